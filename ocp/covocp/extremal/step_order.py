"""What shorter steps change: whether they close in as they do where nothing jumps, and how far states move."""

from __future__ import annotations

import numpy as np

from covocp.extremal.extremal import Extremal
from covocp.extremal.links import Within
from covocp.extremal.mesh_error import by_segments, changes_by_parts, parted

# Parts of a step, each half as long as that before, and the share of the change by one of them that the next one may
# make where nothing jumps: steps of fourth order make a sixteenth, and a rate that jumps a sixth or more.
PARTS, SHARE = (2, 4, 8), 0.1


def is_smooth(extremal: Extremal, within: Within | None = None) -> bool:
    """Whether nothing jumps within the steps: what halving them changes is by far less with each further time.

    Args:
        extremal: the trajectory.
        within: what the rest of a chain says of it.
    """
    running = parted(extremal, 1).running
    with np.errstate(over="ignore", invalid="ignore"):
        found = np.array([changes_by_parts(extremal, running, parts, within) for parts in PARTS])
        steps = np.abs(np.diff(np.vstack([np.zeros(found.shape[1]), found]), axis=0))[:, [0, 2]]  # of cost and states
        return bool((steps[1:] <= SHARE * steps[:-1]).all())


def moved_by_halves(extremal: Extremal) -> float:
    """Largest change of a state by halving the steps, in its range; inf where something is not finite with them."""
    finer, nx = parted(extremal, 2), extremal.statement.nx
    if not all(np.isfinite(v).all() for v in (finer.jumps, finer.states, finer.matrices, finer.running)):
        return float("inf")
    moved, size = by_segments(extremal, 0.0)
    with np.errstate(all="ignore"):
        shares = np.where(moved[:nx] > 0.0, moved[:nx] / size[:nx], 0.0)
    return float(np.where(np.isnan(shares), np.inf, shares).max(initial=0.0))
