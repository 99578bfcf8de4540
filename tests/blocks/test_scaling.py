"""Mixed units: an answer is the same number of metres and radians whatever they are written in."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, SEEDS

from covocp import ProblemError
from covocp.blocks import kalman, scaling
from covocp.blocks.arithmetic import substituted

FORMS = ("joseph", "standard", "sequential", "information")
# Position [m], tilt [rad], gyro bias [rad/s]: standard deviations and a correlation matrix of condition 4.
SPREADS = np.array([1e4, 1e-2, 5e-8])
CORRELATION = np.array([[1.0, 0.5, -0.3], [0.5, 1.0, 0.2], [-0.3, 0.2, 1.0]])


def exact_posterior(P, h, r):
    """P - P h h'P / (h'P h + r) in rational arithmetic."""
    P, h = [[Fraction(v) for v in row] for row in P.tolist()], [Fraction(v) for v in h]
    seen = [sum(p * v for p, v in zip(row, h, strict=True)) for row in P]
    spread = sum(v * s for v, s in zip(h, seen, strict=True)) + Fraction(r)
    n = range(len(h))
    return np.array([[float(P[i][j] - seen[i] * seen[j] / spread) for j in n] for i in n])


@pytest.mark.parametrize("form", FORMS)
def test_a_fix_of_position_leaves_the_gyro_bias(form):
    """Inertial navigation, one axis: [m, m/s, rad, rad/s], a minute of position fixes; each step against fractions."""
    g, radius = 9.81, 6.371e6
    F = np.array([[0, 1, 0, 0], [0, 0, -g, 0], [0, 1 / radius, 0, 1], [0, 0, 0, 0]])[[2, 3, 0, 1]][:, [2, 3, 0, 1]]
    transition, noise = kalman.discretise(F, np.diag([1e-14, 1e-22, 0.0, 1e-6]), 1.0)
    x, P, H = np.zeros(4), np.diag([1e-2, 5e-8, 1e4, 100.0]) ** 2, np.array([0.0, 0.0, 1.0, 0.0])
    for _ in range(60):
        x, M = kalman.predict(x, P, transition, noise)
        x, P = kalman.update(x, M, 1.0, H, 25.0, form=form)
        np.testing.assert_allclose(np.diag(P), np.diag(exact_posterior(M, H, 25.0)), rtol=1e-6)


@FIXED
@given(seed=SEEDS, form=st.sampled_from(FORMS), singular=st.booleans())
def test_updates_do_not_depend_on_units(seed, form, singular):
    """Powers of two change no digit, so the answer in other units has the same digits but for the last ones."""
    generator = np.random.default_rng(seed)
    half = generator.standard_normal((3, 2 if singular and form != "information" else 3))
    P, H = half @ half.T, generator.standard_normal((2, 3))
    R = np.diag(generator.uniform(0.1, 1.0, 2))
    units, rows = 2.0 ** generator.integers(-40, 40, 3), 2.0 ** generator.integers(-40, 40, 2)
    x, here = kalman.update(np.zeros(3), P, [1.0, -0.4], H, R, form=form)
    there = kalman.update(
        np.zeros(3),
        P * np.outer(units, units),
        rows * [1.0, -0.4],
        rows[:, None] * H / units,
        R * np.outer(rows, rows),
        form=form,
    )
    np.testing.assert_allclose(there[0] / units, x, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(scaling.over(there[1], units), here, rtol=1e-9, atol=1e-12)


def test_a_covariance_of_rounding_does_not_touch_the_others():
    """What is left of a variance of one after a reading of noise 1e-20 is rounding; its correlations are none."""
    P = np.array([[1.0, 1.0, 1e-16], [1.0, 1.0, -1e-16], [1e-16, -1e-16, 1e-20]])
    before = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    for known in (before, None):
        mended = scaling.semidefinite_part(P, known)
        np.testing.assert_allclose(mended, P, rtol=1e-12, atol=2e-16)
        assert np.linalg.eigvalsh(scaling.over(mended, scaling.diagonal_scales(mended)))[0] >= -1e-15


def test_a_negative_variance_of_rounding_becomes_zero():
    mended = scaling.semidefinite_part(np.array([[1.0, 1e-17], [1e-17, -1e-17]]))
    np.testing.assert_array_equal(mended, np.diag([1.0, 0.0]))


def test_what_is_semidefinite_comes_back_as_it_is():
    P = np.outer(SPREADS, SPREADS) * CORRELATION
    assert scaling.semidefinite_part(P) is P


def test_predictions_are_semidefinite():
    """The difference of two states that are known to be equal."""
    P = 0.3 * np.ones((2, 2)) + 1e-17 * np.eye(2)
    for share in (0.1, 0.3, 0.7):
        phi = np.array([[share, -share], [1.0, 1.0 / 3.0]])
        spread = kalman.predict(np.zeros(2), P, phi, np.zeros((2, 2)))[1]
        assert np.diag(spread).min() >= 0.0
        scaled = scaling.over(spread, scaling.diagonal_scales(spread))
        assert np.linalg.eigvalsh(scaled)[0] >= -1e-15


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 2, 0]])
@pytest.mark.parametrize("rank", [2, 3])
def test_factor_in_mixed_units(order, rank):
    half = (
        np.array([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0], [0.28, 0.96, 0.0]])
        if rank == 2
        else np.linalg.cholesky(CORRELATION)
    )
    P = np.outer(SPREADS, SPREADS) * (half @ half.T)
    P = P[np.ix_(order, order)]
    L = kalman.factor(P)
    np.testing.assert_array_equal(L, np.tril(L))
    spreads = SPREADS[order]
    np.testing.assert_allclose(scaling.over(L @ L.T, spreads), scaling.over(P, spreads), atol=1e-14)


@pytest.mark.parametrize("sizes", [(1.0, 1e5, 1e-3), (1e6, 1.0, 1e-3), (1e-3, 1e6, 1.0)])
def test_recursive_least_squares_with_regressors_of_unlike_size(sizes):
    """Numbers against the same recursion as a casadi.Function, in standard deviations."""
    generator = np.random.default_rng(0)
    regressors = (generator.standard_normal((60, 3)) + 0.3) * sizes
    outputs = regressors @ (1.0 / np.array(sizes)) + generator.standard_normal(60)
    theta, P = kalman.diffuse_start(3)
    X, C, phi, y = ca.SX.sym("x", 3), ca.SX.sym("P", 3, 3), ca.SX.sym("phi", 3), ca.SX.sym("y")
    step = ca.Function("step", [X, C, phi, y], list(kalman.recursive_least_squares(X, C, phi, y)))
    other, Q = theta, P
    for row, output in zip(regressors, outputs, strict=True):
        theta, P = kalman.recursive_least_squares(theta, P, row, output)
        other, Q = step(other, Q, row, output)
    deviations = np.sqrt(np.diag(P))
    np.testing.assert_allclose(deviations, np.sqrt(np.diag(np.asarray(Q))), rtol=1e-7)
    assert np.abs((theta - np.asarray(other).ravel()) / deviations).max() < 1e-7


def test_batch_start_with_regressors_of_unlike_size():
    """A parameter in units 10^18 apart is determined all the same."""
    generator = np.random.default_rng(3)
    regressors, theta, units = generator.standard_normal((20, 3)), np.array([1.0, -2.0, 0.5]), [1e12, 1.0, 1e-9]
    found, P = kalman.least_squares_start(regressors * units, regressors @ theta)
    np.testing.assert_allclose(found * units, theta, rtol=1e-12)
    np.testing.assert_allclose(P * np.outer(units, units), np.linalg.inv(regressors.T @ regressors), rtol=1e-12)


@FIXED
@given(seed=SEEDS)
def test_substitution(seed):
    generator = np.random.default_rng(seed)
    lower = np.tril(generator.standard_normal((4, 4)), -1) + np.diag(generator.uniform(1.0, 2.0, 4))
    right = generator.standard_normal((4, 2))
    np.testing.assert_allclose(lower @ substituted(lower, right), right, rtol=1e-11, atol=1e-13)


WRONG = {
    "a negative variance beside a large one": (np.diag([1e6, -1e-4]), "-0.0001 in place 1"),
    "the same in other units": (np.diag([1e12, -1e2]), "-100 in place 1"),
    "a correlation above one": (np.array([[1e8, 1e-3], [1e-3, 2.5e-15]]), "its diagonal scaled to one"),
    "a covariance with what has no variance": (np.array([[1e8, 1e-3], [1e-3, 0.0]]), "0 in place 1"),
    "an asymmetry in small units": (np.array([[1e10, 5.0], [0.0, 1e-6]]), "an asymmetry of 5"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_covariances_are_refused_in_any_units(case):
    P, text = WRONG[case]
    with pytest.raises(ProblemError, match=text):
        kalman.update(np.zeros(2), P, 1.0, [0.0, 1.0], 1e-3)


def test_right_covariances_are_taken_in_any_units():
    for correlation in (1.0, -1.0, 0.999, 0.0):
        P = np.array([[1e8, correlation * 5e-4], [correlation * 5e-4, 2.5e-15]])
        kalman.predict(np.zeros(2), P, np.eye(2), np.zeros((2, 2)))
    kalman.predict(np.zeros(2), np.array([[1.0, 1e-17], [1e-17, -1e-17]]), np.eye(2), np.zeros((2, 2)))


def test_a_density_that_is_zero_in_a_row_is_refused():
    with pytest.raises(ProblemError, match="a smallest eigenvalue of 0"):
        kalman.rate(np.eye(2), np.eye(2), np.eye(2), np.eye(2), np.diag([1e8, 0.0]))
