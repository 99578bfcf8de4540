"""Filters on triangular factors: equal to the covariance forms, and right where those lose everything."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from compiled import compile_function
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, GAMMA, NOISE, PHI, SEEDS, definite, least_squares, random_filter

from covocp import ProblemError
from covocp.blocks import kalman


@FIXED
@given(seed=SEEDS, size=st.integers(1, 4), count=st.integers(1, 4), form=st.sampled_from(["array", "sequential"]))
def test_update_solves_the_least_squares_problem(seed, size, count, form):
    x, P, y, rows, R = random_filter(seed, size, count)
    estimate, lower = kalman.update_factor(x, kalman.factor(P), y, rows, kalman.factor(R), form=form)
    expected = least_squares(x, P, y, rows, R)
    np.testing.assert_allclose(estimate, expected[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(lower @ lower.T, expected[1], rtol=1e-9, atol=1e-9)
    assert np.all(np.diag(lower) >= 0)
    assert not np.any(np.triu(lower, 1))


def test_predict():
    P = definite(np.random.default_rng(1), 2)
    estimate, lower = kalman.predict_factor(
        [1.0, 2.0], kalman.factor(P), PHI, np.sqrt(0.2) * GAMMA, drift=GAMMA.ravel()
    )
    np.testing.assert_allclose(estimate, PHI @ [1.0, 2.0] + GAMMA.ravel())
    np.testing.assert_allclose(lower @ lower.T, PHI @ P @ PHI.T + NOISE, rtol=1e-13)


def test_factor_of_a_singular_covariance():
    lower = kalman.factor(NOISE)
    np.testing.assert_allclose(lower @ lower.T, NOISE, atol=1e-16)
    assert not np.any(np.triu(lower, 1))
    assert kalman.factor(4.0) == pytest.approx(2.0)
    with pytest.raises(ProblemError, match="positive semidefinite"):
        kalman.factor(np.diag([1.0, -1.0]))


def exact_posterior(rows, variance):
    """Covariance after scalar readings with prior I, in exact arithmetic: inverse of I + sum h'h / r."""
    size = len(rows[0])
    information = [[Fraction(int(i == j)) for j in range(size)] for i in range(size)]
    for row in rows:
        for i in range(size):
            for j in range(size):
                information[i][j] += Fraction(float(row[i])) * Fraction(float(row[j])) / Fraction(variance)
    (a, b), (_, d) = information
    determinant = a * d - b * b
    return np.array(
        [[float(d / determinant), float(-b / determinant)], [float(-b / determinant), float(a / determinant)]]
    )


def test_ill_conditioned_readings():
    """Two nearly parallel, precise readings (Bierman's example, by hand of rational numbers)."""
    small = 2.0**-30  # small^2 is below the precision of 1
    rows = np.array([[1.0, 1.0 - small], [1.0, 1.0]])
    exact = exact_posterior(rows, small**2)
    factor = np.eye(2)
    for row in rows:
        _, factor = kalman.update_factor([0.0, 0.0], factor, 0.0, row, small)
    np.testing.assert_allclose(factor @ factor.T, exact, rtol=1e-6)
    P = np.eye(2)
    for row in rows:
        _, P = kalman.update([0.0, 0.0], P, 0.0, row, small**2, form="standard")
    assert np.abs(P - exact).max() > 0.1 * np.abs(exact).max()  # what the factors are for
    assert np.linalg.eigvalsh(P)[0] >= -1e-15 * np.abs(P).max()


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("missing", ["raise", "skip"])
def test_symbols_expand(kind, missing):
    x, P, y, rows, R = random_filter(2, 3, 2)
    shapes = {"x": (3, 1), "L": (3, 3), "y": (2, 1), "H": (2, 3), "V": (2, 2)}
    symbols = [kind.sym(name, *shape) for name, shape in shapes.items()]
    function = ca.Function("update", symbols, list(kalman.update_factor(*symbols, missing=missing))).expand()
    L, V = kalman.factor(P), kalman.factor(R)
    expected = kalman.update_factor(x, L, y, rows, V)
    for value, number in zip(function(x, L, y, rows, V), expected, strict=True):
        np.testing.assert_allclose(value.full().squeeze(), number, rtol=1e-11, atol=1e-13)
    exactly_known = function(x, np.zeros((3, 3)), y, rows, V)  # reflections of empty rows
    np.testing.assert_array_equal(exactly_known[0].full().ravel(), x)
    np.testing.assert_array_equal(exactly_known[1].full(), 0.0)
    covariance = kind.sym("P", 3, 3)
    np.testing.assert_allclose(ca.Function("factor", [covariance], [kalman.factor(covariance)])(P), L, rtol=1e-12)


def test_missing_rows_are_left_out():
    x, P, y, rows, R = random_filter(8, 3, 2)
    gap = np.array([np.nan, y[1]])
    estimate, lower = kalman.update_factor(x, kalman.factor(P), gap, rows, kalman.factor(R), missing="skip")
    expected = least_squares(x, P, y[1:], rows[1:], R[1:, 1:])
    np.testing.assert_allclose(estimate, expected[0], rtol=1e-10)
    np.testing.assert_allclose(lower @ lower.T, expected[1], rtol=1e-10)
    with pytest.raises(ProblemError, match="missing='skip'"):
        kalman.update_factor(x, kalman.factor(P), gap, rows, kalman.factor(R))


def test_reading_without_noise_of_what_is_known():
    with pytest.raises(ProblemError, match="innovation is singular"):
        kalman.update_factor([0.0, 0.0], np.zeros((2, 2)), 1.0, [1.0, 0.0], 0.0)


@pytest.mark.needs_cc
@pytest.mark.parametrize("real", ["double", "float"])
def test_c_code(real, tmp_path):
    x, P, y, rows, R = random_filter(3, 3, 2)
    shapes = {"x": (3, 1), "L": (3, 3), "y": (2, 1), "H": (2, 3), "V": (2, 2)}
    symbols = [ca.SX.sym(name, *shape) for name, shape in shapes.items()]
    code = compile_function(ca.Function("update", symbols, list(kalman.update_factor(*symbols))), tmp_path, real=real)
    estimate, lower = code(x, kalman.factor(P), y, rows, kalman.factor(R))
    expected = least_squares(x, P, y, rows, R)
    tolerance = 1e-10 if real == "double" else 1e-4
    np.testing.assert_allclose(estimate.ravel(), expected[0], rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(lower @ lower.T, expected[1], rtol=tolerance, atol=tolerance)
