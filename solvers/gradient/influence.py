"""Forward and backward sweeps of the gradient method: the miss at the end, and its slopes by influence functions.

G. T. Schmidt, Sc.D. thesis, M.I.T. 1971, [4.3], steps 2 to 4, and appendix D, corrected. The matrices are half-vectors
e; x and e are stacked as z, their costates p, P as one column, and each terminal condition z_j(T) has a column R_j
beside it: the adjoint of the rates alone, with the slope of the condition as terminal value. So conditions on final
matrices, and equalities between final values, are treated like fixed components of the final state.

    h = L + p' f + tr(P V),   H_j = R_j' (f, V),   d(J) = int h_u du dt + ...,   d(z_j) = int H_ju du dt + ...

The control is a combination of a few functions phi_i(t/T) (hats, or one on each interval), so the slopes come as the
integrals of phi_i h_u by Simpson's rule on the starts, middles and ends of the pairs of substeps. Controls are held in
t/T: a change of T stretches them, and the slope of J by T is

    k_T + int_0^1 d/dT [T H(t = s T)] ds,

which is k_t + H(T) where H_u = 0 (appendix D); elsewhere it has the change of u at a fixed time that a stretch brings.

In the closed loop (appendix E, corrected) z = (x, E, S), and S runs backward from s(x(T), T), after the nominal. Its
costate Y runs forward from zero (it is -Xhat/2 [A-32]) and needs no other; p and P come last. With nu = k_S - Y(T)

    p(T) = k_x + s_x' nu,   slope by T: k_T + s_T' nu + ...,

which is (1/2 tr S(T) X(T))_x where the terminal cost is not quadratic, a term that the source drops. No condition
depends on S elsewhere, so the influence functions have no part in S.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr, slopes_by
from covocp.base.matrices import Array, stacked
from covocp.base.quadrature import simpson_weight
from covocp.base.short_repr import short_repr
from covocp.extremal.costates import backward_interval, forward_costates, reading_slopes
from covocp.extremal.hamiltonian import hamiltonian
from covocp.extremal.slope_terms import slope_sizes, slope_terms
from covocp.passage.sweep import passed_by
from covocp.statement.interval import Interval, repeated
from covocp.statement.statement import Statement
from covocp.transcription.inside import inside_interval
from covocp.transcription.mesh import Mesh
from covocp.transcription.shooting import interval_columns, matrices_along
from covocp.transcription.steps import full_interval, nominal_interval
from covocp.transcription.trajectory import at_nodes

# Scalar operations of the rates, times the steps in an interval, above which functions are not written out in them.
LARGEST_FLAT = 10_000


@dataclass(frozen=True, kw_only=True)
class Terminal:
    """The conditions at the end that influence functions meet.

    Args:
        fixed: entries of z = (x, e) with a final value.
        rows: equalities among the final conditions that do not depend on the control.
        names: of all of them, in this order.
        matrices: whether the matrices have an influence on them.
        function: (z, T, p, Y) -> terminal cost k, the values of the conditions, the slopes of both by z (size,
            1 + q) and by T (1, 1 + q), S(T) = s(x(T), T) inserted and the slopes of k with -Y' s.
    """

    fixed: tuple[int, ...]
    rows: tuple[int, ...]
    names: tuple[str, ...]
    matrices: bool
    function: ca.Function

    __repr__ = short_repr

    def targets(self, statement: Statement, parameters: Array) -> Array:
        """What the conditions must be."""
        _, final, _, matrices = statement.boundary_values(parameters)
        values = np.concatenate([final, matrices])[list(self.fixed)]
        return np.concatenate([values, statement.end.lower[list(self.rows)]])


@dataclass(frozen=True, kw_only=True)
class Sweeps:
    """The compiled sweeps of a statement on a mesh; `pairs` Runge-Kutta steps backward in each interval.

    forward: (z(0), *common) -> z at the nodes (size, N + 1), running cost of each interval.
    refine: z at the starts and at the ends of the intervals, *common -> z at the starts, middles and ends of the pairs.
    given: costates of the matrices that run backward there; None without such matrices.
    """

    statement: Statement
    mesh: Mesh
    pairs: int
    terminal: Terminal
    forward: ca.Function
    refine: ca.Function
    given: ca.Function | None
    backward: ca.Function
    quadrature: ca.Function
    curvature: ca.Function
    terms: ca.Function

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Run:
    """A forward sweep: z at the nodes (N + 1, size), costs, miss of the terminal conditions (q,)."""

    u: Array
    duration: float
    z: Array
    running: float
    terminal: float
    miss: Array

    __repr__ = short_repr

    @property
    def cost(self) -> float:
        """J."""
        return self.running + self.terminal

    @property
    def finite(self) -> bool:
        """Whether the model stayed in its domain."""
        return bool(np.isfinite(self.cost) and np.isfinite(self.z).all())


@dataclass(frozen=True, kw_only=True)
class Slopes:
    """A backward sweep; the first of the 1 + q entries belongs to the cost, the others to the terminal conditions.

    control: slopes by the control values, (1 + q, K, nu); cost: the part of the running cost alone, (K, nu).
    duration: by T, (1 + q,). start: by z(0), (1 + q, size), the columns p, P, R at t = 0.
    columns: costates and influence functions at the nodes, (N + 1, size, 1 + q).
    middles: values of z in the intervals, and columns at the ends of the pairs: what `reweigh` needs.
    """

    control: Array
    cost: Array
    duration: Array
    start: Array
    columns: Array
    middles: tuple[Array, ...]

    __repr__ = short_repr


def build_sweeps(
    statement: Statement, mesh: Mesh, pairs: int, further: int = 0, *, by_matrices: bool = False
) -> Sweeps:
    """Compile the sweeps.

    Args:
        statement: the problem.
        mesh: nodes, control, integration of the cost.
        pairs: Runge-Kutta steps of the costates in each interval.
        further: number of conditions in phases that follow, whose influence functions pass through this one.
        by_matrices: whether the matrices have an influence on these.
    """
    terminal = terminal_conditions(statement)
    n, count, matrices = mesh.intervals, len(terminal.names) + further, terminal.matrices or by_matrices
    make = hamiltonian(statement)
    curvature = make("curvature", lambda h, x, u, e, t: [ca.hessian(h, u)[0] if statement.nu else ca.DM(0, 0)])
    given = _flat(statement, pairs, forward_costates(statement, pairs)) if statement.behind else None
    backward = _flat(statement, pairs, backward_interval(statement, pairs, count, matrices=matrices))
    quadrature = _flat(statement, pairs, quadrature_interval(statement, pairs, count, matrices=matrices))
    return Sweeps(
        statement=statement,
        mesh=mesh,
        pairs=pairs,
        terminal=terminal,
        forward=_passage(statement, mesh),
        refine=inside_interval(statement, 2 * pairs, mesh.step, mesh.linear_solver).map(n),
        given=None if given is None else given.mapaccum("given", n),
        backward=backward.mapaccum("backward", n),
        quadrature=quadrature.map(n),
        curvature=curvature.map(n + 1),
        terms=slope_terms(statement).map(n + 1),
    )


def _flat(statement: Statement, pairs: int, function: ca.Function) -> ca.Function:
    """A function of an interval in scalar operations, where they are not too many: what is not used is not computed."""
    if statement.symbolic is not ca.SX or pairs * statement.rates.n_instructions() > LARGEST_FLAT:
        return function
    return function.expand()


def _passage(statement: Statement, mesh: Mesh) -> ca.Function:
    """(z(0), *common) -> z at the nodes (size, N + 1), running cost of each interval (steps 2 and 3 of appendix E)."""
    n, nx, solver = mesh.intervals, statement.nx, mesh.linear_solver
    start = ca.MX.sym("start", nx + statement.ne)
    one = Interval.symbols(statement, ca.MX)
    common = Interval(*(ca.MX.sym(name, entry.shape[0], n) for name, entry in one._asdict().items()))
    if not statement.behind:
        interval = full_interval(statement, mesh.substeps, mesh.step, solver).mapaccum("passage", n)
        ends, _, cost = interval(start, *common)
        return ca.Function("forward", [start, *common], [ca.horzcat(start, ends), cost])
    ends, fine, cost = nominal_interval(statement, mesh.substeps, mesh.step).mapaccum("passage", n)(start[:nx], *common)
    x = ca.horzcat(start[:nx], ends)
    e, matrix_cost = matrices_along(
        statement, mesh, x, fine, common, common.parameters[:, 0], start[nx:], passage=passed_by
    )
    return ca.Function("forward", [start, *common], [ca.vertcat(x, e), cost + matrix_cost])


def terminal_conditions(statement: Statement) -> Terminal:
    """Fixed final components and equalities at the end, with their slopes."""
    _, final, _, matrices = statement.boundary_values(statement.values)
    fixed = tuple(int(i) for i in np.flatnonzero(~np.isnan(np.concatenate([final, matrices]))))
    end = statement.end
    by_control = end.function.jac_sparsity(0, 1).row() if end.size else []
    rows = tuple(i for i in range(end.size) if end.lower[i] == end.upper[i] and i not in by_control)
    z = ca.MX.sym("z", statement.nx + statement.ne)
    duration, p = ca.MX.sym("T"), ca.MX.sym("p", statement.np)
    behind = statement.entries(statement.behind)
    x, e, y = z[: statement.nx], z[statement.nx :], ca.MX.sym("y", len(behind))
    cost = statement.terminal(x, e, duration, p)
    adjoint = cost
    if statement.matrix_end is not None:
        ends = statement.matrix_end(x, duration, p)
        e = ca.MX(e)
        e[behind] = ends
        adjoint = statement.terminal(x, e, duration, p) - ca.dot(y, ends)
    values = [z[list(fixed)]] if fixed else []
    if rows:
        values.append(end.function(x, ca.DM.zeros(statement.nu), e, duration, duration, p)[list(rows)])
    conditions = ca.vertcat(ca.MX(0, 1), *values)
    stacked = ca.vertcat(adjoint, conditions)
    slopes = [ca.densify(ca.jacobian(stacked, z)).T, ca.densify(ca.jacobian(stacked, duration)).T]
    names = (*statement.state_names, *statement.matrix_names)
    return Terminal(
        fixed=fixed,
        rows=rows,
        names=(*(f"final value of {names[i]}" for i in fixed), *(end.names[i] for i in rows)),
        matrices=statement.coupled
        or any(j >= statement.nx for j in ca.jacobian(conditions, z).sparsity().get_triplet()[1]),
        function=ca.Function("terminal", [z, duration, p, y], [cost, conditions, *slopes]),
    )


def quadrature_interval(statement: Statement, pairs: int, influences: int, *, matrices: bool = True) -> ca.Function:
    """Slopes of one control interval by the controls at its ends and by T, with Simpson's rule on each pair.

    Between the ends of a pair the columns are cubic (values and rates at both ends).

    Returns:
        (columns at the end (size, 1 + q), columns at the starts of the pairs, z at starts, middles and ends of the
        pairs, *common) -> slopes by the control at the start (nu, 1 + q), at the end, by T (1, 1 + q), the part of the
        running cost alone by the control at the start (nu, 1), at the end.
    """
    size, width = statement.nx + statement.ne, 1 + influences
    after, passed = ca.MX.sym("after", size, width), ca.MX.sym("passed", size, width * pairs)
    z = ca.MX.sym("z", size, 2 * pairs + 1)
    common = Interval.symbols(statement, ca.MX)
    points = _columnwise(_point_slopes(statement), _point_slopes(statement, cost=False, matrices=matrices))
    rates = _columnwise(_point_rates(statement), _point_rates(statement, cost=False, matrices=matrices))
    ends = [*(passed[:, j * width : (j + 1) * width] for j in range(pairs)), after]
    shares = [i / (2 * pairs) for i in range(2 * pairs + 1)]
    rest = (common.duration, common.parameters)
    at = [(z[:, i], common.control(c), common.place(c), *rest) for i, c in enumerate(shares)]
    slopes = [rates(ends[j], *at[2 * j])[0] for j in range(pairs + 1)]
    step = common.h / pairs
    totals: list[Any] = [0.0] * 5
    for i in range(2 * pairs + 1):
        c, j = i / (2 * pairs), i // 2
        area = simpson_weight(i, 2 * pairs) * common.ds
        columns = ends[j] if i % 2 == 0 else (ends[j] + ends[j + 1]) / 2 + step / 8 * (slopes[j] - slopes[j + 1])
        by_control, by_duration = points(columns, *at[i])
        by_cost = points(ca.DM.zeros(size, 1), *at[i])[0]
        parts = ((1 - c) * by_control, c * by_control, by_duration, (1 - c) * by_cost, c * by_cost)
        totals = [total + area * part for total, part in zip(totals, parts, strict=True)]
    if statement.samples is not None:
        for j in range(pairs):
            part = common.part(j / pairs, (j + 1) / pairs)
            read = [
                reading_slopes(statement, part, z[:, 2 * j], column, cost=k == 0)[1:]
                for k, column in enumerate(ca.horzsplit(ends[j + 1]))
            ]
            by_control, by_duration = (ca.horzcat(*values) for values in zip(*read, strict=True))
            by_cost = reading_slopes(statement, part, z[:, 2 * j], ca.DM.zeros(size))[1]
            totals[0], totals[2], totals[3] = totals[0] + by_control, totals[2] + by_duration, totals[3] + by_cost
    return ca.Function("quadrature", [after, passed, z, *common], totals)


def _columnwise(first: ca.Function, others: ca.Function) -> Callable[..., list[Any]]:
    """(columns, z, u, s, T, p) -> outputs side by side: of `first` for the first column, of `others` for the rest."""

    def apply(columns: Expr, *arguments: Any) -> list[Any]:
        split = ca.horzsplit(columns)
        outputs = [(others if k else first).call([*arguments, column]) for k, column in enumerate(split)]
        return [ca.horzcat(*values) for values in zip(*outputs, strict=True)]

    return apply


def _point_slopes(statement: Statement, *, cost: bool = True, matrices: bool = True) -> ca.Function:
    """(z, u, s, T, p, column) -> slopes of T H(t = s T) by u and by T."""
    arguments, value = _point(statement, cost, matrices)
    return ca.Function("point_slopes", arguments, slopes_by(arguments[3] * value, (arguments[1], arguments[3])))


def _point_rates(statement: Statement, *, cost: bool = True, matrices: bool = True) -> ca.Function:
    """(z, u, s, T, p, column) -> rate of the column, -H_z."""
    arguments, value = _point(statement, cost, matrices)
    return ca.Function("point_rates", arguments, [ca.densify(-ca.gradient(value, arguments[0]))])


def _point(statement: Statement, cost: bool, matrices: bool) -> tuple[list[Any], Any]:
    """Symbols z, u, s, T, p, column, and the Hamiltonian of z and column at the time s T."""
    symbolic: Any = statement.symbolic
    nx, size = statement.nx, statement.nx + statement.ne
    z, u, column = symbolic.sym("z", size), symbolic.sym("u", statement.nu), symbolic.sym("column", size)
    s, duration, p = symbolic.sym("s"), symbolic.sym("T"), symbolic.sym("p", statement.np)
    value = hamiltonian(statement, cost=cost, matrices=matrices)("value", lambda h, x, u, e, t: [h])
    h = value(z[:nx], u, z[nx:], s * duration, duration, p, column[:nx], column[nx:])
    return [z, u, s, duration, p, column], h


def sweep_forward(sweeps: Sweeps, u: Array, duration: float, start: Array, parameters: Array) -> Run:
    """Integrate x and E forward, S backward along them (step 2; in appendix E steps 2 and 3).

    Args:
        sweeps: compiled.
        u: controls, (K, nu).
        duration: T [s].
        start: z(0), (size,); S(0) follows from the others.
        parameters: of the statement.
    """
    common = interval_columns(sweeps.mesh, ca.DM(u.T), duration, ca.DM(parameters))
    nodes, cost = sweeps.forward(start, *common)
    z = np.ascontiguousarray(nodes.full().T)
    terminal, values, *_ = sweeps.terminal.function(z[-1], duration, parameters, 0.0)
    targets = sweeps.terminal.targets(sweeps.statement, parameters)
    return Run(
        u=u,
        duration=duration,
        z=z,
        running=float(np.sum(cost.full())),
        terminal=float(terminal),
        miss=np.asarray(values.full()).ravel() - targets,
    )


class Later(NamedTuple):
    """What phases that follow say of the end of one: slopes of their cost, and of each of their conditions.

    columns: by z(T), (size, 1 + further); duration: by T, (1 + further,).
    """

    columns: Array
    duration: Array


def sweep_backward(
    sweeps: Sweeps,
    run: Run,
    parameters: Array,
    jumps: Array,
    later: Later | None = None,
    first: Array | None = None,
) -> Slopes:
    """Integrate Y forward, p, P and R backward, and form the integrals of h_u and H_u (steps 3 to 6).

    Args:
        sweeps: compiled.
        run: where to linearise.
        parameters: of the statement.
        jumps: of the costates at the nodes (N + 1, size), from the penalties; the last is added to the terminal value.
        later: of the phases that follow, where the sweeps were built for some.
        first: Y at the start, where a phase goes before; None: zero.
    """
    mesh, pairs = sweeps.mesh, sweeps.pairs
    n, size = mesh.intervals, run.z.shape[1]
    common, points = _points(sweeps, run, parameters)
    z = np.asarray(points.full()).T.reshape(n, 2 * pairs + 1, size)
    given, given_end = _given(sweeps, points, common, first)
    _, _, last, by_duration = (
        np.asarray(v.full()) for v in sweeps.terminal.function(run.z[-1], run.duration, parameters, given_end)
    )
    behind = [sweeps.statement.nx + k for k in sweeps.statement.entries(sweeps.statement.behind)]
    last[:, 0] += jumps[-1]
    if later is not None:
        last, by_duration = (
            np.hstack([own[:, :1] + others[:, :1], own[:, 1:], others[:, 1:]])
            for own, others in ((last, later.columns), (by_duration, later.duration[None]))
        )
    last[behind, 0] = given_end
    order = list(range(n - 1, -1, -1))
    along = [ca.DM(v[::-1].transpose(2, 0, 1).reshape(v.shape[2], n * v.shape[1])) for v in (z, given)]
    columns = [column[:, order] for column in common]
    starts, passed = sweeps.backward(last, ca.DM(jumps[:-1][::-1].T), *along, *columns)
    nodes = np.concatenate([stacked(starts, n)[::-1], last[None]])
    middles = (z, nodes, stacked(passed, n)[::-1], by_duration.ravel())
    return _slopes(sweeps, run.u, run.duration, parameters, middles)


def _points(sweeps: Sweeps, run: Run, parameters: Array) -> tuple[Interval, Any]:
    """The intervals of a run, and z at the starts, middles and ends of their pairs."""
    common = interval_columns(sweeps.mesh, ca.DM(run.u.T), run.duration, ca.DM(parameters))
    return common, sweeps.refine(ca.DM(run.z[:-1].T), ca.DM(run.z[1:].T), *common)


def given_at_end(sweeps: Sweeps, run: Run, parameters: Array, first: Array | None) -> Array:
    """Y at T, (rows,), from what it begins with."""
    common, points = _points(sweeps, run, parameters)
    return _given(sweeps, points, common, first)[1]


def _given(sweeps: Sweeps, points: Expr, common: tuple[Any, ...], first: Array | None) -> tuple[Array, Array]:
    """Y at the starts, middles and ends of the pairs of all intervals (N, 2 pairs + 1, rows), and at T (rows,)."""
    shape = (sweeps.mesh.intervals, 2 * sweeps.pairs + 1, len(sweeps.statement.entries(sweeps.statement.behind)))
    if sweeps.given is None:
        return np.zeros(shape), np.zeros(0)
    ends, inside = sweeps.given(np.zeros(shape[2]) if first is None else first, points, *common)
    return np.asarray(inside.full()).T.reshape(shape), np.asarray(ends.full())[:, -1]


def reweigh(sweeps: Sweeps, slopes: Slopes, u: Array, duration: float, parameters: Array) -> Slopes:
    """The slopes with another control along the same z and costates: what the chord variant needs [4.2-10]."""
    return _slopes(sweeps, u, duration, parameters, slopes.middles)


def _slopes(sweeps: Sweeps, u: Array, duration: float, parameters: Array, middles: tuple[Array, ...]) -> Slopes:
    z, columns, at_pairs, by_duration = middles
    n, size, width = sweeps.mesh.intervals, z.shape[2], columns.shape[2]
    nu = sweeps.statement.nu

    def side_by_side(values: Array) -> Any:
        return ca.DM(values.transpose(1, 0, 2).reshape(size, -1))

    common = interval_columns(sweeps.mesh, ca.DM(u.T), duration, ca.DM(parameters))
    outputs = sweeps.quadrature(
        side_by_side(columns[1:]), side_by_side(at_pairs), side_by_side(z.transpose(0, 2, 1)), *common
    )
    first, second, by_time, cost_first, cost_second = (np.asarray(v.full()) for v in outputs)

    def gather(one: Array, two: Array, count: int) -> Array:
        """Slopes by the control values from those by both ends of the intervals, (count, K, nu)."""
        total = np.zeros((count, sweeps.mesh.control_nodes, nu))
        offset = int(sweeps.mesh.control == "linear")
        total[:, :n] += one.reshape(nu, n, count).transpose(2, 1, 0)
        total[:, offset : offset + n] += two.reshape(nu, n, count).transpose(2, 1, 0)
        return np.array([sweeps.mesh.gathered(own) for own in total])

    return Slopes(
        control=gather(first, second, width),
        cost=gather(cost_first, cost_second, 1)[0],
        duration=by_duration + by_time.reshape(n, width).sum(axis=0),
        start=columns[0].T,
        columns=columns,
        middles=middles,
    )


def control_curvature(sweeps: Sweeps, run: Run, u: Array, columns: Array, ell: Array, parameters: Array) -> Array:
    """H_uu at the nodes, (N + 1, nu, nu), with the costates p + R l, P + R_E l."""
    costates = columns[:, :, 0] + columns[:, :, 1:] @ ell
    values = sweeps.curvature(*_at_nodes(sweeps, run, u, costates, parameters))
    return stacked(values, sweeps.mesh.intervals + 1)


def control_sizes(sweeps: Sweeps, run: Run, columns: Array, ell: Array, parameters: Array) -> Array:
    """Sizes of H_u at the nodes, (N + 1, nu), where p, P and every R l count apart."""
    costates = np.abs(columns[:, :, 0]) + np.abs(columns[:, :, 1:]) @ np.abs(ell)
    terms = np.asarray(sweeps.terms(*_at_nodes(sweeps, run, run.u, costates, parameters)).full()).T
    curvature = control_curvature(sweeps, run, run.u, columns, ell, parameters)
    return slope_sizes(terms, curvature, at_nodes(run.u, sweeps.mesh.nodes.size))


def _at_nodes(sweeps: Sweeps, run: Run, u: Array, costates: Array, parameters: Array) -> tuple[Array, ...]:
    """The arguments of the Hamiltonian at the nodes, a column each."""
    nx, n = sweeps.statement.nx, sweeps.mesh.intervals
    return (
        run.z[:, :nx].T,
        at_nodes(u, n + 1).T,
        run.z[:, nx:].T,
        (sweeps.mesh.nodes * run.duration)[None, :],
        *repeated(run.duration, parameters, n + 1),
        costates[:, :nx].T,
        costates[:, nx:].T,
    )
