"""Modes that are reached or not, whatever the units and however far the rates of a plant are apart."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, SEEDS, by_doubling
from scipy.linalg import expm

from covocp import ProblemError
from covocp.blocks import kalman, riccati


def sampled(A, B, step):
    """Transition and input matrix of a step, u held."""
    n, m = np.shape(B)
    block = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * step)
    return block[:n, :n], block[:n, n:]


@pytest.mark.parametrize("step", [0.02, 0.03, 1.0])
def test_a_position_behind_a_fast_actuator_is_reached(step):
    """A lag of 1 ms, of which next to nothing is left after a step: the mode 1 has the left eigenvector (1, 1e-3)."""
    F, G = sampled(np.array([[0.0, 1.0], [0.0, -1000.0]]), np.array([[0.0], [1000.0]]), step)
    np.testing.assert_allclose([1.0, 1e-3] @ G, step)
    assert riccati.unstabilisable(F, G, discrete=True).size == 0
    regulator = riccati.lqr(F, G, np.eye(2), 1.0, discrete=True)
    np.testing.assert_allclose(regulator.cost, by_doubling(F, G, np.eye(2), np.eye(1)), rtol=1e-9)


def test_a_slow_unstable_mode_behind_a_fast_lag():
    """x1' = 1e-8 x1 + x2: as of a lag without delay, K = (1, root 2 - 1) to a part in the rate of the lag."""
    A, B = np.array([[1e-8, 1.0], [0.0, -1000.0]]), np.array([[0.0], [1000.0]])
    assert riccati.unstabilisable(A, B).size == 0
    gain = riccati.lqr(A, B, np.diag([1.0, 0.0]), 1.0).gain
    np.testing.assert_allclose(gain, [[1.0, 1e-3]], rtol=1e-3)


@pytest.mark.parametrize("tau", [3.0, 1.0, 0.1])
def test_a_manoeuvring_target_scanned_slowly(tau):
    """Position, speed and an acceleration that is correlated over tau, every 30 s."""
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / tau]])
    transition, noise = kalman.discretise(A, np.diag([0.0, 0.0, 2.0 / tau]), 30.0)
    steady = kalman.steady_state(transition, [1.0, 0.0, 0.0], noise, 1e4)
    truth = by_doubling(transition.T, np.eye(3)[:, :1], noise, np.array([[1e4]]))
    np.testing.assert_allclose(np.diag(steady.prior), np.diag(truth), rtol=1e-8)


@FIXED
@given(seed=SEEDS, size=st.integers(2, 8), step=st.sampled_from([None, 0.03, 1.0]))
def test_chains_of_lags_are_reached(seed, size, step):
    """Rates and links many orders apart, in any units: each state drives the next, and the last one has an input."""
    generator = np.random.default_rng(seed)
    rates = 10.0 ** (generator.uniform(-6, 6, size) if step is None else generator.uniform(-1, 3, size))
    A = np.eye(size, k=1) * 10.0 ** generator.uniform(-3, 3, (size, 1)) - np.diag(rates)
    A[0, 0], B = 0.0, rates[-1] * np.eye(size)[:, -1:]
    if step is not None:
        A, B = sampled(A[-4:, -4:], B[-4:], step)
    units = 10.0 ** generator.uniform(-6, 6, len(A))
    modes = riccati.unstabilisable(A * units / units[:, None], B / units[:, None], discrete=step is not None)
    assert modes.size == 0


@pytest.mark.parametrize("link", [1e-30, 1e4])
def test_a_long_chain_whose_units_are_beyond_all_numbers(link):
    A, B = link * np.eye(40, k=1) - np.diag(np.arange(40.0)), np.eye(40)[:, -1:]
    assert riccati.unstabilisable(A, B).size == 0
    A[20] *= np.arange(40) == 20
    np.testing.assert_array_equal(riccati.unstabilisable(A, B), [0.0])


@pytest.mark.parametrize("fast", [1e3, 1e8, 1e13])
def test_two_modes_behind_one_fast_actuator(fast):
    """They are reached both where they differ, and where they are equal only their sum is."""
    B = np.array([[0.0], [0.0], [fast]])
    assert riccati.unstabilisable([[1.0, 0.0, 1.0], [0.0, 2.0, 1.0], [0.0, 0.0, -fast]], B).size == 0
    np.testing.assert_allclose(
        riccati.unstabilisable([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, -fast]], B)[0], 1.0, rtol=1e-9
    )


@pytest.mark.parametrize("unit", [1.0, 1e-12, 1e12, 1e19])
def test_units_of_states_that_nothing_links(unit):
    assert riccati.unstabilisable(np.diag([2.0, -1.0]), [1.0, unit]).size == 0
    assert riccati.unstabilisable(np.diag([2.0, -1.0]), [unit, 1.0]).size == 0
    np.testing.assert_array_equal(riccati.unstabilisable(np.diag([2.0, -1.0]), [0.0, unit]), [2.0])
    np.testing.assert_array_equal(riccati.unstabilisable([[2.0, 0.0], [unit, -1.0]], [0.0, 1.0]), [2.0])


@FIXED
@given(seed=SEEDS)
def test_an_unreached_mode_is_found_in_numerical_modal_coordinates(seed):
    """What rounding leaves of its entries couples it to the others, by nothing but rounding."""
    generator = np.random.default_rng(seed)
    T = np.linalg.qr(generator.standard_normal((4, 4)))[0]
    A, B = T @ np.diag([1.7, -0.3, 0.4, 0.8]) @ T.T, T @ np.array([[0.0], [1.0], [1.0], [1.0]])
    vectors = np.linalg.eig(A)[1]
    back = np.linalg.inv(vectors)
    np.testing.assert_allclose(riccati.unstabilisable(back @ A @ vectors, back @ B, discrete=True), [1.7], rtol=1e-12)


@pytest.mark.parametrize(("size", "far"), [(3, 0), (4, 0), (6, 3), (6, 9), (12, 6), (20, 6)])
def test_an_unreached_mode_in_blocks_of_numerical_modes(size, far):
    """In any units, powers of two: what the change of coordinates leaves beside B is cond V roundings, no input."""
    for seed in range(6, 14) if far else (13, 32, 34, 46, 60):
        generator = np.random.default_rng(seed)
        A, B = np.full((size, size), 0.0), np.zeros((size, 1))
        A[:-1, :-1], A[:-1, -1] = generator.standard_normal((size - 1, size - 1)), generator.standard_normal(size - 1)
        A[-1, -1], B[:-1] = 0.7, generator.standard_normal((size - 1, 1))
        T = np.linalg.qr(generator.standard_normal((size, size)))[0]
        A, B = T @ A @ T.T, T @ B
        vectors = np.linalg.eig(A)[1]
        vectors = vectors.real + vectors.imag
        A, B = np.linalg.solve(vectors, A @ vectors), np.linalg.solve(vectors, B)
        units = 2.0 ** np.round(generator.uniform(-far, far, size) * np.log2(10.0))
        modes = riccati.unstabilisable(A * units[:, None] / units, B * units[:, None])
        np.testing.assert_allclose(modes, [0.7], rtol=1e-9)


@pytest.mark.parametrize("feedback", [1e-12, 1e-6, 1.0])
@pytest.mark.parametrize("fast", [1e2, 1e5, 1e8])
@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_a_position_that_moves_its_fast_actuator(feedback, fast, unit):
    """x1' = x2, x2' = fast (u - x2 - feedback x1): weakly linked back, and yet reached."""
    A, B = np.array([[1e-9, unit], [-feedback * fast / unit, -fast]]), np.array([[0.0], [fast / unit]])
    assert riccati.unstabilisable(A, B).size == 0
    F, G = sampled(A, B, 20.0 / fast)
    assert riccati.unstabilisable(F, G, discrete=True).size == 0


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
def test_a_clock_in_any_unit_of_its_phase(unit):
    """Phase and frequency; rounding of the variance of the one in ns is more than the whole of the other's."""
    step, q1, q2, noise = 1.0, 1e-21, 1e-31, 1e-17
    W = np.array([[q1 * step + q2 * step**3 / 3, q2 * step**2 / 2], [q2 * step**2 / 2, q2 * step]])
    units = np.diag([unit, 1.0])
    steady = kalman.steady_state([[1.0, step * unit], [0.0, 1.0]], [1.0, 0.0], units @ W @ units, noise * unit**2)
    truth = by_doubling(np.array([[1.0, 0.0], [step, 1.0]]), np.array([[1.0], [0.0]]), W, np.array([[noise]]))
    np.testing.assert_allclose(steady.prior, units @ truth @ units, rtol=1e-7)


def test_what_two_large_weights_leave_is_no_weight():
    """Q - N R^-1 N' of an integrator is rounding of its terms: its mode has no weight."""
    N, R = np.array([[0.1], [0.7]]), np.array([[0.3]])
    Q = N @ N.T / R + np.diag([0.0, 1.0])
    with pytest.raises(ProblemError, match=r"mode 0, which Q gives no weight"):
        riccati.lqr(np.diag([0.0, -1.0]) + np.array([[1.0], [1.0]]) @ N.T / R, [1.0, 1.0], Q, R, cross=N)


def test_lyapunov_equation_with_a_mode_that_is_all_but_zero():
    """X = the sum of A^k A'^k; the squares of the units that balance A would overflow."""
    small = np.exp(-700.0)
    X = riccati.lyapunov([[0.5, 0.001], [0.0, small]], np.eye(2), discrete=True)
    np.testing.assert_allclose(X, [[(1 + 1e-6) / 0.75, 0.001 * small], [0.001 * small, 1.0]], rtol=1e-12)


def test_stable_modes_far_apart_that_a_large_number_links():
    """Only the modes of a triangular matrix say whether it is stable, not what is beside them."""
    certificate = riccati.lyapunov_certificate([[-1e-3, 1e12], [0.0, -1.0]])
    assert certificate.proves
    assert riccati.unstabilisable([[-1e-3, 1e12], [0.0, -1.0]], [0.0, 0.0]).size == 0


@pytest.mark.parametrize("far", [0, 6])
@pytest.mark.parametrize("seed", range(20))
def test_sampled_noise_that_misses_an_integrator(seed, far):
    """In turned coordinates and mixed units: its variance is the rounding of the terms that it is the sum of."""
    generator = np.random.default_rng(seed)
    size, step = int(generator.integers(2, 7)), 10.0 ** generator.uniform(-3, 0)
    A, G = 0.4 * generator.standard_normal((size, size)), generator.standard_normal((size, 1))
    A[-1], G[-1] = 0.0, 0.0
    T = np.linalg.qr(generator.standard_normal((size, size)))[0]
    units = 2.0 ** generator.integers(-3 * far, 3 * far + 1, size)
    transition, noise = kalman.discretise(T @ A @ T.T, T @ G @ G.T @ T.T, step)
    transition, noise = transition * units / units[:, None], noise / units / units[:, None]
    with pytest.raises(ProblemError, match="does not excite"):
        kalman.steady_state(transition, generator.standard_normal(size), noise, 1.0)
