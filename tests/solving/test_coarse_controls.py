"""Controls that must turn between two nodes: what their form costs is told, which halves of the steps do not see."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from problems import beside_switches, least_fuel
from scipy.linalg import solve_continuous_are

import covocp as co

A = np.array([[0.0, 1.0, 0.0], [0.0, -2.0, 20.0], [0.0, 0.0, -100.0]])
B, PRICE = np.array([[0.0], [0.0], [100.0]]), 1e-3


def servo(duration: float, begin: bool = True) -> co.Problem:
    """An angle that is brought to zero through an actuator of 10 ms; `begin`: from 1."""
    ocp = co.Problem(duration, name="servo" if begin else "servo, on")
    th, w, i = (ocp.state(name, initial=value if begin else None) for name, value in zip("awi", (1, 0, 0), strict=True))
    u = ocp.control("u")
    ocp.dynamics(th, w)
    ocp.dynamics(w, -2.0 * w + 20.0 * i)
    ocp.dynamics(i, 100.0 * (u - i))
    ocp.minimize(running=th**2 + PRICE * u**2)
    return ocp


def best() -> float:
    """Over any time that is long for it."""
    return float(solve_continuous_are(A, B, np.diag([1.0, 0.0, 0.0]), [[PRICE]])[0, 0])


def told(solve) -> tuple[float, list[str]]:
    """The cost, and what was said of the controls."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cost = solve().cost
    return cost, [str(one.message) for one in caught if "change faster" in str(one.message)]


@pytest.mark.parametrize("method", ["ipopt", "reduced"])
def test_a_cost_that_is_a_hundredth_off_is_told_with_about_how_much(method):
    cost, words = told(lambda: co.solve(servo(10.0), method, progress=False))
    off = cost / best() - 1.0
    assert off > 0.03
    assert len(words) == 1
    assert 0.5 * off < float(words[0].split("about ")[1].split()[0]) < 2.0 * off
    assert "refine=" in words[0]


@pytest.mark.parametrize("duration", [1.0, 2.0, 4.0])
def test_where_the_nodes_follow_nothing_is_said(duration):
    cost, words = told(lambda: co.solve(servo(duration), progress=False))
    assert cost == pytest.approx(best(), rel=2e-3)
    assert not words


def test_what_is_said_to_help_helps():
    cost, words = told(lambda: co.solve(servo(30.0), refine=1e-4, progress=False))
    assert cost == pytest.approx(best(), rel=1e-4)
    assert not words


def test_more_than_the_cost_is_no_number():
    cost, words = told(lambda: co.solve(servo(60.0), progress=False))
    assert cost > 3.0 * best()
    assert "costs much of the cost, by a crude estimate. " in words[0]


def test_a_control_that_is_held_is_meant_to_be():
    assert not told(lambda: co.solve(servo(30.0), control="constant", progress=False))[1]


def test_a_solver_of_another_duration_and_phases_tell_it_too():
    solver = co.Solver(servo(2.0))
    assert not told(lambda: solver.solve(progress=False))[1]
    assert told(lambda: solver.solve(duration=30.0, progress=False))[1]
    assert not told(lambda: solver.solve(duration=30.0, assess=False, progress=False))[1]
    cost, words = told(lambda: co.solve(co.Phases([servo(15.0), servo(15.0, begin=False)]), progress=False))
    assert cost > 1.1 * best()
    assert len(words) == 1  # of the second phase, which rests, there is nothing to say


def test_switches_that_cost_little_are_measured():
    """Least fuel on 8 intervals: by H it would be 1.7e-2, it is 8e-4."""
    ocp, optimum = least_fuel()
    cost, words = told(lambda: co.solve(ocp, grid=beside_switches(1e-3, 1e-4), progress=False))
    assert cost == pytest.approx(optimum, rel=1e-3)
    assert not words


def test_the_nominal_of_a_classical_design_is_looked_at():
    """x' = -x^3/10 + u with cheap control over 100 s: halves of the steps see 4e-5 of the 68 % that it is off."""
    ocp = co.Problem(100.0)
    x, b = ocp.state("x", initial=2.0, variance=1e-4), ocp.unknown("b", mean=1.0, variance=1e-4)
    u = ocp.control("u")
    ocp.dynamics(x, -0.1 * b * x**3 + u, noise=1e-6)
    ocp.measurement("y", x, noise=1e-3)
    ocp.minimize_expected(running=0.5 * x**2 + 0.005 * u**2)
    # over a long time the costate p has  p^2 / (2 r) + p x^3/10 = x^2/2  with r = 1/100
    places = np.linspace(0.0, 2.0, 200001)
    slopes = 0.01 * (-0.1 * places**3 + np.sqrt((0.1 * places**3) ** 2 + 100.0 * places**2))
    nominal = float(np.trapezoid(slopes, places))
    cost, words = told(lambda: co.solve(ocp, nominal="deterministic", progress=False))
    assert cost > 1.5 * nominal
    assert len(words) == 1
    assert words[0].endswith("Use more intervals.")
    fine, nothing = told(lambda: co.solve(ocp, nominal="deterministic", intervals=2000, progress=False))
    assert fine == pytest.approx(nominal, rel=0.02)
    assert not nothing
