"""Riccati equations by doubling, where the eigenvalues of a pencil cannot be ordered; inputs in unlike units."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, SEEDS, by_doubling, definite
from scipy.linalg import expm

from covocp.blocks import kalman, riccati
from covocp.blocks.doubling import doubled

# A transport aircraft along its path, sampled at 2 Hz.
A = np.array([[-0.00643, 0.0263, 0, -32.2], [-0.0941, -0.624, 820, 0], [-0.000222, -0.00153, -0.668, 0], [0, 0, 1, 0]])
B = np.array([[0], [-32.7], [-2.08], [0]])
STEP = expm(np.block([[A, B], [np.zeros((1, 5))]]) * 0.5)


@pytest.mark.parametrize("R", [0.9, 0.99, 1.0, 1.01, 1.1, 2.0])
def test_a_sampled_aircraft(R):
    F, G = STEP[:4, :4], STEP[:4, 4:]
    regulator = riccati.lqr(F, G, np.eye(4), R, discrete=True)
    truth = by_doubling(F, G, np.eye(4), np.array([[R]]))
    np.testing.assert_allclose(regulator.gain, np.linalg.solve(R + G.T @ truth @ G, G.T @ truth @ F), rtol=1e-7)


@FIXED
@given(seed=SEEDS, size=st.integers(1, 5), count=st.integers(1, 3), discrete=st.booleans())
def test_doubling_solves_the_equation(seed, size, count, discrete):
    generator = np.random.default_rng(seed)
    joint = definite(generator, size + count)
    A, B = generator.standard_normal((size, size)), generator.standard_normal((size, count))
    Q, N, R = joint[:size, :size], joint[:size, size:], joint[size:, size:]
    S = doubled(A, B, Q, R, N, discrete=discrete)
    if discrete:
        K = np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A + N.T)
        residual = A.T @ S @ A - S + Q - (A.T @ S @ B + N) @ K
        assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1
    else:
        K = np.linalg.solve(R, B.T @ S + N.T)
        residual = A.T @ S + S @ A + Q - (S @ B + N) @ K
        assert np.linalg.eigvals(A - B @ K).real.max() < 0
    assert np.abs(residual).max() <= 1e-8 * (np.abs(S).max() + np.abs((S @ B) @ K).max())


@pytest.mark.parametrize("small", [1e-14, 1e-16, 1e-18, 1e-24])
def test_weights_of_inputs_far_apart(small):
    """Two lags apart: K = root(1 + 1/r) - 1 of each, S = r K."""
    wanted = np.diag([np.sqrt(1.0 + 1.0 / small) - 1.0, np.sqrt(2.0) - 1.0])
    R = np.diag([small, 1.0])
    np.testing.assert_allclose(riccati.lqr(-np.eye(2), np.eye(2), np.eye(2), R).gain, wanted, rtol=1e-9, atol=1e-12)
    steady = kalman.steady_state(-np.eye(2), np.eye(2), np.eye(2), R, discrete=False)
    np.testing.assert_allclose(steady.gain, wanted, rtol=1e-9, atol=1e-12)


@FIXED
@given(seed=SEEDS, discrete=st.booleans())
def test_regulators_do_not_depend_on_the_units_of_inputs(seed, discrete):
    generator = np.random.default_rng(seed)
    joint = definite(generator, 5)
    A, B = (0.5 if discrete else 1.0) * generator.standard_normal((3, 3)), generator.standard_normal((3, 2))
    Q, N, R = joint[:3, :3], joint[:3, 3:], joint[3:, 3:]
    units = 2.0 ** generator.integers(-40, 40, 2)
    here = riccati.lqr(A, B, Q, R, cross=N, discrete=discrete)
    there = riccati.lqr(A, B * units, Q, R * units * units[:, None], cross=N * units, discrete=discrete)
    np.testing.assert_allclose(there.gain * units[:, None], here.gain, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(there.cost, here.cost, rtol=1e-9, atol=1e-11)
