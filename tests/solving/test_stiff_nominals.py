"""Nominals that are faster somewhere than any step: taken by shorter steps, or told; against scipy's own steps."""

from __future__ import annotations

import re
import warnings

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co


def flame(start: float) -> co.Problem:
    """A ball of flame that grows slowly, ignites half way, and stays."""
    ocp = co.Problem(2 / start, name="flame")
    x, u = ocp.state("x", initial=start), ocp.control("u")
    ocp.dynamics(x, x**2 - x**3 + 1e-9 * u)
    ocp.minimize(running=(u**2 + (x - 1) ** 2) * start)
    return ocp


def test_an_ignition_that_default_steps_miss_is_run_by_shorter_ones():
    """It had been "the model becomes NaN or inf along this nominal"."""
    start = 1e-4

    def rates(_: float, y: np.ndarray) -> list[float]:
        return [y[0] ** 2 - y[0] ** 3, (y[0] - 1) ** 2 * start]

    truth = solve_ivp(rates, [0, 2 / start], [start, 0.0], method="Radau", rtol=1e-9, atol=1e-12).y[:, -1]
    solution = co.evaluate(flame(start), nominal={"u": 0.0})
    assert solution.converged
    assert solution.cost == pytest.approx(truth[1], rel=1e-4)
    assert solution["x"][-1] == pytest.approx(1.0, abs=1e-6)


def test_steps_that_are_too_long_are_not_called_a_fault_of_the_model():
    """Robertson's reaction, finite for ever, whose first fraction of a second no equal step resolves."""
    ocp = co.Problem(40.0, name="reaction")
    x, u = ocp.state("x", 3, initial=[1.0, 0.0, 0.0]), ocp.control("u")
    fast, slow, mixed = 3e7 * x[1] ** 2, 0.04 * x[0], 1e4 * x[1] * x[2]
    ocp.dynamics(x, ca.vertcat(mixed - slow, slow - mixed - fast, fast))
    ocp.minimize(running=u**2 + ca.sumsqr(x))
    solution = co.evaluate(ocp, nominal={"u": 0.0})
    assert not solution.converged
    assert "the integration steps are too long for the model, which stays finite" in solution.message


@pytest.mark.parametrize("speed", [1.0, 1e3])
def test_a_model_that_blows_up_is_told_with_its_time(speed):
    """x' = c x^2 from 1 is infinite at 1 / c."""
    ocp = co.Problem(2.0 / speed, name="blow")
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, speed * (x**2 + u))
    ocp.minimize(running=u**2 + x**2)
    solution = co.evaluate(ocp, nominal={"u": 0.0})
    assert not solution.converged
    assert f"the model becomes NaN or inf along this nominal, at t = {1 / speed:.4g} s" in solution.message


def test_what_would_take_too_long_to_know_is_not_blamed_on_the_model():
    """A free oscillation that becomes faster all the time is finite for ever; it has 8e6 periods here."""
    ocp = co.Problem(100.0, name="fast")
    x, s, u = ocp.state("x", 2, initial=[1.0, 0.0]), ocp.state("s", initial=0.0), ocp.control("u")
    ocp.dynamics(x, 1e4 * s * ca.vertcat(x[1], -x[0]))
    ocp.dynamics(s, 1 + u)
    ocp.minimize(running=u**2 + x[0] ** 2)
    solution = co.evaluate(ocp, nominal={"u": 0.0})
    assert not solution.converged
    assert "whether by the model or by steps that are too long is not known" in solution.message


def reaction(**changes):
    """Robertson's kinetics by states of their own."""
    ocp = co.Problem(40.0, name="reaction")
    a, b, c = ocp.state("a", initial=1.0), ocp.state("b", initial=0.0), ocp.state("c", initial=0.0)
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(a, -0.04 * a + 1e4 * b * c)
    ocp.dynamics(b, 0.04 * a - 1e4 * b * c - 3e7 * b**2)
    ocp.dynamics(c, 3e7 * b**2)
    ocp.minimize(running=u**2, terminal=(a - 1) ** 2)
    return co.evaluate(ocp, nominal={"u": 0.0}, **changes)


@pytest.mark.parametrize("intervals", [10, 40, 100])
def test_a_run_that_goes_astray_by_its_steps_does_not_count_as_evaluated(intervals):
    """Its states were numbers of 1e302, and it had been called evaluated, with a warning of rates without slopes."""

    def rates(_: float, y: np.ndarray) -> list[float]:
        a, b, c = y
        return [-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b**2, 3e7 * b**2]

    truth = solve_ivp(rates, [0, 40], [1.0, 0.0, 0.0], method="Radau", rtol=1e-9, atol=1e-14, dense_output=True).sol
    with warnings.catch_warnings():
        warnings.simplefilter("error", co.CovocpWarning)
        solution = reaction(intervals=intervals, step="rodas")
    assert not solution.converged
    assert solution.message.startswith("the integration steps are too long for the model, which stays finite")
    assert "take more intervals (grid= where it is fast) or substeps=" in solution.message
    found = re.search(r"at t = (\S+) s '(\w)' is (\S+) in place of (\S+)\)", solution.message)
    time, name, right = float(found[1]), "abc".index(found[2]), float(found[4])
    assert right == pytest.approx(truth(time)[name], rel=5e-3)
    assert abs(float(found[3])) > 1e3 * right


def swinging(speed: float, **changes):
    """Van der Pol's oscillator with an unknown speed, along a control that is linear between the nodes."""
    ocp = co.Problem(20.0, name="oscillator")
    x, v = ocp.state("x", initial=2.0, variance=0.01), ocp.state("v", initial=0.0, variance=0.01)
    mu, u = ocp.unknown("mu", mean=speed, variance=1.0), ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, mu * (1 - x**2) * v - x + u, noise=0.01)
    ocp.measurement("y", x, noise=1e-3)
    ocp.minimize(terminal=ca.log(ocp.estimation_covariance()[mu, mu]))
    s = np.linspace(0.0, 1.0, 11)
    nominal = 0.4 * np.sin(2 * np.pi * 1.3 * s)

    def rates(t: float, y: np.ndarray) -> list[float]:
        return [y[1], speed * (1 - y[0] ** 2) * y[1] - y[0] + np.interp(t / 20.0, s, nominal)]

    truth = solve_ivp(rates, [0, 20.0], [2.0, 0.0], method="Radau", rtol=1e-9, atol=1e-11, max_step=0.5).y[:, -1]
    return co.evaluate(ocp, nominal={"u": nominal}, intervals=10, **changes), truth


@pytest.mark.parametrize("speed", [2.0, 5.0])
def test_an_oscillation_whose_covariance_default_steps_lose_is_run_by_shorter_ones(speed):
    """With 10 intervals it had been "the model becomes NaN or inf along this nominal"."""
    solution, truth = swinging(speed)
    assert solution.converged
    assert solution.mesh_error < 1e-3
    np.testing.assert_allclose([solution["x"][-1], solution["v"][-1]], truth, atol=5e-3)


def test_given_steps_that_lose_an_oscillation_are_told():
    solution, _ = swinging(5.0, step="rodas", substeps=4)
    assert not solution.converged
    assert "the integration steps are too long for the model, which stays finite" in solution.message
    assert "take more intervals (grid= where it is fast) or substeps=" in solution.message


def test_a_state_that_grows_far_as_the_model_says_is_evaluated():
    """x' = 2 x for 20 s: exp(40), 2e17 times the start."""
    ocp = co.Problem(20.0, name="growth")
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, 2 * x + 0 * u)
    ocp.minimize(running=u**2, terminal=ca.log(x))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        solution = co.evaluate(ocp, nominal={"u": 0.0})
    assert solution.converged
    assert solution.cost == pytest.approx(40.0, rel=1e-4)


def test_a_cost_without_a_value_along_a_nominal_is_not_told_of_a_guess():
    ocp = co.Problem(1.0, name="below")
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=ca.log(x))
    with pytest.raises(co.ProblemError) as told:
        co.evaluate(ocp, nominal={"u": -2.0})
    assert "nan at the end of this nominal" in str(told.value)
    assert "guess" not in str(told.value)
    assert "final state [-1.]" in str(told.value)


def test_a_guess_that_the_steps_do_not_bear_is_told_without_a_state_that_is_not_meant():
    """The segments behind begin at the initial state, which had been called the final one."""
    ocp = co.Problem(40.0, name="reaction")
    x = ocp.state("x", 3, initial=[1.0, 0.0, 0.0], variance=np.diag([1e-4, 1e-10, 1e-4]))
    rate, u = ocp.unknown("rate", mean=0.04, variance=1e-4), ocp.control("u", lower=0.5, upper=1.5, guess=1.0)
    fast, slow, mixed = 3e7 * x[1] ** 2, rate * u * x[0], 1e4 * x[1] * x[2]
    ocp.dynamics(x, ca.vertcat(mixed - slow, slow - mixed - fast, fast), noise=np.diag([1e-6, 1e-12, 1e-6]))
    ocp.measurement("y", x[2], noise=1e-2)
    ocp.minimize(terminal=ca.log(ocp.estimation_covariance()[rate, rate]))
    with pytest.raises(co.CovocpError) as told:
        co.solve(ocp, intervals=40, progress=False)
    assert "integration steps are too long" in str(told.value)
    assert "final state" not in str(told.value)
