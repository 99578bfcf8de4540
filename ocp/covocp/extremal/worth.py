"""What there is to gain where a curvature is negative, between the bounds of the controls."""

from __future__ import annotations

import numpy as np

from covocp.extremal.cost_sizes import absolute_cost, variable_cost
from covocp.extremal.curvature import Curvature
from covocp.extremal.extremal import Extremal
from covocp.extremal.metric import mass_matrix

# Share of the cost that is not worth a word: a control that goes from bound to bound between two nodes is between them
# at a node, where the cost is concave in it; along a singular arc, or beside the bound of a state, zigzags of linear
# controls are.
HARDLY = 1e-5
# Share of it by which a mesh may be off: what is off more is told, and no reason to keep silent of a saddle.
OFF = 1e-3
# By how much the square of a direction differs from 1 where all controls count in their own units.
ROUNDOFF = 1e-6


def gain(extremal: Extremal, curvature: Curvature) -> float:
    """The most that the quadratic model falls between the bounds of the controls: 1/2 |curvature| int room' room dt.

    No direction is bent down more than that of the smallest curvature; conditions and bounds of states may leave less.
    Where it moves initial states, or controls that have no bounds, there is no telling where it ends.

    Args:
        extremal: the solution.
        curvature: of it.

    Returns:
        The fall of the cost; inf where it ends nowhere, 0 where the curvature is not negative.
    """
    if not curvature.value < 0:
        return 0.0
    d, u = curvature.direction, extremal.trajectory.u
    lower, upper = extremal.statement.control_bounds
    room = np.where(d != 0, np.maximum(upper - u, u - lower), 0.0)
    if curvature.start.any() or not d.any() or not np.isfinite(room).all():
        return np.inf
    mass = np.asarray(mass_matrix(extremal.mesh, extremal.trajectory.duration, 1).full())
    squares = np.sum(d * (mass @ d), axis=0)
    rooms = np.sum(room * (mass @ room), axis=0)
    moved = squares > 0
    # units of controls that are far apart are not known here: the most that any of them may count for
    own = abs(float(squares.sum()) - 1.0) < ROUNDOFF
    return 0.5 * abs(curvature.value) * float(rooms.sum() if own else (rooms[moved] / squares[moved]).max())


def worth_telling(extremal: Extremal, curvature: Curvature, error: float = 0.0) -> bool:
    """Whether more may be gained where a curvature is negative than anyone cares for.

    Args:
        extremal: the solution.
        curvature: of it.
        error: of the cost, by the mesh and the form of the controls, as a share of it.
    """
    least = max(HARDLY * variable_cost(extremal), min(error, OFF) * absolute_cost(extremal))
    return gain(extremal, curvature) > least
