"""A problem of which everything that a re-planning may change is a parameter: initial values, covariances, duration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import ExportError
from covocp.base.expressions import Expr
from covocp.base.matrices import Array, pack, pack_symbolic, unpack
from covocp.base.short_repr import short_repr
from covocp.export.laws.law import Port
from covocp.export.text.names import identifier
from covocp.problem.builder import Problem
from covocp.problem.declarations import Declarations, Free, Parameter
from covocp.problem.estimation_covariance import with_estimation
from covocp.problem.expected_cost import statement_of
from covocp.statement.statement import Statement

# Shortest and longest duration of a plan, in units of that of the problem.
DURATIONS = (1e-3, 1e3)


@dataclass(frozen=True, kw_only=True, eq=False)
class Argument:
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
        statement: with initial values as parameters, the duration a variable where it is an argument.
        fixed: the same with the fixed duration: what a reference is solved for.
        entries: arguments of the solver.
    """

    statement: Statement
    fixed: Problem
    entries: tuple[Argument, ...]

    __repr__ = short_repr


def replannable(problem: Problem) -> Replannable:
    """The problem with parameters for all that may change between two plans.

    Fixed initial values of states become "initial_<state>", initial matrices "initial_<matrix>" (that of the estimation
    covariance too), a fixed duration "duration", unless something depends on the time explicitly. Free initial values,
    a free duration and decisions are chosen anew by each plan.
    """
    statement, own = problem.statement(), problem.declarations
    if own.sampled:
        raise ExportError(
            f"'{own.sampled[0].name}' is read at instants, which another plan would have elsewhere.",
            expected="continuous measurements, whose plan may begin at any time",
            received=", ".join(f"'{entry.name}'" for entry in own.sampled),
            remedy="export the controller or the trajectory; solve again in Python with the instants that are left",
        )
    start, _, matrices, _ = statement.boundary_values(statement.values)
    taken = {"workspace", "guess", "variables", "cost", "time", "status", "infeasibility", "stationarity"}
    entries: list[Argument] = []
    if own.expected is not None and not any(matrix.estimation for matrix in own.matrices):
        own = with_estimation(own)  # so that its start can be a parameter
    for position, state in enumerate(own.states):
        if state.role != "moving":
            continue
        block = next(b for b in statement.states if b.name == state.name)
        own = _with_start(own, position, start[block.span], taken, entries)
    for position, matrix in enumerate(own.matrices):
        block = next(b for b in statement.matrices if b.name == matrix.name)
        if matrix.backward is None and matrix.role == "moving" and not np.isnan(matrices[block.span]).any():
            own = _with_matrix(own, position, matrices[block.span], taken, entries)
    for block in (*statement.of_kind("parameter"), *statement.of_kind("unknown")):
        value = statement.values[block.span]
        about = "parameter" if block.kind == "parameter" else "mean of the unknown"
        port = Port(
            name=identifier(block.name, taken), rows=block.size, unit=block.unit, about=f"{about} '{block.name}'"
        )
        entries.append(Argument(port=port, parameter=block.name, value=value, deviation=0.02 * np.abs(value)))
    moving = own
    if own.free_duration is None and statement.autonomous and not _timed(own):
        T = float(own.duration)
        free = Free(T, DURATIONS[0] * T, DURATIONS[1] * T)
        moving = replace(own, free_duration=free, duration=ca.MX.sym("duration"))
        port = Port(name="duration", unit="s", about="from now to the end")
        entries.append(Argument(port=port, parameter="", value=np.array([T]), deviation=np.array([0.02 * T])))
    return Replannable(statement=statement_of(moving), fixed=Problem.of(own), entries=tuple(entries))


def _timed(problem: Declarations) -> bool:
    """Whether a constraint or a measurement contains the time."""
    expressions = [c.expression for c in problem.constraints]
    expressions += [value for m in problem.measurements for value in (m.expression, m.noise)]
    return any(ca.depends_on(expression, problem.time) for expression in expressions)


def _parameter(problem: Declarations, name: str, value: Array, unit: str, taken: set[str]) -> Parameter:
    """A new parameter."""
    declared: list[Any] = [*problem.states, *problem.unknowns, *problem.parameters, *problem.controls]
    unique = identifier(name, taken | {entry.name for entry in declared})
    taken.add(unique)
    symbol = ca.MX.sym(unique, value.size)
    return Parameter(name=unique, symbol=symbol, size=value.size, where="the export", unit=unit, value=value)


def _with_start(
    problem: Declarations, position: int, start: Array, taken: set[str], entries: list[Argument]
) -> Declarations:
    """The declarations with the known initial values of a state as a parameter."""
    state, known = problem.states[position], np.flatnonzero(~np.isnan(start))
    if not known.size:
        return problem
    own = _parameter(problem, f"initial_{state.name}", start[known], state.unit, taken)
    name, symbol = own.name, own.symbol
    rows = [symbol[known.tolist().index(i)] if i in known else state.initial[i] for i in range(state.size)]
    about = f"initial value of '{state.name}'"
    about += "" if known.size == state.size else f", its entries {', '.join(map(str, known.tolist()))}"
    deviation = np.full(known.size, 0.0)
    if state.variance.is_constant():
        deviation = 0.1 * np.sqrt(np.maximum(np.diagonal(np.asarray(ca.evalf(state.variance).full())), 0.0))[known]
    deviation = np.maximum(deviation, 0.005 * np.abs(start[known]))
    port = Port(name=name, rows=known.size, unit=state.unit, about=about)
    entries.append(Argument(port=port, parameter=name, value=start[known], deviation=deviation))
    return _started(problem.adding(parameters=own), "states", position, ca.vertcat(*rows))


def _started(problem: Declarations, group: str, position: int, initial: Expr) -> Declarations:
    """The declarations with another initial value of one entry of a group."""
    found = list(getattr(problem, group))
    found[position] = replace(found[position], initial=initial)
    changed: dict[str, Any] = {group: tuple(found)}
    return replace(problem, **changed)


def _with_matrix(
    problem: Declarations, position: int, half: Array, taken: set[str], entries: list[Argument]
) -> Declarations:
    """The declarations with the initial value of a matrix as a parameter."""
    matrix = problem.matrices[position]
    own = _parameter(problem, f"initial_{matrix.name}", half, matrix.unit, taken)
    name, labels = own.name, matrix.labels
    value = unpack(half, matrix.size)
    about = f"initial value of the matrix '{matrix.name}', rows {', '.join(labels)}"
    port = Port(name=name, rows=matrix.size, columns=matrix.size, unit=matrix.unit, about=about)
    entries.append(Argument(port=port, parameter=name, value=value.ravel(), deviation=np.zeros(value.size)))
    return _started(problem.adding(parameters=own), "matrices", position, own.symbol)


def stacked(entries: tuple[Argument, ...], values: dict[str, Any], names: tuple[str, ...]) -> list[Any]:
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


def _half(column: Expr, size: int) -> Any:
    """Half-vector of a flat symmetric matrix, numbers or an expression; its symmetric part."""
    if isinstance(column, np.ndarray):
        return pack(column.reshape(size, size))
    return pack_symbolic(ca.reshape(column, size, size))
