"""Limits of any size hold: the same problem in metres, micrometres and nanometres.

Solvers meet rows to an absolute tolerance. A limit on a square of micrometres, 1e-14, was passed by a factor of 24 by
runs that called themselves solved, with no violation.
"""

import casadi as ca
import pytest
from problems import solve

import covocp as co

UNITS = [1.0, 1e-4, 1e-6]


@pytest.mark.parametrize("unit", UNITS)
def test_an_integral_within_a_small_limit(unit):
    """int u^2 <= 0.01 with x(4) as near 1 as that allows: u = 0.05, x(4) = 0.2, cost 0.01 + 10 0.8^2."""
    ocp = co.Problem(4.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    effort = ocp.integral(u**2, name="effort")
    ocp.dynamics(x, u)
    ocp.subject_to(effort, upper=0.01 * unit**2)
    ocp.minimize(running=(u / unit) ** 2, terminal=10 * (x / unit - 1) ** 2)
    solution = solve(ocp, intervals=10)
    assert solution.cost == pytest.approx(6.41, rel=1e-6)
    assert float(solution["effort"]) / unit**2 == pytest.approx(0.01, rel=1e-6)


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e-9])
@pytest.mark.parametrize("how", ["at the end", "bound"])
def test_a_place_within_a_small_limit(unit, how):
    """x <= 0.5 of a double integrator that would go on to 1; the same multiplier in its own unit."""
    ocp = co.Problem(4.0)
    x = ocp.state("x", initial=0.0, upper=0.5 * unit if how == "bound" else float("inf"))
    v, u = ocp.state("v", initial=0.0), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    if how == "at the end":
        ocp.subject_to(x, upper=0.5 * unit, at="final", name="wall")
    ocp.minimize(running=(u / unit) ** 2, terminal=10 * ((x / unit - 1) ** 2 + (v / unit) ** 2))
    solution = solve(ocp, intervals=20)
    # int u^2 = 12 (x/T^3 - x v/T^2 + v^2/(3 T)) with v free at the weight 10, x = 1/2
    best = min(
        12 * (0.25 / 64 - 0.5 * w / 16 + w**2 / 12) + 10 * (0.25 + w**2) for w in (k * 1e-5 for k in range(5000))
    )
    assert solution.cost == pytest.approx(best, rel=1e-6)
    assert solution["x"][-1] / unit == pytest.approx(0.5, rel=1e-6)
    if how == "at the end":
        slope = 24 * 0.5 / 64 - 12 * 0.0 + 20 * (0.5 - 1)  # of the cost by x, at v near zero
        assert -solution.multiplier("wall") * unit == pytest.approx(slope, rel=0.05)


def test_a_small_variance_that_is_asked_for():
    """1/E = 1 + w with int w^2 as small as E = 1/4 allows: 9, in units of nanometres."""
    ocp = co.Problem(1.0)
    x, w = ocp.state("x", initial=0.0, variance=1e-18), ocp.control("w", lower=0.0, upper=100.0, guess=1.0)
    ocp.dynamics(x, ca.MX(0))
    ocp.measurement("m", x, information=w / 1e-18)
    E = ocp.estimation_covariance()
    ocp.subject_to(E[x, x], upper=0.25e-18, at="final")
    ocp.minimize(running=w**2)
    assert solve(ocp, intervals=10).cost == pytest.approx(9.0, rel=1e-6)


def test_the_gradient_method_meets_a_small_limit_or_says_that_it_does_not():
    def effort(unit):
        ocp = co.Problem(4.0)
        x, u = ocp.state("x", initial=0.0), ocp.control("u")
        ocp.dynamics(x, u)
        ocp.subject_to(ocp.integral(u**2), upper=0.01 * unit**2)
        ocp.minimize(running=(u / unit) ** 2, terminal=10 * (x / unit - 1) ** 2)
        return ocp

    assert solve(effort(1e-4), method="gradient", intervals=10).cost == pytest.approx(6.41, rel=1e-5)
    with pytest.raises(co.SolveError, match="do not remove the violations"):
        solve(effort(1e-6), method="gradient", intervals=10)
