"""Bryson-Denham problem: a double integrator under a bound on its position (a state constraint of second order).

A. E. Bryson, W. F. Denham and S. E. Dreyfus, "Optimal programming problems with inequality constraints I", AIAA Journal
1(11), 1963; A. E. Bryson and Y.-C. Ho, Applied Optimal Control, 1975, section 3.11. All quantities are dimensionless.

    dx/dt = v,   dv/dt = u,   x(0) = x(1) = 0,   v(0) = 1,   v(1) = -1,   x <= l,   J = int_0^1 u^2/2 dt

l = 1/9: J = 4. There is no covariance.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Exact:
    """The solution in closed form; histories have the shape of `t`."""

    t: Array
    x: Array
    v: Array
    u: Array
    cost: float

    __repr__ = short_repr


def problem(limit: float = 1 / 9) -> co.Problem:
    """Double integrator under a bound on its position, Bryson and Ho, section 3.11; dimensionless.

    Args:
        limit: l > 0, upper bound of x (parameter "limit").

    Returns:
        The problem, with states "x" and "v" and control "u".

    Raises:
        ProblemError: where the limit is NaN or inf.
    """
    ocp = co.Problem(duration=1.0, name="Bryson-Denham")
    bound = ocp.parameter("limit", limit)
    x = ocp.state("x", initial=0.0, final=0.0)
    v = ocp.state("v", initial=1.0, final=-1.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.subject_to(x - bound, name="position limit")
    ocp.minimize(running=0.5 * u**2)
    return ocp


def exact(limit: float = 1 / 9, t: npt.ArrayLike | None = None) -> Exact:
    """Closed-form solution, Bryson and Ho, section 3.11: x rests at l (l <= 1/6), touches it (l < 1/4) or stays below.

    Args:
        limit: l > 0.
        t: times in [0, 1], any shape; 101 of them by default.

    Returns:
        Histories and cost: 4/(9 l), 2 + 6 (1 - 4 l)^2 or 2.
    """
    times = np.asarray(np.linspace(0.0, 1.0, 101) if t is None else t, dtype=float)
    early = np.minimum(times, 1 - times)  # the solution is symmetric about t = 1/2
    sign = np.where(times <= 0.5, 1.0, -1.0)
    if limit <= 1 / 6:
        rest = np.minimum(early / (3 * limit), 1.0)  # 1 from t = 3 l on, where x rests at l
        x, v, u = limit * (1 - (1 - rest) ** 3), (1 - rest) ** 2, -2 / (3 * limit) * (1 - rest)
        cost = 4 / (9 * limit)
    else:
        excess = max(0.0, 1 - 4 * limit)  # u = -2 - 6 excess + 24 excess t up to t = 1/2
        u = -2 - 6 * excess + 24 * excess * early
        v = 1 - (2 + 6 * excess) * early + 12 * excess * early**2
        x = early - (1 + 3 * excess) * early**2 + 4 * excess * early**3
        cost = 2 + 6 * excess**2
    return Exact(t=times, x=np.asarray(x), v=np.asarray(sign * v), u=np.asarray(u), cost=cost)
