"""The extended filter of a problem: the same covariance as the optimal control problem has along its nominal."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.models import unknown_lag
from covocp.problem.filters import extended_filter, initial_estimate


def lag(form="minimize"):
    """dx = -b x + u + n with b unknown; two correlated measurements, one of them of the control too."""
    ocp = co.Problem(2.0)
    density = ocp.parameter("density", 0.3)
    x = ocp.state("x", initial=0.5, variance=0.2)
    b = ocp.unknown("b", mean=1.5, variance=0.7)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=density * (1 + x**2))
    ocp.measurement("y", ca.vertcat(x, x * b + u), noise=np.array([[1.0, 0.2], [0.2, 2.0]]))
    E = ocp.estimation_covariance()
    if form == "minimize":
        ocp.minimize(running=u**2, terminal=E[b, b])
    else:
        ocp.minimize_expected(running=u**2, terminal_weight={x: 2.0})
    return ocp


@pytest.mark.parametrize("cost", ["minimize", "minimize_expected"])
def test_rates_by_hand(cost):
    rate = extended_filter(lag(cost)).expand()
    x, b, u = 0.4, 1.2, 0.3
    P, y = np.array([[0.5, 0.1], [0.1, 0.6]]), np.array([0.7, 0.2])
    F = np.array([[-b, -x], [0.0, 0.0]])
    H = np.array([[1.0, 0.0], [b, x]])
    U = np.array([[1.0, 0.2], [0.2, 2.0]])
    gain = P @ H.T @ np.linalg.inv(U)
    dx, dP = rate([x, b], P, u, y, 0.0)
    np.testing.assert_allclose(dx.full().ravel(), [-b * x + u, 0.0] + gain @ (y - [x, x * b + u]), rtol=1e-13)
    Q = np.diag([0.3 * (1 + x**2), 0.0])
    np.testing.assert_allclose(dP, F @ P + P @ F.T + Q - gain @ U @ gain.T, rtol=1e-12)


def test_start():
    estimate, covariance = initial_estimate(lag())
    np.testing.assert_array_equal(estimate, [0.5, 1.5])
    np.testing.assert_array_equal(covariance, np.diag([0.2, 0.7]))
    ocp = co.Problem(1.0)
    variance = ocp.parameter("variance", 4.0)
    x = ocp.state("x", initial=1.0, variance=variance)
    ocp.dynamics(x, ocp.control("u"))
    ocp.minimize(running=x**2)
    np.testing.assert_array_equal(initial_estimate(ocp)[1], [[4.0]])


def test_filter_along_the_nominal_is_the_covariance_of_the_problem():
    """Readings as predicted leave the estimate on the nominal, and P is the E of the optimal control problem."""
    problem = unknown_lag.problem(final=1.0)
    solution = co.solve(problem, intervals=200, progress=False)
    rate = extended_filter(problem)
    estimate, covariance = initial_estimate(problem)

    def slope(t, z):
        u = np.interp(t, solution.t, solution["u"])
        dx, dP = rate(z[:2], z[2:].reshape(2, 2), u, z[0], t)
        return np.concatenate([dx.full().ravel(), dP.full().ravel()])

    end = np.concatenate([estimate, covariance.ravel()])
    for a, b in zip(solution.t[:-1], solution.t[1:], strict=True):  # u is linear between the nodes only
        end = solve_ivp(slope, (a, b), end, rtol=1e-8, atol=1e-10).y[:, -1]
    np.testing.assert_allclose(end[0], 1.0, atol=1e-6)
    np.testing.assert_allclose(end[2:].reshape(2, 2), solution["E"][-1], rtol=1e-5)


def test_discrete_filter_converges_to_the_continuous_one():
    problem = lag()
    rate = extended_filter(problem)
    estimate, covariance = initial_estimate(problem)
    reading, u = np.array([0.6, 1.0]), 0.4

    def slope(t, z):
        dx, dP = rate(z[:2], z[2:].reshape(2, 2), u, reading, t)
        return np.concatenate([dx.full().ravel(), dP.full().ravel()])

    exact = solve_ivp(slope, (0.0, 1.0), np.concatenate([estimate, covariance.ravel()]), rtol=1e-10, atol=1e-12).y[
        :, -1
    ]
    errors = []
    for count in (50, 100):
        predict, update = extended_filter(problem, step=1.0 / count, form="sequential")
        x, P = ca.DM(estimate), ca.DM(covariance)
        for k in range(count):
            x, P = predict(x, P, u, k / count)
            x, P = update(x, P, reading, u, (k + 1) / count)
        errors.append(np.abs(np.concatenate([x.full().ravel(), P.full().ravel()]) - exact).max())
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.2)
    assert errors[1] < 5e-3
    assert update.expand().is_a("SXFunction")


def test_problem_without_measurement_or_covariance():
    ocp = co.Problem(co.Free(2.0))
    x = ocp.state("x", initial=0.0, variance=0.1)
    u = ocp.control("u")
    ocp.dynamics(x, u * ocp.time / ocp.duration, noise=0.3)
    ocp.minimize(running=u**2, terminal=ocp.duration)
    dx, dP = extended_filter(ocp, duration=4.0)(1.0, 0.5, 2.0, [], 3.0)
    assert (float(dx), float(dP)) == pytest.approx((2.0 * 3.0 / 4.0, 0.3))
    predict, update = extended_filter(ocp, step=0.1)
    assert float(predict(1.0, 0.5, 2.0, 3.0)[1]) == pytest.approx(0.53)
    assert float(update(1.0, 0.5, [], 2.0, 3.0)[1]) == 0.5


def test_missing_readings():
    _, update = extended_filter(lag(), step=0.1, missing="skip")
    x, P = update([0.5, 1.5], np.eye(2), [np.nan, np.nan], 0.0, 0.0)
    np.testing.assert_array_equal(x.full().ravel(), [0.5, 1.5])
    np.testing.assert_allclose(P, np.eye(2), atol=1e-15)


def test_what_has_no_filter():
    with pytest.raises(co.ProblemError, match="not a problem"):
        extended_filter("problem")
    ocp = co.Problem(1.0)
    x = ocp.state("x", initial=0.0, variance=0.1)
    E = ocp.estimation_covariance()
    ocp.dynamics(x, ocp.control("u") + E[x, x])
    ocp.minimize(terminal=x**2)
    with pytest.raises(co.ProblemError, match="depend on matrices"):
        extended_filter(ocp)
    with pytest.raises(co.ProblemError, match="step is not positive"):
        extended_filter(lag(), step=0.0)


def test_a_mean_is_compared_with_the_mean():
    """dx = u + n, exactly: x moves by u h, its mean is half of that behind; their covariances by integrals of h - s."""
    p, Q, U, h, u, reading = 0.5, 0.3, 0.02, 0.4, 2.0, 1.7
    ocp = co.Problem(1.0)
    x, control = ocp.state("x", initial=1.0, variance=p), ocp.control("u")
    ocp.dynamics(x, control, noise=Q)
    ocp.measurement("m", x, noise=U)
    ocp.minimize(running=control**2)
    predict, update = extended_filter(ocp, step=h, reading="mean")
    x, P = update(*predict(1.0, p, u, 0.0), reading, u, h)
    own, across, mean = p + Q * h, p + Q * h / 2, p + Q * h / 3 + U / h
    assert float(x) == pytest.approx(1.0 + u * h + across / mean * (reading - 1.0 - u * h / 2), rel=1e-12)
    assert float(P) == pytest.approx(own - across**2 / mean, rel=1e-12)
    _, update = extended_filter(ocp, step=h)
    x, _ = update(1.0 + u * h, own, reading, u, h)
    assert float(x) == pytest.approx(1.0 + u * h + own / (own + U / h) * (reading - 1.0 - u * h), rel=1e-12)


@pytest.mark.parametrize("form", ["joseph", "standard", "sequential", "information"])
def test_means_of_a_motion_as_predicted_leave_the_estimate_on_it(form):
    """The means along the nominal itself, by quadrature: what is expected at the end is half a step ahead of them."""
    problem, u, h = lag(), 0.8, 0.1
    start, covariance = initial_estimate(problem)
    end, decay = u / start[1], np.exp(-start[1] * h)
    moved = end + (start[0] - end) * decay
    mean = end + (start[0] - end) * (1 - decay) / (start[1] * h)
    predict, update = extended_filter(problem, step=h, substeps=4, reading="mean", form=form)
    x, P = update(*predict(start, covariance, u, 0.0), [mean, start[1] * mean + u], u, h)
    np.testing.assert_allclose(x.full().ravel(), [moved, start[1]], atol=1e-7)
    assert (np.linalg.eigvalsh(P.full()) > 0).all()


def test_what_a_reading_is_fits():
    for given in ({"reading": "mean"}, {"step": 0.1, "reading": "middle"}):
        with pytest.raises(co.ProblemError, match="reading"):
            extended_filter(lag(), **given)
