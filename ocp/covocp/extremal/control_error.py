"""What the piecewise form of the control costs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.costates import discrete_costates
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import refined, with_parts
from covocp.extremal.hamiltonian import Costates, by_controls_at, terms_of
from covocp.extremal.hamiltonian_in_numbers import ByControls
from covocp.extremal.inside import controlled_nodes
from covocp.statement.interval import repeated

# A truth value for each control of each interval.
Mask = NDArray[np.bool_]

# Integrals over [0, 1] of the products of the quadratic polynomials that are 1 at one of 0, 1/2, 1 and 0 at the others.
QUADRATIC_PRODUCTS = np.array([[4.0, 2.0, -1.0], [2.0, 16.0, 2.0], [-1.0, 2.0, 4.0]]) / 30.0
# Weights of the integral over [0, 1] of a value at 0, 1/2 and 1.
SIMPSON = np.array([1.0, 4.0, 1.0]) / 6.0
# One more control value in each interval: integral of the square of what it adds over [0, 1], a hat, or a step by 1/2
# up and down; by how much more the cost falls with the best control, whose difference from the form is taken for
# s^2 - s + 1/6 (linear) or s - 1/2 (constant) in each interval.
HAT, STEP = (1.0 / 3.0, 64.0 / 15.0), (1.0 / 4.0, 4.0 / 3.0)
# A multiplier of a control bound above this share of the largest slope counts the bound as active.
ACTIVE = 1e-5
# Share of the terms of H_u up to which its change over the magnitude of a control may be rounding: H is linear in it.
ROUNDING = 1e-8
# Share of its range within which a control counts as at a bound.
AT_BOUND = 1e-2
# Parts of an interval whose ends a polynomial goes through, and its values in the middles of many equal parts.
PARTS, MANY = 4, 64
SAMPLES = np.vander((np.arange(MANY) + 0.5) / MANY, PARTS + 1) @ np.linalg.inv(
    np.vander(np.arange(PARTS + 1) / PARTS, PARTS + 1)
)


class Kinds(NamedTuple):
    """Which controls count, and how.

    Attributes:
        nodes: free at the nodes, (N + 1, nu).
        free: in each interval free in all of it, (N, nu).
        bounded: at a bound somewhere in it.
    """

    nodes: Mask
    free: Mask
    bounded: Mask


def kinds_of(extremal: Extremal) -> Kinds:
    """Controls that count: none where they act beside H_u."""
    slopes, beside = discrete_costates(extremal)[1], _beside(extremal)[:, None]
    free = np.abs(extremal.multipliers.controls) <= ACTIVE * np.abs(slopes).max(initial=0.0)
    if free.shape[0] == extremal.mesh.intervals:
        free = np.vstack([free, free[-1:]])
    free = free & ~beside
    whole = free[:-1] & free[1:]
    return Kinds(nodes=free, free=whole, bounded=~whole & ~(beside[:-1] | beside[1:]))


def _beside(extremal: Extremal) -> Mask:
    """Nodes whose control acts beside H_u: through what is read there at an instant, or in a condition there."""
    result = np.zeros(extremal.mesh.intervals + 1, dtype=bool)
    result[controlled_nodes(extremal)] = True
    samples = extremal.statement.samples
    if samples is not None and any(samples.measurement.jac_sparsity(i, 1).nnz() for i in (1, 2)):
        result[extremal.mesh.instants] = True
    return result


def estimate_control_error(
    extremal: Extremal, kinds: tuple[Mask, Mask], size: float, *, convex_alone: bool = False
) -> float | None:
    """Relative cost of the piecewise form of the control: 1/2 int H_u H_uu^-1 H_u dt.

    H_u is a quadratic polynomial through its values at both ends and in the middle of an interval. Controls at a bound
    somewhere in it count with what the Hamiltonian, quadratic in each of them, can fall between the bounds, by
    Simpson's rule. Controls in which H is not convex over an interval, as where it is linear in them, count with what
    it is above its values with the controls before, in and after it (`_above`).

    All costates are those of the discrete steps: fast ones are no polynomial over an interval.

    Args:
        extremal: the solution.
        kinds: of the controls in each interval, (N, nu): free in all of it; at a bound somewhere. Others do not count.
        size: of the cost, in which it is measured.
        convex_alone: leave out those in which H is not convex, of which it is known to no more than ten times.

    Returns:
        The share of the cost; None where H is not known pointwise, and needed; nan where there is one control alone,
        with no other to compare it with.
    """
    points, around = extremal.mesh.points, _around(extremal)
    if points > 1:  # costates jump inside the intervals
        extremal, kinds = refined(extremal), (np.repeat(kinds[0], points, axis=0), np.repeat(kinds[1], points, axis=0))
        around = np.repeat(around, points, axis=1)
    along = _Along.of(extremal, 2)
    places = along.everywhere()
    convex = _convex(places, _magnitudes(extremal))
    if extremal.mesh.step == "rodas":
        total = _by_middles(extremal, along, convex, kinds, places[1].curvature)
    else:
        total = _by_points(extremal, along, convex, kinds, places)
        left = (kinds[0] | kinds[1]) & ~convex
        if left.any() and not convex_alone:
            total += _above(extremal, left, around)
    return None if total is None else float(total / max(size, np.finfo(float).tiny))


@dataclass(frozen=True, kw_only=True)
class _Along:
    """The Hamiltonian at the places of each interval that end equal parts of it.

    Attributes:
        fine: the extremal with these places as nodes.
        parts: of each interval.
        ends: controls at both ends of each interval (2, N, nu).
    """

    fine: Extremal
    parts: int
    ends: tuple[Array, Array]

    __repr__ = short_repr

    @staticmethod
    def of(extremal: Extremal, parts: int) -> _Along:
        """Of an extremal whose limits are imposed at its nodes."""
        u = extremal.controls
        return _Along(
            fine=with_parts(extremal, parts),
            parts=parts,
            ends=(u[:-1], u[:-1] if extremal.mesh.control == "constant" else u[1:]),
        )

    def control(self, j: int) -> Array:
        """The control there, (N, nu)."""
        return self.ends[0] + j / self.parts * (self.ends[1] - self.ends[0])

    def everywhere(self) -> list[ByControls]:
        """H_u, H_uu and terms of H_u at each place of all intervals."""
        points, costates = zip(*[self._points(j, self.control(j)) for j in range(self.parts + 1)], strict=True)
        columns = [np.concatenate(parts, axis=1) for parts in zip(*points, strict=True)]
        together = Costates(
            state=np.concatenate([own.state for own in costates]),
            matrices=np.concatenate([own.matrices for own in costates]),
        )
        found = by_controls_at(self.fine.statement, columns, together)
        return [ByControls(*parts) for parts in zip(*(np.split(v, self.parts + 1) for v in found), strict=True)]

    def values(self, j: int, control: Array) -> Array:
        """H there with another control, (N,)."""
        return np.asarray(terms_of(self.fine.statement, *self._points(j, control)).sum(axis=1))

    def _points(self, j: int, control: Array) -> tuple[list[Array], Costates]:
        """Arguments of the model at place j of all intervals, a column each, and costates."""
        fine, n = self.fine, self.ends[0].shape[0]
        costates, t = discrete_costates(fine)[0], fine.trajectory
        at = slice(j, j + self.parts * (n - 1) + 1, self.parts)
        columns = [t.x[at].T, control.T, t.e[at].T, fine.time[None, at], *repeated(t.duration, fine.parameters, n)]
        return columns, Costates(state=costates.state[at], matrices=costates.matrices[at])


def _convex(places: Sequence[ByControls], magnitudes: Array) -> Mask:
    """Controls of each interval in which H is strictly convex, all of them together, at all places, (N, nu).

    Beyond rounding: over the magnitude of a control its slope changes by more than a share of what this is a sum of.
    """
    bends, terms = np.array([place.curvature for place in places]), np.array([place.sizes for place in places])
    beyond = np.diagonal(bends, axis1=2, axis2=3) * magnitudes > ROUNDING * terms
    found: Mask = np.all(beyond, axis=0)
    block = np.where(found[:, :, None] & found[:, None, :], bends, np.eye(bends.shape[-1]))
    return np.asarray(found & (np.linalg.eigvalsh(block)[..., :1] > 0).all(axis=0))


def _magnitudes(extremal: Extremal) -> Array:
    """Of the controls (nu,): the largest on the way, the range of the bounds where that is zero, else 1."""
    lower, upper = extremal.statement.control_bounds
    largest = np.abs(extremal.controls).max(axis=0)
    ranges = np.where(np.isfinite(upper - lower) & (upper > lower), upper - lower, 1.0)
    return np.where(largest > 0.0, largest, ranges)


def _among(convex: Mask, curvature: Array) -> Array:
    """H_uu of the controls in which H is convex, beside a unit matrix."""
    return np.where(convex[:, :, None] & convex[:, None, :], curvature, np.eye(convex.shape[1]))


def _around(extremal: Extremal) -> Array:
    """Controls that each interval may have instead: those of its ends and of the intervals beside it, (m, N, nu).

    Where all of these are at one bound the other is among them, or the value farthest from it; where one control value
    is all there is, both bounds, NaN where there are none.
    """
    u, constant = extremal.controls, extremal.mesh.control == "constant"
    first, last = u[:-1], u[:-1] if constant else u[1:]
    places = np.flatnonzero(np.diff(extremal.mesh.nodes) > 0)  # what is read at an instant has an interval of no length
    lower, upper = extremal.statement.control_bounds
    if constant and places.size < 2:
        return np.array([np.where(np.isfinite(bound), bound, np.nan) + 0.0 * first for bound in (lower, upper)])
    own = np.clip(np.searchsorted(places, np.arange(first.shape[0])), 0, places.size - 1)
    before, after = places[np.maximum(own - 1, 0)], places[np.minimum(own + 1, places.size - 1)]
    found = np.array([first[before], first, last, last[after]])
    used = np.concatenate([first[places], last[places]])
    least, most = (
        np.where(np.isfinite(lower), lower, used.min(axis=0)),
        np.where(np.isfinite(upper), upper, used.max(axis=0)),
    )
    near = AT_BOUND * (most - least)
    other = np.where((found <= least + near).all(axis=0), most, first)
    other = np.where((found >= most - near).all(axis=0), least, other)
    return np.concatenate([found[[0, 3]] if constant else found, other[None]])


def _by_points(
    extremal: Extremal, along: _Along, convex: Mask, kinds: tuple[Mask, Mask], found: list[ByControls]
) -> float:
    """By what is found at the ends and in the middles of the intervals, of the controls in which H is convex."""
    bounds, (free, bounded) = extremal.statement.control_bounds, kinds
    places = [(along.control(j), slope, bend) for j, (slope, bend, _) in enumerate(found)]
    falls = [np.where(bounded & convex, _fall(u, slope, bend, *bounds), 0.0).sum(axis=1) for u, slope, bend in places]
    slopes = np.array([np.where(free & convex, slope, 0.0) for _, slope, _ in places])
    steps = np.linalg.solve(_among(convex, places[1][2]), slopes[..., None])[..., 0]
    gained = 0.5 * np.einsum("jk,jni,kni->n", QUADRATIC_PRODUCTS, slopes, steps)
    return float(np.diff(extremal.time) @ (gained + SIMPSON @ np.array(falls)))


def _above(extremal: Extremal, left: Mask, around: Array) -> float:
    """By how much H is above its least value with one of the controls around, each of those left by itself.

    The differences are polynomials through five places of each interval: along a singular arc with constant controls
    they vanish at both ends and in the middle.

    Args:
        extremal: whose limits are imposed at its nodes.
        left: controls that count, (N, nu).
        around: other controls for each interval, (m, N, nu).
    """
    along, total = _Along.of(extremal, PARTS), 0.0
    for i in np.flatnonzero(left.any(axis=0)):
        differences = np.zeros((around.shape[0], PARTS + 1, left.shape[0]))
        for j in range(PARTS + 1):
            u = along.control(j)
            value = along.values(j, u)
            for difference, other in zip(differences, around, strict=True):
                moved = u.copy()
                moved[:, i] = other[:, i]
                difference[j] = along.values(j, moved) - value
        falls = np.maximum(-(SAMPLES @ differences).min(axis=0), 0.0).mean(axis=0)
        total += float(np.diff(extremal.time) @ np.where(left[:, i], falls, 0.0))
    return total


def _by_middles(
    extremal: Extremal, along: _Along, convex: Mask, kinds: tuple[Mask, Mask], middle: Array
) -> float | None:
    """By what another value in the middle of each interval, of this H_uu there, changes the discrete cost.

    Implicit steps that are longer than a fast state lives add up what it does, and so does their adjoint: its costate
    at a node may be off by a third, H_u with it, while slopes by control values are exact. A control that changes
    within a fraction of a step is not seen.
    """
    st, (free, bounded) = extremal.statement, kinds
    if not convex[free | bounded].all():
        return None
    square, more = HAT if extremal.mesh.control == "linear" else STEP
    weights = square * np.where((h := np.diff(extremal.time)) > 0, h, 1.0)
    slopes = np.where(h[:, None] > 0, discrete_costates(along.fine)[1][1::2], 0.0) / weights[:, None]
    curvature = _among(convex, middle)
    inside = np.where(free, slopes, 0.0)
    gained = 0.5 * np.sum(inside * np.linalg.solve(curvature, inside[..., None])[..., 0], axis=1)
    gained += np.where(bounded, _fall(along.control(1), slopes, curvature, *st.control_bounds), 0.0).sum(axis=1)
    return float(more * weights @ gained)


def _fall(u: Array, slope: Array, curvature: Array, lower: Array, upper: Array) -> Array:
    """What a function with these slopes and curvatures, (n, nu, nu), falls where entries of u move within bounds."""
    bend = np.diagonal(curvature, axis1=1, axis2=2)
    bend = np.where(bend > 0, bend, 1.0)
    move = np.clip(u - slope / bend, lower, upper) - u
    return np.asarray(np.maximum(-(slope * move + bend / 2 * move**2), 0.0))
