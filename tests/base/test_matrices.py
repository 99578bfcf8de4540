"""Half-vectors: packing and unpacking are inverse, symbolic and numeric agree, and traces become products."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from covocp.base.matrices import (
    as_array,
    distinct,
    half_indices,
    half_length,
    is_semidefinite,
    pack,
    pack_costate,
    pack_symbolic,
    semidefinite_part,
    smallest_eigenvalue,
    unpack,
    unpack_costate,
    unpack_indices,
    unpack_symbolic,
)

SIZES = st.integers(1, 6)
ENTRIES = st.floats(-1e3, 1e3, allow_nan=False).map(lambda v: round(v, 6))
repeatable = settings(derandomize=True, deadline=None, max_examples=60)


def squares(lead=()):
    return SIZES.flatmap(lambda n: arrays(float, (*lead, n, n), elements=ENTRIES))


def symmetric(lead=()):
    return squares(lead).map(lambda a: a + np.swapaxes(a, -1, -2))


@repeatable
@given(symmetric(lead=(3,)))
def test_packing_is_invertible(matrices):
    half = pack(matrices)
    n = matrices.shape[-1]
    assert half.shape == (3, n * (n + 1) // 2)
    np.testing.assert_array_equal(unpack(half, n), matrices)


@repeatable
@given(squares())
def test_packing_takes_the_symmetric_part(matrix):
    np.testing.assert_allclose(unpack(pack(matrix), len(matrix)), (matrix + matrix.T) / 2, rtol=1e-15, atol=1e-12)


@pytest.mark.parametrize("size", range(1, 7))
def test_order_of_the_half_vector(size):
    """Column by column of the lower triangle: (0,0), (1,0), ..., (n-1,0), (1,1), ..."""
    order = [(i, j) for j in range(size) for i in range(j, size)]
    rows, columns = half_indices(size)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == order
    assert half_length(size) == len(order)
    positions = unpack_indices(size)
    for k, (i, j) in enumerate(order):
        assert positions[i, j] == positions[j, i] == k


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@repeatable
@given(squares())
def test_symbolic_agrees_with_numeric(kind, matrix):
    n = len(matrix)
    symbol, half = kind.sym("A", n, n), kind.sym("h", half_length(n))
    packed = ca.Function("pack", [symbol], [pack_symbolic(symbol)])(matrix)
    np.testing.assert_allclose(packed.full().ravel(), pack(matrix), rtol=1e-15, atol=1e-12)
    full = ca.Function("unpack", [half], [unpack_symbolic(half, n)])(pack(matrix))
    np.testing.assert_array_equal(full.full(), unpack(pack(matrix), n))


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_packing_of_sparse_expressions(kind):
    d = kind.sym("d", 3)
    packed = ca.Function("pack", [d], [pack_symbolic(ca.diag(d))])([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(packed.full().ravel(), [1, 0, 0, 2, 0, 3])


@repeatable
@given(SIZES.flatmap(lambda n: arrays(float, (2, n, n), elements=ENTRIES)))
def test_trace_is_the_product_of_half_vectors(pair):
    """tr(P V) = costate of the half-vector times half-vector: the off-diagonal costate is 2 P_ij."""
    P, V = (a + a.T for a in pair)
    np.testing.assert_allclose(pack_costate(P) @ pack(V), np.trace(P @ V), rtol=1e-12, atol=1e-6)
    np.testing.assert_array_equal(unpack_costate(pack_costate(P), len(P)), P)


def test_costate_is_the_slope_of_the_packed_entry():
    """d tr(C E) / dE_12 as an entry of the half-vector, by finite difference, is 2 C_12."""
    C, E = np.array([[1.0, 0.3], [0.3, 2.0]]), np.array([[2.0, 0.5], [0.5, 1.0]])
    slopes = []
    for k in range(3):
        moved = pack(E)
        moved[k] += 1e-6
        slopes.append((np.trace(C @ unpack(moved, 2)) - np.trace(C @ E)) / 1e-6)
    np.testing.assert_allclose(slopes, pack_costate(C), rtol=1e-8)


@repeatable
@given(symmetric(lead=(4,)))
def test_smallest_eigenvalue(matrices):
    shift = smallest_eigenvalue(matrices)
    n = matrices.shape[-1]
    least = min(np.linalg.eigvals(m).real.min() for m in matrices)
    assert shift == pytest.approx(least, rel=1e-9, abs=1e-6)
    # the quadratic form is never below the smallest eigenvalue
    vectors = np.random.default_rng(0).standard_normal((20, n))
    forms = np.einsum("vi,kij,vj->kv", vectors, matrices, vectors) / (vectors**2).sum(axis=1)
    assert (forms >= shift - 1e-6).all()


@repeatable
@given(squares(lead=(2,)))
def test_squares_are_semidefinite(factors):
    matrices = factors @ np.swapaxes(factors, -1, -2)
    assert is_semidefinite(matrices)
    n = matrices.shape[-1]
    largest = np.linalg.norm(matrices, axis=(-2, -1)).max()
    assert not is_semidefinite(matrices - (1e-3 + 2 * largest) * np.eye(n))


def test_eigenvalues_of_nothing_and_of_nan():
    assert smallest_eigenvalue(np.zeros((0, 2, 2))) == np.inf
    assert smallest_eigenvalue(np.full((1, 2, 2), np.nan)) == -np.inf
    assert is_semidefinite(np.zeros((0, 2, 2)))
    assert is_semidefinite(np.zeros((3, 2, 2)))
    assert not is_semidefinite(np.full((1, 2, 2), np.nan))
    assert not is_semidefinite(np.full((1, 2, 2), np.inf))


def test_different_numbers_are_sorted():
    assert distinct([0.5, 0.0, 1.0], np.array([1.0, 0.25]), []).tolist() == [0.0, 0.25, 0.5, 1.0]
    assert distinct([]).size == 0


def test_roundoff_is_forgiven_but_not_more():
    matrix = np.diag([1.0, -1e-12])
    assert is_semidefinite(matrix)
    assert not is_semidefinite(np.diag([1.0, -1e-6]))


def test_one_indefinite_matrix_among_many():
    assert not is_semidefinite(np.stack([np.eye(2), np.diag([1.0, -0.1]), np.eye(2)]))


def test_the_semidefinite_part_is_the_nearest_covariance():
    """Of diag(2, -1) in a turned basis what is left is 2 along the first direction; a covariance stays what it is."""
    turn = np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0)  # both variances are the same: units change nothing
    np.testing.assert_allclose(
        semidefinite_part(turn @ np.diag([2.0, -1.0]) @ turn.T), 2 * np.outer(turn[:, 0], turn[:, 0])
    )
    covariance = turn @ np.diag([2.0, 1.0]) @ turn.T
    assert semidefinite_part(covariance) is covariance
    assert semidefinite_part(np.array([[-9.9]])) == 0.0


UNITS = [(1e3, 1e-6), (1e-6, 1e3), (1e6, 1e-6), (1.0, 1.0), (1e140, 1e135), (1e-150, 1e-140)]


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("correlation", [0.0, -0.5, 0.999, 1.0, 1.001, -2.0])
def test_a_covariance_is_one_in_all_units(units, correlation):
    """A correlation of two is none, however small the other variance is beside the larger one."""
    scale = np.diag(units)
    plain = np.array([[1.0, correlation], [correlation, 1.0]])
    assert is_semidefinite(scale @ plain @ scale) == (abs(correlation) <= 1)
    part = np.linalg.inv(scale) @ semidefinite_part(scale @ plain @ scale) @ np.linalg.inv(scale)
    most = max(1.0, (1.0 + abs(correlation)) / 2)  # of the eigenvalues 1 + |rho| and 1 - |rho| the first is left
    kept = np.sign(correlation) * most if abs(correlation) > 1 else correlation
    np.testing.assert_allclose(part, [[most, kept], [kept, most]], rtol=1e-6)


def test_what_is_left_of_a_large_variance_is_known_to_its_rounding():
    """Two variances fall by 16 orders: what rounding leaves of their correlation at the end tells nothing."""
    left = np.array([[1.0, 1.0 + 1e-3], [1.0 + 1e-3, 1.0]])
    assert not is_semidefinite(left)
    assert is_semidefinite(np.stack([1e16 * np.eye(2), left]))
    assert not is_semidefinite(np.stack([1e6 * np.eye(2), left]))


def test_what_rounding_leaves_beside_a_large_variance_is_forgiven():
    assert is_semidefinite(np.array([[1e6, 1e-12], [1e-12, -1e-16]]))
    assert is_semidefinite(np.array([[1e6, 1e-12], [1e-12, 0.0]]))
    assert not is_semidefinite(np.array([[1e6, 1e-3], [1e-3, 0.0]]) + 1e-30 * np.eye(2))


@pytest.mark.parametrize("shape", [(3, 4), (50, 60), (1, 5000), (5000, 1), (0, 7)])
def test_numbers_of_a_matrix_are_those_of_casadi(shape):
    """Of a small and of a large one, dense and sparse, NaN and infinity among them; an array stays what it is."""
    values = np.random.default_rng(1).normal(size=shape)
    values.ravel()[3:9] = [0.0, np.nan, np.inf, -np.inf, -0.0, 1e-310][: max(values.size - 3, 0)]
    given = ca.DM(values)
    np.testing.assert_array_equal(as_array(given), values)
    np.testing.assert_array_equal(np.signbit(as_array(given)), np.signbit(values))
    np.testing.assert_array_equal(as_array(ca.sparsify(given)), values)
    assert as_array(values) is values
