"""Nominals that are faster somewhere than any step: taken by shorter steps, or told; against scipy's own steps."""

from __future__ import annotations

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
