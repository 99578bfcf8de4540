"""Induced drag and rolling moment of a transport in the wake of an identical one, as a table with cubic splines.

The pair is that of the formation example of J. J. Ryan, J. L. Speyer, Peak-seeking control using gradient and Hessian
estimates (American Control Conference 2010), which prints no table; this one is by `vortex_lattice`. Wings of a Boeing
747-100, span b = 59.64 m, area 511 m^2, taper 0.30, quarter-chord sweep 37.5 deg, untwisted, both at C_L = 0.654; core
of the wake 0.035 b. Positions are those of the follower's middle: y to the right of the leader, h above its wake, every
0.5 m in 54.9 +- 22 m by +- 16 m. Drag is in counts, 1e-4 of C_Di.

|                      | least drag   | at      | C_l there |
|----------------------|--------------|---------|-----------|
| flat wake, 0.035 b   | 80.7, -59 %  | 0.920 b | 0.0088    |
| core of 0.02 b       | -65 %        | 0.921 b |           |
| core of 0.05 b       | -54 %        | 0.917 b |           |
| rolled up, 0.035 b   | -73 %        | 0.885 b |           |

The drag of the wing alone is 197.6 counts. The Hessian at the minimum is 0.88 (y) and 5.6 (h) counts/m^2 in the
lattice, 1 % and 2 % more in the splines. Second differences over 1 m, about what a peak seeker meets, are 0.85 and 5.2:
within the core's radius of 2.1 m the drag is far from quadratic in h. With more strips the value of y is 0.85 too.

Beyond the table what the border promises is lost with the distance d from it, by 1/(1 + d/b)^2, as the upwash beside a
pair of vortices is: drag tends to that of the wing alone and C_l to zero. To the right this is within one count of the
lattice, above within 30; toward the leader the lattice has up to 300 counts more than the wing alone, and what is left
of the continuation is that it leads back. Derivatives jump at the border. `DragMap.inside` says what is in the table.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.arguments import checked, one_of, positive
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.models.formation import vortex_lattice

Array = npt.NDArray[np.float64]

PLANFORM = vortex_lattice.Trapezoid(span=59.64, area=511.0, taper=0.30, sweep=float(np.deg2rad(37.5)))
LIFT = 0.654  # C_L0
CORE = 0.035  # of the span
WAKES = ("flat", "rolled_up")
COUNT = 1e-4  # of a drag coefficient
CENTRE, WIDE, HIGH, STEP = 54.9, 22.0, 16.0, 0.5  # of the table [m]
NEWTON_STEPS = 20  # at most; from the best node three are enough
SETTLED = 1e-10  # length of the last step [m]


class Local(NamedTuple):
    """Drag [counts], its gradient, (2,) [counts/m], and its Hessian, (2, 2) [counts/m^2], at a position (y, h)."""

    drag: float
    gradient: Array
    hessian: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class DragMap:
    """Drag and rolling moment of the follower by its position (y, h); arrays are read-only.

    Args:
        y: nodes to the right of the leader, shape (89,) [m].
        h: nodes above the leader's wake, shape (65,) [m].
        drag: at the nodes, shape (89, 65) [counts].
        rolling_moment: C_l at the nodes, positive: right wing down, shape (89, 65).
        function: position, shape (2,) or columns (2, k) [m], to drag [counts] and rolling moment, shape (1, k).
        derivatives: position, shape (2,) [m], to drag, gradient (2,) and Hessian (2, 2) [counts, m].
        isolated: drag of the wing alone [counts].
        best: position of least drag, shape (2,) [m].
        at_best: drag, gradient and Hessian there.
    """

    y: Array
    h: Array
    drag: Array
    rolling_moment: Array
    function: ca.Function
    derivatives: ca.Function
    isolated: float
    best: Array
    at_best: Local

    __repr__ = short_repr

    def evaluate(self, positions: npt.ArrayLike) -> tuple[Array, Array]:
        """Drag and rolling moment at many positions.

        Args:
            positions: (y, h) as last axis, shape (..., 2) [m].

        Returns:
            Drag [counts] and C_l, both of shape (...).

        Raises:
            ProblemError: positions of another shape, or that are not finite.
        """
        points = _positions(positions)
        shape = points.shape[:-1]
        if not points.size:
            return np.empty(shape), np.empty(shape)
        drag, moment = self.function(points.reshape(-1, 2).T)
        return np.asarray(drag).reshape(shape), np.asarray(moment).reshape(shape)

    def local(self, position: npt.ArrayLike) -> Local:
        """Drag, gradient and Hessian at one position.

        Args:
            position: (y, h), shape (2,) [m].

        Raises:
            ProblemError: not one position, or one that is not finite.
        """
        return _local(self.derivatives, _positions(position, one=True))

    def inside(self, positions: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether positions, shape (..., 2) [m], are in the table, shape (...).

        Raises:
            ProblemError: positions of another shape, or that are not finite.
        """
        points = _positions(positions)
        lower, upper = (self.y[0], self.h[0]), (self.y[-1], self.h[-1])
        return np.asarray(np.all((points >= lower) & (points <= upper), axis=-1))

    def gap(self, drag: npt.ArrayLike) -> Array:
        """Share of the benefit that is not had: (f - f_best)/(f_isolated - f_best) of drags f [counts], shape kept."""
        return np.asarray((np.asarray(drag) - self.at_best.drag) / (self.isolated - self.at_best.drag))


@checked(core=positive, wake=one_of(*WAKES))
def drag_map(core: float = CORE, wake: str = "flat") -> DragMap:
    """The table behind an identical leader; the same object for the same arguments.

    Args:
        core: radius of the wake's vortices over the span.
        wake: "flat", or "rolled_up" into two vortices.

    Raises:
        ProblemError: a core that is not positive, another wake, no minimum inside the table.
    """
    return _made(float(core), wake)


@cache
def _made(core: float, wake: str) -> DragMap:
    """The table for checked arguments."""
    wing = vortex_lattice.lattice(PLANFORM)
    leader = vortex_lattice.trimmed(wing, LIFT)
    shed = vortex_lattice.rolled_up if wake == "rolled_up" else vortex_lattice.wake
    lines = shed(wing, leader.circulation, core * wing.span)
    y, h = _nodes(CENTRE, WIDE), _nodes(0.0, HIGH)
    flight = vortex_lattice.following(wing, lines, LIFT, y[:, None], h)
    drag, isolated = flight.drag / COUNT, float(leader.drag / COUNT)
    function = _function(y, h, drag, flight.rolling_moment, isolated, wing.span)
    derivatives = _derivatives(function)
    row, column = np.unravel_index(int(np.argmin(drag)), drag.shape)
    best = _minimum(derivatives, np.array([y[row], h[column]]))
    return DragMap(
        y=_frozen(y),
        h=_frozen(h),
        drag=_frozen(drag),
        rolling_moment=_frozen(flight.rolling_moment),
        function=function,
        derivatives=derivatives,
        isolated=isolated,
        best=_frozen(best),
        at_best=_local(derivatives, best),
    )


def _nodes(centre: float, half: float) -> Array:
    """Nodes of one direction [m]."""
    count = round(half / STEP)
    return np.asarray(centre + STEP * np.arange(-count, count + 1), dtype=np.float64)


def _function(y: Array, h: Array, drag: Array, moment: Array, isolated: float, span: float) -> ca.Function:
    """Splines within the table and their continuation beyond it, position (2,) to drag [counts] and C_l."""
    values = np.stack([(drag - isolated).ravel(order="F"), moment.ravel(order="F")]).ravel(order="F")
    splines = ca.interpolant("splines", "bspline", [y.tolist(), h.tolist()], values.tolist())
    position = ca.MX.sym("position", 2)
    within = ca.fmin(ca.fmax(position, ca.DM([y[0], h[0]])), ca.DM([y[-1], h[-1]]))
    beyond = position - within
    # The square root alone has no derivative at 0, where all of the table is.
    square = ca.sumsqr(beyond)
    outside = square > 0
    distance = ca.if_else(outside, ca.sqrt(ca.if_else(outside, square, 1.0)), 0.0)
    gained = splines(within) / (1.0 + distance / span) ** 2
    outputs = [isolated + gained[0], gained[1]]
    return ca.Function("drag_map", [position], outputs, ["position"], ["drag", "rolling_moment"])


def _derivatives(function: ca.Function) -> ca.Function:
    """Position to drag, gradient and Hessian."""
    position = ca.MX.sym("position", 2)
    drag = function(position)[0]
    hessian, gradient = ca.hessian(drag, position)
    outputs = [drag, gradient, hessian]
    return ca.Function("derivatives", [position], outputs, ["position"], ["drag", "gradient", "hessian"])


def _minimum(derivatives: ca.Function, start: Array) -> Array:
    """Position of least drag by Newton's method from the best node.

    Raises:
        ProblemError: there is none near the node.
    """
    position = start
    step = np.full(2, np.inf)
    for _ in range(NEWTON_STEPS):
        at = _local(derivatives, position)
        step = -np.linalg.solve(at.hessian, at.gradient)
        position = position + step
        if np.linalg.norm(step) < SETTLED:
            break
    if np.linalg.norm(step) >= SETTLED or np.abs(position - start).max() > STEP:
        raise co.ProblemError(
            "The drag has no minimum inside the table.",
            expected="a core that leaves one",
            received=f"a best node at y = {start[0]:g} m, h = {start[1]:g} m",
            remedy="give another core",
        )
    return position


def _local(derivatives: ca.Function, position: Array) -> Local:
    """Values of the derivatives as arrays of numpy."""
    drag, gradient, hessian = derivatives(position)
    return Local(float(drag), _frozen(np.asarray(gradient).ravel()), _frozen(np.asarray(hessian)))


def _positions(positions: npt.ArrayLike, *, one: bool = False) -> Array:
    """Positions as an array whose last axis is (y, h)."""
    points = np.asarray(positions, dtype=float)
    if points.ndim == 0 or points.shape[-1] != 2 or (one and points.ndim > 1) or not np.isfinite(points).all():
        raise co.ProblemError(
            "This is not a position." if one else "These are not positions.",
            expected="finite numbers of shape " + ("(2,)" if one else "(..., 2)") + ": to the right and above [m]",
            received=f"shape {points.shape}" + ("" if np.isfinite(points).all() else " with NaN or inf"),
            remedy="give y and h as the last axis",
        )
    return points


def _frozen(values: Array) -> Array:
    """A read-only array."""
    result = np.array(values, dtype=float)
    result.setflags(write=False)
    return result
