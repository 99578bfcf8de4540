"""Vortex lattice of a planar wing, alone and in the wake of another one: lift, induced drag, rolling moment.

A wing is divided into strips along its span and each strip into panels along its chord. Every panel carries a horseshoe
vortex of unknown circulation: a bound piece along the panel's quarter-chord line, and from its two ends trailing lines
straight downstream. The flow must pass along the surface at the control point of each panel, at three quarters of the
panel's chord, in the middle of the cosine that spaces the strips:

    sum_j W_ij Gamma_j + alpha + w_i = 0

with W by the law of Biot and Savart, incidence alpha and an upwash w that others impose. The circulation is therefore
linear in alpha and w, W is factored once, and as w here is the same along a chord, a matrix of strips by strips is all
that is kept of it. Forces are found in two planes (all per unit of free stream and dynamic pressure, Gamma_j summed
over the chord):

    C_L  =  2/S sum Gamma_j dy_j,     C_l = -2/(S b) sum Gamma_j y_j dy_j     (positive: right wing down)
    C_Di = -1/S sum Gamma_j w_T,j dy_j - 2/S sum Gamma_j w_j dy_j

Far downstream, in the Trefftz plane, the trailing lines are doubly infinite and induce w_T, twice what the wing itself
feels; w is felt in full (Munk). The wake of a leader far ahead is such lines too: by Munk's stagger theorem the sum of
both drags does not depend on the distance. The viscous core of a line is that of Burnham and Hallock; one that lifts
the air on its right, as a right wing tip's does, has w = Gamma/(2 pi) dy/(dy^2 + dz^2 + r^2).

Axes: x downstream, y to the right, z upward; angles in radians, the free stream is one, so that circulations are
lengths. Incompressible, without camber, twist, thickness and friction; wakes stay flat unless `rolled_up`.

Sources: J. Katz, A. Plotkin, Low-Speed Aerodynamics, 2nd ed., Cambridge 2001, chapter 12 (lattice) and 8 (Trefftz
plane); M. M. Munk, The minimum induced drag of aerofoils, NACA report 121, 1921 (stagger, mutual drag); D. C. Burnham,
J. N. Hallock, Chicago monostatic acoustic vortex sensing system, vol. IV, DOT-TSC-FAA-79-18-4, 1982 (core).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.arguments import check_argument, checked, is_number, positive, share, whole
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

Array = npt.NDArray[np.float64]

SPANWISE, CHORDWISE = 40, 4
BOUND, CONTROL = 0.25, 0.75  # of a panel's chord: exact lift slope and moment of a flat plate in two dimensions
STEEPEST = np.deg2rad(80.0)  # of a sweep that is accepted


class Planform(Protocol):
    """A wing seen from above, symmetric about y = 0."""

    @property
    def span(self) -> float:
        """b [m]"""

    @property
    def area(self) -> float:
        """S [m^2]"""

    def chord(self, y: Array) -> Array:
        """Chord at some y, of y's shape [m]; it may vanish at the tips alone."""

    def quarter_chord(self, y: Array) -> Array:
        """How far downstream the quarter-chord line is at some y, of y's shape [m]."""


@dataclass(frozen=True, kw_only=True)
class Trapezoid:
    """A planform with straight edges on either side.

    Args:
        span: b [m].
        area: S [m^2].
        taper: tip chord over root chord, in (0, 1].
        sweep: of the quarter-chord line, positive backward [rad].

    Raises:
        ProblemError: lengths that are not positive, another taper, a sweep beyond 80 deg.
    """

    span: float
    area: float
    taper: float = 1.0
    sweep: float = 0.0

    def __post_init__(self) -> None:
        for name in ("span", "area"):
            check_argument("Trapezoid()", name, positive, getattr(self, name))
        check_argument("Trapezoid()", "taper", share, self.taper)
        check_argument(
            "Trapezoid()",
            "sweep",
            lambda v: "" if is_number(v) and abs(v) <= STEEPEST else "an angle within 80 deg, in radians",
            self.sweep,
        )

    def chord(self, y: Array) -> Array:
        """Chord at some y, of y's shape [m]."""
        root = 2 * self.area / (self.span * (1 + self.taper))
        return np.asarray(root * (1 - (1 - self.taper) * np.abs(2 * y / self.span)))

    def quarter_chord(self, y: Array) -> Array:
        """How far downstream of the root's the quarter-chord point at some y is, of y's shape [m]."""
        return np.asarray(np.abs(y) * np.tan(self.sweep))


@dataclass(frozen=True, kw_only=True, eq=False)
class Wing:
    """A wing whose lattice is solved: circulation of n strips for incidence and upwash; arrays are read-only.

    Args:
        span: b [m].
        area: S [m^2].
        edges: of the strips, from left to right, shape (n + 1,) [m].
        stations: y of the control points, shape (n,) [m].
        response: circulation of strip i for unit upwash at the stations j, shape (n, n) [m].
        far_field: upwash in the Trefftz plane at station i by unit circulation of strip j, shape (n, n) [1/m].
    """

    span: float
    area: float
    edges: Array
    stations: Array
    response: Array
    far_field: Array

    __repr__ = short_repr

    @property
    def widths(self) -> Array:
        """Of the strips, shape (n,) [m]."""
        return np.diff(self.edges)

    @property
    def lift_slope(self) -> float:
        """dC_L/dalpha [1/rad]."""
        return float(lift(self, circulation(self, 1.0)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Wake:
    """Doubly infinite vortex lines along the stream, all at one height; arrays are read-only.

    Args:
        lines: y of each, shape (k,) [m].
        strengths: circulation of each over the free stream; positive ones lift air on their right, shape (k,) [m].
        core: radius at which the swirl of a line is greatest, r [m]; 0: a line without core.
    """

    lines: Array
    strengths: Array
    core: float

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Flight:
    """A wing in trim at given lift; each array has the shape of the positions, the circulation strips as last axis.

    Args:
        incidence: alpha [rad].
        circulation: over the free stream [m].
        drag: induced drag coefficient.
        rolling_moment: C_l by the span, positive: right wing down.
    """

    incidence: Array
    circulation: Array
    drag: Array
    rolling_moment: Array

    __repr__ = short_repr


@checked(spanwise=whole(2, 2000), chordwise=whole(1, 200))
def lattice(planform: Planform, *, spanwise: int = SPANWISE, chordwise: int = CHORDWISE) -> Wing:
    """The wing of a planform, with cosine-spaced strips and equal panels along the chord.

    Args:
        planform: such as a `Trapezoid`.
        spanwise: number of strips over the whole span, even: a kink of the planform is at the middle.
        chordwise: number of panels of a strip.

    Raises:
        ProblemError: an odd number of strips, numbers out of range.
    """
    if spanwise % 2:
        raise co.ProblemError(
            "The strips of a wing do not meet at its middle.",
            expected="an even number of strips",
            received=f"spanwise={spanwise}",
            remedy="add one",
        )
    angle = np.pi * np.arange(spanwise + 1) / spanwise
    # Both halves from one: sine and cosine of mirrored angles differ in the last digit.
    edges = _mirrored(-0.5 * planform.span * np.cos(angle))
    stations = _mirrored(-0.5 * planform.span * np.cos(angle[1:] - 0.5 * np.pi / spanwise))
    influence = _influence(planform, edges, stations, chordwise)
    ones = np.tile(np.eye(spanwise), (chordwise, 1))
    panels = np.linalg.solve(influence, -ones)
    # One line on the left and one on the right of a strip, without core.
    away = 1.0 / (stations[:, None] - edges)
    return Wing(
        span=float(planform.span),
        area=float(planform.area),
        edges=_frozen(edges),
        stations=_frozen(stations),
        response=_frozen(panels.reshape(chordwise, spanwise, spanwise).sum(axis=0)),
        far_field=_frozen((away[:, 1:] - away[:, :-1]) / (2 * np.pi)),
    )


def circulation(wing: Wing, incidence: npt.ArrayLike, upwash: npt.ArrayLike = 0.0) -> Array:
    """Circulation of the strips for an incidence and an upwash, linear in both.

    Args:
        wing: of n strips.
        incidence: alpha, shape (...) [rad].
        upwash: w over the free stream, shape (..., n) or a number.

    Returns:
        Over the free stream, shape (..., n) [m].

    Raises:
        ProblemError: an upwash for another number of strips.
    """
    relative = _upwash(wing, upwash) + np.asarray(incidence, dtype=float)[..., None]
    return np.asarray(relative @ wing.response.T)


def lift(wing: Wing, circulation: Array) -> Array:
    """C_L = 2/S sum Gamma_j dy_j of circulations (..., n) [m], shape (...)."""
    return np.asarray(2 / wing.area * (circulation @ wing.widths))


def rolling_moment(wing: Wing, circulation: Array) -> Array:
    """C_l = -2/(S b) sum Gamma_j y_j dy_j of circulations (..., n) [m], positive: right wing down, shape (...)."""
    return np.asarray(-2 / (wing.area * wing.span) * (circulation @ (wing.widths * wing.stations)))


def induced_drag(wing: Wing, circulation: Array, upwash: npt.ArrayLike = 0.0) -> Array:
    """Induced drag coefficient in the Trefftz plane.

    Args:
        wing: of n strips.
        circulation: Gamma, shape (..., n) [m].
        upwash: that others impose, w over the free stream, shape (..., n) or a number.

    Returns:
        C_Di = -1/S sum Gamma_j dy_j (w_T,j + 2 w_j), shape (...).

    Raises:
        ProblemError: an upwash for another number of strips.
    """
    downstream = circulation @ wing.far_field.T + 2 * _upwash(wing, upwash)
    return np.asarray(-1 / wing.area * np.sum(circulation * downstream * wing.widths, axis=-1))


def trimmed(wing: Wing, lift_coefficient: float, upwash: npt.ArrayLike = 0.0) -> Flight:
    """The wing at the incidence at which it has some lift.

    Args:
        wing: of n strips.
        lift_coefficient: C_L.
        upwash: that others impose, w over the free stream, shape (..., n) or a number.

    Raises:
        ProblemError: an upwash for another number of strips, a lift that is no number.
    """
    _finite("trimmed()", "lift_coefficient", lift_coefficient)
    imposed = _upwash(wing, upwash)
    unit, extra = circulation(wing, 1.0), circulation(wing, 0.0, imposed)
    incidence = (lift_coefficient - lift(wing, extra)) / lift(wing, unit)
    total = extra + incidence[..., None] * unit
    return Flight(
        incidence=incidence,
        circulation=total,
        drag=induced_drag(wing, total, imposed),
        rolling_moment=rolling_moment(wing, total),
    )


def wake(wing: Wing, circulation: Array, core: float) -> Wake:
    """Flat wake of a wing: at each edge of a strip a line with what the circulation changes by there.

    Args:
        wing: of n strips.
        circulation: of its strips, shape (n,) [m].
        core: radius r [m].

    Raises:
        ProblemError: a core that is negative, circulations of another shape.
    """
    gamma = _strips(wing, circulation)
    return _wake(wing.edges, -np.diff(gamma, prepend=0.0, append=0.0), core)


def rolled_up(wing: Wing, circulation: Array, core: float) -> Wake:
    """Wake of a wing that has rolled up into two lines of the same lift, with the circulation of the middle.

    Args:
        wing: of n strips.
        circulation: of its strips, shape (n,) [m].
        core: radius r [m].

    Raises:
        ProblemError: a core that is negative, circulations of another shape or that are zero in the middle.
    """
    gamma = _strips(wing, circulation)
    middle = 0.5 * (gamma[gamma.size // 2 - 1] + gamma[gamma.size // 2])
    if middle == 0.0:
        raise co.ProblemError(
            "A wing without circulation in its middle has no two vortices.",
            expected="circulation in the middle",
            received="none",
            remedy="use wake(), which keeps the wake flat",
        )
    spacing = gamma @ wing.widths / middle
    return _wake(np.array([-0.5, 0.5]) * spacing, np.array([-middle, middle]), core)


def upwash(wake: Wake, y: npt.ArrayLike, height: npt.ArrayLike) -> Array:
    """Upwash by a wake over the free stream.

    Args:
        wake: of a wing at y = 0.
        y: to the right of that wing [m].
        height: above the wake [m]; of y's shape, or one that fits to it.

    Returns:
        w = 1/(2 pi) sum_k Gamma_k dy_k/(dy_k^2 + height^2 + r^2), of the common shape; NaN on a line without core.
    """
    at, above = np.broadcast_arrays(np.asarray(y, dtype=float), np.asarray(height, dtype=float))
    w, fixed = np.zeros(at.shape), above**2 + wake.core**2
    # One line at a time: all at once would be arrays of gigabytes, and slower.
    with np.errstate(divide="ignore", invalid="ignore"):
        for line, strength in zip(wake.lines, wake.strengths, strict=True):
            away = at - line
            w += strength * away / (away**2 + fixed)
    return w / (2 * np.pi)


def following(wing: Wing, wake: Wake, lift_coefficient: float, y: npt.ArrayLike, height: npt.ArrayLike) -> Flight:
    """A wing in trim in the wake of another one far ahead.

    Args:
        wing: the follower.
        wake: of the leader.
        lift_coefficient: C_L.
        y: of the follower's middle, to the right of the leader [m].
        height: above the leader's wake [m]; of y's shape, or one that fits to it.

    Returns:
        Trim, drag and rolling moment at each position, of the common shape.

    Raises:
        ProblemError: positions that do not fit to one another, a lift that is no number.
    """
    try:
        at, above = np.broadcast_arrays(np.asarray(y, dtype=float), np.asarray(height, dtype=float))
    except ValueError as error:
        raise co.ProblemError(
            "Positions to the side and heights do not fit to one another.",
            expected="shapes that broadcast",
            received=f"y of shape {np.shape(y)}, height of shape {np.shape(height)}",
            remedy="give y[:, None] and height[None, :] for a grid",
        ) from error
    return trimmed(wing, lift_coefficient, upwash(wake, at[..., None] + wing.stations, above[..., None]))


def _influence(planform: Planform, edges: Array, stations: Array, chordwise: int) -> Array:
    """W: upwash at control point i by unit circulation of horseshoe j, (m n, m n) [1/m]; strips vary fastest."""
    left, right = edges[:-1], edges[1:]
    part = np.arange(chordwise)[:, None]

    def line(y: Array, share: float) -> Array:
        """x at a share of each panel's chord, (m n,)."""
        along = (part + share) / chordwise - 0.25
        return np.asarray((planform.quarter_chord(y) + along * planform.chord(y)).ravel())

    x, y = line(stations, CONTROL)[:, None], np.tile(stations, chordwise)[:, None]
    x1, y1 = x - line(left, BOUND), y - np.tile(left, chordwise)
    x2, y2 = x - line(right, BOUND), y - np.tile(right, chordwise)
    r1, r2 = np.hypot(x1, y1), np.hypot(x2, y2)
    # Biot and Savart for the piece between both ends, in the form that is regular on its extensions.
    bound = (x1 * y2 - y1 * x2) * (r1 + r2) / (r1 * r2 * (r1 * r2 + x1 * x2 + y1 * y2))
    # Half-infinite lines: 1 + cos(angle) over the distance, the left one up to its end, the right one from it.
    trailing = (1 + x2 / r2) / y2 - (1 + x1 / r1) / y1
    return np.asarray((bound + trailing) / (4 * np.pi))


def _wake(lines: Array, strengths: Array, core: float) -> Wake:
    """A wake whose core is checked."""
    fits = is_number(core) and core >= 0
    check_argument("wake()", "core", lambda _: "" if fits else "a finite number >= 0", core)
    return Wake(lines=_frozen(lines), strengths=_frozen(strengths), core=float(core))


def _upwash(wing: Wing, upwash: npt.ArrayLike) -> Array:
    """An upwash as an array whose last axis is that of the strips."""
    w = np.asarray(upwash, dtype=float)
    if w.ndim == 0:
        return np.full(wing.stations.size, w)
    if w.shape[-1] != wing.stations.size:
        raise co.ProblemError(
            "The upwash does not fit to the strips of the wing.",
            expected=f"shape (..., {wing.stations.size}), or a number",
            received=f"shape {w.shape}",
            remedy="give the upwash at wing.stations",
        )
    return w


def _strips(wing: Wing, circulation: Array) -> Array:
    """Circulations of one flight."""
    gamma = np.asarray(circulation, dtype=float)
    if gamma.shape != wing.stations.shape:
        raise co.ProblemError(
            "The circulation does not fit to the strips of the wing.",
            expected=f"shape {wing.stations.shape}",
            received=f"shape {gamma.shape}",
            remedy="give the circulation of one flight of this wing",
        )
    return gamma


def _finite(owner: str, name: str, value: float) -> None:
    """A number must be finite."""
    check_argument(owner, name, lambda v: "" if is_number(v) else "a finite number", value)


def _mirrored(y: Array) -> Array:
    """Points of a symmetric wing, symmetric to the last digit."""
    return np.asarray(0.5 * (y - y[::-1]))


def _frozen(values: Array) -> Array:
    """A read-only array."""
    result = np.array(values, dtype=float)
    result.setflags(write=False)
    return result
