"""When a run has left the range of numbers: judged by the state of the plant, from where and how it started."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# So many times what it started with, and the rounding of the start is as large as the start was (1 / eps); nothing is
# known of a run beyond, and nothing counts that is smaller than this in the units given.
GROWTH = 1e15


def farthest(start: Array, pace: Array, duration: float) -> Any:
    """Size of an entry of the plant beyond which a run has diverged; states are (n,) or, of several runs, (n, runs).

    Args:
        start: state at the start.
        pace: its rate there: so a plant may start at zero, in any units.
        duration: of the run, in the unit of time of the pace.
    """
    with np.errstate(all="ignore"):
        sizes = [np.abs(part).max(axis=0, initial=0.0) for part in (start, pace * duration)]
        return GROWTH * np.fmax(1.0, np.fmax(*sizes))


def in_range(state: Array, size: int, limit: Any) -> Any:
    """Whether a run has not diverged: all its entries are numbers, and those of the plant within a limit.

    Args:
        state: whatever the run consists of, the plant first, (total,) or, a column for each run, (total, runs).
        size: number of entries of the plant.
        limit: of `farthest`.
    """
    within = np.abs(state[:size]).max(axis=0, initial=0.0) <= limit
    return within & np.isfinite(state).all(axis=0)
