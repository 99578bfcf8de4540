"""A rigid spacecraft with three wheels and an attitude control that is held between its samples.

    J_b dw/dt + w x (J_b w + J_W r) = tau,  J_W dr/dt = -tau,  dC/dt = -w^x C,
    tau = -k_d w + k_p P_a(C_ba C_da')^vee

with the wheel speeds r and the torque tau of the wheels on the body, section 8 (signs and units as corrected there).
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from covocp.base.arguments import check_argument, positive
from covocp.base.dataclass import dataclass
from covocp.blocks import so3
from covocp.blocks.values import weight

Array = npt.NDArray[np.float64]

STATES = 10  # quaternion, angular velocity [rad/s], wheel speeds [rad/s]


@dataclass(frozen=True, kw_only=True)
class Spacecraft:
    """Inertias and gains.

    Args:
        inertia: of the body with its wheels at rest, J_b, numbers (3, 3) or its diagonal (3,) [kg m^2].
        wheel: moment of inertia of each wheel, J_W [kg m^2].
        damping: k_d [N m s].
        stiffness: k_p [N m].

    Raises:
        ProblemError: an inertia that is not positive definite, numbers that are not positive.
    """

    inertia: Any = (4.0, 4.0, 1.0)
    wheel: float = 0.04
    damping: float = 1.2
    stiffness: float = 0.96

    def __post_init__(self) -> None:
        for name in ("wheel", "damping", "stiffness"):
            check_argument("Spacecraft()", name, positive, getattr(self, name))
        given = np.asarray(self.inertia, dtype=float) if np.ndim(self.inertia) == 1 else self.inertia
        weight("inertia", np.diag(given) if np.ndim(given) == 1 else given, 3, definite=True)

    @property
    def matrix(self) -> Array:
        """J_b, (3, 3) [kg m^2]."""
        numbers = np.asarray(self.inertia, dtype=float)
        return np.diag(numbers) if numbers.ndim == 1 else numbers

    def acceleration(self, rate: Any, wheels: Any, torque: Any) -> Any:
        """dw/dt of angular velocity, wheel speeds and torque, SX or MX (3, 1) [rad/s^2]."""
        J = ca.DM(self.matrix)
        inverse = ca.DM(np.linalg.inv(self.matrix))
        return inverse @ (torque - ca.cross(rate, J @ rate + self.wheel * wheels))

    def torque(self, state: Any, desired: Any) -> Any:
        """tau of the attitude control.

        Args:
            state: (10, 1).
            desired: attitude, unit quaternion (4, 1).

        Returns:
            SX (3, 1) [N m].
        """
        C_bd = so3.from_quaternion(state[:4]) @ so3.from_quaternion(desired).T
        return -self.damping * state[4:7] + self.stiffness * so3.vee(so3.antisymmetric_part(C_bd))

    def step(self, state: Any, desired: Any, h: float) -> Any:
        """The state after a sample of the control, by a Lie-group Runge-Kutta step of order 4, section 2.

        Args:
            state: (10, 1).
            desired: attitude, unit quaternion (4, 1).
            h: time of the sample [s].

        Returns:
            SX (10, 1), with a quaternion of length one.
        """
        torque = self.torque(state, desired)
        wheels, slowing = state[7:], -torque / self.wheel

        def rates(y: Any, t: float) -> Any:
            sigma, rate = y[:3], y[3:]
            turn = ca.cross(sigma, rate)
            return ca.vertcat(
                rate + 0.5 * turn + ca.cross(sigma, turn) / 12, self.acceleration(rate, wheels + t * slowing, torque)
            )

        y = ca.vertcat(ca.SX.zeros(3, 1), state[4:7])
        first = rates(y, 0.0)
        second = rates(y + h / 2 * first, h / 2)
        third = rates(y + h / 2 * second, h / 2)
        fourth = rates(y + h * third, h)
        y = y + h / 6 * (first + 2 * second + 2 * third + fourth)
        quaternion = so3.quaternion_step(state[:4], y[:3])
        quaternion = quaternion / ca.sqrt(ca.sumsqr(quaternion))
        return ca.vertcat(quaternion, y[3:], wheels + h * slowing)
