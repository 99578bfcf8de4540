"""A problem with decisions wherever they may be, for the tests of both methods' slopes."""

from __future__ import annotations

import casadi as ca

import covocp as co


def everywhere(values, closed=False):
    """Decisions in rates, noises, measurements, initial values and covariances, integrals and costs."""
    ocp = co.Problem(1.5, "everywhere")
    d = ocp.decision("d", 3, guess=values, lower=0.1, upper=3.0)
    x, v = ocp.state("x", initial=d[2], variance=0.4 * d[1]), ocp.state("v", initial=0.2, variance=0.1)
    b = ocp.unknown("b", mean=0.8, variance=0.3 * d[0] * d[1])
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, -b * d[0] * ca.sin(x) + u, noise=0.1 * d[2])
    ocp.measurement("m", x * d[1], noise=0.2 + d[0] ** 2)
    E = ocp.estimation_covariance()
    total = ocp.integral(E[x, x] * (1 + x**2))
    if closed:
        ocp.minimize_expected(running=0.5 * u**2 + x**2 / d[1], terminal=d[0] * x**2 + v**2)
    else:
        spent = ocp.integral(d[1] * u**2)
        ocp.minimize(running=u**2 + 0.1 * E[b, b], terminal=E[x, b] ** 2 + total * d[0] + spent**2 + x**2)
    return ocp
