"""Controls that change faster than the nodes can say, and what their piecewise-linear form costs then."""

from __future__ import annotations

import numpy as np

from covocp.extremal.extremal import Extremal
from covocp.extremal.links import Within
from covocp.extremal.path_limits import acting_nodes
from covocp.transcription.scales import choose_scales

# Share of its range by which a control turns away from a straight line in an interval, above which it is asked what
# that costs: one that falls with a time constant of one and a half intervals does, and pays 2e-4.
STEEP = 0.25
# Entries of the matrices above which it is not asked: the answer takes as much memory as the solution, beside it.
MOST_ENTRIES = 2000
# Share of its magnitude within which a control does nothing.
NOTHING = 1e-4


def cost_of_form(extremal: Extremal, least: float, within: Within | None = None) -> float | None:
    """Estimated relative cost of the piecewise-linear form of controls that turn within few intervals.

    Of controls that are held constant over the intervals nothing is said: so is what holds them. Where a limit along
    the path acts H_u is no measure; what the others cost is known all the same. What is worth telling by H_u is
    measured on a finer mesh: a large estimate is crude, and so is one of controls in which H is not convex, as of those
    that switch. Beside matrices that takes long, and these controls alone are measured.

    Args:
        extremal: the solution.
        least: what is worth telling.
        within: what the rest of a chain says of it.

    Returns:
        As `Optimality.control_error`, where no limit acts; None where the controls are smooth, where it is no more than
        the least, or where nothing is known, as beside matrices of more than 2000 entries.
    """
    st = extremal.statement
    if not st.nu or st.ne > MOST_ENTRIES or extremal.mesh.control != "linear" or not are_steep(extremal):
        return None
    from covocp.extremal.control_error import estimate_control_error, kinds_of
    from covocp.extremal.cost_sizes import ZERO_COST, absolute_cost
    from covocp.extremal.finer_cost import change_on_finer_mesh
    from covocp.extremal.optimality import duality_gap

    kinds, at = kinds_of(extremal), acting_nodes(extremal)
    held = (at[:-1] | at[1:]).reshape(extremal.mesh.intervals, -1).any(axis=1, keepdims=True)  # by a limit
    size = max(absolute_cost(extremal) + (0.0 if within is None else within.size), duality_gap(extremal))
    given = extremal, (kinds.free & ~held, kinds.bounded & ~held), size
    found = estimate_control_error(*given) if size > ZERO_COST else None
    if found is None or not found > least:
        return None
    convex = estimate_control_error(*given, convex_alone=True)
    sure = found if convex is not None and convex > least else None
    if st.ne and sure is not None:
        return sure
    measured = change_on_finer_mesh(extremal, size, within)
    return sure if measured is None else measured if measured > least else None


def are_steep(extremal: Extremal) -> bool:
    """Whether a control leaves a straight line within an interval by much of its range; what hardly moves does not."""
    u, h = extremal.controls, np.diff(extremal.time)
    long = h > 0.0  # what is read at an instant has an interval of no length, where controls jump
    slopes = np.diff(u, axis=0) / np.where(long, h, 1.0)[:, None]
    between = np.where(long[1:] & long[:-1], np.minimum(h[1:], h[:-1]), 0.0)
    turned = (np.abs(np.diff(slopes, axis=0)) * between[:, None]).max(axis=0, initial=0.0)
    span = np.ptp(u, axis=0)
    steep = turned > STEEP * span
    if not steep.any():
        return False
    units = choose_scales(extremal.statement, extremal.mesh, extremal.trajectory, extremal.parameters).u
    return bool((steep & (span > NOTHING * units)).any())
