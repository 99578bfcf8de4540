"""Modes of a linear system that its inputs do not reach, or its outputs do not see, and modes that do not decay."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from covocp.blocks.scaling import RUBBLE, rubble, semidefinite_root

Array = NDArray[np.float64]
Modes = NDArray[np.complex128]

# A mode is out of reach where the smallest singular value of [A - mode I, B], both blocks of size 1, is below this.
UNREACHABLE = 1e-10
# A mode counts as marginal, neither stable nor unstable, this many units of the machine's precision from the boundary,
# times the size and the norm of A and the condition of the mode; but never further than a share of the largest mode.
ROUNDING = 100.0
MARGINAL = 1e-9


def lost_modes(A: Array, B: Array, *, discrete: bool, marginal: bool = False) -> Modes:
    """Modes of A that are not stable (`marginal`: on the boundary) and that B does not reach.

    Hautus' test at each mode, and the modes of what a staircase of orthogonal changes of the state finds out of reach:
    of a multiple mode only the mean is known to rounding, and a rank at a mode that is off says nothing.
    """
    if not len(A):
        return np.zeros(0, dtype=complex)
    balanced, units = balance(A)
    columns = _normalised(B / units[:, None])
    size, largest = _sizes(balanced, discrete)
    values = _chosen(balanced, size, largest, discrete, marginal)
    lost = np.asarray([value for value in values if nearness(balanced, columns, value) <= UNREACHABLE], dtype=complex)
    rest = _chosen(_out_of_reach(balanced, columns), size, largest, discrete, marginal)
    return rest if rest.size > lost.size else lost


def slow_modes(A: Array, *, discrete: bool) -> Modes:
    """Modes of A that are not stable by more than their rounding."""
    if not len(A):
        return np.zeros(0, dtype=complex)
    balanced, _ = balance(A)
    return _chosen(balanced, *_sizes(balanced, discrete), discrete, False)


def nearness(A: Array, B: Array, mode: complex) -> float:
    """Smallest singular value of [A - mode I, B], both blocks of size 1: how hardly B reaches the mode."""
    shifted = A - mode * np.eye(len(A))
    size = max(float(np.linalg.norm(shifted, 2)), np.finfo(float).tiny)
    return float(np.linalg.svd(np.hstack([shifted / size, _normalised(B)]), compute_uv=False)[-1])


def balance(A: Array) -> tuple[Array, Array]:
    """A in units of the states in which its rows and columns are of similar size, and these units (powers of two)."""
    from scipy import linalg

    balanced, (units, _) = linalg.matrix_balance(A, permute=False, separate=True)
    return np.asarray(balanced), np.asarray(units)


def weighted_directions(weights: Array) -> Array:
    """Columns that span what a positive semidefinite matrix gives a weight, each entry to rounding of its row.

    The root of rounding, 1e-8 of 1e-16, would be a weight: what is below the rounding of the matrix is none.
    """
    known = np.where(rubble(weights)[:, None] | rubble(weights), 0.0, weights)
    return semidefinite_root(known, rounding=RUBBLE * len(weights) * float(np.finfo(float).eps))


def _sizes(A: Array, discrete: bool) -> tuple[float, float]:
    """Rounding of the entries of a matrix, and the size of its largest mode (discrete: of the unit circle)."""
    rounding = ROUNDING * len(A) * float(np.finfo(float).eps) * float(np.linalg.norm(A, 2))
    return rounding, 1.0 if discrete else float(np.abs(np.linalg.eigvals(A)).max())


def _chosen(A: Array, known: float, largest: float, discrete: bool, marginal: bool) -> Modes:
    """Modes on the boundary of stability or (not `marginal`) outside, each within its own rounding.

    Args:
        A: a matrix or an invariant part of it, (n, n).
        known: rounding of the entries of the whole matrix.
        largest: size of its largest mode.
        discrete: the boundary is the unit circle.
        marginal: on the boundary only.
    """
    from scipy import linalg

    if not len(A):
        return np.zeros(0, dtype=complex)
    found: Any = linalg.eig(A, left=True, right=True)
    values, left, right = found
    # of unit vectors; zero where a mode is defective
    angles = np.abs(np.sum(left.conj() * right, axis=0))
    rounding = np.minimum(known / np.maximum(angles, np.finfo(float).eps), max(known, MARGINAL * largest))
    excess = np.abs(values) - 1.0 if discrete else values.real
    return np.asarray(values[np.abs(excess) <= rounding if marginal else excess >= -rounding], dtype=complex)


def _normalised(columns: Array) -> Array:
    norms = np.linalg.norm(columns, axis=0)
    return np.asarray(columns / np.where(norms > 0.0, norms, 1.0))


def _out_of_reach(A: Array, B: Array) -> Array:
    """The block of A, after orthogonal changes of the state, that B does not reach: the controllability staircase.

    Each step turns the directions that the step before reaches to the front; what these drive is the next step.
    """
    rest, reach = A, B
    limit = UNREACHABLE
    for _ in range(len(A)):
        if not rest.size:
            break
        turn, sizes, _ = np.linalg.svd(reach)
        rank = int(np.count_nonzero(sizes > limit))
        if rank == 0:
            break
        turned = turn.T @ rest @ turn
        reach, rest = turned[rank:, :rank], turned[rank:, rank:]
        limit = UNREACHABLE * float(np.linalg.norm(A, 2))
    return np.asarray(rest)
