"""Statement -> NLP by multiple shooting, with the matrices eliminated or as half-vector states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from covocp.integrators import (
    full_interval,
    interval_symbols,
    joint_interval,
    nominal_interval,
    propagate_step,
    simpson_interval,
    step_matrix,
)
from covocp.matrices import Array
from covocp.mesh import Mesh
from covocp.nlp import NLP, Rows, Scales
from covocp.statement import Conditions, Statement
from covocp.trajectory import Trajectory

# Steps that a sequence of numbers takes at a time.
NUMERIC_RUN = 10


def transcribe(statement: Statement, mesh: Mesh, scales: Scales) -> NLP:
    """Build the NLP of a statement on a mesh.

    Args:
        statement: the problem.
        mesh: nodes, segments, formulation.
        scales: magnitudes in which the NLP works.

    Returns:
        The NLP; its functions are not yet differentiated.
    """
    variables = _Variables(statement, mesh, scales)
    nodes = _shoot(statement, mesh, variables)
    running = ca.sum2(nodes["cost"])
    last_x, last_e = nodes["x"][:, -1], nodes["e"][:, -1]
    terminal = statement.terminal(last_x, last_e, variables.duration, variables.parameters)
    rows = _constraints(statement, mesh, scales, variables, nodes)
    g = ca.vertcat(ca.MX(0, 1), *(entry.expression for entry in rows))
    p = ca.vertcat(variables.p)
    outputs = [nodes["x"], nodes["e"], variables.u, variables.duration, running, terminal, g]
    return NLP(
        statement=statement,
        mesh=mesh,
        scales=scales,
        w=variables.w,
        p=p,
        f=(running + terminal) / variables.cost_scale,
        g=g,
        rows=rows,
        jacobian=_split_jacobian(variables, rows, g),
        evaluate=ca.Function("evaluate", [variables.w, p], outputs),
    )


class _Variables:
    """The variables of the NLP, and their unscaled values as matrices with a column for each node."""

    def __init__(self, statement: Statement, mesh: Mesh, scales: Scales) -> None:
        nx, ne, nu, count, nodes = statement.nx, statement.ne, statement.nu, len(mesh.starts), mesh.control_nodes
        lengths = [nx * count, 0 if mesh.eliminated else ne * count, nu * nodes, int(statement.duration.free)]
        ends = np.cumsum([0, *lengths]).tolist()
        self.w = ca.MX.sym("w", ends[-1])
        x, e, u, duration = (self.w[i:j] for i, j in pairwise(ends))
        self.x = ca.reshape(x, nx, count) * ca.repmat(ca.DM(scales.x), 1, count)
        self.e: Any = None if mesh.eliminated else ca.reshape(e, ne, count) * ca.repmat(ca.DM(scales.e), 1, count)
        self.u = ca.reshape(u, nu, nodes) * ca.DM(np.broadcast_to(scales.u, (nodes, nu)).T)
        self.duration = duration * scales.duration if statement.duration.free else ca.MX(statement.duration.guess)
        self.p = ca.MX.sym("p", statement.np + 1)
        self.parameters, self.cost_scale = ca.vertsplit(self.p, [0, statement.np, statement.np + 1])


def repeat(column: Any, count: int) -> Any:
    """A column repeated; one without entries stays without."""
    return ca.repmat(column, 1, count) if column.shape[0] else ca.DM(0, count)


def control_ends(mesh: Mesh, u: Any) -> tuple[Any, Any]:
    """Controls at the starts and the ends of the intervals, a column each."""
    return (u[:, :-1], u[:, 1:]) if mesh.control == "linear" else (u, u)


def common_columns(mesh: Mesh, u: Any, duration: Any, parameters: Any) -> tuple[Any, ...]:
    """The common arguments of the interval functions, a column for each interval."""
    n = mesh.intervals
    start, end = control_ends(mesh, u)
    s, ds = ca.DM(mesh.nodes[:-1]).T, ca.DM(np.diff(mesh.nodes)).T
    return start, end, s, ds, ca.repmat(duration, 1, n), repeat(parameters, n)


def _shoot(statement: Statement, mesh: Mesh, variables: _Variables | SimpleNamespace) -> dict[str, Any]:
    """States and half-vectors at all nodes, gaps at the ends of the segments, running cost of each interval."""
    common = common_columns(mesh, variables.u, variables.duration, variables.parameters)
    if not mesh.eliminated or statement.coupled:
        start = ca.vertcat(variables.x, variables.e) if statement.matrices else variables.x
        advance = full_interval(statement, mesh.substeps, mesh.step, mesh.linear_solver)
    else:
        start, advance = variables.x, nominal_interval(statement, mesh.substeps)
    ends, fine, cost = _segments(mesh, advance, start, common)
    nodes = _node_values(mesh, start, ends)
    last = [i - 1 for i in mesh.starts[1:]]
    gaps = ends[:, last] - start[:, 1:]
    nx = statement.nx
    result = {"x": nodes[:nx, :], "gap_x": gaps[:nx, :], "gap_e": gaps[nx:, :], "cost": cost}
    if not statement.matrices:
        return result | {"e": ca.DM(0, mesh.intervals + 1)}
    if not mesh.eliminated or statement.coupled:
        return result | {"e": nodes[nx:, :]}
    e0 = None if variables.e is None else variables.e[:, 0]
    e, matrix_cost = matrices_along(statement, mesh, result["x"], fine, common, variables.parameters, e0)
    return result | {"e": e, "cost": cost + matrix_cost}


def refined_run(
    statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: Array
) -> tuple[Array, float, Array]:
    """Run the segments of a trajectory again with half the integration steps.

    The intervals are halved, not the substeps doubled: so the functions of the transcription serve again.

    Returns:
        Jumps at the ends of the segments (segments, nx, or nx + ne where the matrices are variables), running cost,
        half-vectors at the end (ne,).
    """
    starts, u = list(mesh.starts), trajectory.u
    nodes = np.insert(mesh.nodes, np.arange(1, mesh.intervals + 1), 0.5 * (mesh.nodes[1:] + mesh.nodes[:-1]))
    halved = replace(mesh, nodes=nodes, segments=tuple(2 * length for length in mesh.segments))
    if mesh.control == "linear":
        between = np.insert(u, np.arange(1, mesh.intervals + 1), 0.5 * (u[1:] + u[:-1]), axis=0)
    else:
        between = np.repeat(u, 2, axis=0)
    start = SimpleNamespace(
        x=ca.DM(trajectory.x[starts].T),
        e=ca.DM(trajectory.e[starts].T),
        u=ca.DM(between.T),
        duration=ca.DM(trajectory.duration),
        parameters=ca.DM(parameters),
    )
    values = _shoot(statement, halved, start)
    jumps = np.hstack([np.asarray(ca.DM(values[name]).full()).T for name in ("gap_x", "gap_e")])
    running, last = ca.DM(ca.sum2(values["cost"])), ca.DM(values["e"][:, -1])
    return jumps, float(running), np.asarray(last.full()).ravel()


def _segments(mesh: Mesh, advance: ca.Function, start: Any, common: tuple[Any, ...]) -> tuple[Any, Any, Any]:
    """Run all segments: values at the ends of the intervals, at the substeps, running costs; mapped by equal length."""
    ends: list[Any] = []
    fine: list[Any] = []
    costs: list[Any] = []
    first_segment = first_interval = 0
    for length in sorted(set(mesh.segments), reverse=True):
        count = mesh.segments.count(length)
        function = advance if length == 1 else advance.mapaccum("segment", length)
        function = function.map(count) if count > 1 else function
        span = slice(first_interval, first_interval + count * length)
        outputs = function(start[:, first_segment : first_segment + count], *(column[:, span] for column in common))
        for collected, value in zip((ends, fine, costs), outputs, strict=True):
            collected.append(value)
        first_segment, first_interval = first_segment + count, span.stop
    return ca.horzcat(*ends), ca.horzcat(*fine), ca.horzcat(*costs)


def _node_values(mesh: Mesh, start: Any, ends: Any) -> Any:
    """Values at all nodes: variables where segments start and at the end, computed ones between."""
    if len(mesh.segments) == mesh.intervals:
        return start  # each node starts a segment
    columns = []
    for j, (i, k) in enumerate(zip(mesh.starts[:-1], mesh.starts[1:], strict=True)):
        columns += [start[:, j], ends[:, i : k - 1]]
    return ca.horzcat(*columns, start[:, -1])


def matrices_along(
    statement: Statement,
    mesh: Mesh,
    x: Any,
    fine: Any,
    common: tuple[Any, ...],
    parameters: Any,
    e0: Any = None,
    kicks: Any = None,
) -> tuple[Any, Any]:
    """Propagate the matrices along a nominal: those that run backward from its end, the others from its start.

    Args:
        statement: an uncoupled problem with matrices.
        mesh: nodes, substeps, covariance step.
        x: states at the nodes, (nx, N + 1).
        fine: states at the ends of all substeps, (nx, N substeps).
        common: common arguments of the interval functions, a column for each interval.
        parameters: of the statement.
        e0: half-vectors at the start; None: the statement's.
        kicks: added to the half-vectors as they pass the nodes, (ne, N + 1): slopes by them are costates. None:
            nothing; only where some matrix runs backward.

    Returns:
        Half-vectors at the nodes (ne, N + 1), running cost of each interval (1, N) where it depends on the matrices.
    """
    n, m = mesh.intervals, mesh.substeps
    e0 = statement.boundary(parameters)[2] if e0 is None else e0
    starts = x[:, :n]
    if mesh.step == "rk4" and not statement.behind:
        ends, cost = _runge_kutta_along(statement, mesh, e0, starts, common)
        return ca.horzcat(e0, ends), cost if statement.running_uses_matrices else ca.DM.zeros(1, n)
    before = starts
    if m > 1:
        before = ca.vertcat(starts, ca.reshape(fine, statement.nx * m, n)[: statement.nx * (m - 1), :])
        before = ca.reshape(before, statement.nx, n * m)
    columns = (before, fine, *substep_columns(common, m, n))
    first = e0[statement.entries(statement.ahead)]
    passages = _forward(statement, mesh, first, columns, _of(kicks, statement, statement.ahead))
    if statement.matrix_end is not None:
        last = statement.matrix_end(x[:, -1], common[4][:, -1], parameters)
        other = _backward(statement, mesh, last, columns, _of(kicks, statement, statement.behind))
        entries = np.argsort(statement.entries(statement.ahead) + statement.entries(statement.behind)).tolist()
        passages = tuple(ca.vertcat(a, b)[entries, :] for a, b in zip(passages, other, strict=True))
    e, begins, halves = passages
    if not statement.running_uses_matrices:
        return e, ca.DM.zeros(1, n)
    return e, simpson_interval(statement, m).map(n)(starts, begins, fine, halves, *common)


def _of(kicks: Any, statement: Statement, positions: tuple[int, ...]) -> Any:
    """The rows of the kicks that belong to some of the matrices."""
    return None if kicks is None else kicks[statement.entries(positions), :]


def _forward(statement: Statement, mesh: Mesh, first: Any, columns: tuple[Any, ...], kicks: Any) -> tuple[Any, ...]:
    """The matrices that run forward: half-vectors at the nodes, at the starts of the intervals, after the substeps."""
    n, m = mesh.intervals, mesh.substeps
    later = None
    if kicks is not None:
        first, later = first + kicks[:, 0], kicks[:, 1:]
    arrived, passed = _sequence(statement, mesh, statement.ahead, first, columns, later)
    nodes = ca.horzcat(first, passed[:, m - 1 :: m])
    return nodes, nodes[:, :n], arrived


def _backward(statement: Statement, mesh: Mesh, last: Any, columns: tuple[Any, ...], kicks: Any) -> tuple[Any, ...]:
    """The same for the matrices that run backward: each step is the forward one of the interval turned round."""
    n, m = mesh.intervals, mesh.substeps
    before, after, start, end, s, ds, duration, parameters = columns
    order = list(range(n * m - 1, -1, -1))
    turned = tuple(column[:, order] for column in (after, before, end, start, s + ds, -ds, duration, parameters))
    if kicks is not None:
        last, kicks = last + kicks[:, n], kicks[:, list(range(n - 1, -1, -1))]
    arrived, passed = _sequence(statement, mesh, statement.behind, last, turned, kicks)
    points = ca.horzcat(passed[:, order], last)
    return points[:, ::m], arrived[:, order][:, ::m], points[:, 1:]


def _sequence(
    statement: Statement, mesh: Mesh, positions: tuple[int, ...], first: Any, columns: tuple[Any, ...], kicks: Any
) -> tuple[Any, Any]:
    """Half-vectors of some matrices after each substep, in the order of travel: before and after the kicks."""
    count = mesh.intervals * mesh.substeps
    if mesh.step == "rk4":
        step = _runge_kutta_step(statement, positions)
        matrices = [column for k, column in enumerate(columns) if k != 1]
    else:
        step = propagate_step(statement, positions, mesh.linear_solver)
        matrices = [step_matrix(statement, i, mesh.step, mesh.linear_solver).map(count)(*columns) for i in positions]
    if kicks is None:
        values = _accumulated(step, first, matrices, count)
        return values, values
    inputs = step.mx_in()
    kick = ca.MX.sym("kick", first.shape[0])
    arrived = step(*inputs)
    kicked = ca.Function("kicked", [*inputs, kick], [arrived + kick, arrived])
    at_nodes = ca.MX(first.shape[0], count)
    at_nodes[:, mesh.substeps - 1 :: mesh.substeps] = kicks
    passed, before = kicked.mapaccum("propagate", count)(first, *matrices, at_nodes)
    return before, passed


def _accumulated(step: ca.Function, first: Any, arguments: list[Any], count: int) -> Any:
    """What a step function gives in sequence; numbers in short runs, because a long one takes memory for all of it."""
    if not isinstance(arguments[0], ca.DM):
        return step.mapaccum("propagate", count)(first, *arguments)
    lengths = [min(NUMERIC_RUN, count - begin) for begin in range(0, count, NUMERIC_RUN)]
    runs = {length: step if length == 1 else step.mapaccum("propagate", length) for length in set(lengths)}
    parts = [ca.horzsplit(argument, NUMERIC_RUN * (argument.shape[1] // count)) for argument in arguments]
    value, passed = first, []
    for length, *columns in zip(lengths, *parts, strict=True):
        passed.append(runs[length](value, *columns))
        value = passed[-1][:, -1]
    return ca.horzcat(*passed)


def _runge_kutta_step(statement: Statement, positions: tuple[int, ...]) -> ca.Function:
    """(half-vectors of some matrices, state, *common of the substep) -> half-vectors after a classical step."""
    entries = statement.entries(positions)
    symbolic: Any = statement.symbolic
    own, x = symbolic.sym("e", len(entries)), symbolic.sym("x", statement.nx)
    rest = interval_symbols(statement, symbolic)
    e = symbolic.zeros(statement.ne)
    e[entries] = own
    end = joint_interval(statement, 1)(ca.vertcat(x, e), *rest)[0]
    return ca.Function("matrix_step", [own, x, *rest], [end[statement.nx :][entries]])


def single_shooting(statement: Statement, mesh: Mesh, u: Any, start: tuple[Any, ...]) -> tuple[Any, Any, Any]:
    """States and half-vectors at the nodes and running costs as functions of the controls and (x0, e0, T, p)."""
    x0, e0, duration, p = start
    common = common_columns(mesh, u, duration, p)
    if statement.coupled:
        interval = full_interval(statement, mesh.substeps, mesh.step)
        ends, _, cost = interval.mapaccum("run", mesh.intervals)(ca.vertcat(x0, e0), *common)
        nodes = ca.horzcat(ca.vertcat(x0, e0), ends)
        return nodes[: statement.nx, :], nodes[statement.nx :, :], cost
    ends, fine, cost = nominal_interval(statement, mesh.substeps).mapaccum("run", mesh.intervals)(x0, *common)
    x = ca.horzcat(x0, ends)
    if not statement.matrices:
        return x, ca.MX(0, mesh.intervals + 1), cost
    e, matrix_cost = matrices_along(statement, mesh, x, fine, common, p, e0)
    return x, e, cost + matrix_cost


def substep_columns(common: tuple[Any, ...], m: int, n: int) -> tuple[Any, ...]:
    """The common arguments for each substep, a column each."""
    if m == 1:
        return common
    start, end, s, ds, duration, parameters = common

    def interleave(columns: list[Any]) -> Any:
        return ca.reshape(ca.vertcat(*columns), columns[0].shape[0], n * m)

    at = [start + (j / m) * (end - start) for j in range(m + 1)]
    return (
        interleave(at[:m]),
        interleave(at[1:]),
        interleave([s + (j / m) * ds for j in range(m)]),
        interleave([ds / m] * m),
        interleave([duration] * m),
        interleave([parameters] * m),
    )


def _runge_kutta_along(
    statement: Statement, mesh: Mesh, e0: Any, starts: Any, common: tuple[Any, ...]
) -> tuple[Any, Any]:
    """The rk4 covariance step in sequence, restarted at the nominal of each node."""
    interval = joint_interval(statement, mesh.substeps)
    symbolic: Any = statement.symbolic
    x, e = symbolic.sym("x", statement.nx), symbolic.sym("e", statement.ne)
    rest = interval_symbols(statement, symbolic)
    end, _, cost = interval(ca.vertcat(x, e), *rest)
    step = ca.Function("matrix_step", [e, x, *rest], [end[statement.nx :], cost])
    return tuple(step.mapaccum("propagate", mesh.intervals)(e0, starts, *common))


def _constraints(
    statement: Statement, mesh: Mesh, scales: Scales, variables: _Variables, nodes: dict[str, Any]
) -> tuple[Rows, ...]:
    """All constraint rows; those that depend on eliminated matrices (dense rows) come last."""
    rows = [_gap_rows("gap_x", nodes["gap_x"], scales.x, statement.state_names)]
    if not mesh.eliminated and statement.matrices:
        rows.append(_gap_rows("gap_e", nodes["gap_e"], scales.e, statement.matrix_names))
        if statement.matrix_end is not None:
            rows.append(_backward_ends(statement, scales, variables, nodes))
    rows += _interior_bounds(statement, mesh, scales, nodes["x"])
    u = variables.u
    at_nodes = u if mesh.control == "linear" else ca.horzcat(u, u[:, -1]) if statement.nu else u
    n = mesh.intervals + 1
    if not statement.nu:
        at_nodes = ca.MX(0, n)
    time = variables.duration * ca.DM(mesh.nodes).T
    arguments = (nodes["x"], at_nodes, nodes["e"], time)
    places: Mapping[str, tuple[Conditions, list[int]]] = {
        "path": (statement.path, list(range(n))),
        "start": (statement.start, [0]),
        "end": (statement.end, [n - 1]),
    }
    for kind, (conditions, columns) in places.items():
        if conditions.size:
            k = len(columns)
            value = conditions.function.map(k)(
                *(v[:, columns] for v in arguments),
                ca.repmat(variables.duration, 1, k),
                repeat(variables.parameters, k),
            )
            rows.append(
                Rows(
                    kind=kind,
                    expression=ca.vec(value),
                    lower=np.tile(conditions.lower, k),
                    upper=np.tile(conditions.upper, k),
                    names=conditions.names,
                    scale=np.ones(k * conditions.size),
                    dense=conditions.uses_matrices and mesh.eliminated,
                )
            )
    if mesh.eliminated and statement.matrices:
        rows += _final_matrices(statement, scales, nodes["e"][:, -1])
    return tuple(sorted(rows, key=lambda entry: entry.dense))


def _backward_ends(statement: Statement, scales: Scales, variables: _Variables, nodes: dict[str, Any]) -> Rows:
    """The matrices that run backward, where they are variables, at the end."""
    assert statement.matrix_end is not None
    entries = statement.entries(statement.behind)
    value = statement.matrix_end(nodes["x"][:, -1], variables.duration, variables.parameters)
    scale = scales.e[entries]
    return Rows(
        kind="backward_ends",
        expression=(nodes["e"][entries, -1] - value) / ca.DM(scale),
        lower=np.zeros(len(entries)),
        upper=np.zeros(len(entries)),
        names=tuple(f"final value of {statement.matrix_names[i]}" for i in entries),
        scale=scale,
    )


def _gap_rows(kind: str, gaps: Any, scale: Array, names: tuple[str, ...]) -> Rows:
    """Continuity at the ends of the segments."""
    count = gaps.shape[1]
    return Rows(
        kind=kind,
        expression=ca.vec(gaps / ca.repmat(ca.DM(scale), 1, count)),
        lower=np.zeros(scale.size * count),
        upper=np.zeros(scale.size * count),
        names=tuple(f"continuity of {name}" for name in names),
        scale=np.tile(scale, count),
    )


def _interior_bounds(statement: Statement, mesh: Mesh, scales: Scales, x: Any) -> list[Rows]:
    """Bounds on states at the nodes inside the segments, where they are not variables."""
    lower, upper = statement.state_bounds
    bounded = np.flatnonzero(np.isfinite(lower) | np.isfinite(upper))
    inside = sorted(set(range(mesh.intervals + 1)) - set(mesh.starts))
    if not bounded.size or not inside:
        return []
    scale = scales.x[bounded]
    value = x[bounded.tolist(), inside] / ca.repmat(ca.DM(scale), 1, len(inside))
    return [
        Rows(
            kind="state_bounds",
            expression=ca.vec(value),
            lower=np.tile(lower[bounded] / scale, len(inside)),
            upper=np.tile(upper[bounded] / scale, len(inside)),
            names=tuple(f"bounds of {statement.state_names[i]}" for i in bounded),
            scale=np.tile(scale, len(inside)),
        )
    ]


def _final_matrices(statement: Statement, scales: Scales, last: Any) -> list[Rows]:
    """Terminal conditions on entries of eliminated matrices; their targets are set for each solve."""
    known = np.flatnonzero(~np.isnan(statement.boundary_values(statement.values)[3]))
    if not known.size:
        return []
    scale = scales.e[known]
    return [
        Rows(
            kind="final_matrices",
            expression=last[known.tolist()] / ca.DM(scale),
            lower=np.zeros(known.size),
            upper=np.zeros(known.size),
            names=tuple(f"final value of {statement.matrix_names[i]}" for i in known),
            scale=scale,
            dense=True,
        )
    ]


def _split_jacobian(variables: _Variables, rows: tuple[Rows, ...], g: Any) -> ca.Function | None:
    """Jacobian of g where it has dense rows: those by their own adjoint sweeps, the rest with its sparsity."""
    dense = [entry.expression for entry in rows if entry.dense]
    if not dense:
        return None
    sparse = ca.vertcat(*(entry.expression for entry in rows if not entry.dense))
    blocks = [ca.jacobian(sparse, variables.w), ca.jacobian(ca.vertcat(*dense), variables.w)]
    return ca.Function("nlp_jac_g", [variables.w, variables.p], [g, ca.vertcat(*blocks)], ["x", "p"], ["g", "jac_g_x"])
