"""What is left of the slope of an identification's cost among the controls on the mesh of its solution."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from covocp.analysis.conditions import end_slopes, terminal_weight
from covocp.analysis.constraint_duals import acting, evaluated
from covocp.analysis.reduction import Reduction, resolved
from covocp.analysis.stages import Stages
from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import prolongation, refined
from covocp.transcription.mesh import Mesh


def mesh_residual(extremal: Extremal, w: Array) -> tuple[float, float]:
    """Norm of the slope of the Lagrangian in the energy metric on the mesh of a solution, and the cost of slack.

    The multipliers are those of the nodes and of the points inside the intervals where limits are imposed; terminal
    conditions that are equalities take theirs as they need them.

    Args:
        extremal: the solution.
        w: its control at both ends of its intervals, (N, 2 nu).
    """
    from scipy.linalg import lstsq, solveh_banded  # here: importing scipy takes longer than all of covocp

    coarse, extremal = extremal.mesh, refined(extremal)
    st, parameters, nx = extremal.statement, extremal.parameters, extremal.statement.nx
    stages = Stages.of(Reduction(st, resolved(st, extremal.mesh, parameters), parameters))
    whole = stages if coarse.points == 1 else Stages.of(Reduction(st, resolved(st, coarse, parameters), parameters))
    w = divided(coarse, w, coarse.points)[1]
    zeta = stages.trajectory(w)
    covariance = np.linalg.inv(stages.information(zeta))
    weight = terminal_weight(st, parameters)[nx:, nx:]
    curvature = stages.running - stages.weighted(covariance @ weight @ covariance)
    local = np.einsum("kij,kj->ki", curvature, zeta[:-1])
    by_xi = np.vstack([local[:, : stages.size], np.zeros((1, stages.size))])
    by_xi[-1, :nx] += end_slopes(st, parameters, zeta[-1, :nx])[0]
    nodal_x, nodal_u, slack, rows = _nodal(extremal, zeta[:, :nx])
    by_xi[:, :nx] += nodal_x
    constant = coarse.control == "constant"

    def on_mesh(slopes: Array, more: Array | float = 0.0) -> Array:
        first, last = np.hsplit(slopes, 2)
        if constant:
            values = first + last
        else:
            end = np.zeros((1, st.nu))
            values = np.vstack([first, end]) + np.vstack([end, last])
        return np.asarray(values + more if coarse.points == 1 else prolongation(coarse).T @ (values + more))

    slope = on_mesh(stages.slopes(by_xi, local[:, stages.size : -1]), nodal_u)
    columns = [slope.ravel()]
    for row in rows:
        at_end = np.zeros_like(by_xi)
        at_end[-1, :nx] = row
        columns.append(on_mesh(stages.slopes(at_end, np.zeros_like(w))).ravel())
    banded = _banded_energy(whole, constant)
    right = np.column_stack(columns)
    solved = solveh_banded(banded, right)
    gram = right.T @ solved
    units = np.sqrt(np.diag(gram)[1:])  # conditions on states in other units count alike
    units = np.where(units > 0.0, units, 1.0)
    along = gram[1:, 0] / units
    held = lstsq(gram[1:, 1:] / np.outer(units, units), along)[0] if rows.shape[0] else np.zeros(0)
    return float(np.sqrt(max(0.0, gram[0, 0] - along @ held))), slack


def both_ends(extremal: Extremal) -> Array:
    """The control at both ends of the intervals, (N, 2 nu)."""
    u = extremal.trajectory.u
    return np.hstack([u, u]) if extremal.mesh.control == "constant" else np.hstack([u[:-1], u[1:]])


def divided(mesh: Mesh, w: Array, factor: int) -> tuple[Mesh, Array]:
    """The mesh with every interval cut into equal parts, and the same control at both ends of them."""
    shares = np.arange(factor) / factor
    starts = mesh.nodes[:-1, None] + np.diff(mesh.nodes)[:, None] * shares
    first, last = np.hsplit(w, 2)
    parts = [first[:, None] + s[None, :, None] * (last - first)[:, None] for s in (shares, shares + 1.0 / factor)]
    ends = np.concatenate(parts, axis=2).reshape(-1, w.shape[1])
    return replace(mesh, nodes=np.append(starts.ravel(), 1.0)), ends


def _banded_energy(stages: Stages, constant: bool) -> Array:
    """The energy of the control values of the mesh as an upper banded matrix."""
    nu = stages.energy.shape[1] // 2
    blocks = stages.energy.reshape(-1, 2, nu, 2, nu)
    if constant:
        diagonal, beside = blocks.sum(axis=(1, 3)), np.zeros((0, nu, nu))
    else:
        empty = np.zeros((1, nu, nu))
        diagonal = np.concatenate([blocks[:, 0, :, 0], empty]) + np.concatenate([empty, blocks[:, 1, :, 1]])
        beside = blocks[:, 0, :, 1]
    size = diagonal.shape[0] * nu
    rows = nu if constant else 2 * nu
    result = np.zeros((rows, size))
    for i in range(nu):
        for j in range(nu):
            columns = np.arange(diagonal.shape[0]) * nu + j
            if i <= j:
                result[rows - 1 + i - j, columns] = diagonal[:, i, j]
            if beside.shape[0]:
                result[nu - 1 + i - j, columns[1:]] = beside[:, i, j]
    return result


class _Nodal(NamedTuple):
    """Slopes by nodes and control values of the multipliers at the nodes, slack, rows of terminal equalities."""

    by_x: Array
    by_u: Array
    slack: float
    rows: Array


def _nodal(extremal: Extremal, x: Array) -> _Nodal:
    """What the limits that act at the nodes do."""
    st, m, count = extremal.statement, extremal.multipliers, extremal.mesh.intervals + 1
    fixed = ~np.isnan(st.boundary_values(extremal.parameters)[1])
    states = m.states.copy()
    states[-1] += np.where(fixed, 0.0, m.final)
    by_x, slack = acting(states, x, *st.state_bounds)
    by_u, more = acting(m.controls, extremal.trajectory.u, *st.control_bounds)
    slack += more
    rows = [np.eye(st.nx)[fixed]]
    for conditions, multipliers, nodes in (
        (st.path, m.path, np.arange(count)),
        (st.start, m.start[None, :], np.array([0])),
        (st.end, m.end[None, :], np.array([count - 1])),
    ):
        if not conditions.size:
            continue
        z = np.hstack([x, extremal.controls])[nodes]
        values, maps = evaluated(extremal, conditions, z, extremal.time[nodes])
        weights, more = acting(multipliers, values, conditions.lower, conditions.upper)
        slopes = np.einsum("kr,kri->ki", weights, maps)
        by_x[nodes] += slopes[:, : st.nx]
        np.add.at(by_u, np.minimum(nodes, by_u.shape[0] - 1), slopes[:, st.nx :])
        slack += more
        if conditions is st.end:
            rows.append(maps[0, conditions.lower == conditions.upper, : st.nx])
    return _Nodal(by_x, by_u, slack, np.vstack(rows))
