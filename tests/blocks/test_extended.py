"""The extended filter: linear models, Jacobians by hand, the continuous filter as the limit of the sampled one."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from compiled import compile_function
from linear_systems import GAMMA, NOISE, PHI, R_V, H, definite
from scipy.integrate import solve_ivp

from covocp import ProblemError
from covocp.blocks import kalman

Q = np.diag([0.0, 0.1])
R = 0.05
START = np.array([0.3, 0.1])
COVARIANCE = np.array([[0.2, 0.05], [0.05, 0.3]])


def pendulum(kind=ca.SX):
    """Continuous pendulum with a torque, and the height that is measured."""
    x, u = kind.sym("x", 2), kind.sym("u")
    f = ca.Function("f", [x, u], [ca.vertcat(x[1], -ca.sin(x[0]) + u)])
    return f, ca.Function("h", [x], [1 - ca.cos(x[0])])


def slopes(state, u):
    """Rates of estimate and covariance, written out; F by hand."""
    x, P = state[:2], state[2:].reshape(2, 2)
    F = np.array([[0.0, 1.0], [-np.cos(x[0]), 0.0]])
    return np.concatenate([[x[1], -np.sin(x[0]) + u], (F @ P + P @ F.T + Q).ravel()])


def test_linear_model_is_the_linear_filter():
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    f = ca.Function("f", [x, u], [ca.mtimes(ca.DM(PHI), x) + ca.DM(GAMMA) * u])
    h = ca.Function("h", [x], [x[0]])
    predict, update = kalman.extended(f, h, NOISE, R_V)
    for value, expected in zip(
        predict(START, COVARIANCE, 2.0),
        kalman.predict(START, COVARIANCE, PHI, NOISE, drift=2 * GAMMA.ravel()),
        strict=True,
    ):
        np.testing.assert_allclose(value.full().squeeze(), expected, rtol=1e-14)
    for value, expected in zip(
        update(START, COVARIANCE, 0.7), kalman.update(START, COVARIANCE, 0.7, H, R_V), strict=True
    ):
        np.testing.assert_allclose(value.full().squeeze(), expected, rtol=1e-13)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_slopes_are_taken_at_the_estimate(kind):
    f, h = pendulum(kind)
    predict, update = kalman.extended(f, h, Q, R)
    F = np.array([[0.0, 1.0], [-np.cos(START[0]), 0.0]])
    moved, spread = predict(START, COVARIANCE, 0.4)
    np.testing.assert_allclose(moved.full().ravel(), [START[1], -np.sin(START[0]) + 0.4], rtol=1e-14)
    np.testing.assert_allclose(spread, F @ COVARIANCE @ F.T + Q, rtol=1e-14)
    rows = np.array([[np.sin(START[0]), 0.0]])
    S = float((rows @ COVARIANCE @ rows.T).item()) + R
    L = COVARIANCE @ rows.T / S
    corrected, after = update(START, COVARIANCE, 0.2)
    np.testing.assert_allclose(corrected.full().ravel(), START + L.ravel() * (0.2 - 1 + np.cos(START[0])), rtol=1e-13)
    np.testing.assert_allclose(after, COVARIANCE - S * L @ L.T, rtol=1e-13)
    assert predict.expand().is_a("SXFunction")
    assert update.expand().is_a("SXFunction")


@pytest.mark.parametrize("form", ["joseph", "standard", "sequential", "information"])
def test_forms_agree(form):
    f, _ = pendulum()
    x = ca.SX.sym("x", 2)
    h = ca.Function("h", [x], [ca.vertcat(ca.sin(x[0]), x[0] * x[1])])
    noise = definite(np.random.default_rng(0), 2)
    expected = kalman.extended(f, h, Q, noise)[1](START, COVARIANCE, [0.2, 0.1])
    result = kalman.extended(f, h, Q, noise, form=form)[1](START, COVARIANCE, [0.2, 0.1])
    for one, two in zip(result, expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-11)


def test_sampled_prediction_has_order_four():
    f, h = pendulum()
    exact = solve_ivp(
        lambda _, z: slopes(z, 0.2), (0.0, 0.8), np.concatenate([START, COVARIANCE.ravel()]), rtol=1e-12, atol=1e-14
    ).y[:, -1]
    errors = []
    for substeps in (2, 4, 8):
        predict, _ = kalman.extended(f, h, Q, R, step=0.8, substeps=substeps)
        x, P = predict(START, COVARIANCE, 0.2)
        errors.append(np.abs(np.concatenate([x.full().ravel(), P.full().ravel()]) - exact).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 3.7)
    assert errors[-1] < 1e-7


def test_sampled_prediction_stays_semidefinite_at_any_step():
    """A stable, stiff system over steps that Runge-Kutta cannot follow."""
    x = ca.SX.sym("x", 2)
    f = ca.Function("f", [x], [ca.vertcat(-x[0] + x[1], -50 * x[1] - x[0] ** 3)])
    for step in (0.01, 0.1, 0.5):
        predict, _ = kalman.extended(f, ca.Function("h", [x], [x[0]]), np.diag([0.0, 1.0]), 1.0, step=step)
        P = predict(START, COVARIANCE)[1].full()
        assert np.linalg.eigvalsh(P)[0] >= -1e-14 * np.abs(P).max()


def test_continuous_filter_of_a_linear_model():
    """dP/dt as printed, and dx/dt = f + P H' U^-1 (y - h)."""
    f, h = pendulum()
    rate = kalman.extended_rate(f, h, Q, R)
    dx, dP = rate.expand()(START, COVARIANCE, 0.2, 0.4)
    rows = np.array([[np.sin(START[0]), 0.0]])
    gain = COVARIANCE @ rows.T / R
    expected = slopes(np.concatenate([START, COVARIANCE.ravel()]), 0.4)
    residual = 0.2 - 1 + np.cos(START[0])
    np.testing.assert_allclose(dx.full().ravel(), expected[:2] + gain.ravel() * residual, rtol=1e-13)
    np.testing.assert_allclose(dP, expected[2:].reshape(2, 2) - R * gain @ gain.T, rtol=1e-13, atol=1e-15)


def test_continuous_filter_is_the_limit_of_frequent_readings():
    f, h = pendulum()
    reading, end = 0.15, 0.5
    rate = kalman.extended_rate(f, h, Q, R)

    def slope(_, z):
        dx, dP = rate(z[:2], z[2:].reshape(2, 2), reading, 0.2)
        return np.concatenate([dx.full().ravel(), dP.full().ravel()])

    exact = solve_ivp(slope, (0.0, end), np.concatenate([START, COVARIANCE.ravel()]), rtol=1e-10, atol=1e-12).y[:, -1]
    errors = []
    for count in (50, 100):
        predict, update = kalman.extended(f, h, Q, R * count / end, step=end / count)
        x, P = ca.DM(START), ca.DM(COVARIANCE)
        for _ in range(count):
            x, P = update(*predict(x, P, 0.2), reading)
        errors.append(np.abs(np.concatenate([x.full().ravel(), P.full().ravel()]) - exact).max())
    assert errors[1] < 2e-3
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.2)  # readings at the ends of steps: order one


def test_noise_that_depends_on_the_state():
    f, h = pendulum()
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    noise = ca.Function("noise", [x, u], [ca.diag(ca.vertcat(0, x[0] ** 2 + u**2))])
    variance = ca.Function("R", [x], [1 + x[1] ** 2])
    predict, update = kalman.extended(f, h, noise, variance)
    constant = kalman.extended(f, h, np.diag([0.0, START[0] ** 2 + 0.16]), 1 + START[1] ** 2)
    np.testing.assert_allclose(predict(START, COVARIANCE, 0.4)[1], constant[0](START, COVARIANCE, 0.4)[1], rtol=1e-14)
    np.testing.assert_allclose(update(START, COVARIANCE, 0.4)[1], constant[1](START, COVARIANCE, 0.4)[1], rtol=1e-14)


def test_model_with_a_table():
    """A table has no SX form: the filter works as an MX function."""
    x = ca.MX.sym("x")
    table = ca.interpolant("table", "bspline", [np.linspace(-2, 2, 9)], np.linspace(-2, 2, 9) ** 2)
    f = ca.Function("f", [x], [0.5 * x])
    predict, update = kalman.extended(f, ca.Function("h", [x], [table(x)]), 0.1, 0.2)
    corrected, after = update(1.0, 0.5, 1.3)
    gain = 0.5 * 2.0 / (0.5 * 4.0 + 0.2)
    assert float(corrected) == pytest.approx(1.0 + gain * 0.3)
    assert float(after) == pytest.approx(0.5 - gain * 2.0 * 0.5)
    assert float(predict(1.0, 0.5)[1]) == pytest.approx(0.25 * 0.5 + 0.1)


def test_missing_readings():
    f, h = pendulum()
    _, update = kalman.extended(f, h, Q, R, missing="skip")
    x, P = update(START, COVARIANCE, np.nan)
    np.testing.assert_array_equal(x.full().ravel(), START)
    np.testing.assert_allclose(P, COVARIANCE, rtol=1e-15)
    np.testing.assert_allclose(
        update(START, COVARIANCE, 0.1)[0], kalman.extended(f, h, Q, R)[1](START, COVARIANCE, 0.1)[0]
    )


@pytest.mark.needs_cc
def test_c_code(tmp_path):
    f, h = pendulum()
    predict, update = kalman.extended(f, h, Q, R, step=0.1, missing="skip")
    arguments = {"predict": (START, COVARIANCE, 0.4), "update": (START, COVARIANCE, 0.2)}
    for function in (predict, update):
        code = compile_function(function, tmp_path)
        given = arguments[function.name()]
        for value, expected in zip(code(*given), function(*given), strict=True):
            np.testing.assert_allclose(value, expected, rtol=1e-12)
    np.testing.assert_array_equal(code(START, COVARIANCE, np.nan)[0].ravel(), START)


def test_bad_models():
    f, h = pendulum()
    x = ca.SX.sym("x", 3)
    for arguments, message in (
        ((lambda x: x, h, Q, R), "'f'(?s:.)*casadi.Function"),
        ((h, h, Q, R), r"'f'(?s:.)*2 x 1"),
        ((f, f, Q, R), "'h'"),
        ((f, ca.Function("h", [x], [x[0]]), Q, R), "'h'(?s:.)*2 states"),
        ((f, h, np.eye(3), R), "'noise'"),
        ((f, h, -Q, R), "'noise'(?s:.)*semidefinite"),
        ((f, h, Q, np.eye(2)), "'R'"),
        ((f, h, ca.SX.sym("q", 2, 2), R), "'noise'(?s:.)*casadi.Function"),
        ((f, h, ca.Function("q", [x], [x]), R), "'noise'"),
    ):
        with pytest.raises(ProblemError, match=message):
            kalman.extended(*arguments)
    with pytest.raises(ProblemError, match=r"'R'(?s:.)*definite"):
        kalman.extended_rate(f, h, Q, 0.0)
    with pytest.raises(ProblemError, match="step is not positive"):
        kalman.extended(f, h, Q, R, step=-1.0)
    with pytest.raises(ProblemError, match="'form'"):
        kalman.extended(f, h, Q, R, form="best")
