"""Variances and densities as lists of numbers and expressions."""

import casadi as ca
import pytest
from refusals import refused

import covocp as co


def listed(as_list):
    """A double integrator whose statistics have entries that are parameters."""
    ocp = co.Problem(1.0)
    q = ocp.parameter("q", 0.3)
    x = ocp.state("x", 2, initial=[0.0, 1.0], variance=[q, 0.1] if as_list else ca.vertcat(q, 0.1))
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u), noise=[0, q] if as_list else ca.vertcat(0, q))
    rows = [[q, 0.01], [0.01, 2 * q]]
    matrix = ca.vertcat(*(ca.horzcat(*row) for row in rows))
    ocp.measurement("m", x, noise=rows if as_list else matrix)
    ocp.minimize_expected(running=u**2 + ca.sumsqr(x))
    return ocp


def test_lists_are_diagonals_and_lists_of_rows_matrices():
    costs = [co.solve(listed(way), intervals=10, progress=False).cost for way in (True, False)]
    assert costs[0] == costs[1]


@pytest.mark.parametrize(
    ("entries", "part"),
    [
        (lambda q, x: [q, 1.0, 2.0], "2 numbers"),
        (lambda q, x: [q, x], "not a number"),
        (lambda q, x: [q, None], "not a number"),
        (lambda q, x: [q, [1.0, q]], "not a number"),
        (lambda q, x: [q, -1.0], "negative"),
        (lambda q, x: [[q, 1.0], [2.0, q]], "not symmetric"),
    ],
)
def test_lists_that_mean_nothing(entries, part):
    ocp = co.Problem(1.0)
    q, x, u = ocp.parameter("q", 0.3), ocp.state("x", 2, initial=0.0, variance=0.1), ocp.control("u")
    refused(lambda: ocp.dynamics(x, ca.vertcat(x[1], u), noise=entries(q, x)), part, "'x'")
