"""Weighted recursive least squares with forgetting: the measurement update of the Kalman filter with M = P / gamma.

The weight of the sample i of N is a gamma^(N - i) (item 2). Dictionary to the filter (item 3): estimate before and
after -> prior and posterior estimate, regressor' -> H, P / gamma -> M, P after -> P, a^-1 -> R.
"""

from __future__ import annotations

from typing import Any, get_args

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.arguments import checked, positive, share, whole
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.blocks import values
from covocp.blocks.arithmetic import apply, definite_solve, precision, symmetric, unit
from covocp.blocks.scaling import scales
from covocp.blocks.updates import Missing, check_choice, reading, updating

Array = NDArray[np.float64]


def recursive_least_squares(
    estimate: Expr,
    covariance: Expr,
    regressor: Expr,
    output: Expr,
    *,
    forgetting: Expr = 1.0,
    weight: Expr = 1.0,
    missing: Missing = "raise",
) -> tuple[Any, Any]:
    """One sample more: L = P/g phi (1/a + phi' P/g phi)^-1, theta + L (y - phi' theta), P/g - L phi' P/g (item 2).

    Args:
        estimate: theta, shape (n,) or (n, 1).
        covariance: P, shape (n, n); times the variance of the noise of a sample of weight 1 it is that of the estimate.
        regressor: phi of y = phi' theta + noise, shape (n,) or, of p outputs, (n, p).
        output: y, a number or shape (p,).
        forgetting: g, 0 < g <= 1: what the weight of all earlier samples is multiplied by; 1: ordinary least squares.
        weight: a > 0 of this sample: a number or, of p outputs, symmetric positive definite, shape (p, p); 1 - g:
            exponential forgetting.
        missing: what an output that is NaN means: "raise": an error, "skip": no sample (earlier ones are forgotten
            as ever).

    Returns:
        Estimate and covariance with the sample, in the shapes of the arguments.

    Raises:
        ProblemError: shapes that do not fit, NaN, a covariance that is not positive semidefinite, a weight that is not
            positive definite, forgetting outside (0, 1].
    """
    x = values.matrix("estimate", estimate, (None, 1))
    size = x.shape[0]
    P, phi = values.weight("covariance", covariance, size), values.matrix("regressor", regressor, (size, None))
    g, a = _forgetting(forgetting), _weight(weight, phi.shape[1])
    y = reading("output", output, phi.shape[1], missing)
    correct = updating("joseph", missing)

    def sample(x: Expr, P: Expr, phi: Expr, y: Expr, g: Expr, a: Expr) -> tuple[Any, Any]:
        variance = symmetric(definite_solve(a, unit(a, a.shape[0]), "weight"))
        theta, spread = correct(x, P / g, y, phi.T, variance)
        return theta, spread

    kind = precision(estimate, covariance, regressor, output, forgetting, weight)
    theta, spread = apply(sample, x, P, phi, y, g, a, precision=kind)
    return values.restored(theta, estimate), values.restored(spread, covariance)


@checked(forgetting=share)
def least_squares_start(
    regressors: Expr, outputs: Expr, *, forgetting: float = 1.0, weight: Expr = 1.0, missing: Missing = "raise"
) -> tuple[Array, Array]:
    """Batch start of the recursion: theta and P = (sum of a g^(N-i) phi_i phi_i')^-1 of N samples (item 2), by QR.

    Args:
        regressors: shape (N, n), of p outputs (N, n, p).
        outputs: shape (N,), of p outputs (N, p).
        forgetting: g, 0 < g <= 1.
        weight: a, a number or shape (p, p).
        missing: what an output that is NaN means: "raise": an error, "skip": no sample.

    Returns:
        Estimate (n,) and covariance (n, n).

    Raises:
        ProblemError: shapes that do not fit, NaN, samples that do not determine every parameter (says how many).
    """
    check_choice("missing", missing, get_args(Missing))
    phi, y = values.array("regressors", regressors), values.array("outputs", outputs)
    phi, y = phi[..., None] if phi.ndim == 2 else phi, y[:, None] if y.ndim == 1 else y
    if phi.ndim != 3 or y.ndim != 2 or (phi.shape[0], phi.shape[2]) != y.shape:
        raise ProblemError(
            "The samples do not fit together.",
            expected="regressors (N, n) with outputs (N,), or (N, n, p) with (N, p)",
            received=f"{phi.shape} and {y.shape}",
            remedy="one row of each for a sample",
        )
    g = float(values.numeric("forgetting", _forgetting(forgetting)).item())
    a = values.numeric("weight", _weight(weight, y.shape[1]))
    discount = g ** (np.arange(len(y))[::-1] / 2.0)
    rows, right = [], []
    for scale, regressor, sample in zip(discount, phi, y, strict=True):
        there = np.isfinite(sample)
        if missing == "raise" or there.all():
            half = np.linalg.cholesky(a).T
        else:  # what is left of correlated outputs: the inverse of their part of a^-1
            half = np.linalg.cholesky(np.linalg.inv(np.linalg.inv(a)[np.ix_(there, there)])).T
        kept = there if missing == "skip" else np.ones(there.shape, dtype=bool)
        reading("outputs", sample[kept], int(kept.sum()), "raise")
        rows.append(scale * half @ regressor[:, kept].T)
        right.append(scale * half @ sample[kept])
    return _solved(np.vstack(rows), np.concatenate(right), phi.shape[1])


@checked(size=whole(0, 10**4), alpha=positive)
def diffuse_start(size: int, alpha: float = 1e6) -> tuple[Array, Array]:
    """Start of the recursion that knows nothing: estimate 0, covariance alpha I, alpha >> 1 (item 2).

    Args:
        size: number of parameters.
        alpha: relative to the variance of a sample's noise; parameters of size 1 are forgotten as 1/alpha.

    Returns:
        Estimate (size,) and covariance (size, size).
    """
    return np.zeros(size), alpha * np.eye(size)


def _solved(rows: Array, right: Array, size: int) -> tuple[Array, Array]:
    """Least squares and (rows' rows)^-1; the rank with columns of similar size, whatever the units."""
    units = scales(np.linalg.norm(rows, axis=0))
    rows = rows / units
    rank = int(np.linalg.matrix_rank(rows)) if rows.size else 0
    if rank < size:
        raise ProblemError(
            "The samples do not determine every parameter.",
            expected=f"regressors that span {size} dimensions",
            received=f"{rank} from {len(rows)} samples",
            remedy="start with more samples, or with diffuse_start",
        )
    orthogonal, triangle = np.linalg.qr(rows)
    inverse = np.linalg.solve(triangle, np.eye(size))
    inverse = inverse / units[:, None]
    return inverse @ (orthogonal.T @ right), inverse @ inverse.T


def _forgetting(value: Expr) -> Any:
    """A number in (0, 1] or an expression."""
    result = values.matrix("forgetting", value, (1, 1))
    if not values.is_symbolic(result) and not 0.0 < float(result) <= 1.0:
        remedy = "1 forgets nothing, 0.98 about all that is older than 50 samples"
        raise values.wrong_argument("forgetting", "a number in (0, 1]", f"{float(result):g}", remedy)
    return result


def _weight(value: Expr, size: int) -> Any:
    """The weight of a sample as a matrix; one number stands for all the outputs."""
    result = values.matrix("weight", value)
    if result.shape == (1, 1) and size != 1:
        values.weight("weight", value, 1, definite=True)
        return result * ca.DM.eye(size)
    return values.weight("weight", value, size, definite=True)
