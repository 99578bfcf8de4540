"""`exact` of every model against integration, quadrature and necessary conditions that do not use its formulas."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import expm, solve_sylvester
from scipy.optimize import brentq, lsq_linear

from covocp.models import (
    brachistochrone,
    bryson_denham,
    chord_test,
    damped_oscillator,
    free_time_integrator,
    mass_chain,
    noisy_integrator,
    unknown_gain,
    unknown_lag,
)

TIGHT = {"rtol": 1e-12, "atol": 1e-12, "method": "DOP853"}


def integrate(rate, start, end, *, breaks=(), begin=0.0):
    """Value at the end of an ordinary differential equation, piece by piece between the breaks."""
    times = [begin, *(t for t in breaks if min(begin, end) < t < max(begin, end)), end]
    value = np.asarray(start, dtype=float)
    for first, last in pairwise(times):
        value = solve_ivp(rate, (first, last), value, **TIGHT).y[:, -1]
    return value


# --- integrator with state-dependent noise (3.4) ----------------------------------------------------------------------

WEIGHTS = [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (0.7, 1.3), (2.0, 0.0), (4.0, 0.0), (0.0, 8.0), (3.0, 9.0), (10.0, 5.0)]


@pytest.mark.parametrize(
    ("alpha", "beta", "u", "E", "cost", "energy"),
    [
        (0, 0, [1, 0, 0], [0, 0, 1 / 2, 0, 0], 1 / 2, 1 / 2),
        (0, 1, [2 / 3, 1, -1 / 2], [0, 0, 1 / 3, 1 / 6, -1 / 24], 59 / 90, 23 / 45),
        (1, 0, [1 / 2, 1, 0], [0, 0, 1 / 4, 1 / 6, 0], 23 / 24, 23 / 24 - 5 / 12),
    ],
)
def test_noisy_integrator_table(alpha, beta, u, E, cost, energy):
    t = np.linspace(0, 1, 11)
    exact = noisy_integrator.exact(alpha, beta, t)
    np.testing.assert_allclose(exact.u, np.polynomial.Polynomial(u)(t), rtol=1e-14)
    np.testing.assert_allclose(exact.E, np.polynomial.Polynomial(E)(t), rtol=1e-14, atol=1e-15)
    assert exact.cost == pytest.approx(cost, rel=1e-14)
    assert exact.energy == pytest.approx(energy, rel=1e-14)
    assert exact.ell == pytest.approx(-sum(u), rel=1e-14)
    assert exact.arc == 0.0


@pytest.mark.parametrize(("alpha", "beta"), WEIGHTS)
def test_noisy_integrator_integrates(alpha, beta):
    exact = noisy_integrator.exact(alpha, beta, [0.37, 1.0])

    def rate(t, z):
        u = noisy_integrator.exact(alpha, beta, t).u
        return [u, z[0], u**2 / 2, z[1]]

    middle = integrate(rate, np.zeros(4), 0.37, breaks=[exact.arc])
    end = integrate(rate, np.zeros(4), 1.0, breaks=[exact.arc])
    np.testing.assert_allclose([middle[0], end[0]], exact.x, atol=1e-11)
    np.testing.assert_allclose([middle[1], end[1]], exact.E, atol=1e-11)
    assert end[0] == pytest.approx(1.0, abs=1e-11)
    assert alpha * end[1] + end[2] + beta * end[3] == pytest.approx(exact.cost, rel=1e-11)
    assert end[2] == pytest.approx(exact.energy, rel=1e-11)


def noisy_programme(alpha, beta, intervals):
    """Least cost over continuous piecewise-linear x >= 0, and these x: a convex quadratic programme with bounds.

    Its cost is that of the best u that is constant on each interval: above the optimum by at most h^2/24 int P^2 dt,
    which is int (u - mean of u)^2/2 for the optimal u, whose slope is at most P.
    """
    h, t = 1 / intervals, np.linspace(0, 1, intervals + 1)
    difference = (np.eye(intervals, intervals + 1, k=1) - np.eye(intervals, intervals + 1)) / np.sqrt(h)
    # E(1) = int x and int E = int (1 - t) x, exact for piecewise-linear x; the hat function of node 0 is not needed
    load = h * (alpha + beta * (1 - t))
    load[-1] = h * (alpha / 2 + beta * h / 6)
    free = difference[:, 1:-1]
    shift = np.linalg.lstsq(free.T, load[1:-1], rcond=None)[0]
    x = lsq_linear(free, -difference[:, -1] - shift, bounds=(0, np.inf), method="bvls", tol=1e-14).x
    x = np.concatenate([[0.0], x, [1.0]])
    return 0.5 * np.sum((difference @ x) ** 2) + load @ x, x


@pytest.mark.parametrize(("alpha", "beta"), WEIGHTS)
def test_noisy_integrator_is_the_minimum(alpha, beta):
    intervals = 200
    cost, x = noisy_programme(alpha, beta, intervals)
    exact = noisy_integrator.exact(alpha, beta, np.linspace(0, 1, intervals + 1))
    bound = (alpha**2 + alpha * beta + beta**2 / 3) / 24 / intervals**2
    assert -1e-10 <= cost - exact.cost <= 1.01 * bound + 1e-10
    largest = (alpha + beta) / intervals**2  # h^2 P: what x can change by the kink at t1 falling inside an interval
    np.testing.assert_allclose(x, exact.x, atol=largest + 1e-9)
    assert np.all(exact.x >= 0)


# --- integrator with unknown gain (3.5) -------------------------------------------------------------------------------


def gain_cost(u, b, variance, c, q, T):
    """Cost and end of a control u(t) along the full covariance equation."""

    def rate(t, z):
        F = np.array([[0.0, u(t)], [0.0, 0.0]])
        E = z[2:].reshape(2, 2)
        return np.concatenate([[b * u(t), c * u(t) ** 2 / 2], (F @ E + E @ F.T + np.diag([q, 0.0])).ravel()])

    return integrate(rate, [0.0, 0.0, 0.0, 0.0, 0.0, variance], T)


@pytest.mark.parametrize("data", [(1.0, 0.5, 1.0, 0.1, 1.0, 1.0), (-2.0, 0.3, 0.4, 0.2, 3.0, 2.5)])
def test_unknown_gain(data):
    b, variance, c, q, final, T = data
    exact = unknown_gain.exact(*data)
    end = gain_cost(lambda t: exact.u[0], b, variance, c, q, T)
    np.testing.assert_allclose(end[[0, 2, 3, 5]], [final, exact.E_xx[-1], exact.E_xb[-1], variance], rtol=1e-11)
    assert end[1] + end[2] == pytest.approx(exact.cost, rel=1e-12)
    # H_u = c u + p b + 2 P11 E12 + 2 P12 E22 = 0 with P11 = 1 and P12 = u (T - t)
    slope = c * exact.u + exact.p * b + 2 * exact.E_xb + 2 * exact.u * (T - exact.t) * variance
    np.testing.assert_allclose(slope, 0.0, atol=1e-13 * np.abs(exact.ell * b))
    assert exact.ell == exact.p[-1]
    # every control that reaches x(T) has the same E_xx(T), so a bent one costs more: by the energy of the bend
    bent = gain_cost(lambda t: exact.u[0] + np.cos(np.pi * t / T), b, variance, c, q, T)
    assert bent[0] == pytest.approx(final, rel=1e-11)
    assert bent[1] + bent[2] == pytest.approx(exact.cost + c * T / 4, rel=1e-11)


def test_unknown_gain_correction_sheet_is_not_optimal():
    b, variance, c, q, final, T = 1.0, 0.5, 1.0, 0.1, 1.0, 1.0
    k = 2 * variance / c
    end = gain_cost(lambda t: k * final * np.exp(k * t) / (b * np.expm1(k * T)), b, variance, c, q, T)
    assert end[0] == pytest.approx(final)
    assert end[1] + end[2] > unknown_gain.exact().cost + 0.04


# --- first-order lag (5.2) --------------------------------------------------------------------------------------------


def lag_rate(u):
    """Rates of x, E_xx, E_xb, E_bb and of the energy, specification 6.4."""

    def rate(t, z):
        x, E11, E12, E22 = z[:4]
        return [
            -x + u(t),
            -2 * E11 - E11**2 + 1 - 2 * x * E12,
            -E12 - x * E22 - E11 * E12,
            -(E12**2),
            u(t) ** 2 / 2,
        ]

    return rate


@pytest.mark.parametrize(
    ("weight", "cost", "energy", "E11", "E12", "E22", "ell", "H"),
    [
        (0.1, 0.44818922, 0.10914073, 0.4171458, -0.0997076, 3.3904849, 0.0616565, -0.00289492),
        (1.0, 1.91442319, 0.84225771, 0.4213693, -0.0875906, 1.0721655, 0.1712804, -0.02234059),
        (10.0, 6.55106209, 3.16057716, 0.4227049, -0.0536560, 0.3390485, 0.3317939, -0.08383322),
    ],
)
def test_lag_table(weight, cost, energy, E11, E12, E22, ell, H):
    exact = unknown_lag.exact(weight)
    assert exact.cost == pytest.approx(cost, abs=6e-9)
    assert exact.energy == pytest.approx(energy, abs=6e-9)
    found = [exact.E_xx[-1], exact.E_xb[-1], exact.E_bb[-1], exact.ell]
    np.testing.assert_allclose(found, [E11, E12, E22, ell], atol=6e-8)
    assert exact.hamiltonian == pytest.approx(H, abs=6e-9)


def test_lag_eigenvalue():
    assert unknown_lag.exact().eigenvalue == pytest.approx(0.43495704, abs=6e-9)
    assert unknown_lag.exact().threshold == pytest.approx(0.0459816, abs=6e-8)


@pytest.mark.parametrize(("duration", "variance"), [(10.0, 1.0), (3.0, 0.2), (1.0, 0.0)])
def test_lag_eigenvalue_by_shooting(duration, variance):
    """The Euler equations of max int S^2 / int u^2 have a solution with x(T) = 0 exactly at an eigenvalue."""

    def end(value):
        def rate(t, z):
            y, (x, S, p, r) = z[0], z[1:].reshape(4, 2)
            return [2 - y**2, *(-x - p / value), *(-y * S - x), *(p + r), *(S + y * r)]

        final = integrate(rate, [1 + variance, 0, 0, 0, 0, 1, 0, 0, 1], duration)
        return np.linalg.det(final[[1, 2, 7, 8]].reshape(2, 2))  # x(T) and r(T)

    found = unknown_lag.exact(10.0, duration, variance).eigenvalue
    root = brentq(end, 0.999 * found, 1.001 * found, xtol=1e-14)
    assert found == pytest.approx(root, rel=1e-8)
    above = [end(value) for value in np.linspace(1.01 * found, 3 * found, 40)]
    assert np.all(np.sign(above) == np.sign(above[0])), "a larger eigenvalue was missed"


@pytest.mark.parametrize("data", [(10.0, 10.0, 1.0, 5.0), (1.0, 10.0, 1.0, 5.0), (4.0, 4.0, 0.3, 2.0)])
def test_lag_satisfies_the_necessary_conditions(data):
    """u = -p along the whole trajectory, all of it integrated from the equations of the covariance."""
    weight, T, variance, prior = data
    t = np.linspace(0, T, 2001)
    exact = unknown_lag.exact(*data, t=t)
    u = CubicSpline(t, exact.u)
    forward = solve_ivp(lag_rate(u), (0, T), [0, variance, 0, prior, 0], t_eval=t, **TIGHT).y
    np.testing.assert_allclose(forward[:4], [exact.x, exact.E_xx, exact.E_xb, exact.E_bb], atol=1e-8)
    assert weight * forward[3, -1] + forward[4, -1] == pytest.approx(exact.cost, rel=1e-9)
    path = CubicSpline(t, forward[:4].T)

    def costates(s, z):
        x, E11, E12, E22 = path(s)
        P = z[1:].reshape(2, 2)
        closed = np.array([[-1 - E11, -x], [-E12, 0.0]])
        return [z[0] + 2 * (P[0, 0] * E12 + P[0, 1] * E22), *(-closed.T @ P - P @ closed).ravel()]

    backward = solve_ivp(costates, (T, 0), [exact.ell, 0, 0, 0, weight], t_eval=t[::-1], **TIGHT).y[:, ::-1]
    np.testing.assert_allclose(backward[0], -exact.u, atol=1e-7)
    # P_bb(0) = 1/(2 lambda E_bb(0)^2) for every weight; H from its definition at t = 0
    assert backward[4, 0] == pytest.approx(1 / (2 * exact.eigenvalue * prior**2), rel=1e-7)
    E, P = np.diag([variance, prior]), backward[1:, 0].reshape(2, 2)
    F = np.array([[-1.0, 0.0], [0.0, 0.0]])
    V = F @ E + E @ F.T + np.diag([1.0, 0.0]) - np.outer(E[:, 0], E[0])
    assert -(exact.u[0] ** 2) / 2 + np.trace(P @ V) == pytest.approx(exact.hamiltonian, abs=1e-7)


@pytest.mark.parametrize(("noise", "cost", "E_bb"), [(1e-3, 4.5802190, 0.2345105), (1e-6, 4.5777677, 0.2343819)])
def test_lag_accurate_measurement(monkeypatch, noise, cost, E_bb):
    monkeypatch.setattr(unknown_lag, "MEASUREMENT_NOISE", noise)
    exact = unknown_lag.exact(10.0)
    assert exact.cost == pytest.approx(cost, abs=6e-8)
    assert exact.E_bb[-1] == pytest.approx(E_bb, abs=6e-8)
    if noise == 1e-6:
        assert exact.E_xx[-1] == pytest.approx(9.9900e-4, abs=6e-9)


def test_lag_small_weights_do_not_move():
    exact = unknown_lag.exact(0.045)
    assert exact.cost == pytest.approx(5 * 0.045, rel=1e-14)
    assert np.all(exact.u == 0)
    assert exact.E_bb[-1] == pytest.approx(5.0)


# --- free terminal time (6.6), chord (6.7) ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("w", "duration", "cost"), [(1.0, 2 - np.sqrt(2), 1.7238576251), (0.2, 0.9167378064, 1.1550272665)]
)
def test_free_time(w, duration, cost):
    exact = free_time_integrator.exact(w)
    assert exact.duration == pytest.approx(duration, abs=6e-11)
    assert exact.cost == pytest.approx(cost, abs=6e-11)
    assert exact.ell == pytest.approx(-np.sqrt(2 * (1 + w)))
    assert exact.x[-1] == pytest.approx(1.0)
    end = integrate(lambda t, z: [t + np.sqrt(2 * w), z[0], (t + np.sqrt(2 * w)) ** 2 / 2], np.zeros(3), exact.duration)
    np.testing.assert_allclose(end[:2], [1.0, exact.E[-1]], rtol=1e-11)
    assert end[1] + end[2] + w * exact.duration == pytest.approx(exact.cost, rel=1e-11)

    def fixed(T):
        """Least cost for a fixed T: u = t + c with x(T) = 1."""
        c = 1 / T - T / 2
        return T**3 / 6 + c * T**2 / 2 + ((T + c) ** 3 - c**3) / 6 + w * T

    assert fixed(exact.duration) == pytest.approx(exact.cost, rel=1e-14)
    assert fixed(exact.duration + 1e-3) > exact.cost < fixed(exact.duration - 1e-3)
    assert fixed(exact.duration + 1e-5) - fixed(exact.duration - 1e-5) == pytest.approx(0.0, abs=1e-13)


def test_chord():
    exact = chord_test.exact()
    assert exact.cost == pytest.approx(-1.788321888, abs=6e-10)
    np.testing.assert_allclose(exact.u + exact.u**3, 2 + exact.t, rtol=1e-14)

    def rate(t, z):
        u = chord_test.exact(t).u
        return [u, z[0], u**2 / 2 + u**4 / 4]

    end = integrate(rate, np.zeros(3), 1.0)
    np.testing.assert_allclose(end[:2], [exact.x[-1], exact.E[-1]], rtol=1e-11)
    assert end[1] - 3 * end[0] + end[2] == pytest.approx(exact.cost, rel=1e-11)
    middle = integrate(rate, np.zeros(3), exact.t[40])
    np.testing.assert_allclose(middle[:2], [exact.x[40], exact.E[40]], rtol=1e-11)


# --- problems without a covariance ------------------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [0.05, 1 / 9, 1 / 6, 0.2, 0.24, 0.25, 0.4])
def test_bryson_denham(limit):
    """Feasible, and u is concave with kinks only where x = l: sufficient, because the problem is convex."""
    t = np.linspace(0, 1, 2401)
    exact = bryson_denham.exact(limit, t)
    x, u = CubicSpline(t, exact.x), exact.u
    np.testing.assert_allclose(x(t, 1), exact.v, atol=2e-4 / limit)  # kinks of u cost the spline some accuracy
    np.testing.assert_allclose(np.diff(exact.v), (u[1:] + u[:-1]) / 2 * np.diff(t), atol=1e-3 * np.abs(u).max() * t[1])
    np.testing.assert_allclose([exact.x[0], exact.x[-1], exact.v[0], exact.v[-1]], [0, 0, 1, -1], atol=1e-14)
    assert exact.x.max() <= limit + 1e-14
    bend = np.diff(u, 2)
    assert np.all(bend <= 1e-12 * np.abs(u).max())
    kinks = np.flatnonzero(bend < -1e-9 * np.abs(u).max()) + 1
    assert np.all(limit - exact.x[kinks] < 1e-6)
    energy = np.sum((u[1:] ** 2 + u[1:] * u[:-1] + u[:-1] ** 2) / 6 * np.diff(t))  # exact between the kinks
    assert exact.cost == pytest.approx(energy, rel=1e-6)


def test_bryson_denham_published():
    assert bryson_denham.exact().cost == pytest.approx(4.0, rel=1e-14)


def test_brachistochrone():
    exact = brachistochrone.exact()
    assert exact.duration == pytest.approx(1.8016, abs=6e-5)
    slope = exact.theta[-1] / exact.duration

    def rate(t, z):
        angle = slope * t
        return [z[2] * np.sin(angle), z[2] * np.cos(angle), 9.80665 * np.cos(angle)]

    np.testing.assert_allclose(integrate(rate, np.zeros(3), exact.duration), [10.0, 5.0, exact.v[-1]], rtol=1e-10)
    np.testing.assert_allclose(integrate(rate, np.zeros(3), exact.t[40]), [h[40] for h in (exact.x, exact.y, exact.v)])
    np.testing.assert_allclose(exact.v[1:] / np.sin(exact.theta[1:]), exact.v[-1] / np.sin(exact.theta[-1]))
    np.testing.assert_allclose(exact.v**2, 2 * 9.80665 * exact.y, atol=1e-12)
    straight = np.sqrt(2 * (10.0**2 + 5.0**2) / (9.80665 * 5.0))
    assert exact.duration < straight


def test_goddard_rocket_by_its_three_arcs():
    """Full thrust up to the singular surface m/h^2 = (1 + v/c) D, along it until m = 0.6, coast until v = 0."""
    c, decay = 0.5, 500.0

    def drag(h, v):
        return 310 * v**2 * np.exp(-decay * (h - 1))

    def surface(t, z):
        h, v, m = z
        return (1 + v / c) * drag(h, v) - m / h**2

    def singular(h, v, m):
        """The thrust that stays on the surface: its time derivative is linear in the thrust."""
        D, g = drag(h, v), 1 / h**2
        by_v, by_h, by_m = D / c + (1 + v / c) * 2 * D / v, -decay * (1 + v / c) * D + 2 * m / h**3, -g
        return (by_v * (D / m + g) - by_h * v) / (by_v / m - by_m / c)

    def arc(start, thrust, until):
        def rate(t, z):
            h, v, m = z
            return [v, (thrust(h, v, m) - drag(h, v)) / m - 1 / h**2, -thrust(h, v, m) / c]

        until.terminal = True
        result = solve_ivp(rate, (start[0], start[0] + 1), start[1], events=until, **TIGHT)
        return result.t[-1], result.y[:, -1]

    full = arc((0.0, [1.0, 0.0, 1.0]), lambda h, v, m: 3.5, surface)
    sustained = arc(full, singular, lambda t, z: z[2] - 0.6)
    top = arc(sustained, lambda h, v, m: 0.0, lambda t, z: z[1])
    assert 0 < singular(*full[1]) < singular(*sustained[1]) < 3.5
    np.testing.assert_allclose([full[0], sustained[0], top[0]], [0.0235097, 0.0726707, 0.1988563], atol=6e-8)
    assert top[1][0] == pytest.approx(1.01283, abs=1e-5)  # published, five decimals
    assert top[1][0] == pytest.approx(1.0128369183, abs=6e-11)


# --- guesses and least energies ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("naming", "expected"),
    [
        ("table", [0.1256963, 0.5002708, 0.0482620, 0.1258844]),
        ("equations", [0.0899887, 0.2504635, 0.0990639, 0.1008523]),
    ],
)
def test_oscillator_of_least_energy(naming, expected):
    """Without weights: the control of the Gramian, and the covariance along it by the model's own rates."""
    statement = damped_oscillator.problem(0.0, 0.0, naming=naming).statement()
    stiffness, damping = (3.15, 2.51) if naming == "table" else (2.51, 3.15)
    A, B = np.array([[0.0, 1.0], [-stiffness, -damping]]), np.array([[0.0], [1.0]])
    T, target = 10.0, np.array([10.0, 0.0])
    Phi = expm(A * T)
    gramian = solve_sylvester(A, A.T, Phi @ B @ B.T @ Phi.T - B @ B.T)
    multiplier = np.linalg.solve(gramian, target)
    assert 0.5 * target @ multiplier == pytest.approx(790.65, abs=6e-7)

    def rate(t, z):
        u = (expm(A * (T - t)) @ B)[:, 0] @ multiplier
        x, e, running = statement.rates(z[:2], u, z[2:12], t, T, statement.values)
        return np.concatenate([x.full().ravel(), e.full().ravel(), running.full().ravel()])

    start = np.concatenate([np.zeros(2), statement.boundary_values(statement.values)[2], [0.0]])
    end = solve_ivp(rate, (0, T), start, rtol=1e-10, atol=1e-10, method="DOP853").y[:, -1]
    np.testing.assert_allclose(end[:2], target, atol=1e-7)
    assert end[-1] == pytest.approx(790.65, abs=1e-6)
    np.testing.assert_allclose(end[[2, 6, 9, 11]], expected, atol=1e-7)  # the diagonal of the half-vector


@pytest.mark.parametrize("masses", [1, 3])
def test_chain_of_least_energy(masses):
    """The guess moves the chain without cubic forces to its target, and no control of less energy does."""
    m, T = masses, 10.0 + 0.5 * (masses - 1)
    control = mass_chain.least_energy_control(m, T)
    D = np.eye(m) - np.eye(m, k=-1)
    A = np.block([[np.zeros((m, m)), np.eye(m)], [-2.0 * D.T @ D, -0.3 * D.T @ D]])
    B = np.eye(2 * m)[m]

    def rate(t, z):
        u = float(control(np.array(t / T)))
        return np.concatenate([A @ z[:-1] + B * u, [u**2]])

    end = solve_ivp(rate, (0, T), np.zeros(2 * m + 1), rtol=1e-10, atol=1e-10, method="DOP853").y[:, -1]
    np.testing.assert_allclose(end[[m - 1, 2 * m - 1]], [1.0, 0.0], atol=1e-8)
    # optimal: u(t) = B' exp(A'(T - t)) c, so int u^2 dt = c' (x(T)), and c has entries at the given final states only
    s = np.linspace(0, 1, 41)
    responses = np.array([(expm(A * T * (1 - f)) @ B)[[m - 1, 2 * m - 1]] for f in s])
    c, residual = np.linalg.lstsq(responses, control(s), rcond=None)[:2]
    assert residual[0] < 1e-20
    assert c[0] == pytest.approx(end[-1], rel=1e-8)
    assert control(s).shape == s.shape
