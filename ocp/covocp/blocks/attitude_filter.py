"""The gradient of an unknown function of the attitude, in body axes, by a Kalman filter of differences of readings.

A. Walsh, J. R. Forbes, S. A. Chee, J. J. Ryan, J. Guidance, Control, and Dynamics, 2017, doi 10.2514/1.G002635, with
the corrections of docs/blocks/attitude_seeking.md; the equations are numbered as there.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import half_indices, half_length, standard_deviations
from covocp.base.short_repr import short_repr
from covocp.blocks.arithmetic import beside, where
from covocp.blocks.differences import independent, is_usable
from covocp.blocks.factors import in_turn_with_surprise, triangular
from covocp.blocks.quaternions import quaternion_product
from covocp.blocks.values import matrix

Array = NDArray[np.float64]

AXES = 3
QUATERNION = 4
# A rotation between two readings beyond this is left out: at pi its vector has two signs, and long before it the
# difference is not linear in it [rad].
LARGEST_TURN = 3.1
# Squared length of a quaternion that is one.
SHORTEST, LONGEST = 0.25, 4.0


class Memory(NamedTuple):
    """Where things are in the memory of an attitude seeker.

    attitudes: unit quaternions of the last readings, the newest first, each (4,).
    powers: of these readings.
    readings: their number so far, up to that of the window.
    attitude: the newest one, (4,).
    guided: that of the last guidance step, (4,).
    steps: number of guidance steps.
    gradient: b, (3,).
    factor: lower triangular L with L L' = P, column by column, (6,).
    direction: b as the guidance takes it: between the zones, limited, smoothed, (3,).
    """

    attitudes: slice
    powers: slice
    readings: slice
    attitude: slice
    guided: slice
    steps: slice
    gradient: slice
    factor: slice
    direction: slice

    @classmethod
    def of(cls, kept: int) -> Memory:
        """The layout for a number of readings that are kept."""
        sizes = [0, QUATERNION * kept, kept, 1, QUATERNION, QUATERNION, 1, AXES, half_length(AXES), AXES]
        return cls(*(slice(*pair) for pair in pairwise(np.cumsum(sizes).tolist())))

    @property
    def size(self) -> int:
        """Of the memory."""
        return int(self.direction.stop)


class Parts(NamedTuple):
    """A memory as matrices: attitudes (kept, 4), columns, and the factor L (3, 3)."""

    attitudes: Any
    powers: Any
    readings: Any
    attitude: Any
    guided: Any
    steps: Any
    gradient: Any
    factor: Any
    direction: Any


class Correction(NamedTuple):
    """What the differences of a reading say.

    gradient: b*, SX, (3, 1).
    factor: L of P*, SX, (3, 3).
    surprise: r'S^-1 r of the innovation r with the covariance S; zero without differences.
    """

    gradient: Any
    factor: Any
    surprise: Any


@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """What the filter is told.

    Attributes:
        window: N, number of differences.
        spacing: readings from one of them to the next.
        noise: variance of a reading, or of a difference where they are not correlated [W^2].
        correlated: whether the differences share the noise of the newest reading, (3).
        drift: what the variance of b gains in a guidance step, q_0 [(W/rad)^2].
        motion_drift: and by the square of the rotation in that step, h^2 [(W/rad^2)^2].
    """

    window: int
    spacing: int
    noise: float
    correlated: bool
    drift: float
    motion_drift: float

    @property
    def kept(self) -> int:
        """Number of readings in the memory."""
        return self.window * self.spacing


@dataclass(frozen=True, kw_only=True, eq=False)
class GradientEstimate:
    """What is known of the function at the last attitude; of many memories with their axes first.

    Attributes:
        gradient: b in body axes, (3,) [W/rad].
        covariance: of its error, (3, 3), positive semidefinite [(W/rad)^2].
        direction: what the guidance makes of it, (3,) [W/rad].
        attitude: the newest one, unit quaternion, (4,).
    """

    gradient: Array
    covariance: Array
    direction: Array
    attitude: Array

    __repr__ = short_repr

    @property
    def deviation(self) -> Array:
        """Standard deviation of each entry of the gradient, (3,) [W/rad]."""
        return standard_deviations(self.covariance)


def parts(memory: Expr, layout: Memory) -> Parts:
    """A memory taken apart."""
    lower = ca.SX(AXES, AXES)
    for k, (i, j) in enumerate(zip(*half_indices(AXES), strict=True)):
        lower[int(i), int(j)] = memory[layout.factor.start + k]
    columns = {name: memory[place] for name, place in layout._asdict().items()}
    kept = columns["powers"].shape[0]
    return Parts(**columns | {"attitudes": ca.reshape(columns["attitudes"], QUATERNION, kept).T, "factor": lower})


def joined(parts: Parts) -> Any:
    """A memory put together."""
    half = [parts.factor[int(i), int(j)] for i, j in zip(*half_indices(AXES), strict=True)]
    whole = parts._replace(attitudes=ca.vec(parts.attitudes.T), factor=ca.vertcat(*half))
    return ca.densify(ca.vertcat(*whole))


def turn_between(before: Expr, after: Expr) -> Any:
    """phi of e^(-phi^x) = C_after C_before', (2), of two unit quaternions, (3, 1) [rad].

    Raises:
        ProblemError: one of them has not four entries.
    """
    before, after = matrix("before", before, (QUATERNION, 1)), matrix("after", after, (QUATERNION, 1))
    turn = quaternion_product(ca.vertcat(before[0], -before[1:]), after)
    w, v = turn[0], turn[1:]
    square = ca.sumsqr(v)
    sine = ca.sqrt(ca.fmax(square, 1e-40))
    angle = 2 * ca.atan2(sine, ca.fabs(w))
    return ca.if_else(w < 0, -1, 1) * ca.if_else(square > 1e-40, angle / sine, 2) * v


def located(old: Parts, attitude: Expr) -> tuple[Any, Any]:
    """The attitude of a reading, of unit length, or the last one where it is none; and whether it is one."""
    square = ca.sumsqr(attitude)
    known = ca.logic_and(square >= SHORTEST, square <= LONGEST)
    return ca.if_else(known, attitude / ca.sqrt(ca.if_else(known, square, 1)), old.attitude), known


def recorded(old: Parts, attitude: Expr, power: Expr) -> Parts:
    """The memory with a reading more; without power the attitude alone."""
    place, known = located(old, attitude)
    there = ca.logic_and(known, is_usable(power))
    kept = old.powers.shape[0]
    return old._replace(
        attitudes=ca.if_else(there, ca.vertcat(place.T, old.attitudes[:-1, :]), old.attitudes),
        powers=ca.if_else(there, ca.vertcat(where(there, power), old.powers[:-1]), old.powers),
        readings=ca.fmin(old.readings + there, kept),
        attitude=place,
    )


def corrected(old: Parts, attitude: Expr, power: Expr, settings: FilterSettings) -> Correction:
    """Prediction (4) over the rotation since the last guidance step, then the differences of a new reading, (2), (3).

    Args:
        old: the memory before the reading.
        attitude: of the reading, (4, 1).
        power: of the reading; NaN: no differences.
        settings: of the filter.
    """
    place, known = located(old, attitude)
    there = ca.logic_and(known, is_usable(power))
    moved = where(old.steps > 0, turn_between(old.guided, place))
    growth = ca.sqrt(settings.drift + settings.motion_drift * ca.sumsqr(moved))
    lower = triangular(beside(old.factor, growth * ca.SX.eye(AXES)))
    rows, values, used = [], [], []
    for j in range(settings.spacing - 1, settings.kept, settings.spacing):
        turn = turn_between(old.attitudes[j, :].T, place)
        near = ca.sumsqr(turn) < LARGEST_TURN**2
        rows.append(turn.T)
        values.append(where(there, power) - old.powers[j])
        used.append(ca.logic_and(ca.logic_and(there, near), old.readings > j))
    H, y, taken = ca.vertcat(*rows), ca.vertcat(*values), ca.vertcat(*used)
    if settings.correlated:
        H, y, variances = independent(H, y, taken, settings.noise)
    else:
        H, y = where(ca.repmat(taken, 1, AXES), H), where(taken, y)
        variances = settings.noise * ca.DM.ones(settings.window, 1)
    residual = y - H @ old.gradient
    gradient, root, surprise = in_turn_with_surprise(old.gradient, lower, residual, H, variances)
    return Correction(gradient, triangular(root), surprise)
