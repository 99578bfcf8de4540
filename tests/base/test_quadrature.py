"""Steps and rules of integration against closed forms."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from covocp.base.quadrature import (
    GAUSS_NODES,
    classical_step,
    covariance_after,
    gauss_matrix,
    gauss_step,
    gauss_transition,
    hermite,
    interpolated,
    lyapunov_after,
    simpson_weight,
)

H = np.array([[0.3, -1.2, 0.1, 0.0], [0.4, -0.2, 0.0, 0.7], [0.0, 0.5, -0.6, 0.2], [1.0, 0.0, 0.3, 0.1]])


def test_classical_step_has_order_four():
    """dx/dt = x cos t from 1: x = exp(sin t)."""

    def error(h):
        return abs(classical_step(lambda x, c: x * np.cos(c * h), 1.0, h) - np.exp(np.sin(h)))

    ratios = [error(h) / error(h / 2) for h in (0.4, 0.2)]
    assert 28 < min(ratios) <= max(ratios) < 36  # 2^5: the error of one step


def test_a_known_first_slope_changes_nothing():
    h = 0.3

    def rate(x, c):
        return x**2 + c

    assert classical_step(rate, 0.7, h, rate(0.7, 0.0)) == classical_step(rate, 0.7, h)


def test_hermite_is_exact_for_cubics():
    cubic, slope = np.polynomial.Polynomial([0.3, -1.0, 2.0, 0.7]), np.polynomial.Polynomial([-1.0, 4.0, 2.1])
    c = np.linspace(0.0, 1.0, 11)
    np.testing.assert_allclose(hermite(cubic(0), cubic(1), slope(0), slope(1), c), cubic(c), rtol=1e-14)


@pytest.mark.parametrize("count", [2, 6])
def test_simpson_is_exact_for_cubics(count):
    cubic = np.polynomial.Polynomial([0.3, -1.0, 2.0, 0.7])
    total = sum(simpson_weight(j, count) * cubic(j / count) for j in range(count + 1))
    assert total == pytest.approx(cubic.integ()(1.0), rel=1e-14)


def test_gauss_transition_is_the_pade_approximant_of_constant_rates():
    unit = np.eye(4)
    above, below = (unit + s * H / 2 + H @ H / 12 for s in (1.0, -1.0))
    np.testing.assert_allclose(
        gauss_transition([H, H], unit, np.linalg.solve), np.linalg.solve(below, above), rtol=1e-13
    )


def test_gauss_transition_has_order_four_where_rates_vary():
    """z' = t H z: exp(t^2 H / 2)."""

    def error(h):
        points = [h * (c * h) * H for c in GAUSS_NODES]
        return np.abs(gauss_transition(points, np.eye(4), np.linalg.solve) - expm(h**2 / 2 * H)).max()

    assert error(0.5) / error(0.25) > 28


def test_expressions_numbers_and_stacks_agree():
    points = [H, H @ H / 3]
    numbers = gauss_transition(points, np.eye(4), np.linalg.solve)
    symbols = [ca.MX.sym(f"H{k}", 4, 4) for k in range(2)]
    found = ca.Function("D", symbols, [gauss_matrix(symbols, 2, "lapacklu")])(*points)
    np.testing.assert_allclose(found.full(), numbers, rtol=1e-12)
    stacks = [np.stack([p, 0.5 * p]) for p in points]
    np.testing.assert_allclose(gauss_transition(stacks, np.eye(4), np.linalg.solve)[0], numbers, rtol=1e-12)


def test_a_step_with_a_forcing_is_that_of_the_larger_system_without():
    """y' = H y + f is (y, 1)' = [H f; 0 0] (y, 1)."""
    forcing, start = [np.array([[0.1], [0.4], [-0.3], [0.2]]), np.array([[0.3], [0.0], [0.5], [-0.1]])], np.ones((4, 1))
    points = [0.3 * H, 0.2 * H.T]
    blocks = [np.block([[A, f], [np.zeros((1, 5))]]) for A, f in zip(points, forcing, strict=True)]
    larger = gauss_transition(blocks, np.eye(5), np.linalg.solve)
    change, transition = gauss_step([ca.DM(A) for A in points], forcing, ca.DM(start), ca.DM.eye(4), ca.solve)
    np.testing.assert_allclose(start + change, larger[:4, :4] @ start + larger[:4, 4:], rtol=1e-13)
    np.testing.assert_allclose(transition, larger[:4, :4], rtol=1e-13)


def test_covariance_of_an_integrated_white_noise_is_exact():
    """P = [t^3/3 t^2/2; t^2/2 t] from zero: the method of order 4 is exact for cubics."""
    F, Q, t = np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, 1.0]), 0.7
    generator = t * np.block([[-F.T, np.zeros((2, 2))], [Q, F]])
    D = gauss_transition([generator] * 2, np.eye(4), np.linalg.solve)
    for step in (covariance_after, lyapunov_after):
        np.testing.assert_allclose(step(D, np.zeros((2, 2))), [[t**3 / 3, t**2 / 2], [t**2 / 2, t]], rtol=1e-13)


def test_a_lyapunov_step_does_not_see_what_rounding_leaves():
    F, P, t = np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([1e16, 1.0]), 0.7
    D = gauss_transition(
        [t * np.block([[-F.T, np.zeros((2, 2))], [np.zeros((2, 2)), F]])] * 2, np.eye(4), np.linalg.solve
    )
    move = np.array([[1.0, t], [0.0, 1.0]])
    expected = lyapunov_after(D, P)
    np.testing.assert_allclose(expected, move @ P @ move.T, rtol=1e-13)
    D[:2, 2:] = 1e-17
    np.testing.assert_array_equal(lyapunov_after(D, P), expected)


def test_interpolation_is_exact_for_lines_and_knows_what_has_no_columns():
    old, new = np.array([0.0, 0.3, 1.0]), np.linspace(0.0, 1.0, 7)
    lines = [[1.0, -2.0]]
    np.testing.assert_allclose(interpolated(old[:, None] * lines, old, new), new[:, None] * lines, atol=1e-15)
    assert interpolated(np.zeros((3, 0)), old, new).shape == (7, 0)
