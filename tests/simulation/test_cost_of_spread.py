"""Costs that contain the covariance X of the closed loop: what of them a run has, and what is predicted of that."""

from __future__ import annotations

import casadi as ca
import pytest

import covocp as co


def plant(cost):
    """A nominal at rest: x^2 and x u are what X[x, x] and X[x, u] expect of them."""
    ocp = co.Problem(3.0, name="plant")
    x, y, u = ocp.state("x", initial=0.0, variance=0.2), ocp.state("y", initial=0.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, y - 0.3 * x, noise=0.05)
    ocp.dynamics(y, u - y, noise=0.02)
    ocp.measurement("p", x, noise=0.05)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(running=0.5 * u**2 + cost(x, y, u, X), terminal_weight={x: 5.0})
    return co.solve(ocp, intervals=20, progress=False)


def test_a_run_has_the_deviations_of_which_x_is():
    """The same runs cost the same where the states themselves are in the cost."""
    by_spread = plant(lambda x, y, u, X: 1.5 * X[x, x] + 0.4 * X[x, u] + 0.2 * X[x, y])
    by_states = plant(lambda x, y, u, X: 1.5 * x**2 + 0.4 * x * u + 0.2 * x * y)
    one, two = (co.simulate(entry, 200, seed=1, progress=False) for entry in (by_spread, by_states))
    assert one.costs == pytest.approx(two.costs, rel=1e-5, abs=1e-6)
    assert one.predicted_cost == pytest.approx(two.predicted_cost, rel=1e-6)
    assert abs(one.cost - one.predicted_cost) < 4 * one.cost_error
    assert one.spread_cost == 0.0


def test_what_no_run_has_is_not_predicted_of_them():
    """The logarithm of a variance is no mean of anything that runs do."""
    solution = plant(lambda x, y, u, X: 1.5 * x**2 + 0.3 * ca.log(X[x, x]))
    runs = co.simulate(solution, 1000, seed=1, progress=False)
    assert runs.spread_cost == solution.loop.cost["covariances"]
    assert runs.predicted_cost + runs.spread_cost == pytest.approx(solution.cost, rel=1e-12)
    assert abs(runs.spread_cost) > 20 * runs.cost_error
    assert abs(runs.cost - runs.predicted_cost) < 4 * runs.cost_error
    assert "not linear in X, which no run has" in " ".join(str(runs).split())
