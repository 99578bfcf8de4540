"""Linear-quadratic designs: the optimum of the deterministic problem, found at once, at any length."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from problems import unassessed
from scipy.integrate import solve_ivp

import covocp as co
from covocp.solving import from_classical
from covocp.solving.beside_classical import ClassicalDesign

F, G, M = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
NOISE, SENSOR, PRIOR = np.diag([0.0, 0.1]), 0.01, np.diag([0.2, 0.1])
WEIGHT, PRICE, END = np.diag([1.0, 0.1]), 0.5, np.diag([4.0, 1.0])
START = np.array([1.0, 0.0])


def mass(duration: float, limit: float | None = None, **bounds: float) -> co.Problem:
    """A mass that is pushed, and seen; `limit`: of its speed and three deviations."""
    ocp = co.Problem(duration)
    x, u = ocp.state("x", 2, initial=START, variance=PRIOR), ocp.control("u", **bounds)
    ocp.dynamics(x, ca.vertcat(x[1], u), noise=np.diag(NOISE))
    ocp.measurement("y", x[0], noise=SENSOR)
    weight, end = (ca.bilin(ca.DM(own), x, x) for own in (WEIGHT, END))
    ocp.minimize_expected(running=0.5 * (weight + PRICE * u**2), terminal=0.5 * end)
    if limit is not None:
        X = ocp.closed_loop_covariance()[x, x]
        ocp.subject_to(x[1] + 3.0 * ca.sqrt(X[1, 1]), upper=limit, name="slow")
    return ocp


def expected(duration: float) -> float:
    """The least expected cost, by both Riccati equations."""

    def estimated(_t, e):
        E = e.reshape(2, 2)
        return (F @ E + E @ F.T + NOISE - E @ M.T @ M @ E / SENSOR).ravel()

    def steered(t, s):
        S = s[:4].reshape(2, 2)
        gain = G.T @ S / PRICE
        paid = 0.5 * np.trace(S @ NOISE) + 0.5 * PRICE * float((gain @ E(t).reshape(2, 2) @ gain.T).item())
        return np.append(-(F.T @ S + S @ F + WEIGHT - S @ G @ gain), -paid)

    known = {"method": "LSODA", "rtol": 1e-9, "atol": 1e-12}
    E = solve_ivp(estimated, (0.0, duration), PRIOR.ravel(), dense_output=True, **known).sol
    s = solve_ivp(steered, (duration, 0.0), np.append(END.ravel(), 0.0), **known).y[:, -1]
    S = s[:4].reshape(2, 2)
    return float(0.5 * START @ S @ START + 0.5 * np.trace(S @ PRIOR) + s[4])


@cache
def solved(duration: float) -> co.Solution:
    return co.solve(mass(duration), progress=False)


@pytest.mark.parametrize("duration", [0.1, 5.0, 50.0])
def test_the_optimum_of_both_riccati_equations(duration):
    found = co.solve(mass(duration), progress=False)
    assert found.stats["iterations"] <= 2
    assert found.cost == pytest.approx(expected(duration), rel=2e-5)
    assert found.optimality.stationarity < 1e-4
    assert found.cost_identity < 1e-4


@pytest.mark.filterwarnings("ignore:The mesh is too coarse", "ignore:The controls change faster")
@pytest.mark.parametrize(("duration", "off"), [(500.0, 2e-3), (2000.0, 1e-2)])
def test_a_long_time_is_solved_on_a_coarse_mesh(duration, off):
    """These runs of Ipopt stopped at their last iteration; they are given up for the deterministic optimum."""
    found = co.solve(mass(duration), progress=False)
    assert found.stats["iterations"] < 110
    assert found.cost == pytest.approx(expected(duration), rel=off)
    assert "not yet stationary" not in str(found)


@pytest.mark.parametrize("limit", [0, 1, 3])
def test_limits_are_kept(limit):
    found = co.Solver(mass(5.0)).solve(iteration_limit=limit, progress=False)
    assert not found.converged
    assert found.stats["iterations"] <= limit
    assert "limit" in found.message


@pytest.mark.parametrize("limit", [{"time_limit": 1e6}, {"iteration_limit": 10_000}])
def test_a_run_that_is_limited_does_not_begin_with_one_that_is_not(limit, monkeypatch: pytest.MonkeyPatch):
    def unlimited(self, parameters):
        raise AssertionError("the deterministic problem knows no limits")

    monkeypatch.setattr(ClassicalDesign, "nominal", unlimited)
    found = co.Solver(mass(5.0)).solve(**limit, assess=False, progress=False)
    assert found.cost == pytest.approx(expected(5.0), rel=2e-5)


def test_ctrl_c_in_the_deterministic_problem_carries_an_iterate(monkeypatch: pytest.MonkeyPatch):
    def stopped(self, parameters):
        raise KeyboardInterrupt

    monkeypatch.setattr(ClassicalDesign, "nominal", stopped)
    with pytest.raises(co.Interrupted) as caught:
        co.solve(mass(5.0), progress=False)
    assert caught.value.solution.trajectory.x.shape[1] == 2


def test_what_is_asked_for_otherwise_finds_the_same():
    at_once = solved(5.0)
    for options in ({"max_iterations": 500}, {"covariances": "states"}, {"guess": at_once}, {"guess": {"u": 1.0}}):
        found = co.solve(mass(5.0), progress=False, **options)
        step = 2e-6 if "covariances" in options else 1e-7
        assert found.cost == pytest.approx(at_once.cost, rel=step), options
        assert found.mesh.eliminated == ("covariances" not in options)
        np.testing.assert_allclose(found["u"], at_once["u"], atol=2e-3 * np.ptp(at_once["u"]))
    for method in ("auto", "reduced", "gradient"):
        assert unassessed(mass(5.0), method).cost == pytest.approx(at_once.cost, rel=1e-6)


@pytest.mark.parametrize("bound", [0.05, 0.1, 0.4])
def test_bounds_of_the_control_and_their_multipliers(bound):
    limited = co.solve(mass(5.0, lower=-bound, upper=bound), progress=False)
    other = unassessed(mass(5.0, lower=-bound, upper=bound), max_iterations=1000)
    assert limited.cost == pytest.approx(other.cost, rel=1e-7)
    assert limited.optimality.stationarity < 1e-4
    assert limited.optimality.complementarity < 2e-7
    np.testing.assert_allclose(limited["u"], other["u"], atol=0.01 * bound)
    np.testing.assert_allclose(limited.costates.state, other.costates.state, atol=1e-4)


def test_a_limit_of_the_spread_is_no_quadratic_program():
    """Whose deterministic optimum leaves it: the run must find what keeps to it."""
    free = solved(5.0)
    fast = free.trajectory.x[:, 1] + 3.0 * np.sqrt(free.loop.X[:, 1, 1])
    limit = 0.95 * float(fast.max())
    held = co.solve(mass(5.0, limit), progress=False)
    reached = held.trajectory.x[:, 1] + 3.0 * np.sqrt(held.loop.X[:, 1, 1])
    assert reached.max() == pytest.approx(limit, rel=2e-3)
    assert held.cost > free.cost


def test_what_is_not_stationary_is_not_taken(monkeypatch: pytest.MonkeyPatch):
    """A nominal that would be wrongly called the optimum is left to the run, which finds it."""
    right = solved(5.0)
    original = from_classical.run_around

    def pushed(statement, mesh, found, values):
        t = found.trajectory
        return original(statement, mesh, replace(found, trajectory=replace(t, u=t.u + 0.3)), values)

    monkeypatch.setattr(from_classical, "run_around", pushed)
    found = co.solve(mass(5.0), progress=False)
    assert found.stats["iterations"] > 2
    assert found.cost == pytest.approx(right.cost, rel=1e-7)
