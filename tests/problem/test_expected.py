"""The derived vector-matrix problem of an expected cost against numpy: expansion, rates, costs, weights."""

from __future__ import annotations

from functools import cache

import casadi as ca
import nonlinear_loop as loop
import numpy as np
import pytest
from closed_loops import lower
from nonlinear_loop import random_point, slopes
from problems import solve

import covocp as co

SEEDS = (1, 2, 3)


@cache
def statement(gain=None):
    return loop.problem(noise=1.3, gain=gain).statement()


def values(x):
    """Stacked parameters: the factor of the noise, the mean of c."""
    return np.array([1.3, x[2]])


def numbers(function, *arguments):
    return [np.asarray(v.full()) for v in function(*arguments)]


# --- the example itself -----------------------------------------------------------------------------------------------


def test_gradients_of_the_example_are_derivatives():
    for seed in SEEDS:
        x, u, _, _ = random_point(seed)
        both = loop.derivative(lambda z: [loop.running(z[:3], z[3:])], np.concatenate([x, u]))[0]
        np.testing.assert_allclose(loop.running_slopes(x, u), both, rtol=1e-13)
        np.testing.assert_allclose(
            loop.terminal_slope(x), loop.derivative(lambda z: [loop.terminal(z)], x)[0], rtol=1e-13
        )


# --- expansion --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_expansion_to_second_order(seed):
    """F, G, A, B, N, Q, with derivatives by the unknown among them; k, S(T) = k_xx, L."""
    x, u, _, _ = random_point(seed)
    found = numbers(statement().loop.expansion, x[:2], u, 0.3, loop.DURATION, values(x))
    F, G, _, A, B, N = slopes(x, u)
    for one, two in zip(found, (F, G, A, B, N, loop.process_noise(x, u, 1.3)), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-13)
    k, end = numbers(statement().loop.terminal, x[:2], loop.DURATION, values(x))
    assert k.item() == pytest.approx(loop.terminal(x), rel=1e-14)
    np.testing.assert_allclose(end, loop.terminal_curvature(x), atol=1e-13)
    running = statement().loop.running(x[:2], u, 0.3, loop.DURATION, values(x))
    assert float(running) == pytest.approx(loop.running(x, u), rel=1e-13)


@pytest.mark.parametrize("seed", SEEDS)
def test_rates_of_the_derived_problem(seed):
    """E by Kalman and Bucy, S by (6.3-20), the running cost L + tr(A E + S E W E)/2, k + tr(k_xx E)/2, C."""
    x, u, E, S = random_point(seed)
    F, G, M, A, B, N = slopes(x, u)
    W = M.T @ np.linalg.inv(loop.MEASUREMENT_NOISE) @ M
    C = np.linalg.solve(B, G.T @ S + N.T)
    halves = np.concatenate([lower(E), lower(S)])
    rate, matrices, running = numbers(statement().rates, x[:2], u, halves, 0.3, loop.DURATION, values(x))
    E_rate = F @ E + E @ F.T + loop.process_noise(x, u, 1.3) - E @ W @ E
    S_rate = -F.T @ S - S @ F - A + C.T @ B @ C
    np.testing.assert_allclose(rate.ravel(), loop.rate(x, u)[:2], rtol=1e-13)
    np.testing.assert_allclose(matrices.ravel(), np.concatenate([lower(E_rate), lower(S_rate)]), rtol=1e-11, atol=1e-12)
    expected = loop.running(x, u) + 0.5 * np.trace(A @ E) + 0.5 * np.trace(S @ E @ W @ E)
    assert running.item() == pytest.approx(expected, rel=1e-12)
    terminal = statement().terminal(x[:2], halves, loop.DURATION, values(x))
    assert float(terminal) == pytest.approx(
        loop.terminal(x) + 0.5 * np.trace(loop.terminal_curvature(x) @ E), rel=1e-13
    )
    gain = statement().loop.gain(x[:2], u, halves, 0.3, loop.DURATION, values(x)).full()
    np.testing.assert_allclose(gain, C, rtol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_riccati_form_of_the_backward_matrix(seed):
    """dS/dt = F1 S + S F1' + Q1 - S W1 S with the cross term inside, and S(T)."""
    x, u, _, _ = random_point(seed)
    F, G, _, A, B, N = slopes(x, u)
    drift, noise, information = numbers(statement().riccati[1], x[:2], u, 0.3, loop.DURATION, values(x))
    np.testing.assert_allclose(drift, -(F - G @ np.linalg.solve(B, N.T)).T, atol=1e-12)
    np.testing.assert_allclose(noise, -(A - N @ np.linalg.solve(B, N.T)), atol=1e-12)
    np.testing.assert_allclose(information, -G @ np.linalg.solve(B, G.T), atol=1e-12)
    end = statement().matrix_end(x[:2], loop.DURATION, values(x)).full().ravel()
    np.testing.assert_allclose(end, lower(loop.terminal_curvature(x)), atol=1e-13)
    assert [block.name for block in statement().matrices if block.backward] == ["S"]


@pytest.mark.parametrize("seed", SEEDS)
def test_deviations_cost_what_sampling_gives(seed):
    """L of the actual system in the mean over deviations: symmetric points, so exact but for their fourth powers.

    With free gains, where C, E and Xhat are arguments: dx = y - e, du = -C y, <e e'> = E, <y y'> = Xhat, <e y'> = 0.
    """
    x, u, E, X = random_point(seed)
    C = np.random.default_rng(seed).standard_normal((2, 3))
    st = statement(co.Gain())
    halves = np.concatenate([lower(E), lower(X)])
    control = np.concatenate([u, C.ravel(order="F")])
    running = numbers(st.rates, x[:2], control, halves, 0.3, loop.DURATION, values(x))[2].item()
    size, total = 2e-4, 0.0
    for matrix, shift in ((E, lambda d: (-d, np.zeros(2))), (X, lambda d: (d, -C @ d))):
        for column in np.linalg.cholesky(matrix).T:
            dx, du = shift(size * column)
            mean = (loop.running(x + dx, u + du) + loop.running(x - dx, u - du)) / 2
            total += (mean - loop.running(x, u)) / size**2
    assert running == pytest.approx(loop.running(x, u) + total, rel=1e-6)  # size^2, and roundoff over size^2
    terminal = st.terminal(x[:2], halves, loop.DURATION, values(x))
    half = 0.5 * np.trace(loop.terminal_curvature(x) @ (E + X))
    assert float(terminal) == pytest.approx(loop.terminal(x) + half, rel=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_covariance_of_the_estimate_with_a_free_gain(seed):
    """dXhat/dt = (F - G C) Xhat + Xhat (F - G C)' + E W E (A-32)."""
    x, u, E, X = random_point(seed)
    C = np.random.default_rng(seed).standard_normal((2, 3))
    F, G, M, *_ = slopes(x, u)
    W = M.T @ np.linalg.inv(loop.MEASUREMENT_NOISE) @ M
    st = statement(co.Gain())
    control = np.concatenate([u, C.ravel(order="F")])
    halves = np.concatenate([lower(E), lower(X)])
    rates = numbers(st.rates, x[:2], control, halves, 0.3, loop.DURATION, values(x))[1].ravel()
    np.testing.assert_allclose(rates[6:], lower((F - G @ C) @ X + X @ (F - G @ C).T + E @ W @ E), rtol=1e-11)
    np.testing.assert_allclose(st.loop.gain(x[:2], control, halves, 0.3, loop.DURATION, values(x)).full(), C)


def test_measurement_noise_may_depend_on_the_state():
    """A density that is a full matrix of expressions."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", 2, initial=[1, 0], variance=1.0), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u))
    density = ca.blockcat([[1 + x[0] ** 2, 0.3], [0.3, 2.0]])
    ocp.measurement("m", ca.vertcat(ca.sin(x[0]), x[1]), density)
    ocp.minimize_expected(running=0.5 * u**2, terminal=ca.dot(x, x))
    st = ocp.statement()
    E, S, at = np.array([[0.5, 0.1], [0.1, 0.4]]), np.array([[1.5, -0.2], [-0.2, 0.7]]), np.array([0.6, -0.2])
    M, U = np.diag([np.cos(0.6), 1.0]), np.array([[1.36, 0.3], [0.3, 2.0]])
    W = M.T @ np.linalg.inv(U) @ M
    _, matrices, running = numbers(st.rates, at, [0.0], np.concatenate([lower(E), lower(S)]), 0.0, 1.0, [])
    F = np.array([[0.0, 1.0], [0.0, 0.0]])
    np.testing.assert_allclose(matrices.ravel()[:3], lower(F @ E + E @ F.T - E @ W @ E), rtol=1e-12)
    assert running.item() == pytest.approx(0.5 * np.trace(S @ E @ W @ E), rel=1e-12)


def test_time_in_the_cost_is_a_state_that_is_known():
    """Explicit time against a clock among the states."""
    costs = []
    for clock in (False, True):
        ocp = co.Problem(duration=2.0)
        x, u = ocp.state("x", initial=1.0, variance=0.5), ocp.control("u")
        t = ocp.state("t", initial=0.0) if clock else ocp.time
        if clock:
            ocp.dynamics(t, 1.0)
        ocp.dynamics(x, -ca.sin(x) + (1 + t) * u, noise=0.2 + 0.1 * t)
        ocp.measurement("m", x * (1 + t), noise=1 + t)
        ocp.minimize_expected(running=0.5 * (1 + t) * u**2 + ca.cos(t) ** 2 * x**2)
        costs.append(co.evaluate(ocp, nominal={"u": lambda s: -np.cos(3 * s)}, intervals=20).cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-12)


def test_interpolation_tables():
    """Their derivatives have no scalar form of their own; against the function in the table."""
    knots = np.linspace(-3, 3, 49)
    table = ca.interpolant("table", "bspline", [knots], np.sin(knots))
    costs = []
    for function in (table, ca.sin):
        ocp = co.Problem(duration=2.0)
        x, u = ocp.state("x", initial=0.5, variance=0.5), ocp.control("u")
        ocp.dynamics(x, -function(x) + u, noise=0.3)
        ocp.measurement("m", x + 0.3 * function(2 * x), noise=0.2)
        ocp.minimize_expected(running=0.5 * u**2 + x**2 + 0.2 * function(x), terminal=x**2)
        costs.append(solve(ocp, intervals=20).cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-4)  # third derivatives of the spline: h


# --- weights ----------------------------------------------------------------------------------------------------------


def weighted(**weights):
    """B and S(T) of a problem with two controls, one a vector, a state and an unknown, all with cross terms."""
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", 2, initial=0.0, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=1.0)
    u, w = ocp.control("u", 2), ocp.control("w")
    r = ocp.parameter("r", 7.0)
    ocp.dynamics(x, u + b * w)
    running = u[0] ** 2 + 2 * u[1] ** 2 + 0.5 * u[0] * u[1] + 3 * w**2 + 0.1 * u[0] * w + x[0] * u[0]
    given = {name: value(x, b, u, w, r) for name, value in weights.items()}
    ocp.minimize_expected(running=running, terminal=x[0] ** 2 + 0.3 * x[0] * b, **given)
    st = ocp.statement()
    zero = ([0.0, 0.0], [0.0, 0.0, 0.0], 0.0, 1.0, st.values)
    expansion = numbers(st.loop.expansion, *zero)
    extra = st.loop.extra_control(*zero).full()
    return expansion[3], expansion[4], extra, st.loop.terminal([0.0, 0.0], 1.0, st.values)[1].full()


CURVATURE = np.array([[2.0, 0.5, 0.1], [0.5, 4.0, 0.0], [0.1, 0.0, 6.0]])
END = np.array([[2.0, 0.0, 0.3], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("weight", "B"),
    [
        (lambda x, b, u, w, r: None, CURVATURE),
        (lambda x, b, u, w, r: {w: 9.0}, [[2.0, 0.5, 0.0], [0.5, 4.0, 0.0], [0.0, 0.0, 9.0]]),
        (lambda x, b, u, w, r: {"w": r}, [[2.0, 0.5, 0.0], [0.5, 4.0, 0.0], [0.0, 0.0, 7.0]]),
        (lambda x, b, u, w, r: {u: [5.0, 8.0]}, [[5.0, 0.0, 0.0], [0.0, 8.0, 0.0], [0.0, 0.0, 6.0]]),
        (lambda x, b, u, w, r: {u: [[5, 1], [1, 8]], w: 2}, [[5.0, 1.0, 0.0], [1.0, 8.0, 0.0], [0.0, 0.0, 2.0]]),
        (lambda x, b, u, w, r: 4.0, 4.0 * np.eye(3)),
        (lambda x, b, u, w, r: [1.0, 2.0, 3.0], np.diag([1.0, 2.0, 3.0])),
        (lambda x, b, u, w, r: CURVATURE + np.eye(3), CURVATURE + np.eye(3)),
    ],
)
def test_control_weight_in_place_of_the_curvature(weight, B):
    found, cross, extra, _ = weighted(control_weight=weight)
    np.testing.assert_allclose(found, B)
    np.testing.assert_allclose(extra, np.asarray(B) - CURVATURE, atol=1e-15)
    np.testing.assert_allclose(cross, [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # N stays L_xu


@pytest.mark.parametrize(
    ("weight", "added"),
    [
        (lambda x, b, u, w, r: None, np.zeros((3, 3))),
        (lambda x, b, u, w, r: {x: 2.0}, np.diag([2.0, 2.0, 0.0])),
        (lambda x, b, u, w, r: {"x": [1.0, 0.0], b: 4.0}, np.diag([1.0, 0.0, 4.0])),
        (lambda x, b, u, w, r: {x: [[2, 1], [1, 3]]}, [[2, 1, 0], [1, 3, 0], [0, 0, 0]]),
        (lambda x, b, u, w, r: {x: r}, np.diag([7.0, 7.0, 0.0])),
        (lambda x, b, u, w, r: 0.5, 0.5 * np.eye(3)),
        (lambda x, b, u, w, r: np.ones((3, 3)), np.ones((3, 3))),
    ],
)
def test_terminal_weight_is_added_to_the_curvature(weight, added):
    _, _, _, end = weighted(terminal_weight=weight)
    np.testing.assert_allclose(end, END + added)


def test_a_control_weight_costs_deviations_only():
    """<int |u|> becomes int |u| and B of the deviations (case 3): the nominal's own cost stays as it is."""
    found = []
    for weight in (1.0, 4.0):
        ocp = co.Problem(duration=1.0)
        x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
        ocp.dynamics(x, u, noise=0.5)
        ocp.measurement("m", x, noise=1.0)
        ocp.minimize_expected(running=ca.fabs(u), terminal_weight={x: 2.0}, control_weight={u: weight})
        found.append(co.evaluate(ocp, nominal={"u": lambda s: np.where(s < 0.5, 1.0, -2.0)}, intervals=20))
    assert found[0].cost_terms["running"] == found[1].cost_terms["running"]
    # C = S/B, dS/dt = S^2/B backward from 2: S(0) = 2 B/(B + 2)
    for solution, weight in zip(found, (1.0, 4.0), strict=True):
        assert solution.gains["C"][0, 0, 0] == pytest.approx(2 / (weight + 2), rel=1e-9)


# --- the user's problem -----------------------------------------------------------------------------------------------


def test_the_problem_itself_is_not_changed():
    ocp = loop.problem(gain=co.Gain(constant=True))
    before = {name: getattr(ocp.declarations, name) for name in ("states", "controls", "matrices", "constraints")}
    rates = dict(ocp.declarations.rates)
    first = ocp.statement()
    assert {name: getattr(ocp.declarations, name) for name in before} == before
    assert ocp.declarations.rates == rates
    assert ocp.declarations.cost is None
    assert ocp.statement() is first
    assert "C" not in [entry.name for entry in ocp.declarations.states]


def test_what_is_added_after_a_first_solution_counts():
    """The statement is derived again: unmeasured J = 1/2 + int (1/2 + t) dt/2 = 1; S = tanh(1 - t), E a hyperbola."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=1.0, variance=0.5), ocp.control("u")
    ocp.dynamics(x, u, noise=1.0)
    ocp.minimize_expected(running=0.5 * u**2 + 0.5 * x**2)
    assert co.evaluate(ocp, nominal={"u": 0.0}, intervals=40).cost == pytest.approx(1.0, rel=1e-9)
    ocp.measurement("m", x, noise=0.1)
    t = np.linspace(0.0, 1.0, 10001)
    root = np.sqrt(10.0)  # dE/dt = 1 - 10 E^2
    E, S = 1 / (root * np.tanh(root * t + np.arctanh(1 / (0.5 * root)))), np.tanh(1 - t)
    expected = 0.5 + 0.25 * np.tanh(1.0) + 0.5 * np.trapezoid(S + S**2 * E, t)
    assert co.evaluate(ocp, nominal={"u": 0.0}, intervals=40).cost == pytest.approx(expected, rel=2e-6)


def test_given_initial_covariance_is_used():
    """In place of the variances of states and unknowns."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, variance=5.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.estimation_covariance(initial=0.25)
    ocp.minimize_expected(running=0.5 * u**2, terminal=x**2)
    # nothing is measured, so nothing is fed back: E(T) = E(0), J = S(T) E(T)/2
    assert solve(ocp, intervals=10).cost == pytest.approx(0.25, rel=1e-9)
