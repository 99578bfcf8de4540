"""The discrete filter: every form against a least-squares problem, missing readings, definiteness, symbols and C."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from compiled import compile_function
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import (
    FIXED,
    GAMMA,
    M_INF,
    NOISE,
    P_INF,
    PHI,
    PRINTED,
    R_V,
    SEEDS,
    H,
    definite,
    least_squares,
    random_filter,
)

from covocp import ProblemError
from covocp.blocks import kalman

FORMS = ("joseph", "standard", "sequential", "information")


def symbols(kind, size, count):
    """Symbols of the arguments of an update."""
    shapes = {"x": (size, 1), "P": (size, size), "y": (count, 1), "H": (count, size), "R": (count, count)}
    return [kind.sym(name, *shape) for name, shape in shapes.items()]


def close(first, second, tolerance=1e-11):
    for one, two in zip(first, second, strict=True):
        np.testing.assert_allclose(np.asarray(one).squeeze(), np.asarray(two).squeeze(), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("size", "count"), [(1, 1), (3, 1), (3, 2), (2, 4)])
def test_update_solves_the_least_squares_problem(form, size, count):
    arguments = random_filter(size + 10 * count, size, count)
    close(kalman.update(*arguments, form=form), least_squares(*arguments))


@FIXED
@given(seed=SEEDS, size=st.integers(1, 4), count=st.integers(1, 4))
def test_all_forms_are_equal(seed, size, count):
    arguments = random_filter(seed, size, count)
    reference = kalman.update(*arguments)
    for form in FORMS[1:]:
        close(kalman.update(*arguments, form=form), reference, 1e-9)


def test_cycle_of_the_table():
    posterior = kalman.update([0.0, 0.0], M_INF, 0.0, H, R_V)[1]
    np.testing.assert_allclose(posterior, P_INF, **PRINTED)
    np.testing.assert_allclose(kalman.predict([0.0, 0.0], P_INF, PHI, NOISE)[1], M_INF, rtol=0, atol=2e-8)


def test_predict():
    estimate, covariance = kalman.predict([1.0, 2.0], np.diag([1.0, 4.0]), PHI, NOISE, drift=3.0 * GAMMA.ravel())
    np.testing.assert_allclose(estimate, [1.0 + 1.0 + 0.375, 2.0 + 1.5])
    np.testing.assert_allclose(covariance, np.array([[2.0, 2.0], [2.0, 4.0]]) + NOISE, rtol=1e-14)


def test_scalars_in_scalars_out():
    estimate, covariance = kalman.update(1.0, 4.0, 3.0, 1.0, 4.0)
    assert (type(estimate), type(covariance)) == (float, float)
    assert (estimate, covariance) == pytest.approx((2.0, 2.0))
    assert kalman.predict(1.0, 4.0, 0.5, 1.0) == (0.5, 2.0)


def test_shapes_of_the_arguments_come_back():
    x, P, y, rows, R = random_filter(0, 3, 2)
    flat, covariance = kalman.update(x, P, y, rows, R)
    column, _ = kalman.update(x[:, None], P, ca.DM(y), ca.DM(rows), R)
    assert (flat.shape, column.shape, covariance.shape) == ((3,), (3, 1), (3, 3))
    np.testing.assert_array_equal(flat, column.ravel())
    close(kalman.update(x, P, y[:1], rows[0], R[:1, :1]), kalman.update(x, P, y[0], rows[:1], R[0, 0]), 1e-15)


def test_a_row_without_noise_is_met_exactly():
    x, P, y, rows, _ = random_filter(5, 3, 2)
    for form in ("joseph", "standard", "sequential"):
        estimate, covariance = kalman.update(x, P, y, rows, np.zeros((2, 2)), form=form)
        np.testing.assert_allclose(rows @ estimate, y, atol=1e-12)
        np.testing.assert_allclose(rows @ covariance, 0.0, atol=1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_missing_rows_are_left_out(form):
    x, P, y, rows, R = random_filter(7, 3, 3)
    gap = y.copy()
    gap[1] = np.nan
    left = np.array([0, 2])
    expected = least_squares(x, P, y[left], rows[left], R[np.ix_(left, left)])
    close(kalman.update(x, P, gap, rows, R, form=form, missing="skip"), expected)
    nothing = kalman.update(x, P, np.full(3, np.nan), rows, R, form=form, missing="skip")
    close(nothing, (x, P), 1e-12)
    for kind in (ca.SX, ca.MX):
        arguments = symbols(kind, 3, 3)
        update = ca.Function("update", arguments, list(kalman.update(*arguments, form=form, missing="skip")))
        close(update(x, P, gap, rows, R), expected)
        close(update(x, P, y, rows, R), least_squares(x, P, y, rows, R))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_symbols_expand(form, kind):
    arguments = symbols(kind, 3, 2)
    update = ca.Function("update", arguments, list(kalman.update(*arguments, form=form))).expand()
    numbers = random_filter(11, 3, 2)
    close(update(*numbers), least_squares(*numbers))


def test_symbols_mixed_with_numbers():
    x, P, y, rows, R = random_filter(13, 3, 2)
    symbol = ca.MX.sym("P", 3, 3)
    update = ca.Function("update", [symbol], list(kalman.update(x, symbol, y, rows, R, form="sequential"))).expand()
    close(update(P), least_squares(x, P, y, rows, R))
    assert isinstance(kalman.predict(x, ca.MX(ca.DM(P)), np.eye(3), np.eye(3))[1], np.ndarray)


@pytest.mark.needs_cc
@pytest.mark.parametrize("form", FORMS)
def test_c_code(form, tmp_path):
    arguments = symbols(ca.MX, 3, 2)
    function = ca.Function("update", arguments, list(kalman.update(*arguments, form=form, missing="skip")))
    code = compile_function(function, tmp_path)
    numbers = random_filter(17, 3, 2)
    close(code(*numbers), least_squares(*numbers))
    x, P, y, rows, R = numbers
    close(code(x, P, [y[0], np.nan], rows, R), least_squares(x, P, y[:1], rows[:1], R[:1, :1]))


@FIXED
@given(seed=SEEDS, size=st.integers(1, 5), count=st.integers(1, 3), spread=st.integers(-6, 6))
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_joseph_form_is_semidefinite_for_any_gain(kind, seed, size, count, spread):
    _, P, _, rows, R = random_filter(seed, size, count)
    gain = 10.0**spread * np.random.default_rng(seed).standard_normal((size, count))
    result = kalman.joseph(P.astype(kind), gain.astype(kind), rows.astype(kind), R.astype(kind))
    assert result.dtype == kind
    values = np.linalg.eigvalsh(result.astype(float))
    assert values[0] >= -10 * size * np.finfo(kind).eps * values[-1]
    exact = (np.eye(size) - gain @ rows) @ P @ (np.eye(size) - gain @ rows).T + gain @ R @ gain.T
    np.testing.assert_allclose(result, exact, rtol=0, atol=1e3 * np.finfo(kind).eps * np.abs(exact).max())


@FIXED
@given(seed=SEEDS, form=st.sampled_from(FORMS[:3]), accuracy=st.integers(0, 12))
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_no_update_leaves_the_semidefinite_cone(kind, seed, form, accuracy):
    """Precise readings of a badly known state, one after the other, with the rounding of either precision."""
    generator = np.random.default_rng(seed)
    accuracy = accuracy if kind == np.float64 else accuracy / 3.0  # beyond, H P H' + R is singular to rounding
    P = (10.0**accuracy * definite(generator, 3)).astype(kind)
    x = np.zeros(3, dtype=kind)
    for _ in range(4):
        rows = generator.standard_normal((2, 3)).astype(kind)
        x, P = kalman.update(x, P, np.ones(2, dtype=kind), rows, np.eye(2, dtype=kind), form=form)
        values = np.linalg.eigvalsh(P.astype(float))
        assert P.dtype == kind
        assert values[0] >= -10 * np.finfo(kind).eps * values[-1]


@FIXED
@given(seed=SEEDS, size=st.integers(1, 4), count=st.integers(1, 3))
def test_steps_do_not_depend_on_the_coordinates(seed, size, count):
    x, P, y, rows, R = random_filter(seed, size, count)
    generator = np.random.default_rng(seed + 1)
    change = np.linalg.cholesky(definite(generator, size)) + np.triu(generator.standard_normal((size, size)), 1)
    if np.linalg.cond(change) > 1e4:
        return
    back = np.linalg.inv(change)
    transition, noise = generator.standard_normal((size, size)), definite(generator, size)
    here = kalman.update(*kalman.predict(x, P, transition, noise), y, rows, R)
    moved = (change @ x, change @ P @ change.T, change @ transition @ back, change @ noise @ change.T)
    there = kalman.update(*kalman.predict(*moved), y, rows @ back, R)
    scale = np.linalg.cond(change) ** 2
    for one, two in zip(here, (back @ there[0], back @ there[1] @ back.T), strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-12 * scale * np.abs(one).max())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"covariance": np.diag([1.0, -1.0])}, "covariance.*(?s:.)*positive semidefinite"),
        ({"covariance": [[1.0, 0.5], [0.0, 1.0]]}, "asymmetry"),
        ({"covariance": np.eye(3)}, "'covariance'"),
        ({"measurement": np.nan}, "missing='skip'"),
        ({"measurement": [1.0, 2.0]}, "'measurement'"),
        ({"H": np.ones((1, 3))}, "'H'"),
        ({"R": -1.0}, "'R'"),
        ({"R": np.inf}, "'R'"),
        ({"form": "jacobi"}, "'joseph', 'standard', 'sequential', 'information'"),
        ({"missing": "ignore"}, "'raise', 'skip'"),
        ({"covariance": np.zeros((2, 2)), "R": 0.0}, "innovation(?s:.)*singular"),
        ({"covariance": np.zeros((2, 2)), "R": 0.0, "form": "sequential"}, "innovation(?s:.)*singular"),
        ({"R": 0.0, "form": "information"}, "R is singular"),
        ({"covariance": np.zeros((2, 2)), "form": "information"}, "covariance is singular"),
        ({"covariance": np.zeros((2, 2)), "form": "information"}, "form='sequential' or 'joseph'"),
        ({"estimate": "x"}, "numbers or a CasADi expression"),
        ({"covariance": ca.SX.sym("P", 2, 2), "H": ca.MX.sym("H", 1, 2)}, "mix SX and MX"),
    ],
)
def test_bad_arguments(change, message):
    arguments = {"estimate": [0.0, 0.0], "covariance": np.eye(2), "measurement": 1.0, "H": [1.0, 0.0], "R": 1.0}
    with pytest.raises(ProblemError, match=message):
        kalman.update(**(arguments | change))


@pytest.mark.parametrize("form", ["joseph", "standard"])
def test_refusal_of_two_accurate_sensors_names_the_form_that_takes_them(form):
    """Their innovation is singular to rounding; row by row the update is exact."""
    prior, noise = 1e6, 1e-12
    arguments = ([0.0], np.array([[prior]]), [3.0, 3.0], np.ones((2, 1)), noise * np.eye(2))
    with pytest.raises(ProblemError, match=r"innovation(?s:.)*singular(?s:.)*form='sequential'"):
        kalman.update(*arguments, form=form)
    estimate, covariance = kalman.update(*arguments, form="sequential")
    inverse = 1 / Fraction(prior) + 2 / Fraction(noise)
    assert covariance[0, 0] == pytest.approx(float(1 / inverse), rel=1e-3)
    assert estimate[0] == pytest.approx(float(6 / Fraction(noise) / inverse), rel=1e-12)


@pytest.mark.parametrize("noise", [1e-8, 1e-12, 1e-16])
@pytest.mark.parametrize("units", [(1.0, 1.0), (1e6, 1e-9)])
def test_information_form_with_an_accurate_sensor(noise, units):
    """M = I, h = (1, 0.7): the residual after the update is y R / (h h' + R), P = I - h' h / (h h' + R)."""
    h, y, change = np.array([1.0, 0.7]), 0.3, np.array(units)
    arguments = (np.zeros(2), np.diag(change**2), y, h / change, noise)
    kinds = symbols(ca.SX, 2, 1)
    update = ca.Function("update", kinds, list(kalman.update(*kinds, form="information")))
    expected = np.eye(2) - np.outer(h, h) / (h @ h + noise)
    for estimate, covariance in (
        kalman.update(*arguments, form="information"),
        (value.full() for value in update(*arguments[:3], arguments[3][None, :], noise)),
    ):
        estimate, covariance = np.ravel(estimate) / change, covariance / np.outer(change, change)
        assert abs(y - h @ estimate - y * noise / (h @ h + noise)) <= 2e-16
        np.testing.assert_allclose(estimate, h * y / (h @ h + noise), rtol=1e-14)
        np.testing.assert_allclose(covariance, expected, rtol=0, atol=1e-15)


def test_information_form_keeps_coarse_readings_beside_many_accurate_ones():
    """Ten accurate readings of one combination, two coarse ones of the rest: against rational numbers."""
    generator = np.random.default_rng(3)
    rows = np.vstack([np.outer(generator.uniform(0.5, 2.0, 10), [1.0, 0.7]), [[0.3, 1.0], [1.0, -0.5]]])
    variances, y = np.append(np.full(10, 1e-14), [1.0, 2.0]), np.append(rows[:10, 0], [0.4, 2.0])
    information = [[Fraction(int(i == j)) for j in range(2)] for i in range(2)]
    known = [Fraction(0), Fraction(0)]
    for row, variance, value in zip(rows.tolist(), variances.tolist(), y.tolist(), strict=True):
        for i in range(2):
            known[i] += Fraction(row[i]) * Fraction(value) / Fraction(variance)
            for j in range(2):
                information[i][j] += Fraction(row[i]) * Fraction(row[j]) / Fraction(variance)
    (a, b), (_, d) = information
    expected = [(d * known[0] - b * known[1]) / (a * d - b * b), (a * known[1] - b * known[0]) / (a * d - b * b)]
    spreads = [float(d / (a * d - b * b)), float(a / (a * d - b * b))]
    estimate, P = kalman.update(np.zeros(2), np.eye(2), y, rows, np.diag(variances), form="information")
    np.testing.assert_allclose(estimate, [float(value) for value in expected], rtol=1e-13)
    np.testing.assert_allclose(np.diag(P), spreads, rtol=1e-7)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("noise", [1e-10, 1e-13, 3e-15])
def test_two_sensors_of_nearly_the_same(form, noise):
    """H M H' + R holds little of R any more: the difference of the readings, against a solution in rational numbers."""
    rows, y = np.array([[1.0, 0.5], [1.0, 0.5 + 1e-7]]), np.array([0.3, 0.3 + 2e-7])
    a, b = (Fraction(value) for value in rows[0].tolist())
    c = Fraction(float(rows[1, 1]))
    r, (y1, y2) = Fraction(noise), (Fraction(value) for value in y.tolist())
    information = (1 + 2 * a * a / r, a * (b + c) / r, 1 + (b * b + c * c) / r)
    known = (a * (y1 + y2) / r, (b * y1 + c * y2) / r)
    size = information[0] * information[2] - information[1] ** 2
    x = (information[2] * known[0] - information[1] * known[1]) / size
    z = (information[0] * known[1] - information[1] * known[0]) / size
    estimate, covariance = kalman.update(np.zeros(2), np.eye(2), y, rows, noise * np.eye(2), form=form)
    np.testing.assert_allclose(estimate, [float(x), float(z)], rtol=0, atol=2e-7)
    spreads = [float(information[2] / size), float(information[0] / size)]
    np.testing.assert_allclose(np.diag(covariance), spreads, rtol=1e-6)


def test_factor_update_in_turn_names_the_array_form_where_noises_depend():
    root = np.array([[1.0, 0.0], [1.0, 0.0]])
    with pytest.raises(ProblemError, match=r"singular(?s:.)*form='array'"):
        kalman.update_factor([0.0], np.eye(1), [1.0, 1.0], np.ones((2, 1)), root, form="sequential")


def test_bad_arguments_of_predict():
    for arguments, name in (
        (([0.0], np.eye(2), PHI, NOISE), "estimate"),
        (([0.0, 0.0], np.eye(2), PHI, -NOISE), "noise"),
        (([0.0, 0.0], np.eye(2), np.ones((2, 3)), NOISE), "transition"),
    ):
        with pytest.raises(ProblemError, match=f"'{name}'"):
            kalman.predict(*arguments)
    with pytest.raises(ProblemError, match="'drift'"):
        kalman.predict([0.0, 0.0], np.eye(2), PHI, NOISE, drift=1.0)
