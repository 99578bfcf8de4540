"""The gain of the Kalman filter, written once: numbers, stacks of them, and expressions alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from covocp.base.expressions import Expr
from covocp.base.riccati_rates import inverse

Solve = Callable[[Any, Any], Any]


def weighted(M: Expr, U: Expr, solve: Solve | None = None) -> Any:
    """M' U^-1, (n, r): what the readings tell by their noise; times M it is the information W of a Riccati rate.

    Args:
        M: measurement matrix, (r, n); there may be no rows.
        U: density of the noise, (r, r).
        solve: (matrix, right side) -> solution; None: numpy's for arrays, the inverse of U for expressions.
    """
    if solve is not None:
        return solve(U, M).T
    if isinstance(U, np.ndarray):
        return np.linalg.solve(U, M).mT
    return M.T @ inverse(U) if M.shape[0] else M.T


def kalman_gain(E: Expr, M: Expr, U: Expr, solve: Solve | None = None) -> Any:
    """Gain K = E M' U^-1 of the Kalman-Bucy filter, (n, r) [Schmidt 2.5-3]; arguments as of `weighted`."""
    return E @ weighted(M, U, solve)


def innovation_gain(P: Expr, H: Expr, R: Expr, solve: Solve) -> tuple[Any, Any]:
    """Gain L = P H' S^-1 of a measurement update, and the covariance S = H P H' + R of what is new in the readings."""
    seen = H @ P
    spread = seen @ H.T + R
    return solve(spread, seen).T, spread
