"""Where a solver starts: simulated or given nodes, never at a symmetric point, and the scales that they suggest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.buffered import swept
from covocp.base.checks import as_number, check_density, is_symmetric
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array, is_semidefinite, pack, unpack
from covocp.base.quadrature import interpolated
from covocp.passage.sweep import values_by
from covocp.statement.statement import Block, Statement
from covocp.transcription.mesh import Mesh, control_places
from covocp.transcription.shooting import interval_columns, matrices_along
from covocp.transcription.steering import nominal_states
from covocp.transcription.steps import moving_interval, nominal_interval

# A control guess that is a single number is bent by this multiple of its scale, so that a stationary point that owes
# its existence to a symmetry (u = 0 in equilibrium identification, Schmidt 5.2) is never where the solver starts.
BENDING = 1.0
# So is the guess of a decision or of a free initial value, by this share of its magnitude: it says where about that is.
# A slope that vanishes by symmetry would keep it there, and a Hessian that is negative there stops Newton's method.
BESIDE = 0.01
# Where a decision has no bound its initial covariance is tried at so many times its magnitude.
FAR = 10.0
# A simulated state that grows to so many times what is known of it (1 where that is less) diverges.
DIVERGED = 1e12


def controls_guess(statement: Statement, nodes: Array, control: str, sign: float = 1.0) -> Array:
    """Controls at the nodes (N+1 or N, nu): the user's guess, bent where it is one number."""
    at = control_places(nodes, control)
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
    """How far a control may be varied: its given scale, else half the range of its bounds, else its guess, else 1."""
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
        ProblemError: where its shape does not fit or it is not finite; a function has a value for each entry.
    """
    values = _called(block, guess, at) if callable(guess) else guess
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
        numbers = interpolated(numbers, np.linspace(0.0, 1.0, numbers.shape[0]), at)
    if numbers.shape != (at.size, block.size) or not np.isfinite(numbers).all():
        raise ProblemError(
            f"The guess of '{block.name}' does not fit.",
            expected=f"a finite number, an array over the nodes with {block.size} column(s), or a function of "
            "s = t/T in [0, 1] that returns one",
            received=f"shape {numbers.shape}" if np.isfinite(numbers).all() else "NaN or inf",
            remedy=f"correct the guess of '{block.name}'",
        )
    return numbers


def _called(block: Block, guess: Callable[[Any], Any], at: Array) -> Array:
    """A function of s at all of them at once, or one by one where it takes numbers only (`math.sin`, `if s < 0.5`).

    Raises:
        ProblemError: it fails, or returns another number of values than the block has entries.
    """
    # As many places as entries would leave open which axis is which: then one place is asked for twice.
    places = np.append(at, at[-1]) if at.size == block.size else at
    try:
        together = as_number(block.name, "guess", guess(places))
    except Exception:  # whatever the user's function raises, or lists of numbers and arrays
        together = None
    if together is not None:
        if together.shape == (places.size,) and block.size == 1:
            together = together[:, None]
        elif together.shape == (block.size, places.size):
            together = together.T
        if together.shape == (places.size, block.size):
            return together[: at.size]
    rows = []
    for s in at:
        try:
            value = guess(float(s))
        except Exception as error:
            if together is not None:
                raise _other_count(block, f"shape {together.shape} for {places.size} values of s") from error
            raise ProblemError(
                f"The guess of '{block.name}' is a function that fails.",
                expected="a function of s = t/T, an array of numbers in [0, 1], that returns as many values",
                received=f"{type(error).__name__}: {error}"[:200],
                remedy=f"correct the guess of '{block.name}': numpy.sin, not math.sin; one argument",
            ) from error
        row = as_number(block.name, "guess", value)
        if row.size != block.size:
            raise _other_count(block, f"shape {row.shape} at s = {s:g}")
        rows.append(row.ravel())
    return np.array(rows)


def _other_count(block: Block, received: str) -> ProblemError:
    """The error of a function of s that has another number of values than the block has entries."""
    values = "one value" if block.size == 1 else f"{block.size} values"
    one, several = ("()", "(K,)") if block.size == 1 else (f"({block.size},)", f"(K, {block.size})")
    return ProblemError(
        f"The guess of '{block.name}' is a function that returns another number of values than it has.",
        expected=f"{values} at each s: shape {one} for a number, {several} for an array of K",
        received=received,
        remedy=f"return {values} for each s; numbers over the nodes, which are interpolated, go in as an array",
    )


def starts(statement: Statement, mesh: Mesh, parameters: Array, bent: Array | None = None) -> tuple[Array, Array]:
    """Initial state and matrices, free entries guessed; bent: by units, a little beside a guess that says little."""
    x0, _, e0, ef = statement.boundary_values(parameters)
    lower, upper = statement.state_bounds
    default = np.clip(np.zeros_like(x0), lower, upper)
    for block in statement.states:
        guess = statement.guesses[block.name]
        if guess is not None:
            default[block.span] = evaluate_guess(block, guess, mesh.nodes)[0]
    if bent is not None:
        default = np.where(_bendable(statement), _beside(default, bent, lower, upper), default)
    e0 = np.where(np.isnan(e0), np.nan_to_num(ef), e0)
    for block in statement.matrices:
        if statement.guesses[block.name] is not None:
            e0[block.span] = matrix_guess(block, statement.guesses[block.name])
    known = statement.boundary_values(parameters)[2]
    e0 = np.where(np.isnan(known), e0, known)
    x0, e0 = statement.started(np.where(np.isnan(x0), default, x0), parameters, e0)
    _check_covariances(statement, e0)
    _check_tied(statement, x0, parameters)
    return x0, e0


def _bendable(statement: Statement) -> Array:
    """Whether a guess says only about where a state starts, (nx,): of decisions, and by one number or by none.

    Not of attitudes, which are of unit length.
    """
    result = np.zeros(statement.nx, dtype=bool)
    for block in statement.states:
        plain = is_plain(statement.guesses[block.name]) and not block.tangent
        result[block.span] = plain or block.role == "decision"
    return result


def _beside(values: Array, units: Array, lower: Array, upper: Array) -> Array:
    """Values a little beside some others, on the side where the bounds are further away.

    The magnitude is that of the value; of zero it is the unit or the range of the bounds, the lesser one.
    """
    span = np.where(upper > lower, upper - lower, 0.0)
    size = np.minimum(np.where(values != 0.0, np.abs(values), units), span)
    return np.asarray(values + np.where(upper - values >= values - lower, BESIDE, -BESIDE) * size)


def matrix_guess(block: Block, guess: Given) -> Array:
    """Half-vector of the guess of a matrix; a number means that multiple of the identity.

    Raises:
        ProblemError: where it is not a finite symmetric matrix of the right size.
    """
    numbers = as_number(block.name, "guess", guess)
    if numbers.size == 1:
        numbers = np.diag(np.full(block.size, float(numbers.reshape(()))))
    wrong = numbers.shape != (block.size, block.size)
    if wrong or not is_symmetric(numbers):
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


def _check_tied(statement: Statement, x0: Array, parameters: Array) -> None:
    """Covariances that decisions give must be covariances up to the bounds of each of them.

    Raises:
        ProblemError: names the decision and the bound.
    """
    if statement.tied is None or not statement.tied.matrices:
        return
    covariances = [block for block in statement.matrices if block.covariance]
    for k in statement.decisions:
        far = FAR * max(abs(float(x0[k])), 1.0)
        for side, sign, bound in zip(("lower", "upper"), (-1.0, 1.0), statement.state_bounds, strict=True):
            x = x0.copy()
            x[k] = bound[k] if np.isfinite(bound[k]) else x0[k] + sign * far
            half = np.asarray(ca.DM(statement.started(x, parameters)[1]).full()).ravel()
            for block in covariances:
                matrix = unpack(half[block.span], block.size)
                if np.isnan(matrix).any() or is_semidefinite(matrix[None]):
                    continue
                raise ProblemError(
                    f"The initial value of '{block.name}' is no covariance for every value of the decision "
                    f"'{statement.state_names[k]}' that its bounds allow.",
                    expected="a positive semidefinite matrix up to the bounds",
                    received=f"{matrix.tolist()} where {statement.state_names[k]} = {x[k]:g}"[:200],
                    remedy=f"give decision('{statement.state_names[k]}', ...) a {side} bound that keeps the variance "
                    "positive",
                )


def check_model(statement: Statement, x: Array, u: Array, e: Array, duration: float, parameters: Array) -> None:
    """The model must be finite where the solver starts, and its noise densities sensible.

    The terminal cost counts at the end of the guess, where the methods look at it.

    Raises:
        ProblemError: names the rate, the cost, the constraint or the measurement.
    """
    arguments = [ca.DM(given) for given in (x, u, e, 0.0, duration, parameters)]
    without_matrices = [*arguments[:2], *arguments[3:]]
    check_measured(statement, without_matrices)
    if statement.loop is not None:
        weights = np.asarray(statement.loop.expansion.call(without_matrices)[3].full())
        fed = statement.control_names[: weights.shape[0]]
        check_density(", ".join(fed), "control weight", weights, definite=True)
    rates, matrix_rates, running = (np.asarray(v.full()).ravel() for v in statement.rates.call(arguments))
    groups = [
        ("rate of", statement.state_names, rates),
        ("rate of", statement.matrix_names, matrix_rates),
        ("cost", ("running",), running),
    ]
    for conditions in (statement.path, statement.start):
        if conditions.size:
            values = np.asarray(conditions.function.call(arguments)[0].full()).ravel()
            groups.append(("constraint", conditions.names, values))
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
            noise = np.asarray(form.call(without_matrices)[1].full())
            check_density(", ".join(statement.augmented), "process noise density", noise, definite=False)


def check_measured(statement: Statement, at: list[Any]) -> None:
    """The noise of what is measured, at the start; at instants where it has one value that parameters say.

    Args:
        statement: the problem.
        at: (x, u, t, T, p), numbers of CasADi.

    Raises:
        ProblemError: names the measurement.
    """
    if statement.information is not None:
        stated = np.asarray(statement.information.call(at)[0].full())
        check_density(", ".join(statement.measurement_names), "information", np.diagflat(stated), definite=False)
    if statement.measurement is not None:
        density = np.asarray(statement.measurement.call(at)[2].full())
        for block in statement.measurements:
            own = density[block.span, block.span]
            check_density(block.name, "measurement noise density", own, definite=True)
    samples = statement.samples
    if samples is not None and not any(samples.measurement.jac_sparsity(2, k).nnz() for k in range(len(at) - 1)):
        variance = np.asarray(samples.measurement.call(at)[2].full())
        for block in samples.blocks:
            check_density(block.name, "measurement noise variance", variance[block.span, block.span], definite=True)


def _short(values: Array) -> str:
    return np.array2string(np.asarray(values), precision=4, threshold=8)


def simulate_states(
    statement: Statement, mesh: Mesh, start: Array, e0: Array, u: Array, duration: float, parameters: Array
) -> Array:
    """States at the nodes (N+1, nx) from the controls; where that diverges, a straight line to the final values."""
    values = simulated(statement, mesh, start, e0, u, duration, parameters)
    if values is not None:
        return values
    final = statement.boundary_values(parameters)[1]
    final = np.where(np.isnan(final), start, final)
    return np.asarray(start + mesh.nodes[:, None] * (final - start))


def simulated(
    statement: Statement, mesh: Mesh, start: Array, e0: Array, u: Array, duration: float, parameters: Array
) -> Array | None:
    """States at the nodes (N+1, nx) from the controls, within their bounds; None where they diverge."""
    if statement.coupled:
        advance = moving_interval(statement, mesh.substeps, mesh.step)
        columns = interval_columns(mesh, ca.DM(u.T), duration, ca.DM(parameters))
        values = np.vstack([start, swept(advance, np.concatenate([start, e0]), *columns)[0][:, : statement.nx]])
    else:
        values = nominal_states(statement, mesh, start, u, duration, parameters)
    if np.isfinite(values).all() and not diverges(values, statement.boundary_values(parameters)[1]):
        lower, upper = statement.state_bounds
        return np.asarray(np.clip(values, lower, upper))
    return None


def diverges(values: Array, final: Array) -> bool:
    """Whether some state grows beyond all that is known of it: its values at the ends, and where it moves at first.

    In a small unit of length or a large one of time a number may be large that is not.
    """
    size = np.abs(values)
    moved = np.where(size > 0, size, np.inf)
    first = np.take_along_axis(size, np.argmax(np.isfinite(moved), axis=0)[None], axis=0)[0]
    known = np.maximum(np.maximum(first, np.abs(np.nan_to_num(final))), 1.0)
    return bool((size.max(axis=0, initial=0.0) > DIVERGED * known).any())


def simulate_matrices(
    statement: Statement, mesh: Mesh, x: Array, u: Array, e0: Array, duration: float, parameters: Array
) -> Array:
    """Half-vectors at the nodes (N+1, ne) along given nodes of the nominal; read-only."""
    alike = np.broadcast_to(e0, (mesh.intervals + 1, e0.size))
    if not statement.matrices or mesh.eliminated or statement.coupled:  # no variables, or what drives them is unknown
        return alike
    values = matrices_function(statement, mesh)(x.T, u.T, duration, parameters)
    e = np.asarray(values[0].full()).T
    return e if np.isfinite(e).all() else alike


def matrices_function(statement: Statement, mesh: Mesh) -> ca.Function:
    """(states at the nodes, controls, T, parameters) -> half-vectors at the nodes, running cost of the intervals.

    Without derivatives. Each interval starts at the given node of the nominal; only the matrices run in sequence.
    """
    x = ca.MX.sym("x", statement.nx, mesh.intervals + 1)
    u = ca.MX.sym("u", statement.nu, mesh.control_nodes)
    duration, p = ca.MX.sym("T"), ca.MX.sym("p", statement.np)
    common = interval_columns(mesh, u, duration, p)
    _, states, cost = nominal_interval(statement, mesh.substeps, mesh.step).map(mesh.intervals)(x[:, :-1], *common)
    e, matrix_cost = matrices_along(statement, mesh, x, states, common, p, passage=values_by)
    return ca.Function("matrices", [x, u, duration, p], [e, cost + matrix_cost])
