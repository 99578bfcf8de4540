"""A trajectory run again with shorter integration steps: what its own steps are off."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.passage.sweep import passed_by
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.sequences import NUMERIC_RUN
from covocp.transcription.shooting import interval_columns, shoot
from covocp.transcription.steps import nominal_interval
from covocp.transcription.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """What shorter integration steps make of a trajectory.

    Attributes:
        jumps: at the ends of the segments, (segments, nx, or nx + ne where the matrices are variables).
        running: running cost.
        costs: running cost of each interval, (N,).
        states: at the nodes, (N + 1, nx); those at which a segment starts are as given.
        matrices: half-vectors at the nodes, (N + 1, ne); the same where they are variables.
    """

    jumps: Array
    running: float
    costs: Array
    states: Array
    matrices: Array

    __repr__ = short_repr


def refined_run(statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: Array, parts: int = 2) -> Refined:
    """Run the segments of a trajectory again with shorter integration steps.

    The intervals are divided, not the substeps multiplied: so the functions of the transcription serve again.

    Args:
        statement: the problem.
        mesh: of the trajectory.
        trajectory: where each segment starts from, and the controls.
        parameters: of the statement.
        parts: parts of each interval.
    """
    starts, (divided, u) = list(mesh.starts), _divided(mesh, trajectory.u, parts)
    start = SimpleNamespace(
        x=ca.DM(trajectory.x[starts].T),
        e=ca.DM(trajectory.e[starts].T),
        u=ca.DM(u.T),
        duration=ca.DM(trajectory.duration),
        parameters=ca.DM(parameters),
    )
    values = shoot(statement, divided, start, passage=passed_by)
    jumps = np.hstack([np.asarray(ca.DM(values[name]).full()).T for name in ("gap_x", "gap_e")])
    states, matrices = (np.asarray(ca.DM(values[name][:, ::parts]).full()).T for name in ("x", "e"))
    costs = np.asarray(ca.DM(values["cost"]).full()).reshape(mesh.intervals, parts).sum(axis=1)
    return Refined(
        jumps=jumps, running=float(ca.DM(ca.sum2(values["cost"]))), costs=costs, states=states, matrices=matrices
    )


def refined_end(statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: Array, parts: int = 2) -> Array:
    """The state at the end, (nx,), of one run from the start along the same controls with shorter steps."""
    divided, u = _divided(mesh, trajectory.u, parts)
    common = interval_columns(divided, ca.DM(u.T), trajectory.duration, ca.DM(parameters))
    advance = nominal_interval(statement, mesh.substeps, mesh.step)
    value: Any = ca.DM(trajectory.x[0])
    count = divided.intervals
    lengths = [min(NUMERIC_RUN, count - first) for first in range(0, count, NUMERIC_RUN)]
    runs = {length: advance.mapaccum("run", length) for length in set(lengths)}
    pieces = [ca.horzsplit(ca.DM(column), NUMERIC_RUN) for column in common]
    for length, *columns in zip(lengths, *pieces, strict=True):
        value = runs[length](value, *columns)[0][:, -1]
    return np.asarray(ca.DM(value).full()).ravel()


def _divided(mesh: Mesh, u: Array, parts: int) -> tuple[Mesh, Array]:
    """The mesh with each interval in equal parts, and the same controls on it."""
    c, divided = np.arange(parts) / parts, mesh.divided(parts)
    if mesh.control == "constant":
        return divided, np.repeat(u, parts, axis=0)
    between = u[:-1, None, :] + c[None, :, None] * np.diff(u, axis=0)[:, None, :]
    return divided, np.vstack([between.reshape(mesh.intervals * parts, u.shape[1]), u[-1:]])
