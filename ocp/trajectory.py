"""A trajectory at the nodes of a mesh, and the multipliers of what binds it: plain data."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from covocp.matrices import Array
from covocp.mesh import Mesh
from covocp.statement import Statement


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Nominal and matrices at the nodes: x (N+1, nx), u (N+1 or N, nu), e (N+1, ne), terminal time [s]."""

    x: Array
    u: Array
    e: Array
    duration: float


@dataclass(frozen=True, kw_only=True)
class Multipliers:
    """Multipliers of the constraints of a statement, in the units of cost per unit of the constraint.

    final: l of p(T) = k_x + l, shape (nx,); zero where the final state is free. (Where S(T) of an expected cost depends
        on x(T), its part of p(T) comes beside l.)
    final_matrices: the same for the half-vectors, shape (ne,).
    end, start: of the terminal and initial inequalities.
    path: of the path inequalities at the nodes, shape (N + 1, rows).
    states, matrices: of the bounds on states and half-vectors at the nodes, shapes (N + 1, nx), (N + 1, ne).
    controls: of the bounds on the controls, shape (N + 1 or N, nu).
    gaps: of the continuity at the ends of the shooting segments: the costates there, a row for each segment, shape
        (segments, nx) or, where half-vectors are variables, (segments, nx + ne); no row where nothing was shot.

    Multipliers at nodes belong to the discretised problem: divided by the weight of the node in the time integral they
    approximate the densities of the continuous problem.
    """

    final: Array
    final_matrices: Array
    end: Array = field(default_factory=lambda: np.zeros(0))
    start: Array = field(default_factory=lambda: np.zeros(0))
    path: Array = field(default_factory=lambda: np.zeros((0, 0)))
    states: Array = field(default_factory=lambda: np.zeros((0, 0)))
    matrices: Array = field(default_factory=lambda: np.zeros((0, 0)))
    controls: Array = field(default_factory=lambda: np.zeros((0, 0)))
    gaps: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @staticmethod
    def zero(statement: Statement, mesh: Mesh) -> Multipliers:
        """No constraint binds."""
        nodes = mesh.intervals + 1
        return Multipliers(
            final=np.zeros(statement.nx),
            final_matrices=np.zeros(statement.ne),
            end=np.zeros(statement.end.size),
            start=np.zeros(statement.start.size),
            path=np.zeros((nodes, statement.path.size)),
            states=np.zeros((nodes, statement.nx)),
            matrices=np.zeros((nodes, statement.ne)),
            controls=np.zeros((mesh.control_nodes, statement.nu)),
        )
