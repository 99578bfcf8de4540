"""Multiple shooting: states, matrices and costs of all intervals, the matrices along the nominal or with it.

Matrices along the nominal pass it in sequence: by CasADi's operations, or, where slopes of first order are enough, by
the compiled passage.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.expressions import Expr, beside, sequence_of
from covocp.base.linear_solve import LINEAR_SOLVER
from covocp.passage.columns import in_turn, numbers_in_turn
from covocp.passage.library import functions
from covocp.passage.sweep import passed_by, values_by
from covocp.statement.interval import Interval
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.sequences import Passage, in_sequence
from covocp.transcription.steps import (
    full_interval,
    gathering_step,
    in_order,
    joint_interval,
    nominal_interval,
    simpson_interval,
    taken_by_parts,
)

# Meshes of which columns are kept.
MESHES = 16


def repeat(column: Expr, count: int) -> Any:
    """A column repeated; one without entries stays without."""
    return ca.repmat(column, 1, count) if column.shape[0] else ca.DM(0, count)


def control_ends(mesh: Mesh, u: Expr) -> tuple[Any, Any]:
    """Controls at the starts and the ends of the intervals, a column each."""
    u = mesh.acting(u)
    return (u[:, :-1], u[:, 1:]) if mesh.control == "linear" else (u, u)


def interval_columns(mesh: Mesh, u: Expr, duration: Expr, parameters: Expr) -> Interval:
    """The intervals of a mesh, a column for each."""
    n = mesh.intervals
    start, end = control_ends(mesh, u)
    s, ds, reading = _of_mesh(mesh)
    return Interval(start, end, s, ds, ca.repmat(duration, 1, n), repeat(parameters, n), reading)


@lru_cache(maxsize=MESHES)
def _of_mesh(mesh: Mesh) -> tuple[ca.DM, ca.DM, ca.DM]:
    """Starts and lengths of the intervals of a mesh, and what they read, a column each."""
    reading = ca.DM(mesh.readings) if mesh.readings.size else ca.DM(0, mesh.intervals)
    return ca.DM(mesh.nodes[None, :-1]), ca.DM(np.diff(mesh.nodes)[None]), reading


def shoot(
    statement: Statement,
    mesh: Mesh,
    variables: Expr,
    *,
    passage: Passage = None,
    run: tuple[Any, Any, Any] | None = None,
    intervals: Interval | None = None,
) -> dict[str, Any]:
    """States and half-vectors at all nodes, gaps at the ends of the segments, running cost of each interval.

    Args:
        statement: the problem.
        mesh: of it.
        variables: of the NLP.
        passage: of eliminated matrices.
        run: what all segments give, where it is known: values at the ends of the intervals and of the substeps, running
            cost of the intervals, a column each.
        intervals: `interval_columns` of the variables, where they are known.
    """
    if intervals is None:
        intervals = interval_columns(mesh, variables.u, variables.duration, variables.parameters)
    together = statement.matrices and (not mesh.eliminated or statement.coupled)
    start = ca.vertcat(variables.x, variables.e) if together else variables.x
    ends, fine, cost = _segments(statement, mesh, start, intervals) if run is None else run
    nodes = _node_values(mesh, start, ends)
    last = [i - 1 for i in mesh.starts[1:]]
    gaps = ends[:, last] - start[:, 1:]
    nx = statement.nx
    result: dict[str, Any] = {"x": nodes[:nx, :], "gap_x": gaps[:nx, :], "gap_e": gaps[nx:, :], "cost": cost}
    result["run"] = ends, fine, cost
    inside = _inside(mesh)
    if inside:
        result |= {"x_inside": fine[:nx, inside], "e_inside": fine[nx:, inside]}
    if not statement.matrices:
        return result | {"e": ca.DM(0, mesh.intervals + 1)}
    if not mesh.eliminated or statement.coupled:
        return result | {"e": nodes[nx:, :]}
    e0 = None if variables.e is None else variables.e[:, 0]
    given = (result["x"], fine, intervals, variables.parameters, e0)
    at_nodes, halves, matrix_cost = passages(statement, mesh, *given, passage=passage, inside=bool(inside))
    if inside:
        result["e_inside"] = halves[:, inside]
    return result | {"e": at_nodes, "cost": cost + matrix_cost}


def advancing(statement: Statement, mesh: Mesh) -> ca.Function:
    """What moves along an interval of a mesh: the nominal alone where the matrices are eliminated, else both."""
    if mesh.eliminated and not statement.coupled:
        return nominal_interval(statement, mesh.substeps, mesh.step)
    return full_interval(statement, mesh.substeps, mesh.step, mesh.linear_solver)


def nominal_run(
    statement: Statement, mesh: Mesh, variables: Expr, intervals: Interval, *, compiled: bool = False
) -> tuple[Any, Any, Any]:
    """What `run` of `shoot` is where the nominal runs alone; `compiled`: in the library, where CasADi sees no steps."""
    return _segments(statement, mesh, variables.x, intervals, compiled=compiled, alone=True)


def _inside(mesh: Mesh) -> list[int]:
    """Substeps at whose ends, inside the intervals, limits are imposed."""
    n, m, stride = mesh.intervals, mesh.substeps, mesh.substeps // mesh.points
    return [k * m + j * stride - 1 for k in range(n) for j in range(1, mesh.points)]


def _segments(
    statement: Statement, mesh: Mesh, start: Expr, intervals: Interval, *, compiled: bool = False, alone: bool = False
) -> tuple[Any, Any, Any]:
    """Run all segments: values at the ends of the intervals, at the substeps, running costs; mapped by equal length.

    `alone`: of the nominal, whatever is beside it; `compiled`: as of `nominal_run`.
    """
    ends: list[Any] = []
    fine: list[Any] = []
    costs: list[Any] = []
    first_segment = first_interval = 0
    alike = len(set(mesh.segments)) == 1
    for length in sorted(set(mesh.segments), reverse=True):
        count = mesh.segments.count(length)
        span = slice(first_interval, first_interval + count * length)
        given = [start[:, first_segment : first_segment + count], *(intervals if alike else intervals.columns(span))]
        outputs = _in_sequence(statement, mesh, given, (length, count), compiled=compiled, alone=alone)
        for collected, value in zip((ends, fine, costs), outputs, strict=True):
            collected.append(value)
        first_segment, first_interval = first_segment + count, span.stop
    return beside(ends), beside(fine), beside(costs)


def _in_sequence(
    statement: Statement, mesh: Mesh, given: list[Any], size: tuple[int, int], *, compiled: bool, alone: bool
) -> list[Any]:
    """So many segments of so many intervals each, in the library where they are numbers or that is asked for."""
    length, count = size
    numbers = all(isinstance(value, ca.DM) for value in given)
    alone = alone or (mesh.eliminated and not statement.coupled)
    if alone and (numbers or compiled) and mesh.substeps > 1 and mesh.step != "rodas":
        return _in_substeps(statement, mesh, given, size, numbers=numbers)
    advance = nominal_interval(statement, mesh.substeps, mesh.step) if alone else advancing(statement, mesh)
    found = _numbers(statement, advance, given, length) if numbers else None
    if found is not None:
        return found
    if compiled:
        return in_turn(statement, advance, length, count).call(given)
    function = sequence_of(advance, length)
    return (function.map(count) if count > 1 else function).call(given)


def _in_substeps(
    statement: Statement, mesh: Mesh, given: list[Any], size: tuple[int, int], *, numbers: bool
) -> list[Any]:
    """The same of the nominal step by step: one function for all numbers of substeps."""
    (length, count), m = size, mesh.substeps
    one = nominal_interval(statement, 1, mesh.step)
    stepwise = [given[0], *Interval(*given[1:]).substeps(m)]
    found = _numbers(statement, one, stepwise, length * m) if numbers else None
    after, _, costs = in_turn(statement, one, length * m, count).call(stepwise) if found is None else found
    return [after[:, m - 1 :: m], after, ca.sum1(ca.reshape(ca.densify(costs), m, length * count))]


def _numbers(statement: Statement, advance: ca.Function, given: list[Any], steps: int) -> list[Any] | None:
    """What the library makes of numbers, None where it cannot."""
    first, *columns = (value.full() for value in given)
    found = numbers_in_turn(statement, advance, first, columns, steps)
    return None if found is None else [ca.DM(values) for values in found]


def _node_values(mesh: Mesh, start: Expr, ends: Expr) -> Any:
    """Values at all nodes: variables where segments start and at the end, computed ones between."""
    if len(mesh.segments) == mesh.intervals:
        return start  # each node starts a segment
    places = np.arange(mesh.intervals + 1) + len(mesh.segments)  # of the ends of the intervals, behind the starts
    places[list(mesh.starts)] = np.arange(len(mesh.starts))
    either: Expr = ca.horzcat(start, ends)
    return either[:, places.tolist()]


def matrices_along(
    statement: Statement,
    mesh: Mesh,
    x: Expr,
    fine: Expr,
    intervals: Interval,
    parameters: Expr,
    e0: Expr = None,
    kicks: Expr = None,
    *,
    passage: Passage = None,
) -> tuple[Any, Any]:
    """Propagate the matrices along a nominal: those that run backward from its end, the others from its start.

    Args:
        statement: an uncoupled problem with matrices.
        mesh: nodes, substeps, covariance step.
        x: states at the nodes, (nx, N + 1).
        fine: states at the ends of all substeps, (nx, N substeps).
        intervals: the intervals, a column for each.
        parameters: of the statement.
        e0: half-vectors at the start; None: the statement's.
        kicks: added to the half-vectors as they pass the nodes, (ne, N + 1): slopes by them are costates. None:
            nothing; only where some matrix runs backward.
        passage: how they pass.

    Returns:
        Half-vectors at the nodes (ne, N + 1), running cost of each interval (1, N) where it depends on the matrices.
    """
    e, _, cost = passages(statement, mesh, x, fine, intervals, parameters, e0, kicks, passage=passage)
    return e, cost


def passages(
    statement: Statement,
    mesh: Mesh,
    x: Expr,
    fine: Expr,
    intervals: Interval,
    parameters: Expr,
    e0: Expr = None,
    kicks: Expr = None,
    *,
    passage: Passage = None,
    inside: bool = False,
) -> tuple[Any, Any, Any]:
    """What `matrices_along` returns, and between it the half-vectors at the ends of all substeps (ne, N substeps).

    Unless they are wanted inside the intervals these may be those at the ends of the intervals alone, (ne, N).
    """
    n = mesh.intervals
    e0 = statement.started(x[:, 0], parameters)[1] if e0 is None else e0
    starts = x[:, :n]
    if mesh.step == "rk4" and not statement.behind:
        ends, halves, cost = _runge_kutta_along(statement, mesh, e0, starts, intervals)
        return ca.horzcat(e0, ends), halves, cost if statement.running_uses_matrices else ca.DM.zeros(1, n)
    columns = _substeps(statement, mesh, x, fine, intervals)
    own = None if passage in (passed_by, values_by) and not compiled_steps(mesh) else passage
    everywhere = inside or statement.running_uses_matrices or bool(statement.summed)
    sequence = partial(in_sequence, statement, mesh, own, every=1 if everywhere else mesh.substeps)
    first = e0[statement.entries(statement.ahead)]
    groups = [_forward(statement, mesh, sequence, first, columns, _of(kicks, statement, statement.ahead))]
    if statement.matrix_end is not None:
        last = statement.matrix_end(x[:, -1], intervals.duration[:, -1], parameters)
        groups.append(_backward(statement, mesh, sequence, last, columns, _of(kicks, statement, statement.behind)))
    if statement.summed:
        first = e0[statement.entries(statement.summed)]
        groups.append(_gathered(statement, mesh, first, columns, groups[0], _of(kicks, statement, statement.summed)))
    e, halves = (in_order(statement, *(group[k] for group in groups)) for k in (0, 2))
    if not statement.running_uses_matrices:
        return e, halves, ca.DM.zeros(1, n)
    begins = in_order(statement, *(group[1] for group in groups))
    return e, halves, _matrix_cost(statement, mesh, (starts, begins, fine, halves, *intervals))


def _substeps(statement: Statement, mesh: Mesh, x: Expr, fine: Expr, intervals: Interval) -> tuple[Any, ...]:
    """States before and after each substep, and the substeps, a column each."""
    n, m = mesh.intervals, mesh.substeps
    before = x[:, :n]
    if m > 1:
        inside: Expr = ca.reshape(fine, statement.nx * m, n)
        before = ca.reshape(ca.vertcat(before, inside[: statement.nx * (m - 1), :]), statement.nx, n * m)
    return (before, fine, *intervals.substeps(m))


def backward_at_start(statement: Statement, mesh: Mesh, variables: Expr) -> Any:
    """Half-vectors at the start of the matrices that run backward, where they are no variables; as `shoot` has them."""
    intervals = interval_columns(mesh, variables.u, variables.duration, variables.parameters)
    ends, fine, _ = _segments(statement, mesh, variables.x, intervals, alone=True)
    columns = _substeps(statement, mesh, _node_values(mesh, variables.x, ends), fine, intervals)
    assert statement.matrix_end is not None
    last = statement.matrix_end(variables.x[:, -1], variables.duration, variables.parameters)
    sequence = partial(in_sequence, statement, mesh, None, every=mesh.substeps)
    return _backward(statement, mesh, sequence, last, columns, None)[0][:, 0]


def _matrix_cost(statement: Statement, mesh: Mesh, columns: tuple[Any, ...]) -> Any:
    """Running cost of each interval where it depends on the matrices; of a closed loop by parts but near the end."""
    n, m = mesh.intervals, mesh.substeps
    parted = parted_intervals(statement, mesh)
    widths = (1, 1, m, m) + (1,) * (len(columns) - 4)
    order, costs = [], []
    for by_parts in (True, False):
        span = np.flatnonzero(parted == by_parts)
        if span.size:
            function = simpson_interval(statement, m, by_parts).map(span.size)
            places = [(span[:, None] * w + np.arange(w)).ravel().tolist() for w in widths]
            costs.append(function(*(c[:, at] for c, at in zip(columns, places, strict=True))))
            order += span.tolist()
    found: Any = ca.horzcat(*costs)
    return found if order == list(range(n)) else found[:, np.argsort(order).tolist()]


def parted_intervals(statement: Statement, mesh: Mesh) -> NDArray[np.bool_]:
    """Whether the cost of a closed loop is taken by parts, of each interval."""
    if not statement.behind:
        return np.zeros(mesh.intervals, dtype=bool)
    taken = taken_by_parts(statement, ca.DM(mesh.nodes[:-1]), ca.DM(np.diff(mesh.nodes)))
    return np.asarray(taken.full()).ravel() > 0


def _of(kicks: Expr, statement: Statement, positions: tuple[int, ...]) -> Any:
    """The rows of the kicks that belong to some of the matrices."""
    return None if kicks is None else kicks[statement.entries(positions), :]


def _forward(
    statement: Statement,
    mesh: Mesh,
    sequence: Callable[..., tuple[Any, Any]],
    first: Expr,
    columns: tuple[Any, ...],
    kicks: Expr,
) -> tuple[Any, ...]:
    """The matrices that run forward: half-vectors at the nodes, at the starts of the intervals, after the substeps.

    After the intervals alone where the sequence gives no more.
    """
    n = mesh.intervals
    later = None
    if kicks is not None:
        first, later = first + kicks[:, 0], kicks[:, 1:]
    arrived, passed = sequence(statement.ahead, first, columns, later)
    each = passed.shape[1] // n
    nodes = ca.horzcat(first, passed if each == 1 else passed[:, each - 1 :: each])
    wanted = statement.running_uses_matrices or statement.summed  # numbers would take memory
    return nodes, nodes[:, :n] if wanted else None, arrived


def _gathered(
    statement: Statement, mesh: Mesh, first: Expr, columns: tuple[Any, ...], ahead: tuple[Any, ...], kicks: Expr
) -> tuple[Any, ...]:
    """The same for integrals of what depends on the matrices that run forward: sums of what each substep adds."""
    n, m = mesh.intervals, mesh.substeps
    starts, after = ahead[1], ahead[2]
    before: Any = starts
    if m > 1:
        inside: Expr = ca.reshape(after, after.shape[0] * m, n)
        before = ca.vertcat(starts, inside[: after.shape[0] * (m - 1), :])
        before = ca.reshape(before, after.shape[0], n * m)
    step = gathering_step(statement, mesh.step, mesh.linear_solver).map(n * m)
    later: Any = ca.cumsum(ca.densify(step(before, after, *columns)), 1)
    begin: Any = ca.repmat(first, 1, n)
    if kicks is not None:
        passed: Any = ca.cumsum(ca.densify(kicks), 1)
        begin = begin + passed[:, :n]
        first = first + kicks[:, 0]
    spread: Any = ca.kron(begin, ca.DM.ones(1, m))
    arrived = later + spread
    nodes: Any = arrived[:, m - 1 :: m]
    if kicks is not None:
        nodes = nodes + kicks[:, 1:]
    nodes = ca.horzcat(first, nodes)
    return nodes, nodes[:, :n], arrived


def _backward(
    statement: Statement,
    mesh: Mesh,
    sequence: Callable[..., tuple[Any, Any]],
    last: Expr,
    columns: tuple[Any, ...],
    kicks: Expr,
) -> tuple[Any, ...]:
    """The same for the matrices that run backward: each step is the forward one of the interval turned round."""
    n, m = mesh.intervals, mesh.substeps
    before, after, *rest = columns
    order = list(range(n * m - 1, -1, -1))
    turned = tuple(column[:, order] for column in (after, before, *Interval(*rest).turned()))
    if kicks is not None:
        last, kicks = last + kicks[:, n], kicks[:, list(range(n - 1, -1, -1))]
    arrived, passed = sequence(statement.behind, last, turned, kicks)
    each = passed.shape[1] // n
    order = list(range(n * each - 1, -1, -1))
    points = ca.horzcat(passed[:, order], last)
    return points[:, ::each], arrived[:, order][:, ::each], points[:, 1:]


def compiled_steps(mesh: Mesh) -> bool:
    """Whether the compiled passage has the steps of a mesh: those of Gauss, where CasADi writes nothing out as C."""
    return mesh.step in ("gauss", "rodas") and mesh.linear_solver == LINEAR_SOLVER and functions() is not None


def single_shooting(statement: Statement, mesh: Mesh, u: Expr, start: tuple[Any, ...]) -> tuple[Any, Any, Any]:
    """States and half-vectors at the nodes and running costs as functions of the controls and (x0, e0, T, p)."""
    x0, e0, duration, p = start
    intervals = interval_columns(mesh, u, duration, p)
    if statement.coupled:
        interval = full_interval(statement, mesh.substeps, mesh.step)
        ends, _, cost = sequence_of(interval, mesh.intervals)(ca.vertcat(x0, e0), *intervals)
        nodes = ca.horzcat(ca.vertcat(x0, e0), ends)
        return nodes[: statement.nx, :], nodes[statement.nx :, :], cost
    nominal = nominal_interval(statement, mesh.substeps, mesh.step)
    ends, fine, cost = sequence_of(nominal, mesh.intervals)(x0, *intervals)
    x = ca.horzcat(x0, ends)
    if not statement.matrices:
        return x, ca.MX(0, mesh.intervals + 1), cost
    e, matrix_cost = matrices_along(statement, mesh, x, fine, intervals, p, e0, passage=passed_by)
    return x, e, cost + matrix_cost


def _runge_kutta_along(
    statement: Statement, mesh: Mesh, e0: Expr, starts: Expr, intervals: Interval
) -> tuple[Any, ...]:
    """The rk4 covariance step in sequence, restarted at the nominal of each node: at the ends, the substeps, cost."""
    interval = joint_interval(statement, mesh.substeps)
    symbolic: Any = statement.symbolic
    x, e = symbolic.sym("x", statement.nx), symbolic.sym("e", statement.ne)
    rest = Interval.symbols(statement)
    end, inner, cost = interval(ca.vertcat(x, e), *rest)
    step = ca.Function("matrix_step", [e, x, *rest], [end[statement.nx :], inner[statement.nx :, :], cost])
    return tuple(step.mapaccum("propagate", mesh.intervals)(e0, starts, *intervals))
