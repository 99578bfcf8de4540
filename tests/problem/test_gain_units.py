"""Loops whose gain is chosen freely, in units of time, length and control: the cost is the same, and as soon found."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

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


@pytest.mark.parametrize("length", [1.0, 1e4])
def test_a_limit_that_is_kept_changes_nothing_in_other_units(length):
    """It took 4.8 times the cost, or a minute, where gains are far below one; without the limit nothing is chosen."""
    free = co.solve(cart(), intervals=10, **QUIET)
    units = {"time": 1e4, "length": length, "control": length / 1e8}
    solution = co.solve(cart(**units, limited=True), intervals=10, **QUIET)
    assert solution.cost == pytest.approx(free.cost, rel=1e-3)  # gains are straight between the nodes
    assert solution.cost == pytest.approx(co.solve(cart(limited=True), intervals=10, **QUIET).cost, rel=2e-5)
    assert solution.stats["iterations"] < 10
    assert solution.chances[0].reached > 0.95


@pytest.mark.parametrize("units", [{"time": 1e-3, "length": 1e3, "control": 1e3}, {"time": 1e3, "control": 1e-3}])
def test_a_constant_gain_is_the_same_in_other_units(units):
    asked = {"gain": co.Gain(constant=True)}
    known = co.solve(cart(**asked), intervals=16, **QUIET)
    solution = co.solve(cart(**units, **asked), intervals=16, **QUIET)
    assert solution.cost == pytest.approx(known.cost, rel=1e-6)
    own = {"time": 1.0, "length": 1.0, "control": 1.0, **units}
    in_units = own["control"] / np.array([own["length"], own["length"] / own["time"], 1.0 / own["time"]])
    np.testing.assert_allclose(solution.gains["C"][0], known.gains["C"][0] * in_units, rtol=1e-3)
