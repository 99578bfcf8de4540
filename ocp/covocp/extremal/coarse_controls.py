"""Controls that turn faster than the nodes can say, and what their piecewise-linear form costs then."""

from __future__ import annotations

import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal
from covocp.extremal.links import Within
from covocp.extremal.path_limits import acting_nodes

# Share of its range by which a control turns away from a straight line in an interval, above which it is asked what
# that costs: one that falls with a time constant of two intervals does, and pays 1e-3.
STEEP = 0.15


def cost_of_form(extremal: Extremal, within: Within | None = None) -> float | None:
    """Estimated relative cost of the piecewise-linear form of controls that turn within few intervals.

    Of controls that are held constant over the intervals nothing is said: so is what holds them. Where a limit along
    the path acts H_u is no measure; what the others cost is known all the same.

    Args:
        extremal: the solution.
        within: what the rest of a chain says of it.

    Returns:
        As `Optimality.control_error`, where no limit acts; None where the controls are smooth, or nothing is known.
    """
    st = extremal.statement
    if not st.nu or extremal.mesh.control != "linear" or not are_steep(extremal):
        return None
    from covocp.extremal.control_error import estimate_control_error, kinds_of
    from covocp.extremal.cost_sizes import absolute_cost
    from covocp.extremal.optimality import duality_gap

    kinds = kinds_of(extremal)
    at = acting_nodes(extremal)
    points = extremal.mesh.points
    held = np.add.reduceat(at[:-1] | at[1:], np.arange(0, at.size - 1, points)).astype(bool)[:, None]
    others = 0.0 if within is None else within.size
    size = max(absolute_cost(extremal) + others, duality_gap(extremal))
    return estimate_control_error(extremal, (kinds.free & ~held, kinds.bounded & ~held), size)


def are_steep(extremal: Extremal) -> bool:
    """Whether a control leaves a straight line within an interval by much of its range."""
    return bool((_turning(extremal) > STEEP).any())


def _turning(extremal: Extremal) -> Array:
    """By how much each control leaves a straight line within an interval, at most, in its range."""
    u, h = extremal.controls, np.diff(extremal.time)
    long = h > 0.0  # what is read at an instant has an interval of no length, where controls jump
    slopes = np.diff(u, axis=0) / np.where(long, h, 1.0)[:, None]
    between = np.where(long[1:] & long[:-1], np.minimum(h[1:], h[:-1]), 0.0)
    turned = np.abs(np.diff(slopes, axis=0)) * between[:, None]
    return np.asarray(turned.max(axis=0, initial=0.0) / np.maximum(np.ptp(u, axis=0), np.finfo(float).tiny))
