"""Covariances that a filter leaves are known to rounding of what they were: such an error is no indefinite matrix."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.base.checks import check_density
from covocp.base.matrices import without_rounding


def solver(variances: tuple[float, float]) -> co.Solver:
    ocp = co.Problem(4.0, "two rows")
    x = ocp.state("x", initial=0.0, final=1.0, variance=variances[0])
    v = ocp.state("v", initial=0.0, final=0.0, variance=variances[1])
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=0.01)
    ocp.measurement("m", x, noise=0.05)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2 + E[x, x])
    return co.Solver(ocp, intervals=20)


def test_a_variance_of_rounding_alone_is_zero():
    twenty = solver((0.5, 0.2))
    exact = twenty.solve(covariance=np.diag([0.5, 0.0]), progress=False)
    for rounding in (-1e-17, -1e-15):
        found = twenty.solve(covariance=np.diag([0.5, rounding]), progress=False)
        assert found["E"][0] == pytest.approx(np.diag([0.5, 0.0]), abs=0.0)
        assert found.cost == pytest.approx(exact.cost, rel=1e-9)


@pytest.mark.parametrize("noise", [1e-6, 1e-10, 1e-14])
def test_what_a_filter_leaves_is_semidefinite_and_hardly_changed(noise):
    """Ten readings of both positions in turned axes; the error that the filter made itself is what may be changed."""
    random, once = np.random.default_rng(1), np.array([1e4, 1e4, 1.0, 1.0])
    F = np.eye(4)
    F[0, 2] = F[1, 3] = 0.1
    for _ in range(30):
        E, angle = np.diag(once), random.uniform(0.0, 6.0)
        H = np.array([[np.cos(angle), np.sin(angle), 0, 0], [-np.sin(angle), np.cos(angle), 0, 0]])
        for _ in range(10):
            E = F @ E @ F.T + np.diag([0.0, 0.0, 1e-7, 1e-7])
            gain = E @ H.T @ np.linalg.inv(H @ E @ H.T + noise * np.eye(2))
            E = (np.eye(4) - gain @ H) @ E
            E = 0.5 * (E + E.T)
            kept = without_rounding(E, once)
            check_density("E", "initial value", kept, definite=False)
            assert np.abs(kept - E).max() <= 1e-7 * np.abs(E).max()


def test_rank_that_an_exact_reading_takes():
    random, twenty = np.random.default_rng(0), solver((0.5, 0.2))
    for _ in range(100):
        A, H = random.standard_normal((2, 2)), random.standard_normal((1, 2))
        E = A @ A.T
        E = (np.eye(2) - E @ H.T @ H / (H @ E @ H.T)) @ E
        twenty.solve(covariance=0.5 * (E + E.T), progress=False, iteration_limit=0, assess=False)


REFUSED = [
    [[1.0, 2.0], [2.0, 1.0]],
    [[0.5, 0.0], [0.0, -1e-12]],  # beyond rounding of the 0.2 that it was
    [[1e6, 0.0], [0.0, -1e-12]],  # of which a million metres tell nothing
    [[0.5, 1e-3], [1e-3, 0.0]],
    [[0.5, 1e-3], [1e-3, -1e-17]],
    [[np.inf, 0.0], [0.0, 1.0]],
]


@pytest.mark.parametrize("matrix", REFUSED)
def test_what_is_really_indefinite_is_refused(matrix):
    with pytest.raises(co.ProblemError, match=r"(not positive semidefinite|contains NaN or inf)"):
        solver((0.5, 0.2)).solve(covariance=np.array(matrix), progress=False)


def test_small_variances_and_exact_matrices_stay_as_they_are():
    for matrix in (np.diag([1e4, 1e-16]), np.array([[1e4, 9e-7], [9e-7, 1e-16]]), np.diag([0.5, 0.0])):
        assert np.array_equal(without_rounding(matrix, np.array([1e4, 1.0])), matrix)


NEGATIVE = [[[-1e-10, 0.0], [0.0, 1e6]], [[-1e-9, 0.0], [0.0, 1e6]], [[0.5, 0.0], [0.0, -1e-17]]]
NEGATIVE += [[[-1e-10, 1e-8], [1e-8, 1e6]], [[0.5, 1e-18], [1e-18, -1e-17]]]


@pytest.mark.parametrize("matrix", NEGATIVE)
def test_no_declared_variance_is_negative_however_far_apart_the_units_are(matrix):
    """In a re-solve from variances of 0.5 and 0.2 as well, unless it is rounding of these."""
    given, ocp = np.array(matrix), co.Problem(1.0)
    x = ocp.state("x", 2, initial=0.0)
    ocp.dynamics(x, ca.MX.zeros(2), noise=np.eye(2))
    ocp.measurement("m", x[0], noise=1.0)
    ways = [
        lambda: ocp.estimation_covariance(initial=given),
        lambda: ocp.state("y", 2, initial=0.0, variance=given),
        lambda: ocp.unknown("b", [0.0, 0.0], variance=given),
        lambda: ocp.symmetric("P", 2, initial=given, lower=0.0),
    ]
    if np.diagonal(given).min() < -1e-13:
        ways.append(lambda: solver((0.5, 0.2)).solve(covariance=given, progress=False))
    for way in ways:
        with pytest.raises(co.ProblemError, match=r"not positive semidefinite|outside its bounds"):
            way()


@pytest.mark.parametrize("declared", [0.0, 1e-3])
def test_a_row_without_variance_may_have_one_rounding_of_the_largest(declared):
    """n eps = 4.4e-16 of it, and only where that row is declared with none."""
    two = solver((1e6, declared))
    if declared == 0.0:
        given = np.diag([1e6, -4e-10])
        found = two.solve(covariance=given, progress=False, iteration_limit=0, assess=False)
        assert np.array_equal(found["E"][0], np.diag([1e6, 0.0]))
    with pytest.raises(co.ProblemError, match="not positive semidefinite"):
        two.solve(covariance=np.diag([1e6, -5e-10 if declared == 0.0 else -4e-10]), progress=False)
