"""The step of a simulation: halved on a pilot batch until the statistics settle.

The coarse and the fine run of a pair go along the same Brownian paths, the increments of the coarse one being sums of
those of the fine one, so that their difference is the error of the step and not of the sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from covocp.matrices import Array
from covocp.simulation.batches import Batch, run_batch
from covocp.simulation.plan import make_plan
from covocp.simulation.run_step import Setting
from covocp.simulation.schedule import Grid

# First step times the fastest rate of filter, loop and plant: Heun's method then errs by 1 % of a variance.
STEP_PER_RATE = 0.2
# The change by halving a step that is allowed, as a share of the sampling error of the whole simulation.
SHARE = 0.2
PILOT_RUNS = 512
PAIRS = 5
# Steps of a first grid, at most: a filter that is still faster is not resolved, and the halving says so.
MOST_STEPS = 100_000


@dataclass(frozen=True, kw_only=True)
class StepChoice:
    """The step of a simulation and why.

    grid: its steps. longest, shortest: of them [s]. change: largest change of a second moment at the end by halving the
    step, in sampling errors of the whole simulation; NaN for a given step. settled: whether it is small enough.
    """

    grid: Grid
    change: float
    settled: bool

    @property
    def longest(self) -> float:
        """Longest step [s]."""
        return float(self.grid.h.max())

    @property
    def shortest(self) -> float:
        """Shortest step [s]."""
        return float(self.grid.h.min())

    @property
    def given(self) -> bool:
        """Whether the user gave it."""
        return bool(np.isnan(self.change))

    @property
    def reason(self) -> str:
        """Why this step, a sentence."""
        if self.given:
            return "as given"
        words = f"halving it changes the terminal second moments by {self.change:.2g} of their sampling error"
        return words if self.settled else f"NOT SETTLED: {words}"


def given_step(base: Grid, step: float) -> StepChoice:
    """Steps of at most the given length."""
    return StepChoice(grid=base.divided(base.parts(step)), change=np.nan, settled=True)


def choose_step(
    setting: Setting, base: Grid, rates: Array, *, runs: int, seed: int, stop: Callable[[], bool]
) -> StepChoice:
    """Halve the step until the second moments at the end do not change any more.

    Args:
        setting: what is simulated.
        base: intervals that the steps divide.
        rates: fastest rate in each of them [1/s].
        runs: number of runs of the simulation, for its sampling error.
        seed: of the simulation; the pilot runs have random numbers of their own.
        stop: asked now and then; true to give up.

    Returns:
        The coarser step of the first pair that agrees to `SHARE` of the sampling error; the finest one otherwise.

    Raises:
        StoppedError: when `stop` said so.
    """
    parts = base.parts(STEP_PER_RATE / np.maximum(rates, np.finfo(float).tiny))
    parts = np.minimum(parts, max(1, MOST_STEPS // base.steps))
    count = min(runs, PILOT_RUNS)
    change = np.inf
    for _ in range(PAIRS):
        coarse, fine = (
            run_batch(
                make_plan(setting, base.divided(p), base.t[[0, -1]], seed=seed, pilot=True, pairs=p is parts),
                0,
                count,
                stop,
            )
            for p in (parts, 2 * parts)
        )
        change = _largest_change(coarse, fine, runs)
        if change <= SHARE:
            return StepChoice(grid=base.divided(parts), change=change, settled=True)
        # An error of second order falls by four with each halving; one or two may be left out.
        needed = np.ceil(np.log(min(change, 1e9) / SHARE) / np.log(4.0))
        parts = parts * 2 ** int(np.clip(needed, 1, 3))
    return StepChoice(grid=base.divided(parts), change=change, settled=False)


def _largest_change(coarse: Batch, fine: Batch, runs: int) -> float:
    """Largest change of a second moment of deviation and estimate, in its sampling error for the number of runs.

    Runs that leave the domain count through their share.
    """
    stayed = np.isinf(coarse.left) & np.isinf(fine.left)
    changes = [0.0]
    if np.count_nonzero(stayed) > 1:
        one, two = (np.hstack([b.deviation, b.estimate])[stayed] ** 2 for b in (coarse, fine))
        error = two.std(axis=0, ddof=1) / np.sqrt(runs)
        scattered = error > 0
        changes += (np.abs((one - two).mean(axis=0))[scattered] / error[scattered]).tolist()
    gone = [np.isfinite(b.left).mean() for b in (coarse, fine)]
    error = np.sqrt(max(gone[1] * (1 - gone[1]), 1 / fine.runs) / runs)
    changes.append(abs(gone[0] - gone[1]) / error)
    return float(max(changes))
