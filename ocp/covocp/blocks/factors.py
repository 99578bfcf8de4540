"""Triangular factors of covariances: triangularisation by reflections, and measurements taken on factors.

What a factor holds it holds to rounding of itself, so that a reading may be more accurate than the rounding of the
prior covariance: the update is right up to noises of 1e-32 of what the prior expects of the reading, not of 1e-16.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.blocks.arithmetic import below, beside, definite_solve, substituted, zeros


def triangular(roots: Expr) -> Any:
    """Lower triangular L, its diagonal not negative, with L L' = roots roots' for roots of at least as many columns."""
    count = roots.shape[0]
    if isinstance(roots, np.ndarray):
        if roots.shape[1] < count:
            roots = beside(roots, np.zeros((count, count - roots.shape[1]), dtype=roots.dtype))
        lower = np.tril(np.asarray(np.linalg.qr(roots.T, mode="r")).T)
        return lower * np.where(np.diag(lower) < 0.0, -1.0, 1.0).astype(lower.dtype)
    if roots.shape[1] < count:
        roots = beside(roots, ca.SX(count, count - roots.shape[1]))
    columns: list[Any] = []
    for i in range(count):
        roots = _reflected(roots if i == 0 else roots[1:, 1:])
        columns.append(ca.vertcat(ca.SX(i, 1), roots[:, 0]))
    return ca.horzcat(*columns)


def _reflected(block: Expr) -> Any:
    """The block times a Householder reflection that leaves of its first row the first entry, the norm of the row."""
    row = block[0, :]
    squares = ca.sumsqr(row)
    empty = squares <= 0
    norm = ca.if_else(empty, 0, ca.sqrt(ca.if_else(empty, 1, squares)))
    sign = ca.if_else(row[0] < 0, -1, 1)
    normal = row + beside(sign * norm, ca.SX(1, row.shape[1] - 1))
    scale = ca.if_else(empty, 0, 1 / ca.if_else(empty, 1, squares + ca.fabs(row[0]) * norm))
    result = block - (block @ normal.T) @ (scale * normal)
    result[0, :] = beside(-sign * norm, ca.SX(1, row.shape[1] - 1))
    return beside(-sign * result[:, 0], result[:, 1:])


def in_turn(x: Expr, L: Expr, residual: Expr, H: Expr, variances: Expr) -> tuple[Any, Any]:
    """Rows with independent noise one after the other, in Potter's form.

    Args:
        x: estimate, (n, 1).
        L: any square root of its covariance, (n, k).
        residual: y - H x, (m, 1).
        H: (m, n); a row of zeros, with a residual of zero, is no measurement.
        variances: of the noise, (m, 1).

    Returns:
        Estimate and square root, no longer triangular, of its covariance.
    """
    return in_turn_with_surprise(x, L, residual, H, variances)[:2]


def in_turn_with_surprise(x: Expr, L: Expr, residual: Expr, H: Expr, variances: Expr) -> tuple[Any, Any, Any]:
    """As `in_turn`, and the surprise r'S^-1 r of the residual r, whose covariance is S."""
    step, surprise = 0 * x, 0
    for i in range(H.shape[0]):
        h, r = H[i : i + 1, :], variances[i, 0]
        seen = (h @ L).T
        spread = (seen.T @ seen)[0, 0] + r
        check_divisor(spread)
        gain = (L @ seen) / spread
        left = residual[i, 0] - (h @ step)[0, 0]
        step, surprise = step + gain * left, surprise + left**2 / spread
        L = L - (gain / (1 + (r / spread) ** 0.5)) @ seen.T
    return x + step, L, surprise


def check_divisor(spread: Expr) -> None:
    """A row without noise of something that is known exactly has no update."""
    if not isinstance(spread, ca.SX) and not spread > 0.0:
        definite_solve(np.atleast_2d(spread), np.atleast_2d(spread), "covariance of the innovation, H P H' + R,")


def corrected_factor(x: Expr, L: Expr, residual: Expr, H: Expr, V: Expr) -> tuple[Any, Any]:
    """[V, H L; 0, L] becomes [S, 0; K S, L+] with S S' the covariance of the innovation."""
    count = H.shape[0]
    lower = triangular(below(beside(V, H @ L), beside(zeros(L, L.shape[0], V.shape[1]), L)))
    innovation, spread = lower[:count, :count], lower[count:, :count]
    return x + spread @ _substituted(innovation, residual), lower[count:, count:]


def _substituted(lower: Expr, right: Expr) -> Any:
    """lower^-1 right by substitution."""
    if isinstance(lower, np.ndarray):
        if np.diag(lower).min(initial=np.inf) <= 0.0:
            raise ProblemError(
                "The covariance of the innovation is singular.",
                expected="measurements with noise, or of what is not known exactly",
                received=f"a smallest entry of its factor of {np.diag(lower).min():.3g}",
                remedy="give every measurement some noise, and no measurement twice without noise",
            )
        return substituted(lower, right)
    rows: list[Any] = []
    for i in range(lower.shape[0]):
        known = sum((lower[i, j] * rows[j] for j in range(i)), ca.SX(1, 1))
        rows.append((right[i, 0] - known) / lower[i, i])
    return ca.vertcat(*rows)
