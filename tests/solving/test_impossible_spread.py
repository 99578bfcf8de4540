"""Limits of the covariance of the loop that no feedback can keep, told before a run looks for a gain."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co


def regulator(limit):
    """A spring with a bias and coloured noise; the variance of its place at the end is limited."""
    ocp = co.Problem(5.0, name="regulator")
    x, v = ocp.state("x", initial=1.0, variance=0.3), ocp.state("v", initial=0.0, variance=0.1)
    d, w = ocp.unknown("bias", mean=0.2, variance=0.5), ocp.state("w", initial=0.0, variance=0.2)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, -x + u + d + w, noise=0.02)
    ocp.dynamics(w, -w, noise=0.4)
    ocp.measurement("place", x, noise=0.01)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(running=u**2 + x**2, terminal_weight={x: 10.0, v: 1.0})
    ocp.subject_to(X[x, x], upper=limit, at="final", name="end")
    return ocp


def known():
    """The variance of the error of the filter at the end of `regulator`, by its Riccati equation."""
    F = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 1.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 0.0]])

    def rate(t, y):
        E = y.reshape(4, 4)
        return (F @ E + E @ F.T + np.diag([0.0, 0.02, 0.4, 0.0]) - np.outer(E[:, 0], E[0]) / 0.01).ravel()

    start = np.diag([0.3, 0.1, 0.2, 0.5]).ravel()
    return solve_ivp(rate, (0.0, 5.0), start, rtol=1e-10, atol=1e-12, method="LSODA").y[0, -1]


@pytest.mark.parametrize("share", [0.4, 0.999])
def test_a_limit_below_the_error_of_the_filter_is_refused_at_once(share):
    with pytest.raises(co.SolveError, match="no feedback takes X below E") as refused:
        co.solve(regulator(share * known()), intervals=20, progress=False)
    assert f"'end' is {known():.4g} at 5 s" in str(refused.value)
    assert refused.value.solution.converged
    assert float(refused.value.solution.covariance("x")[-1].item()) > known()


def slow(duration=10.0, variance=0.5, row=lambda X, x: X[x, x], **limits):
    """An integrator that is measured badly: what is known of it grows with the time."""
    ocp = co.Problem(duration, name="slow")
    start = ocp.decision("start", lower=0.05, upper=0.5, guess=0.3) if variance is None else variance
    x, u = ocp.state("x", initial=1.0, variance=start), ocp.control("u", lower=-5.0, upper=5.0)
    ocp.dynamics(x, u)
    ocp.measurement("place", x, noise=1.0)
    X = ocp.closed_loop_covariance()
    cost = ocp.duration if isinstance(duration, co.Free) else 0.0
    ocp.minimize_expected(running=u**2, terminal=x**2 + cost + (0.0 if variance is not None else 0.01 / start))
    ocp.subject_to(row(X, x), **limits, at="final", name="end")
    return ocp


def error(duration, variance):
    """The variance of the error of an integrator without noise, of density 1 measured."""
    return 1.0 / (1.0 / variance + duration)


def test_a_lower_limit_says_nothing_of_the_filter():
    """Feedback can let the place scatter more than it is known."""
    limit = 4.0 * error(10.0, 0.5)
    solution = co.solve(slow(lower=limit), intervals=20, progress=False)
    assert float(solution.covariance("x")[-1].item()) == pytest.approx(limit, rel=1e-6)


def test_a_free_duration_is_made_long_enough():
    ocp = slow(co.Free(1.0, 0.5, 20.0), upper=0.15)
    assert co.solve(ocp, intervals=20, progress=False).duration >= 1.0 / 0.15 - 1.0 / 0.5
    with pytest.raises(co.SolveError, match="no feedback takes X below E"):
        co.solve(slow(1.0, upper=0.15), intervals=20, progress=False)


def test_a_decision_says_how_much_is_known_at_the_start():
    solution = co.solve(slow(2.0, None, upper=0.15), intervals=20, progress=False)
    assert error(2.0, float(solution["start"].item())) <= 0.15 * (1 + 1e-6)


def test_what_falls_again_is_left_to_the_run():
    """sin(3 X) is above its limit for X = E, and below it for a larger X."""
    assert np.sin(3.0 * error(1.0, 0.9)) > 0.5 > np.sin(3.0 * 0.9)
    ocp = slow(1.0, 0.9, lambda X, x: ca.sin(3.0 * X[x, x]), upper=0.5)
    solution = co.solve(ocp, intervals=10, progress=False)
    assert np.sin(3.0 * float(solution.covariance("x")[-1].item())) <= 0.5 + 1e-6


def test_an_iterate_is_given_back_where_that_is_asked_for():
    found = co.solve(slow(1.0, upper=0.15), intervals=10, progress=False, allow_failure=True)
    assert not found.converged
    assert found.violations
