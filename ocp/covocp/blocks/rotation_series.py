"""Coefficients of rotations, functions of the squared angle that are smooth at zero, section 2.

Each is its series near zero and its closed form elsewhere. Both are evaluated at an argument that is clamped to where
they hold: the branch that is not taken, and its derivatives, are finite, so those of the whole are exact, in SX and MX.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from math import comb, factorial, prod
from typing import Any

import numpy as np

from covocp.base.expressions import Expr
from covocp.blocks.rotation_entries import library, select

# Squared angle up to which the series in it are taken, and the distance of the cosine from one for that of g.
SERIES = 1.0
COSINE_SERIES = 0.12
# Terms that make the series and their second derivatives exact to double precision there: what is left out of the
# second derivative of A is below 90/21!, of E 132 * 2/(2 pi)^26, of g 306 * 0.06^18/0.12^2.
TERMS, COTANGENT_TERMS, COSINE_TERMS = 10, 12, 18
# Cosine below which the logarithm is taken from the symmetric part, rotations by more than 2.69 rad: g loses digits as
# 1/sin^2 towards half a turn.
HALF_TURN = -0.9


def _bernoulli(count: int) -> list[Fraction]:
    """B_0, B_1, ..., by their recursion."""
    numbers = [Fraction(1)]
    for n in range(1, count):
        numbers.append(-sum((comb(n + 1, k) * numbers[k] for k in range(n)), Fraction(0)) / (n + 1))
    return numbers


def _factorials(first: int) -> list[float]:
    return [(-1.0) ** k / factorial(2 * k + first) for k in range(TERMS)]


_A, _B, _D = (_factorials(first) for first in (1, 2, 3))
_E = [
    float(abs(number) / factorial(2 * k)) for k, number in enumerate(_bernoulli(2 * COTANGENT_TERMS + 1)[::2]) if k > 0
]
_G = [factorial(k) / prod(range(1, 2 * k + 2, 2)) for k in range(COSINE_TERMS)]


def sine(x: Expr) -> Any:
    """A = sin t / t of the squared angle x = t^2."""
    if isinstance(x, (np.ndarray, np.floating)):
        angle = np.sqrt(x)
        return np.sin(angle) / np.where(angle > 0, angle, 1) + (angle == 0)
    return _smooth(x, _A, lambda t, y: library(t).sin(t) / t)


def versine(x: Expr) -> Any:
    """B = (1 - cos t) / t^2 of the squared angle x = t^2."""
    half = sine(0.25 * x) if isinstance(x, (np.ndarray, np.floating)) else None
    if half is not None:
        return 0.5 * half * half
    return _smooth(x, _B, lambda t, y: 2 * library(t).sin(0.5 * t) ** 2 / y)


def sine_remainder(x: Expr) -> Any:
    """D = (t - sin t) / t^3 of the squared angle x = t^2."""
    return _smooth(x, _D, lambda t, y: (t - library(t).sin(t)) / (t * y))


def cotangent_remainder(x: Expr) -> Any:
    """E = (1 - (t/2) cot(t/2)) / t^2 of the squared angle x = t^2; infinite at a full turn."""
    return _smooth(x, _E, lambda t, y: (1 - 0.5 * t / library(t).tan(0.5 * t)) / y)


def angle_over_sine(c: Expr) -> Any:
    """g = t / sin t of the cosine c of the angle, at cosines above HALF_TURN; what comes back below is finite."""
    near, far = 1 - c < COSINE_SERIES, c < HALF_TURN
    series = _horner(_G, select(near, 1 - c, 0))
    inside = select(near, 0, select(far, 0, c))
    closed = library(inside).arccos(inside) / library(inside).sqrt(1 - inside * inside)
    return select(near, series, closed)


def _smooth(x: Expr, coefficients: Sequence[float], closed: Callable[[Any, Any], Any]) -> Any:
    near = x < SERIES
    y = select(near, SERIES, x)
    return select(near, _horner(coefficients, select(near, x, 0)), closed(library(y).sqrt(y), y))


def _horner(coefficients: Sequence[float], x: Expr) -> Any:
    value: Any = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        value = coefficient + x * value
    return value
