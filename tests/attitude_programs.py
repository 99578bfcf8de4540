"""The programs of the constrained attitude filter posed to a conic solver: the matrix inequality itself, and (R)."""

from __future__ import annotations

from typing import NamedTuple

import clarabel
import numpy as np
from scipy import sparse


class Case(NamedTuple):
    """Numbers of one update, section 6."""

    H: np.ndarray
    R: np.ndarray
    prior: np.ndarray  # P^-
    before: np.ndarray  # b^-
    residual: np.ndarray  # r
    A: np.ndarray
    beta: np.ndarray
    kappa: float
    penalty: float
    largest_step: float

    @property
    def innovation(self):
        """S."""
        return self.H @ self.prior @ self.H.T + self.R

    @property
    def surprise(self):
        """q = r'S^-1 r."""
        return float(self.residual @ np.linalg.solve(self.innovation, self.residual))

    @property
    def gain(self):
        """K* of the filter without zones."""
        return np.linalg.solve(self.innovation, self.H @ self.prior).T

    @property
    def estimate(self):
        """b*."""
        return self.before + self.gain @ self.residual

    @property
    def covariance(self):
        """P*, by the information form."""
        return np.linalg.inv(np.linalg.inv(self.prior) + self.H.T @ np.linalg.solve(self.R, self.H))

    def spread(self, K):
        """P(K), in Joseph's form."""
        left = np.eye(3) - K @ self.H
        return left @ self.prior @ left.T + K @ self.R @ K.T


def random_case(seed, rows=2, differences=4):
    """Noise, prior, attitudes of the window and zones at random; the step bound is active in some."""
    generator = np.random.default_rng(seed)
    x, z = (unit(generator.standard_normal((rows, 3))) for _ in range(2))
    H = 0.2 * generator.standard_normal((differences, 3))
    root = generator.standard_normal((3, 3))
    R = 0.0025 * (np.eye(differences) + 1.0)
    return Case(
        H=H,
        R=R,
        prior=root @ root.T + 0.1 * np.eye(3),
        before=2.0 * generator.standard_normal(3),
        residual=H @ generator.standard_normal(3) + 0.05 * generator.standard_normal(differences),
        A=np.cross(x, z),
        beta=generator.uniform(-0.1, 0.05, rows),
        kappa=0.05,
        penalty=100.0,
        largest_step=generator.choice([0.05, 0.1, 0.25]),
    )


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def settings(tolerance=1e-10):
    """Of the conic solver."""
    given = clarabel.DefaultSettings()
    given.verbose = False
    given.tol_gap_abs = given.tol_gap_rel = given.tol_feas = tolerance
    return given


class Literal:
    """The problem of section 6 in conic form: K by columns, the upper half of Z by columns, zeta."""

    def __init__(self, case: Case, regular: float = 0.0, tolerance: float = 1e-10) -> None:
        N, m = case.H.shape[0], len(case.beta)
        self.shape, self.halves = (3, N), [(i, j) for j in range(N) for i in range(j + 1)]
        self.size = 3 * N + len(self.halves) + m
        weight = 0.5 * (np.outer(case.residual, case.residual) + regular * case.innovation)
        cost = np.zeros(self.size)
        for k, (i, j) in enumerate(self.halves):
            cost[3 * N + k] = weight[i, j] * (1 if i == j else 2)
        cost[self.size - m :] = case.penalty
        origin = [values.copy() for values in self._blocks(case, np.zeros(self.size))]
        columns = [[] for _ in origin]
        for k in range(self.size):
            step = np.zeros(self.size)
            step[k] = 1.0
            for block, values, zero in zip(columns, self._blocks(case, step), origin, strict=True):
                block.append(values - zero)
        matrix = -np.vstack([np.array(block).T for block in columns])
        cones = [
            clarabel.NonnegativeConeT(len(origin[0])),
            clarabel.PSDTriangleConeT(2 * N + 3),
            clarabel.PSDTriangleConeT(4),
        ]
        self.arguments = (
            sparse.csc_matrix((self.size, self.size)), cost, sparse.csc_matrix(matrix), np.concatenate(origin), cones,
            settings(tolerance),
        )  # fmt: skip

    def _blocks(self, case, x):
        """What must be not negative, or positive semidefinite as the scaled upper half, at x."""
        N, m = case.H.shape[0], len(case.beta)
        K, zeta = x[: 3 * N].reshape(N, 3).T, x[self.size - m :]
        Z = np.zeros((N, N))
        for (i, j), value in zip(self.halves, x[3 * N : self.size - m], strict=True):
            Z[i, j] = Z[j, i] = value
        b, left = case.before + K @ case.residual, np.eye(N) - case.H @ K
        first = np.block(
            [
                [Z, left.T, K.T],
                [left, case.R, np.zeros((N, 3))],
                [K, np.zeros((3, N)), case.prior],
            ]
        )
        second = np.block(
            [[np.array([[case.largest_step**2]]), case.kappa * b[None]], [case.kappa * b[:, None], np.eye(3)]]
        )
        rows = np.concatenate([case.kappa * case.A @ b - case.beta + zeta, zeta])
        return rows, scaled_half(first), scaled_half(second)

    def solve(self):
        """Gain, gradient and value.

        Returns:
            K (3, N), b (3,) less b^-, value, status.
        """
        found = clarabel.DefaultSolver(*self.arguments).solve()
        K = np.array(found.x)[: 3 * self.shape[1]].reshape(self.shape[1], 3).T
        return K, found.obj_val, str(found.status)


class Reduced:
    """(R) as a second-order cone program: b, zeta."""

    def __init__(self, case: Case, tolerance: float = 1e-10) -> None:
        m = len(case.beta)
        information = np.zeros((3 + m, 3 + m))
        information[:3, :3] = np.linalg.inv(case.covariance)
        cost = np.concatenate([-information[:3, :3] @ case.estimate, np.full(m, case.penalty)])
        ball = np.zeros((4, 3 + m))
        ball[1:, :3] = -np.eye(3)
        rows = np.vstack(
            [np.hstack([-case.kappa * case.A, -np.eye(m)]), np.hstack([np.zeros((m, 3)), -np.eye(m)]), ball]
        )
        right = np.concatenate([-case.beta, np.zeros(m), [case.largest_step / case.kappa, 0.0, 0.0, 0.0]])
        cones = [clarabel.NonnegativeConeT(2 * m), clarabel.SecondOrderConeT(4)]
        upper = sparse.csc_matrix(np.triu(information))
        self.arguments = (upper, cost, sparse.csc_matrix(rows), right, cones, settings(tolerance))

    def solve(self):
        """The gradient b (3,) and the status."""
        found = clarabel.DefaultSolver(*self.arguments).solve()
        return np.array(found.x)[:3], str(found.status)


def scaled_half(matrix):
    """Upper half by columns, entries off the diagonal times sqrt(2)."""
    size = len(matrix)
    return np.array([matrix[i, j] * (1.0 if i == j else np.sqrt(2.0)) for j in range(size) for i in range(j + 1)])
