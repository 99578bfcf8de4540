"""Sensors that the time switches on and off, against Riccati and moment equations by an integrator of scipy."""

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co

DAY, PASS = 86400.0, (43560.0, 43700.0)
CAMERA = 100.0


def on(time, begin, end, information):
    """The information of a sensor that is on from one time to another."""
    return ca.if_else(ca.logic_and(time > begin, time < end), information, 0.0)


def thruster(switched=on, begin=PASS[0], end=PASS[1]):
    """A gain that is learnt from the speed, which is seen for a small part of a day."""
    ocp = co.Problem(DAY, name="pass")
    v = ocp.state("v", initial=0.0, variance=1.0)
    g = ocp.unknown("g", mean=1.0, variance=0.25)
    u = ocp.control("u", lower=-1e-3, upper=1e-3)
    ocp.dynamics(v, g * u - v / 2e4, noise=1e-4)
    ocp.measurement("doppler", v, information=switched(ocp.time, begin, end, 1.0))
    E = ocp.estimation_covariance()
    ocp.minimize(running=2e-3 * (u / 1e-3) ** 2 / DAY, terminal=E[g, g] / 0.25)
    return ocp


def integrated(rates, first, ends):
    """The end of what moves by rates(t, y, k) in the k-th of the stretches between some times."""
    y = first
    for k, (begin, end) in enumerate(pairwise(ends)):
        steps = {"rtol": 1e-9, "atol": 1e-12, "max_step": (end - begin) / 50}
        y = solve_ivp(rates, (begin, end), y, args=(k,), method="LSODA", **steps).y[:, -1]
    return y


def learnt(control):
    """The cost of `thruster` along a control."""

    def rates(t, y, k):
        u, E = control(t), y[1:5].reshape(2, 2)
        F = np.array([[-1 / 2e4, u], [0.0, 0.0]])
        rate = F @ E + E @ F.T + np.diag([1e-4, 0.0]) - (k == 1) * np.outer(E[:, 0], E[0])
        return np.r_[u - y[0] / 2e4, rate.ravel(), 2e-3 * (u / 1e-3) ** 2 / DAY]

    y = integrated(rates, np.r_[0.0, np.diag([1.0, 0.25]).ravel(), 0.0], (0.0, *PASS, DAY))
    return y[-1] + y[4] / 0.25


@pytest.mark.parametrize("method", ["ipopt", "auto"])
def test_a_pass_that_is_shorter_than_a_step_is_seen(method):
    solution = co.solve(thruster(), method, progress=False)
    assert solution.cost == pytest.approx(learnt(lambda t: float(solution.controls_at(t)[0])), rel=1e-4)
    assert solution.cost < 1.001 * learnt(lambda t: 1e-3 if t < PASS[1] else 0.0) < 0.02


def test_a_pass_that_only_shorter_steps_see_leaves_a_saddle():
    """Of a table of CasADi's own nothing is known: where no step sees the pass, no control at all is a minimum."""

    def tabulated(time, begin, end, information):
        grid = [0.0, begin, begin + 1.0, end - 1.0, end, DAY]
        values = [0.0, 0.0, information, information, 0.0, 0.0]
        return ca.interpolant("on", "linear", [grid], values)(time)

    with pytest.warns(co.CovocpWarning, match="saddle"):
        solution = co.solve(thruster(tabulated, 43500.0, 43860.0), progress=False)
    assert solution.cost < 0.014


def test_times_that_a_parameter_says_are_those_of_each_solve():
    ocp = co.Problem(10.0)
    begin = ocp.parameter("begin", 2.0)
    v, g, u = ocp.state("v", initial=0.0, variance=1.0), ocp.unknown("g", mean=1.0, variance=1.0), ocp.control("u")
    ocp.dynamics(v, g * u - v)
    ocp.measurement("speed", v, information=on(ocp.time, begin, begin + 0.03, 1000.0))
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2 / 10, terminal=E[g, g])
    solver = co.Solver(ocp)
    for time in (2.0, 7.01234):
        nodes = solver.solve(parameters={"begin": time}, progress=False).t
        assert np.abs(nodes[:, None] - [time, time + 0.03]).min(axis=0) == pytest.approx([0.0, 0.0], abs=1e-12)


def camera(begin, end):
    """A double integrator with an unknown gain that is fed back, seen by a camera for a while."""
    ocp = co.Problem(100.0, name="camera")
    x, v = ocp.state("x", initial=10.0, variance=4.0), ocp.state("v", initial=0.0, variance=0.01)
    g, u = ocp.unknown("g", mean=1.0, variance=0.04), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, g * u, noise=1e-4)
    ocp.measurement("camera", x, information=on(ocp.time, begin, end, CAMERA))
    ocp.minimize_expected(running=10 * u**2, terminal_weight={x: 1.0, v: 10.0}, terminal=x**2 / 2 + 5 * v**2)
    return ocp


def moments(solution, begin, end):
    """Cost and deviations at the end along the nominal of `camera`, with its best gain."""
    G = np.array([[0.0], [1.0], [0.0]])

    def drift(t):
        return np.array([[0.0, 1.0, 0.0], [0.0, 0.0, float(solution.controls_at(t)[0])], [0.0, 0.0, 0.0]])

    def backward(s, y):
        S, F = y.reshape(3, 3), drift(100.0 - s)
        return (F.T @ S + S @ F - S @ G @ G.T @ S / 20).ravel()

    course = solve_ivp(
        backward, (0, 100), np.diag([2.0, 20.0, 0.0]).ravel(), "LSODA", dense_output=True, rtol=1e-8, atol=1e-11
    ).sol

    def rates(t, y, k):
        E, Xhat, F = y[2:11].reshape(3, 3), y[11:20].reshape(3, 3), drift(t)
        C = G.T @ course(100.0 - t).reshape(3, 3) / 20
        seen, A, u = CAMERA * (k == 1) * np.outer(E[:, 0], E[0]), F - G @ C, F[1, 2]
        known = F @ E + E @ F.T + np.diag([0.0, 1e-4, 0.0]) - seen
        estimated = A @ Xhat + Xhat @ A.T + seen
        return np.r_[y[1], u, known.ravel(), estimated.ravel(), 10 * u**2 + 10 * (C @ Xhat @ C.T).item()]

    first = np.r_[10.0, 0.0, np.diag([4.0, 0.01, 0.04]).ravel(), np.zeros(9), 0.0]
    y = integrated(rates, first, (0.0, begin, end, 100.0))
    X = (y[2:11] + y[11:20]).reshape(3, 3)
    return y[-1] + y[0] ** 2 / 2 + 5 * y[1] ** 2 + X[0, 0] + 10 * X[1, 1], np.sqrt(np.diag(X))


@pytest.mark.filterwarnings("ignore:The mesh is too coarse:covocp.CovocpWarning")
@pytest.mark.parametrize("window", [(20.0, 25.0), (50.001, 55.001), (70.3, 75.3)])
def test_cost_and_deviations_of_a_loop_whose_sensor_is_switched_on_late(window):
    solution = co.solve(camera(*window), progress=False)
    cost, deviations = moments(solution, *window)
    assert solution.cost == pytest.approx(cost, rel=1e-2)
    assert [float(solution.deviation(name)[-1].item()) for name in ("x", "v")] == pytest.approx(
        deviations[:2], rel=1e-3
    )
    assert solution.optimality.cost_identity < 2e-2


def test_a_mesh_that_refines_itself_finds_the_same():
    solution = co.solve(camera(70.3, 75.3), progress=False, refine=1e-4)
    assert solution.cost == pytest.approx(moments(solution, 70.3, 75.3)[0], rel=1e-4)


@pytest.mark.filterwarnings("ignore:The mesh is too coarse:covocp.CovocpWarning")
def test_simulations_predict_the_deviations_of_the_loop():
    """The filter takes what is seen first, just after a node: its gain there is that of the interval that begins."""
    solution = co.solve(camera(50.0, 55.0), progress=False)
    runs = co.simulate(solution, runs=8, seed=1, progress=False, step=0.05)
    predicted = np.sqrt(np.diagonal(runs.predicted[-1]))[:2]
    assert predicted == pytest.approx(moments(solution, 50.0, 55.0)[1][:2], rel=1e-3)


def lighthouse(place, strength=1e5, width=0.2):
    """Two integrators; the second is seen well where the first comes near a place, late on its way."""
    ocp = co.Problem(10.0, name="lighthouse")
    x, y = ocp.state("x", initial=0.0, variance=1.0), ocp.state("y", initial=0.0, variance=1.0)
    u, v = ocp.control("u"), ocp.control("v")
    ocp.dynamics(x, u, noise=1e-3)
    ocp.dynamics(y, v, noise=1e-3)
    ocp.measurement("light", y, information=strength * ca.exp(-(((x - place) / width) ** 2)))
    ocp.measurement("way", x, information=1.0)
    running = u**2 / 10 + v**2 / 10 + (x - 0.6 * ocp.time) ** 2
    ocp.minimize_expected(running=running, terminal=20 * (x - 6) ** 2 + 50 * y**2)
    return ocp


def seen_by_it(solution, place, strength=1e5, width=0.2):
    """The expected cost along the nominal of `lighthouse`, with its best gain."""
    end, weight = np.diag([40.0, 100.0]), np.diag([2.0, 0.0])

    def backward(s, y):
        S = y.reshape(2, 2)
        return (weight - 5 * S @ S).ravel()

    course = solve_ivp(backward, (0, 10), end.ravel(), "LSODA", dense_output=True, rtol=1e-10, atol=1e-12).sol

    def rates(t, y, k):
        E, Xhat, u = y[2:6].reshape(2, 2), y[6:10].reshape(2, 2), solution.controls_at(t).ravel()
        C, W = 5 * course(10.0 - t).reshape(2, 2), np.diag([1.0, strength * np.exp(-(((y[0] - place) / width) ** 2))])
        seen, spread = E @ W @ E, np.trace(weight @ (E + Xhat)) / 2 + np.trace(C @ Xhat @ C.T) / 10
        cost = (u @ u) / 10 + (y[0] - 0.6 * t) ** 2 + spread
        return np.r_[u, (1e-3 * np.eye(2) - seen).ravel(), (seen - C @ Xhat - Xhat @ C.T).ravel(), cost]

    first = np.r_[0.0, 0.0, np.eye(2).ravel(), np.zeros(5)]
    y = integrated(rates, first, np.unique(solution.t))
    spread = (y[2:6] + y[6:10]).reshape(2, 2)
    return y[-1] + 20 * (y[0] - 6) ** 2 + 50 * y[1] ** 2 + np.trace(end @ spread) / 2


def test_a_sensor_that_comes_to_see_something_late_costs_no_accuracy():
    solution = co.solve(lighthouse(4.5), progress=False)
    assert solution.cost == pytest.approx(seen_by_it(solution, 4.5), rel=5e-7)
