"""Attitudes from elsewhere, as quaternions of either sign and as rotations; truths of solutions from elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from attitudes import slew

import covocp as co
from covocp.blocks import so3

LAST = so3.exp([0.3, 1.5, -0.4])


def test_an_attitude_is_the_same_with_either_sign_and_as_a_rotation():
    first = np.asarray(so3.exp([0.2, -0.1, 0.3]))
    fresh = co.solve(slew(first, LAST)[0], intervals=20)
    quaternion = np.asarray(so3.to_quaternion(first)).ravel()
    solver = co.Solver(slew(np.eye(3), LAST)[0], intervals=20)
    for given in (first, quaternion, -quaternion):
        found = solver.solve(initial={"attitude": given})
        assert found.cost == pytest.approx(fresh.cost, rel=1e-8)
    for wrong in (1.1 * quaternion, np.zeros(4), np.ones(3), 2.0 * first):
        with pytest.raises(co.ProblemError, match="initial attitude of 'attitude' is no attitude"):
            solver.solve(initial={"attitude": wrong})


def lag(start: float, prior: np.ndarray) -> co.Problem:
    """A lag of unknown rate under feedback."""
    ocp = co.Problem(5.0)
    x = ocp.state("x", initial=start, variance=prior[0, 0])
    b = ocp.unknown("b", 1.0, prior[1, 1])
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.2)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal_weight={"x": 1.0})
    return ocp


def test_truths_with_other_parameters_are_compared_by_what_is_unknown():
    """The means of the unknowns stand behind the parameters, of which a solution from elsewhere has more."""
    prior = np.diag([0.7, 0.4])
    found = co.Solver(lag(0.3, np.diag([0.5, 0.2])), intervals=30).solve(initial={"x": 1.5}, covariance=prior)
    fresh, truth = co.solve(lag(1.5, prior), intervals=30), lag(1.5, 2.0 * prior)
    expected = co.evaluate(fresh, truth=truth).cost
    assert expected > fresh.cost
    for given in (truth, co.movable(truth), {"initial_E": [1.4, 0.0, 0.8]}):
        assert co.evaluate(found, truth=given).cost == pytest.approx(expected, rel=1e-8)
    with pytest.raises(co.ProblemError, match="starts elsewhere"):
        co.evaluate(found, truth=lag(0.3, prior))
