"""The estimation covariance as it is indexed, and what measurements may not contain."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from refusals import empty, lag, simple, wrong

import covocp as co


@pytest.fixture
def covariance():
    """A covariance with entries 1 to 6, its symbols and its function of the half-vector."""
    ocp = empty()
    y, b = ocp.state("y", 2, initial=0), ocp.unknown("b", mean=1.0, variance=1.0)
    E = ocp.estimation_covariance()
    numbers = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]])
    half = ca.symvar(E.matrix)[0]
    rows, columns = np.triu_indices(3)

    def value(entry):
        return ca.Function("entry", [half], [entry])(numbers[columns, rows]).full()

    return y, b, E, numbers, value


@pytest.mark.parametrize(
    ("left", "right", "rows", "columns"),
    [
        ("y[0]", "y[1]", [0], [1]),
        ("y[1]", "b", [1], [2]),
        ("y", "y[1]", [0, 1], [1]),
        ("b", "y", [2], [0, 1]),
    ],
)
def test_names_of_components_are_indices(covariance, left, right, rows, columns):
    _, _, E, numbers, value = covariance
    np.testing.assert_array_equal(value(E[left, right]), numbers[np.ix_(rows, columns)])


def test_names_and_symbols_of_components_agree(covariance):
    y, b, E, _, value = covariance
    np.testing.assert_array_equal(value(E["y[1]", "b"]), value(E[y[1], b]))


@wrong("'y[2]'", "y[0], y[1]")
def test_a_component_that_is_not_there():
    ocp = empty()
    ocp.state("y", 2, initial=0)
    ocp.estimation_covariance()["y[2]", "y"]


@wrong("measurement 'm' contains the matrix 'E'", "test_estimation.py:", "time")
def test_measurement_of_a_covariance():
    ocp, x, _, _, E = lag()
    ocp.measurement("m", x * E[x, x], noise=1.0)
    co.solve(ocp)


@wrong("noise density of measurement 'm' contains the matrix 'S'", "test_estimation.py:")
def test_measurement_noise_from_a_matrix():
    ocp, x, _ = simple()
    S = ocp.symmetric("S", 1, initial=1.0)
    ocp.dynamics(S, -S)
    ocp.measurement("m", x, noise=S)
    co.solve(ocp)
