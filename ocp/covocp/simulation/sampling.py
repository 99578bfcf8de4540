"""Sample moments about the nominal and their confidence bands.

Bands of a mean square are those of a chi-square law whose degrees of freedom are those that the sample's kurtosis k
leaves, 2 N/(k - 1) instead of N: a few runs far out make a mean square less certain than normal ones would. For normal
samples k is 3, and the law exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import special

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.simulation.batches import Batch

# Probability within 3 standard deviations of a normal law.
THREE_SIGMA = float(special.erf(3.0 / np.sqrt(2.0)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Moments:
    """Raw moments of y at K times, over the runs inside the domain: deviation, its estimate, that of the control.

    count: (K,); mean, cube, fourth: of the powers of y, (K, rows); product: of y y', (K, rows, rows). NaN where no run
    is left.
    """

    count: Array
    mean: Array
    product: Array
    cube: Array
    fourth: Array

    __repr__ = short_repr


def moments_of(batches: Sequence[Batch]) -> Moments:
    """The moments of all runs, summed by group: the same bits however the groups were spread over batches."""
    count = np.concatenate([b.count for b in batches]).sum(axis=0)

    def mean(name: str) -> Array:
        total = np.concatenate([getattr(b, name) for b in batches]).sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(total / count.reshape(-1, *(1,) * (total.ndim - 1)))

    return Moments(count=count, mean=mean("mean"), product=mean("product"), cube=mean("cube"), fourth=mean("fourth"))


def degrees_of_freedom(count: Given, square: Given, fourth: Given) -> Any:
    """Degrees of freedom of the chi-square law of a mean square, from the mean fourth power."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        kurtosis = fourth / np.square(square)
        kurtosis = np.where(np.isfinite(kurtosis), kurtosis, 3.0)
        return np.minimum(count, 2.0 * count / np.maximum(kurtosis - 1.0, np.finfo(float).tiny))


def mean_square_band(square: Given, freedom: Given, level: float) -> tuple[Any, Any]:
    """Confidence band of a mean square, (low, high) of the shape of `square`."""
    tail = (1.0 - level) / 2.0
    with np.errstate(invalid="ignore", divide="ignore"):
        low = square * freedom / (2.0 * special.gammainccinv(freedom / 2.0, tail))
        high = square * freedom / (2.0 * special.gammaincinv(freedom / 2.0, tail))
    return low, high


def mean_band(mean: Given, variance: Given, count: Given, level: float) -> tuple[Any, Any]:
    """Confidence band of a mean by Student's law: the deviation is that of the same few runs.

    Args:
        mean: of the sample.
        variance: mean square about it, divided by the number of runs.
        count: of the runs; below two the band is infinite.
        level: probability of the band.
    """
    freedom = np.maximum(np.asarray(count, dtype=float) - 1.0, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.sqrt(np.maximum(variance, 0.0) / freedom)
        width = np.where(freedom > 0, special.stdtrit(freedom, (1.0 + level) / 2.0) * error, np.inf)
    return mean - width, mean + width


def share_band(count: Given, runs: int, level: float) -> tuple[Any, Any]:
    """Confidence band of a probability of which `count` of some runs were hit, exact (Clopper and Pearson)."""
    hits, tail = np.asarray(count, dtype=float), (1.0 - level) / 2.0
    low = np.where(hits > 0, special.betaincinv(np.maximum(hits, 1.0), runs - hits + 1.0, tail), 0.0)
    high = np.where(hits < runs, special.betaincinv(hits + 1.0, np.maximum(runs - hits, 1.0), 1.0 - tail), 1.0)
    return low, high


def robust_deviation(values: Array) -> Array:
    """Standard deviation of the normal law with the same median absolute deviation from the nominal, by column."""
    return np.asarray(np.median(np.abs(values), axis=0) / special.ndtri(0.75))
