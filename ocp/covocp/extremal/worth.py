"""What there is to gain along a direction of negative curvature, between the bounds of the controls."""

from __future__ import annotations

import numpy as np

from covocp.extremal.cost_sizes import absolute_cost, variable_cost
from covocp.extremal.curvature import Curvature
from covocp.extremal.extremal import Extremal

# Share of the cost that is not worth a word: a control that goes from bound to bound between two nodes is between them
# at a node, where the cost is concave in it; along a singular arc, or beside the bound of a state, zigzags of linear
# controls are.
HARDLY = 1e-5
# Share of it by which a mesh may be off: what is off more is told, and no reason to keep silent of a saddle.
OFF = 1e-3
# Of a direction, of its square: where bounds stop so much of it, it ends.
STOPPED = 0.5


def gain(extremal: Extremal, curvature: Curvature) -> float:
    """What the quadratic model falls along the direction of the smallest curvature until bounds stop half of it.

    Conditions and bounds of states may stop it sooner: this is the most. Where it moves initial states, or controls
    that have no bounds, there is no telling where it ends.

    Args:
        extremal: the solution.
        curvature: of it.

    Returns:
        The fall of the cost; inf where it ends nowhere, 0 where the curvature is not negative.
    """
    if not curvature.value < 0:
        return 0.0
    d, u = curvature.direction, extremal.trajectory.u
    if curvature.start.any() or not d.any():
        return np.inf
    lower, upper = extremal.statement.control_bounds
    far = []
    for sign in (1.0, -1.0):
        room = np.maximum(np.where(sign * d > 0, upper - u, u - lower), 0.0)
        steps = np.divide(room, np.abs(d), out=np.full(d.shape, np.inf), where=d != 0).ravel()
        order = np.argsort(steps)
        stopped = np.cumsum(d.ravel()[order] ** 2)
        far.append(steps[order][np.searchsorted(stopped, STOPPED * stopped[-1])])
    return float(0.5 * abs(curvature.value) * max(far) ** 2)


def worth_telling(extremal: Extremal, curvature: Curvature, error: float = 0.0) -> bool:
    """Whether more can be gained along a direction of negative curvature than anyone cares for.

    Args:
        extremal: the solution.
        curvature: of it.
        error: of the cost, by the mesh and the form of the controls, as a share of it.
    """
    least = max(HARDLY * variable_cost(extremal), min(error, OFF) * absolute_cost(extremal))
    return gain(extremal, curvature) > least
