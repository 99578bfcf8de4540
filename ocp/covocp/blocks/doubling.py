"""Riccati equations by structure-preserving doubling, which needs no eigenvalues.

The iteration squares the distance of the closed loop's modes from the unit circle in each step [Chu, Fan, Lin, Wang,
Structure-preserving algorithms for periodic discrete-time algebraic Riccati equations, Int. J. Control 77 (2004)].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from covocp.blocks.reachability import balance
from covocp.blocks.scaling import over

Array = NDArray[np.float64]

# Doublings: 2^60 steps of the recursion, more than a mode that is a rounding error away from the unit circle needs.
DOUBLINGS = 60
# Relative change in which rounding ends the quadratic convergence.
CONVERGED = 1e-15
# Points of Cayley's transform, in sizes of A.
POINTS = (1.0, 0.1, 10.0, 1e-3, 1e3)


def doubled(A: Array, B: Array, Q: Array, R: Array, N: Array, *, discrete: bool) -> Array:
    """Stabilising solution of the Riccati equation, to what the conditions of the steps leave.

    Args:
        A: (n, n).
        B: (n, m).
        Q: weight of the state, (n, n).
        R: weight of the control, (m, m), its diagonal of size 1.
        N: weight of state times control, (n, m).
        discrete: which equation.

    Raises:
        LinAlgError: a step is singular, or none converges.
    """
    A, Q = A - B @ np.linalg.solve(R, N.T), Q - N @ np.linalg.solve(R, N.T)
    A, units = balance(A)
    B, Q = B / units[:, None], Q * units[:, None] * units
    G = B @ np.linalg.solve(R, B.T)
    # Both halves of the problem of similar size: S in units of the root of Q over G.
    weights = np.array([np.linalg.norm(Q, 2), np.linalg.norm(G, 2)])
    unit = 2.0 ** np.round(np.log2(weights[0] / weights[1]) / 2.0) if weights.all() else 1.0
    G, Q = G * unit, Q / unit
    return over(_limit(A, G, Q) if discrete else _by_cayley(A, G, Q), units) * unit


def _by_cayley(A: Array, G: Array, Q: Array) -> Array:
    """The continuous equation as a discrete one with the same solution, from the first point that makes it regular."""
    eye = np.eye(len(A))
    size = max(float(np.linalg.norm(A, 2)), float(np.sqrt(np.linalg.norm(G, 2) * np.linalg.norm(Q, 2))))
    for point in POINTS:
        shift = point * size
        try:
            moved = np.linalg.inv(A - shift * eye)
            W = (A - shift * eye).T + Q @ moved @ G
            inner = np.linalg.inv(W)
            start = eye + 2.0 * shift * inner.T
            return _limit(start, 2.0 * shift * moved @ G @ inner, 2.0 * shift * inner @ Q @ moved)
        except np.linalg.LinAlgError as error:
            failed = error
    raise failed


def _limit(A: Array, G: Array, S: Array) -> Array:
    """Where A, G, S go by A W A, G + A W G A', S + A'S W A with W = (1 + G S)^-1."""
    eye = np.eye(len(A))
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            G, S = (G + G.T) / 2.0, (S + S.T) / 2.0
            step = np.linalg.solve(eye + G @ S, np.hstack([A, G]))
            forward, spread = step[:, : len(A)], step[:, len(A) :]
            change = A.T @ S @ forward
            A, G, S = A @ forward, G + A @ spread @ A.T, S + change
            if not np.isfinite(S).all():
                break
            if np.abs(change).max(initial=0.0) <= CONVERGED * np.abs(S).max(initial=0.0):
                return S
    raise np.linalg.LinAlgError("doubling does not converge")
