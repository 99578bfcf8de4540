"""Statement -> NLP by multiple shooting, with the matrices eliminated or as half-vector states."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.statement.statement import Columns, Conditions, Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.nlp import NLP, Rows, Scales
from covocp.transcription.scales import limit_units
from covocp.transcription.shooting import interval_columns, shoot


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
    nodes = shoot(statement, mesh, variables)
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
        self.p = ca.MX.sym("p", statement.np + 1)
        self.parameters, self.cost_scale = ca.vertsplit(self.p, [0, statement.np, statement.np + 1])
        self.x = ca.reshape(x, nx, count) * ca.repmat(ca.DM(scales.x), 1, count)
        self.e: Any = None if mesh.eliminated else ca.reshape(e, ne, count) * ca.repmat(ca.DM(scales.e), 1, count)
        if self.e is not None and statement.tied is not None and statement.tied.matrices:
            first = statement.started(self.x[:, 0], self.parameters, self.e[:, 0])[1]
            self.e = ca.horzcat(first, self.e[:, 1:])
        self.u = mesh.acting(ca.reshape(u, nu, nodes) * ca.DM(np.broadcast_to(scales.u, (nodes, nu)).T))
        self.duration = duration * scales.duration if statement.duration.free else ca.MX(statement.duration.guess)


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
            x, u, e, t = (v[:, columns] for v in arguments)
            value = conditions.columns(Columns(x, u, e, t), variables.duration, variables.parameters)
            rows.append(_condition_rows(kind, conditions, value, k, mesh))
    if mesh.points > 1:
        rows += _inside_rows(statement, mesh, scales, variables, nodes)
    if mesh.eliminated and statement.matrices:
        rows += _final_matrices(statement, scales, nodes["e"][:, -1])
    return tuple(sorted(rows, key=lambda entry: entry.dense))


def _condition_rows(kind: str, conditions: Conditions, value: Expr, count: int, mesh: Mesh) -> Rows:
    """Inequalities at some points, in units of their limits where these are small.

    Solvers meet rows to an absolute tolerance: without that a limit of 1e-12 (the square of micrometres) is none.
    """
    scale = limit_units(conditions.lower, conditions.upper)
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
    """Bounds on states and path constraints at the points inside the intervals where they are imposed."""
    n, inner, rows = mesh.intervals, mesh.points - 1, []
    if statement.bounded_states:
        rows.append(_bound_rows("bounds_inside", statement, scales, nodes["x_inside"][statement.bounded_states, :]))
    path = statement.path
    if path.size:
        at = [k * mesh.points + j for k in range(n) for j in range(1, mesh.points)]
        intervals = interval_columns(mesh, variables.u, variables.duration, variables.parameters)
        points = intervals.substeps(mesh.points).columns(at)
        e = nodes["e_inside"] if statement.matrices else ca.DM(0, n * inner)
        places = Columns(nodes["x_inside"], points.start, e, variables.duration * points.s)
        value = path.columns(places, variables.duration, variables.parameters)
        rows.append(_condition_rows("path_inside", path, value, n * inner, mesh))
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


def _split_jacobian(variables: _Variables, rows: tuple[Rows, ...], g: Expr) -> ca.Function | None:
    """Jacobian of g where it has dense rows: those by their own adjoint sweeps, the rest with its sparsity."""
    dense = [entry.expression for entry in rows if entry.dense]
    if not dense:
        return None
    sparse = ca.vertcat(*(entry.expression for entry in rows if not entry.dense))
    blocks = [ca.jacobian(sparse, variables.w), ca.jacobian(ca.vertcat(*dense), variables.w)]
    return ca.Function("nlp_jac_g", [variables.w, variables.p], [g, ca.vertcat(*blocks)], ["x", "p"], ["g", "jac_g_x"])
