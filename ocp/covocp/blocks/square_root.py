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

from covocp.base.expressions import Expr
from covocp.blocks.arithmetic import (
    apply,
    beside,
    diagonal,
    is_there,
    precision,
    symmetric,
    triangular_solve,
    unit_triangular,
    where,
)
from covocp.blocks.factors import corrected_factor, in_turn, triangular
from covocp.blocks.scaling import semidefinite_part, semidefinite_root
from covocp.blocks.updates import Missing, check_choice, reading, row_matrix, shift
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
        missing: what a row of y that is NaN, infinite or beyond 1e30 means: "raise": an error, "skip": no measurement
            of that row.

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
    correct = corrected_factor if form == "array" else _correct_in_turn
    law = _skipping_update if missing == "skip" else _measurement_update
    corrected, lower = apply(partial(law, correct), x, L, y, rows, V, precision=kind)
    return restored(corrected, estimate), restored(lower, factor)


def _definite_factor(P: Expr) -> tuple[Any]:
    lower, entries = unit_triangular(P, "covariance")
    return (lower @ diagonal(ca.sqrt(entries)),)


def _time_update(x: Expr, L: Expr, phi: Expr, G: Expr, drift: Expr) -> tuple[Any, Any]:
    return phi @ x + drift, triangular(beside(phi @ L, G))


def _measurement_update(correct: Correction, x: Expr, L: Expr, y: Expr, H: Expr, V: Expr) -> tuple[Any, Any]:
    return correct(x, L, y - H @ x, H, V)


def _skipping_update(correct: Correction, x: Expr, L: Expr, y: Expr, H: Expr, V: Expr) -> tuple[Any, Any]:
    """Rows that are missing become 0 = 0 x + noise of variance 1."""
    there = is_there(y)
    kept = diagonal(there)
    return correct(x, L, where(there, y - H @ x), kept @ H, beside(kept @ V, diagonal(1 - there)))


def _correct_in_turn(x: Expr, L: Expr, residual: Expr, H: Expr, V: Expr) -> tuple[Any, Any]:
    """As `corrected_factor`, by `in_turn`."""
    remedy = "take form='array', which does not square the root of the noise"
    lower, variances = unit_triangular(V @ V.T, "measurement noise, whose rows are correlated,", remedy)
    corrected, root = in_turn(x, L, triangular_solve(lower, residual), triangular_solve(lower, H), variances)
    return corrected, triangular(root)
