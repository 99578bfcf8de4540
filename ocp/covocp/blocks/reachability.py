"""Modes of a linear system that its inputs do not reach, or its outputs do not see, and modes that do not decay."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from covocp.blocks.scaling import RUBBLE, over, semidefinite_root

Array = NDArray[np.float64]
Modes = NDArray[np.complex128]

# A mode is out of reach where an error of the data by this share makes it so: the smallest singular value of
# [A - mode I, B], rows in units of what drives the states, columns divided by their size, is below this. A link between
# two states below this share of what moves them is none.
UNREACHABLE = 1e-12
# A mode counts as marginal, neither stable nor unstable, this many units of the machine's precision from the boundary,
# times the size and the norm of A and the condition of the mode; but never further than a share of the largest mode.
ROUNDING = 100.0
MARGINAL = 1e-9
# A weight is rounding this many units of the machine's precision, times the size, below the terms that it is a sum of.
NOTHING = 64.0
# An entry of B is rounding below this share of the largest of its column that drives the same states: what is left of a
# mode out of reach by the change to coordinates whose condition is some thousands.
NO_INPUT = 1e-10
# Largest and smallest unit of a state are 2 to this power; beyond, squares of units overflow.
FARTHEST = 200.0


def lost_modes(A: Array, B: Array, *, discrete: bool, marginal: bool = False, weights: Array | None = None) -> Modes:
    """Modes of A that are not stable (`marginal`: on the boundary) and that B does not reach, whatever the units.

    What no path of entries leads to from B is out of reach as it stands. For the others Hautus' test at each mode, and
    the modes of what a staircase of orthogonal changes of the state finds out of reach: of a multiple mode only the
    mean is known to rounding, and a rank at a mode that is off says nothing.

    Args:
        A: (n, n).
        B: (n, m).
        discrete: stable means inside the unit circle.
        marginal: on the boundary of stability only.
        weights: what B is a root of, (n, n): a root of rounding is none, 1e-8 of 1e-16.
    """
    if not len(A):
        return np.zeros(0, dtype=complex)
    balanced, units = balance(A)
    known, largest = _sizes(balanced, discrete)
    size, there, part, columns = _driven_part(balanced, B / units[:, None])
    apart = _chosen(balanced[np.ix_(~there, ~there)], known, largest, discrete, marginal)
    values = _chosen(balanced[np.ix_(there, there)], known, largest, discrete, marginal)
    spread = None if weights is None else over(weights, units)[np.ix_(there, there)]
    lost = [
        value
        for value in values
        if _distance(part, columns, value / size) <= UNREACHABLE
        or (spread is not None and _is_weightless(balanced[np.ix_(there, there)], spread, value))
    ]
    rest = _chosen(balance(_out_of_reach(part, columns))[0] * size, known, largest, discrete, marginal)
    return np.concatenate([apart, rest if rest.size > len(lost) else np.asarray(lost, dtype=complex)])


def slow_modes(A: Array, *, discrete: bool) -> Modes:
    """Modes of A that are not stable by more than their rounding."""
    if not len(A):
        return np.zeros(0, dtype=complex)
    balanced, _ = balance(A)
    return _chosen(balanced, *_sizes(balanced, discrete), discrete, False)


def nearness(A: Array, B: Array, mode: complex) -> float:
    """The share by which an error of A and B makes the mode one that B does not reach."""
    balanced, units = balance(A)
    size, there, part, columns = _driven_part(balanced, B / units[:, None])
    if not there.all() and np.abs(np.linalg.eigvals(balanced[np.ix_(~there, ~there)]) - mode).min() <= MARGINAL * size:
        return 0.0
    return _distance(part, columns, mode / size)


def balance(A: Array) -> tuple[Array, Array]:
    """A in units of the states in which its rows and columns are of similar size, and these units (powers of two).

    Without the diagonal, which no unit changes: in a triangular matrix a diagonal entry that is small beside the links
    would drive the unit of its state as far as it is small. Where one part of the states drives another, but not the
    other way round, the units of the driven part make the links no larger than what moves the modes.
    """
    from scipy import linalg

    if not len(A):
        return A, np.ones(0)
    together = _together(A)
    links = np.where(together & ~np.eye(len(A), dtype=bool), A, 0.0)
    routines: Any = linalg.get_lapack_funcs(("gebal",), (links,))
    units = routines[0](links, scale=True, permute=False)[3]
    units = np.exp2(np.clip(np.log2(units) + _apart(A / units[:, None] * units, together), -FARTHEST, FARTHEST))
    return np.asarray(A / units[:, None] * units), np.asarray(units)


def _apart(A: Array, together: NDArray[np.bool_]) -> Array:
    """Logarithms of the units in which no link between parts that drive each other one way only is above A's size."""
    parts = np.zeros(len(A))
    if together.all():
        return parts
    with np.errstate(divide="ignore"):
        links = np.log2(np.abs(A))
    links = np.where(together, -np.inf, links - _cycle_mean(links))
    for _ in range(len(A)):
        driven = np.maximum(parts, np.max(links + parts, axis=1))
        parts = np.max(np.where(together, driven, 0.0), axis=1)
    return np.ceil(parts)


def _together(A: Array) -> NDArray[np.bool_]:
    """Which states drive each other, directly or by way of others; each itself."""
    drives = (A != 0.0) | np.eye(len(A), dtype=bool)
    for _ in range(len(A).bit_length()):
        drives = drives @ drives
    return np.asarray(drives & drives.T)


def driven_units(A: Array, B: Array) -> tuple[float, Array]:
    """Size of A, the largest mean of a cycle of its entries, and units of what inputs drive, as logarithms to base 2.

    The unit of a state is the largest product of entries, each over the size of A, along a path from an input to it
    (-inf: there is none); along a long one it may be beyond all numbers. In these units no entry of A is above its
    size, no entry of B above that of an input, and to each state leads a chain of entries of full size. They change
    with the units of the data as these do.
    """
    with np.errstate(divide="ignore"):
        links, inputs = np.log2(np.abs(A)), np.log2(np.abs(B))
    size = _cycle_mean(links)
    links = links - size
    for _ in range(len(A)):
        inputs = np.maximum(inputs, np.max(links[:, :, None] + inputs[None, :, :], axis=1, initial=-np.inf))
    reached = np.isfinite(inputs)
    means = np.where(reached, inputs, 0.0).sum(axis=0) / np.maximum(reached.sum(axis=0), 1)
    driven = np.max(inputs - means, axis=1, initial=-np.inf)
    return float(np.exp2(size)), np.asarray(np.round(driven))


def _cycle_mean(links: Array) -> float:
    """Largest mean of the entries along a cycle, by Karp's theorem; 0 where there is no cycle."""
    walks = [np.zeros(len(links))]
    for _ in range(len(links)):
        walks.append(np.max(links + walks[-1], axis=1, initial=-np.inf))
    ends = np.isfinite(walks[-1])
    lengths = len(links) - np.arange(len(links))[:, None]
    means = np.min((walks[-1][ends] - np.array(walks[:-1])[:, ends]) / lengths, axis=0)
    return float(means.max(initial=0.0 if not ends.any() else -np.inf))


def _without_rounding(A: Array, B: Array) -> tuple[Array, Array]:
    """A pair without entries that are rounding of others, whatever its units.

    Only states that drive each other, directly or not, have units that follow from each other. Among others an entry
    may be small because of its unit: it counts as it stands. A link is held against the larger of what moves the two
    states that it joins: a change of coordinates leaves that much.
    """
    together = _together(A)
    with np.errstate(divide="ignore"):
        links, inputs = np.where(together, np.log2(np.abs(A)), -np.inf), np.log2(np.abs(B))
    units = _level_units(np.where(np.eye(len(A), dtype=bool), -np.inf, links))
    links, inputs = links - units[:, None] + units, inputs - units[:, None]
    sizes = links.max(axis=1, initial=-np.inf)
    small = links <= np.maximum(sizes[:, None], sizes) + np.log2(UNREACHABLE)
    columns = np.array([inputs[row].max(axis=0) for row in together]).reshape(B.shape)
    unlinked = together & ~np.eye(len(A), dtype=bool) & small
    return np.where(unlinked, 0.0, A), np.where(inputs <= columns + np.log2(NO_INPUT), 0.0, B)


def _level_units(links: Array) -> Array:
    """Units of states in which as much leads into each group of them as out of it, as logarithms to base 2.

    Unlike those of `balance`, which looks at one state at a time, they say what links groups that are closely linked
    within: the largest cycles are levelled first, then each as one state with the rest [Schneider, Schneider,
    Max-balancing weighted directed graphs and matrix scaling, Math. Oper. Res. 16 (1991)]. To a factor of two.

    Args:
        links: logarithms of the sizes of the entries, -inf for none, on the diagonal and between states that do not
            drive each other, (n, n).
    """
    units = np.zeros(len(links))
    group = np.arange(len(links))
    for _ in range(len(group)):
        if not np.isfinite(links).any():
            break
        size, levels = _cycle_mean(links), np.zeros(len(links))
        for _ in range(len(links)):
            before, levels = levels, np.maximum(levels, np.max(links - size + levels, axis=1))
            if np.array_equal(before, levels):
                break
        units += levels[group]
        links = links - levels[:, None] + levels
        # what the largest cycles join is one state from here on
        large = np.where(links > size - 1.0, 1.0, 0.0)
        first, joined = np.unique(np.argmax(_together(large), axis=1), return_inverse=True)
        order = np.argsort(joined, kind="stable")
        starts = np.searchsorted(joined[order], np.arange(len(first)))
        links = np.maximum.reduceat(np.maximum.reduceat(links[np.ix_(order, order)], starts, axis=0), starts, axis=1)
        np.fill_diagonal(links, -np.inf)
        group = joined[group]
    return units


def _driven_part(A: Array, B: Array) -> tuple[float, NDArray[np.bool_], Array, Array]:
    """Of a balanced pair: its size, which states are driven, and A and B of these in units of what drives them."""
    A, B = _without_rounding(A, B)
    size, units = driven_units(A, B)
    there = np.isfinite(units)
    units = units[there]
    part, columns = A[np.ix_(there, there)] / size, B[there]
    with np.errstate(divide="ignore"):
        links, inputs = np.log2(np.abs(part)), np.log2(np.abs(columns)) - units[:, None]
    links = np.sign(part) * np.exp2(links + (units - units[:, None]))
    largest = np.max(inputs, axis=0, initial=-np.inf)
    inputs = np.sign(columns) * np.exp2(inputs - np.where(np.isfinite(largest), largest, 0.0))
    return size, there, links, _normalised(inputs)


def _distance(A: Array, B: Array, mode: complex) -> float:
    """Smallest singular value of [A - mode I, B], each column divided by the size of what it was computed from."""
    unit = np.eye(len(A))
    sizes = np.linalg.norm(np.abs(A) + abs(mode) * unit, axis=0)
    shifted = (A - mode * unit) / np.where(sizes > 0.0, sizes, 1.0)
    return float(np.linalg.svd(np.hstack([shifted, B]), compute_uv=False)[-1]) if len(A) else np.inf


def weighted_directions(weights: Array, errors: Array) -> Array:
    """Columns that span what a positive semidefinite matrix gives a weight, each entry to rounding of its row.

    The root of rounding, 1e-8 of 1e-16, would be a weight: what is below the rounding of the matrix is none.

    Args:
        weights: (n, n).
        errors: sizes of the terms that each entry is the sum of, (n, n).
    """
    rounding = RUBBLE * len(weights) * float(np.finfo(float).eps)
    known = np.diag(weights) > rounding * np.diag(errors)
    return semidefinite_root(np.where(known[:, None] & known, weights, 0.0), rounding=rounding)


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


def _is_weightless(A: Array, weights: Array, mode: complex) -> bool:
    """Whether the weight of a mode is rounding of the terms that it is the sum of, whatever the units."""
    sizes = np.linalg.norm(np.abs(A) + abs(mode) * np.eye(len(A)), axis=0)
    vectors, values, _ = np.linalg.svd((A - mode * np.eye(len(A))) / np.where(sizes > 0.0, sizes, 1.0))
    # of a multiple mode all its left eigenvectors, and the one of these with the least weight
    basis = vectors[:, values <= max(UNREACHABLE, values[-1])]
    least = basis @ np.linalg.eigh(basis.conj().T @ weights @ basis)[1][:, 0]
    terms = np.abs(least) @ np.abs(weights) @ np.abs(least)
    rounding = NOTHING * len(A) * float(np.finfo(float).eps)
    return bool((least.conj() @ weights @ least).real <= rounding * terms)


def _out_of_reach(A: Array, B: Array) -> Array:
    """The block of A, after orthogonal changes of the state, that B does not reach: the controllability staircase.

    Each step turns the directions that the step before reaches to the front; what these drive is the next step. What
    the data may be off by, a share of each entry, is turned along: by its squares, as independent errors add up.
    """
    rest, reach = A, B
    variances, limit = (UNREACHABLE * A) ** 2, UNREACHABLE * float(np.linalg.norm(B))
    for _ in range(len(A)):
        if not rest.size:
            break
        turn, sizes, _ = np.linalg.svd(reach)
        rank = int(np.count_nonzero(sizes > limit))
        if rank == 0:
            break
        turned, spread = turn.T @ rest @ turn, (turn**2).T @ variances @ turn**2
        reach, rest = turned[rank:, :rank], turned[rank:, rank:]
        limit, variances = float(np.sqrt(spread[rank:, :rank].sum())), spread[rank:, rank:]
    return np.asarray(rest)
