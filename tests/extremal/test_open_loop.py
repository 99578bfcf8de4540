"""Unstable plants along their controls alone: what is told of nodes and cost is what an integration by scipy finds."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co

Q = np.diag([0.0, 1e-3, 0.0])


def pendulum(T: float, estimated: bool = False) -> co.Problem:
    """An inverted pendulum that is brought up, its gain unknown or not."""
    ocp = co.Problem(T)
    x = ocp.state("x", 2, initial=(0.5, 0.0), **({"variance": [1e-3, 1e-3]} if estimated else {}))
    b = ocp.unknown("b", mean=1.0, variance=0.1) if estimated else 1.0
    u = ocp.control("u", lower=-20, upper=20)
    rate = ca.vertcat(x[1], 9.81 * ca.sin(x[0]) - b * u * ca.cos(x[0]))
    ocp.dynamics(x, rate, **({"noise": [0, 1e-3]} if estimated else {}))
    terminal = 0
    if estimated:
        ocp.measurement("y", x[0], noise=1e-3)
        E = ocp.estimation_covariance()
        terminal = E[b, b]
    ocp.minimize(running=0.01 * u**2 + 5 * x[0] ** 2 + 0.1 * x[1] ** 2, terminal=terminal)
    return ocp


def flown(solution: co.Solution, estimated: bool = False) -> tuple[float, float]:
    """Largest departure from the nodes in a run along the controls, relative to the range, and what the run costs."""

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        u = np.interp(t, solution.t, solution["u"].ravel())
        s, c = np.sin(y[0]), np.cos(y[0])
        own = [y[1], 9.81 * s - u * c, 0.01 * u**2 + 5 * y[0] ** 2 + 0.1 * y[1] ** 2]
        if not estimated:
            return np.array(own)
        E, F = y[3:].reshape(3, 3), np.array([[0.0, 1.0, 0.0], [9.81 * c + u * s, 0.0, -u * c], [0.0, 0.0, 0.0]])
        return np.r_[own, (F @ E + E @ F.T + Q - np.outer(E[:, 0], E[0]) / 1e-3).ravel()]

    y = np.r_[0.5, 0.0, 0.0, np.diag([1e-3, 1e-3, 0.1]).ravel() if estimated else []]
    nodes = solution["x"]
    if estimated:
        nodes = np.hstack([nodes, solution["E"].reshape(-1, 9)])
    worst = np.zeros(nodes.shape[1])
    for begin, end, node in zip(solution.t[:-1], solution.t[1:], nodes[1:], strict=True):
        y = solve_ivp(rate, (begin, end), y, rtol=1e-9, atol=1e-11).y[:, -1]
        worst = np.maximum(worst, np.abs(np.delete(y, 2) - node))
    return float((worst / np.ptp(nodes, axis=0)).max()), float(y[2] + (y[-1] if estimated else 0.0))


@pytest.mark.parametrize(
    ("T", "intervals", "estimated"), [(2.0, 25, False), (4.0, 25, False), (2.0, 25, True), (4.0, 60, True)]
)
def test_nodes_and_cost_are_told_as_they_fly(T, intervals, estimated):
    """With steps that are too long; what is told is by steps of half the length, so a little less."""
    with pytest.warns(co.CovocpWarning, match="along these controls alone") as told:
        solution = co.solve(pendulum(T, estimated), intervals=intervals, substeps=1, progress=False)
    left, cost = flown(solution, estimated)
    assert str(told[0].message).startswith("What the steps are off grows")
    assert left > 5e-3
    assert left / 3 < solution.optimality.node_error < 3 * left
    paid = float(str(told[0].message).split("costs ")[1].split(" instead")[0])
    assert abs(cost - solution.cost) / 3 < abs(paid - solution.cost) < 3 * abs(cost - solution.cost)


@pytest.mark.parametrize(("T", "method"), [(2.0, "ipopt"), (2.8, "ipopt"), (2.0, "reduced")])
def test_default_steps_are_short_enough_where_a_few_more_are(T, method):
    """No warning, and nodes that are those of the equation along the controls to what is allowed of their range."""
    solution = co.solve(pendulum(T), method, intervals=25, progress=False)
    left, cost = flown(solution)
    assert left < 2.2e-3
    assert left / 3 < solution.optimality.node_error < 3 * left
    assert cost == pytest.approx(solution.cost, rel=1e-5)


@pytest.mark.parametrize("T", [8.0, 12.0])
def test_a_long_horizon_is_told_and_asks_for_no_shorter_steps(T):
    """x' = 3 x + u has a closed form along linear controls; what the first steps are off grows by e^(3 T)."""
    ocp = co.Problem(T)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, 3 * x + u)
    ocp.minimize(running=0.5 * u**2 + x**2)
    with pytest.warns(co.CovocpWarning, match="along these controls alone") as told:
        solution = co.solve(ocp, progress=False)
    assert len(told) == 1
    assert solution.mesh.substeps == 1
    nodes, y, left = solution["x"].ravel(), 1.0, 0.0
    for k, h in enumerate(np.diff(solution.t)):
        v, slope = solution["u"].ravel()[k], np.diff(solution["u"].ravel())[k] / h
        constant, linear = -(v + slope / 3) / 3, -slope / 3  # a particular solution: constant + linear t
        y = (y - constant) * np.exp(3 * h) + constant + linear * h
        left = max(left, abs(y - nodes[k + 1]))
    assert solution.optimality.node_error == pytest.approx(left / np.ptp(nodes), rel=0.3)


def test_a_run_that_diverges_is_told():
    """x' = x + x^3 + u leaves every range in finite time once it has left the nodes."""
    ocp = co.Problem(12.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, x + x**3 + u)
    ocp.minimize(running=0.5 * u**2 + x**2)
    with pytest.warns(co.CovocpWarning, match="along these controls alone diverges"):
        solution = co.solve(ocp, progress=False)
    assert solution.optimality.node_error == np.inf
    assert solution.mesh_error < 1e-3


def test_a_nominal_with_a_feedback_around_it_is_not_flown_alone():
    """The same plant in closed loop: what the segments are off is held by the feedback, and nothing is warned of."""
    ocp = co.Problem(6.0)
    x, u = ocp.state("x", initial=1.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, 3 * x + u, noise=0.1)
    ocp.measurement("y", x, noise=0.1)
    ocp.minimize_expected(running=0.5 * u**2 + x**2)
    solution = co.solve(ocp, progress=False)
    assert solution.optimality.node_error < 1e-2


def spring(duration: float = 5.083) -> co.Problem:
    """A free spring whose rate is known well, seen by its speed: its covariance falls to what long steps see."""
    ocp = co.Problem(duration)
    x, v = (ocp.state(name, initial=start, variance=9.2e-8) for name, start in (("x", 1.0), ("v", 0.0)))
    k, u = ocp.unknown("k", mean=17.2, variance=0.1), ocp.control("u", lower=-3.0, upper=3.0, guess=0.1)
    ocp.dynamics(x, v)
    ocp.dynamics(v, -k * x - 0.1 * v + u, noise=1.02e-8)
    ocp.measurement("m", v, noise=0.0127)
    E = ocp.estimation_covariance()
    ocp.minimize(running=1 + 0.5 * u**2 + 0.1 * x**2, terminal=0.01 * E[k, k])
    return ocp


def test_the_end_of_a_covariance_is_told_to_its_own_deviations_along_the_controls() -> None:
    """The nominal drifts through all segments, and E with it: each by itself is off by a fifth of that."""
    solution = co.solve(spring(), intervals=50, progress=False)
    times, controls = solution.t, solution["u"].ravel()

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        u, E = np.interp(t, times, controls), y[2:].reshape(3, 3)
        F = np.array([[0, 1, 0], [-17.2, -0.1, -y[0]], [0, 0, 0]])
        change = F @ E + E @ F.T + np.diag([0, 1.02e-8, 0]) - np.outer(E[:, 1], E[1]) / 0.0127
        return np.concatenate([[y[1], -17.2 * y[0] - 0.1 * y[1] + u], change.ravel()])

    begin = np.concatenate([[1.0, 0.0], np.diag([9.2e-8, 9.2e-8, 0.1]).ravel()])
    exact = solve_ivp(rate, (0.0, times[-1]), begin, rtol=1e-10, atol=1e-14, method="LSODA", max_step=0.1).y[2:, -1]
    deviation = np.sqrt(np.diag(exact.reshape(3, 3)))
    off = np.abs((solution["E"][-1] - exact.reshape(3, 3)) / np.outer(deviation, deviation)).max()
    assert off > 5e-3
    assert solution.optimality.node_error == pytest.approx(off, rel=0.2)
