"""Costates in two independent ways.

By the adjoint of the discrete steps, with the multipliers of the NLP as terminal values (`discrete_costates`), and by
integrating the continuous adjoint equations p' = -H_x, P' = -H_E backward (`integrated_costates`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices, swept
from covocp.base.expressions import Expr, slopes_by
from covocp.base.matrices import Array, read_only
from covocp.base.quadrature import classical_step, hermite
from covocp.extremal.along_nodes import along_nodes
from covocp.extremal.costates_in_numbers import costates_in_numbers
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import fine_trajectory, prolongation, refined
from covocp.extremal.forms import has_forms
from covocp.extremal.hamiltonian import Costates, state_slope
from covocp.extremal.inside import instant_jumps
from covocp.passage.columns import in_columns
from covocp.passage.sweep import passed_by
from covocp.statement.interval import Interval, model_symbols
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT, StepKind
from covocp.transcription.mesh import Mesh
from covocp.transcription.nlp import terminal_slopes
from covocp.transcription.shooting import interval_columns, matrices_along
from covocp.transcription.steps import full_interval, nominal_interval

# Operations of the slopes of H up to which the four of a Runge-Kutta step are written out in scalars.
WRITTEN_OUT = 2000


def terminal_costates(extremal: Extremal) -> tuple[Array, Array]:
    """p(T) = k_x + l and the costate of the half-vectors at T, with all multipliers that act there."""
    multipliers = extremal.multipliers
    slopes = terminal_slopes(
        extremal.statement,
        extremal.trajectory,
        extremal.parameters,
        multipliers.end,
        multipliers.path[-1],
    )
    return slopes[0] + multipliers.final, slopes[1] + multipliers.final_matrices


def impulses(extremal: Extremal) -> Array:
    """Jumps of the costates at the nodes, (N + 1, nx + ne), by the multipliers of what acts there.

    That are path constraints, bounds, and conditions at instants: costates at a node are those before them. The row of
    the last node is zero: what acts there is part of the terminal costates.
    """
    statement, multipliers = extremal.statement, extremal.multipliers
    jumps = np.hstack([multipliers.states, multipliers.matrices]) + instant_jumps(extremal)
    if statement.path.size:
        symbolic: Any = statement.symbolic
        symbols = model_symbols(statement)
        weights = symbolic.sym("mu", statement.path.size)
        value = ca.dot(weights, statement.path.function(*symbols))
        slope = ca.vertcat(*slopes_by(value, (symbols[0], symbols[2])))
        function = ca.Function("jumps", [*symbols, weights], [slope])
        count = extremal.mesh.intervals + 1
        jumps = jumps + np.asarray(function.map(count)(*extremal.columns(), multipliers.path.T).full()).T
    jumps[-1] = 0.0
    return np.asarray(jumps)


@lru_cache(maxsize=KEPT)
def adjoint_interval(statement: Statement, substeps: int, step: StepKind, *, nominal: bool = False) -> ca.Function:
    """Adjoint of one discrete control interval; with `nominal` of the nominal alone, without cost.

    Returns:
        (costates at the end, which of them to keep (1 or 0), values in place of the others, impulse at the start,
        x and e stacked, *common) -> costates at the start, slopes of the Lagrangian by the control at the start, by
        that at the end, by T.
    """
    interval = nominal_interval(statement, substeps, step) if nominal else full_interval(statement, substeps, step)
    symbolic: Any = statement.symbolic if interval.is_a("SXFunction") else ca.MX
    size = interval.size1_in(0)
    after, keep, known, impulse, z = (symbolic.sym(name, size) for name in ("after", "keep", "known", "impulse", "z"))
    common = Interval.symbols(statement, symbolic)
    end, _, cost = interval(z, *common)
    value = ca.dot(keep * after + known, end) + (0 if nominal else cost)
    by = (z, common.start, common.end, *([common.duration] if statement.duration.free else []))
    slopes = slopes_by(value, by) + [ca.DM(0)] * (4 - len(by))
    return ca.Function("adjoint", [after, keep, known, impulse, z, *common], [slopes[0] + impulse, *slopes[1:]])


@lru_cache(maxsize=4)
def discrete_costates(extremal: Extremal) -> tuple[Costates, Array, float]:
    """Costates of the discretised problem, by the adjoint sweep from the multipliers at the end; remembered.

    Where the problem was shot in segments, each is swept from the multipliers of the continuity at its end: a nominal
    that is unstable would amplify the error of those at the end of all.

    Returns:
        Costates at the nodes; the slope of the Lagrangian by each control value (N + 1 or N, nu), without the
        multipliers of control bounds; its slope by T through the intervals. All of it read-only.
    """
    costates, slopes, by_duration = _discrete(extremal)
    slopes.setflags(write=False)
    return read_only(costates), slopes, by_duration


def _discrete(extremal: Extremal) -> tuple[Costates, Array, float]:
    """The same, to be written to."""
    st, points = extremal.statement, extremal.mesh.points
    if points > 1:  # limits act between the nodes: swept on the mesh that has them as nodes
        fine, slopes, by_duration = discrete_costates(refined(extremal))
        at_nodes = Costates(state=fine.state[::points], matrices=fine.matrices[::points])
        return at_nodes, prolongation(extremal.mesh).T @ slopes, by_duration
    mesh = extremal.mesh
    apart = bool(st.matrices) and mesh.eliminated and not st.coupled and mesh.step != "rk4"
    alone = not st.matrices and along_nodes(st, mesh, extremal.trajectory, extremal.parameters) is not None
    if st.behind or apart or alone:
        return _costates_of_passages(extremal)
    last = np.concatenate(terminal_costates(extremal))
    z = np.hstack([extremal.trajectory.x, extremal.trajectory.e])
    costates, slopes, by_duration = _swept(extremal, last, impulses(extremal), z)
    return Costates(state=costates[:, : st.nx], matrices=costates[:, st.nx :]), slopes, by_duration


def _swept(
    extremal: Extremal, last: Array, jumps: Array, z: Array, *, nominal: bool = False
) -> tuple[Array, Array, float]:
    """The adjoint of one interval swept from the end: costates at the nodes, slopes by the control values and by T."""
    st, mesh = extremal.statement, extremal.mesh
    n, size = mesh.intervals, last.size
    adjoint = adjoint_interval(st, mesh.substeps, mesh.step, nominal=nominal)
    keep, known = (values[:size] for values in _restarts(extremal))
    stacked = (keep, known, jumps[:-1].T, z[:n].T, *extremal.interval_arrays)
    if not keep[:, :-1].any():  # each interval has its own multipliers
        outputs = Matrices(adjoint.map(n)).evaluated(np.tile(last[:, None], n), *stacked)
        values, by_start, by_end, by_duration = (v.T for v in outputs)
    else:
        swept_back = swept(adjoint, last, *(column[:, ::-1] for column in stacked))
        values, by_start, by_end, by_duration = (v[::-1] for v in swept_back)
    slopes = np.zeros((mesh.control_nodes, st.nu))
    slopes[:n] += by_start
    slopes[int(mesh.control == "linear") :][:n] += by_end
    return np.vstack([values, last]), mesh.gathered(slopes), float(by_duration.sum())


def _costates_of_passages(extremal: Extremal) -> tuple[Costates, Array, float]:
    """The same where matrices pass along the nominal: the costate of one that runs backward runs forward.

    It begins with zero, or with what is before a link.

    The costates of the matrices are the slopes of the Lagrangian by kicks at the nodes, had in one reverse sweep over
    both passages; what they say of the nominal enters its own adjoint as impulses at the nodes.
    """
    st, t = extremal.statement, extremal.trajectory
    nx = st.nx
    jumps = impulses(extremal)
    last_x, last_e = terminal_costates(extremal)
    behind = st.entries(st.behind)
    direct = last_e[behind] - extremal.multipliers.final_matrices[behind]
    weights = jumps[:, nx:].copy()
    weights[-1] = last_e
    weights[-1, behind] = direct
    along = along_nodes(st, extremal.mesh, t, extremal.parameters)
    if along is not None:
        keep, known = (values[:nx] for values in _restarts(extremal))
        costates, slopes, total, kicks = along.costates(weights, last_x, jumps[:, :nx], (keep, known))
    else:
        by_x, by_u, by_duration, kicks = _through_passages(extremal, weights)
        last_x, by_x[-1] = last_x + by_x[-1], 0.0  # x(T) also acts through the matrices that start there
        costates, slopes, total = _swept(extremal, last_x, jumps[:, :nx] + by_x, t.x, nominal=True)
        slopes, total = slopes + by_u, total + float(by_duration.item())
    kicks[-1, behind] -= direct
    kicks[:, behind] *= -1.0
    return Costates(state=costates, matrices=kicks), slopes, total


def without_passage(extremal: Extremal) -> Extremal:
    """The extremal whose multipliers `final` are l of p(T) = k_x + l + (slope through the matrices that start at T).

    A transcription that eliminates these matrices sees l and the slope as one.
    """
    st, m = extremal.statement, extremal.multipliers
    if st.matrix_end is None or not st.matrix_end.jac_sparsity(0, 0).nnz():
        return extremal
    fine = refined(extremal)
    weights = impulses(fine)[:, st.nx :]
    weights[-1] = terminal_costates(fine)[1]
    behind = st.entries(st.behind)
    weights[-1, behind] -= m.final_matrices[behind]
    through = _through_passages(fine, weights)[0][-1]
    return replace(extremal, multipliers=replace(m, final=m.final - through))


def _through_passages(extremal: Extremal, weights: Array) -> tuple[Array, ...]:
    """What `passage_slopes` gives along an extremal for weights of the half-vectors (N + 1, ne), the node first."""
    t = extremal.trajectory
    given = (t.x.T, t.u.T, t.duration, extremal.parameters, t.e[0], weights.T, np.zeros_like(weights.T))
    return tuple(v.T for v in passage_slopes(extremal.statement, extremal.mesh).evaluated(*given))


def passage_end(extremal: Extremal, given: Array) -> tuple[Array, float, Array]:
    """Slopes by x(T), by T and by the parameters through the matrices that start at T, nu' S(T), nu = k_S - P_S.

    Args:
        extremal: the solution.
        given: costates P_S of these matrices at T.
    """
    st, t = extremal.statement, extremal.trajectory
    if st.matrix_end is None:
        return np.zeros(st.nx), 0.0, np.zeros(st.np)
    behind = st.entries(st.behind)
    nu = terminal_costates(extremal)[1][behind] - extremal.multipliers.final_matrices[behind] - given
    symbols = [ca.MX.sym("x", st.nx), ca.MX.sym("T"), ca.MX.sym("p", st.np)]
    value = ca.dot(ca.DM(nu), st.matrix_end(*symbols))
    function = ca.Function("passage_end", symbols, slopes_by(value, symbols))
    by_x, by_duration, by_p = function(t.x[-1], t.duration, extremal.parameters)
    return np.asarray(by_x.full()).ravel(), float(by_duration), np.asarray(by_p.full()).ravel()


@lru_cache(maxsize=KEPT)
def passage_slopes(statement: Statement, mesh: Mesh) -> Matrices:
    """Slopes of cost and weighted half-vectors along given nodes of the nominal.

    Returns:
        (states at the nodes, controls, T, parameters, half-vectors at the start, weights of the half-vectors at the
        nodes, kicks there) -> slopes of int L dt + weights . half-vectors by the states at the nodes, the controls, T,
        and by the kicks. These are zero: they stand for what the slopes are taken by.
    """
    n = mesh.intervals
    x, u = ca.MX.sym("x", statement.nx, n + 1), ca.MX.sym("u", statement.nu, mesh.control_nodes)
    duration, p = ca.MX.sym("T"), ca.MX.sym("p", statement.np)
    e0, kicks = ca.MX.sym("e0", statement.ne), ca.MX.sym("kicks", statement.ne, n + 1)
    weights = ca.MX.sym("weights", statement.ne, n + 1)
    common = interval_columns(mesh, u, duration, p)
    advance = in_columns(statement, nominal_interval(statement, mesh.substeps, mesh.step), n)
    _, states, cost = advance(x[:, :-1], *common)
    e, matrix_cost = matrices_along(statement, mesh, x, states, common, p, e0, kicks, passage=passed_by)
    value = ca.sum2(cost + matrix_cost) + ca.dot(weights, e)
    slopes = slopes_by(value, (x, u, duration, kicks))
    return Matrices(ca.Function("passage_slopes", [x, u, duration, p, e0, weights, kicks], slopes))


def backward_pair(statement: Statement, *, cost: bool = True, matrices: bool = True) -> ca.Function:
    """Classical Runge-Kutta step of the adjoint equations p' = -H_x, P' = -H_E backward over a pair of substeps.

    The costates of matrices that run backward are not integrated here, they run forward: they are given.

    Args:
        statement: the problem.
        cost: False for an influence function, R' = -f_x' R: the adjoint of the rates alone.
        matrices: False where the costates of the half-vectors are zero.

    Returns:
        (costates at the end, stacked x and e at start, middle and end, given costates there, *common of the pair) ->
        costates at the start.
    """
    nx, size, behind = statement.nx, statement.nx + statement.ne, _behind(statement)
    slope = state_slope(statement, cost=cost, matrices=matrices)
    written_out = slope.is_a("SXFunction") and slope.n_instructions() <= WRITTEN_OUT
    symbolic: Any = ca.SX if written_out else ca.MX
    after = symbolic.sym("after", size)
    points = [symbolic.sym(name, size) for name in ("z0", "zm", "z1")]
    given = [symbolic.sym(name, len(behind)) for name in ("k0", "km", "k1")]
    pair = Interval.symbols(statement, symbolic)

    def rate(costate: Expr, c: float) -> Expr:
        z, full = points[round(2 * (1 - c))], _with(costate, behind, given[round(2 * (1 - c))])
        return slope(*pair.at(1 - c, z[:nx], z[nx:]), full[:nx], full[nx:])

    before = classical_step(rate, after, pair.h)
    if statement.samples is not None and matrices:
        before = ca.densify(reading_slopes(statement, pair, points[0], before, cost=cost)[0])
    return ca.Function("backward", [after, *points, *given, *pair], [_with(before, behind, given[0])])


def reading_slopes(
    statement: Statement, part: Interval, z: Expr, costate: Expr, *, cost: bool = True
) -> tuple[Any, ...]:
    """Costates before what a part of an interval reads, from those after it; slopes there by its controls and by T.

    Args:
        statement: with measurements at instants.
        part: symbols of it.
        z: x and e stacked before it.
        costate: of both after it.
        cost: whether what it adds to the running cost counts.
    """
    assert statement.samples is not None
    nx = statement.nx
    symbolic: Any = type(z)
    point = symbolic.sym("z", nx + statement.ne)
    control, duration, time = symbolic.sym("u", statement.nu), symbolic.sym("T"), symbolic.sym("t")
    later = symbolic.sym("later", nx + statement.ne)
    reading, p = symbolic.sym("reading", statement.readings), symbolic.sym("p", statement.np)
    inputs = [point, control, time, duration, p, reading, later]
    after, added = statement.samples.update(point[:nx], control, point[nx:], time, duration, p, reading)
    value = ca.dot(later[nx:], after) + ca.dot(later[:nx], point[:nx]) + (added if cost else 0)
    function = ca.Function("reading_slopes", inputs, slopes_by(value, (point, control, time, duration)))
    by_z, by_u, by_t, by_duration = function(
        z, part.start, part.time(0.0), part.duration, part.parameters, part.reading, costate
    )
    return by_z, by_u, part.place(0.0) * by_t + by_duration


def _behind(statement: Statement) -> list[int]:
    """Entries of z = (x, e) that run backward."""
    return [statement.nx + k for k in statement.entries(statement.behind)]


def _with(column: Expr, entries: list[int], values: Expr) -> Any:
    """A column with some entries replaced."""
    if not entries:
        return column
    result = type(column)(column)
    result[entries] = values
    return result


@lru_cache(maxsize=KEPT)
def forward_costates(statement: Statement, pairs: int) -> ca.Function:
    """Costates of the matrices that run backward, forward over the pairs of substeps of one control interval.

    P' = -H_S does not depend on the other costates. Between the ends of a pair they are cubic.

    Returns:
        (their costates at the start, x and e stacked at the starts, middles and ends of the pairs (size, 2 pairs + 1),
        *common) -> at the end, at the starts, middles and ends of the pairs.
    """
    nx, behind = statement.nx, _behind(statement)
    start, z = ca.MX.sym("start", len(behind)), ca.MX.sym("z", nx + statement.ne, 2 * pairs + 1)
    interval = Interval.symbols(statement, ca.MX)
    slope = state_slope(statement)
    value, points = start, [start]

    def rate(pair: int, costate: Expr, c: float) -> Expr:
        full, point = _with(ca.MX.zeros(nx + statement.ne), behind, costate), round(2 * (pair + c))
        place = interval.at(point / (2 * pairs), z[:nx, point], z[nx:, point])
        return -slope(*place, full[:nx], full[nx:])[behind]

    h, slope_there = interval.h / pairs, rate(0, start, 0.0)
    for j in range(pairs):
        after = classical_step(partial(rate, j), value, h, slope_there)
        if statement.samples is not None:
            part, still = interval.part(j / pairs, (j + 1) / pairs), ca.MX.zeros(nx + statement.ne)
            after = after - reading_slopes(statement, part, z[:, 2 * j], still)[0][behind]
        before, slope_there = slope_there, rate(j, after, 1.0)
        points += [hermite(value, after, h * before, h * slope_there, 0.5), after]
        value = after
    return ca.Function("forward_costates", [start, z, *interval], [value, ca.horzcat(*points)])


def backward_interval(statement: Statement, pairs: int, influences: int = 0, *, matrices: bool = True) -> ca.Function:
    """Costates and influence functions backward over the pairs of substeps of one control interval.

    Args:
        statement: the problem.
        pairs: Runge-Kutta steps.
        influences: number of influence functions, columns beside the costates.
        matrices: whether the influence functions have costates of the half-vectors that are not zero.

    Returns:
        (columns at the end (size, 1 + influences), impulse at the start, x and e stacked at the starts, middles and
        ends of the pairs (size, 2 pairs + 1), the costates there of the matrices that run backward, *common) -> columns
        at the start with the impulse on the first, columns at the starts of the pairs without it
        (size, pairs (1 + influences)).
    """
    size, count = statement.nx + statement.ne, len(_behind(statement))
    after, impulse = ca.MX.sym("after", size, 1 + influences), ca.MX.sym("impulse", size)
    z, given = ca.MX.sym("z", size, 2 * pairs + 1), ca.MX.sym("given", count, 2 * pairs + 1)
    zero = ca.DM.zeros(count, 2 * pairs + 1)
    interval = Interval.symbols(statement, ca.MX)
    steps = [backward_pair(statement)]
    if influences:
        steps.append(backward_pair(statement, cost=False, matrices=matrices))
    columns, passed = ca.horzsplit(after), []
    for j in range(pairs - 1, -1, -1):
        part = interval.part(j / pairs, (j + 1) / pairs)
        at = [2 * j, 2 * j + 1, 2 * j + 2]
        columns = [
            steps[min(k, 1)](column, *(v[:, i] for v in (z, zero if k else given) for i in at), *part)
            for k, column in enumerate(columns)
        ]
        passed.append(ca.horzcat(*columns))
    start = ca.horzcat(columns[0] + impulse, *columns[1:])
    return ca.Function("backward_interval", [after, impulse, z, given, *interval], [start, ca.horzcat(*passed[::-1])])


def integrated_costates(extremal: Extremal, pairs: int = 1) -> Costates:
    """Costates by integrating the adjoint equations backward, independently of the discrete steps.

    Args:
        extremal: trajectory and terminal multipliers.
        pairs: Runge-Kutta steps of the adjoint per control interval.

    Returns:
        Costates at the nodes.
    """
    st, n, parts = extremal.statement, extremal.mesh.intervals, extremal.mesh.points
    if parts > 1:
        fine = integrated_costates(refined(extremal), max(1, -(-pairs // parts)))
        return Costates(state=fine.state[::parts], matrices=fine.matrices[::parts])
    size = st.nx + st.ne
    values = fine_trajectory(extremal, 2 * pairs)
    if has_forms(st):
        given_last = np.concatenate(terminal_costates(extremal))
        found = costates_in_numbers(extremal, pairs, values, given_last, impulses(extremal), _restarts(extremal))
        if found is not None:
            return Costates(state=found[:, : st.nx], matrices=found[:, st.nx :])
    interval = backward_interval(st, pairs)
    after, *rest = interval.mx_in()
    keep, known = ca.MX.sym("keep", size), ca.MX.sym("known", size)
    start, _ = interval(keep * after + known, *rest)
    sweep = ca.Function("sweep", [after, keep, known, *rest], [start])
    backward = list(range(n - 1, -1, -1))
    behind = st.entries(st.behind)
    jumps = impulses(extremal)
    first = -jumps[0, [st.nx + k for k in behind]]
    jumps[0, [st.nx + k for k in behind]] = 0.0  # these costates are given
    common = extremal.interval_arrays
    given, last_given = given_costates(st, values, common, pairs, first)
    points = values[backward].transpose(2, 0, 1).reshape(size, -1)
    stacked = [column[:, ::-1] for column in (*_restarts(extremal), jumps[:-1].T)]
    last = np.concatenate(terminal_costates(extremal))
    last[_behind(st)] = last_given
    last[: st.nx] += passage_end(extremal, last_given)[0]
    reversed_given = given[backward].transpose(2, 0, 1).reshape(given.shape[2], given.shape[0] * given.shape[1])
    (result,) = swept(sweep, last, *stacked, points, reversed_given, *common.columns(backward))
    costates = np.vstack([result[::-1], last])
    return Costates(state=costates[:, : st.nx], matrices=costates[:, st.nx :])


def given_costates(
    statement: Statement, values: Array, common: Interval, pairs: int, first: Array | None = None
) -> tuple[Array, Array]:
    """Costates of the matrices that run backward along a trajectory; none where none does.

    Args:
        statement: the problem.
        values: x and e at the starts, middles and ends of the pairs of all intervals, (N, 2 pairs + 1, size).
        common: the intervals, a column for each.
        pairs: Runge-Kutta steps an interval.
        first: at the start, (rows,); None: zero.

    Returns:
        At the same points (N, 2 pairs + 1, rows), and at the end (rows,).
    """
    n, points, size = values.shape
    rows = len(_behind(statement))
    if not rows:
        return np.zeros((n, points, 0)), np.zeros(0)
    start = np.zeros(rows) if first is None else first
    ends, inside = swept(
        forward_costates(statement, pairs), start, values.transpose(2, 0, 1).reshape(size, -1), *common
    )
    return inside.reshape(n, points, rows), ends[-1]


def _restarts(extremal: Extremal) -> tuple[Array, Array]:
    """Which costates to keep at the ends of the intervals (1 or 0) and the values in place of the others, (size, N).

    Inside, where a shooting segment ends, the multipliers of its continuity are the costates.
    """
    mesh, gaps = extremal.mesh, extremal.multipliers.gaps
    size = extremal.statement.nx + extremal.statement.ne
    keep, known = np.ones((size, mesh.intervals)), np.zeros((size, mesh.intervals))
    if gaps.shape[0] == len(mesh.segments):
        inner = np.array(mesh.starts[1:-1], dtype=np.intp) - 1
        keep[: gaps.shape[1], inner] = 0.0
        known[: gaps.shape[1], inner] = gaps[:-1].T
    return keep, known
