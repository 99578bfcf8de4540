"""Symmetric matrices as half-vectors, and what is asked of them.

A symmetric n x n matrix is stored as its n(n+1)/2 entries (i, j), i >= j, column by column: (0,0), (1,0), ..., (n-1,0),
(1,1), ... The costate of an off-diagonal entry of the half-vector is twice the entry of the matrix costate P, because
the entry stands for two entries of the matrix (Schmidt 1971, section 2.4).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from covocp.base.expressions import Expr, Given, densified, plus, times

Array = NDArray[np.float64]
T = TypeVar("T")

# A covariance counts as positive semidefinite while its smallest eigenvalue is above minus this times its largest, both
# with unit diagonal: roundoff of a propagation over some thousand steps.
SEMIDEFINITE_TOLERANCE = 1e-9
# A variance is known to this share of what it once was: some hundred roundings of that.
ROUNDINGS = 1e-13
# Entries below so many units of the machine's precision times the size, relative to the largest, hold nothing else.
RUBBLE = 8.0
# Numbers of a matrix of CasADi's from which on it pays to let it write them into memory.
MANY_NUMBERS = 1500
# Share of a whole within which two places of it are one.
SAME = 1e-9


def real_numbers(value: Given) -> Array:
    """Numbers as an array of floats. None in a sequence is NaN; arrays of truths are patterns of 0 and 1.

    Raises:
        TypeError: words, a truth, None by itself, symbols, complex numbers, dates, masked entries, no numbers at all.
        ValueError: rows of different lengths.
        OverflowError: a whole number that no float can hold.
    """
    if isinstance(value, (float, int)) and not isinstance(value, bool):
        return np.asarray(float(value))
    if value is None or _no_number(value):
        raise TypeError("numpy would read words and truths as numbers, and None as NaN")
    if "numpy.ma" in sys.modules and np.ma.is_masked(value):  # importing it takes longer than a solve
        raise TypeError("numpy would read what is masked too")
    numbers = np.asarray(value.full() if isinstance(value, ca.DM) else value)
    if numbers.dtype.kind not in "fiubO":
        raise TypeError(f"numbers of the type {numbers.dtype} are not real")
    if numbers.dtype.kind == "O" and any(_no_number(entry) for entry in numbers.flat):
        raise TypeError("not all are numbers")
    return numbers.astype(float)


def _no_number(value: Given) -> bool:
    """Whether a value is a truth, a word or a symbol, or a sequence that holds a word or a symbol."""
    if isinstance(value, (list, tuple)):
        return any(not isinstance(entry, (bool, np.bool_)) and _no_number(entry) for entry in value)
    return isinstance(value, (str, bytes, bool, np.bool_, ca.SX, ca.MX))


def read_only(holder: T) -> T:
    """A dataclass or a dictionary, whose own arrays cannot be written to any more."""
    for value in (holder if isinstance(holder, Mapping) else vars(holder)).values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
    return holder


def distinct(*values: Any) -> Array:
    """The different numbers among some, sorted: `np.unique` would import numpy.ma, which takes as long as a solve."""
    together = np.sort(np.concatenate([np.ravel(own) for own in values]))
    return np.asarray(together[np.append(True, together[1:] != together[:-1])[: together.size]])


def near(values: Array, places: Array) -> Any:
    """Which values are, but for rounding, one of some rising places; they are shares of one whole."""
    if not places.size:
        return np.zeros(values.shape, dtype=bool)
    k = np.clip(np.searchsorted(places, values), 1, places.size) - 1
    distance = np.minimum(np.abs(values - places[k]), np.abs(values - places[np.minimum(k + 1, places.size - 1)]))
    return distance <= SAME


def half_length(size: int) -> int:
    """Number of distinct entries of a symmetric matrix of the given size."""
    return size * (size + 1) // 2


@lru_cache(maxsize=64)
def half_indices(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns (i >= j) of the entries of the half-vector, in its order."""
    columns, rows = np.triu_indices(size)
    return rows, columns


@lru_cache(maxsize=64)
def unpack_indices(size: int) -> NDArray[np.intp]:
    """Position in the half-vector of each entry of the full matrix, shape (size, size)."""
    rows, columns = half_indices(size)
    positions = np.zeros((size, size), dtype=np.intp)
    positions[rows, columns] = np.arange(rows.size)
    positions[columns, rows] = np.arange(rows.size)
    return positions


def pack(matrix: ArrayLike) -> Array:
    """Half-vector of symmetric matrices.

    Args:
        matrix: shape (..., n, n); the symmetric part is taken.

    Returns:
        Shape (..., n(n+1)/2).
    """
    full = np.asarray(matrix, dtype=float)
    rows, columns = half_indices(full.shape[-1])
    return np.asarray(0.5 * (full[..., rows, columns] + full[..., columns, rows]))


def unpack(half: ArrayLike, size: int) -> Array:
    """Full symmetric matrices from half-vectors of shape (..., n(n+1)/2); shape (..., n, n)."""
    return np.asarray(np.asarray(half, dtype=float)[..., unpack_indices(size)])


def own_units(matrices: Array, negative: bool = False) -> Array:
    """Units of the rows of symmetric matrices (..., n, n) in which their diagonals are 1, (..., n).

    In these no decision depends on the units that something is stated in. A variance that is not positive has no unit
    of its own: its row gets that of the largest entry; where `negative` ones count as they are, that of their size.
    """
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    sizes = np.abs(diagonal)
    largest = np.abs(matrices).max(axis=(-2, -1), initial=0.0)[..., None]
    sizes = np.where((diagonal > 0) | (negative & (sizes > 0)), sizes, largest)
    return np.asarray(np.sqrt(np.where(sizes > 0, sizes, 1.0)))


def over_units(matrices: Array, units: Array) -> Array:
    """Entries (i, j) of matrices (..., n, n) over units i and j (..., n), whose product may underflow."""
    return np.asarray(matrices / units[..., :, None] / units[..., None, :])


def semidefinite_part(matrix: Array) -> Array:
    """The positive semidefinite matrix nearest to a symmetric one with unit diagonal; one that is none comes back."""
    units = own_units(matrix)
    values, vectors = np.linalg.eigh(over_units(matrix, units))
    if values.min(initial=0.0) >= 0.0:
        return matrix
    return np.asarray(units[:, None] * ((vectors * np.maximum(values, 0.0)) @ vectors.T) * units)


def without_rounding(matrix: Array, once: Array | None = None) -> Array:
    """A matrix as the covariance that it is but for rounding; as it is where it is none.

    A filter leaves E - K H E, whose entries are known to rounding of what the variances were before. Of a row that had
    none, a variance that is not positive may be one rounding of the largest entry for each row.

    Args:
        matrix: (n, n).
        once: variances that the same rows had before, (n,); None: nothing was before, and none may be negative.

    Returns:
        Symmetric and semidefinite where rounding alone keeps it from being so: rows of variances that are not positive
        are zero.
    """
    if not np.isfinite(matrix).all():
        return matrix
    diagonal, size = np.diagonal(matrix), matrix.shape[0]
    before = np.maximum(diagonal, 0.0 if once is None else once)
    beside = 0.0 if once is None else size * np.finfo(float).eps * np.abs(matrix).max(initial=0.0)
    margins = np.where(before > 0.0, ROUNDINGS * before, beside)
    deviations = np.sqrt(margins)
    if not (np.abs(matrix - matrix.T) <= deviations[:, None] * deviations).all():
        return matrix
    even = 0.5 * (matrix + matrix.T)
    widened = even + np.diag(margins)
    known = (np.diagonal(widened) >= 0.0).all()
    if not known or np.linalg.eigvalsh(over_units(widened, own_units(widened))).min(initial=0.0) < -ROUNDINGS:
        return matrix
    empty = diagonal <= 0.0
    return semidefinite_part(np.where(empty[:, None] | empty, 0.0, even))


def unpack_costate(half: ArrayLike, size: int) -> Array:
    """Matrix costate P from the costates of the half-vector: off-diagonal entries are halved."""
    half = np.asarray(half, dtype=float)
    rows, columns = half_indices(size)
    return unpack(np.where(rows == columns, half, 0.5 * half), size)


def pack_costate(matrix: ArrayLike) -> Array:
    """Costates of the half-vector from the matrix costate P: off-diagonal entries are doubled."""
    half = pack(matrix)
    rows, columns = half_indices(np.shape(matrix)[-1])
    return np.asarray(np.where(rows == columns, half, 2.0 * half))


def pack_symbolic(matrix: Expr) -> Any:
    """Half-vector of a symbolic symmetric matrix; the symmetric part is taken."""
    size = matrix.shape[0]
    rows, columns = half_indices(size)
    lower, upper = columns * size + rows, rows * size + columns
    flat = ca.vec(densified(matrix))
    return times(0.5, plus(flat[lower.tolist()], flat[upper.tolist()]))


def unpack_symbolic(half: Expr, size: int) -> Any:
    """Full symmetric matrix of a symbolic half-vector."""
    order = unpack_indices(size).T.ravel().tolist()
    return ca.reshape(half[order], size, size)


def as_array(value: Any) -> Array:
    """The numbers of a matrix of CasADi's, as its `full` gives them; what is an array already stays it.

    `full` makes an object of each number, 50 ns, and of a large one 60 times what it takes to let CasADi write them.

    Args:
        value: (rows, columns).
    """
    if not isinstance(value, ca.DM):
        return np.asarray(value)
    if value.numel() < MANY_NUMBERS:
        return np.asarray(value.full())
    result = np.empty(value.numel())
    buffer: Any
    buffer, run = ca.Function("numbers", [], [ca.MX(densified(value))]).buffer()
    buffer.set_res(0, memoryview(result))  # type: ignore[arg-type]
    run()
    return result.reshape(value.shape, order="F")


def stacked(value: Expr, count: int) -> Array:
    """Matrices side by side, as a mapped function returns them, one after the other: (count, rows, columns)."""
    numbers = as_array(value)
    return numbers.reshape(numbers.shape[0], count, numbers.shape[1] // count).transpose(1, 0, 2)


def smallest_eigenvalue(matrices: ArrayLike) -> float:
    """Smallest eigenvalue over all the symmetric matrices of shape (..., n, n); inf where there is none."""
    full = np.asarray(matrices, dtype=float)
    if full.size == 0:
        return np.inf
    if not np.all(np.isfinite(full)):
        return -np.inf
    return float(np.linalg.eigvalsh(full).min())


def is_semidefinite(matrices: ArrayLike, known: float = 0.0) -> bool:
    """Whether every symmetric matrix of shape (..., n, n) is positive semidefinite up to roundoff, in its own units.

    Args:
        matrices: of one quantity at several times, say; what is left of a variance is known to rounding of the largest
            one among them.
        known: share of the largest one up to which they are known besides, where they are found by iteration.
    """
    full = np.asarray(matrices, dtype=float)
    if full.size == 0:
        return True
    if not np.all(np.isfinite(full)):
        return False
    size = full.shape[-1]
    full = full.reshape(-1, size, size)
    rounding = (ROUNDINGS + known) * np.diagonal(full, axis1=1, axis2=2).max(axis=0).clip(0.0)
    full = _without_rubble(full) + np.diag(rounding)
    values = np.linalg.eigvalsh(over_units(full, own_units(full)))
    return bool(np.all(values[:, 0] >= -SEMIDEFINITE_TOLERANCE * np.maximum(np.abs(values[:, -1]), 1e-300)))


def _without_rubble(matrices: Array) -> Array:
    """Matrices (K, n, n) with zeros where the rounding of the largest entry is all that is left of a coupled row."""
    sizes = np.abs(matrices)
    own = np.diagonal(matrices, axis1=1, axis2=2)
    beside = np.count_nonzero(matrices, axis=2) > (own != 0)
    limit = RUBBLE * matrices.shape[-1] * np.finfo(float).eps * sizes.max(axis=(1, 2), initial=0.0)
    empty = beside & (sizes.max(axis=2, initial=0.0) <= limit[:, None])
    return np.where(empty[:, :, None] | empty[:, None, :], 0.0, matrices)


def standard_deviations(covariances: ArrayLike) -> Array:
    """Roots of the diagonals of covariances of shape (..., n, n), (..., n); what roundoff left below zero is zero."""
    return np.asarray(np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1).clip(0.0)))
