"""Blocks in C of single precision: constants that it has no numbers for, and what is said of code that is right."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.blocks import kalman, so3

X, P, Y = ca.SX.sym("x", 2), ca.SX.sym("P", 2, 2), ca.SX.sym("y", 2)
PHI = ca.SX.sym("phi", 3)


@pytest.mark.parametrize("form", ["joseph", "standard", "sequential", "information"])
def test_a_reading_that_is_no_number_is_left_out(tmp_path, form):
    updated = kalman.update(X, P, Y, np.eye(2), 0.1 * np.eye(2), form=form, missing="skip")
    function = ca.Function("filter", [X, P, Y], list(updated), ["x", "P", "y"], ["xn", "Pn"])
    package = co.export_c(function, tmp_path / "filter", precision="single")
    package.build()
    code = package.python().filter
    for gone in (np.nan, np.inf, -np.inf, 1e35):
        state, variance = code(np.zeros(2), np.eye(2), np.array([gone, 1.0]))
        np.testing.assert_allclose(np.ravel(state), [0.0, 1.0 / 1.1], rtol=1e-6)
        np.testing.assert_allclose(variance, np.diag([1.0, 0.1 / 1.1]), rtol=1e-6)
        numbers = kalman.update(
            np.zeros(2), np.eye(2), np.array([gone, 1.0]), np.eye(2), 0.1 * np.eye(2), form=form, missing="skip"
        )
        np.testing.assert_allclose(numbers[0], [0.0, 1.0 / 1.1], rtol=1e-12)


def test_rotations_have_numbers(tmp_path):
    parts = {"exp": so3.exp, "left": so3.left_jacobian, "inverse": so3.inverse_left_jacobian}
    functions = [ca.Function(name, [PHI], [make(PHI)], ["phi"], ["value"]) for name, make in parts.items()]
    ranges = {"phi": (-6.0, 6.0)}  # a million radians have no angle in single precision
    package = co.export_c(functions, tmp_path / "rotations", precision="single", ranges=ranges)
    package.build()
    assert package.check().ok
    code = package.python()
    for phi in (np.zeros(3), np.array([1e-8, 0.0, 0.0]), np.array([0.1, -0.2, 0.3]), np.array([2.0, 1.0, -1.5])):
        for name, make in parts.items():
            np.testing.assert_allclose(getattr(code, name)(phi), make(phi), atol=1e-6)


@pytest.mark.parametrize("form", ["joseph", "sequential"])
def test_a_filter_that_is_right_passes_the_check(tmp_path, form):
    prior = kalman.predict(X, P, np.array([[1.0, 0.5], [0.0, 1.0]]), 0.2 * np.outer([0.125, 0.5], [0.125, 0.5]))
    updated = kalman.update(*prior, Y[0], np.array([1.0, 0.0]), 0.05, form=form)
    function = ca.Function("filter", [X, P, Y], list(updated), ["x", "P", "y"], ["xn", "Pn"])
    package = co.export_c(function, tmp_path / "filter", precision="single")
    package.build()
    report = package.check()
    assert report.ok, str(report)
