"""The discrete filter on triangular factors of the covariance, for ill-conditioned cases.

P = L L' with L lower triangular is positive semidefinite whatever the rounding, and L has half the digits of P to
carry: a condition number of 1e24 of P is one of 1e12 of L. Both steps are one triangularisation by Householder
reflections: numbers by LAPACK's QR, expressions unrolled, so that they expand to SX and need no linear solver in C.
Many rows are taken faster one after the other, by Potter's form, one square root and one division each.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.blocks.arithmetic import (
    apply,
    below,
    beside,
    diagonal,
    is_there,
    precision,
    substituted,
    symmetric,
    triangular_solve,
    unit_triangular,
    where,
    zeros,
)
from covocp.blocks.scaling import semidefinite_part, semidefinite_root
from covocp.blocks.updates import Missing, check_choice, check_divisor, reading, row_matrix, shift
from covocp.blocks.values import is_symbolic, matrix, restored, square, weight

FactorForm = Literal["array", "sequential"]
# (estimate, root, residual, H, root of the noise) -> (estimate, root)
Correction = Callable[[Any, Any, Any, Any, Any], tuple[Any, Any]]


def factor(covariance: Expr) -> Any:
    """Lower triangular L with L L' = covariance.

    Args:
        covariance: positive semidefinite, shape (n, n); an expression must be definite.

    Returns:
        L, shape (n, n), its diagonal not negative.

    Raises:
        ProblemError: not symmetric, or not positive semidefinite.
    """
    P = weight("covariance", covariance)
    if is_symbolic(P):
        return apply(_definite_factor, P)[0]
    numbers = symmetric(P.full())
    try:
        lower = np.linalg.cholesky(numbers)
    except np.linalg.LinAlgError:  # singular: any root, made triangular
        lower = triangular(semidefinite_root(semidefinite_part(numbers)))
    return restored(lower.astype(precision(covariance)), covariance)


def predict_factor(
    estimate: Expr, factor: Expr, transition: Expr, noise_factor: Expr, *, drift: Expr = 0
) -> tuple[Any, Any]:
    """Time update of item 3 on factors: L+ L+' = Phi L L' Phi' + G G'.

    Args:
        estimate: after the last measurement, shape (n,) or (n, 1).
        factor: L of its covariance, any square root, shape (n, n).
        transition: Phi, shape (n, n).
        noise_factor: G, any square root of the noise covariance, such as Gamma1 R_w^1/2, shape (n, k).
        drift: what is known to be added, shape (n,); 0: nothing.

    Returns:
        Estimate and lower triangular factor before the next measurement.

    Raises:
        ProblemError: shapes that do not fit, NaN.
    """
    phi = square("transition", transition)
    size = phi.shape[0]
    x, L = matrix("estimate", estimate, (size, 1)), square("factor", factor, size)
    G = matrix("noise_factor", noise_factor, (size, None))
    kind = precision(estimate, factor, transition, noise_factor, drift)
    moved, lower = apply(_time_update, x, L, phi, G, shift(drift, size), precision=kind)
    return restored(moved, estimate), restored(lower, factor)


def update_factor(
    estimate: Expr,
    factor: Expr,
    measurement: Expr,
    H: Expr,
    R_factor: Expr,
    *,
    form: FactorForm = "array",
    missing: Missing = "raise",
) -> tuple[Any, Any]:
    """Measurement update of item 3 on factors.

    Forms: "array" triangularises [V, H L; 0, L]; "sequential" takes one row of the measurement after the other by
    Potter's form, rows that are correlated made independent first: fewer operations where the rows are many, but it
    squares V, so that noises that are nearly dependent belong to "array".

    Args:
        estimate: before the measurement, shape (n,) or (n, 1).
        factor: L of its covariance, any square root, shape (n, n).
        measurement: y, shape (m,) or (m, 1), or a number.
        H: shape (m, n), or (n,) for one measurement.
        R_factor: any square root of the covariance of the measurement noise, shape (m, m).
        form: of the equations.
        missing: what a row of y that is NaN or infinite means: "raise": an error, "skip": no measurement of that row.

    Returns:
        Estimate and lower triangular factor after the measurement.

    Raises:
        ProblemError: shapes that do not fit, NaN, a row without noise of something that is known exactly, an unknown
            form ("sequential": correlated noise that is singular).
    """
    check_choice("form", form, get_args(FactorForm))
    x, L = matrix("estimate", estimate, (None, 1)), square("factor", factor)
    size = x.shape[0]
    L, rows = square("factor", factor, size), row_matrix("H", H, size)
    y, V = reading("measurement", measurement, rows.shape[0], missing), square("R_factor", R_factor, rows.shape[0])
    kind = precision(estimate, factor, measurement, H, R_factor)
    correct = _correct if form == "array" else _correct_in_turn
    law = _skipping_update if missing == "skip" else _measurement_update
    corrected, lower = apply(partial(law, correct), x, L, y, rows, V, precision=kind)
    return restored(corrected, estimate), restored(lower, factor)


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


def _definite_factor(P: Expr) -> tuple[Any]:
    lower, entries = unit_triangular(P, "covariance")
    return (lower @ diagonal(ca.sqrt(entries)),)


def _time_update(x: Expr, L: Expr, phi: Expr, G: Expr, drift: Expr) -> tuple[Any, Any]:
    return phi @ x + drift, triangular(beside(phi @ L, G))


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


def _measurement_update(correct: Correction, x: Expr, L: Expr, y: Expr, H: Expr, V: Expr) -> tuple[Any, Any]:
    return correct(x, L, y - H @ x, H, V)


def _skipping_update(correct: Correction, x: Expr, L: Expr, y: Expr, H: Expr, V: Expr) -> tuple[Any, Any]:
    """Rows that are missing become 0 = 0 x + noise of variance 1."""
    there = is_there(y)
    kept = diagonal(there)
    return correct(x, L, where(there, y - H @ x), kept @ H, beside(kept @ V, diagonal(1 - there)))


def _correct_in_turn(x: Expr, L: Expr, residual: Expr, H: Expr, V: Expr) -> tuple[Any, Any]:
    """As `_correct`, by `in_turn`."""
    remedy = "take form='array', which does not square the root of the noise"
    lower, variances = unit_triangular(V @ V.T, "measurement noise, whose rows are correlated,", remedy)
    corrected, root = in_turn(x, L, triangular_solve(lower, residual), triangular_solve(lower, H), variances)
    return corrected, triangular(root)


def _correct(x: Expr, L: Expr, residual: Expr, H: Expr, V: Expr) -> tuple[Any, Any]:
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
