"""The normal law: quantiles, and how far a normal number may be off the middle of two limits that it has to keep.

A number y + s z, z standard normal, is inside c - w .. c + w with at least the probability p where d = |y - c| obeys

    d^2 <= s^2 U(w/s),

U(h) = (h - k)^2 with the k between q1 and q2 at which the two tails make 1 - p: T(k) + T(2 h - k) = 1 - p. Here q1 and
q2 are the quantiles of one and of two equal tails. U is smooth, rises through zero at h = q2, below which no middle is
good enough, and is (h - q1)^2 but for a rest that vanishes as exp(-2 h (h - q1)): that rest is a Chebyshev sum.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr

# The rest of U is left out where it is smaller than exp(-this), relative to its largest value.
VANISHED = 38.0
# Terms of the sum at most, and the relative size of the first one that is left out.
TERMS, ROUNDOFF = 80, 1e-14
BISECTIONS = 120


def tail(x: float) -> float:
    """Probability that a standard normal number is larger than x."""
    return 0.5 * math.erfc(x / math.sqrt(2.0))


def quantile(probability: float) -> float:
    """The number that a standard normal one stays below with this probability, exact also close to one."""
    return -_below(1.0 - probability) if probability > 0.5 else _below(probability)


def _below(share: float) -> float:
    """The number that a standard normal one stays below with this probability."""
    from statistics import NormalDist  # here: few problems ask for it, and it takes as long as many modules of covocp

    return NormalDist().inv_cdf(share)


def inside(y: Array, s: Array, lower: Array | float, upper: Array | float) -> Array:
    """Probability that y + s z is between two limits, which may be infinite; where s is zero: whether y is."""
    y, s = (np.asarray(v, dtype=float) for v in np.broadcast_arrays(y, s))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        above, below = (upper - y) / s, (y - lower) / s
    share = 1.0 - _tails(above) - _tails(below)
    return np.where(s > 0, np.clip(share, 0.0, 1.0), ((y >= lower) & (y <= upper)).astype(float))


def shown_probability(value: float) -> str:
    """A probability as a number, with as many digits as tell it from one."""
    if value <= 0.0 or value >= 1.0:
        return f"{value:g}"
    digits = max(6, 3 - math.floor(math.log10(1.0 - value)))
    return f"{value:.{digits}g}" if 1.0 - value > 1e-15 else "1"


_tails = np.vectorize(tail, otypes=[float])


def margin(y: Array, s: Array, lower: float, upper: float, probability: float) -> Array:
    """By how much each limit could be drawn in until y + s z is inside with just this probability; negative: by
    how much they would have to be moved apart."""
    y, s = (np.asarray(v, dtype=float) for v in np.broadcast_arrays(y, s))
    one = quantile(probability)
    if not np.isfinite(lower):
        return np.asarray(upper - y - one * s)
    if not np.isfinite(upper):
        return np.asarray(y - lower - one * s)
    d = np.abs(y - 0.5 * (lower + upper))
    # The width that is needed is between those of one tail and of two tails that are equal at the nearer limit.
    low, high = np.maximum(d + one * s, 0.0), d - _below(0.5 * (1.0 - probability)) * s
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        with np.errstate(divide="ignore", invalid="ignore"):
            outside = np.where(s > 0, _tails((middle - d) / s) + _tails((middle + d) / s), 0.0)
        short = outside > 1.0 - probability
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return np.asarray(0.5 * (upper - lower) - 0.5 * (low + high))


@dataclass(frozen=True, kw_only=True, eq=False)
class TwoSided:
    """U of one probability: both quantiles, the end of the rest's range, its Chebyshev sum, and the slope at q2."""

    one: float
    two: float
    top: float
    sum: Array
    slope: float

    __repr__ = short_repr

    def room(self, y: Expr, s: Expr, lower: float, upper: float) -> Any:
        """What is not negative where y + s z is inside with the probability; in the unit of y near the limits.

        Args:
            y: the middle of the normal number, an expression.
            s: its standard deviation, positive.
            lower: lower limit.
            upper: upper limit, larger.
        """
        w, d = 0.5 * (upper - lower), y - 0.5 * (upper + lower)
        h = ca.fmax(ca.fmin(w / s, self.top), self.two)
        straight = ca.fmax(w - self.one * s, (self.two - self.one) * s)
        beyond = self.slope * s * ca.fmin(w - self.two * s, 0.0)
        return (straight**2 + s**2 * self._rest(h) + beyond - d**2) / (2.0 * w)

    def _rest(self, h: Expr) -> Any:
        """The Chebyshev sum, by Clenshaw's recurrence."""
        x: Any = (2.0 * h - self.two - self.top) / (self.top - self.two)
        one: Any = 0.0
        two: Any = 0.0
        for coefficient in self.sum[:0:-1].tolist():
            one, two = 2.0 * x * one - two + coefficient, one
        return x * one - two + float(self.sum[0])


@lru_cache(maxsize=64)
def two_sided(probability: float) -> TwoSided:
    """The function U of a probability."""
    one, two = quantile(probability), -_below(0.5 * (1.0 - probability))
    top = max(0.5 * (one + math.sqrt(one**2 + 2.0 * VANISHED)), two + 1.0)
    points = np.cos(np.pi * (np.arange(TERMS) + 0.5) / TERMS)
    values = np.array([_rest(probability, one, 0.5 * (two + top + x * (top - two))) for x in points])
    values -= (1.0 + points) / 2.0 * _rest(probability, one, top)  # joined to zero at the end
    coefficients = np.polynomial.chebyshev.chebfit(points, values, TERMS - 1)
    kept = np.flatnonzero(np.abs(coefficients) > ROUNDOFF * np.abs(coefficients).max())
    coefficients = coefficients[: kept[-1] + 1]
    by_x = np.polynomial.chebyshev.chebval(-1.0, np.polynomial.chebyshev.chebder(coefficients))
    slope = float(by_x) * 2.0 / (top - two) + 2.0 * (two - one)
    return TwoSided(one=one, two=two, top=top, sum=coefficients, slope=slope)


def _rest(probability: float, one: float, h: float) -> float:
    """U(h) - (h - q1)^2."""
    low, high = one, h
    for _ in range(BISECTIONS):
        k = 0.5 * (low + high)
        low, high = (k, high) if tail(k) + tail(2.0 * h - k) > 1.0 - probability else (low, k)
    k = 0.5 * (low + high)
    return (one - k) * (2.0 * h - one - k)
