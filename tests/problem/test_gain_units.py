"""Loops whose gain is chosen freely, in units of time, length and control: the cost is the same, and as soon found."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest
from problems import unassessed

import covocp as co

QUIET = {"progress": False}


def cart(time=1.0, length=1.0, control=1.0, *, limited=False, **asked) -> co.Problem:
    """A cart with unknown drag before a place where it shall be, in other units of time, length and control.

    limited: by a speed that the best gain keeps.
    """
    speed, pull = length / time, length / time**2
    ocp = co.Problem(8.0 * time)
    x = ocp.state("x", initial=0.0, final=10.0 * length, variance=0.5 * length**2)
    v = ocp.state("v", initial=speed, final=0.0, variance=0.2 * speed**2)
    b, u = ocp.unknown("b", mean=0.3 / time, variance=0.02 / time**2), ocp.control("u")
    place, fast, force = x / length, v / speed, u / control
    ocp.dynamics(x, v)
    rate = pull * (force - time * b * fast - 0.1 * ca.sin(place))
    ocp.dynamics(v, rate, noise=0.05 * (1 + 0.1 * fast**2) * pull**2 * time)
    ocp.measurement("position", x, noise=0.1 * length**2 * time)
    ocp.measurement("speed", v, noise=0.4 * speed**2 * time)
    running = (0.1 * force**2 + 0.01 * (place - 5.0) ** 2) / time
    ocp.minimize_expected(running, terminal_weight={x: 2.0 / length**2, v: 1.0 / speed**2}, **asked)
    if limited:
        ocp.chance(v, upper=3.2 * speed, probability=0.95)
    return ocp


@cache
def cost_of_the_cart(*, limited: bool) -> float:
    return unassessed(cart(limited=limited), intervals=10).cost


@pytest.mark.parametrize("length", [1.0, 1e4])
def test_a_limit_that_is_kept_changes_nothing_in_other_units(length):
    """It took 4.8 times the cost, or a minute, where gains are far below one; without the limit nothing is chosen."""
    units = {"time": 1e4, "length": length, "control": length / 1e8}
    solution = co.solve(cart(**units, limited=True), intervals=10, **QUIET)
    assert solution.cost == pytest.approx(cost_of_the_cart(limited=False), rel=1e-3)  # gains are straight lines
    assert solution.cost == pytest.approx(cost_of_the_cart(limited=True), rel=2e-5)
    assert solution.stats["iterations"] < 10
    assert solution.chances[0].reached > 0.95


def pendulum(time=1.0, length=1.0, control=1.0) -> co.Problem:
    """A pendulum with unknown damping that is kept off its rest by a gain that is constant, in other units."""
    ocp = co.Problem(5.0 * time)
    x = ocp.state("x", initial=0.0, variance=0.03 * length**2)
    v = ocp.state("v", initial=0.0, variance=0.03 * (length / time) ** 2)
    b, u = ocp.unknown("b", mean=0.3 / time, variance=(0.06 / time) ** 2), ocp.control("u")
    pull = length / time**2
    ocp.dynamics(x, v)
    ocp.dynamics(v, pull * (u / control - ca.sin(x / length)) - b * v, noise=0.02 * pull**2 * time)
    ocp.measurement("y", x, noise=0.03 * length**2 * time)
    running = 0.3 * (u / control) ** 2 + 0.3 * (x / length - 1.0) ** 2 + 0.05 * (v * time / length) ** 2
    ocp.minimize_expected(running / time, terminal_weight={x: 2.0 / length**2}, gain=co.Gain(constant=True))
    return ocp


@cache
def known_pendulum() -> co.Solution:
    return co.solve(pendulum(), intervals=12, **QUIET)


@pytest.mark.parametrize("units", [(1e-3, 1e3, 1e3), (1e3, 1e3, 1e-3)])
def test_a_constant_gain_is_found_in_other_units(units):
    """Where entries are far from one it took a thousand iterations, and was not found."""
    known = known_pendulum()
    solution = co.solve(pendulum(*units), intervals=12, **QUIET)
    time, length, control = units
    assert solution.cost == pytest.approx(known.cost, rel=1e-6)
    in_units = control / np.array([length, length / time, 1.0 / time])
    np.testing.assert_allclose(solution.gains["C"][0, 0], known.gains["C"][0, 0] * in_units, rtol=1e-4)
    assert solution.stats["iterations"] < 300
