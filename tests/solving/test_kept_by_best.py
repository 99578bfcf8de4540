"""Conditions on X that the best gain keeps leave it the optimum, also beside an actuator that is known exactly."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.solving import solver

INTERVALS = {"intervals": 80, "progress": False}


def lane(probability=None):
    """A lane change with an actuator that is known exactly; state and control are bounded, neither bound acts."""
    ocp = co.Problem(4.0, name="lane change")
    y = ocp.state("y", initial=0.0, final=3.5, variance=0.04)
    psi = ocp.state("psi", initial=0.0, final=0.0, variance=1e-4)
    delta = ocp.state("delta", initial=0.0, lower=-0.2, upper=0.2)
    rate = ocp.control("rate", lower=-0.5, upper=0.5)
    ocp.dynamics(y, 20 * psi, noise=0.01)
    ocp.dynamics(psi, 7.4 * delta, noise=1e-4)
    ocp.dynamics(delta, rate)
    ocp.measurement("camera", y, noise=0.01)
    cost = rate**2 + 10 * delta**2 + 0.01 * (y - 3.5) ** 2
    ocp.minimize_expected(running=cost, terminal_weight={y: 1.0, psi: 10.0, delta: 1.0})
    if probability is not None:
        ocp.chance(y, lower=-0.7, upper=4.2, probability=probability, name="road")
    return ocp


@pytest.fixture(scope="module")
def best():
    """Of the best gain, from a Riccati equation."""
    return co.solve(lane(), **INTERVALS)


def test_a_condition_that_the_best_gain_keeps_costs_nothing(best):
    """Xhat is known to what steps may leave, along an actuator that hardly scatters: no warning tells of it."""
    found = co.solve(lane(0.5), **INTERVALS)
    assert found.cost == pytest.approx(best.cost, rel=2e-5)
    assert found.stats["iterations"] < 10
    assert found["delta"] == pytest.approx(best["delta"], abs=1e-4)
    assert found.chances[0].reached > 0.9


def flown(solution):
    """Expected cost of the loop along its nominal with its gains, linear between the nodes, by scipy."""
    A, B, M = np.array([[0, 20, 0], [0, 0, 7.4], [0, 0, 0]]), np.array([[0.0], [0.0], [1.0]]), np.array([[1.0, 0, 0]])
    process, measured = np.diag([0.01, 1e-4, 0.0]), 0.01
    running, last = np.diag([0.01, 0.0, 10.0]), np.diag([1.0, 10.0, 1.0])
    nodes, inputs = solution.t, np.column_stack([solution["rate"], solution.gains["C"][:, 0, :]])

    def rate(t, z):
        x, E, X = z[:3], z[3:12].reshape(3, 3), z[12:21].reshape(3, 3)
        u, *C = (np.interp(t, nodes, column) for column in inputs.T)
        C, K = np.array([C]), E @ M.T / measured
        gained = K @ K.T * measured
        loop = (A - B @ C) @ X
        cost = u**2 + 10 * x[2] ** 2 + 0.01 * (x[0] - 3.5) ** 2 + np.trace(running @ (E + X)) + (C @ X @ C.T).item()
        moved = (A @ x + B[:, 0] * u, (A @ E + E @ A.T + process - gained).ravel(), (loop + loop.T + gained).ravel())
        return np.concatenate([*moved, [cost]])

    z = np.concatenate([np.zeros(3), np.diag([0.04, 1e-4, 0.0]).ravel(), np.zeros(10)])
    for begin, end in pairwise(solution.t):
        z = solve_ivp(rate, (begin, end), z, method="DOP853", rtol=1e-8, atol=1e-12).y[:, -1]
    return z[-1] + np.trace(last @ (z[3:12] + z[12:21]).reshape(3, 3)) / 2


def test_a_condition_that_acts_beside_an_actuator_known_exactly_is_found(best):
    """Its cost is that of the loop that flies, and no gain or nominal near it is better."""
    found = co.solve(lane(0.99), **INTERVALS)
    assert found.chances[0].reached == pytest.approx(0.99, abs=1e-6)
    assert found.cost == pytest.approx(flown(found), rel=1e-6)
    assert found.cost > best.cost * (1 + 1e-3)
    assert found.optimality.stationarity < 1e-6
    assert found.optimality.complementarity < 1e-5
    assert found.optimality.curvature >= 0


def lag(weight, *, limit):
    """An unstable lag that is brought to one; with a limit, a gain that is optimised, which the best one keeps."""
    ocp = co.Problem(5.0)
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=0.3), ocp.control("u")
    ocp.dynamics(x, 0.5 * x + u, noise=0.05)
    ocp.measurement("m", x, noise=0.02)
    ocp.minimize_expected(running=weight * u**2, terminal_weight={x: 3.0 * weight})
    if limit:
        ocp.chance(x, upper=2.2, probability=0.9)
    return ocp


@pytest.mark.parametrize(("weight", "looks"), [(1.0, 0), (0.01, 1)])
def test_a_solution_of_another_problem_is_not_taken_for_its_optimum(weight, looks, monkeypatch):
    """A hundredth of the cost has the same names and way; that it is no saddle is known of the problem itself alone."""
    looked, away = [], solver.away_from_saddle
    monkeypatch.setattr(solver, "away_from_saddle", lambda *given: looked.append(1) or away(*given))
    options = {"intervals": 25, "progress": False}
    guess = co.solve(lag(weight, limit=False), **options)
    looked.clear()
    found = co.solve(lag(1.0, limit=True), guess=guess, **options)
    assert len(looked) == looks
    assert found.cost == pytest.approx(guess.cost / weight, rel=1e-4)
