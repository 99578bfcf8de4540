"""A trajectory at the nodes of a mesh, and the multipliers of what binds it: plain data."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Nominal and matrices at the nodes: x (N+1, nx), u (N+1 or N, nu), e (N+1, ne), terminal time [s]."""

    x: Annotated[Array, "nodes x"]
    u: Annotated[Array, "controls u"]
    e: Annotated[Array, "nodes e"]
    duration: float

    __repr__ = short_repr


def between(one: Trajectory, other: Trajectory, share: float) -> Trajectory:
    """What lies at a share of the straight way from one trajectory to another on the same mesh."""

    def at(first: Array, last: Array) -> Array:
        return np.asarray(first + share * (last - first))

    duration = one.duration + share * (other.duration - one.duration)
    return Trajectory(x=at(one.x, other.x), u=at(one.u, other.u), e=at(one.e, other.e), duration=duration)


def at_nodes(u: Array, nodes: int) -> Array:
    """Control values at all nodes; a constant control holds its last value at the last node."""
    return u if u.shape[0] == nodes else np.vstack([u, u[-1:]])


@dataclass(frozen=True, kw_only=True)
class Multipliers:
    """Multipliers of the constraints of a statement, in the units of cost per unit of the constraint.

    final: l of p(T) = k_x + l, shape (nx,); zero where the final state is free. (Where S(T) of an expected cost depends
        on x(T), its part of p(T) comes beside l.)
    final_matrices: the same for the half-vectors, shape (ne,).
    end, start: of the terminal and initial inequalities.
    instants: of the conditions at instants, one instant after the other.
    path: of the path inequalities at the nodes, shape (N + 1, rows).
    inside_path, inside_states: of the path inequalities and the bounds on states at the other points of the intervals
        where they are imposed, shapes (N, points - 1, rows), (N, points - 1, nx).
    states, matrices: of the bounds on states and half-vectors at the nodes, shapes (N + 1, nx), (N + 1, ne). Where a
        phase goes before, the first row of those that run backward has the slopes of its cost by them.
    controls: of the bounds on the controls, shape (N + 1 or N, nu).
    gaps: of the continuity at the ends of the shooting segments: the costates there, a row for each segment, shape
        (segments, nx) or, where half-vectors are variables, (segments, nx + ne); no row where nothing was shot.

    Multipliers at nodes belong to the discretised problem: divided by the weight of the node in the time integral they
    approximate the densities of the continuous problem.
    """

    final: Annotated[Array, "x"]
    final_matrices: Annotated[Array, "e"]
    end: Annotated[Array, "end"] = field(default_factory=lambda: np.zeros(0))
    start: Annotated[Array, "start"] = field(default_factory=lambda: np.zeros(0))
    instants: Annotated[Array, "instants"] = field(default_factory=lambda: np.zeros(0))
    path: Annotated[Array, "nodes path or none"] = field(default_factory=lambda: np.zeros((0, 0)))
    states: Annotated[Array, "nodes x or none"] = field(default_factory=lambda: np.zeros((0, 0)))
    matrices: Annotated[Array, "nodes e or none"] = field(default_factory=lambda: np.zeros((0, 0)))
    controls: Annotated[Array, "controls u or none"] = field(default_factory=lambda: np.zeros((0, 0)))
    gaps: Array = field(default_factory=lambda: np.zeros((0, 0)))
    inside_path: Annotated[Array, "intervals inside path"] = field(default_factory=lambda: np.zeros((0, 0, 0)))
    inside_states: Annotated[Array, "intervals inside x"] = field(default_factory=lambda: np.zeros((0, 0, 0)))

    __repr__ = short_repr

    @staticmethod
    def zero(statement: Statement, mesh: Mesh) -> Multipliers:
        """No constraint binds."""
        nodes = mesh.intervals + 1
        return Multipliers(
            final=np.zeros(statement.nx),
            final_matrices=np.zeros(statement.ne),
            end=np.zeros(statement.end.size),
            start=np.zeros(statement.start.size),
            instants=np.zeros(statement.inside.size),
            path=np.zeros((nodes, statement.path.size)),
            states=np.zeros((nodes, statement.nx)),
            matrices=np.zeros((nodes, statement.ne)),
            controls=np.zeros((mesh.control_nodes, statement.nu)),
            inside_path=np.zeros((mesh.intervals, mesh.points - 1, statement.path.size)),
            inside_states=np.zeros((mesh.intervals, mesh.points - 1, statement.nx)),
        )

    @property
    def path_at_nodes(self) -> Array:
        """Those of the path inequalities, with what acts inside an interval shared between its nodes, (N + 1, rows)."""
        return _shared(self.path, self.inside_path)

    @property
    def states_at_nodes(self) -> Array:
        """The same of the bounds on states, (N + 1, nx)."""
        return _shared(self.states, self.inside_states)


def _shared(nodes: Array, inside: Array) -> Array:
    """Values at nodes, and at equally spread points between them by the lever rule."""
    if not inside.size:
        return nodes
    points = inside.shape[1] + 1
    later = np.arange(1, points)[:, None] / points
    result = nodes.copy()
    result[:-1] += ((1.0 - later) * inside).sum(axis=1)
    result[1:] += (later * inside).sum(axis=1)
    return result
