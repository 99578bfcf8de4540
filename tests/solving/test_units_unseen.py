"""Starts that are zero but for roundoff and targets that are far away: no units in which the cost does not change."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co

METHODS = ("auto", "ipopt", "reduced", "gradient")
T, WEIGHT = 2.0, 100.0


def double_integrator(target: float, speed: float) -> co.Problem:
    ocp = co.Problem(T)
    x, v, u = ocp.state("x", initial=0.0), ocp.state("v", initial=speed), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=u**2, terminal=WEIGHT * ((x - target) ** 2 + v**2))
    return ocp


def least_cost(target: float, speed: float) -> float:
    """The energy that leads anywhere by the Gramian, and what being there costs; the best control is linear in time."""
    gramian = np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
    missed = np.array([target - T * speed, -speed])
    return float(missed @ np.linalg.solve(gramian + np.eye(2) / WEIGHT, missed))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("speed", [np.sin(np.pi), 1e-12, 1e-9])
def test_a_start_of_roundoff_is_no_magnitude(method, speed):
    solution = co.solve(double_integrator(1.0, speed), method=method, progress=False)
    assert solution.cost == pytest.approx(least_cost(1.0, speed), rel=1e-6)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("speed", [0.0, 1.0])
@pytest.mark.parametrize("target", [1e9, 1e12])
def test_a_target_far_away_is_gone_to(method, speed, target):
    solution = co.solve(double_integrator(target, speed), method=method, progress=False)
    assert solution.cost == pytest.approx(least_cost(target, speed), rel=1e-6)


def forced(rate: float, start: float = 0.0) -> co.Problem:
    ocp = co.Problem(10.0)
    x, u = ocp.state("x", initial=start), ocp.control("u")
    ocp.dynamics(x, u - 0.1 * x + rate)
    ocp.minimize(running=u**2 + 0.1 * (x - 1) ** 2)
    return ocp


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("rate", [1e-12, 1e-16, 1e-30])
def test_a_forcing_of_roundoff_is_no_magnitude(method, rate):
    rest = co.solve(forced(0.0), intervals=50, progress=False)
    solution = co.solve(forced(rate), method=method, intervals=50, progress=False)
    assert solution.cost == pytest.approx(rest.cost, rel=1e-6)


@pytest.mark.parametrize("offset", [1e7, 1e12])
def test_a_large_constant_in_the_cost_moves_no_start(offset):
    """The size of what a cost asks for is that of its changes, whatever is added to it."""
    ocp = co.Problem(T)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, u - x)
    ocp.minimize(running=u**2 + x**2 + offset)
    with np.errstate(all="raise"):
        solution = co.solve(ocp, progress=False)
    assert np.abs(solution["u"]).max() <= 1.0  # where it starts, or less
    assert solution.cost == pytest.approx(offset * T, rel=1e-5)


@pytest.mark.parametrize("method", ["ipopt", "reduced", "gradient"])
def test_a_decision_that_is_far_from_its_guess_of_zero(method):
    """x' = d - x, nothing else to pay: x(1) = d (1 - 1/e)."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u", lower=-1.0, upper=1.0)
    d = ocp.decision("d", guess=0.0)
    ocp.dynamics(x, u - x + d)
    ocp.minimize(running=u**2, terminal=(x - 1e9) ** 2)
    solution = co.solve(ocp, method=method, progress=False)
    assert solution["d"] == pytest.approx(1e9 / (1 - np.exp(-1.0)), rel=1e-6)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_small_and_large_units_of_everything_are_kept(unit):
    ocp = co.Problem(T)
    x, u = ocp.state("x", initial=unit), ocp.control("u")
    ocp.dynamics(x, u - x)
    ocp.minimize(running=(u / unit) ** 2 + (x / unit) ** 2)
    reference = co.Problem(T)
    y, w = reference.state("y", initial=1.0), reference.control("w")
    reference.dynamics(y, w - y)
    reference.minimize(running=w**2 + y**2)
    solution, plain = co.solve(ocp, progress=False), co.solve(reference, progress=False)
    assert solution.cost == pytest.approx(plain.cost, rel=1e-9)
    np.testing.assert_allclose(solution["u"] / unit, plain["w"], atol=1e-6)
