"""Integrator with state-dependent noise and free terminal time: the smallest test of the transversality condition.

The system of Schmidt's section 3.4 (Sc.D. thesis, M.I.T. 1971) under the necessary conditions of his appendix C. All
quantities are dimensionless.

    dx/dt = u,   dE/dt = x,   x(0) = E(0) = 0,   x(T) = 1,   T free,   J = E(T) + w T + int_0^T u^2/2 dt

w = 1: T = 2 - sqrt(2), J = 1.7238576251.   w = 0.2: T = 0.9167378064, J = 1.1550272665.

Errata: in [C-2] read tr(P dE/dt), in [C-3] k_t dT. In appendix D, the coefficient of dT in [D-1] needs h(T) and [D-2]
needs + dx_q/dt(T) dT; [D-7] to [D-9] and [D-14] change accordingly.
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

    duration: float
    """The optimal terminal time T."""
    t: Array
    x: Array
    u: Array
    E: Array
    p: Array
    """Costate of x; that of E is 1."""
    ell: float
    """Multiplier of x(T) = 1, equal to p(T)."""
    cost: float

    __repr__ = short_repr


def problem(time_weight: float = 1.0) -> co.Problem:
    """Integrator with state-dependent noise and free terminal time; dimensionless.

    Args:
        time_weight: w >= 0 (parameter "time_weight").

    Returns:
        The problem, with state "x", control "u" and the 1 x 1 matrix "E".

    Raises:
        ProblemError: where the weight is NaN or inf.
    """
    ocp = co.Problem(duration=co.Free(guess=1.0), name="integrator, state-dependent noise, free time")
    weight = ocp.parameter("time_weight", time_weight)
    x = ocp.state("x", initial=0.0, final=1.0)
    u = ocp.control("u", guess=1.0)
    ocp.dynamics(x, u)
    E = ocp.symmetric("E", 1, initial=0.0)
    ocp.dynamics(E, x)
    ocp.minimize(running=0.5 * u**2, terminal=E + weight * ocp.duration)
    return ocp


def exact(time_weight: float = 1.0, s: npt.ArrayLike | None = None) -> Exact:
    """Closed-form solution: u = t + sqrt(2 w), T = sqrt(2) (sqrt(1 + w) - sqrt(w)).

    Args:
        time_weight: w >= 0.
        s: fractions t/T in [0, 1], any shape; 101 of them by default.

    Returns:
        Terminal time, histories, multiplier and cost.
    """
    w = float(time_weight)
    start = np.sqrt(2 * w)  # u(0), from H = w + E - E at t = 0
    T = float(np.sqrt(2 * (1 + w)) - start)
    t = T * np.asarray(np.linspace(0.0, 1.0, 101) if s is None else s, dtype=float)
    u = t + start
    terminal = T**3 / 6 + start * T**2 / 2
    energy = ((T + start) ** 3 - start**3) / 6
    return Exact(
        duration=T,
        t=t,
        x=t**2 / 2 + start * t,
        u=u,
        E=t**3 / 6 + start * t**2 / 2,
        p=-u,
        ell=-float(T + start),
        cost=float(terminal + w * T + energy),
    )
