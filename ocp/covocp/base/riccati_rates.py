"""Recognition of matrix rates of Riccati or Lyapunov form.

A rate V(E) = F E + E F' + Q - E W E, with F, Q, W independent of E, takes covariance steps that stay positive
semidefinite at any step size (`integrators`). The estimation covariance has this form by construction; the rate of a
general symmetric state is examined here.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.checks import check_density
from covocp.base.expressions import Expr, trial_values
from covocp.base.matrices import half_indices, pack_symbolic, unpack_symbolic

# Agreement asked between a rate and its recognised form at random points.
RECOGNITION_TOLERANCE = 1e-9
RECOGNITION_POINTS = 3


def riccati_rate(covariance: Expr, drift: Expr, noise: Expr, information: Expr) -> Any:
    """Rate F E + E F' + Q - E W E of a covariance, W = M' U^-1 M [Schmidt 2.5-3]; all n x n."""
    product = drift @ covariance
    return product + product.T + noise - covariance @ information @ covariance


def inverse(density: Expr) -> Any:
    """Inverse of a density or weight matrix, with as much structure as it has.

    Raises:
        ProblemError: where it is constant and not positive definite.
    """
    if density.is_constant():
        numbers = ca.evalf(density).full()
        check_density("measurement", "noise density", numbers, definite=True)
        return ca.sparsify(ca.DM(np.linalg.inv(numbers)))
    if density.sparsity().is_diag():
        return ca.diag(1.0 / ca.diag(density))
    return ca.inv(density)


def recognise(rate: Expr, half: Expr, size: int) -> tuple[Any, Any, Any] | None:
    """F, Q, W of a rate, as expressions, or None where it has not the Riccati form.

    Args:
        rate: half-vector of V, SX, n(n+1)/2 entries.
        half: symbols of the half-vector of E, SX.
        size: n.

    Returns:
        Three n x n SX expressions, or None.
    """
    slope = ca.jacobian(rate, half)
    curvature = ca.jacobian(slope, half)
    if ca.depends_on(curvature, half):
        return None
    zero = ca.SX.zeros(half.shape[0])
    constant, linear = (ca.substitute(entry, half, zero) for entry in (rate, slope))
    drift, information = ca.SX.zeros(size, size), ca.SX.zeros(size, size)
    rows, columns = (indices.tolist() for indices in half_indices(size))
    position = {pair: k for k, pair in enumerate(zip(rows, columns, strict=True))}
    for i in range(size):
        along = linear[:, position[i, i]]  # rate along e_i e_i': F's column i enters row i and column i
        for j in range(size):
            entry = along[position[max(i, j), min(i, j)]]
            drift[j, i] = entry / 2 if i == j else entry
        # at E = e_i e_i' the slope of -E W E along e_j e_i' + e_i e_j' has -2 W_ij as its entry (i, i)
        probe = ca.SX.zeros(half.shape[0])
        probe[position[i, i]] = 1.0
        quadratic = (ca.substitute(slope, half, probe) - linear)[position[i, i], :]
        for j in range(size):
            information[i, j] = -quadratic[position[max(i, j), min(i, j)]] / 2
    form = pack_symbolic(riccati_rate(unpack_symbolic(half, size), drift, unpack_symbolic(constant, size), information))
    return (drift, unpack_symbolic(constant, size), information) if same(rate, form, half) else None


def same(first: Expr, second: Expr, half: Expr) -> bool:
    """Whether two expressions agree at a few points."""
    symbols = ca.symvar(ca.veccat(first, second, half))
    function = ca.Function("both", [ca.veccat(*symbols)], [first, second])
    count = len(symbols)
    for k in range(RECOGNITION_POINTS):
        one, two = (np.asarray(v.full()) for v in function(trial_values(count, k * count)))
        if not np.allclose(one, two, rtol=RECOGNITION_TOLERANCE, atol=RECOGNITION_TOLERANCE, equal_nan=False):
            return False
    return True
