"""Linear systems for tests of the blocks: the notes' double integrator, and random ones."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

# Property tests repeat.
FIXED = settings(derandomize=True, deadline=None, database=None, max_examples=40)
SEEDS = st.integers(0, 10**6)

# Specification 3, part 2: double integrator, T = 0.5 s.
T = 0.5
PHI = np.array([[1.0, T], [0.0, 1.0]])
GAMMA = np.array([[T**2 / 2], [T]])
H = np.array([[1.0, 0.0]])
NOISE = 0.2 * GAMMA @ GAMMA.T
R_V = np.array([[0.05]])
Q_1 = np.diag([1.0, 0.1])
Q_2 = np.array([[0.4]])
M_INF = [[0.08454367, 0.08201941], [0.08201941, 0.12807764]]
L_INF = [[0.62837346], [0.60961180]]
P_INF = [[0.03141867, 0.03048059], [0.03048059, 0.07807764]]
S_INF = [[2.89771131, 1.27475488], [1.27475488, 1.57824709]]
K = [[1.00040881, 1.44944797]]
AVERAGE_COST = 0.40347843
PRINTED = {"rtol": 0, "atol": 1e-8}  # the table has eight decimals


def definite(generator, size, condition=100.0):
    """A random covariance with a given condition number."""
    vectors = np.linalg.qr(generator.standard_normal((size, size)))[0]
    values = np.exp(generator.uniform(0.0, np.log(condition), size))
    product = (vectors * values) @ vectors.T
    return 0.5 * (product + product.T)


def random_filter(seed, size, count):
    """Estimate, covariance, reading, H and correlated R."""
    generator = np.random.default_rng(seed)
    return (
        generator.standard_normal(size),
        definite(generator, size),
        generator.standard_normal(count),
        generator.standard_normal((count, size)),
        definite(generator, count),
    )


def least_squares(estimate, covariance, reading, rows, noise):
    """The update as one least-squares problem: prior and readings as equations of weight one, by QR."""
    prior, white = (np.linalg.inv(np.linalg.cholesky(matrix)) for matrix in (covariance, noise))
    equations = np.vstack([prior, white @ rows])
    right = np.concatenate([prior @ estimate, white @ reading])
    triangle = np.linalg.qr(equations, mode="r")
    inverse = np.linalg.inv(triangle)
    return np.linalg.lstsq(equations, right, rcond=None)[0], inverse @ inverse.T


def by_doubling(A, B, Q, R):
    """The stabilising solution by the structure-preserving doubling algorithm, in 60 digits, without eigenvectors."""
    exact = np.vectorize(Decimal, otypes=[object])
    with localcontext(prec=60):
        A, B, S, R = (exact(np.asarray(matrix, dtype=float)) for matrix in (A, B, Q, R))
        unit, G = exact(np.eye(len(A))), B @ inverse(R) @ B.T
        for _ in range(60):
            W = inverse(unit + G @ S)
            A, G, S, before = A @ W @ A, G + A @ W @ G @ A.T, S + A.T @ S @ W @ A, S
            if abs(S - before).max() <= abs(S).max() * Decimal("1e-30"):
                break
    return S.astype(float)


def inverse(matrix):
    """By elimination with pivots, of a matrix of decimals."""
    size = len(matrix)
    rows = np.hstack([matrix, np.vectorize(Decimal, otypes=[object])(np.eye(size))])
    for j in range(size):
        pivot = j + int(np.argmax(abs(rows[j:, j])))
        rows[[j, pivot]] = rows[[pivot, j]]
        rows[j] = rows[j] / rows[j, j]
        others = np.arange(size) != j
        rows[others] = rows[others] - rows[others, j : j + 1] * rows[j]
    return rows[:, size:]
