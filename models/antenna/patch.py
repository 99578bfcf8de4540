"""Power that a rectangular patch antenna receives from a source, as a smooth function of the attitude.

Two-slot model of the mode TM10, resonant length a along b1, width W along b2, C. A. Balanis, Antenna Theory: with the
source direction (u, v, w) = C_ba a in the body frame and the free-space wavenumber k,

    J = G0 (1 - v^2) sinc(k W v / 2)^2 cos(k a u / 2)^2,  w >= 0,

analytic in u and v. Behind the patch it is multiplied by exp(-(w / 0.15)^2), which no source has.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from covocp.base.arguments import check_argument, one_of, positive
from covocp.base.dataclass import dataclass
from covocp.blocks import so3
from covocp.blocks.rotation_series import sine, versine

Array = npt.NDArray[np.float64]

BEHIND = 0.15  # decay of the power behind the patch, in w


@dataclass(frozen=True, kw_only=True)
class Patch:
    """A patch antenna; its beam is along b3.

    Args:
        peak: G0, power at the peak [W].
        permittivity: of the substrate; k a = pi / sqrt(permittivity).
        aspect: length over width, a / W.
        pattern: "two-slot", or "cavity": with the magnetic currents of all four walls.
        azimuth: "source": of the source in the body frame; "literal": cos(phi) = b1 . a1 as printed in the paper, which
            is not a function of the source direction alone.

    Raises:
        ProblemError: numbers that are not positive, another word.
    """

    peak: float = 4.61
    permittivity: float = 2.32
    aspect: float = 1.5
    pattern: str = "two-slot"
    azimuth: str = "source"

    def __post_init__(self) -> None:
        for name in ("peak", "permittivity", "aspect"):
            check_argument("Patch()", name, positive, getattr(self, name))
        check_argument("Patch()", "pattern", one_of("two-slot", "cavity"), self.pattern)
        check_argument("Patch()", "azimuth", one_of("source", "literal"), self.azimuth)

    @property
    def curvatures(self) -> tuple[float, float]:
        """Of the power at the peak, of rotations about b1 and b2 [W/rad^2]."""
        length = np.pi / np.sqrt(self.permittivity)
        width = length / self.aspect
        return -2 * self.peak * (1 + width**2 / 12), -2 * self.peak * (length / 2) ** 2

    def power(self, attitude: Any, source: Any) -> Any:
        """J of an attitude.

        Args:
            attitude: C_ba, SX (3, 3).
            source: direction of the source in the inertial frame, unit vector, SX or DM (3, 1).

        Returns:
            SX [W].
        """
        u, v, w = ca.vertsplit(attitude @ source)
        square_u, square_v = u**2, v**2
        if self.azimuth == "literal":
            square_u, square_v = (1 - w**2) * attitude[0, 0] ** 2, (1 - w**2) * (1 - attitude[0, 0] ** 2)
        length = np.pi / np.sqrt(self.permittivity)
        x, y = (length / 2) ** 2 * square_u, (length / self.aspect / 2) ** 2 * square_v
        if self.pattern == "cavity":
            ratio = square_u / (self.permittivity - square_u)
            shape = 1 + ratio * square_v / (self.permittivity - square_u) - square_v * (1 + ratio) ** 2
        else:
            shape = 1 - square_v
        front = self.peak * shape * sine(y) ** 2 * (1 - x * versine(x)) ** 2
        return front * ca.if_else(w < 0, ca.exp(-((w / BEHIND) ** 2)), 1)

    def evaluate(self, attitudes: npt.ArrayLike, sources: npt.ArrayLike = (0.0, 0.0, 1.0)) -> tuple[Array, Array]:
        """Power and its gradient in body axes, J(e^(-phi^x) C) = J + b'phi + ..., of many attitudes.

        Args:
            attitudes: unit quaternions, (..., 4).
            sources: unit vectors in the inertial frame, of shape (..., 3) or one that broadcasts to it.

        Returns:
            J (...) [W] and b (..., 3) [W/rad].
        """
        quaternions = np.asarray(attitudes, dtype=float)
        shape = quaternions.shape[:-1]
        directions = np.broadcast_to(np.asarray(sources, dtype=float), (*shape, 3))
        function = self.function().map(max(1, int(np.prod(shape))))
        power, gradient = function(quaternions.reshape(-1, 4).T, directions.reshape(-1, 3).T)
        return np.asarray(power.full()).reshape(shape), np.asarray(gradient.full()).T.reshape(*shape, 3)

    def function(self) -> ca.Function:
        """casadi.Function (quaternion, source) -> (power, gradient in body axes)."""
        return _function(self)


@lru_cache(maxsize=16)
def _function(patch: Patch) -> ca.Function:
    """Power and gradient of a patch, made once: as long as a thousand evaluations."""
    quaternion, source, phi = ca.SX.sym("quaternion", 4), ca.SX.sym("source", 3), ca.SX.sym("phi", 3)
    power = patch.power(so3.exp(phi) @ so3.from_quaternion(quaternion), source)
    slope = ca.substitute(ca.vertcat(power, ca.gradient(power, phi)), phi, ca.SX.zeros(3, 1))
    return ca.Function("patch", [quaternion, source], [slope[0], slope[1:]], {"cse": True})
