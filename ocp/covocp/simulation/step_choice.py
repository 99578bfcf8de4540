"""The step of a simulation: halved on a pilot batch until the statistics settle.

The coarse and the fine run of a pair go along the same Brownian paths, the increments of the coarse one being sums of
those of the fine one, so that their difference is the error of the step and not of the sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.simulation.batches import Batch, Cloud, run_batch
from covocp.simulation.plan import make_plan
from covocp.simulation.run_parts import Setting
from covocp.simulation.schedule import Grid

# First step times the fastest rate of filter, loop and plant: Heun's method then errs by 1 % of a variance.
STEP_PER_RATE = 0.2
# The change by halving a step that is allowed, as a share of the sampling error of the whole simulation.
SHARE = 0.2
PILOT_RUNS = 512
# A given step times the fastest rate, at most: Heun's method is stable up to 2.
STABLE = 1.0
# Runs by which a given step is examined where the prediction fails; the change from which on the step is to blame:
# three standard deviations, as the bands have them.
EXAMINED_RUNS, MATTERS = 256, 3.0
PAIRS = 5
# Share of the change of a pair that the next one leaves, at most, from some steps on: else no shorter ones settle it.
FALLEN, PATIENT = 0.7, 10_000
# Scatter of a square as a share of its mean below which it is one number.
SAME = 1e-9
# Steps of a grid that is halved, at most: a filter that is still faster is not resolved, and the halving says so.
MOST_STEPS = 100_000


@dataclass(frozen=True, kw_only=True)
class StepChoice:
    """The step of a simulation and why.

    grid: its steps. longest, shortest: of them [s]. change: largest change of a second moment at the end by halving the
    step, in sampling errors of the whole simulation; NaN where that was not looked at. settled: whether it is small
    enough; stalled: whether it is not, and halving steps that are shorter changes as much. given: whether the user gave
    the step; shortened: whether some are shorter, for what moves faster.
    """

    grid: Grid
    change: float
    settled: bool
    stalled: bool = False
    given: bool = False
    shortened: bool = False

    __repr__ = short_repr

    @property
    def longest(self) -> float:
        """Longest step [s]."""
        return float(self.grid.h.max())

    @property
    def shortest(self) -> float:
        """Shortest step [s]."""
        return float(self.grid.h[self.grid.share == 0].min())

    @property
    def reason(self) -> str:
        """Why this step, a sentence."""
        if np.isinf(self.change):
            return "NOT SETTLED: runs leave the domain, and what is fastest takes shorter steps"
        words = f"halving it changes the terminal second moments by {self.change:.2g} of their sampling error"
        if self.given:
            own = "as given" + (", shorter where loop, filter or model are faster" if self.shortened else "")
            return own if np.isnan(self.change) else f"{own}; {words}"
        if self.settled:
            return words
        return f"NOT SETTLED: {words}" + (
            ", and so it does where steps are shorter: runs that begin alike part, as where an estimate is lost"
            if self.stalled
            else ""
        )


def given_step(base: Grid, step: float, rates: Array) -> StepChoice:
    """Steps of at most the given length, shorter where one would be longer than a time constant, or would not see the
    model change with the time.

    Args:
        base: intervals that the steps divide.
        step: [s].
        rates: fastest rate in each of them [1/s].
    """
    parts = replace(base, seen=np.full(base.steps, np.inf)).parts(step)
    needed = base.parts(STABLE / np.maximum(rates, np.finfo(float).tiny), MOST_STEPS + 1)
    shortened = bool((needed > parts).any())
    parts = np.minimum(np.maximum(parts, needed), np.maximum(parts, MOST_STEPS // base.steps))
    return StepChoice(grid=base.divided(parts), change=np.nan, settled=True, given=True, shortened=shortened)


def examined(
    choice: StepChoice,
    setting: Setting,
    *,
    runs: int,
    seed: int,
    stop: Callable[[], bool],
    cloud: Cloud | None = None,
) -> StepChoice:
    """A given step with the change that halving it makes, on a pilot batch; see `choose_step`."""
    coarse, fine = _pair(setting, choice.grid, choice.grid.divided(2), min(runs, EXAMINED_RUNS), seed, stop, cloud)
    change = _largest_change(coarse, fine, runs)
    return replace(choice, change=change, settled=change <= MATTERS)


def choose_step(
    setting: Setting,
    base: Grid,
    rates: Array,
    *,
    runs: int,
    seed: int,
    stop: Callable[[], bool],
    cloud: Cloud | None = None,
) -> StepChoice:
    """Halve the step until the second moments at the end do not change any more.

    Args:
        setting: what is simulated.
        base: intervals that the steps divide.
        rates: fastest rate in each of them [1/s].
        runs: number of runs of the simulation, for its sampling error.
        seed: of the simulation; the pilot runs have random numbers of their own.
        stop: asked now and then; true to give up.
        cloud: where pilot runs start; None: drawn.

    Returns:
        The coarser step of the first pair that agrees to `SHARE` of the sampling error, else of the last pair: the
        search ends where shorter steps would be too many, or change as much.

    Raises:
        StoppedError: when `stop` said so.
    """
    most = max(1, MOST_STEPS // base.steps)
    parts = base.parts(STEP_PER_RATE / np.maximum(rates, np.finfo(float).tiny), most + 1)
    unresolved = bool((parts > most).any())
    parts = np.minimum(parts, most)
    change, stalled = np.inf, False
    for pair in range(PAIRS):
        grids = base.divided(parts), base.divided(2 * parts)
        coarse, fine = _pair(setting, *grids, min(runs, PILOT_RUNS), seed, stop, cloud)
        before, change = change, _largest_change(coarse, fine, runs)
        if unresolved and np.isfinite(fine.left).any():
            change = np.inf  # they may leave it because of the step, in both
            break
        if change <= SHARE:
            return StepChoice(grid=grids[0], change=change, settled=True)
        stalled = grids[1].steps > PATIENT and change > FALLEN * before
        more = _times(change, most // int(parts.max()))
        if stalled or pair == PAIRS - 1 or more * parts.max() > most:
            break
        parts = parts * more
    return StepChoice(grid=grids[0], change=change, settled=False, stalled=stalled)


def _times(change: float, most: int) -> int:
    """How many times as many steps leave the allowed change, eight times at most, or `most`; twice at least."""
    # An error of second order falls by four with each halving; one or two may be left out.
    needed = np.ceil(np.log(min(change, 1e9) / SHARE) / np.log(4.0))
    wanted = 2 ** int(np.clip(needed, 1, 3))
    return int(max(2, min(wanted, most)))


def _pair(
    setting: Setting,
    coarse: Grid,
    fine: Grid,
    count: int,
    seed: int,
    stop: Callable[[], bool],
    cloud: Cloud | None,
) -> tuple[Batch, Batch]:
    """Pilot runs on a grid, and on one with steps half as long along the same paths."""
    one, two = (
        make_plan(setting, grid, coarse.t[[0, -1]], seed=seed, pilot=True, pairs=grid is coarse)
        for grid in (coarse, fine)
    )
    if cloud is None:
        return run_batch(one, 0, count, stop), run_batch(two, 0, count, stop)
    same = cloud.first(count), cloud.first(count)
    return run_batch(one, 0, count, stop, same[0]), run_batch(two, 0, count, stop, same[1])


def _largest_change(coarse: Batch, fine: Batch, runs: int) -> float:
    """Largest change of a second moment of deviation and estimate, in its sampling error for the number of runs.

    Runs that leave the domain count through their share.
    """
    stayed = np.isinf(coarse.left) & np.isinf(fine.left)
    changes = [0.0]
    if np.count_nonzero(stayed) > 1:
        one, two = (np.hstack([b.deviation, b.estimate])[stayed] ** 2 for b in (coarse, fine))
        error = two.std(axis=0, ddof=1) / np.sqrt(runs)
        # What is the same in all runs but for rounding, such as a state that is known exactly, has no sampling error.
        scattered = error * np.sqrt(runs) > SAME * two.mean(axis=0)
        changes += (np.abs((one - two).mean(axis=0))[scattered] / error[scattered]).tolist()
    gone = [np.isfinite(b.left).mean() for b in (coarse, fine)]
    error = np.sqrt(max(gone[1] * (1 - gone[1]), 1 / fine.runs) / runs)
    changes.append(abs(gone[0] - gone[1]) / error)
    return float(max(changes))
