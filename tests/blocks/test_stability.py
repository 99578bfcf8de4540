"""Stability: modes that no input reaches, and certificates by quadratic functions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, GAMMA, PHI, Q_1, Q_2, SEEDS
from scipy import linalg

from covocp import ProblemError
from covocp.blocks import kalman, riccati


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


# modes in general coordinates: what the numbers hold of a mode that is not seen is rounding


def turned(seed, size):
    """A random rotation."""
    return np.linalg.qr(np.random.default_rng(seed).standard_normal((size, size)))[0]


def three_masses(m=1.7, k=3.0, d=0.45):
    """Equal masses between walls, a damper in the node of the antisymmetric mode: A, energy, frequency of that mode."""
    stiffness = k * np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 2.0]])
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-stiffness / m, -np.diag([0.0, d, 0.0]) / m]])
    return A, linalg.block_diag(stiffness, m * np.eye(3)) / 2, np.sqrt(2 * k / m)


@pytest.mark.parametrize("step", [None, 0.02, 0.1])
def test_energy_does_not_prove_that_an_undamped_mode_decays(step):
    A, energy, frequency = three_masses()
    A = A if step is None else linalg.expm(A * step)
    certificate = riccati.lyapunov_certificate(A, energy, discrete=step is not None)
    assert not certificate.proves
    mode = 1j * frequency if step is None else np.exp(1j * frequency * step)
    assert f"{abs(mode.imag):.6g}" in certificate.reason


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("discrete", [False, True])
def test_an_undamped_mode_in_turned_coordinates_is_not_proved_stable(seed, discrete):
    Q = turned(seed, 3)
    A = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    A = Q @ (linalg.expm(0.1 * A) if discrete else A) @ Q.T
    assert not riccati.lyapunov_certificate(A, np.eye(3), discrete=discrete).proves


UNWEIGHTED = {
    "oscillator": ([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], [0.0, 0.0, 1.0]),
    "unstable mode": ([[0.5, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -2.0]], [0.0, 1.0, 1.0]),
    "integrator": ([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -2.0]], [0.0, 1.0, 1.0]),
    "double integrator, speed alone": ([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]], [0.0, 1.0, 1.0]),
}


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("case", UNWEIGHTED)
def test_modes_without_weight_are_refused_in_turned_coordinates(case, seed):
    A, weights = UNWEIGHTED[case]
    Q = turned(seed, 3)
    A, B, W = Q @ np.array(A) @ Q.T, Q @ np.ones((3, 1)), Q @ np.diag(weights) @ Q.T
    W = (W + W.T) / 2
    with pytest.raises(ProblemError, match="not detectable"):
        riccati.lqr(A, B, W, 1.0)
    with pytest.raises(ProblemError, match="not stabilisable"):
        kalman.steady_state(A.T, B.T, W, 1.0, discrete=False)
    if case != "unstable mode":  # that one has a stabilising solution
        with pytest.raises(ProblemError, match="not detectable"):
            riccati.continuous(A, B, W, 1.0)


def test_sampled_noise_does_not_excite_what_is_not_driven():
    """A force on the middle mass, noise sampled: what is left of the antisymmetric mode is rounding."""
    A, _, frequency = three_masses()
    force = np.zeros((6, 1))
    force[4] = 1.0
    transition, noise = kalman.discretise(A, force @ force.T, 0.02)
    with pytest.raises(ProblemError, match="does not excite") as caught:
        kalman.steady_state(transition, [1.0, 0, 0, 0, 0, 0], noise, 0.01)
    assert f"{np.cos(0.02 * frequency):.6g}" in str(caught.value)


@pytest.mark.parametrize(("m1", "m2", "k", "c"), [(1.0, 1.0, 1.0, 0.0), (1.3, 2.7, 10.0, 0.2), (2.0, 3.0, 50.0, 1.0)])
@pytest.mark.parametrize("step", [None, 0.1])
def test_rigid_motion_of_which_only_the_speed_is_seen(m1, m2, k, c, step):
    """Two masses and a spring: the mode 0 is double and defective, and known to 1e-8 only."""
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-k / m1, k / m1, -c / m1, c / m1], [k / m2, -k / m2, c / m2, -c / m2]])
    A = A if step is None else linalg.expm(A * step)
    H, discrete = np.eye(4)[2:], step is not None
    np.testing.assert_allclose(riccati.undetectable(A, H, discrete=discrete), [float(discrete)], atol=1e-9)
    with pytest.raises(ProblemError, match="not detectable"):
        riccati.lqr(A, np.array([0, 0, 1 / m1, 0]), H.T @ H, 1.0, discrete=discrete)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("size", [2, 3])
def test_the_last_of_a_chain_is_found_unreached(seed, size):
    """A mode of multiplicity n, whose last state no input reaches, in any coordinates."""
    A, B = 0.1 * np.eye(size) + np.eye(size, k=1), np.eye(size)[:, [size - 2]]
    change = np.random.default_rng(seed).standard_normal((size, size))
    modes = riccati.unstabilisable(change @ A @ np.linalg.inv(change), change @ B)
    assert modes.size
    assert np.abs(modes - 0.1).min() < 1e-3


def test_one_measurement_may_be_a_row():
    assert riccati.undetectable(np.diag([1.0, -1.0]), [0.0, 1.0]).size == 1
    assert riccati.undetectable(np.diag([1.0, -1.0]), [1.0, 0.0]).size == 0


@pytest.mark.parametrize("fast", [1e5, 1e7])
def test_a_slow_stable_mode_beside_a_fast_one(fast):
    """An amplifier and a disturbance of 1000 s that it does not reach, but that decays by itself."""
    A, B = np.array([[-fast, 1.0], [0.0, -1e-3]]), np.array([[fast], [0.0]])
    assert riccati.unstabilisable(A, B).size == 0
    np.testing.assert_allclose(riccati.lqr(A, B, np.eye(2), 1.0).eigenvalues, [-np.sqrt(2) * fast, -1e-3], rtol=1e-9)
    slow = np.diag([0.5, np.exp(-1e-6 / 1100)])  # sampled each microsecond
    assert riccati.unstabilisable(slow, [1.0, 0.0], discrete=True).size == 0


# certificates in mixed units


@pytest.mark.parametrize("large", [1e13, 1e16])
@pytest.mark.parametrize("discrete", [False, True])
def test_an_unstable_mode_in_large_units_is_not_proved_stable(large, discrete):
    A = np.diag([0.5, 1.1]) if discrete else np.diag([-1.0, 1.0])
    certificate = riccati.lyapunov_certificate(A, np.diag([large, -1.0]), discrete=discrete)
    assert not certificate.proves
    assert "V is negative somewhere" in certificate.reason


@FIXED
@given(seed=SEEDS, stable=st.booleans(), discrete=st.booleans())
def test_certificates_do_not_depend_on_units(seed, stable, discrete):
    generator = np.random.default_rng(seed)
    A = generator.standard_normal((4, 4))
    if discrete:
        A *= (0.8 if stable else 1.2) / np.abs(np.linalg.eigvals(A)).max()
    else:
        A -= (np.linalg.eigvals(A).real.max() + (0.3 if stable else -0.3)) * np.eye(4)
    units = 10.0 ** generator.uniform(-5, 5, 4)
    scaled = A * units / units[:, None]
    certificate = riccati.lyapunov_certificate(scaled, decrease=np.diag(units**2), discrete=discrete)
    assert certificate.proves == stable
    again = riccati.lyapunov_certificate(scaled, certificate.matrix, discrete=discrete)
    assert again.proves == stable


@FIXED
@given(seed=SEEDS, discrete=st.booleans())
def test_regulators_do_not_depend_on_units(seed, discrete):
    generator = np.random.default_rng(seed)
    A, B = (0.5 if discrete else 1.0) * generator.standard_normal((4, 4)), generator.standard_normal((4, 2))
    units = 2.0 ** generator.integers(-18, 18, 4)
    here = riccati.lqr(A, B, np.eye(4), np.eye(2), discrete=discrete)
    there = riccati.lqr(A * units / units[:, None], B / units[:, None], np.diag(units**2), np.eye(2), discrete=discrete)
    np.testing.assert_allclose(there.gain / units, here.gain, rtol=1e-9, atol=1e-11)
    closed = A * units / units[:, None] - B / units[:, None] @ there.gain
    assert riccati.lyapunov_certificate(closed, there.cost, discrete=discrete).proves


@FIXED
@given(seed=SEEDS, discrete=st.booleans())
def test_lyapunov_solutions_do_not_depend_on_units(seed, discrete):
    generator = np.random.default_rng(seed)
    A = generator.standard_normal((3, 3))
    A = 0.3 * A if discrete else A - 4.0 * np.eye(3)
    units = 2.0 ** generator.integers(-18, 18, 3)
    X = riccati.lyapunov(A, np.eye(3), discrete=discrete)
    Y = riccati.lyapunov(A / units * units[:, None], np.diag(units**2), discrete=discrete)
    np.testing.assert_allclose(Y / units / units[:, None], X, rtol=1e-9, atol=1e-11)
