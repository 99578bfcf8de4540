"""Stability: modes that no input reaches, and certificates by quadratic functions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, GAMMA, PHI, Q_1, Q_2, SEEDS

from covocp import ProblemError
from covocp.blocks import riccati


@FIXED
@given(seed=SEEDS, discrete=st.booleans())
def test_lost_modes_are_found_in_any_coordinates(seed, discrete):
    """A hidden mode, with coordinates changed and units that differ by 10^6."""
    generator = np.random.default_rng(seed)
    A = np.zeros((4, 4))
    A[:3] = 0.5 * generator.standard_normal((3, 4))
    A[3, 3] = 1.7
    B = np.vstack([generator.standard_normal((3, 2)), np.zeros((1, 2))])
    change = (np.eye(4) + 0.3 * generator.standard_normal((4, 4))) @ np.diag(10.0 ** generator.uniform(-3, 3, 4))
    back = np.linalg.inv(change)
    modes = riccati.unstabilisable(change @ A @ back, change @ B, discrete=discrete)
    np.testing.assert_allclose(modes, [1.7], rtol=1e-6)
    modes = riccati.undetectable((change @ A @ back).T, (change @ B).T, discrete=discrete)
    np.testing.assert_allclose(modes, [1.7], rtol=1e-6)
    reached = B + np.eye(4)[:, 3:] @ np.ones((1, 2))
    assert riccati.unstabilisable(change @ A @ back, change @ reached, discrete=discrete).size == 0


# certificates


def test_certificate_of_the_regulator():
    """Item 7: S = Ac'S Ac + Q1 + K'Q2 K."""
    regulator = riccati.lqr(PHI, GAMMA, Q_1, Q_2, discrete=True)
    closed = PHI - GAMMA @ regulator.gain
    certificate = riccati.lyapunov_certificate(closed, regulator.cost, discrete=True)
    np.testing.assert_allclose(certificate.decrease, Q_1 + regulator.gain.T @ Q_2 @ regulator.gain, rtol=1e-12)
    assert certificate.proves
    assert "positive definite" in certificate.reason
    x = np.array([1.0, -2.0])
    for _ in range(5):  # along a trajectory
        after = closed @ x
        assert x @ certificate.matrix @ x - after @ certificate.matrix @ after == pytest.approx(
            x @ certificate.decrease @ x
        )
        x = after


def test_certificate_by_invariance():
    """A damped spring: its energy does not decrease while the mass rests, and yet it proves stability."""
    A = np.array([[0.0, 1.0], [-4.0, -0.3]])
    certificate = riccati.lyapunov_certificate(A, np.diag([4.0, 1.0]))
    np.testing.assert_allclose(certificate.decrease, np.diag([0.0, 0.6]), atol=1e-15)
    assert certificate.proves
    assert "invariance" in certificate.reason
    undamped = riccati.lyapunov_certificate(np.array([[0.0, 1.0], [-4.0, 0.0]]), np.diag([4.0, 1.0]))
    assert not undamped.proves
    assert "0 + 2i" in undamped.reason or "0 - 2i" in undamped.reason


@pytest.mark.parametrize(
    ("closed", "arguments", "reason"),
    [
        (np.diag([-1.0, 0.2]), {"matrix": np.eye(2)}, "grows somewhere"),
        (np.diag([-1.0, 0.2]), {}, "V is negative somewhere"),
        (np.diag([0.5, 1.0]), {"matrix": np.eye(2), "discrete": True}, "along the mode 1"),
        (np.diag([0.5, 1.2]), {"discrete": True}, "V is negative somewhere"),
    ],
)
def test_certificates_that_prove_nothing(closed, arguments, reason):
    certificate = riccati.lyapunov_certificate(closed, **arguments)
    assert not certificate.proves
    assert reason in certificate.reason


@FIXED
@given(seed=SEEDS, size=st.integers(1, 5), discrete=st.booleans())
def test_certificate_decides_stability(seed, size, discrete):
    A = np.random.default_rng(seed).standard_normal((size, size)) * (0.6 if discrete else 1.0)
    if not discrete:
        A -= np.eye(size)
    values = np.linalg.eigvals(A)
    margin = np.abs(values).max() - 1 if discrete else values.real.max()
    if abs(margin) < 1e-3:
        return
    assert riccati.lyapunov_certificate(A, discrete=discrete).proves == (margin < 0)


def test_bad_certificates():
    with pytest.raises(ProblemError, match="leave one out"):
        riccati.lyapunov_certificate(-np.eye(2), np.eye(2), decrease=np.eye(2))
    with pytest.raises(ProblemError, match="asymmetry"):
        riccati.lyapunov_certificate(-np.eye(2), np.array([[1.0, 0.5], [0.0, 1.0]]))
    with pytest.raises(ProblemError, match="add up to zero"):
        riccati.lyapunov_certificate(np.diag([-1.0, 1.0]))
