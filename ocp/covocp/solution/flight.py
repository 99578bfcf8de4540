"""The loop as it flies: with gains that are interpolated between nodes, or held between samples, against the design."""

from __future__ import annotations

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array, pack, standard_deviations
from covocp.extremal.closed_loop import covariances_along, loop_substeps
from covocp.solution.solution import Solution

# A deviation below this share of its largest predicted one counts as that share: what starts known is known.
SMALL = 1e-2
# Share by which gains or deviations change within an interval from which on what lies between its nodes must be flown.
STEEP = 0.2
# Relative difference of a flown deviation from the predicted one above which it is worth a word.
NOTICED = 0.02


@dataclass(frozen=True, kw_only=True)
class Flight:
    """How the deviations of a loop as it flies compare with the predicted ones, where they differ most.

    name: of the entry; time [s]; predicted, flown: its standard deviation there; flown is not finite where the loop
    diverges. worst: the factor between the two, at least 1.
    """

    name: str
    time: float
    predicted: float
    flown: float

    @property
    def worst(self) -> float:
        """The factor between flown and predicted deviation, at least 1; infinite where the loop diverges."""
        if not np.isfinite(self.flown) or min(self.flown, self.predicted) <= 0.0:
            return float("inf") if self.flown != self.predicted else 1.0
        return max(self.flown / self.predicted, self.predicted / self.flown)

    @property
    def words(self) -> str:
        """The comparison in words."""
        if not np.isfinite(self.flown):
            return f"the loop diverges: the deviation of {self.name} is without limit at t = {self.time:.4g} s"
        return (
            f"the standard deviation of {self.name} at t = {self.time:.4g} s is {self.flown:.4g} as flown, "
            f"{self.predicted:.4g} as predicted"
        )


def gains_are_steep(solution: Solution) -> bool:
    """Whether the feedback or the filter of a loop changes much within an interval: cheap, where a flight is not."""
    loop = solution.loop
    assert loop is not None
    feedback = np.linalg.norm(loop.gain * standard_deviations(loop.X).max(axis=0), axis=2)
    return any(_largest_change(values) > STEEP for values in (feedback, standard_deviations(loop.E)))


def _largest_change(values: Array) -> float:
    """Largest change of a column (K, n) from a row to the next, as a share of their sum where that counts."""
    total = np.abs(values[1:]) + np.abs(values[:-1])
    floor = SMALL * np.abs(values).max(axis=0)
    return float((np.abs(np.diff(values, axis=0)) / np.maximum(total, np.maximum(floor, 1e-300))).max(initial=0.0))


def interpolated_flight(solution: Solution) -> Flight:
    """The loop with its gains as they are interpolated between the nodes.

    Args:
        solution: with a loop and its problem.
    """
    assert solution.loop is not None
    start = None if solution.within is None else solution.within.deviations
    flown = covariances_along(solution.extremal, _interpolated(solution), start)
    return compared(solution, flown, solution.loop.X, solution.t)


def compared(solution: Solution, flown: Array, predicted: Array, t: Array, small: float = SMALL) -> Flight:
    """Where flown covariances (K, n, n) differ most from predicted ones, at some times (K,).

    A deviation below the share `small` of its largest predicted one counts as that.
    """
    actual, expected = (standard_deviations(v) for v in (flown, predicted))
    floor = small * expected.max(axis=0)
    actual = np.where(np.isfinite(np.diagonal(flown, axis1=1, axis2=2)), np.maximum(actual, floor), np.inf)
    expected = np.maximum(expected, floor)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(expected > 0.0, np.abs(np.log(actual / expected)), 0.0)
    k, row = np.unravel_index(int(np.argmax(factor)), factor.shape)
    return Flight(
        name=f"'{solution.augmented[row]}'",
        time=float(t[k]),
        predicted=float(expected[k, row]),
        flown=float(actual[k, row]),
    )


def _interpolated(solution: Solution) -> Array:
    """x and half-vectors at equal parts of the intervals, (N, m + 1, size), as `Solution.at` has them."""
    nodes, m = solution.t, loop_substeps(solution.extremal)
    c = np.arange(m + 1) / m
    t = nodes[:-1, None] + np.diff(nodes)[:, None] * c[:-1]
    parts = []
    for times, side in ((t.ravel(), "after"), (nodes[1:], "before")):
        sample = solution.at(times, side)
        states = [sample[b.name].reshape(times.size, b.size) for b in solution.blocks if b.kind == "state"]
        halves = [pack(sample[b.name]) for b in solution.blocks if b.kind == "matrix"]
        parts.append(np.hstack([*states, *halves]))
    inside, ends = parts[0].reshape(*t.shape, -1), parts[1][:, None, :]
    return np.concatenate([inside, ends], axis=1)
