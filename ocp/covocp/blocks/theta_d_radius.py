"""Where the θ-D series of A0 + s D stops to converge: the singularities of the Riccati solution P(s) next to zero.

The Hamiltonian matrix H(s) = [[A0 + s D, -S], [-Q, -(A0 + s D)']] is entire in s, and with lambda it has the eigenvalue
-lambda. [1; P(s)] spans the invariant subspace of those of A_c(s) = A0 + s D - S P(s). So P is analytic until one of
these, lambda_i, meets one that is not, -lambda_j (a branch point, where (lambda_i + lambda_j)^2 has a simple zero), or
until the subspace has a vector without upper half (a pole). On a circle on which the series still converges both kinds
are estimated by a Newton step, and then found by Newton's method on H(s). What is found must agree with how the terms
of high order grow.

Systems that do not act on one another, in whatever coordinates, are looked at one by one: where two of them are alike
every eigenvalue of H(s) is a double one, and no two of them are seen to meet.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from covocp.blocks.scaling import diagonal_scales, over
from covocp.blocks.theta_d_separate import separate
from covocp.blocks.theta_d_series import Start

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Terms that a circle is summed from; the first passes, with fewer, find the scale at which they do not grow or vanish.
PASSES, FIRST_TERMS, TERMS = 20, 16, 160
SETTLED, SMALLER = 0.02, 1e-8
# Terms of high order below this, relative to the first ones, are roundoff: the series ends.
VANISHED = 1e-12
# Orders whose largest terms are compared, to see how fast n^3/2 T_n grows. Other powers of n, and singularities that
# take turns, leave the radius uncertain by this.
EARLY, LATE = slice(46, 101), slice(106, 161)
POWER, UNCERTAIN = 1.5, 0.1
# The circle, relative to that radius: what the terms leave out there is rounding. Angles from 0 to pi.
CIRCLE, ANGLES = 0.8, 65
# Near its singularity a term of order n behaves like n^-p R^-n: p = 3/2 where two eigenvalues meet, 1/2 for the inverse
# of such a root, 0 for a pole, -1 for a double one. Orders of recurrences, the windows of terms that are compared, the
# misfit and uncertainty up to which one is believed; what is found may be farther away by so many times its
# uncertainty, and a rest.
POWERS, ORDERS = (1.5, 0.5, 0.0, -1.0), (2, 4, 6)
WINDOWS = slice(50, 106), slice(105, 161)
FITTING, AGREEING, ACCURACY = 3e-3, 6.0, 1e-3
# How far beyond the limit an estimate may be of what is within. The same, angles and ways that are enough to see
# whether another one is nearer than one that is known, by this at least.
BEYOND, CLOSELY, COARSE, CLOSE, NEARER = 1.1, 1.03, 25, 0.4, 1.0 - 1e-6
# Estimates that are followed first: so many, at most so far from where the recurrence tells, relative to its distance.
TRIED, NEIGHBOURING = 3, 0.2
# Estimates are followed that are at most so far from their point of the circle, relative to it; those that are as near
# to a singularity as this, relative to their way, are of that one.
FAR, SAME = 0.6, 0.25
NEWTON_STEPS, CONVERGED = 40, 1e-10
# A step that is shorter than this, relative to the circle, and not shorter than the one before is made of rounding: the
# eigenvalues that meet at a singularity are known to half of the digits there.
ROUNDING = 1e-4
# Eigenvalues that meet and pass leave a zero of order two, those of a branch point one of order one: growth of
# (lambda_i + lambda_j)^2 from a distance to four times of it, between 4 and 16.
NEAR, PASSING = 1e-3, 8.0
# The eigenvalues of A_c are followed to a singularity in steps of 0.4 of what is left, up to 1e-3 of its distance from
# the circle; a pole has made P larger then, by this at least.
SHARES, LARGER = 1.0 - 0.6 ** np.arange(15), 30.0


class _Branch(NamedTuple):
    """P(s) and its first two derivatives, (k, n, n); eigenvalues of A_c(s) and their slopes, (k, n)."""

    P: Complex
    slope: Complex
    bend: Complex
    values: Complex
    slopes: Complex


class _Singularity(NamedTuple):
    """Where it is, and the eigenvalue of H(s) at which two of them meet there; None: it is a pole.

    Where they pass one another it is no singularity, but what estimates from other points lead to as well.
    """

    s: complex
    meeting: complex | None
    passing: bool = False


class _Fit(NamedTuple):
    """The nearest singularity by a recurrence of some order, its misfit and the uncertainty, both relative."""

    order: int
    nearest: complex
    misfit: float
    uncertainty: float


class _Family(NamedTuple):
    """H(s) = constant + s slope, (2n, 2n), and T_0, T_1, ... of P(s), (terms, n, n)."""

    constant: Array
    slope: Array
    terms: Array

    def branch(self, points: Complex) -> _Branch:
        """P(s) at points (k,) where the series converges."""
        n, orders = self.terms.shape[1], np.arange(len(self.terms))
        powers = points[:, None] ** orders
        P = np.tensordot(powers, self.terms, 1)
        slope = np.tensordot(powers[:, :-1] * orders[1:], self.terms[1:], 1)
        bend = np.tensordot(powers[:, :-2] * (orders[2:] * orders[1:-1]), self.terms[2:], 1)
        A0, weight, direction = self.constant[:n, :n], -self.constant[:n, n:], self.slope[:n, :n]
        values, vectors = np.linalg.eig(A0 + points[:, None, None] * direction - weight @ P)
        slopes = np.einsum("kij,kji->ki", np.linalg.pinv(vectors), (direction - weight @ slope) @ vectors)
        return _Branch(P, slope, bend, values, slopes)

    def eigen(self, s: complex) -> tuple[Complex, Complex, Complex]:
        """Eigenvalues of H(s), their slopes, and eigenvectors as columns."""
        values, vectors = np.linalg.eig(self.constant + s * self.slope)
        slopes = np.einsum("ij,ji->i", np.linalg.pinv(vectors), self.slope @ vectors)
        return values, slopes, vectors


def nearest_singularity(begin: Start, A0: Array, Q: Array, direction: Array, guaranteed: float) -> float:
    """Distance from zero of the nearest singularity of P(s); inf where the series ends.

    Args:
        begin: of `series.start`.
        A0: (n, n) [1/s].
        Q: weight of the state, (n, n).
        direction: D, (n, n).
        guaranteed: a lower bound of it.
    """
    if not direction.any():
        return np.inf
    parts = separate(begin, A0, Q, direction)
    return float(max(guaranteed, min(_nearest_of(*part) for part in parts)))


def _nearest_of(begin: Start, A0: Array, Q: Array, direction: Array) -> float:
    """The same of a system that is one."""
    units = diagonal_scales(begin.riccati)  # of the states, so that T_0 has ones on its diagonal
    scale = _scale(begin, direction, units) if direction.any() else np.inf
    if not np.isfinite(scale):
        return np.inf
    terms = scaled_terms(begin, scale * direction, TERMS) / units[:, None] / units
    sizes = np.linalg.norm(terms, axis=(1, 2))
    if sizes[FIRST_TERMS:].max() <= VANISHED * sizes[:FIRST_TERMS].max():
        return np.inf
    sizes = sizes * np.arange(len(terms)) ** POWER
    by_terms = float(sizes[EARLY].max() / sizes[LATE].max()) ** (1.0 / (LATE.start - EARLY.start))
    constant, step = (units[:, None] * matrix / units for matrix in (A0, scale * direction))
    weight, zero = units[:, None] * (begin.root @ begin.root.T) * units, np.zeros_like(A0)
    family = _Family(
        np.block([[constant, -weight], [-over(Q, units), -constant.T]]),
        np.block([[step, zero], [zero, -step.T]]),
        terms,
    )
    return scale * _agreed(family, by_terms)


def _agreed(family: _Family, by_terms: float) -> float:
    """The nearest singularity that agrees with the terms of high order, or what these tell less its uncertainty."""
    fitted = recurrence(family.terms)
    most = (1.0 + UNCERTAIN) * by_terms
    if fitted is None or abs(abs(fitted.nearest) / by_terms - 1.0) > UNCERTAIN:
        return next(_singularities(family, CIRCLE * by_terms, most), (1.0 - UNCERTAIN) * by_terms)
    radius, allowed = abs(fitted.nearest), AGREEING * fitted.uncertainty + ACCURACY
    most = min(most, (1.0 + allowed) * radius)
    if fitted.order == 2 and (beside := _beside(family, fitted, allowed * radius)) is not None:
        # one that is nearer may be so weak that the terms do not tell of it yet
        return next(_singularities(family, CIRCLE * radius, NEARER * abs(beside.s), [beside]), abs(beside.s))
    return next(_singularities(family, CIRCLE * radius, most), (1.0 - fitted.uncertainty) * radius)


def _scale(begin: Start, direction: Array, units: Array) -> float:
    """Where terms up to FIRST_TERMS neither grow nor vanish; inf where they end before."""
    closed, step = (units[:, None] * matrix / units for matrix in (begin.closed_loop, direction))
    scale, middle = float(np.linalg.norm(closed) / np.linalg.norm(step)), FIRST_TERMS // 2
    for _ in range(PASSES):
        with np.errstate(over="ignore", invalid="ignore"):
            terms = scaled_terms(begin, scale * direction, FIRST_TERMS) / units[:, None] / units
            sizes = np.linalg.norm(terms, axis=(1, 2))
        if not np.isfinite(sizes).all():
            scale *= SMALLER
            continue
        if sizes[-2:].max() == 0.0:
            return np.inf
        change = float((sizes[middle - 1 : middle + 1].max() / sizes[-2:].max()) ** (1.0 / (FIRST_TERMS - middle)))
        scale *= change
        if abs(np.log(change)) < SETTLED:
            break
    return scale


def scaled_terms(begin: Start, direction: Array, count: int) -> Array:
    """T_0, ..., T_count of A0 + direction with epsilon = 1, numbers, (count + 1, n, n)."""
    weight, size = begin.root @ begin.root.T, len(direction)
    terms = np.zeros((count + 1, size, size))
    terms[0] = begin.riccati
    # T_1 S, T_2 S, ... beside one another and T_count, ..., T_1 below one another: their sums are products of matrices
    left, right = np.zeros((size, count * size)), np.zeros((count * size, size))
    for n in range(1, count + 1):
        moved = terms[n - 1] @ direction
        inner = left[:, : (n - 1) * size] @ right[(count - n + 1) * size :]
        terms[n] = begin.corrected(inner - moved - moved.T)
        left[:, (n - 1) * size : n * size] = terms[n] @ weight
        right[(count - n) * size : (count - n + 1) * size] = terms[n]
    return terms


def recurrence(terms: Array) -> _Fit | None:
    """The nearest singularity by a recurrence that n^p T_n obey, of the least order that fits; None where none does.

    The order is 2 where one pair of conjugate singularities is nearest. How the root changes from earlier terms to
    later ones is its uncertainty.
    """
    flat, orders = terms.reshape(len(terms), -1), np.maximum(np.arange(len(terms)), 1.0)[:, None]
    weighed = [flat * orders**power for power in POWERS]
    for order in ORDERS:
        fits = []
        for values in weighed:
            (early, _), (late, misfit) = (_dominant(values[window], order) for window in WINDOWS)
            fits.append(_Fit(order, late, misfit, abs(abs(early) / abs(late) - 1.0)))
        best = min(fits, key=lambda fit: fit.misfit)
        if max(best.misfit, best.uncertainty) < FITTING:
            return best
    return None


def _dominant(values: Array, order: int) -> tuple[complex, float]:
    """Inverse of the largest root of the recurrence that rows obey best, and its misfit, relative."""
    values = values / np.abs(values).max()
    count = len(values) - order
    columns = np.stack([values[order - k - 1 : order - k - 1 + count].ravel() for k in range(order)], axis=1)
    last = values[order:].ravel()
    factors = np.linalg.lstsq(columns, last, rcond=1e-10)[0]
    misfit = float(np.linalg.norm(last - columns @ factors) / np.linalg.norm(last))
    roots = np.roots([1.0, *-factors]).astype(complex)
    largest = roots[np.argmax(np.abs(roots))] if roots.any() else complex(np.nan)
    return 1.0 / complex(largest), misfit


def _estimates(points: Complex, branch: _Branch) -> tuple[Complex, list[tuple[int, int]]]:
    """Where a step from points (k,) finds eigenvalues to meet and, last, P a pole: (k, pairs + 1); and the pairs."""
    first, second = np.triu_indices(branch.values.shape[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        sums, slopes = (part[:, first] + part[:, second] for part in (branch.values, branch.slopes))
        meetings = points[:, None] - sums / slopes / 2
        poles = points + 2 * _to_pole(branch.slope, branch.bend)  # of a pole and what hardly changes beside it
    return np.column_stack([meetings, poles]), list(zip(first.tolist(), second.tolist(), strict=True))


def _followed(
    family: _Family, start: complex, branch: _Branch, k: int, pair: tuple[int, int] | None, estimate: complex
) -> _Singularity | None:
    """What Newton's method finds from an estimate at the k-th point; without a pair it is one of a pole."""
    values = branch.values[k]
    if pair is None:
        return _pole(family, start, values, branch.slopes[k], estimate)
    return _branch_point(family, start, values[pair[0]], -values[pair[1]])


def _beside(family: _Family, fitted: _Fit, allowed: float) -> _Singularity | None:
    """The singularity that is no further than allowed from the one of a recurrence; None: none is found."""
    place = complex(fitted.nearest.real, abs(fitted.nearest.imag))
    points = np.array([CIRCLE * place])
    branch = family.branch(points)
    estimates, pairs = _estimates(points, branch)
    away = np.abs(estimates[0] - place)
    for kind in np.argsort(away)[:TRIED]:
        if away[kind] < NEIGHBOURING * abs(place):
            pair = pairs[kind] if kind < len(pairs) else None
            new = _followed(family, points[0], branch, 0, pair, estimates[0, kind])
            if new is None or new.passing or abs(new.s - place) > allowed:
                continue
            if _is_reached(family, abs(points[0]), new):
                return new
    return None


def _singularities(family: _Family, radius: float, most: float, known: Sequence[_Singularity] = ()) -> Iterator[float]:
    """Distances of branch points and poles up to `most` that are found from a circle, the nearest first.

    Where one is known that is just beyond, fewer points and the estimates close to them are enough.
    """
    angles, far, beyond = (COARSE, CLOSE, CLOSELY) if known else (ANGLES, FAR, BEYOND)
    points = radius * np.exp(1j * np.linspace(0.0, np.pi, angles))
    branch = family.branch(points)
    estimates, pairs = _estimates(points, branch)
    ways = np.abs(estimates - points[:, None])
    near = np.argwhere((ways < far * radius) & (np.abs(estimates) < beyond * most))
    found = [*known, *_meetings_in_zero(family, radius, most)]
    for k, kind in near[np.argsort(ways[near[:, 0], near[:, 1]])]:
        pair = pairs[kind] if kind < len(pairs) else None
        like = (other.s for other in found if (other.meeting is None) == (pair is None))
        estimate = estimates[k, kind]
        if any(min(abs(s - estimate), abs(s.conjugate() - estimate)) < SAME * ways[k, kind] for s in like):
            continue
        new = _followed(family, points[k], branch, k, pair, estimate)
        if new is not None:
            found.append(new)
    for entry in sorted(found, key=lambda entry: abs(entry.s)):
        if abs(entry.s) < most and not entry.passing and _is_reached(family, radius, entry):
            yield abs(entry.s)


def _meetings_in_zero(family: _Family, radius: float, most: float) -> list[_Singularity]:
    """Where eigenvalues of H(s) meet in zero, which is where H(s) is singular."""
    inverses = np.linalg.eigvals(np.linalg.solve(family.constant, -family.slope)).astype(complex)
    places = 1.0 / inverses[(np.abs(inverses) > 1.0 / most) & (inverses.imag <= 0.0)]
    return [_Singularity(s, 0j) for s in places if abs(s) > radius and _is_branch_point(family, s, 0j, radius)]


def _to_pole(P: Complex, slope: Complex) -> Any:
    """How far the pole is where P(s) is nothing but one, of one or more P and P'."""
    return np.sum(np.abs(P) ** 2, axis=(-2, -1)) / np.sum(P.conj() * slope, axis=(-2, -1))


def _is_reached(family: _Family, radius: float, singularity: _Singularity) -> bool:
    """Whether P itself has a singularity, and not another solution: by following its eigenvalues from the circle."""
    end, meeting, _ = singularity
    start = radius * end / abs(end)
    branch = family.branch(np.array([start]))
    values, slopes, before = branch.values[0], branch.slopes[0], start
    for share in SHARES:
        at = start + share * (end - start)
        found = family.eigen(at)
        chosen = _nearest(values + slopes * (at - before), found[0])
        values, slopes, before = found[0][chosen], found[1][chosen], at
    if meeting is not None:
        return len({*_pair(found[0], meeting)} & set(chosen.tolist())) == 1
    n = values.size
    P = found[2][n:, chosen] @ np.linalg.pinv(found[2][:n, chosen], rcond=1e-300)
    return bool(np.linalg.norm(P) > LARGER * np.linalg.norm(branch.P[0]))


def _nearest(wanted: Complex, values: Complex) -> NDArray[np.intp]:
    """Which of some values are nearest to those wanted, each once."""
    from scipy.optimize import linear_sum_assignment

    return np.asarray(linear_sum_assignment(np.abs(wanted[:, None] - values))[1])


def _pair(values: Complex, mean: complex) -> tuple[int, int]:
    """The two eigenvalues that are nearest to one another and to a mean."""
    first, second = np.triu_indices(values.size, 1)
    away = np.abs((values[first] + values[second]) / 2 - mean) + np.abs(values[first] - values[second]) / 2
    best = int(np.argmin(away))
    return int(first[best]), int(second[best])


def _branch_point(family: _Family, start: complex, one: complex, other: complex) -> _Singularity | None:
    """Where two eigenvalues of H(s) meet, or pass; None where they are lost."""
    s, size, values, last = start, abs(start), family.eigen(start), np.inf
    a, b = (int(np.argmin(np.abs(values[0] - value))) for value in (one, other))
    for _ in range(NEWTON_STEPS):
        eigenvalues, slopes, _ = values
        difference = eigenvalues[a] - eigenvalues[b]
        change = -difference / (2 * (slopes[a] - slopes[b])) if slopes[a] != slopes[b] else 0j
        if not np.isfinite(change) or abs(s - start) > size:
            return None
        if abs(change) < CONVERGED * size or last <= abs(change) < ROUNDING * size:
            break
        last = abs(change)
        mean = (eigenvalues[a] + eigenvalues[b] + (slopes[a] + slopes[b]) * change) / 2
        s, values = s + change, family.eigen(s + change)
        a, b = _pair(values[0], mean)
    else:
        return None
    mean = complex(values[0][a] + values[0][b]) / 2
    return _Singularity(s, mean, not _is_branch_point(family, s, mean, size))


def _is_branch_point(family: _Family, s: complex, meeting: complex, size: float) -> bool:
    """Whether eigenvalues that meet at s do not pass one another."""
    squares = []
    for distance in (NEAR * size, 4 * NEAR * size):
        eigenvalues = family.eigen(s * (1 - distance / abs(s)))[0]
        a, b = _pair(eigenvalues, meeting)
        squares.append(abs(eigenvalues[a] - eigenvalues[b]) ** 2)
    return bool(squares[1] < PASSING * squares[0])


def _pole(family: _Family, start: complex, values: Complex, slopes: Complex, guess: complex) -> _Singularity | None:
    """Where P(s) becomes infinite along the branch with these eigenvalues at the start; None where it does not."""
    s, size, n, last = start, abs(start), values.size, np.inf
    change = guess - start
    for _ in range(NEWTON_STEPS):
        wanted = values + slopes * change
        s = s + change
        found = family.eigen(s)
        chosen = _nearest(wanted, found[0])
        values, slopes = found[0][chosen], found[1][chosen]
        upper, lower = found[2][:n, chosen], found[2][n:, chosen]
        inverse = np.linalg.pinv(upper, rcond=1e-300)
        right = lower.T @ family.slope[:n, :n] @ upper
        P = lower @ inverse
        slope = -inverse.T @ ((right + right.T) / (values[:, None] + values)) @ inverse
        change = complex(_to_pole(P, slope))
        if last < ROUNDING * size and not abs(change) < last:  # also where P is infinite already
            return _Singularity(s, None)
        if not np.isfinite(change) or abs(s - start) > size:
            return None
        if abs(change) < CONVERGED * size:
            return _Singularity(s + change, None)
        last = abs(change)
    return None
