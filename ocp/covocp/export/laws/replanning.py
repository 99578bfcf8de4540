"""A problem of which everything that a re-planning may change is a parameter: initial values, covariances, duration."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array, half_length, pack, unpack
from covocp.base.short_repr import short_repr
from covocp.export.laws.law import Port
from covocp.export.text.names import identifier
from covocp.problem.builder import Problem
from covocp.problem.declarations import Free, Matrix, Parameter, State
from covocp.problem.estimation_covariance import augmented_names

# Shortest and longest duration of a plan, in units of that of the problem.
DURATIONS = (1e-3, 1e3)


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry:
    """One argument of the solver: a parameter of the problem, or the duration.

    Attributes:
        port: as the caller sees it; a covariance is a whole matrix.
        parameter: name of the parameter; "" for the duration.
        value: default, in the shape of the port, flat.
        deviation: how far it may be moved to try the solver, of the same shape.
    """

    port: Port
    parameter: str
    value: Array
    deviation: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Replannable:
    """A problem, twice, and the arguments of its solver.

    Attributes:
        problem: with initial values as parameters, the duration a variable where it is an argument.
        fixed: the same with the fixed duration: what a reference is solved for.
        entries: arguments of the solver.
    """

    problem: Problem
    fixed: Problem
    entries: tuple[Entry, ...]

    __repr__ = short_repr


def replannable(problem: Problem) -> Replannable:
    """The problem with parameters for all that may change between two plans.

    Fixed initial values of states become "initial_<state>", initial matrices "initial_<matrix>" (that of the estimation
    covariance too), a fixed duration "duration", unless something depends on the time explicitly. Free initial values
    and a free duration stay free.
    """
    own = _copied(problem)
    statement = problem.statement()
    start, _, matrices, _ = statement.boundary_values(statement.values)
    taken = {"workspace", "guess", "variables", "cost", "time", "status", "infeasibility", "stationarity"}
    entries: list[Entry] = []
    _estimated(own)
    for position, state in enumerate(problem.states):
        block = next(b for b in statement.states if b.name == state.name)
        own.states[position] = _with_start(own, state, start[block.span], taken, entries)
    for position, matrix in enumerate(own.matrices):
        block = next(b for b in statement.matrices if b.name == matrix.name)
        if matrix.backward is None and not np.isnan(matrices[block.span]).any():
            own.matrices[position] = _with_matrix(own, matrix, matrices[block.span], taken, entries)
    for block in (*statement.of_kind("parameter"), *statement.of_kind("unknown")):
        value = statement.values[block.span]
        about = "parameter" if block.kind == "parameter" else "mean of the unknown"
        port = Port(
            name=identifier(block.name, taken), rows=block.size, unit=block.unit, about=f"{about} '{block.name}'"
        )
        entries.append(Entry(port=port, parameter=block.name, value=value, deviation=0.02 * np.abs(value)))
    moving = copy.copy(own)
    if problem.free_duration is None and statement.autonomous and not _timed(problem):
        T = float(problem.duration)
        moving.free_duration = Free(T, DURATIONS[0] * T, DURATIONS[1] * T)
        moving._duration = ca.MX.sym("duration")
        port = Port(name="duration", unit="s", about="from now to the end")
        entries.append(Entry(port=port, parameter="", value=np.array([T]), deviation=np.array([0.02 * T])))
    return Replannable(problem=moving, fixed=own, entries=tuple(entries))


def _copied(problem: Problem) -> Problem:
    """The same declarations and symbols, in lists of its own."""
    result = copy.copy(problem)
    result.states, result.matrices = list(problem.states), list(problem.matrices)
    result.parameters = list(problem.parameters)
    result._frozen = None
    return result


def _estimated(problem: Problem) -> None:
    """Where an expected cost implies the estimation covariance, declare it, so that its start can be a parameter."""
    if problem.expected is not None and not any(matrix.estimation for matrix in problem.matrices):
        problem.estimation_covariance()


def _timed(problem: Problem) -> bool:
    """Whether a constraint or a measurement contains the time."""
    expressions = [c.expression for c in problem.constraints]
    expressions += [value for m in problem.measurements for value in (m.expression, m.noise)]
    return any(ca.depends_on(expression, problem.time) for expression in expressions)


def _parameter(problem: Problem, name: str, value: Array, unit: str, taken: set[str]) -> tuple[str, Any]:
    """A new parameter: its name and its symbol."""
    declared: list[Any] = [*problem.states, *problem.unknowns, *problem.parameters, *problem.controls]
    symbols = {entry.name for entry in declared}
    unique = identifier(name, taken | symbols)
    taken.add(unique)
    symbol = ca.MX.sym(unique, value.size)
    problem.parameters.append(
        Parameter(name=unique, symbol=symbol, size=value.size, where="the export", unit=unit, value=value)
    )
    return unique, symbol


def _with_start(problem: Problem, state: State, start: Array, taken: set[str], entries: list[Entry]) -> State:
    """A state whose known initial values are parameters."""
    known = np.flatnonzero(~np.isnan(start))
    if not known.size:
        return state
    name, symbol = _parameter(problem, f"initial_{state.name}", start[known], state.unit, taken)
    rows = [symbol[known.tolist().index(i)] if i in known else ca.MX(np.nan) for i in range(state.size)]
    about = f"initial value of '{state.name}'"
    about += "" if known.size == state.size else f", its entries {', '.join(map(str, known.tolist()))}"
    deviation = np.full(known.size, 0.0)
    if state.variance.is_constant():
        deviation = 0.1 * np.sqrt(np.maximum(np.diagonal(np.asarray(ca.evalf(state.variance).full())), 0.0))[known]
    deviation = np.maximum(deviation, 0.005 * np.abs(start[known]))
    port = Port(name=name, rows=known.size, unit=state.unit, about=about)
    entries.append(Entry(port=port, parameter=name, value=start[known], deviation=deviation))
    return replace(state, initial=ca.vertcat(*rows))


def _with_matrix(problem: Problem, matrix: Matrix, half: Array, taken: set[str], entries: list[Entry]) -> Matrix:
    """A matrix whose initial value is a parameter."""
    name, symbol = _parameter(problem, f"initial_{matrix.name}", half, matrix.unit, taken)
    labels = augmented_names([*problem.states, *problem.unknowns]) if matrix.estimation else matrix.labels
    value = unpack(half, matrix.size)
    about = f"initial value of the matrix '{matrix.name}', rows {', '.join(labels)}"
    port = Port(name=name, rows=matrix.size, columns=matrix.size, unit=matrix.unit, about=about)
    entries.append(Entry(port=port, parameter=name, value=value.ravel(), deviation=np.zeros(value.size)))
    return replace(matrix, initial=symbol)


def stacked(entries: tuple[Entry, ...], values: dict[str, Any], names: tuple[str, ...]) -> list[Any]:
    """The parameters of a statement from the arguments, in the order of their names; matrices as half-vectors."""
    by_parameter = {entry.parameter: entry for entry in entries}
    result = []
    for name in names:
        entry = by_parameter[name]
        value = values[entry.port.name]
        if entry.port.columns > 1:
            value = _half(value, entry.port.rows)
        result.append(value)
    return result


def _half(column: Any, size: int) -> Any:
    """Half-vector of a flat symmetric matrix, numbers or an expression; its symmetric part."""
    if isinstance(column, np.ndarray):
        return pack(column.reshape(size, size))
    rows, columns = np.triu_indices(size)
    lower, upper = (columns * size + rows).tolist(), (rows * size + columns).tolist()
    assert len(lower) == half_length(size)
    return 0.5 * (column[lower] + column[upper])
