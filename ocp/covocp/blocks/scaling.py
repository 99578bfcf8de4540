"""Symmetric matrices in mixed units: what is tested or mended is scaled to a unit diagonal first.

A covariance of metres and radians has entries 10^20 apart. Eigenvalues of such a matrix are known to the rounding of
its largest entry only, which is more than the whole of the smallest variance; with unit diagonal each variance is known
to rounding of itself, and no decision depends on the units.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# Relative size of a negative eigenvalue that counts as roundoff, and that many units of the machine's precision where
# this is coarser (float32).
ROUNDOFF = 1e-9
UNITS = 100.0
# An entry is the rounding of the largest one below this many units of the machine's precision, times the size.
RUBBLE = 8.0


def scales(sizes: Array) -> Array:
    """The powers of two next to positive sizes, by which a matrix is divided without rounding; 1 for the others."""
    positive = sizes > 0.0
    return np.asarray(np.exp2(np.round(np.log2(np.where(positive, sizes, 1.0)))), dtype=sizes.dtype)


def diagonal_scales(matrix: Array) -> Array:
    """Of the roots of the diagonal of a symmetric matrix."""
    return scales(np.sqrt(np.clip(np.diag(matrix), 0.0, None)))


def over(matrix: Array, units: Array) -> Array:
    """Entry (i, j) divided by units i and j, one after the other, for their product may underflow."""
    return np.asarray(matrix / units[:, None] / units)


def roundoff(kind: Any) -> float:
    """Relative size of a negative eigenvalue of a matrix with unit diagonal that is roundoff."""
    return max(ROUNDOFF, UNITS * float(np.finfo(kind).eps))


def rubble(matrix: Array, kind: Any = np.float64) -> Array:
    """Which rows hold rounding of the largest entry only: tiny, and yet coupled to others (a number alone is none)."""
    sizes = np.abs(matrix)
    coupled = np.count_nonzero(matrix - np.diag(np.diag(matrix)), axis=1) > 0
    limit = RUBBLE * len(matrix) * float(np.finfo(kind).eps) * sizes.max(initial=0.0)
    return np.asarray((sizes.max(axis=1, initial=0.0) <= limit) & coupled)


def semidefinite_part(matrix: Array, before: Array | None = None) -> Array:
    """A covariance without the negative eigenvalues that rounding can leave; what has none comes back as it is.

    No variance changes by more than rounding of itself, apart from negative ones, which become zero. Where the rounding
    of larger numbers is all that is left of a variance, its correlations may be anything: those that contradict the
    others become zero.

    Args:
        matrix: symmetric, (n, n).
        before: the covariance that it was computed from, (n, n): the less is left of a variance the less its
            correlations are trusted; None: the smaller a variance is.
    """
    spreads = np.diag(matrix)
    empty = spreads <= 0.0
    units = diagonal_scales(matrix)
    scaled = over(matrix, units)
    scaled[empty] = scaled[:, empty] = 0.0
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < -roundoff(matrix.dtype):
        left = spreads if before is None else spreads / np.maximum(np.diag(before), np.finfo(matrix.dtype).tiny)
        scaled = _consistent(scaled, np.argsort(-left, kind="stable"))
        values, vectors = np.linalg.eigh(scaled)
    elif values[0] >= 0.0:
        return matrix if not matrix[empty].any() else scaled * units[:, None] * units
    clipped = (vectors * np.clip(values, 0.0, None)) @ vectors.T
    clipped[empty] = clipped[:, empty] = 0.0
    return np.asarray((clipped + clipped.T) / 2 * units[:, None] * units)


def semidefinite_root(matrix: Array, *, rounding: float = 0.0) -> Array:
    """X with X X' = matrix, (n, n), for a positive semidefinite one, each row to rounding of itself.

    Args:
        matrix: symmetric, (n, n).
        rounding: eigenvalues of the matrix with unit diagonal below this share of the largest are none.
    """
    if not matrix.size:
        return matrix
    units = diagonal_scales(matrix)
    values, vectors = np.linalg.eigh(over(matrix, units))
    values = np.where(values > rounding * abs(values[-1]), np.clip(values, 0.0, None), 0.0)
    return np.asarray(units[:, None] * ((vectors * np.sqrt(values)) @ vectors.T))


def _consistent(scaled: Array, order: Array) -> Array:
    """Rows in this order; one that is not semidefinite together with those before it loses its correlations."""
    kept: list[int] = []
    lost: list[int] = []
    for i in order.tolist():
        together = np.ix_([*kept, i], [*kept, i])
        sound = np.linalg.eigvalsh(scaled[together])[0] >= -roundoff(scaled.dtype)
        (kept if sound else lost).append(i)
    result = scaled.copy()
    for i in lost:
        result[i] = result[:, i] = 0.0
        result[i, i] = scaled[i, i]
    return result
