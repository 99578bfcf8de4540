"""Steps of runs with noise that see how a law changes with the time, and how fast the loop is.

These runs have no error to tell that they do not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import warn_user
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.quadrature import classical_step
from covocp.extremal.dense_output import mapped
from covocp.simulation.unseen import PLACES, turning
from covocp.simulation.vectorised import Columns

# A law is looked at in so many steps on end, in so many such windows at most, and the steps are divided once more.
WINDOW, WINDOWS, MARGIN = 2.0, 1024, 2
# Steps that a law may ask for, at most.
MOST_STEPS = 1_000_000
# Length of a step times the fastest rate of the loop: noise that is held over it leaves a mode's variance 0.33 % too
# small, by (tanh x) / x of half of that; classical Runge-Kutta errs by less, and is stable up to 2.78.
RESOLVED, STABLE = 0.2, 2.78
# The loop is looked at in so many of the runs, again after so many steps: an extended filter may be fast at first.
LOOKED, AGAIN = 4, 8
# Steps that are spent on what is too fast for the whole time, as it may die out.
OF_TRANSIENTS = 20_000
# Share of a step that its first and last slopes keep from its ends, where a law may jump.
WITHIN = 1e-9
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


def on_columns(function: Columns, state: Array, t: float | tuple[float, float], *shocks: Array) -> Array:
    """Values of a vectorised function of columns, with the time (and the length of the step) in common.

    Args:
        function: made ready; its second input is shared by all columns.
        state: a column for each run, (total, runs).
        t: time, or time and length of the step [s].
        shocks: further inputs, a column for each run.

    Returns:
        Its first output, a column for each run.
    """
    count = state.shape[1]
    function.inputs[1][:] = t
    for memory, given in zip((function.inputs[0], *function.inputs[2:]), (state, *shocks), strict=True):
        memory[:, :count] = given
    with np.errstate(all="ignore"):  # runs that diverge
        function.evaluate()
    return np.array(function.outputs[0][:, :count])


def held_noise_step(rate: ca.Function) -> Callable[..., Any]:
    """One classical step with the noise held; at its ends a law that jumps there has the value that it has within.

    Args:
        rate: (state of the loop, t, process noise, measurement noise) -> its rate.

    Returns:
        (state, [t, length of the step], process noise, measurement noise) -> state after the step.
    """

    def advance(state: Given, at: Given, process: Given, measurement: Given) -> Any:
        t, h = at[0], at[1]

        def slope(value: Given, c: float) -> Any:
            within = min(max(c, WITHIN), 1.0 - WITHIN)
            return rate(value, t + within * h, process, measurement)

        return classical_step(slope, state, h)

    return advance


class Pace:
    """Lengths of steps by how fast the loop is where some of the runs are."""

    def __init__(self, rate: ca.Function, times: Array, step: float) -> None:
        """Nothing has been looked at yet.

        Args:
            rate: (state of the loop, t, ...) -> its rate, the cost last.
            times: (K,) [s].
            step: longest one [s].
        """
        symbols: list[Any] = [ca.SX.sym(f"i{i}", rate.size1_in(i)) for i in range(rate.n_in())]
        dynamic = rate.size1_out(0) - 1
        slope = ca.densify(ca.jacobian(rate(*symbols)[:dynamic], symbols[0])[:, :dynamic])
        self._slope = ca.Function("slope", symbols, [slope])
        self._rest = [np.zeros(rate.size1_in(i)) for i in range(2, rate.n_in())]
        self._step = step
        self._all = self._left = max(MOST_STEPS, 2 * int(np.ceil(times[-1] / step)))
        self._end = float(times[-1])
        self.missed, self.rate = 0.0, 0.0

    def steps(self, state: Array, time: float, end: float) -> tuple[float, int]:
        """Length of the next steps from a time on, and how many of them to take before it is asked again.

        Args:
            state: of the loop, a column for each run.
            time: where they begin [s].
            end: where one of them has to end [s].
        """
        fastest = self._fastest(state, time)
        wanted = min(self._step, RESOLVED / fastest) if fastest > 0.0 else self._step
        length = self._affordable(wanted, fastest, self._end - time)
        if length * fastest > max(self.missed, (1.0 + 1e-9) * RESOLVED):
            self.missed, self.rate = length * fastest, fastest
        count = max(1, int(np.ceil((end - time) / length * (1.0 - 1e-12))))
        taken = min(count, AGAIN)
        self._left -= taken
        return (end - time) / count, taken

    def _affordable(self, wanted: float, fastest: float, rest: float) -> float:
        """A length that leaves steps for the rest, or is for what may die out; the given one if none does."""
        if rest <= wanted * max(self._left, 1) or self._left > self._all - OF_TRANSIENTS:
            return wanted
        even = rest / max(self._left, 1)
        return even if even * fastest < STABLE else self._step

    def _fastest(self, state: Array, time: float) -> float:
        """Largest magnitude of an eigenvalue of the loop in some of the runs [1/s]; 0 where none has a value."""
        known = np.flatnonzero(np.isfinite(state).all(axis=0))
        if not known.size:
            return 0.0
        chosen = known[np.unique(np.linspace(0, known.size - 1, LOOKED).astype(int))]
        with np.errstate(all="ignore"):
            found = [self._slope(state[:, run], time, *self._rest).full() for run in chosen]
            found = [slope for slope in found if np.isfinite(slope).all()]
            return float(np.abs(np.linalg.eigvals(found)).max()) if found else 0.0

    def tell(self) -> None:
        """Warn where the steps were too long for the loop, as shorter ones would have been too many."""
        if not self.missed:
            return
        length = self.missed / self.rate
        wrong = (
            "variances of what is so fast come out too small"
            if self.missed < STABLE
            else "what is so fast grows without end, which the loop itself need not do"
        )
        warn_user(
            f"The loop has rates of {self.rate:.2g} per s, for which runs with noise would take more than "
            f"{MOST_STEPS:g} steps; they are {length:.2g} s long, and {wrong}. Simulate a shorter duration, or leave "
            "out what is so fast."
        )


class Lost:
    """Runs that become NaN or inf within one step, though they were in the range of numbers before it."""

    def __init__(self, runs: int) -> None:
        """None is lost yet."""
        self.lost = np.zeros(runs, dtype=bool)
        self.time, self.state, self.length = np.nan, np.zeros(0), 0.0

    @property
    def count(self) -> int:
        """How many."""
        return int(self.lost.sum())

    def look(self, gone: Any, time: float, before: Array, length: float) -> None:
        """Note who is lost in a step, (runs,), and of the first where it began: time, states (total, runs), length."""
        if gone.any():
            if not self.lost.any():
                self.time, self.state, self.length = time, before[:, int(np.argmax(gone))], length
            self.lost |= gone

    def ahead(self, rate: Callable[[Array, float], Array]) -> Iterator[tuple[Array, float]]:
        """States on the way of the first one, without noise, at which its rate has no value."""
        h = self.length
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
