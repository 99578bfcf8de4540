"""A large initial variance says that little is known: the optimum is that of no prior at all, from any start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.transcription.scales import magnitudes

T, B_VARIANCE, WEIGHT = 6.0, 5.0, 10.0
# A prior that is large, but small beside what the units of the states were taken from.
MODERATE = 1e4


def lag(prior: float, final: float | None = 1.0) -> co.Problem:
    """A lag with an unknown time constant, whose state is hardly known at first."""
    ocp = co.Problem(T)
    x = ocp.state("x", initial=0.0, final=final, variance=prior)
    b = ocp.unknown("b", mean=1.0, variance=B_VARIANCE)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("y", x, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=WEIGHT * E[b, b])
    return ocp


def integrated(solution: co.Solution, prior: float) -> float:
    """The cost along the controls of a solution, by the information matrix L = E^-1 of the state and b:

    L' = -L F - F' L - L Q L + M'M, which is as smooth at the start as without a prior.
    """
    noise, measured = np.diag([1.0, 0.0]), np.diag([1.0, 0.0])

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        u = np.interp(t, solution.t, solution["u"].ravel())
        x, L = y[0], y[1:5].reshape(2, 2)
        F = np.array([[-1.0, -x], [0.0, 0.0]])
        return np.r_[-x + u, (-L @ F - F.T @ L - L @ noise @ L + measured).ravel(), 0.5 * u**2]

    y = np.r_[0.0, 1.0 / prior, 0.0, 0.0, 1.0 / B_VARIANCE, 0.0]
    for begin, end in zip(solution.t[:-1], solution.t[1:], strict=True):
        y = solve_ivp(rate, (begin, end), y, rtol=1e-9, atol=1e-12).y[:, -1]
    return float(y[5] + WEIGHT * np.linalg.inv(y[1:5].reshape(2, 2))[1, 1])


@pytest.fixture(scope="module")
def moderate() -> dict[float | None, co.Solution]:
    return {final: co.solve(lag(MODERATE, final), intervals=40, progress=False) for final in (1.0, None)}


@pytest.mark.parametrize("final", [1.0, None])
@pytest.mark.parametrize(("method", "prior"), [("ipopt", 1e10), ("ipopt", 1e14), ("ipopt", 1e30), ("reduced", 1e26)])
def test_the_cost_lies_between_what_the_prior_is_worth(moderate, method, prior, final):
    """A larger prior costs more, and no more than it does along the controls that are best for a smaller one."""
    found = co.solve(lag(prior, final), method, intervals=40, progress=False)
    above = co.evaluate(lag(prior, final), nominal=moderate[final], intervals=40).cost
    assert moderate[final].cost < found.cost <= above * (1.0 + 1e-9)
    assert found.optimality.stationarity < 1e-5
    assert found.cost == pytest.approx(integrated(found, prior), rel=1e-5)


def test_one_solver_goes_through_all_priors():
    solver = co.Solver(lag(1.0), intervals=40)
    solver.solve(progress=False)
    costs = []
    for prior in (1e8, 1e12, 1e16):
        found = solver.solve(covariance=np.diag([prior, B_VARIANCE]), progress=False, assess=False)
        costs.append(found.cost)
    assert costs == pytest.approx([integrated(found, 1e16)] * 3, rel=1e-5)
    assert costs == pytest.approx([costs[-1]] * 3, rel=1e-7)


def test_a_point_that_was_reached_is_not_judged_in_units_of_its_prior(moderate):
    """The state moves by one, whatever was known of it at first."""
    found, statement = moderate[1.0], lag(1e16).statement()
    assert np.abs(found["x"]).max() == pytest.approx(1.3, abs=0.1)
    scales = magnitudes(statement, found.trajectory, statement.values, reached=True)
    assert scales.x == pytest.approx([10.0])
    still = replace(found.trajectory, x=0.0 * found.trajectory.x)
    resting = lag(0.01, None).statement()
    assert magnitudes(resting, still, resting.values, reached=True).x == pytest.approx([0.1])


@pytest.mark.parametrize(("prior", "intervals"), [(1.0, 30), (1e4, 15), (1e8, 30)])
def test_what_remains_of_a_prior_is_known_by_itself(prior, intervals):
    """Of the range of a variance what is left at the end may be nothing: it had been 0.3 % off by default steps."""
    ocp = co.Problem(10.0)
    x = ocp.state("x", initial=0.0, final=1.0, variance=prior)
    v = ocp.state("v", initial=0.0, variance=prior)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, -4 * x - 0.2 * v + u, noise=1e-3)
    ocp.measurement("m", x, noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + 1e3, terminal=E[x, x])  # whose mesh error is small
    F, Q = np.array([[0.0, 1.0], [-4.0, -0.2]]), np.diag([0.0, 1e-3])

    def rate(t, y):
        P = y.reshape(2, 2)
        return (F @ P + P @ F.T + Q - np.outer(P[:, 0], P[:, 0]) / 0.1).ravel()

    run = solve_ivp(rate, (0, 10), (prior * np.eye(2)).ravel(), method="LSODA", rtol=1e-10, atol=1e-14)
    found = co.solve(ocp, intervals=intervals, progress=False)
    np.testing.assert_allclose(np.diag(found["E"][-1]), run.y[[0, 3], -1], rtol=2e-3)
