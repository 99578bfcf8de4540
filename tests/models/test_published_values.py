"""Every converged value of the tables, by the solver, from the default guess of each model."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co
from covocp.models import (
    brachistochrone,
    bryson_denham,
    chord_test,
    damped_oscillator,
    free_time_integrator,
    goddard_rocket,
    mass_chain,
    noisy_integrator,
    unknown_gain,
    unknown_lag,
)

COST = 1e-6  # relative, at 200 intervals
ENTRY = 1e-4  # of covariances and multipliers


def solve(problem, **options):
    return co.solve(problem, **{"intervals": 200, "progress": False, **options})


def last(values):
    return float(np.ravel(values[-1])[0])


def energy(solution):
    """Integral of u^2/2 for a control that is linear on each interval."""
    u = np.ravel(solution["u"])
    return float(np.sum((u[1:] ** 2 + u[1:] * u[:-1] + u[:-1] ** 2) / 6 * np.diff(solution.t)))


# --- 3.4 --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("alpha", "beta", "cost", "E", "ell"),
    [
        (0.0, 0.0, 1 / 2, 1 / 2, -1.0),
        (0.0, 1.0, 59 / 90, 1 / 3 + 1 / 6 - 1 / 24, -7 / 6),
        (1.0, 0.0, 23 / 24, 5 / 12, -3 / 2),
    ],
)
def test_noisy_integrator(alpha, beta, cost, E, ell):
    solution = solve(noisy_integrator.problem(alpha, beta))
    assert solution.cost == pytest.approx(cost, rel=COST)
    assert last(solution["E"]) == pytest.approx(E, rel=ENTRY)
    assert last(solution.costate("x")) == pytest.approx(ell, rel=ENTRY)
    np.testing.assert_allclose(np.ravel(solution["u"]), noisy_integrator.exact(alpha, beta, solution.t).u, atol=1e-3)
    np.testing.assert_allclose(np.ravel(solution.costate("E")), alpha + beta * (1 - solution.t), atol=ENTRY)


@pytest.mark.parametrize(("alpha", "beta"), [(4.0, 0.0), (0.0, 8.0), (3.0, 9.0)])
def test_noisy_integrator_rests_first(alpha, beta):
    solution = solve(noisy_integrator.problem(alpha, beta))
    exact = noisy_integrator.exact(alpha, beta, solution.t)
    assert exact.arc > 0
    assert solution.cost == pytest.approx(exact.cost, rel=COST)
    assert last(solution["E"]) == pytest.approx(exact.E[-1], rel=1e-3)
    np.testing.assert_allclose(np.ravel(solution["x"]), exact.x, atol=1e-3)


# --- 3.5 --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("data", [{}, {"gain": -2.0, "gain_variance": 0.3, "final": 3.0, "duration": 2.5}])
def test_unknown_gain(data):
    problem, exact = unknown_gain.problem(**data), unknown_gain.exact(**data)
    solution = solve(problem)
    assert solution.cost == pytest.approx(exact.cost, rel=COST)
    np.testing.assert_allclose(np.ravel(solution["u"]), exact.u[0], rtol=1e-3)
    assert last(solution.covariance("x")) == pytest.approx(exact.E_xx[-1], rel=ENTRY)
    assert last(solution.covariance("x", "b")) == pytest.approx(exact.E_xb[-1], rel=ENTRY)
    assert last(solution.covariance("b")) == pytest.approx(exact.E_bb[-1], rel=ENTRY)
    np.testing.assert_allclose(np.ravel(solution.costate("x")), exact.ell, rtol=ENTRY)


# --- 5.2 and 5.3 ------------------------------------------------------------------------------------------------------

LAG = [
    (0.0, 0.1, 0.44818922, 0.10914073, 0.4171458, -0.0997076, 3.3904849, 0.0616565, -0.00289492),
    (0.0, 1.0, 1.91442319, 0.84225771, 0.4213693, -0.0875906, 1.0721655, 0.1712804, -0.02234059),
    (0.0, 10.0, 6.55106209, 3.16057716, 0.4227049, -0.0536560, 0.3390485, 0.3317939, -0.08383322),
    (1.0, 0.1, 1.30521661, 1.04249222, 0.9885108, -1.2283399, 2.6272440, -1.8356321, -0.00002238),
    (1.0, 1.0, 2.62300222, 1.61420983, 0.7255171, -0.5603933, 1.0087924, -1.6178997, -0.00494070),
    (1.0, 10.0, 7.08523968, 3.78785027, 0.5525941, -0.2136105, 0.3297389, -1.4158328, -0.04275282),
]


def lag_hamiltonian(solution, weight):
    """H at the end, where P = diag(0, weight)."""
    x, u, p = (last(values) for values in (solution["x"], solution["u"], solution.costate("x")))
    return u**2 / 2 + p * (-x + u) - weight * last(solution.covariance("x", "b")) ** 2


@pytest.mark.parametrize(("final", "weight", "cost", "control", "E11", "E12", "E22", "ell", "H"), LAG)
def test_unknown_lag(final, weight, cost, control, E11, E12, E22, ell, H):
    solution = solve(unknown_lag.problem(weight, final))
    sign = 1.0 if final else np.sign(last(solution.costate("x")))  # in 5.2, (x, u, E12) may change sign together
    assert solution.cost == pytest.approx(cost, rel=COST)
    assert energy(solution) == pytest.approx(control, rel=ENTRY)
    assert last(solution.covariance("x")) == pytest.approx(E11, rel=ENTRY)
    assert sign * last(solution.covariance("x", "b")) == pytest.approx(E12, rel=ENTRY)
    assert last(solution.covariance("b")) == pytest.approx(E22, rel=ENTRY)
    assert sign * last(solution.costate("x")) == pytest.approx(ell, rel=ENTRY)
    assert lag_hamiltonian(solution, weight) == pytest.approx(H, abs=ENTRY)


def test_unknown_lag_trajectory():
    solution = solve(unknown_lag.problem())
    exact = unknown_lag.exact(t=solution.t)
    sign = np.sign(last(solution.costate("x")))
    for name in ("x", "u"):
        np.testing.assert_allclose(sign * np.ravel(solution[name]), getattr(exact, name), atol=1e-3)
    np.testing.assert_allclose(np.ravel(solution.covariance("b")), exact.E_bb, rtol=1e-3)


def test_unknown_lag_second_minimum():
    solution = solve(unknown_lag.problem(10.0, 1.0), guess={"u": lambda s: -np.sin(np.pi * s)})
    assert solution.cost == pytest.approx(7.71199239, rel=COST)
    assert energy(solution) == pytest.approx(4.22580786, rel=ENTRY)
    assert last(solution.covariance("b")) == pytest.approx(0.34861845, rel=ENTRY)
    assert last(solution.covariance("x")) == pytest.approx(0.46377416, rel=ENTRY)


def test_unknown_lag_second_minimum_ends():
    """It exists above C22 = 1.537619, the least C22 = s/E_bb(T)^2 along (I - 2 s G) u = -ell R with x(T) = 1."""
    second = solve(unknown_lag.problem(1.6, 1.0), guess={"u": lambda s: -np.sin(np.pi * s)})
    assert second.cost == pytest.approx(3.48601114, rel=COST)
    assert second.optimality.curvature > 0
    above = solve(unknown_lag.problem(1.55, 1.0), guess=second)
    below = solve(unknown_lag.problem(1.5, 1.0), guess=second)
    assert above.cost > solve(unknown_lag.problem(1.55, 1.0)).cost + 0.3
    assert below.cost == pytest.approx(solve(unknown_lag.problem(1.5, 1.0)).cost, rel=COST)


def test_unknown_lag_weights_without_rebuilding():
    """The weight is a parameter of the built problem."""
    problem = unknown_lag.problem(weight=10.0, final=1.0)
    for _, weight, cost, *_ in LAG[3:]:
        solution = co.solve(problem, intervals=200, progress=False, parameters={"weight": weight})
        assert solution.cost == pytest.approx(cost, rel=COST)


@pytest.mark.parametrize(("noise", "cost", "E22"), [(1e-3, 4.5802190, 0.2345105), (1e-6, 4.5777677, 0.2343819)])
def test_unknown_lag_accurate_measurement(monkeypatch, noise, cost, E22):
    """The covariance equation is stiff: h E/U is up to 5e4."""
    monkeypatch.setattr(unknown_lag, "MEASUREMENT_NOISE", noise)
    solution = solve(unknown_lag.problem(10.0, 0.0), covariance_step="gauss")
    assert solution.cost == pytest.approx(cost, rel=COST)
    assert last(solution.covariance("b")) == pytest.approx(E22, rel=ENTRY)
    if noise == 1e-6:
        assert last(solution.covariance("x")) == pytest.approx(9.9900e-4, rel=ENTRY)


def test_unknown_lag_without_weight():
    assert solve(unknown_lag.problem(0.0, 1.0)).cost == pytest.approx(1 / (1 - np.exp(-20)), rel=COST)


def test_unknown_lag_free_duration():
    """H = dJ*/dT for fixed T, so the weight -H of the table makes T = 10 s stationary."""
    solution = solve(unknown_lag.problem(10.0, 1.0, duration=8.0, duration_weight=0.04275282))
    assert solution.t[-1] == pytest.approx(10.0, rel=1e-3)
    assert solution.cost == pytest.approx(7.08523968 + 0.4275282, rel=COST)


# --- 5.4 --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("naming", "C33", "C44", "cost", "control", "E11", "E22", "E33", "E44"),
    [
        ("table", 0.0, 0.0, 790.650000, 790.650000, 0.1256963, 0.5002708, 0.0482620, 0.1258844),
        ("table", 1000.0, 0.0, 824.793839, 798.205325, 0.1204984, 0.4155369, 0.0265885, 0.0873026),
        ("table", 0.0, 1000.0, 863.839329, 816.064615, 0.0941239, 0.2135334, 0.0220242, 0.0477747),
        ("equations", 0.0, 0.0, 790.650000, 790.650000, 0.0899887, 0.2504635, 0.0990639, 0.1008523),
        ("equations", 1000.0, 0.0, 847.415448, 812.428816, 0.0690707, 0.0901272, 0.0349866, 0.0416234),
        ("equations", 0.0, 1000.0, 844.788719, 809.421708, 0.0852168, 0.1573384, 0.0493841, 0.0353670),
    ],
)
def test_damped_oscillator(naming, C33, C44, cost, control, E11, E22, E33, E44):
    check_oscillator(solve(damped_oscillator.problem(C33, C44, naming=naming)), cost, control, E11, E22, E33, E44)


def test_damped_oscillator_second_minimum():
    problem = damped_oscillator.problem(1000.0, 0.0, naming="equations")
    solution = solve(problem, guess={"u": lambda s: 20 * np.sin(np.pi * s)})
    check_oscillator(solution, 847.855502, 813.450947, 0.0659783, 0.0797048, 0.0344046, 0.0592464)


def check_oscillator(solution, cost, control, *variances):
    assert solution.cost == pytest.approx(cost, rel=2e-6)
    assert energy(solution) == pytest.approx(control, rel=ENTRY)
    found = [last(solution.covariance(name)) for name in ("y", "rate", "a", "b")]
    np.testing.assert_allclose(found, variances, rtol=ENTRY)


# --- 6.6, 6.7, 6.8 ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("w", "duration", "cost"), [(1.0, 2 - np.sqrt(2), 1.7238576251), (0.2, 0.9167378064, 1.1550272665)]
)
def test_free_time(w, duration, cost):
    solution = solve(free_time_integrator.problem(w))
    assert solution.cost == pytest.approx(cost, rel=COST)
    assert solution.t[-1] == pytest.approx(duration, rel=ENTRY)
    assert last(solution.costate("x")) == pytest.approx(-np.sqrt(2 * (1 + w)), rel=ENTRY)
    np.testing.assert_allclose(np.ravel(solution["u"]), solution.t + np.sqrt(2 * w), atol=1e-3)


def test_chord():
    solution = solve(chord_test.problem())
    exact = chord_test.exact(solution.t)
    assert solution.cost == pytest.approx(-1.788321888, rel=COST)
    np.testing.assert_allclose(np.ravel(solution.costate("x")), exact.p, atol=ENTRY)
    np.testing.assert_allclose(np.ravel(solution["u"]), exact.u, atol=1e-3)


@pytest.mark.filterwarnings("ignore:The mesh is too coarse", "ignore:The integration steps are long")  # as tabulated
@pytest.mark.parametrize(
    ("masses", "rk4", "gauss"),
    [
        (1, 1.0196361700, 1.0199952551),
        (3, 1.8376564176, 1.8375579980),
        (5, 2.2222978530, 2.2234033128),
        (9, 3.3181037202, 3.3191543556),
        (14, None, 3.8129993516),
    ],
)
def test_mass_chain(masses, rk4, gauss):
    """To ten digits, because the discretisation is that of the table."""
    for step, cost in (("rk4", rk4), ("gauss", gauss)):
        if cost is not None:
            problem = mass_chain.problem(masses)
            solution = solve(problem, intervals=50, control="constant", substeps=1, covariance_step=step)
            assert solution.cost == pytest.approx(cost, rel=1e-8)


# --- problems without a covariance ------------------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [1 / 9, 0.2, 0.3])
def test_bryson_denham(limit):
    solution = solve(bryson_denham.problem(limit))
    exact = bryson_denham.exact(limit, solution.t)
    assert solution.cost == pytest.approx(exact.cost, rel=ENTRY)
    np.testing.assert_allclose(np.ravel(solution["x"]), exact.x, atol=ENTRY)


def test_brachistochrone():
    solution = solve(brachistochrone.problem())
    exact = brachistochrone.exact(solution.t / solution.t[-1])
    assert solution.cost == pytest.approx(exact.duration, rel=COST)
    np.testing.assert_allclose(np.ravel(solution["y"]), exact.y, atol=1e-3)


def test_goddard_rocket():
    solution = solve(goddard_rocket.problem())
    assert solution.cost == pytest.approx(-1.0128369183, abs=1e-5)
    assert solution.t[-1] == pytest.approx(0.1988563, rel=1e-3)
