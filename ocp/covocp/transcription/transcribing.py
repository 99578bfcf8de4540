"""Statement -> NLP by multiple shooting, with the matrices eliminated or as half-vector states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr, above, densified, minus, over, plus, slopes_by, times
from covocp.base.matrices import Array
from covocp.passage.sweep import depends, passed_by
from covocp.statement.interval import Interval
from covocp.statement.statement import Columns, Conditions, Statement
from covocp.transcription.chained import chains, segment_slopes
from covocp.transcription.limit_units import ALONG, row_units
from covocp.transcription.mesh import Mesh
from covocp.transcription.nlp import NLP, Rows, Scales, inside_kind
from covocp.transcription.pieces import is_separable, pieces
from covocp.transcription.sequences import Passage
from covocp.transcription.shooting import backward_at_start, compiled_steps, interval_columns, nominal_run, shoot
from covocp.transcription.staged import SMALLEST_ALONE, Staged, is_staged, staged

if TYPE_CHECKING:
    from covocp.passage.written import Tape

# Adjoint sweeps that a Jacobian takes at once.
LARGEST_DIRECTIONS = 64


def transcribe(
    statement: Statement, mesh: Mesh, scales: Scales, passage: Passage = None, *, taken: bool = False
) -> NLP:
    """Build the NLP of a statement on a mesh.

    Args:
        statement: the problem.
        mesh: nodes, segments, formulation.
        scales: magnitudes in which the NLP works.
        passage: of eliminated matrices; compiled, the NLP has slopes of first order only.
        taken: whether the solver takes functions of slopes as they are, and so needs no further slopes of them.

    Returns:
        The NLP; its functions are not yet differentiated.
    """
    variables = _Variables(statement, mesh, scales)
    passage = passage if compiled_steps(mesh) else None
    along = _AlongRun(variables) if passage is passed_by and is_staged(statement, mesh) else None
    nodes = shoot(statement, mesh, variables, passage=passage) if along is None else along.nodes
    running, terminal = _costs(variables, nodes)
    rows = _constraints(statement, mesh, scales, variables, nodes)
    g = above([entry.expression for entry in rows])
    depending = None
    if passage is not None and any(entry.dense for entry in rows):
        depending = _depending(variables, scales)
    outputs = [nodes["x"], nodes["e"], variables.u, variables.duration, running, terminal, g]
    separable = taken and is_separable(statement, mesh)
    stages = taken and not separable and statement.nx >= SMALLEST_ALONE and is_staged(statement, mesh)
    by_stages = _staged(variables, nodes) if stages or along is not None else None
    return NLP(
        statement=statement,
        mesh=mesh,
        scales=scales,
        w=variables.w,
        p=variables.p,
        f=over(plus(running, terminal), variables.cost_scale),
        g=g,
        rows=rows,
        gradient=None if along is None or by_stages is None else along.gradient(by_stages),
        jacobian=_jacobian(variables, nodes, rows, depending, by_stages),
        evaluate=ca.Function("evaluate", [variables.w, variables.p], outputs),
        backward=_backward(statement, mesh, variables, variables.p),
        pieces=pieces(statement, mesh, scales, rows) if separable else (),
    )


def written_out(statement: Statement, mesh: Mesh, scales: Scales, tape: Tape) -> NLP:
    """The NLP of a statement of which matrices pass alone, for C code: the passages are those of a tape.

    Args:
        statement: the problem.
        mesh: nodes and segments; its matrices are eliminated, its steps those of Gauss.
        scales: magnitudes in which the NLP works.
        tape: takes the passages.
    """
    from covocp.transcription.taped import Taped

    variables = _Variables(statement, mesh, scales)
    taped = Taped(statement, mesh, variables, tape)
    running, terminal = _costs(variables, taped.nodes)
    rows = _constraints(statement, mesh, scales, variables, taped.nodes)
    f = (running + terminal) / variables.cost_scale
    cost = sum(_costs(variables, taped.given)) / variables.cost_scale
    gradient, dense = taped.slopes(cost, _dense(_constraints(statement, mesh, scales, variables, taped.given)))
    others = ca.jacobian(ca.vertcat(ca.MX(0, 1), *(entry.expression for entry in rows if not entry.dense)), variables.w)
    if dense.shape[0]:
        dense = ca.project(dense, ca.jacobian_sparsity(_depending(variables, scales), variables.w))
    g = ca.vertcat(ca.MX(0, 1), *(entry.expression for entry in rows))
    nodes = taped.nodes
    outputs = [nodes["x"], nodes["e"], variables.u, variables.duration, running, terminal, g]
    return NLP(
        statement=statement,
        mesh=mesh,
        scales=scales,
        w=variables.w,
        p=variables.p,
        f=f,
        g=g,
        rows=rows,
        gradient=(f, gradient),
        jacobian=ca.vertcat(others, dense),
        evaluate=ca.Function("evaluate", [variables.w, variables.p], outputs),
        backward=_backward(statement, mesh, variables, variables.p),
    )


def _depending(variables: _Variables, scales: Scales) -> Any:
    """What depends on the variables as the dense rows do, where the sparsity of these cannot be seen."""
    statement, mesh = variables.statement, variables.mesh
    seen = shoot(statement, mesh, variables, passage=depends)
    return _dense(_constraints(statement, mesh, scales, variables, seen))


def _backward(statement: Statement, mesh: Mesh, variables: _Variables, p: Expr) -> ca.Function | None:
    """(w, p) -> half-vectors at the start of the matrices that run backward; None where none does."""
    if not statement.behind:
        return None
    if mesh.eliminated:
        start = backward_at_start(statement, mesh, variables)
    else:
        start = variables.e[statement.entries(statement.behind), 0]
    return ca.Function("backward", [variables.w, p], [start])


class _Variables:
    """The variables of the NLP, and their unscaled values as matrices with a column for each node."""

    def __init__(self, statement: Statement, mesh: Mesh, scales: Scales) -> None:
        self.statement, self.mesh = statement, mesh
        nx, ne, nu, count, nodes = statement.nx, statement.ne, statement.nu, len(mesh.starts), mesh.control_nodes
        lengths = [nx * count, 0 if mesh.eliminated else ne * count, nu * nodes, int(statement.duration.free)]
        ends = np.cumsum([0, *lengths]).tolist()
        self.w = ca.MX.sym("w", ends[-1])
        units = [np.tile(scales.x, count), np.zeros(0) if mesh.eliminated else np.tile(scales.e, count)]
        units += [np.broadcast_to(scales.u, (nodes, nu)).ravel(), np.full(lengths[-1], scales.duration)]
        values = times(ca.MX(ca.DM(np.concatenate(units))), self.w)
        x, e, u, duration = (values[i:j] for i, j in pairwise(ends))
        self.p = ca.MX.sym("p", statement.np + 1)
        # of one entry CasADi's empty part is a row
        self.parameters = self.p[: statement.np] if statement.np else ca.MX(0, 1)
        self.cost_scale = self.p[statement.np]
        self.x = ca.reshape(x, nx, count)
        self.e: Any = None if mesh.eliminated else ca.reshape(e, ne, count)
        if self.e is not None and statement.tied is not None and statement.tied.matrices:
            first = statement.started(self.x[:, 0], self.parameters, self.e[:, 0])[1]
            self.e = ca.horzcat(first, self.e[:, 1:])
        self.u = mesh.acting(ca.reshape(u, nu, nodes)) if nu else ca.MX(0, nodes)
        self.duration = duration if statement.duration.free else ca.MX(statement.duration.guess)

    @cached_property
    def intervals(self) -> Interval:
        """The intervals of the mesh, a column for each."""
        return interval_columns(self.mesh, self.u, self.duration, self.parameters)


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
    places: Mapping[str, tuple[Conditions, list[int], tuple[float, ...]]] = {
        "path": (statement.path, list(range(n)), ALONG),
        "start": (statement.start, [0], (0.0,)),
        "end": (statement.end, [n - 1], (1.0,)),
    }
    for kind, (conditions, columns, shares) in places.items():
        if conditions.size:
            k = len(columns)
            x, u, e, t = (v[:, columns] for v in arguments)
            value = conditions.columns(Columns(x, u, e, t), variables.duration, variables.parameters)
            units = row_units(statement, conditions, scales, shares)
            rows.append(_condition_rows(kind, conditions, value, k, mesh, units))
    for i, (part, k) in enumerate(zip(statement.inside.parts, statement.inside.nodes_among(mesh.nodes), strict=True)):
        at = Columns(*(v[:, k] for v in arguments))
        value = part.conditions.columns(at, variables.duration, variables.parameters)
        units = row_units(statement, part.conditions, scales, (part.place,))
        rows.append(_condition_rows(inside_kind(i), part.conditions, value, 1, mesh, units))
    if mesh.points > 1:
        rows += _inside_rows(statement, mesh, scales, variables, nodes)
    if mesh.eliminated and statement.matrices:
        rows += _final_matrices(statement, scales, nodes["e"][:, -1])
    return tuple(sorted(rows, key=lambda entry: entry.dense))


def _condition_rows(kind: str, conditions: Conditions, value: Expr, count: int, mesh: Mesh, scale: Array) -> Rows:
    """Inequalities at some points, in units of their own (`row_units`).

    Solvers meet rows to an absolute tolerance: without that a limit of 1e-12 (the square of micrometres) is none.
    """
    return Rows(
        kind=kind,
        expression=ca.vec(value if (scale == 1.0).all() else value / ca.repmat(ca.DM(scale), 1, count)),
        lower=np.tile(conditions.lower / scale, count),
        upper=np.tile(conditions.upper / scale, count),
        names=conditions.names,
        scale=np.tile(scale, count),
        dense=conditions.uses_matrices and mesh.eliminated,
    )


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


def _gap_rows(kind: str, gaps: Expr, scale: Array, names: tuple[str, ...]) -> Rows:
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


def _interior_bounds(statement: Statement, mesh: Mesh, scales: Scales, x: Expr) -> list[Rows]:
    """Bounds on states at the nodes inside the segments, where they are not variables."""
    bounded = statement.bounded_states
    inside = sorted(set(range(mesh.intervals + 1)) - set(mesh.starts))
    if not bounded or not inside:
        return []
    return [_bound_rows("state_bounds", statement, scales, x[bounded, inside])]


def _bound_rows(kind: str, statement: Statement, scales: Scales, values: Expr) -> Rows:
    """Bounds on the bounded states at some places, a column each."""
    bounded, count = statement.bounded_states, values.shape[1]
    scale = scales.x[bounded]
    lower, upper = (bound[bounded] / scale for bound in statement.state_bounds)
    return Rows(
        kind=kind,
        expression=ca.vec(values / ca.repmat(ca.DM(scale), 1, count)),
        lower=np.tile(lower, count),
        upper=np.tile(upper, count),
        names=tuple(f"bounds of {statement.state_names[i]}" for i in bounded),
        scale=np.tile(scale, count),
    )


def _inside_rows(
    statement: Statement, mesh: Mesh, scales: Scales, variables: _Variables, nodes: dict[str, Any]
) -> list[Rows]:
    """Bounds on states and path constraints at the points inside the intervals where they are imposed.

    An equation is none of them: at each point between the nodes it would take what a linear control leaves free, so
    that a direction of unit length could not turn within an interval.
    """
    n, inner, rows = mesh.intervals, mesh.points - 1, []
    if statement.bounded_states:
        rows.append(_bound_rows("bounds_inside", statement, scales, nodes["x_inside"][statement.bounded_states, :]))
    path = statement.path
    if path.size:
        at = [k * mesh.points + j for k in range(n) for j in range(1, mesh.points)]
        points = variables.intervals.substeps(mesh.points).columns(at)
        e = nodes["e_inside"] if statement.matrices else ca.DM(0, n * inner)
        places = Columns(nodes["x_inside"], points.start, e, variables.duration * points.s)
        value = path.columns(places, variables.duration, variables.parameters)
        own = _condition_rows("path_inside", path, value, n * inner, mesh, row_units(statement, path, scales))
        free = np.where(np.tile(path.equations, n * inner), np.inf, 0.0)
        rows.append(replace(own, lower=own.lower - free, upper=own.upper + free))
    return rows


def _final_matrices(statement: Statement, scales: Scales, last: Expr) -> list[Rows]:
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


def _dense(rows: tuple[Rows, ...]) -> Any:
    """The rows that depend on eliminated matrices."""
    return above([entry.expression for entry in rows if entry.dense])


def _staged(variables: _Variables, nodes: dict[str, Any]) -> Staged:
    """The segments of the NLP by the stages of their steps."""
    mesh, states = variables.mesh, (nodes["x"], nodes["run"][1])
    return staged(variables.statement, mesh, states, variables.intervals, variables.w, variables.x[:, :-1])


class _AlongRun:
    """What follows from the run of the nominal through all segments, as from something that is given."""

    def __init__(self, variables: _Variables) -> None:
        self._variables = variables
        self._run = nominal_run(variables.statement, variables.mesh, variables, variables.intervals, compiled=True)
        names = ("ends", "fine", "cost")
        self._given = [ca.MX.sym(name, *value.shape) for name, value in zip(names, self._run, strict=True)]
        ends, fine, costs = self._given
        of, run, intervals = variables.statement, (ends, fine, costs), variables.intervals
        self._nodes = shoot(of, variables.mesh, variables, passage=passed_by, run=run, intervals=intervals)

    @property
    def nodes(self) -> dict[str, Any]:
        """What `shoot` returns, of the run itself."""
        named = {name: value for name, value in self._nodes.items() if name != "run"}
        own = [self._variables.w, self._variables.p]
        function = ca.Function("after_run", [*own, *self._given], list(named.values()))
        values = function.call([*own, *self._run], True, False)
        return {**dict(zip(named, values, strict=True)), "run": self._run}

    def gradient(self, by_stages: Staged) -> tuple[Any, Any]:
        """The cost and its slopes: by what is given by CasADi, of the run by the stages."""
        variables = self._variables
        w, p, nx, n = variables.w, variables.p, variables.statement.nx, variables.mesh.intervals
        cost = over(plus(*_costs(variables, self._nodes)), variables.cost_scale)
        slopes = slopes_by(cost, [w, *self._given])
        after = ca.Function("cost_after_run", [w, p, *self._given], [cost, *slopes])
        value, by_w, by_ends, by_fine, by_costs = after(w, p, *self._run)
        tall = nx * variables.mesh.substeps
        if variables.mesh.substeps == 1:
            seeds = plus(by_fine, by_ends)
        else:
            seeds = ca.reshape(by_fine, tall, n) + ca.vertcat(ca.DM(tall - nx, n), by_ends)
            seeds = ca.reshape(seeds, *by_fine.shape)
        return value, plus(by_w, by_stages.cost_slopes(densified(seeds), by_costs))


def _costs(variables: _Variables, nodes: dict[str, Any]) -> tuple[Any, Any]:
    """Running and terminal cost."""
    last_x, last_e = nodes["x"][:, -1], nodes["e"][:, -1]
    terminal = variables.statement.terminal(last_x, last_e, variables.duration, variables.parameters)
    return ca.sum2(nodes["cost"]), terminal


def _jacobian(
    variables: _Variables, nodes: dict[str, Any], rows: tuple[Rows, ...], depending: Expr, by_stages: Staged | None
) -> Any:
    """Jacobian of the rows where CasADi's own takes longer: continuity by intervals, dense rows by their own sweeps.

    Args:
        variables: of the NLP.
        nodes: values at them.
        rows: continuity of the states first, dense ones last.
        depending: what depends on the variables as the dense rows do, where the sparsity of these cannot be seen.
        by_stages: the segments, where they are differentiated by the stages of their steps.

    Returns:
        An expression; None where CasADi's own will do.
    """
    dense, w, mesh, statement = _dense(rows), variables.w, variables.mesh, variables.statement
    chained = by_stages is None and chains(statement, mesh)
    if not dense.shape[0] and not chained and by_stages is None:
        return None
    blocks, others = [], [entry.expression for entry in rows if not entry.dense]
    if by_stages is not None or chained:
        if by_stages is not None:
            slopes = by_stages.segment_slopes()
        else:
            slopes = segment_slopes(statement, mesh, nodes["x"], variables.intervals, w, variables.x[:, :-1])
        unscaled = minus(slopes, ca.jacobian(ca.vec(variables.x[:, 1:]), w))
        blocks.append(ca.mtimes(ca.diag(ca.DM(1 / rows[0].scale)), unscaled))
        others = others[1:]
    if others:
        blocks.append(ca.jacobian(above(others), w))
    if depending is not None:
        pattern = ca.jacobian_sparsity(depending, w)
        unit = ca.horzsplit(ca.DM.eye(dense.shape[0]), LARGEST_DIRECTIONS)
        by_w = ca.horzcat(*(ca.jtimes(dense, w, ca.densify(seeds), True) for seeds in unit))
        blocks.append(ca.project(by_w.T, pattern))
    elif dense.shape[0]:
        blocks.append(ca.jacobian(dense, w))
    return above(blocks)
