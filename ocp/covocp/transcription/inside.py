"""The trajectory inside control intervals whose ends are known."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.linear_solve import LINEAR_SOLVER
from covocp.base.matrices import Array
from covocp.passage.columns import numbers_in_columns, numbers_in_turn
from covocp.passage.sweep import from_many
from covocp.statement.interval import Interval
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT, StepKind, gauss_entries
from covocp.transcription.mesh import Mesh
from covocp.transcription.numbers import by_themselves, columns_of_parts, turned
from covocp.transcription.sequences import NUMERIC_ENTRIES, at_columns
from covocp.transcription.shooting import interval_columns
from covocp.transcription.steps import (
    full_interval,
    gathering_step,
    in_order,
    matrices_step,
    nominal_interval,
)


def inside_intervals(
    statement: Statement, mesh: Mesh, nodes: Array, u: Array, duration: float, parameters: Array, count: int
) -> Array:
    """Each interval integrated again from its node; what runs backward from its later node.

    Args:
        statement: the problem.
        mesh: of it.
        nodes: x and e stacked at the nodes, (N + 1, nx + ne).
        u: control values, (N + 1 or N, nu).
        duration: terminal time [s].
        parameters: of the statement.
        count: substeps.

    Returns:
        x and e stacked at the starts of the substeps and at the end, (N, count + 1, nx + ne).

    Raises:
        RuntimeError: a step cannot be solved.
    """
    st, n = statement, mesh.intervals
    if not st.matrices or not by_themselves(st, mesh):
        common = interval_columns(mesh, ca.DM(u.T), duration, ca.DM(parameters))
        function = Matrices(inside_interval(st, count, mesh.step).map(n))
        (inside,) = function.evaluated(nodes[:-1].T, nodes[1:].T, *common)
        return np.ascontiguousarray(inside.T).reshape(n, count + 1, nodes.shape[1])
    result = np.empty((n, count + 1, nodes.shape[1]))
    result[:, 0], result[:, -1] = nodes[:-1], nodes[1:]
    given = u.T, duration, parameters
    columns = columns_of_parts(mesh, count, *given)
    result[:, 1:, : st.nx] = _states(st, mesh, nodes[:-1, : st.nx], given, columns)
    most = max(NUMERIC_ENTRIES // (8 * st.ne * count), 1)  # H of all steps takes memory
    for first in range(0, n, most):
        span = slice(first, min(first + most, n))
        own = slice(span.start * count, span.stop * count)
        _pass_matrices(st, mesh, result[span], [column[:, own] for column in columns])
    return result


def _states(
    statement: Statement, mesh: Mesh, starts: Array, given: tuple[Array, float, Array], columns: list[Array]
) -> Array:
    """The nominal at the ends of the substeps, (N, count, nx), by the steps of the mesh where these divide them."""
    n, x = mesh.intervals, starts.T
    count = columns[0].shape[1] // n
    own = mesh.substeps if count % mesh.substeps == 0 else count
    if mesh.step != "rodas":
        found = numbers_in_turn(statement, nominal_interval(statement, 1, mesh.step), x, columns, count)
        if found is not None:
            return found[0].T.reshape(n, count, statement.nx)
    advance, values = Matrices(nominal_interval(statement, own, mesh.step).map(n)), []
    common, parts = interval_columns(mesh, *(ca.DM(value) for value in given)), count // own
    for j in range(parts):
        x, fine, _ = advance.evaluated(x, *common.part(j / parts, (j + 1) / parts))
        values.append(fine.T.reshape(n, own, statement.nx))
    return np.concatenate(values, axis=1)


def _pass_matrices(statement: Statement, mesh: Mesh, values: Array, columns: list[Array]) -> None:
    """Write the matrices inside some intervals beside the states, (N, count + 1, nx + ne), by the compiled passage."""
    st, (n, points, _), nx = statement, values.shape, statement.nx
    count = points - 1
    steps = [values[:, at, :nx].reshape(n * count, nx).T for at in (slice(count), slice(1, None))] + columns
    order = np.arange(n * count).reshape(n, count)[:, ::-1].ravel()
    for positions, backward in ((st.ahead, False), (st.behind, True)):
        along = turned(steps, order) if backward and positions else steps
        for i in positions:
            block = st.matrices[i]
            own = slice(nx + block.span.start, nx + block.span.stop)
            function, pattern = gauss_entries(st, i, mesh.step)
            h = numbers_in_columns(st, function, along)
            if h is None:
                h = Matrices(at_columns(st, mesh, function, n * count)).evaluated(*along)
            after = from_many(values[:, -1 if backward else 0, own], [v.T for v in h], block.size, pattern, count)
            if backward:
                values[:, :-1, own] = after[:, ::-1]
            else:
                values[:, 1:, own] = after


@lru_cache(maxsize=KEPT)
def inside_interval(statement: Statement, count: int, step: StepKind, solver: str = LINEAR_SOLVER) -> ca.Function:
    """The trajectory inside an interval whose ends are known: what runs forward from its start, S from its end.

    Returns:
        (x and e stacked at the start, at the end, *interval) -> the stack at the start and at the ends of `count`
        substeps, (nx + ne, count + 1).
    """
    nx, size = statement.nx, statement.nx + statement.ne
    before, after = ca.MX.sym("before", size), ca.MX.sym("after", size)
    interval = Interval.symbols(statement, ca.MX)
    if not statement.behind:
        _, fine, _ = full_interval(statement, count, step, solver)(before, *interval)
        return ca.Function("inside", [before, after, *interval], [ca.horzcat(before, fine)])
    x = ca.horzcat(before[:nx], nominal_interval(statement, count, step)(before[:nx], *interval)[1])
    ahead, behind = statement.entries(statement.ahead), statement.entries(statement.behind)
    first, last = [before[nx:][ahead]], [after[nx:][behind]]
    gathered = [before[nx:][statement.entries(statement.summed), :]]
    forward, backward = (matrices_step(statement, which, step, solver) for which in (statement.ahead, statement.behind))
    parts = [interval.part(j / count, (j + 1) / count) for j in range(count)]
    for j in range(count):
        first.append(forward(first[-1], x[:, j], x[:, j + 1], *parts[j]))
        if statement.summed:
            gather = gathering_step(statement, step, solver)
            gathered.append(gathered[-1] + gather(*first[-2:], x[:, j], x[:, j + 1], *parts[j]))
    for j in range(count - 1, -1, -1):
        last.append(backward(last[-1], x[:, j + 1], x[:, j], *parts[j].turned()))
    rows = [ca.horzcat(*first), ca.horzcat(*last[::-1])]
    if statement.summed:
        rows.append(ca.horzcat(*gathered))
    e = in_order(statement, *rows)
    return ca.Function("inside", [before, after, *interval], [ca.vertcat(x, e)])
