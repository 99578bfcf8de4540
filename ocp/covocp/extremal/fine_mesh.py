"""A trajectory between its nodes as the steps of its transcription see it, and the mesh on which these are nodes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from math import lcm

import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal
from covocp.statement.statement import Statement
from covocp.transcription.inside import inside_intervals
from covocp.transcription.mesh import Mesh
from covocp.transcription.trajectory import Trajectory


def fine_trajectory(extremal: Extremal, substeps: int) -> Array:
    """Each interval integrated again from its node with other substeps; what runs backward from its later node.

    Returns:
        x and e stacked at the starts of the substeps and at the end, (N, substeps + 1, nx + ne).
    """
    mesh = replace(extremal.mesh, points=1)
    return _inside(extremal.statement, mesh, extremal.trajectory, tuple(extremal.parameters.tolist()), substeps)


@lru_cache(maxsize=2)
def _inside(
    statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: tuple[float, ...], substeps: int
) -> Array:
    """The same, remembered: several residuals look at one trajectory; read-only."""
    nodes = np.hstack([trajectory.x, trajectory.e])
    given = (trajectory.u, trajectory.duration, np.array(parameters))
    values = inside_intervals(statement, mesh, nodes, *given, substeps)
    values.setflags(write=False)
    return values


@lru_cache(maxsize=8)
def refined_mesh(mesh: Mesh) -> Mesh:
    """The mesh whose nodes are all points at which limits are imposed; its steps are those of the given one."""
    return replace(mesh.divided(mesh.points), substeps=mesh.substeps // mesh.points)


@lru_cache(maxsize=8)
def prolongation(mesh: Mesh) -> Array:
    """Control values on the refined mesh from those of the mesh, (fine values, values)."""
    n, p = mesh.intervals, mesh.points
    if mesh.control == "constant":
        return np.asarray(np.kron(np.eye(n), np.ones((p, 1))), dtype=float)
    at = np.minimum(np.arange(n * p + 1) // p, n - 1)
    share = np.arange(n * p + 1) / p - at
    result = np.zeros((n * p + 1, n + 1))
    result[np.arange(n * p + 1), at] = 1.0 - share
    result[np.arange(n * p + 1), at + 1] += share
    return result


def refined(extremal: Extremal) -> Extremal:
    """The same extremal with the points at which limits are imposed as nodes; the control is that of the mesh."""
    mesh, t, m = extremal.mesh, extremal.trajectory, extremal.multipliers
    if mesh.points == 1:
        return extremal
    p, nx = mesh.points, extremal.statement.nx
    fine = refined_mesh(mesh)
    z = fine_trajectory(extremal, mesh.substeps)[:, :: mesh.substeps // p]
    inside = z[:, 1:-1]

    def merged(at_nodes: Array, between: Array) -> Array:
        columns = at_nodes.shape[1]
        parts = np.concatenate([at_nodes[:-1, None], between], axis=1).reshape(mesh.intervals * p, columns)
        return np.vstack([parts, at_nodes[-1:]])

    controls = np.zeros((fine.control_nodes, m.controls.shape[1]))
    controls[::p] = m.controls
    multipliers = replace(
        m,
        path=merged(m.path, m.inside_path),
        states=merged(m.states, m.inside_states),
        matrices=merged(m.matrices, np.zeros((mesh.intervals, p - 1, m.matrices.shape[1]))),
        controls=controls,
        inside_path=np.zeros((fine.intervals, 0, m.path.shape[1])),
        inside_states=np.zeros((fine.intervals, 0, nx)),
    )
    trajectory = Trajectory(
        x=merged(t.x, inside[:, :, :nx]),
        e=merged(t.e, inside[:, :, nx:]),
        u=prolongation(mesh) @ t.u,
        duration=t.duration,
    )
    return replace(extremal, mesh=fine, trajectory=trajectory, multipliers=multipliers)


def with_parts(extremal: Extremal, parts: int) -> Extremal:
    """The same extremal with equal parts of the intervals ended by nodes, its steps those of the mesh where these fit.

    Args:
        extremal: on a mesh whose limits are imposed at its nodes.
        parts: of each interval.
    """
    st, mesh, m = extremal.statement, extremal.mesh, extremal.multipliers
    paired = 2 if st.running_uses_matrices else 1  # of Simpson's rule
    substeps = lcm(mesh.substeps, parts * paired)
    nothing = replace(
        m,
        inside_path=np.zeros((mesh.intervals, parts - 1, m.path.shape[1])),
        inside_states=np.zeros((mesh.intervals, parts - 1, st.nx)),
    )
    return refined(replace(extremal, mesh=replace(mesh, points=parts, substeps=substeps), multipliers=nothing))
