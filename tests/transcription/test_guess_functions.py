"""Guesses and nominals that are functions of s = t/T: as many values as the control or the state has, in any form."""

import math

import casadi as ca
import numpy as np
import pytest
from refusals import refused, simple

import covocp as co


def plane(controls=2):
    """States and controls of two entries, one integrator for each."""
    ocp = co.Problem(duration=2.0)
    p, u = ocp.state("p", 2, initial=0.0), ocp.control("u", controls)
    ocp.dynamics(p, u if controls == 2 else ca.vertcat(u, -u))
    ocp.minimize(running=ca.sumsqr(u), terminal=ca.sumsqr(p - 1.0))
    return ocp


def flown(ocp, function, intervals=4):
    return co.evaluate(ocp, nominal={"u": function}, intervals=intervals)


# Forms of u = (s, 1 - s), and of one control, u = 1 - s.
OF_TWO = {
    "a row for each entry": lambda s: np.array([s, 1 - s]),
    "a column for each entry": lambda s: np.stack([s, 1 - s], axis=-1),
    "a list of arrays and numbers": lambda s: [s, 1 - s],
    "numbers only": lambda s: [float(s), 1.0 - float(s)] if s < 2.0 else None,
    "CasADi": lambda s: ca.vertcat(s, 1 - s),
}
OF_ONE = {
    "an array": lambda s: 1 - s,
    "a column": lambda s: np.reshape(1 - s, (-1, 1)),
    "a row": lambda s: np.reshape(1 - s, (1, -1)),
    "math": lambda s: 1 - math.fabs(s),
    "a list of one": lambda s: [1.0 - s],
}


@pytest.mark.parametrize("intervals", [1, 2, 4])
@pytest.mark.parametrize("form", OF_TWO)
def test_two_values_in_any_form(form, intervals):
    """Also on as many nodes as there are entries, where rows and columns look the same."""
    solution = flown(plane(), OF_TWO[form], intervals)
    s = solution.t / 2.0
    np.testing.assert_allclose(solution["u"], np.stack([s, 1 - s], axis=1), atol=1e-15)


@pytest.mark.parametrize("form", OF_ONE)
def test_one_value_in_any_form(form):
    solution = flown(plane(1), OF_ONE[form])
    np.testing.assert_allclose(solution["u"], 1.0 - solution.t / 2.0, atol=1e-15)


@pytest.mark.parametrize("intervals", [1, 4])
def test_constants(intervals):
    np.testing.assert_array_equal(flown(plane(1), lambda s: 0.25, intervals)["u"], 0.25)
    np.testing.assert_array_equal(flown(plane(), lambda s: [0.25, 3.0], intervals)["u"][-1], [0.25, 3.0])


# What is returned, of one control and of two, and the shape that is told.
COUNTS = {
    "two for one": (1, lambda s: [0.0, 1.0], "shape (2,) at s = 0"),
    "two courses for one": (1, lambda s: np.array([s, 1 - s]), "shape (2,) at s = 0"),
    "numbers for nodes of another mesh": (1, lambda s: np.linspace(0, 1, 7), "shape (7,) at s = 0"),
    "every second value": (1, lambda s: s[::2], "shape (3,) for 5 values of s"),
    "one for two": (2, lambda s: s, "shape () at s = 0"),
    "one constant for two": (2, lambda s: 0.5, "shape () at s = 0"),
    "three for two": (2, lambda s: np.array([s, s, s]), "shape (3,) at s = 0"),
}


@pytest.mark.parametrize("case", COUNTS)
def test_another_number_of_values_is_refused(case):
    controls, function, shape = COUNTS[case]
    expected = "one value at each s" if controls == 1 else "2 values at each s"
    for call in (
        lambda: flown(plane(controls), function),
        lambda: co.solve(plane(controls), intervals=4, guess={"u": function}, progress=False),
    ):
        refused(call, "guess of 'u'", "another number of values", expected, shape)


def test_one_value_for_two_is_refused_on_as_many_nodes_as_entries():
    refused(lambda: flown(plane(), lambda s: s, 1), "guess of 'u'", "2 values at each s", "shape () at s = 0")


def test_guess_of_a_state_with_too_many_values_is_refused():
    ocp = simple(final=1.0, guess=lambda s: [0.0, 0.5, 1.0])[0]
    refused(lambda: co.solve(ocp, intervals=4, progress=False), "guess of 'x'", "one value at each s", "shape (3,)")


def test_function_that_fails_says_why():
    refused(lambda: flown(plane(), lambda s: [s, 1 / 0]), "guess of 'u'", "that fails", "ZeroDivisionError")
