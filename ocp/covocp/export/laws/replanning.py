"""A problem of which everything that a re-planning may change is a parameter: initial values, covariances, duration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ExportError
from covocp.base.expressions import Expr
from covocp.base.matrices import Array, pack, pack_symbolic, unpack
from covocp.base.short_repr import short_repr
from covocp.export.laws.law import QUATERNION, Port
from covocp.export.text.names import identifier
from covocp.problem.builder import Problem
from covocp.problem.decisions import matters
from covocp.problem.declarations import Declarations, Free, Parameter, State
from covocp.problem.expected_cost import derive, statement_of
from covocp.problem.matrices import Matrix
from covocp.problem.restart import Start, restartable
from covocp.statement.statement import Statement

# Shortest and longest duration of a plan, in units of that of the problem.
DURATIONS = (1e-3, 1e3)


@dataclass(frozen=True, kw_only=True, eq=False)
class Argument:
    """One argument of the solver: a parameter of the problem, or the duration.

    Attributes:
        port: as the caller sees it; a covariance is a whole matrix.
        parameter: name of the parameter; "" for the duration.
        value: default, in the shape of the port, flat row by row.
        deviation: how far it may be moved to try the solver, of the same shape.
        symmetric: whether the parameter is the half-vector of the matrix, not its columns one below the other.
        attitude: of the initial quaternion of an attitude, its rows among the initial states; None of all else.
        limits: bounds of a state, (2, rows), within which a solver is tried.
    """

    port: Port
    parameter: str
    value: Array
    deviation: Array
    symmetric: bool = False
    attitude: slice | None = None
    limits: Array | None = None

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Replannable:
    """A problem, twice, and the arguments of its solver.

    Attributes:
        statement: with initial values as parameters, the duration a variable where it is an argument.
        fixed: the same with the fixed duration: what a reference is solved for.
        entries: arguments of the solver.
        replaced: parameters that are no arguments, as nothing but the start depends on them, with their values.
        instead: arguments in their place, by the name of such a parameter.
    """

    statement: Statement
    fixed: Problem
    entries: tuple[Argument, ...]
    replaced: Mapping[str, Array]
    instead: Mapping[str, str]

    __repr__ = short_repr


def replannable(problem: Problem) -> Replannable:
    """The problem with parameters for all that may change between two plans.

    Fixed initial values of states become "initial_<state>", initial matrices "initial_<matrix>" (that of the estimation
    covariance too), a fixed duration "duration", unless another one would be another problem (`_movable`). Free initial
    values, a free duration and decisions are chosen anew by each plan. Parameters that only such a start depends on are
    no arguments: in C every argument is given, so the start is, and they would do nothing.
    """
    statement, own = problem.statement(), problem.declarations
    if own.sampled:
        raise ExportError(
            f"'{own.sampled[0].name}' is read at instants, which another plan would have elsewhere.",
            expected="continuous measurements, whose plan may begin at any time",
            received=", ".join(f"'{entry.name}'" for entry in own.sampled),
            remedy="export the controller or the trajectory; solve again in Python with the instants that are left",
        )
    taken = {"workspace", "guess", "variables", "cost", "time", "status", "infeasibility", "stationarity"}
    found = restartable(own, statement)
    entries = [_argument(start, taken, own.parameters) for start in found.starts]
    own = found.declarations
    instead = _instead(own, found.starts, [entry.port.name for entry in entries])
    replaced = {}
    for block in (*statement.of_kind("parameter"), *statement.of_kind("unknown")):
        rows, columns = statement.matrix_parameters.get(block.name, (block.size, 1))
        if block.name in instead:
            replaced[block.name] = statement.values[block.span]
            continue
        value = statement.values[block.span].reshape(rows, columns, order="F").ravel()
        about = "parameter" if block.kind == "parameter" else "mean of the unknown"
        about = f"{about} '{block.name}'" + (f", {rows} by {columns}, row by row" if columns > 1 else "")
        name = identifier(block.name, taken)
        port = Port(name=name, rows=rows, columns=columns, unit=block.unit, about=about)
        entries.append(Argument(port=port, parameter=block.name, value=value, deviation=0.02 * np.abs(value)))
    moving = own
    if statement.autonomous and _movable(own, read=problem.duration_read):
        T = float(own.duration)
        free = Free(T, DURATIONS[0] * T, DURATIONS[1] * T)
        moving = replace(own, free_duration=free, duration=ca.MX.sym("duration"))
        port = Port(name="duration", unit="s", about="from now to the end")
        entries.append(Argument(port=port, parameter="", value=np.array([T]), deviation=np.array([0.02 * T])))
    return Replannable(
        statement=statement_of(moving),
        fixed=Problem.of(own),
        entries=tuple(entries),
        replaced=replaced,
        instead=instead,
    )


def _instead(own: Declarations, starts: tuple[Start, ...], ports: list[str]) -> dict[str, str]:
    """Parameters that mattered for the start alone, which is an argument now, and the arguments in their place."""
    places = {
        entry.name: [port for start, port in zip(starts, ports, strict=True) if _follows(start, entry)]
        for entry in own.parameters
    }
    if not any(places.values()):
        return {}
    derived = own if own.expected is None else derive(own)
    values = [c.chance.expression for c in derived.constraints if c.chance is not None]
    rest = ca.veccat(*values, *(state.target for state in derived.states if state.target is not None))
    return {
        entry.name: ", ".join(places[entry.name])
        for entry in own.parameters
        if places[entry.name] and not matters(derived, entry.symbol) and not ca.depends_on(rest, entry.symbol)
    }


def _follows(start: Start, entry: Parameter) -> bool:
    """Whether an initial value was declared in terms of a parameter."""
    return start.of.initial is not None and ca.depends_on(ca.MX(start.of.initial), entry.symbol)


def _movable(problem: Declarations, *, read: bool) -> bool:
    """Whether a fixed duration of an autonomous problem may be another one, and all else stays what was declared.

    Not where a constraint or a measurement contains the time, where a condition holds at so many seconds, or where the
    number of the duration was read (`read`) and may be in the expressions.
    """
    expressions = [c.expression for c in problem.constraints]
    expressions += [value for m in problem.measurements for value in (m.expression, m.noise)]
    timed = any(ca.depends_on(expression, problem.time) for expression in expressions)
    held = any(c.instant is not None and not c.relative for c in problem.constraints)
    return problem.free_duration is None and not (timed or held or read)


def _argument(start: Start, taken: set[str], parameters: tuple[Parameter, ...]) -> Argument:
    """An initial value as an argument of the solver."""
    given = [f"'{entry.name}'" for entry in parameters if _follows(start, entry)]
    instead = f", in place of what {' and '.join(given)} would give" if given else ""
    entry, known = start.of, list(start.known)
    name = identifier(start.parameter, taken)
    if isinstance(entry, Matrix):
        value = unpack(start.value, entry.size)
        about = f"initial value of the matrix '{entry.name}', rows {', '.join(entry.labels)}{instead}"
        port = Port(name=name, rows=entry.size, columns=entry.size, unit=entry.unit, about=about)
        none = np.zeros(value.size)
        return Argument(port=port, parameter=start.parameter, value=value.ravel(), deviation=none, symmetric=True)
    if entry.chart is not None:
        about = f"initial attitude of '{entry.name}', {QUATERNION}{instead}"
        deviation = np.full(entry.size, max(0.05 * float(_deviations(entry).max()), 0.005))  # half the angle
        port = Port(name=name, rows=entry.size, about=about)
        return Argument(
            port=port, parameter=start.parameter, value=start.value, deviation=deviation, attitude=start.place
        )
    about = f"initial value of '{entry.name}'"
    about += "" if len(known) == entry.size else f", its entries {', '.join(map(str, known))}"
    about += instead
    deviation = np.maximum(0.1 * _deviations(entry)[known], 0.005 * np.abs(start.value))
    port = Port(name=name, rows=len(known), unit=entry.unit, about=about)
    limits = np.array([start.lower, start.upper])
    return Argument(port=port, parameter=start.parameter, value=start.value, deviation=deviation, limits=limits)


def _deviations(entry: State) -> Array:
    """Standard deviations of an initial value, of its tangent where it is no vector; zero where they are no numbers."""
    if not entry.variance.is_constant():
        return np.zeros(entry.size)
    return np.asarray(np.sqrt(np.maximum(np.diagonal(np.asarray(ca.evalf(entry.variance).full())), 0.0)))


def unit_quaternion(value: Expr, near: Expr) -> Any:
    """A quaternion of unit length; of q and -q, the same attitude, the one that is nearer to another quaternion."""
    return ca.if_else(ca.dot(value, near) < 0, -value, value) / ca.norm_2(value)


def stacked(made: Replannable, values: dict[str, Any], names: tuple[str, ...]) -> list[Any]:
    """The parameters of a statement from the arguments, in the order of their names, as it has matrices."""
    by_parameter, replaced = {entry.parameter: entry for entry in made.entries}, made.replaced
    result = []
    for name in names:
        if name in replaced:
            result.append(replaced[name])
            continue
        entry = by_parameter[name]
        value = values[entry.port.name]
        rows, columns = entry.port.rows, entry.port.columns
        if entry.symmetric:
            value = _half(value, rows)
        elif columns > 1:
            turned = np.arange(rows * columns).reshape(rows, columns).ravel(order="F")
            value = value[turned.tolist()]
        result.append(value)
    return result


def _half(column: Expr, size: int) -> Any:
    """Half-vector of a flat symmetric matrix, numbers or an expression; its symmetric part."""
    if isinstance(column, np.ndarray):
        return pack(column.reshape(size, size))
    return pack_symbolic(ca.reshape(column, size, size))
