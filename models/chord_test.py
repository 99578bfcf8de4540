"""Integrator with a quartic control cost and a free end: the test of the chord variant of the gradient method.

The system of Schmidt's section 3.4 (Sc.D. thesis, M.I.T. 1971) with a cost that is not quadratic in u, for [4.2-10].
All quantities are dimensionless.

    dx/dt = u,   dE/dt = x,   x(0) = E(0) = 0,   x(1) free,   J = E(1) - 3 x(1) + int_0^1 (u^2/2 + u^4/4) dt

Optimal: p = -2 - t, u + u^3 = 2 + t, J = -1.788321888. The costates do not depend on u, so the chord step with d = 1
(solve H_u = 0 along the current costates) is exact after one iteration.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import covocp as co
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

Array = npt.NDArray[np.float64]

# Gauss-Legendre points for the integrals of the smooth solution; 12 already give 1e-14.
QUADRATURE_POINTS = 30


@dataclass(frozen=True, kw_only=True)
class Exact:
    """The solution in closed form; histories have the shape of `t`."""

    t: Array
    x: Array
    u: Array
    E: Array
    p: Array
    """Costate of x; that of E is 1."""
    cost: float

    __repr__ = short_repr


def problem() -> co.Problem:
    """Integrator with quartic control cost, free end, for Schmidt [4.2-10]; dimensionless.

    Returns:
        The problem, with state "x", control "u" and the 1 x 1 matrix "E".
    """
    ocp = co.Problem(duration=1.0, name="integrator, quartic control cost")
    x = ocp.state("x", initial=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    E = ocp.symmetric("E", 1, initial=0.0)
    ocp.dynamics(E, x)
    ocp.minimize(running=0.5 * u**2 + 0.25 * u**4, terminal=E - 3.0 * x)
    return ocp


def exact(t: npt.ArrayLike | None = None) -> Exact:
    """Closed-form solution, u the real root of u + u^3 = 2 + t; integrals over u by du = dt / (1 + 3 u^2).

    Args:
        t: times in [0, 1], any shape; 101 of them by default.

    Returns:
        Histories and cost.
    """
    times = np.asarray(np.linspace(0.0, 1.0, 101) if t is None else t, dtype=float)
    start = float(control(np.zeros(())))

    def x_at(v: Array) -> Array:
        """int u dt = int v (1 + 3 v^2) dv from u(0) to v."""
        return np.asarray((v**2 - start**2) / 2 + 3 * (v**4 - start**4) / 4)

    points, weights = np.polynomial.legendre.leggauss(QUADRATURE_POINTS)
    fractions, weights = (points + 1) / 2, weights / 2
    u = control(times)
    E = times * (x_at(control(times[..., None] * fractions)) @ weights)
    nodes = control(fractions)
    last = control(np.ones(()))
    running = (nodes**2 / 2 + nodes**4 / 4) @ weights
    terminal = x_at(nodes) @ weights - 3 * x_at(last)
    return Exact(t=times, x=x_at(u), u=u, E=np.asarray(E), p=-2 - times, cost=float(running + terminal))


def control(t: Array) -> Array:
    """Real root of u + u^3 = 2 + t, by hyperbolic functions; shape of t."""
    return np.asarray(2 / np.sqrt(3) * np.sinh(np.arcsinh(1.5 * np.sqrt(3) * (2 + t)) / 3))
