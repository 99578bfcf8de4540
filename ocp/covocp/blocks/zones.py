"""Pointing zones: cones that a body axis must stay in or keep out of, and the rows that they are to a small rotation.

An inclusion zone is x'C y >= cos(alpha), of a body axis x and an inertial direction y; keeping x out of a cone of half
angle alpha about y is staying in that of pi - alpha about -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from covocp.base.arguments import is_number
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr, Given
from covocp.base.short_repr import short_repr
from covocp.blocks.values import array, wrong_argument
from covocp.blocks.zone_programs import Rows

Array = NDArray[np.float64]
KINDS = ("inclusion", "exclusion")
# Body axis, inertial direction, half angle in degrees, "inclusion" or "exclusion".
ZoneLike = Any


@dataclass(frozen=True, kw_only=True, eq=False)
class Zone:
    """A zone as an inclusion zone, made by `zone`.

    Attributes:
        body: x, unit vector in body axes, (3,).
        direction: y, unit vector in inertial axes, (3,).
        angle: alpha, half angle of the cone that x stays in [rad].
        name: as the user gave it, for messages.
    """

    body: Array
    direction: Array
    angle: float
    name: str

    __repr__ = short_repr

    def value(self, attitude: Any) -> Any:
        """x'C y - cos(alpha) of a rotation matrix C, SX or numbers (..., 3, 3): not negative in the zone."""
        if isinstance(attitude, (ca.SX, ca.MX)):
            return ca.DM(self.body).T @ attitude @ ca.DM(self.direction) - np.cos(self.angle)
        return np.einsum("i,...ij,j->...", self.body, attitude, self.direction) - np.cos(self.angle)


def zone(body: ArrayLike, direction: ArrayLike, degrees: float, kind: str, *, margin: float = 0.0) -> Zone:
    """A pointing zone.

    Args:
        body: axis of the body that is watched, (3,), of any length but zero.
        direction: axis of the cone in inertial axes, (3,), of any length but zero.
        degrees: half angle of the cone, between 0 and 180 [deg].
        kind: "inclusion": the axis stays in the cone; "exclusion": it keeps out.
        margin: by which the zone is tightened [deg].

    Returns:
        The zone, as one of inclusion.

    Raises:
        ProblemError: an axis of no length, an angle outside (0, 180), an unknown kind, a margin that leaves nothing.
    """
    x, y = _unit("body axis", body), _unit("inertial direction", direction)
    if not is_number(degrees) or not 0 < degrees < 180:
        raise wrong_argument("zones", "half angles between 0 and 180 deg", f"{degrees!r}"[:60])
    if not isinstance(kind, str) or kind not in KINDS:
        raise wrong_argument("zones", "zones of the kind 'inclusion' or 'exclusion'", f"{kind!r}"[:60])
    name = f"{kind} of {np.round(x, 4).tolist()}, {degrees:g} deg about {np.round(y, 4).tolist()}"
    angle = float(degrees) if kind == "inclusion" else 180.0 - float(degrees)
    if not is_number(margin) or not 0 <= margin < angle:
        raise wrong_argument(
            "margin", f"a number from 0 to what a zone has, {angle:g} deg ({name})", f"{margin!r}"[:60]
        )
    return Zone(body=x, direction=-y if kind == "exclusion" else y, angle=float(np.radians(angle - margin)), name=name)


def zones_of(given: Sequence[ZoneLike], margin: float = 0.0) -> tuple[Zone, ...]:
    """Zones that no attitude can be said to fit to are refused.

    Args:
        given: each (body axis, inertial direction, half angle in degrees, kind).
        margin: by which each is tightened [deg].

    Raises:
        ProblemError: no list of such, or two zones that contradict one another: says which.
    """
    if not isinstance(given, (list, tuple)) or not all(isinstance(z, (list, tuple)) and len(z) == 4 for z in given):
        expected = "a list of (body axis, inertial direction, half angle in degrees, 'inclusion' or 'exclusion')"
        raise wrong_argument("zones", expected, f"{given!r}"[:100])
    made = tuple(zone(*entry, margin=margin) for entry in given)
    for first, second in combinations(made, 2):
        _check_pair(first, second)
    return made


def zone_rows(rotation: Expr, zones: Sequence[Zone]) -> Rows:
    """A d >= beta of section 3, the zones after a small rotation d from an attitude.

    Args:
        rotation: C, SX or numbers, (3, 3).
        zones: of number m.

    Returns:
        A (m, 3) and beta (m, 1), as SX or arrays.

    Raises:
        ProblemError: no rotation matrix, or no list of zones.
    """
    symbolic = isinstance(rotation, ca.SX)
    C: Any = rotation if symbolic else array("rotation", rotation)
    if C.shape != (3, 3):
        raise wrong_argument("rotation", "shape 3 x 3", " x ".join(str(size) for size in C.shape) or "a number")
    if not isinstance(zones, (list, tuple)) or not all(isinstance(entry, Zone) for entry in zones):
        raise wrong_argument("zones", "a list of zones", f"{zones!r}"[:100], "make them by zone() or zones_of()")
    rows: list[Any] = []
    bounds: list[Any] = []
    for each in zones:
        z = C @ (ca.DM(each.direction) if symbolic else each.direction)
        rows.append(ca.cross(ca.SX(ca.DM(each.body)), z).T if symbolic else np.cross(each.body, z))
        bounds.append(-each.value(C))
    if symbolic:
        return Rows(ca.vertcat(*rows) if rows else ca.SX(0, 3), ca.vertcat(*bounds) if bounds else ca.SX(0, 1))
    return Rows(np.array(rows).reshape(-1, 3), np.array(bounds).reshape(-1, 1))


def _unit(name: str, value: Given) -> Array:
    """A direction of length one."""
    numbers = np.ravel(array("zones", value))
    if numbers.shape != (3,) or not np.isfinite(numbers).all() or not np.linalg.norm(numbers) > 0:
        raise wrong_argument("zones", f"three finite numbers that are not all zero as {name}", f"{value!r}"[:60])
    return np.asarray(numbers / np.linalg.norm(numbers))


def _check_pair(first: Zone, second: Zone) -> None:
    """Points of two cones are at all angles from (between - reach) to (between + reach), within 0 and 180 deg.

    Raises:
        ProblemError: no attitude is in both.
    """
    apart = _angle(first.body, second.body)
    between, reach = _angle(first.direction, second.direction), first.angle + second.angle
    if between - reach <= apart <= between + reach:
        return
    raise ProblemError(
        "Two zones contradict one another: no attitude is in both.",
        expected="zones with an attitude in common",
        received=f"{first.name}; and {second.name}",
        remedy="widen one of them (a margin makes zones narrower)",
    )


def _angle(first: Array, second: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))
