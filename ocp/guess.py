"""Where a solver starts: simulated or given nodes, never at a symmetric point, and the scales that they suggest."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.checks import as_number, check_density
from covocp.errors import ProblemError, describe
from covocp.integrators import KEPT, full_interval, nominal_interval
from covocp.matrices import Array, half_indices, pack, unpack
from covocp.mesh import Mesh
from covocp.nlp import Scales
from covocp.shooting import common_columns, matrices_along
from covocp.statement import Block, Statement
from covocp.trajectory import Trajectory

# A control guess that is a single number is bent by this multiple of its scale, so that a stationary point that owes
# its existence to a symmetry (u = 0 in equilibrium identification, Schmidt 5.2) is never where the solver starts.
BENDING = 1.0
RANDOM_AMPLITUDE = 1.0
STEERING_STEPS = 4
RESPONSE_STEP = 1e-3
STEERING_TOLERANCE = 1e-6


def controls_guess(
    statement: Statement, nodes: Array, control: str, random: np.random.Generator | None = None, sign: float = 1.0
) -> Array:
    """Controls at the nodes (N+1 or N, nu): the user's guess, bent where it is one number, or random (multistart)."""
    at = nodes if control == "linear" else 0.5 * (nodes[:-1] + nodes[1:])
    columns = []
    for block in statement.controls:
        guess = statement.guesses[block.name]
        lower, upper = (bound[block.span] for bound in statement.control_bounds)
        values = evaluate_guess(block, 0.0 if guess is None else guess, at)
        scale = control_scale(statement, block, values)
        if random is not None:
            values = values + RANDOM_AMPLITUDE * scale * _random_wave(at, block.size, random)
        elif is_plain(guess):
            values = values + sign * BENDING * scale * (1.0 - at[:, None])
        columns.append(np.clip(values, lower, upper))
    return np.concatenate([np.zeros((at.size, 0)), *columns], axis=1)


def is_plain(guess: Any) -> bool:
    """Whether a guess is one number, which says little: it may be steered and bent."""
    return not callable(guess) and np.ndim(0.0 if guess is None else guess) == 0


def _random_wave(at: Array, size: int, random: np.random.Generator) -> Array:
    """A smooth random function: a few cosines with random coefficients."""
    orders = np.arange(4)
    coefficients = random.standard_normal((orders.size, size)) / (1.0 + orders[:, None])
    return np.asarray(np.cos(np.pi * np.outer(at, orders)) @ coefficients)


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


def evaluate_guess(block: Block, guess: Any, at: Array) -> Array:
    """A guess (number, array over the nodes, function of s) as an array (len(at), size).

    Raises:
        ProblemError: where its shape does not fit or it is not finite.
    """
    values = guess(at) if callable(guess) else guess
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
            describe(
                f"The guess of '{block.name}' does not fit.",
                expected=f"a finite number, an array over the nodes with {block.size} column(s), or a function of "
                "s = t/T in [0, 1] that returns one",
                received=f"shape {numbers.shape}" if np.isfinite(numbers).all() else "NaN or inf",
                remedy=f"correct the guess of '{block.name}'",
            )
        )
    return numbers


def first_guess(
    statement: Statement, mesh: Mesh, parameters: Array, random: np.random.Generator | None = None
) -> Trajectory:
    """The trajectory from which a solver starts.

    Controls from their guesses; states from theirs, or simulated; matrices simulated.

    Raises:
        ProblemError: where a rate is NaN or inf at the start (says which).
    """
    u = controls_guess(statement, mesh.nodes, mesh.control, random)
    duration = statement.duration.guess
    start, e0 = starts(statement, mesh, parameters)
    check_model(statement, start, u[:1].ravel(), e0, duration, parameters)
    if statement.nu and not statement.coupled and all(is_plain(statement.guesses[b.name]) for b in statement.controls):
        u = steer(statement, mesh, start, u, duration, parameters)
    guessed = [b for b in statement.states if statement.guesses[b.name] is not None]
    if len(guessed) < len(statement.states):
        x = simulate_states(statement, mesh, start, e0, u, duration, parameters)
    else:
        x = np.zeros((mesh.intervals + 1, statement.nx))
    for block in guessed:
        x[:, block.span] = evaluate_guess(block, statement.guesses[block.name], mesh.nodes)
    return Trajectory(x=x, u=u, e=simulate_matrices(statement, mesh, x, u, e0, duration, parameters), duration=duration)


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


def matrix_guess(block: Block, guess: Any) -> Array:
    """Half-vector of the guess of a matrix; a number means that multiple of the identity.

    Raises:
        ProblemError: where it is not a finite symmetric matrix of the right size.
    """
    numbers = as_number(block.name, "guess", guess)
    if numbers.size == 1:
        numbers = float(numbers.reshape(())) * np.eye(block.size)
    wrong = numbers.shape != (block.size, block.size)
    if wrong or not np.isfinite(numbers).all() or not np.allclose(numbers, numbers.T):
        raise ProblemError(
            describe(
                f"The guess of '{block.name}' does not fit.",
                expected=f"a symmetric {block.size} x {block.size} matrix, or a number (times identity)",
                received=f"shape {numbers.shape}" if wrong else str(numbers),
                remedy=f"correct the guess of '{block.name}'",
            )
        )
    return pack(numbers)


def _check_covariances(statement: Statement, e0: Array) -> None:
    """Initial covariances that come from parameters are checked here, with their numbers."""
    for block in statement.matrices:
        if block.covariance:
            check_density(block.name, "initial value", unpack(e0[block.span], block.size), definite=False)


def check_model(statement: Statement, x: Array, u: Array, e: Array, duration: float, parameters: Array) -> None:
    """The model must be finite where the solver starts, and its noise densities sensible.

    Raises:
        ProblemError: names the rate, the cost, the constraint or the measurement.
    """
    arguments = (x, u, e, 0.0, duration, parameters)
    if statement.measurement is not None:
        density = np.asarray(statement.measurement(x, u, 0.0, duration, parameters)[2].full())
        check_density(", ".join(statement.measurement_names), "measurement noise density", density, definite=True)
    if statement.loop is not None:
        weights = np.asarray(statement.loop.expansion(x, u, 0.0, duration, parameters)[3].full())
        fed = statement.control_names[: weights.shape[0]]
        check_density(", ".join(fed), "control weight", weights, definite=True)
    rates, matrix_rates, running = (np.asarray(v.full()).ravel() for v in statement.rates(*arguments))
    terminal = np.asarray(statement.terminal(x, e, duration, parameters).full()).ravel()
    groups = [
        ("rate of", statement.state_names, rates),
        ("rate of", statement.matrix_names, matrix_rates),
        ("cost", ("running",), running),
        ("cost", ("terminal",), terminal),
    ]
    for conditions in (statement.path, statement.start):
        groups.append(("constraint", conditions.names, np.asarray(conditions.function(*arguments).full()).ravel()))
    for what, names, values in groups:
        for name, value in zip(names, values, strict=True):
            if not np.isfinite(value):
                raise ProblemError(
                    describe(
                        f"The {what} '{name}' is {value} at the initial guess.",
                        expected="finite values where the solver starts",
                        received=f"state {_short(x)}, control {_short(u)}, parameters {_short(parameters)}, t = 0",
                        remedy="give another guess or initial value, or bounds that keep the model in its domain",
                    )
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
        interval = nominal_interval(statement, mesh.substeps)
    return interval.mapaccum("simulate", mesh.intervals)


def simulate_states(
    statement: Statement, mesh: Mesh, start: Array, e0: Array, u: Array, duration: float, parameters: Array
) -> Array:
    """States at the nodes (N+1, nx) from the controls; where that diverges, a straight line to the final values."""
    first = np.concatenate([start, e0]) if statement.coupled else start
    run = _simulation(statement, mesh)
    ends = np.asarray(run(first, *common_columns(mesh, ca.DM(u.T), duration, ca.DM(parameters)))[0].full())
    values = np.vstack([start, ends[: statement.nx].T])
    if np.isfinite(values).all() and np.abs(values).max(initial=0.0) < 1e12:
        lower, upper = statement.state_bounds
        return np.asarray(np.clip(values, lower, upper))
    final = statement.boundary_values(parameters)[1]
    final = np.where(np.isnan(final), start, final)
    return np.asarray(start + mesh.nodes[:, None] * (final - start))


def steer(statement: Statement, mesh: Mesh, start: Array, u: Array, duration: float, parameters: Array) -> Array:
    """Add the control of least energy that brings the nominal to its final values; the bend follows its sign.

    The bend 1 - s breaks symmetries; where the terminal conditions prefer a direction, it must not oppose them. Steps
    of Gauss and Newton on the miss, kept only while the miss falls.
    """
    final = statement.boundary_values(parameters)[1]
    fixed = np.flatnonzero(~np.isnan(final))
    if not fixed.size or not np.isfinite(start).all():
        return u
    miss = _miss_function(statement, mesh, fixed.tolist())
    weights = np.tile(quadrature_weights(mesh)[:, None], (1, statement.nu)).ravel()
    scale = np.maximum(np.maximum(np.abs(final[fixed]), np.abs(start[fixed])), 1e-3)

    def pull(controls: Array) -> tuple[Array, Array, float]:
        value, slope = miss(start, controls.T, duration, parameters)
        gap = (np.asarray(value.full()).ravel() - final[fixed]) / scale
        return gap, np.asarray(slope.full()) / scale[:, None], float(np.linalg.norm(gap))

    plain = controls_guess(statement, mesh.nodes, mesh.control, sign=0.0)
    best, (gap, slope, norm) = plain, pull(plain)
    for _ in range(STEERING_STEPS):
        if not np.isfinite(slope).all() or norm < STEERING_TOLERANCE:
            break
        change = -(slope / weights).T @ np.linalg.pinv(slope / weights @ slope.T, rcond=1e-8) @ gap
        trial = np.clip(best + change.reshape(u.shape), *statement.control_bounds)
        following = pull(trial)
        if not following[2] < norm:
            break
        best, (gap, slope, norm) = trial, following
    bend = u - plain
    sign = np.where(np.sum((best - plain) * bend, axis=0) < 0, -1.0, 1.0)
    return np.asarray(np.clip(best + sign * bend, *statement.control_bounds))


def quadrature_weights(mesh: Mesh) -> Array:
    """Weight of each control value in the integral over s: trapezoidal for linear controls, lengths for constant."""
    steps = np.diff(mesh.nodes)
    if mesh.control == "constant":
        return steps
    return np.asarray(0.5 * (np.append(steps, 0.0) + np.append(0.0, steps)))


def _miss_function(statement: Statement, mesh: Mesh, fixed: list[int]) -> ca.Function:
    """(start, controls, T, parameters) -> final values of the fixed components, their Jacobian by the controls."""
    u = ca.MX.sym("u", statement.nu * mesh.control_nodes)
    x0, duration, p = ca.MX.sym("x0", statement.nx), ca.MX.sym("T"), ca.MX.sym("p", statement.np)
    matrix = ca.reshape(u, statement.nu, mesh.control_nodes)
    run = nominal_interval(statement, mesh.substeps).mapaccum("simulate", mesh.intervals)
    last = run(x0, *common_columns(mesh, matrix, duration, p))[0][:, -1][fixed]
    inner = ca.Function("miss", [x0, u, duration, p], [last, ca.jacobian(last, u)])
    controls = ca.MX.sym("controls", statement.nu, mesh.control_nodes)
    return ca.Function("miss", [x0, controls, duration, p], list(inner(x0, ca.vec(controls), duration, p)))


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
    common = common_columns(mesh, u, duration, p)
    _, states, cost = nominal_interval(statement, mesh.substeps).map(mesh.intervals)(x[:, :-1], *common)
    e, matrix_cost = matrices_along(statement, mesh, x, states, common, p)
    return ca.Function("matrices", [x, u, duration, p], [e, cost + matrix_cost])


def stiffness(statement: Statement, nodes: Array, control: str, parameters: Array, *, matrices: bool) -> float:
    """Largest h times spectral radius of what Runge-Kutta steps, at the start: f_x, with `matrices` 2 (F - E W)."""
    u = controls_guess(statement, nodes[:2], control)[0]
    mesh = Mesh(nodes=nodes, control=control, substeps=1, segments=(nodes.size - 1,), eliminated=True, step="rk4")
    x, e = starts(statement, mesh, parameters)
    duration = statement.duration.guess
    largest = _radius(_state_jacobian(statement)(x, u, e, 0.0, duration, parameters).full())
    if matrices and statement.ne:
        for block, form in zip(statement.matrices, statement.riccati, strict=True):
            if form is None:
                slope = _matrix_jacobian(statement)(x, u, e, 0.0, duration, parameters).full()
                largest = max(largest, _radius(slope))
                break
            drift, _, information = (np.asarray(v.full()) for v in form(x, u, 0.0, duration, parameters))
            largest = max(largest, 2 * _radius(drift - unpack(e[block.span], block.size) @ information))
    return float(largest * duration * np.diff(nodes).max())


def _radius(matrix: Array) -> float:
    return float(np.abs(np.linalg.eigvals(matrix)).max(initial=0.0)) if np.isfinite(matrix).all() else 0.0


def _state_jacobian(statement: Statement) -> ca.Function:
    """f_x as a function of the six arguments."""
    symbols = _six_symbols(statement)
    if statement.nominal is None:
        rate = statement.rates(*symbols)[0]
    else:
        rate = statement.nominal(*symbols[:2], *symbols[3:])[0]
    return ca.Function("jacobian", symbols, [ca.jacobian(rate, symbols[0])])


def _matrix_jacobian(statement: Statement) -> ca.Function:
    """V_e as a function of the six arguments."""
    symbols = _six_symbols(statement)
    return ca.Function("jacobian", symbols, [ca.jacobian(statement.rates(*symbols)[1], symbols[2])])


def _six_symbols(statement: Statement) -> list[Any]:
    symbolic: Any = statement.symbolic
    sizes = (statement.nx, statement.nu, statement.ne, 1, 1, statement.np)
    return [symbolic.sym(f"a{i}", n) for i, n in enumerate(sizes)]


def choose_scales(statement: Statement, mesh: Mesh, guess: Trajectory, parameters: Array) -> Scales:
    """Magnitudes from the given scales, bounds, boundary values, standard deviations and the guess."""
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
    response = None
    for block in statement.controls:
        u[block.span] = control_scale(statement, block, guess.u[:, block.span])
        bounds = np.concatenate([bound[block.span] for bound in statement.control_bounds])
        if block.name not in statement.scales and not np.isfinite(bounds).all() and not statement.coupled:
            response = _needed_controls(statement, mesh, guess, x, parameters) if response is None else response
            magnitude = np.abs(guess.u[:, block.span]).max(axis=0, initial=0.0)
            u[block.span] = np.maximum(magnitude, np.where(response[block.span] > 0, response[block.span], 1.0))
    return Scales(x=x, u=u, e=_matrix_scales(statement, guess.e), duration=statement.duration.guess)


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
        scales[block.span] = np.sqrt(diagonal[rows] * diagonal[columns])
    return scales
