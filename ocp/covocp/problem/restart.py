"""The same problem with its start as parameters: initial values of states and matrices may change between solves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.checks import as_number, check_density, check_symmetric_numbers, digits
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr, Given
from covocp.base.matrices import Array, pack, standard_deviations, unpack, without_rounding
from covocp.base.residuals import onto_bounds, passing
from covocp.base.short_repr import short_repr
from covocp.problem.attitude import as_quaternion
from covocp.problem.checks import find_name
from covocp.problem.declarations import Declarations, Parameter, State
from covocp.problem.estimation_covariance import with_estimation
from covocp.problem.matrices import Matrix
from covocp.statement.statement import Statement


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """An initial value that is a parameter.

    Args:
        of: the state or the matrix.
        parameter: name of the parameter: known entries of the state, half-vector of the matrix.
        place: its rows among all initial states, or among all half-vectors.
        value: as declared, of the parameter.
        known: which entries of a state are no free ones; of a matrix all.
        lower, upper: bounds of these entries.
        margins: by which these entries of a state may pass their bounds and be at them, (2, entries).
    """

    of: State | Matrix
    parameter: str
    place: slice
    value: Array
    known: tuple[int, ...]
    lower: Array
    upper: Array
    margins: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Restartable:
    """Declarations with initial values as parameters, and these, states first."""

    declarations: Declarations
    starts: tuple[Start, ...]

    __repr__ = short_repr


def restartable(declarations: Declarations, statement: Statement) -> Restartable:
    """The declarations with every known initial value of states and of matrices as a parameter.

    Parameters are called "initial_<name>". An expected cost gets the estimation covariance that is derived from it, so
    that its start is one too. What decisions give, and free entries, stay as they are.

    Args:
        declarations: of a problem.
        statement: of the same.
    """
    start, end, matrices, _ = statement.boundary_values(statement.values)
    if declarations.expected is not None and not any(matrix.estimation for matrix in declarations.matrices):
        declarations = with_estimation(declarations)
    starts: list[Start] = []
    for position, state in enumerate(declarations.states):
        if state.role == "moving":
            span = next(b for b in statement.states if b.name == state.name).span
            declarations = _with_start(declarations, position, span, (start[span], end[span]), starts)
    estimated = next((position for position, matrix in enumerate(declarations.matrices) if matrix.estimation), None)
    spreads = {c.chance.spread for c in declarations.constraints if c.chance is not None} - {None}
    followers = [] if estimated is None else [i for i, m in enumerate(declarations.matrices) if m.name in spreads]
    for position, matrix in enumerate(declarations.matrices):
        if position in followers and position != estimated:
            continue  # the actual system starts where its filter does
        place = next(b for b in statement.matrices if b.name == matrix.name).span
        half = matrices[place]
        if matrix.backward is None and matrix.role == "moving" and not np.isnan(half).any():
            own = _parameter(declarations, matrix, half)
            limits = np.full(half.size, np.inf)
            starts.append(
                Start(
                    of=matrix,
                    parameter=own.name,
                    place=place,
                    value=half,
                    known=tuple(range(half.size)),
                    lower=-limits,
                    upper=limits,
                    margins=np.zeros((2, half.size)),
                )
            )
            declarations = declarations.adding(parameters=own)
            for one in {position, *followers} if position == estimated else {position}:
                declarations = _started(declarations, "matrices", one, own.symbol)
    return Restartable(declarations=declarations, starts=tuple(starts))


def _with_start(
    declarations: Declarations, position: int, place: slice, ends: tuple[Array, Array], starts: list[Start]
) -> Declarations:
    """The declarations with the known initial values of a state as a parameter; `ends`: its initial and final ones."""
    start, end = ends
    state, known = declarations.states[position], np.flatnonzero(~np.isnan(start)).tolist()
    if not known:
        return declarations
    own = _parameter(declarations, state, start[known])
    rows = [own.symbol[known.index(i)] if i in known else state.initial[i] for i in range(state.size)]
    starts.append(
        Start(
            of=state,
            parameter=own.name,
            place=place,
            value=start[known],
            known=tuple(known),
            lower=state.lower[known],
            upper=state.upper[known],
            margins=_margins(state, start, end, known),
        )
    )
    return _started(declarations.adding(parameters=own), "states", position, ca.vertcat(*rows))


def _margins(state: State, start: Array, end: Array, known: list[int]) -> Array:
    """By how much entries of a state may pass their bounds as a plan along one does, (2, entries).

    What is declared tells the size of what moves: the scale, how far from their bound the initial and final values are.
    Where that is nothing, and the bound zero, it is the size of these values and of their standard deviations.

    Args:
        state: its declaration.
        start: initial values, NaN where they are free.
        end: final values, likewise.
        known: the entries.
    """
    ends = np.abs(np.nan_to_num([start[known], end[known]])).max(axis=0)
    if state.chart is None and state.variance.is_constant():
        ends = np.maximum(ends, standard_deviations(np.asarray(ca.evalf(state.variance).full()))[known])
    scale = np.zeros(start.size) if state.scale is None else np.abs(np.broadcast_to(state.scale, start.shape))
    bounds = np.array([state.lower[known], state.upper[known]])
    away = np.nan_to_num(np.abs([start[known] - bounds, end[known] - bounds]), posinf=0.0).max(axis=0)
    told = np.stack([np.broadcast_to(scale[known], bounds.shape), away], axis=1)
    return passing(bounds[0], bounds[1], told, ends)


def _parameter(declarations: Declarations, entry: State | Matrix, value: Array) -> Parameter:
    """A new parameter for the initial value of a state or a matrix."""
    name, taken = f"initial_{entry.name}", {entry.name for entry in declarations.taken}
    while name in taken:
        name += "_"
    symbol = ca.MX.sym(name, value.size)
    return Parameter(name=name, symbol=symbol, size=value.size, where=entry.where, unit=entry.unit, value=value)


def _started(declarations: Declarations, group: str, position: int, initial: Expr) -> Declarations:
    """The declarations with another initial value of one entry of a group."""
    found = list(getattr(declarations, group))
    found[position] = replace(found[position], initial=initial)
    changed: dict[str, Any] = {group: tuple(found)}
    return replace(declarations, **changed)


def declared_values(starts: tuple[Start, ...], statement: Statement, parameters: Array) -> dict[str, Array]:
    """Parameters for the initial values that are declared, for these values of what they may depend on.

    Args:
        starts: of a restartable problem.
        statement: of the problem before.
        parameters: of that statement.
    """
    states, _, matrices, _ = statement.boundary_values(parameters)
    values = ((start, states if isinstance(start.of, State) else matrices) for start in starts)
    return {start.parameter: found[start.place][list(start.known)] for start, found in values}


def values_of(starts: tuple[Start, ...], initial: Given, covariance: Given) -> dict[str, Array]:
    """Parameters for other initial values.

    Args:
        starts: of a restartable problem.
        initial: dict of state (symbol or name) to value, of its size; NaN for entries that are free. Or None.
        covariance: initial covariance of what is estimated, a matrix; or a dict of matrix to value; or None.

    Raises:
        ProblemError: an unknown name, a value that does not fit, is out of bounds or indefinite.
    """
    result = {}
    states = {start.of.name: start for start in starts if isinstance(start.of, State)}
    for key, value in _by_name(initial, "initial", "state", states).items():
        result[states[key].parameter] = _state_value(states[key], value)
    matrices = {start.of.name: start for start in starts if isinstance(start.of, Matrix)}
    if covariance is not None and not isinstance(covariance, Mapping):
        estimated = [name for name, start in matrices.items() if isinstance(start.of, Matrix) and start.of.estimation]
        if not estimated:
            raise ProblemError(
                "There is no covariance of estimation errors that could start elsewhere.",
                expected="a problem with estimation_covariance() or minimize_expected(), whose start is known",
                received="covariance=, and " + (", ".join(matrices) or "no matrix with a known start"),
                remedy="leave covariance= out, or give a dict of matrix to value",
            )
        covariance = {estimated[0]: covariance}
    for key, value in _by_name(covariance, "covariance", "matrix", matrices).items():
        result[matrices[key].parameter] = _matrix_value(matrices[key], value)
    return result


def _by_name(given: Given, argument: str, kind: str, starts: Mapping[str, Start]) -> dict[str, Any]:
    """What is given, by name.

    Raises:
        ProblemError: no dict, or an unknown name.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise ProblemError(
            f"The values of {argument}= are not given by name.",
            expected=f"a dict of {kind} (symbol or name) to value",
            received=repr(given)[:100],
            remedy=f"write {argument}={{'name': value}}",
        )
    known, result = tuple(start.of for start in starts.values()), dict[str, Any]()
    for key, value in given.items():
        name = find_name(getattr(key, "_stands_for", key), f"{argument}=", list(known), known)
        if name in result:
            raise ProblemError(
                f"{argument}= has two values of '{name}'.",
                expected="one value for each",
                received="one by its symbol and one by its name",
                remedy="leave one of them out",
            )
        result[name] = value
    return result


def _state_value(start: Start, value: Given) -> Array:
    """The entries of an initial state that are known.

    Raises:
        ProblemError: it does not fit.
    """
    name, size = start.of.name, start.of.size
    if isinstance(start.of, State) and start.of.chart is not None:
        numbers = np.asarray(ca.evalf(as_quaternion(name, value, "initial attitude")).full()).ravel()
        return -numbers if numbers @ start.value < 0 else numbers  # of q and -q the one that the guess begins with
    numbers = np.atleast_1d(as_number(name, "initial value", value)).astype(float)
    if numbers.size != size or numbers.ndim > 2:
        raise _wrong(name, f"{size} numbers", f"shape {numbers.shape}")
    numbers = numbers.reshape(size)
    known = list(start.known)
    if np.isnan(numbers[known]).any() or np.isinf(numbers[known]).any():
        raise _wrong(name, f"finite numbers in the entries {known}", str(numbers))
    if len(known) < size and not np.isnan(np.delete(numbers, known)).all():
        raise _wrong(name, f"NaN in the entries that are free: all but {known}", str(numbers))
    found = onto_bounds(numbers[known], start.lower, start.upper, start.margins)
    if not ((found >= start.lower) & (found <= start.upper)).all():
        low, high, own = (_in_digits(values) for values in (start.lower, start.upper, numbers[known]))
        raise _wrong(name, f"numbers within the bounds {low} to {high} of the state", own)
    return found


def _in_digits(values: Array) -> str:
    """Numbers with all their digits: a value may be beyond its bound by little."""
    return "[" + ", ".join(map(digits, values)) + "]"


def _matrix_value(start: Start, value: Given) -> Array:
    """The half-vector of an initial matrix.

    Raises:
        ProblemError: it does not fit, is not symmetric, or is an indefinite covariance.
    """
    assert isinstance(start.of, Matrix)
    name, size = start.of.name, start.of.size
    numbers = as_number(name, "initial value", value).astype(float)
    numbers = numbers.reshape(1, 1) if numbers.size == 1 else numbers
    if numbers.shape != (size, size):
        rows = ", ".join(start.of.labels)
        raise _wrong(name, f"a symmetric {size} x {size} matrix, rows {rows}", f"shape {numbers.shape}")
    if start.of.covariance:
        numbers = without_rounding(numbers, np.diagonal(unpack(start.value, size)))
        check_density(name, "initial value", numbers, definite=False)
    else:
        check_symmetric_numbers(name, "initial value", numbers)
    return pack(0.5 * (numbers + numbers.T))


def _wrong(name: str, expected: str, received: str) -> ProblemError:
    return ProblemError(
        f"The initial value of '{name}' does not fit.",
        expected=expected,
        received=received,
        remedy=f"correct what is given for '{name}'",
    )
