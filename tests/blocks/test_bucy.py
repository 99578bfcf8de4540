"""The continuous filter's rate, and discretisation."""

from __future__ import annotations

from math import factorial

import casadi as ca
import numpy as np
import pytest
from compiled import compile_function
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, GAMMA, NOISE, PHI, SEEDS, T, definite
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

from covocp import ProblemError
from covocp.blocks import kalman


def random_rate(seed, size, count):
    """E, F, M, Q, U and a cross density that goes with them."""
    generator = np.random.default_rng(seed)
    joint = definite(generator, size + count)
    E, F, M = (
        definite(generator, size),
        generator.standard_normal((size, size)),
        generator.standard_normal((count, size)),
    )
    return (E, F, M, joint[:size, :size], joint[size:, size:]), joint[:size, size:]


def test_scalar_riccati_equation():
    """de/dt = 2 f e + q - e^2/u from e(0) = 0: a hyperbolic tangent."""
    f, q, u = -1.0, 2.0, 0.5
    root = np.sqrt(f**2 + q / u)
    result = solve_ivp(lambda _, e: [kalman.rate(e[0], f, 1.0, q, u)], (0.0, 1.5), [0.0], rtol=1e-11, atol=1e-13)
    slope = np.tanh(1.5 * root)
    assert result.y[0, -1] == pytest.approx(q * slope / (root - f * slope), rel=1e-9)


@FIXED
@given(seed=SEEDS, size=st.integers(1, 4), count=st.integers(1, 3))
def test_best_gain_is_the_limit_of_discrete_updates(seed, size, count):
    """One short step with uncorrelated noise U/h: (P(h) - P(0)) / h goes to the rate."""
    (E, F, M, Q, U), _ = random_rate(seed, size, count)
    h = 1e-6
    after = kalman.update(np.zeros(size), E, np.zeros(count), M, U / h)[1]
    moved = kalman.predict(np.zeros(size), after, np.eye(size) + h * F, h * Q)[1]
    scale = np.abs(E @ M.T @ np.linalg.inv(U) @ M @ E).max() + np.abs(E).max()
    np.testing.assert_allclose((moved - E) / h, kalman.rate(E, F, M, Q, U), rtol=0, atol=1e-4 * scale**2)


@FIXED
@given(seed=SEEDS, size=st.integers(1, 4), count=st.integers(1, 3))
def test_no_gain_is_better_than_the_best(seed, size, count):
    """rate(K) - rate(best) = (K - K0) U (K - K0)', with correlated noises too."""
    (E, F, M, Q, U), cross = random_rate(seed, size, count)
    for c in (None, cross):
        best = (E @ M.T + (0 if c is None else c)) @ np.linalg.inv(U)
        away = np.random.default_rng(seed).standard_normal(best.shape)
        lowest = kalman.rate(E, F, M, Q, U, cross=c)
        np.testing.assert_allclose(kalman.rate(E, F, M, Q, U, gain=best, cross=c), lowest, rtol=1e-9, atol=1e-7)
        above = kalman.rate(E, F, M, Q, U, gain=best + away, cross=c) - lowest
        np.testing.assert_allclose(above, away @ U @ away.T, rtol=1e-7, atol=1e-7)


def test_correlated_noise_by_simulation_of_the_error():
    """dx = -x dt + n, m = x + v, <n v> = c: error of the filter with gain k obeys de = (-1 - k) e dt + n - k v."""
    q, u, c, k = 2.0, 1.0, 0.8, 0.7
    assert kalman.rate(0.3, -1.0, 1.0, q, u, gain=k, cross=c) == pytest.approx(
        2 * (-1 - k) * 0.3 + q - 2 * k * c + k**2 * u
    )


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("given_gain", [False, True])
def test_rate_expands(kind, given_gain):
    arguments, cross = random_rate(3, 3, 2)
    shapes = ((3, 3), (3, 3), (2, 3), (3, 3), (2, 2), (3, 2))
    names = ("E", "F", "M", "Q", "U", "C")
    symbols = [kind.sym(name, *shape) for name, shape in zip(names, shapes, strict=True)]
    gain = np.ones((3, 2)) if given_gain else None
    function = ca.Function("rate", symbols, [kalman.rate(*symbols[:5], cross=symbols[5], gain=gain)]).expand()
    expected = kalman.rate(*arguments, cross=cross, gain=gain)
    np.testing.assert_allclose(function(*arguments, cross), expected, rtol=1e-11)


def test_bad_arguments_of_rate():
    for change, message in (
        ({"Q": -1.0}, "'Q'"),
        ({"U": 0.0}, "'U'(?s:.)*positive definite"),
        ({"M": [[1.0, 2.0]]}, "'M'"),
        ({"gain": [1.0, 2.0]}, "'gain'"),
        ({"cross": 3.0}, "cross(?s:.)*positive semidefinite"),
    ):
        with pytest.raises(ProblemError, match=message):
            kalman.rate(**({"E": 1.0, "F": -1.0, "M": 1.0, "Q": 1.0, "U": 1.0} | change))
    assert kalman.rate(1.0, -1.0, 1.0, 1.0, 0.0, gain=0.0) == -1.0  # no measurement needs no inverse


def test_discretised_double_integrator():
    A, density = np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, 3.0])
    transition, noise = kalman.discretise(A, density, T)
    np.testing.assert_allclose(transition, PHI, atol=1e-15)
    np.testing.assert_allclose(noise, 3.0 * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]]), rtol=1e-14)
    # a held acceleration of the same power is not the same noise
    assert np.abs(noise - 3.0 / T * GAMMA @ GAMMA.T).max() == pytest.approx(3.0 * T**3 * (1 / 3 - 1 / 4))
    assert NOISE.shape == noise.shape


@pytest.mark.parametrize("step", [0.01, 1.0, 5.0])
def test_discretisation_by_quadrature(step):
    generator = np.random.default_rng(4)
    A, Q = generator.standard_normal((3, 3)) - np.eye(3), definite(generator, 3)
    transition, noise = kalman.discretise(A, Q, step)
    integral, _ = quad_vec(lambda s: expm(A * s) @ Q @ expm(A.T * s), 0.0, step, epsrel=1e-12)
    np.testing.assert_allclose(transition, expm(A * step), rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(noise, integral, rtol=1e-10)


def test_discretisation_of_a_stiff_system():
    """Van Loan's exponential alone would overflow: exp(1000)."""
    transition, noise = kalman.discretise(np.diag([-1000.0, -1.0]), np.eye(2), 1.0)
    np.testing.assert_allclose(transition, np.diag([0.0, np.exp(-1.0)]), atol=1e-15)
    np.testing.assert_allclose(noise, np.diag([1 / 2000.0, (1 - np.exp(-2.0)) / 2]), rtol=1e-12)


@pytest.mark.parametrize("size", [2, 4, 7, 12])
@pytest.mark.parametrize("step", [1e-4, 0.01, 1.0])
@pytest.mark.parametrize("unit", [1.0, 1e-5])
def test_chain_of_integrators_in_every_entry(size, step, unit):
    """Noise into the last of n integrators: h^(2n-1-i-j) / ((2n-1-i-j) (n-1-i)! (n-1-j)!), state i in units^i."""
    left = np.arange(size)[::-1]
    powers, sizes = left[:, None] + left + 1, np.array([factorial(k) for k in left.tolist()], dtype=float)
    units = unit ** np.arange(size)
    A, density = np.eye(size, k=1) * units[:, None] / units, np.zeros((size, size))
    density[-1, -1] = units[-1] ** 2
    transition, noise = kalman.discretise(A, density, step)
    expected = step**powers / powers / np.outer(sizes, sizes)
    np.testing.assert_allclose(noise / np.outer(units, units), expected, rtol=3e-14)
    lags = np.arange(size) - np.arange(size)[:, None]
    wanted = [[step**k / factorial(k) if k >= 0 else 0.0 for k in row] for row in lags.tolist()]
    np.testing.assert_allclose(transition / units[:, None] * units, wanted, rtol=1e-14)


@pytest.mark.parametrize("step", [1e-3, 0.1, 2.0])
def test_noise_through_a_lag_and_an_integrator(step):
    """dx = v, dv = -a v + n in closed form, by differences that are computed without cancellation."""
    a = 3.0
    z = a * step
    _, noise = kalman.discretise([[0.0, 1.0], [0.0, -a]], np.diag([0.0, 2.0]), step)
    series = [((-z) ** k * (4 - 2**k) / factorial(k)) for k in range(3, 60)]  # 2 z - 3 + 4 exp(-z) - exp(-2 z)
    position = sum(series) / a**3
    np.testing.assert_allclose(
        noise, [[position, (np.expm1(-z) / a) ** 2], [(np.expm1(-z) / a) ** 2, -np.expm1(-2 * z) / a]], rtol=1e-11
    )


def test_discretisation_does_not_depend_on_units():
    generator = np.random.default_rng(8)
    A, Q = generator.standard_normal((4, 4)), definite(generator, 4)
    units = 10.0 ** np.array([-6.0, 5.0, 0.0, -3.0])
    transition, noise = kalman.discretise(A, Q, 0.3)
    moved, other = kalman.discretise(A * units[:, None] / units, Q * np.outer(units, units), 0.3)
    np.testing.assert_allclose(moved, transition * units[:, None] / units, rtol=1e-12)
    np.testing.assert_allclose(other, noise * np.outer(units, units), rtol=1e-12)


@pytest.mark.parametrize(("size", "error"), [(1.0, 1e-15), (4.0, 2e-10), (16.0, 1e-4)])
@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_symbolic_discretisation_and_its_error(kind, size, error):
    A, Q, h = kind.sym("A", 3, 3), kind.sym("Q", 3, 3), kind.sym("h")
    function = ca.Function("discretise", [A, Q, h], list(kalman.discretise(A, Q, h))).expand()
    for seed in range(5):
        generator = np.random.default_rng(seed)
        matrix, density = generator.standard_normal((3, 3)), definite(generator, 3)
        matrix *= size / np.linalg.norm(matrix, 2)
        for value, exact in zip(function(matrix, density, 1.0), kalman.discretise(matrix, density, 1.0), strict=True):
            assert np.abs(value.full() - exact).max() <= 3 * error * max(1.0, np.abs(exact).max())
        noise = function(matrix, density, 1.0)[1].full()
        assert np.linalg.eigvalsh(noise)[0] > 0


@FIXED
@given(seed=SEEDS, size=st.integers(1, 4), length=st.floats(-6, 3))
def test_two_half_steps_are_a_step(seed, size, length):
    generator = np.random.default_rng(seed)
    A, Q, h = generator.standard_normal((size, size)) - 3 * np.eye(size), definite(generator, size), 10.0**length
    transition, noise = kalman.discretise(A, Q, h)
    half, part = kalman.discretise(A, Q, h / 2)
    scale = np.linalg.cond(A)
    np.testing.assert_allclose(half @ half, transition, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(part + half @ part @ half.T, noise, rtol=0, atol=1e-12 * scale * np.abs(noise).max())
    assert np.linalg.eigvalsh(noise)[0] >= -1e-14 * np.abs(noise).max()


def test_bad_arguments_of_discretise():
    for arguments, message in (
        ((np.eye(2), np.eye(2), 0.0), "step is not positive"),
        ((np.eye(2), -np.eye(2), 1.0), "'Q'"),
        ((np.ones((2, 3)), np.eye(2), 1.0), "'A'"),
    ):
        with pytest.raises(ProblemError, match=message):
            kalman.discretise(*arguments)


def rate_symbols():
    """The filter of the first-order lag and an unknown, as an expression of E and the state x."""
    E, x = ca.SX.sym("E", 2, 2), ca.SX.sym("x")
    return E, x, kalman.rate(E, ca.blockcat([[-1.0, -x], [0.0, 0.0]]), [1.0, 0.0], np.diag([0.3, 0.0]), 0.5)


@pytest.mark.needs_cc
def test_rate_as_c_code(tmp_path):
    E, x, slope = rate_symbols()
    function = ca.Function("rate", [E, x], [slope])
    code = compile_function(function, tmp_path)
    value = np.array([[0.4, -0.1], [-0.1, 2.0]])
    np.testing.assert_allclose(code(value, 0.7)[0], function(value, 0.7), rtol=1e-14)


def test_a_transition_that_overflows_is_refused():
    with pytest.raises(ProblemError, match="shorter steps"):
        kalman.discretise([[1.0]], [[1.0]], 1000.0)
