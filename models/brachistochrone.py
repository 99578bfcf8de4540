"""Brachistochrone: the slide of least time between two points, without friction.

Johann Bernoulli, Acta Eruditorum, 1696; as a problem of optimal control A. E. Bryson and Y.-C. Ho, Applied Optimal
Control, 1975, chapter 2. The bead starts at rest; the end lies 10 m to the side and 5 m down; g = 9.80665 m/s^2.

    dx/dt = v sin(theta),   dy/dt = v cos(theta),   dv/dt = g cos(theta),   J = T

y points down, theta is the angle of the slope from the vertical. The solution is a cycloid, on which theta grows in
proportion to time: T = 1.8016 s. There is no covariance.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

import covocp as co
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

Array = npt.NDArray[np.float64]

GRAVITY = 9.80665  # m/s^2, standard gravity
DISTANCE = 10.0  # m, to the side
DROP = 5.0  # m, down


@dataclass(frozen=True, kw_only=True)
class Exact:
    """The solution in closed form; histories have the shape of `t`."""

    duration: float
    """The least time T [s], which is the cost."""
    radius: float
    """Radius of the circle whose point draws the cycloid [m]."""
    t: Array
    """[s]"""
    x: Array
    """To the side [m]."""
    y: Array
    """Down [m]."""
    v: Array
    """[m/s]"""
    theta: Array
    """From the vertical [rad]."""

    __repr__ = short_repr


def problem() -> co.Problem:
    """Slide of least time over 10 m to the side and 5 m down, Bryson and Ho, chapter 2.

    Returns:
        The problem, with states "x" [m], "y" [m, down] and "v" [m/s] and control "theta" [rad].
    """
    ocp = co.Problem(duration=co.Free(guess=2.0), name="brachistochrone")
    x = ocp.state("x", initial=0.0, final=DISTANCE, unit="m")
    y = ocp.state("y", initial=0.0, final=DROP, unit="m")
    v = ocp.state("v", initial=0.0, unit="m/s")
    theta = ocp.control("theta", lower=0.0, upper=np.pi, guess=lambda s: 2.0 * s, unit="rad")
    ocp.dynamics(x, v * ca.sin(theta))
    ocp.dynamics(y, v * ca.cos(theta))
    ocp.dynamics(v, GRAVITY * ca.cos(theta))
    ocp.minimize(terminal=ocp.duration)
    return ocp


def exact(s: npt.ArrayLike | None = None) -> Exact:
    """Closed-form solution: the cycloid x = R (a - sin a), y = R (1 - cos a), theta = a/2 = t sqrt(g/R)/2.

    Args:
        s: fractions t/T in [0, 1], any shape; 101 of them by default.

    Returns:
        Least time, radius and histories.
    """

    def miss(angle: float) -> float:
        """Of the end point, for a cycloid that ends after this angle."""
        return float(DROP * (angle - np.sin(angle)) - DISTANCE * (1 - np.cos(angle)))

    last = float(brentq(miss, 0.1, 2 * np.pi - 0.1, xtol=1e-14))  # also zero at 0; the end lies before the second cusp
    radius = DROP / (1 - np.cos(last))
    angle = last * np.asarray(np.linspace(0.0, 1.0, 101) if s is None else s, dtype=float)
    return Exact(
        duration=float(last * np.sqrt(radius / GRAVITY)),
        radius=float(radius),
        t=angle * np.sqrt(radius / GRAVITY),
        x=radius * (angle - np.sin(angle)),
        y=radius * (1 - np.cos(angle)),
        v=2 * np.sqrt(GRAVITY * radius) * np.sin(angle / 2),
        theta=angle / 2,
    )
