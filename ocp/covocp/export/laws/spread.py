"""Whether a controller holds in flight what its solution promises: told before anything is written."""

from __future__ import annotations

import numpy as np

from covocp.base.errors import ExportError, warn_user
from covocp.export.laws.moves import WHOLE
from covocp.export.laws.sampled import Samples
from covocp.solution.flight import Flight, compared
from covocp.solution.solution import Solution

# Factor between flown and predicted standard deviations above which nothing is exported, and is worth a warning.
LARGEST_SPREAD = 1.5
NOTICED = 1.05
# Share of the predicted deviation by which the mean may be off the nominal: more makes its root mean square noticed.
LARGEST_LAG = float(np.sqrt(NOTICED**2 - 1.0))
# Share of its largest predicted deviation below which a deviation counts as that: where it passes through a minimum a
# delay of half a period moves it much and costs nothing.
SMALL = 0.1
# The end is what a design is for: there a deviation below this share of the largest counts as that.
SMALL_AT_END = 1e-3


def sampled_flight(solution: Solution, samples: Samples) -> Flight:
    """The loop with its control held between samples, against the continuous one that the solution predicts.

    Only what is more than predicted counts. Between two nodes the curve of what is predicted may lie anywhere between
    their values.
    """
    assert solution.loop is not None
    nodes, predicted = solution.t, solution.loop.X
    after = np.clip(np.searchsorted(nodes, samples.times), 1, nodes.size - 1)
    expected = np.zeros((samples.times.size, *predicted.shape[1:]))
    rows = np.arange(predicted.shape[1])
    variances = np.diagonal(predicted, axis1=1, axis2=2)
    flown = np.diagonal(samples.flown, axis1=1, axis2=2)
    most = np.maximum(variances[after - 1], variances[after])
    expected[:, rows, rows] = np.where(np.isfinite(flown), np.minimum(flown, most), most)
    along = compared(solution, samples.flown, expected, samples.times, SMALL)
    if samples.times[-1] >= nodes[-1] * (1.0 - WHOLE):
        expected[-1, rows, rows] = np.minimum(flown[-1], variances[-1])
    ends = samples.flown[-1:].copy(), expected[-1:].copy()
    for end in ends:
        end[0, rows, rows] = np.maximum(end[0, rows, rows], SMALL_AT_END**2 * variances.max(axis=0))
    at_end = compared(solution, *ends, samples.times[-1:])
    return max(along, at_end, key=lambda flight: flight.worst)


def check_lag(solution: Solution, samples: Samples) -> None:
    """Warn where the mean of the loop, its control held between samples, is off the nominal by more than it spreads."""
    assert solution.loop is not None
    nodes, X = solution.t, solution.loop.X
    variances = np.diagonal(X, axis1=1, axis2=2)
    after = np.clip(np.searchsorted(nodes, samples.times), 1, nodes.size - 1)
    least = np.full(samples.times.shape, SMALL)
    least[samples.times >= nodes[-1] * (1.0 - WHOLE)] = SMALL_AT_END
    floor = least[:, None] ** 2 * variances.max(axis=0)
    expected = np.sqrt(np.maximum(np.maximum(variances[after - 1], variances[after]), floor))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.nan_to_num(np.where(expected > 0.0, np.abs(samples.lag) / expected, 0.0), nan=np.inf)
    k, row = np.unravel_index(int(np.argmax(share)), share.shape)
    if share[k, row] > LARGEST_LAG:
        warn_user(
            f"With its control held over {samples.period:g} s the loop flies beside the nominal: the mean of "
            f"'{solution.augmented[row]}' is off by {samples.lag[k, row]:.4g} at t = {samples.times[k]:.4g} s, where "
            f"its standard deviation is {expected[k, row]:.4g} as predicted; a shorter period= halves it, or more."
        )


def check_flight(flight: Flight, largest: float, period: float | None) -> None:
    """Refuse a loop that flies worse than promised.

    Args:
        flight: of the loop.
        largest: factor between flown and predicted deviations.
        period: of the samples [s]; None: gains between the nodes.

    Raises:
        ExportError: it is exceeded.
    """
    if flight.worst <= NOTICED:
        return
    how = "interpolated between the nodes" if period is None else f"held over {period:g} s"
    remedy = "a mesh that resolves the gains: leave grid= out, or solve with more intervals"
    if period is not None:
        remedy = "a shorter period="
    if flight.worst <= largest:
        warn_user(f"With its gains {how} the loop spreads otherwise than the solution predicts: {flight.words}.")
        return
    raise ExportError(
        f"With its gains {how} this controller does not hold what the solution promises.",
        expected=f"deviations within a factor of {largest:g} of the predicted ones",
        received=flight.words,
        remedy=f"{remedy}; largest_spread= exports it all the same",
    )
