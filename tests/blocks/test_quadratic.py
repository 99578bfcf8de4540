"""The quadratic model of a function: its differences, its parameters, and how they move with the point."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, SEEDS, definite
from quadratics import packed, random_quadratic

from covocp import ProblemError
from covocp.blocks import peak_seeking


@FIXED
@given(seed=SEEDS, inputs=st.integers(1, 5))
def test_regressor_times_parameters_is_the_difference_of_a_quadratic(seed, inputs):
    M, b, f = random_quadratic(seed, inputs)
    point, step = np.random.default_rng(seed + 1).standard_normal((2, inputs))
    zeta = packed(M, b + M @ point)
    difference = f(point + step) - f(point)
    assert peak_seeking.regressor(step) @ zeta == pytest.approx(difference, abs=1e-12 * (1 + abs(f(point))) * inputs**2)
    symbol = ca.SX.sym("step", inputs)
    expression = ca.Function("h", [symbol], [peak_seeking.regressor(symbol)])
    np.testing.assert_allclose(expression(step).full().ravel(), peak_seeking.regressor(step), rtol=1e-15)


@pytest.mark.parametrize(("inputs", "size"), [(1, 2), (2, 5), (3, 9), (4, 14)])
def test_layout(inputs, size):
    M, b, _ = random_quadratic(3, inputs)
    zeta, layout = packed(M, b), peak_seeking.parameters(inputs)
    assert layout.size == size
    np.testing.assert_array_equal(zeta[layout.hessian], M)
    np.testing.assert_array_equal(zeta[layout.gradient], b)
    many = np.stack([zeta, 2 * zeta])
    np.testing.assert_array_equal(peak_seeking.hessian(many), np.stack([M, 2 * M]))
    np.testing.assert_array_equal(peak_seeking.gradient(many), np.stack([b, 2 * b]))
    symbol = ca.MX.sym("zeta", size)
    parts = ca.Function("parts", [symbol], [peak_seeking.hessian(symbol), peak_seeking.gradient(symbol)])
    np.testing.assert_array_equal(parts(zeta)[0].full(), M)
    np.testing.assert_array_equal(parts(zeta)[1].full().ravel(), b)
    np.testing.assert_array_equal(peak_seeking.gradient(ca.DM(zeta)), b)


@FIXED
@given(seed=SEEDS, inputs=st.integers(1, 4))
def test_transport_is_exact(seed, inputs):
    M, b, _ = random_quadratic(seed, inputs)
    step = np.random.default_rng(seed + 1).standard_normal(inputs)
    zeta = packed(M, b)
    P = definite(np.random.default_rng(seed), zeta.size)
    moved, around = peak_seeking.transport(zeta, P, step)
    np.testing.assert_allclose(peak_seeking.hessian(moved), M, rtol=0, atol=0)
    np.testing.assert_allclose(peak_seeking.gradient(moved), b + M @ step, rtol=0, atol=1e-14 * inputs * 10)
    # its covariance by the differences of the map itself, which is linear
    F = np.array([peak_seeking.transport(column, P, step)[0] for column in np.eye(zeta.size)]).T
    np.testing.assert_allclose(around, F @ P @ F.T, rtol=1e-12, atol=1e-12)
    back, restored = peak_seeking.transport(moved, around, -step)
    np.testing.assert_allclose(back, zeta, atol=1e-13)
    np.testing.assert_allclose(restored, P, rtol=1e-10, atol=1e-10)


def test_transport_of_expressions_and_its_noise():
    zeta, P, step = np.arange(5.0), np.diag([1.0, 2.0, 3.0, 4.0, 5.0]), np.array([0.5, -2.0])
    expected = peak_seeking.transport(zeta, P, step, noise=[1.0, 2.0, 3.0, 4.0, 5.0])
    plain = peak_seeking.transport(zeta, P, step)
    np.testing.assert_allclose(expected[1] - plain[1], np.diag([1.0, 2.0, 3.0, 4.0, 5.0]), atol=1e-14)
    np.testing.assert_allclose(
        peak_seeking.transport(zeta, P, step, noise=2.0)[1] - plain[1], 2 * np.eye(5), atol=1e-14
    )
    for kind in (ca.SX, ca.MX):
        symbols = [kind.sym("zeta", 5), kind.sym("P", 5, 5), kind.sym("step", 2), kind.sym("W", 5, 5)]
        results = peak_seeking.transport(*symbols[:3], noise=symbols[3])
        found = ca.Function("transport", symbols, list(results))(zeta, P, step, np.diag([1.0, 2.0, 3.0, 4.0, 5.0]))
        for value, reference in zip(found, expected, strict=True):
            np.testing.assert_allclose(value.full().reshape(reference.shape), reference, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda: peak_seeking.parameters(0), "'n'"),
        (lambda: peak_seeking.hessian(np.zeros(4)), "'zeta'"),
        (lambda: peak_seeking.regressor([1.0, np.inf]), "'step'"),
        (lambda: peak_seeking.regressor(np.zeros((2, 2))), "'step'"),
        (lambda: peak_seeking.transport(np.zeros(5), np.eye(5), [1.0]), "'step'"),
        (lambda: peak_seeking.transport(np.zeros(5), -np.eye(5), [1.0, 1.0]), "'covariance'"),
        (lambda: peak_seeking.transport(np.zeros(5), np.eye(4), [1.0, 1.0]), "'covariance'"),
        (lambda: peak_seeking.transport(np.zeros(5), np.eye(5), [1.0, 1.0], noise=[1.0, 2.0]), "'noise'"),
        (lambda: peak_seeking.transport(np.zeros(5), np.eye(5), [1.0, 1.0], noise=-1.0), "'noise'"),
    ],
)
def test_wrong_arguments_are_named(call, argument):
    with pytest.raises(ProblemError, match=argument):
        call()


def test_ramp_and_excitation():
    """After a period the command has moved by the increment; numbers and expressions alike, wrong shapes named."""
    command = np.array([1.0, -2.0])
    for _ in range(10):
        command = peak_seeking.ramp(command, [0.5, 1.0], period=2.0, step=0.2)
    np.testing.assert_allclose(command, [1.5, -1.0], atol=1e-14)
    symbol = ca.SX.sym("command", 2)
    moved = ca.Function("moved", [symbol], [peak_seeking.ramp(symbol, ca.DM([1.0, 2.0]), period=4.0, step=1.0)])
    np.testing.assert_allclose(moved([0.0, 0.0]).full().ravel(), [0.25, 0.5])
    with pytest.raises(ProblemError, match="'increment'"):
        peak_seeking.ramp([0.0, 0.0], [1.0, 1.0, 1.0], period=1.0, step=0.1)
    t = ca.SX.sym("t")
    wave = peak_seeking.sine(t, 2.0, 8.0, start=1.0, end=9.0)
    circle = peak_seeking.circle(t, 0.7, 120.0, end=60.0)
    both = ca.Function("both", [t], [wave, circle])
    for time, expected in ((0.5, 0.0), (3.0, 2.0), (7.0, -2.0), (9.5, 0.0)):
        assert peak_seeking.sine(time, 2.0, 8.0, start=1.0, end=9.0) == pytest.approx(expected, abs=1e-14)
        assert float(both(time)[0]) == pytest.approx(expected, abs=1e-14)
    np.testing.assert_allclose(
        peak_seeking.circle([0.0, 30.0, 61.0], 0.7, 120.0, end=60.0), [[0, 0.7], [0.7, 0], [0, 0]], atol=1e-15
    )
    np.testing.assert_allclose(both(30.0)[1].full().ravel(), [0.7, 0.0], atol=1e-15)
