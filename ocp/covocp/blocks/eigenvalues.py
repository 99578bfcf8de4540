"""Eigenvalues and eigenvectors of small symmetric matrices, written out: by Jacobi's rotations, no linear solver."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import casadi as ca

from covocp.base.expressions import Expr

# A matrix of two rows is diagonal after one rotation; of n rows, off-diagonal entries are rounding after n + 1 sweeps
# over all pairs (measured up to n = 8), and one is to spare.
ONE_SWEEP = 2


class Eigen(NamedTuple):
    """Eigenvalues, not sorted, (n, 1), and the eigenvectors that belong to them as columns, (n, n)."""

    values: Expr
    vectors: Expr


def symmetric_eigen(matrix: Expr) -> Eigen:
    """Eigenvalues and eigenvectors of a symmetric expression.

    Args:
        matrix: SX, shape (n, n).

    Returns:
        As SX of scalar operations; the vectors are orthogonal whatever the rounding of the values.
    """
    size = matrix.shape[0]
    A, Q = ca.SX(matrix), ca.SX.eye(size)
    for _ in range(size + 2 if size > ONE_SWEEP else 1):
        for i, j in combinations(range(size), 2):
            A, Q = _rotated(A, Q, i, j)
    return Eigen(ca.diag(A), Q)


def _rotated(A: Expr, Q: Expr, i: int, j: int) -> tuple[Expr, Expr]:
    """The rotation by at most 45 deg in the plane of i and j that makes the entry (i, j) zero."""
    difference, twice = A[j, j] - A[i, i], 2 * A[i, j]
    length = ca.fabs(difference) + ca.sqrt(difference**2 + twice**2)
    tangent = ca.if_else(length > 0, twice / ca.if_else(length > 0, length, 1), 0)
    tangent = ca.if_else(difference < 0, -tangent, tangent)
    cosine = 1 / ca.sqrt(1 + tangent**2)
    rotation = ca.SX.eye(A.shape[0])
    rotation[i, i] = rotation[j, j] = cosine
    rotation[i, j], rotation[j, i] = tangent * cosine, -tangent * cosine
    turned = rotation.T @ A @ rotation
    turned[i, j] = turned[j, i] = 0
    return turned, Q @ rotation


def is_definite(matrix: Expr) -> Expr:
    """Whether a symmetric expression is positive definite, 1 or 0: all pivots of its elimination are positive."""
    rest, definite = ca.SX(matrix), ca.SX(1)
    for _ in range(matrix.shape[0]):
        pivot = rest[0, 0]
        definite = ca.logic_and(definite, pivot > 0)
        column = rest[1:, 0]
        rest = rest[1:, 1:] - column @ column.T / ca.if_else(pivot > 0, pivot, 1)
    return definite
