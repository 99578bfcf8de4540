"""Certificates of a solution that do not trust the code that found it."""

from __future__ import annotations

import casadi as ca
import numpy as np


def lag_rates(solution, noise=1.0):
    """-H_x and -H_E of the first-order lag, written out [specification, 6.4], from states and costates at the nodes."""
    x, E = solution["x"], solution["E"]
    p, P = solution.costate("x"), solution.costate("E")
    F = np.zeros_like(E)
    F[:, 0, 0], F[:, 0, 1] = -1.0, -x
    W = np.diag([1 / noise, 0.0])
    A = F - E @ W
    matrix = -np.swapaxes(A, 1, 2) @ P - P @ A
    state = p + 2 * (P[:, 0, 0] * E[:, 0, 1] + P[:, 0, 1] * E[:, 1, 1])
    return state, matrix


def lag_hamiltonian(solution, noise=1.0):
    """H = u^2/2 + p (-x + u) + tr(P V) at the nodes."""
    x, u, E = solution["x"], solution["u"], solution["E"]
    p, P = solution.costate("x"), solution.costate("E")
    F = np.zeros_like(E)
    F[:, 0, 0], F[:, 0, 1] = -1.0, -x
    V = F @ E + E @ np.swapaxes(F, 1, 2) + np.diag([1.0, 0.0]) - E @ np.diag([1 / noise, 0.0]) @ E
    return u**2 / 2 + p * (-x + u) + np.trace(P @ V, axis1=1, axis2=2)


def is_symmetric(matrices):
    return np.array_equal(matrices, np.swapaxes(matrices, -1, -2))


def second_singular_value(matrices):
    """Largest ratio of second to first singular value: zero for rank one."""
    values = np.linalg.svd(matrices, compute_uv=False)
    return float((values[:, 1] / values[:, 0].max()).max())


def evaluate(expression, symbols, values):
    return np.asarray(ca.Function("f", symbols, [expression])(*values).full())
