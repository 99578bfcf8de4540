"""Steps of runs with noise that see how a law changes with the time: these have no error to tell that they do not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import warn_user
from covocp.base.matrices import Array
from covocp.extremal.dense_output import mapped
from covocp.simulation.unseen import PLACES, turning

# A law is looked at in so many steps on end, in so many such windows at most, and the steps are divided once more.
WINDOW, WINDOWS, MARGIN = 2.0, 1024, 2
# Steps that a law may ask for, at most.
MOST_STEPS = 1_000_000
# Where a step that has no value is looked at, from its start, in its length.
AHEAD = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)


def seeing_steps(control: ca.Function, start: Array, times: Array, steps: int) -> int:
    """Steps between two of the equally spread times, so many that a law does not turn twice in one; warns if too many.

    Args:
        control: (state, t) -> u.
        start: state of the loop; the law is looked at there and beside it, all but the time held.
        times: (K,) [s].
        steps: as given.
    """
    if not control.jac_sparsity(0, 1).nnz():
        return steps
    beside = start + np.maximum(1.0, np.abs(start)) * (np.resize(PLACES, start.shape) - 0.5)
    most, given = max(steps, MOST_STEPS // (times.size - 1)), steps
    while (blind := _turns(control, (start, beside), times, steps)) and MARGIN * steps <= most:
        steps *= 2
    if blind:
        warn_user(
            f"The law changes with the time faster than steps of {times[1] / steps:.2g} s see: runs with noise may "
            "take one place of its period for all. Put its mean in its place, or give step=, below a quarter of it."
        )
    return steps if steps == given or blind else steps * MARGIN


class Lost:
    """Runs that become NaN or inf within one step, though they were in the range of numbers before it."""

    def __init__(self, runs: int) -> None:
        """None is lost yet."""
        self.lost = np.zeros(runs, dtype=bool)
        self.time, self.state = np.nan, np.zeros(0)

    @property
    def count(self) -> int:
        """How many."""
        return int(self.lost.sum())

    def look(self, gone: Any, time: float, before: Array) -> None:
        """Note who is lost in a step, (runs,), and of the first where it began: its time and states (total, runs)."""
        if gone.any():
            if not self.lost.any():
                self.time, self.state = time, before[:, int(np.argmax(gone))]
            self.lost |= gone

    def ahead(self, rate: Callable[[Array, float], Array], h: float) -> Iterator[tuple[Array, float]]:
        """States on the way of the first one, without noise, at which its rate has no value."""
        moved = np.nan_to_num(h * rate(self.state, self.time), nan=0.0, posinf=0.0, neginf=0.0)
        for c in AHEAD:
            state, time = self.state + c * moved, self.time + min(c, 1.0) * h
            if not np.isfinite(rate(state, time)).all():
                yield state, time


def _turns(control: ca.Function, states: Any, times: Array, steps: int) -> bool:
    """Whether a law turns twice in two steps, at one of the states held."""
    h, count = times[1] / steps, steps * (times.size - 1)
    window = min(WINDOW * h, float(times[-1]))
    chosen = np.unique(np.linspace(0, count - 1, min(count, WINDOWS)).astype(int))
    at = np.minimum(chosen * h, times[-1] - window)[:, None] + window * PLACES
    for state in states:
        columns = np.tile(state[:, None], (1, at.size)), at.reshape(1, -1)
        if turning(mapped(control, *columns)[0].T.reshape(*at.shape, -1)).any():
            return True
    return False
