"""The discrete Kalman filter: prediction, and the measurement update in four forms, equal in exact arithmetic.

x+ = Phi x + Gamma u + Gamma1 w, y = H x + v; M is the covariance before, P that after the measurement (item 3).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.gains import innovation_gain
from covocp.blocks.arithmetic import (
    apply,
    definite_root,
    definite_solve,
    diagonal,
    is_there,
    precision,
    semidefinite,
    substituted,
    symmetric,
    triangular_solve,
    unit,
    unit_triangular,
    where,
)
from covocp.blocks.factors import check_divisor, corrected_factor, in_turn
from covocp.blocks.scaling import diagonal_scales, over, semidefinite_part, semidefinite_root
from covocp.blocks.values import SYMBOLIC, array, is_symbolic, matrix, restored, square, weight

Array = NDArray[Any]
Form = Literal["joseph", "standard", "sequential", "information"]
# Remedies: two accurate sensors of one state leave H P H' + R singular to rounding, each by itself does not.
IN_TURN = (
    "give every measurement some noise; where rounding hides it, take one row after the other "
    "(form='sequential', where there is a choice) or the square-root form"
)
NOT_DIVIDED = "take form='sequential' or 'joseph', which need no inverse of the covariance"
Missing = Literal["raise", "skip"]


def predict(estimate: Expr, covariance: Expr, transition: Expr, noise: Expr, *, drift: Expr = 0) -> tuple[Any, Any]:
    """Time update of item 3: x = Phi x + drift, M = Phi P Phi' + Gamma1 R_w Gamma1'.

    Args:
        estimate: after the last measurement, shape (n,) or (n, 1).
        covariance: of its error, shape (n, n).
        transition: Phi, shape (n, n).
        noise: Gamma1 R_w Gamma1', positive semidefinite, shape (n, n).
        drift: Gamma u or whatever else is known to be added, shape (n,); 0: nothing.

    Returns:
        Estimate and covariance before the next measurement, in the shapes of the arguments.

    Raises:
        ProblemError: shapes that do not fit, NaN, a covariance or noise that is not positive semidefinite.
    """
    phi = square("transition", transition)
    size = phi.shape[0]
    x, P = matrix("estimate", estimate, (size, 1)), weight("covariance", covariance, size)
    Q, known = weight("noise", noise, size), shift(drift, size)
    kind = precision(estimate, covariance, transition, noise, drift)
    moved, spread = apply(time_update, x, P, phi, Q, known, precision=kind)
    return restored(moved, estimate), restored(spread, covariance)


def shift(drift: Expr, size: int) -> Any:
    """What is added to a prediction as a column; the number 0 stands for nothing."""
    nothing = not is_symbolic(drift) and not array("drift", drift).ndim and float(drift) == 0.0
    return ca.DM.zeros(size, 1) if nothing else matrix("drift", drift, (size, 1))


def time_update(x: Expr, P: Expr, phi: Expr, noise: Expr, drift: Expr) -> tuple[Any, Any]:
    """Item 3; all are matrices of one kind."""
    return phi @ x + drift, semidefinite(symmetric(phi @ P @ phi.T + noise))


def update(
    estimate: Expr,
    covariance: Expr,
    measurement: Expr,
    H: Expr,
    R: Expr,
    *,
    form: Form = "joseph",
    missing: Missing = "raise",
) -> tuple[Any, Any]:
    """Measurement update of item 3: x + L (y - H x), P = (I - L H) M (I - L H)' + L R L', L = M H'(H M H' + R)^-1.

    Forms: "joseph" as above, positive semidefinite whatever the rounding of the gain; "standard" P = M - L H M;
    "sequential" one row of the measurement after the other, by scalar divisions only, rows that are correlated made
    independent first; "information" P = (M^-1 + H' R^-1 H)^-1 on a root of M, for definite M and R. Numbers of which
    H M H' + R holds too little of R for a gain are taken on roots of M and R in every form.

    Args:
        estimate: before the measurement, shape (n,) or (n, 1).
        covariance: M, shape (n, n).
        measurement: y, shape (m,) or (m, 1), or a number.
        H: shape (m, n), or (n,) for one measurement.
        R: covariance of v, positive semidefinite, shape (m, m).
        form: of the equations.
        missing: what a row of y that is NaN, infinite or beyond 1e30 means: "raise": an error (an expression is
            trusted), "skip": no measurement of that row.

    Returns:
        Estimate and covariance after the measurement, in the shapes of the arguments; numeric covariances are positive
        semidefinite.

    Raises:
        ProblemError: shapes that do not fit, NaN, a covariance that is not positive semidefinite, a singular
            H M H' + R ("sequential": correlated R; "information": M or R), an unknown form.
    """
    x, P = matrix("estimate", estimate, (None, 1)), square("covariance", covariance)
    size = x.shape[0]
    P = weight("covariance", covariance, size)
    rows = row_matrix("H", H, size)
    y = reading("measurement", measurement, rows.shape[0], missing)
    U = weight("R", R, rows.shape[0])
    kind = precision(estimate, covariance, measurement, H, R)
    corrected, spread = apply(updating(form, missing), x, P, y, rows, U, precision=kind)
    return restored(corrected, estimate), restored(spread, covariance)


def joseph(covariance: Expr, gain: Expr, H: Expr, R: Expr) -> Any:
    """Covariance after an update with any gain L: (I - L H) M (I - L H)' + L R L', of item 3.

    Args:
        covariance: M, shape (n, n).
        gain: L, shape (n, m), the best one or another.
        H: shape (m, n).
        R: covariance of the measurement noise, shape (m, m).

    Returns:
        P, shape (n, n), positive semidefinite to rounding.

    Raises:
        ProblemError: shapes that do not fit, a covariance that is not positive semidefinite.
    """
    P = weight("covariance", covariance)
    rows = row_matrix("H", H, P.shape[0])
    L = matrix("gain", gain, (P.shape[0], rows.shape[0]))
    kind = precision(covariance, gain, H, R)
    (spread,) = apply(lambda *v: (joseph_form(*v),), P, L, rows, weight("R", R, rows.shape[0]), precision=kind)
    return restored(spread, covariance)


def row_matrix(name: str, value: Expr, size: int) -> Any:
    """A measurement matrix of `size` columns; a flat array of that many numbers is one row."""
    if not isinstance(value, (*SYMBOLIC, ca.DM)):
        numbers = array(name, value)
        value = numbers[None, :] if numbers.shape == (size,) else value
    return matrix(name, value, (None, size))


def reading(name: str, value: Expr, size: int, missing: Missing) -> Any:
    """A measurement as a column, NaN where numbers are missing and that is allowed.

    Raises:
        ProblemError: another size, NaN or inf where they are not allowed.
    """
    check_choice("missing", missing, get_args(Missing))
    if is_symbolic(value):
        return matrix(name, value, (size, 1))
    numbers = array(name, value)
    gaps = ~np.isfinite(numbers)
    if gaps.any() and missing == "raise":
        raise ProblemError(
            f"The argument '{name}' has a missing reading.",
            expected="finite numbers",
            received=f"{numbers.ravel()}",
            remedy="missing='skip' leaves such rows out",
        )
    column = matrix(name, np.where(gaps, 0.0, numbers), (size, 1))
    if gaps.any():
        column[np.flatnonzero(gaps.ravel()).tolist()] = np.nan
    return column


def check_choice(name: str, value: Expr, choices: tuple[str, ...]) -> None:
    """One of some words.

    Raises:
        ProblemError: another.
    """
    if not isinstance(value, str) or value not in choices:
        raise ProblemError(
            f"The argument '{name}' is unknown.",
            expected=", ".join(repr(choice) for choice in choices),
            received=repr(value),
            remedy="choose one of them",
        )


def updating(form: Form, missing: Missing) -> Callable[..., tuple[Any, Any]]:
    """The law (x, M, y, H, R) -> (x, P) of one form.

    Raises:
        ProblemError: an unknown form.
    """
    check_choice("form", form, tuple(FORMS))
    check_choice("missing", missing, get_args(Missing))
    correct = FORMS[form]

    def measurement_update(x: Expr, P: Expr, y: Expr, H: Expr, R: Expr) -> tuple[Any, Any]:
        residual, rows, noise = present(y - H @ x, y, H, R) if missing == "skip" else (y - H @ x, H, R)
        step, spread = correct(P, residual, rows, noise)
        return x + step, semidefinite(spread, P)

    return measurement_update


def present(residual: Expr, y: Expr, H: Expr, R: Expr) -> tuple[Any, Any, Any]:
    """Residual, H and R without the rows that are missing."""
    there = is_there(y)
    return where(there, residual), *without(there, H, R)


def without(there: Expr, H: Expr, R: Expr) -> tuple[Any, Any]:
    """H and R without the rows that are missing: these become 0 = 0 x + noise of variance 1, uncorrelated."""
    kept = diagonal(there)
    return kept @ H, kept @ R @ kept + diagonal(1 - there)


def joseph_form(P: Expr, L: Expr, H: Expr, R: Expr) -> Any:
    """Covariance of item 3 for any gain."""
    remaining = unit(P, P.shape[0]) - L @ H
    return symmetric(remaining @ P @ remaining.T + L @ R @ L.T)


def corrected_by_factors(P: Array, residual: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """Step and covariance by a triangularisation of roots, which holds R beside H M H' down to its own rounding."""
    root, noise = semidefinite_root(semidefinite_part(P)), semidefinite_root(semidefinite_part(R))
    step, lower = corrected_factor(0 * P[:, :1], root, residual, H, noise)
    return step, lower @ lower.T


def noise_left(P: Expr, H: Expr, R: Expr) -> float:
    """What of R is left in H M H' + R of numbers: the smallest pivot of that matrix with unit diagonal, 0 where none.

    The gain that it holds has an error of about eps / pivot^1.5 standard deviations of the estimate. One reading
    alone, and expressions, of which nothing is known: 1.
    """
    if not isinstance(P, np.ndarray) or len(R) < 2:
        return 1.0
    spread = symmetric(H @ P @ H.T + R)
    try:
        return float(np.diag(np.linalg.cholesky(over(spread, diagonal_scales(spread)))).min() ** 2)
    except np.linalg.LinAlgError:
        return 0.0


def enough(P: Expr) -> float:
    """The noise that must be left for an error of about 1e-8 standard deviations, of the root of eps in general."""
    return float(np.finfo(P.dtype).eps) ** (1 / 3) if isinstance(P, np.ndarray) else 0.0


def definite_gain(P: Expr, H: Expr, R: Expr) -> Any:
    """L = M H'(H M H' + R)^-1, by a solver for positive definite matrices."""
    what = "covariance of the innovation, H P H' + R,"
    return innovation_gain(P, H, R, lambda S, seen: definite_solve(symmetric(S), seen, what, IN_TURN))[0]


def _joseph(P: Expr, residual: Expr, H: Expr, R: Expr) -> tuple[Any, Any]:
    if 0.0 < noise_left(P, H, R) < enough(P):
        return corrected_by_factors(P, residual, H, R)
    L = definite_gain(P, H, R)
    return L @ residual, joseph_form(P, L, H, R)


def _standard(P: Expr, residual: Expr, H: Expr, R: Expr) -> tuple[Any, Any]:
    if 0.0 < noise_left(P, H, R) < enough(P):
        return corrected_by_factors(P, residual, H, R)
    L = definite_gain(P, H, R)
    return L @ residual, symmetric(P - L @ (H @ P))


def _information(P: Expr, residual: Expr, H: Expr, R: Expr) -> tuple[Any, Any]:
    """On a root of M: the sum of the inverses would round away what is small beside an accurate reading."""
    if isinstance(P, np.ndarray):
        noise = definite_root(R, "measurement noise R", NOT_DIVIDED)
        root = definite_root(P, "covariance", NOT_DIVIDED)
        rows, residual, variances = condensed(P, *whitened(noise, H, residual))
    else:
        lower, variances = unit_triangular(R, "measurement noise R")
        rows, residual = triangular_solve(lower, H), triangular_solve(lower, residual)
        lower, entries = unit_triangular(P, "covariance")
        root = lower @ diagonal(ca.sqrt(entries))
    step, root = in_turn(0 * P[:, :1], root, residual, rows, variances)
    return step, symmetric(root @ root.T)


def whitened(noise: Array, H: Array, residual: Array) -> tuple[Array, Array]:
    """Rows and residual in units of independent noises of variance 1; `noise`: a lower triangular root of R."""
    spreads = np.diag(noise)[:, None]
    if not np.any(np.tril(noise, -1)):
        return H / spreads, residual / spreads
    return substituted(noise, H), substituted(noise, residual)


def condensed(P: Array, H: Array, residual: Array) -> tuple[Array, Array, Array]:
    """Rows, residual and variances of as many measurements of noise 1 as there are states, where there are many more.

    By reflections, the largest rows and columns first in units of the prior: so every row keeps its own digits beside
    those that are more accurate [Cox and Higham, Stability of Householder QR factorization for weighted least squares
    problems, 1998].
    """
    size = len(P)
    if len(H) <= 2 * size:
        return H, residual, np.ones_like(residual)
    from scipy.linalg import qr_multiply

    units = np.sqrt(np.diag(P))
    scaled = H * units
    order = np.argsort(-np.abs(scaled).max(axis=1), kind="stable")
    left, triangle, columns = qr_multiply(scaled[order], residual[order, 0], mode="right", pivoting=True)
    rows = np.empty_like(triangle)
    rows[:, columns] = triangle
    return rows / units, left[:, None], np.ones_like(left)[:, None]


def _sequential(P: Expr, residual: Expr, H: Expr, R: Expr) -> tuple[Any, Any]:
    """Row by row; the covariance in Joseph form, its products with I - k h written as corrections of rank one."""
    remedy = "give every row some noise of its own, or take form='joseph'"
    lower, variances = unit_triangular(R, "measurement noise R, whose rows are correlated,", remedy)
    rows, residual = triangular_solve(lower, H), triangular_solve(lower, residual)
    step = 0 * P[:, :1]
    if noise_left(P, H, R) < enough(P) and variances.min() > 0.0:  # rounding between two rows hides the second
        step, root = in_turn(step, semidefinite_root(semidefinite_part(P)), residual, rows, variances)
        return step, root @ root.T
    for i in range(rows.shape[0]):
        h, r = rows[i : i + 1, :], variances[i, 0]
        seen = P @ h.T
        spread = (h @ seen)[0, 0] + r
        check_divisor(spread)
        k = seen / spread
        step = step + k * (residual[i, 0] - (h @ step)[0, 0])
        left = P - k @ seen.T
        P = symmetric(left - (left @ h.T) @ k.T + r * (k @ k.T))
    return step, P


FORMS: dict[str, Callable[[Any, Any, Any, Any], tuple[Any, Any]]] = {
    "joseph": _joseph,
    "standard": _standard,
    "sequential": _sequential,
    "information": _information,
}
