"""Recursive least squares against the batch solution, and its dictionary to the Kalman filter."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from compiled import compile_function
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, SEEDS, definite

from covocp import ProblemError
from covocp.blocks import kalman


def samples(seed, count, size, outputs):
    """Regressors (N, n, p), outputs (N, p) and a weight (p, p)."""
    generator = np.random.default_rng(seed)
    return (
        generator.standard_normal((count, size, outputs)),
        generator.standard_normal((count, outputs)),
        definite(generator, outputs, 10.0),
    )


def batch(regressors, outputs, forgetting, weight):
    """Item 2: P = (Phi'W Phi)^-1, theta = P Phi'W Y, with the full weight matrix."""
    count = len(outputs)
    phi = np.vstack([regressor.T for regressor in regressors])
    W = np.kron(np.diag(forgetting ** np.arange(count - 1, -1, -1.0)), weight)
    P = np.linalg.inv(phi.T @ W @ phi)
    return P @ phi.T @ W @ outputs.ravel(), P


@FIXED
@given(seed=SEEDS, size=st.integers(1, 4), outputs=st.integers(1, 3), forgetting=st.floats(0.8, 1.0))
def test_recursion_equals_batch(seed, size, outputs, forgetting):
    regressors, y, weight = samples(seed, 20, size, outputs)
    options = {"forgetting": forgetting, "weight": weight}
    first = kalman.least_squares_start(regressors[:8], y[:8], **options)
    np.testing.assert_allclose(first[1], batch(regressors[:8], y[:8], forgetting, weight)[1], rtol=1e-6, atol=1e-9)
    estimate, covariance = first
    for regressor, output in zip(regressors[8:], y[8:], strict=True):
        estimate, covariance = kalman.recursive_least_squares(estimate, covariance, regressor, output, **options)
    theta, P = batch(regressors, y, forgetting, weight)
    np.testing.assert_allclose(covariance, P, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(estimate, theta, rtol=1e-6, atol=1e-8)


def test_scalar_output_with_flat_arrays():
    regressors, y, _ = samples(1, 6, 3, 1)
    estimate, covariance = kalman.least_squares_start(regressors[:5, :, 0], y[:5, 0], weight=0.3)
    estimate, covariance = kalman.recursive_least_squares(
        estimate, covariance, regressors[5, :, 0], y[5, 0], weight=0.3
    )
    theta, P = batch(regressors, y, 1.0, 0.3 * np.eye(1))
    np.testing.assert_allclose(estimate, theta, rtol=1e-11)
    np.testing.assert_allclose(covariance, P, rtol=1e-11)
    assert estimate.shape == (3,)


@FIXED
@given(seed=SEEDS, forgetting=st.floats(0.5, 1.0))
def test_information_form_of_the_sample(seed, forgetting):
    """P+^-1 = gamma P^-1 + phi a phi'."""
    regressors, y, weight = samples(seed, 1, 3, 2)
    P = definite(np.random.default_rng(seed), 3)
    after = kalman.recursive_least_squares(np.zeros(3), P, regressors[0], y[0], forgetting=forgetting, weight=weight)[1]
    information = forgetting * np.linalg.inv(P) + regressors[0] @ weight @ regressors[0].T
    np.testing.assert_allclose(np.linalg.inv(after), information, rtol=1e-7, atol=1e-8)


def test_running_mean():
    """A constant regressor, ordinary weights: the mean, and 1/N."""
    y = np.array([3.0, -1.0, 4.0, 1.0, -5.0])
    estimate, covariance = kalman.least_squares_start(np.ones((1, 1)), y[:1])
    for k, value in enumerate(y[1:], 2):
        estimate, covariance = kalman.recursive_least_squares(estimate, covariance, [1.0], value)
        assert estimate[0] == pytest.approx(y[:k].mean())
        assert covariance[0, 0] == pytest.approx(1 / k)


def test_exponential_forgetting_is_a_first_order_filter():
    """a = 1 - gamma: in the long run P = 1 and theta+ = gamma theta + (1 - gamma) y."""
    g = 0.9
    estimate, covariance = kalman.recursive_least_squares(2.0, 1.0, 1.0, 5.0, forgetting=g, weight=1 - g)
    assert covariance == pytest.approx(1.0)
    assert estimate == pytest.approx(g * 2.0 + (1 - g) * 5.0)


def test_diffuse_start():
    """theta = 0, P = alpha I is a batch with one more, weak equation for each parameter."""
    regressors, y, weight = samples(3, 9, 3, 2)
    estimate, covariance = kalman.diffuse_start(3, 1e4)
    for regressor, output in zip(regressors, y, strict=True):
        estimate, covariance = kalman.recursive_least_squares(estimate, covariance, regressor, output, weight=weight)
    phi = np.vstack([regressor.T for regressor in regressors])
    W = np.kron(np.eye(9), weight)
    P = np.linalg.inv(phi.T @ W @ phi + 1e-4 * np.eye(3))
    np.testing.assert_allclose(covariance, P, rtol=1e-7)
    np.testing.assert_allclose(estimate, P @ phi.T @ W @ y.ravel(), rtol=1e-7)


@FIXED
@given(seed=SEEDS, forgetting=st.floats(0.5, 1.0), outputs=st.integers(1, 3))
@pytest.mark.parametrize("form", ["joseph", "standard", "sequential", "information"])
def test_dictionary_to_the_filter(form, seed, forgetting, outputs):
    """Item 3: theta -> x, phi' -> H, P/gamma -> M, a^-1 -> R."""
    regressors, y, weight = samples(seed, 1, 3, outputs)
    theta, P = np.random.default_rng(seed).standard_normal(3), definite(np.random.default_rng(seed), 3)
    squares = kalman.recursive_least_squares(theta, P, regressors[0], y[0], forgetting=forgetting, weight=weight)
    filtered = kalman.update(theta, P / forgetting, y[0], regressors[0].T, np.linalg.inv(weight), form=form)
    for one, two in zip(squares, filtered, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-8, atol=1e-9)


def test_formulas_as_printed():
    """Item 2, with the inverse that the notes lack, one scalar output."""
    theta, P, phi, y, g, a = (
        np.array([1.0, -1.0]),
        np.array([[2.0, 0.5], [0.5, 1.0]]),
        np.array([0.3, 2.0]),
        1.5,
        0.9,
        0.7,
    )
    L = P / g @ phi / (1 / a + phi @ P / g @ phi)
    estimate, covariance = kalman.recursive_least_squares(theta, P, phi, y, forgetting=g, weight=a)
    np.testing.assert_allclose(estimate, theta + L * (y - phi @ theta), rtol=1e-13)
    np.testing.assert_allclose(covariance, P / g - np.outer(L, phi @ P / g), rtol=1e-13)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_symbols_expand(kind):
    regressors, y, weight = samples(5, 1, 3, 2)
    shapes = {"theta": (3, 1), "P": (3, 3), "phi": (3, 2), "y": (2, 1), "g": (1, 1), "a": (2, 2)}
    symbols = [kind.sym(name, *shape) for name, shape in shapes.items()]
    result = kalman.recursive_least_squares(*symbols[:4], forgetting=symbols[4], weight=symbols[5], missing="skip")
    function = ca.Function("rls", symbols, list(result)).expand()
    P = definite(np.random.default_rng(0), 3)
    for reading in (y[0], np.array([y[0, 0], np.nan])):
        expected = kalman.recursive_least_squares(
            np.ones(3), P, regressors[0], reading, forgetting=0.9, weight=weight, missing="skip"
        )
        for one, two in zip(function(np.ones(3), P, regressors[0], reading, 0.9, weight), expected, strict=True):
            np.testing.assert_allclose(one.full().squeeze(), two, rtol=1e-11)


@pytest.mark.needs_cc
def test_c_code(tmp_path):
    regressors, y, _ = samples(6, 1, 3, 1)
    shapes = {"theta": (3, 1), "P": (3, 3), "phi": (3, 1), "y": (1, 1)}
    symbols = [ca.SX.sym(name, *shape) for name, shape in shapes.items()]
    function = ca.Function("rls", symbols, list(kalman.recursive_least_squares(*symbols, forgetting=0.98)))
    code = compile_function(function, tmp_path)
    P = definite(np.random.default_rng(0), 3)
    expected = kalman.recursive_least_squares(np.ones(3), P, regressors[0], y[0], forgetting=0.98)
    for one, two in zip(code(np.ones(3), P, regressors[0], y[0]), expected, strict=True):
        np.testing.assert_allclose(one.squeeze(), two, rtol=1e-12)


def test_missing_outputs():
    regressors, y, weight = samples(7, 12, 3, 2)
    gaps = y.copy()
    gaps[5, 0] = gaps[9] = np.nan
    estimate, covariance = kalman.least_squares_start(regressors, gaps, forgetting=0.9, weight=weight, missing="skip")
    recursion = kalman.least_squares_start(regressors[:4], gaps[:4], forgetting=0.9, weight=weight)
    for regressor, output in zip(regressors[4:], gaps[4:], strict=True):
        recursion = kalman.recursive_least_squares(
            *recursion, regressor, output, forgetting=0.9, weight=weight, missing="skip"
        )
    np.testing.assert_allclose(recursion[0], estimate, rtol=1e-9)
    np.testing.assert_allclose(recursion[1], covariance, rtol=1e-9)
    with pytest.raises(ProblemError, match="missing='skip'"):
        kalman.least_squares_start(regressors, gaps)
    with pytest.raises(ProblemError, match="missing='skip'"):
        kalman.recursive_least_squares(estimate, covariance, regressors[5], gaps[5])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"forgetting": 0.0}, r"'forgetting'(?s:.)*\(0, 1\]"),
        ({"forgetting": 1.1}, r"'forgetting'(?s:.)*\(0, 1\]"),
        ({"weight": 0.0}, "'weight'(?s:.)*definite"),
        ({"weight": np.eye(2)}, "'weight'"),
        ({"regressor": [1.0, 2.0, 3.0]}, "'regressor'"),
        ({"output": [1.0, 2.0]}, "'output'"),
        ({"covariance": -np.eye(2)}, "'covariance'"),
    ],
)
def test_bad_arguments(change, message):
    arguments = {"estimate": [0.0, 0.0], "covariance": np.eye(2), "regressor": [1.0, 0.0], "output": 1.0}
    with pytest.raises(ProblemError, match=message):
        kalman.recursive_least_squares(**(arguments | change))


def test_samples_that_say_too_little():
    with pytest.raises(ProblemError, match=r"span 3 dimensions(?s:.)*2 from 2 samples"):
        kalman.least_squares_start(np.eye(3)[:2], [1.0, 2.0])
    with pytest.raises(ProblemError, match="do not fit together"):
        kalman.least_squares_start(np.eye(3), [1.0, 2.0])
