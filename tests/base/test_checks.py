"""Densities and variances that are given: judged in units of their own, whatever stands beside them."""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.base.checks import check_density, density_matrix


def exact_determinant(matrix):
    """Of a 2 x 2 matrix of floats, without rounding."""
    (a, b), (c, d) = ([Fraction(float(entry)) for entry in row] for row in matrix)
    return a * d - b * c


MIXED = [
    [[1e6, 2e-3], [2e-3, 1e-12]],  # a correlation of 2
    [[1e-12, -2e-3], [-2e-3, 1e6]],
    [[1e6, 1.001e-3], [1.001e-3, 1e-12]],
    [[1e20, 1.5], [1.5, 1e-20]],
    [[1e6, 5e-4], [5e-4, 1e-12]],  # of a half
    [[1e-12, 9.99e-4], [9.99e-4, 1e6]],
    [[1e20, 0.5], [0.5, 1e-20]],
]


@pytest.mark.parametrize("numbers", MIXED)
@pytest.mark.parametrize("definite", [True, False])
def test_density_in_mixed_units(numbers, definite):
    """One that is definite had been called singular, and correlations beyond 1 had been accepted."""
    matrix = np.array(numbers)
    if exact_determinant(matrix) > 0:
        check_density("x", "density", matrix, definite=definite)
        return
    with pytest.raises(co.ProblemError, match=r"is not positive semidefinite \(smallest eigenvalue -[^)]*\)"):
        check_density("x", "density", matrix, definite=definite)


def test_correlation_of_one_is_semidefinite_and_singular():
    matrix = np.array([[1e6, 1e-3], [1e-3, 1e-12]])
    check_density("x", "density", matrix, definite=False)
    with pytest.raises(co.ProblemError, match="is singular"):
        check_density("x", "density", matrix, definite=True)


@pytest.mark.parametrize("small", [-1e-12, -1e-30])
def test_variance_that_stands_alone_is_not_negative(small):
    with pytest.raises(co.ProblemError, match=f"smallest eigenvalue {small:g}"):
        check_density("x", "variance", np.diag([1e6, small]), definite=False)


def test_small_entries_that_differ_are_not_symmetric():
    """Beside 1e6 entries of 1e-7 and 2e-7 had been the same but for rounding; in their units they are 0.1 and 0.2."""
    with pytest.raises(co.ProblemError, match="is not symmetric"):
        check_density("x", "variance", np.array([[1e6, 0, 0], [0, 1e-6, 1e-7], [0, 2e-7, 1e-6]]), definite=False)


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e6, 1e-6), (1e-9, 1e-9)])
@pytest.mark.parametrize("correlation", [0.0, 0.3])
def test_rounding_of_a_covariance_is_no_asymmetry(units, correlation):
    """A share of sqrt(P_ii P_jj), whatever the entry itself is: 1e-12 beside 0.1 and 0.3 had been too much."""
    D, apart = np.diag(units), np.sqrt(0.1 * 0.3)
    even = np.array([[0.1, correlation * apart], [correlation * apart, 0.3]])
    for share, allowed in ((1e-12, True), (9e-10, True), (1.1e-9, False), (1e-6, False)):
        uneven = D @ (even + np.array([[0.0, share * apart], [0.0, 0.0]])) @ D
        if allowed:
            check_density("x", "variance", uneven, definite=True)
            taken = ca.evalf(density_matrix("x", "variance", uneven, 2)).full()
            np.testing.assert_array_equal(taken, (uneven + uneven.T) / 2)
            continue
        with pytest.raises(co.ProblemError, match="is not symmetric") as refused:
            check_density("x", "variance", uneven, definite=True)
        assert refused.value.remedy.startswith("give (P + P.T) / 2 where the difference is rounding")
        told = float(refused.value.received.rpartition("entries [0, 1] and [1, 0] differ by ")[2])
        assert told == pytest.approx(share * apart * units[0] * units[1], rel=1e-2)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_variance_of_a_state_is_refused_in_all_units(scale):
    with pytest.raises(co.ProblemError, match="variance of 'x' is not positive semidefinite"):
        co.Problem(1.0).state("x", 2, initial=[0.0, 0.0], variance=[[1.0, 2.0 * scale], [2.0 * scale, scale**2]])
