"""Costs that are linear in what a budget of length limits: an area in the way round it, a height in the way up."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq

import covocp as co


def dido(length, *, width=1.0, equal=False, guess=None):
    """The largest area between a coast of this width and a rope that is so many times as long."""
    ocp = co.Problem(width)
    y = ocp.state("y", initial=0.0, final=0.0)
    u = ocp.control("u", **({} if guess is None else {"guess": guess}))
    ocp.dynamics(y, u)
    rope = {"equals": length * width} if equal else {"upper": length * width}
    ocp.subject_to(ocp.integral(ca.sqrt(1.0 + u**2)), at="final", **rope)
    ocp.minimize(running=-y)
    return ocp


def area(length):
    """Of a segment of the circle, for a coast of 1."""
    half = brentq(lambda a: np.sin(a) / a - 1.0 / length, 1e-6, 0.5 * np.pi)
    radius = 0.5 / np.sin(half)
    return radius**2 * (half - np.sin(half) * np.cos(half))


@pytest.mark.parametrize("method", ["ipopt", "auto"])
@pytest.mark.parametrize(("length", "accuracy"), [(1.01, 1e-5), (1.2, 1e-5), (1.5, 1e-3)])
def test_the_rope_of_dido_is_an_arc(method, length, accuracy):
    solution = co.solve(dido(length), intervals=30, method=method, progress=False)
    assert solution.cost == pytest.approx(-area(length), rel=accuracy)


def test_a_rope_in_metres_and_one_that_is_no_longer_than_it_may_be():
    far = co.solve(dido(1.2, width=1000.0), intervals=30, progress=False)
    assert far.cost == pytest.approx(-1e6 * area(1.2), rel=1e-5)
    equal = co.solve(dido(1.2, equal=True, guess=lambda s: 1.0 - 2.0 * s), intervals=30, progress=False)
    assert equal.cost == pytest.approx(-area(1.2), rel=1e-5)
    assert equal.stats["iterations"] < 500  # of all runs: one that has gone far away is not waited for


def test_later_solves_are_kept_near_at_once():
    solver = co.Solver(dido(1.2), intervals=30)
    first, second = solver.solve(progress=False), solver.solve(progress=False)
    assert second.cost == pytest.approx(first.cost, rel=1e-9)
    assert second.stats["iterations"] < 0.5 * first.stats["iterations"]


@pytest.mark.parametrize("length", [1.1, 2.0, 5.0])
def test_the_steepest_way_up_is_straight(length):
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.subject_to(ocp.integral(ca.sqrt(1.0 + u**2)), upper=length, at="final")
    ocp.minimize(terminal=-x)
    solution = co.solve(ocp, intervals=20, progress=False)
    assert solution.cost == pytest.approx(-np.sqrt(length**2 - 1.0), rel=1e-6)
    np.testing.assert_allclose(solution["u"], np.sqrt(length**2 - 1.0), rtol=1e-3)
