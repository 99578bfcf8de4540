"""Where a solver starts: simulated or given nodes, never at a symmetric point, and the scales that they suggest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.checks import as_number, check_density
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array, half_indices, pack, real_numbers, unpack
from covocp.statement.interval import model_symbols
from covocp.statement.statement import Block, Statement
from covocp.transcription.mesh import Graded, Mesh, Options, Stiffness, choose_mesh, choose_step
from covocp.transcription.nlp import Scales
from covocp.transcription.shooting import interval_columns, matrices_along
from covocp.transcription.steps import KEPT, full_interval, nominal_interval
from covocp.transcription.trajectory import Trajectory

# A control guess that is a single number is bent by this multiple of its scale, so that a stationary point that owes
# its existence to a symmetry (u = 0 in equilibrium identification, Schmidt 5.2) is never where the solver starts.
BENDING = 1.0
RESPONSE_STEP = 1e-3
# Real part over modulus of an eigenvalue below which what it belongs to dies out before it turns.
DAMPED = -0.5


def controls_guess(statement: Statement, nodes: Array, control: str, sign: float = 1.0) -> Array:
    """Controls at the nodes (N+1 or N, nu): the user's guess, bent where it is one number."""
    at = nodes if control == "linear" else 0.5 * (nodes[:-1] + nodes[1:])
    columns = []
    for block in statement.controls:
        guess = statement.guesses[block.name]
        lower, upper = (bound[block.span] for bound in statement.control_bounds)
        values = evaluate_guess(block, 0.0 if guess is None else guess, at)
        scale = control_scale(statement, block, values)
        if is_plain(guess):
            values = values + sign * BENDING * scale * (1.0 - at[:, None])
        columns.append(np.clip(values, lower, upper))
    return np.concatenate([np.zeros((at.size, 0)), *columns], axis=1)


def is_plain(guess: Given) -> bool:
    """Whether a guess is one number, which says little: it may be steered and bent."""
    return not callable(guess) and np.ndim(0.0 if guess is None else guess) == 0


def control_scale(statement: Statement, block: Block, values: Array) -> Array:
    """Typical magnitudes of a control: given, else half the range of the bounds, else of the guess, else 1."""
    given = statement.scales.get(block.name)
    if given is not None:
        return given
    lower, upper = (bound[block.span] for bound in statement.control_bounds)
    half = np.where(np.isfinite(upper - lower), 0.5 * (upper - lower), 0.0)
    magnitude = np.abs(values).max(axis=0, initial=0.0)
    scale = np.where(half > 0, half, magnitude)
    return np.where(scale > 0, scale, 1.0)


def evaluate_guess(block: Block, guess: Given, at: Array) -> Array:
    """A guess (number, array over the nodes, function of s) as an array (len(at), size).

    Raises:
        ProblemError: where its shape does not fit or it is not finite.
    """
    values = _called(block.name, guess, at) if callable(guess) else guess
    numbers = as_number(block.name, "guess", values)
    if numbers.ndim == 0:
        numbers = np.full((at.size, block.size), float(numbers))
    elif numbers.shape == (block.size,):
        numbers = np.tile(numbers, (at.size, 1))
    elif numbers.ndim == 1 and block.size == 1:
        numbers = numbers[:, None]
    if numbers.ndim == 2 and numbers.shape == (block.size, at.size) and numbers.shape != (at.size, block.size):
        numbers = numbers.T
    if numbers.ndim == 2 and numbers.shape[1] == block.size and numbers.shape[0] > 1 and numbers.shape[0] != at.size:
        own = np.linspace(0.0, 1.0, numbers.shape[0])
        numbers = np.stack([np.interp(at, own, column) for column in numbers.T], axis=1)
    if numbers.shape != (at.size, block.size) or not np.isfinite(numbers).all():
        raise ProblemError(
            f"The guess of '{block.name}' does not fit.",
            expected=f"a finite number, an array over the nodes with {block.size} column(s), or a function of "
            "s = t/T in [0, 1] that returns one",
            received=f"shape {numbers.shape}" if np.isfinite(numbers).all() else "NaN or inf",
            remedy=f"correct the guess of '{block.name}'",
        )
    return numbers


def _called(name: str, guess: Callable[[Any], Any], at: Array) -> Any:
    """A function of s at all of them at once, or one by one where it takes numbers only (`math.sin`, `if s < 0.5`).

    Raises:
        ProblemError: it fails.
    """
    try:
        return guess(at)
    except Exception:  # whatever the user's function raises
        try:
            return np.array([real_numbers(guess(float(s))) for s in at])
        except Exception as error:
            raise ProblemError(
                f"The guess of '{name}' is a function that fails.",
                expected="a function of s = t/T, an array of numbers in [0, 1], that returns as many values",
                received=f"{type(error).__name__}: {error}"[:200],
                remedy=f"correct the guess of '{name}': numpy.sin, not math.sin; one argument",
            ) from error


def starts(statement: Statement, mesh: Mesh, parameters: Array) -> tuple[Array, Array]:
    """Initial state and matrices, the free entries guessed."""
    x0, _, e0, ef = statement.boundary_values(parameters)
    lower, upper = statement.state_bounds
    default = np.clip(np.zeros_like(x0), lower, upper)
    for block in statement.states:
        guess = statement.guesses[block.name]
        if guess is not None:
            default[block.span] = evaluate_guess(block, guess, mesh.nodes)[0]
    e0 = np.where(np.isnan(e0), np.nan_to_num(ef), e0)
    for block in statement.matrices:
        if statement.guesses[block.name] is not None:
            e0[block.span] = matrix_guess(block, statement.guesses[block.name])
    known = statement.boundary_values(parameters)[2]
    e0 = np.where(np.isnan(known), e0, known)
    _check_covariances(statement, e0)
    return np.where(np.isnan(x0), default, x0), e0


def matrix_guess(block: Block, guess: Given) -> Array:
    """Half-vector of the guess of a matrix; a number means that multiple of the identity.

    Raises:
        ProblemError: where it is not a finite symmetric matrix of the right size.
    """
    numbers = as_number(block.name, "guess", guess)
    if numbers.size == 1:
        numbers = np.diag(np.full(block.size, float(numbers.reshape(()))))
    wrong = numbers.shape != (block.size, block.size)
    if wrong or not np.isfinite(numbers).all() or not np.allclose(numbers, numbers.T):
        raise ProblemError(
            f"The guess of '{block.name}' does not fit.",
            expected=f"a symmetric {block.size} x {block.size} matrix, or a number (times identity)",
            received=f"shape {numbers.shape}" if wrong else str(numbers),
            remedy=f"correct the guess of '{block.name}'",
        )
    return pack(numbers)


def _check_covariances(statement: Statement, e0: Array) -> None:
    """Initial covariances that come from parameters are checked here, with their numbers."""
    for block in statement.matrices:
        if block.covariance:
            check_density(block.name, "initial value", unpack(e0[block.span], block.size), definite=False)


def check_model(statement: Statement, x: Array, u: Array, e: Array, duration: float, parameters: Array) -> None:
    """The model must be finite where the solver starts, and its noise densities sensible.

    The terminal cost counts at the end of the guess, where the methods look at it.

    Raises:
        ProblemError: names the rate, the cost, the constraint or the measurement.
    """
    arguments = (x, u, e, 0.0, duration, parameters)
    if statement.information is not None:
        stated = np.asarray(statement.information(x, u, 0.0, duration, parameters).full())
        check_density(", ".join(statement.measurement_names), "information", np.diagflat(stated), definite=False)
    if statement.measurement is not None:
        density = np.asarray(statement.measurement(x, u, 0.0, duration, parameters)[2].full())
        for block in statement.measurements:
            own = density[block.span, block.span]
            check_density(block.name, "measurement noise density", own, definite=True)
    if statement.loop is not None:
        weights = np.asarray(statement.loop.expansion(x, u, 0.0, duration, parameters)[3].full())
        fed = statement.control_names[: weights.shape[0]]
        check_density(", ".join(fed), "control weight", weights, definite=True)
    rates, matrix_rates, running = (np.asarray(v.full()).ravel() for v in statement.rates(*arguments))
    groups = [
        ("rate of", statement.state_names, rates),
        ("rate of", statement.matrix_names, matrix_rates),
        ("cost", ("running",), running),
    ]
    for conditions in (statement.path, statement.start):
        groups.append(("constraint", conditions.names, np.asarray(conditions.function(*arguments).full()).ravel()))
    for what, names, values in groups:
        for name, value in zip(names, values, strict=True):
            if not np.isfinite(value):
                raise ProblemError(
                    f"The {what} '{name}' is {value} at the initial guess.",
                    expected="finite values where the solver starts",
                    received=f"state {_short(x)}, control {_short(u)}, parameters {_short(parameters)}, t = 0",
                    remedy="give another guess or initial value, or bounds that keep the model in its domain",
                )
    for block, form in zip(statement.matrices, statement.riccati, strict=True):
        if form is not None and block.estimation:
            noise = np.asarray(form(x, u, 0.0, duration, parameters)[1].full())
            check_density(", ".join(statement.augmented), "process noise density", noise, definite=False)


def _short(values: Array) -> str:
    return np.array2string(np.asarray(values), precision=4, threshold=8)


@lru_cache(maxsize=KEPT)
def _simulation(statement: Statement, mesh: Mesh) -> ca.Function:
    """All intervals in sequence, from the start."""
    if statement.coupled:
        interval = full_interval(statement, mesh.substeps, mesh.step)
    else:
        interval = nominal_interval(statement, mesh.substeps, mesh.step)
    return interval.mapaccum("simulate", mesh.intervals)


def simulate_states(
    statement: Statement, mesh: Mesh, start: Array, e0: Array, u: Array, duration: float, parameters: Array
) -> Array:
    """States at the nodes (N+1, nx) from the controls; where that diverges, a straight line to the final values."""
    first = np.concatenate([start, e0]) if statement.coupled else start
    run = _simulation(statement, mesh)
    ends = np.asarray(run(first, *interval_columns(mesh, ca.DM(u.T), duration, ca.DM(parameters)))[0].full())
    values = np.vstack([start, ends[: statement.nx].T])
    if np.isfinite(values).all() and np.abs(values).max(initial=0.0) < 1e12:
        lower, upper = statement.state_bounds
        return np.asarray(np.clip(values, lower, upper))
    final = statement.boundary_values(parameters)[1]
    final = np.where(np.isnan(final), start, final)
    return np.asarray(start + mesh.nodes[:, None] * (final - start))


def simulate_matrices(
    statement: Statement, mesh: Mesh, x: Array, u: Array, e0: Array, duration: float, parameters: Array
) -> Array:
    """Half-vectors at the nodes (N+1, ne) along given nodes of the nominal."""
    if not statement.matrices:
        return np.zeros((mesh.intervals + 1, 0))
    if mesh.eliminated or statement.coupled:  # not variables, or driven by what is not known yet
        return np.tile(e0, (mesh.intervals + 1, 1))
    values = matrices_function(statement, mesh)(x.T, u.T, duration, parameters)
    e = np.asarray(values[0].full()).T
    return e if np.isfinite(e).all() else np.tile(e0, (mesh.intervals + 1, 1))


def matrices_function(statement: Statement, mesh: Mesh) -> ca.Function:
    """(states at the nodes, controls, T, parameters) -> half-vectors at the nodes, running cost of the intervals.

    Each interval starts at the given node of the nominal; only the matrices run in sequence.
    """
    x = ca.MX.sym("x", statement.nx, mesh.intervals + 1)
    u = ca.MX.sym("u", statement.nu, mesh.control_nodes)
    duration, p = ca.MX.sym("T"), ca.MX.sym("p", statement.np)
    common = interval_columns(mesh, u, duration, p)
    _, states, cost = nominal_interval(statement, mesh.substeps, mesh.step).map(mesh.intervals)(x[:, :-1], *common)
    e, matrix_cost = matrices_along(statement, mesh, x, states, common, p)
    return ca.Function("matrices", [x, u, duration, p], [e, cost + matrix_cost])


def resolve_mesh(statement: Statement, options: Options, parameters: Array) -> Mesh:
    """The mesh of some options, its steps chosen by the stiffness of the problem at its start."""
    stiff = stiffness(statement, options, parameters)
    return choose_mesh(statement, options, choose_step(statement, options, stiff), stiff)


def stiffness(statement: Statement, options: Options, parameters: Array) -> Stiffness:
    """The stiffness at the start, for the longest interval: of f_x, and for the matrices of 2 (F - E W).

    A graded mesh knows that of the filter on each of its intervals.
    """
    nodes, control = options.nodes(), options.control
    u = controls_guess(statement, nodes[:2], control)[0]
    mesh = Mesh(nodes=nodes, control=control, substeps=1, segments=(nodes.size - 1,), eliminated=True, step="rk4")
    x, e = starts(statement, mesh, parameters)
    duration = statement.duration.guess
    rates = _eigenvalues(state_jacobian(statement)(x, u, e, 0.0, duration, parameters).full())
    longest = duration * float(np.diff(nodes).max())
    matrices = 0.0
    for block, form in zip(statement.matrices, statement.riccati, strict=True):
        if form is None:
            slope = _matrix_jacobian(statement)(x, u, e, 0.0, duration, parameters).full()
            matrices = max(matrices, _largest(_eigenvalues(slope)))
            break
        if block.estimation and isinstance(options.grid, Graded):
            matrices = max(matrices, options.grid.stiffness / longest)
            continue
        drift, _, information = (np.asarray(v.full()) for v in form(x, u, 0.0, duration, parameters))
        with np.errstate(invalid="ignore"):  # a density that is zero: refused by its name later
            filtered = drift - unpack(e[block.span], block.size) @ information
        matrices = max(matrices, 2 * _largest(_eigenvalues(filtered)))
    return Stiffness(
        nominal=longest * _largest(rates),
        oscillating=longest * _largest(rates[rates.real >= DAMPED * np.abs(rates)]),
        decaying=longest * _largest(rates[rates.real <= 0.0]),
        matrices=longest * matrices,
    )


def _eigenvalues(matrix: Array) -> NDArray[np.complex128]:
    """Eigenvalues; none of a matrix that is not finite."""
    return np.linalg.eigvals(matrix).astype(complex) if np.isfinite(matrix).all() else np.zeros(0, complex)


def _largest(values: NDArray[np.complex128]) -> float:
    return float(np.abs(values).max(initial=0.0))


@lru_cache(maxsize=KEPT)
def state_jacobian(statement: Statement) -> ca.Function:
    """f_x as a function of the six arguments."""
    symbols = model_symbols(statement)
    if statement.nominal is None:
        rate = statement.rates(*symbols)[0]
    else:
        rate = statement.nominal(*symbols[:2], *symbols[3:])[0]
    return ca.Function("jacobian", symbols, [ca.jacobian(rate, symbols[0])])


def _matrix_jacobian(statement: Statement) -> ca.Function:
    """V_e as a function of the six arguments."""
    symbols = model_symbols(statement)
    return ca.Function("jacobian", symbols, [ca.jacobian(statement.rates(*symbols)[1], symbols[2])])


def magnitudes(statement: Statement, guess: Trajectory, parameters: Array) -> Scales:
    """Magnitudes from the given scales, bounds, boundary values, standard deviations and the trajectory itself."""
    x0, xf, e0, _ = statement.boundary_values(parameters)
    lower, upper = statement.state_bounds
    candidates = [np.abs(guess.x).max(axis=0, initial=0.0), np.abs(np.nan_to_num(x0)), np.abs(np.nan_to_num(xf))]
    for block in statement.matrices:
        if block.estimation:
            diagonal = np.diagonal(unpack(np.nan_to_num(e0[block.span]), block.size))
            known = min(statement.nx, block.size)  # constants to be chosen are states that nothing estimates
            deviations = np.zeros(statement.nx)
            deviations[:known] = np.sqrt(np.maximum(diagonal[:known], 0.0))
            candidates.append(deviations)
    span = upper - lower
    x = np.max(candidates, axis=0)
    bounded = np.isfinite(span) & (span > 0)
    x = np.where(bounded, np.clip(x, 1e-3 * span, np.where(x > 0, span, np.inf)), x)
    x = np.where(x > 0, x, np.where(bounded, span, 1.0))
    for block in statement.states:
        if block.name in statement.scales:
            x[block.span] = statement.scales[block.name]
    u = np.ones(statement.nu)
    for block in statement.controls:
        u[block.span] = control_scale(statement, block, guess.u[:, block.span])
    return Scales(x=x, u=u, e=_matrix_scales(statement, guess.e), duration=statement.duration.guess)


def choose_scales(statement: Statement, mesh: Mesh, guess: Trajectory, parameters: Array) -> Scales:
    """The magnitudes along a guess; controls without bounds on both sides by what they move as well."""
    scales = magnitudes(statement, guess, parameters)
    u, response = scales.u.copy(), None
    for block in statement.controls:
        bounds = np.concatenate([bound[block.span] for bound in statement.control_bounds])
        if block.name not in statement.scales and not np.isfinite(bounds).all() and not statement.coupled:
            if response is None:
                response = _needed_controls(statement, mesh, guess, scales.x, parameters)
            magnitude = np.abs(guess.u[:, block.span]).max(axis=0, initial=0.0)
            u[block.span] = np.maximum(magnitude, np.where(response[block.span] > 0, response[block.span], 1.0))
    return replace(scales, u=u)


def _needed_controls(statement: Statement, mesh: Mesh, guess: Trajectory, scale: Array, parameters: Array) -> Array:
    """Constant changes of each control that move some state by its scale, to first order; 0 where none does."""
    needed = np.zeros(statement.nu)
    base = simulate_states(statement, mesh, guess.x[0], guess.e[0], guess.u, guess.duration, parameters)
    for i in range(statement.nu):
        changed = guess.u.copy()
        step = RESPONSE_STEP * max(1.0, float(np.abs(guess.u[:, i]).max(initial=0.0)))
        changed[:, i] += step
        moved = simulate_states(statement, mesh, guess.x[0], guess.e[0], changed, guess.duration, parameters)
        response = float((np.abs(moved - base).max(axis=0, initial=0.0) / scale).max(initial=0.0)) / step
        needed[i] = 1.0 / response if np.isfinite(response) and response > 0 else 0.0
    return needed


def _matrix_scales(statement: Statement, e: Array) -> Array:
    """sqrt(E_ii E_jj) from the largest diagonal entries along the guess; 1 where these are zero."""
    scales = np.ones(statement.ne)
    for block in statement.matrices:
        rows, columns = half_indices(block.size)
        diagonal = np.abs(e[:, block.span][:, rows == columns]).max(axis=0, initial=0.0)
        diagonal = np.where(diagonal > 0, diagonal, 1.0)
        scales[block.span] = np.sqrt(diagonal[rows]) * np.sqrt(diagonal[columns])
    return scales
