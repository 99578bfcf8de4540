"""Integrator whose noise grows with its state: the smallest problem in which the trajectory drives a covariance.

G. T. Schmidt, Sc.D. thesis, M.I.T. 1971, section 3.4. All quantities are dimensionless.

    dx/dt = u,   dE/dt = x,   x(0) = E(0) = 0,   x(1) = 1,   x >= 0 (it is the density of the noise)
    J = alpha E(1) + int_0^1 (u^2/2 + beta E) dt

| case | alpha, beta | u               | J                                  |
|------|-------------|-----------------|------------------------------------|
| a    | 0, 0        | 1               | 1/2                                |
| b    | 0, 1        | 2/3 + t - t^2/2 | 59/90, of which int u^2/2 is 23/45 |
| c    | 1, 0        | t + 1/2         | 23/24, of which E(1) is 5/12       |

Errata: in [3.4-9] read dP/dt, in [3.4-10] P(1) = 0, in [3.4-28] dp/dt.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial
from scipy.optimize import brentq

import covocp as co
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

Array = npt.NDArray[np.float64]

# Spacing of the floating-point numbers near t1, the root that it is asked for.
ROOT_TOLERANCE = 4 * np.finfo(float).eps


@dataclass(frozen=True, kw_only=True)
class Exact:
    """The solution in closed form; histories have the shape of `t`."""

    t: Array
    x: Array
    u: Array
    E: Array
    P: Array
    """Costate of E."""
    p: Array
    """Costate of x; zero on the arc x = 0."""
    ell: float
    """Multiplier of x(1) = 1, equal to p(1)."""
    cost: float
    energy: float
    """Integral of u^2/2."""
    arc: float
    """The time t1 at which x leaves zero."""

    __repr__ = short_repr


def problem(terminal_weight: float = 0.0, integral_weight: float = 0.0) -> co.Problem:
    """Integrator with state-dependent noise, Schmidt [3.4]; dimensionless.

    Args:
        terminal_weight: alpha, of the terminal covariance (parameter "terminal_weight").
        integral_weight: beta, of the integral of the covariance (parameter "integral_weight").

    Returns:
        The problem, with state "x", control "u" and the 1 x 1 matrix "E".

    Raises:
        ProblemError: where a weight is NaN or inf.
    """
    ocp = co.Problem(duration=1.0, name="integrator with state-dependent noise")
    alpha = ocp.parameter("terminal_weight", terminal_weight)
    beta = ocp.parameter("integral_weight", integral_weight)
    x = ocp.state("x", initial=0.0, final=1.0, lower=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    E = ocp.symmetric("E", 1, initial=0.0)
    ocp.dynamics(E, x)
    ocp.minimize(running=0.5 * u**2 + beta * E, terminal=alpha * E)
    return ocp


def exact(terminal_weight: float = 0.0, integral_weight: float = 0.0, t: npt.ArrayLike | None = None) -> Exact:
    """Closed-form solution, Schmidt [3.4], with the arc x = u = 0 on [0, t1] where the weights are large.

    The costates are P = alpha + beta (1 - t) and p = -u, so that u is a parabola with du/dt = P once x > 0. Where its
    value u(0) = 1 - (alpha + beta)/2 + beta/6 would be negative, x stays at zero until t1, leaves it with u(t1) = 0,
    and

        x(1) = (1 - t1)^2 [(alpha + beta)/2 - beta (1 + 2 t1)/6] = 1.

    Args:
        terminal_weight: alpha >= 0.
        integral_weight: beta >= 0.
        t: times in [0, 1], any shape; 101 of them by default.

    Returns:
        Histories, multiplier and cost.
    """
    alpha, beta = float(terminal_weight), float(integral_weight)
    times = np.asarray(np.linspace(0.0, 1.0, 101) if t is None else t, dtype=float)

    def reached(start: float) -> float:
        """x(1) on leaving zero at this time with u = 0."""
        return (1 - start) ** 2 * ((alpha + beta) / 2 - beta * (1 + 2 * start) / 6)

    arc = float(brentq(lambda s: reached(s) - 1.0, 0.0, 1.0, xtol=ROOT_TOLERANCE)) if reached(0.0) > 1.0 else 0.0
    slope = Polynomial([alpha + beta, -beta])  # du/dt = P
    u = slope.integ(lbnd=arc) + max(0.0, 1.0 - reached(0.0))
    x = u.integ(lbnd=arc)
    E = x.integ(lbnd=arc)
    energy = 0.5 * (u**2).integ(lbnd=arc)(1.0)
    free = times >= arc
    control = np.where(free, u(times), 0.0)
    return Exact(
        t=times,
        x=np.where(free, x(times), 0.0),
        u=control,
        E=np.where(free, E(times), 0.0),
        P=slope(times),
        p=-control,
        ell=-float(u(1.0)),
        cost=float(alpha * E(1.0) + energy + beta * E.integ(lbnd=arc)(1.0)),
        energy=float(energy),
        arc=arc,
    )


def figures() -> dict[str, list[tuple[str, co.Problem]]]:
    """What Schmidt 3.4 compares: no weight, one on the integral of E, one on E(1); by title, with labels."""
    weights = {"a: energy only": (0.0, 0.0), "b: integral of E": (0.0, 1.0), "c: E at the end": (1.0, 0.0)}
    return {
        "Schmidt 3.4: integrator with state-dependent noise": [
            (label, problem(alpha, beta)) for label, (alpha, beta) in weights.items()
        ]
    }
