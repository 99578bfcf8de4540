"""A quadratic model of a function around a point: its parameters, its regressor, and how it moves with the point.

f(x + d) - f(x) = b'd + d'M d / 2, linear in zeta = (M_11, ..., M_nn, M_12, M_13, ..., b_1, ..., b_n). Equations are
numbered as in docs/blocks/peak_seeking.md.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.arguments import checked, whole
from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import half_length
from covocp.base.short_repr import short_repr
from covocp.blocks.arithmetic import apply, precision
from covocp.blocks.updates import time_update
from covocp.blocks.values import array, is_symbolic, matrix, restored, weight, wrong_argument

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Parameters:
    """Where the Hessian and the gradient of a function of n inputs lie in the parameters zeta.

    Attributes:
        inputs: n.
        size: p = n (n + 1) / 2 + n, number of parameters.
        hessian: position of each entry of M, (n, n); M = zeta[hessian].
        gradient: positions of b, (n,); b = zeta[gradient].
    """

    inputs: int
    size: int
    hessian: NDArray[np.intp]
    gradient: NDArray[np.intp]

    __repr__ = short_repr


@checked(n=whole(1, 100))
def parameters(n: int) -> Parameters:
    """The layout of the parameters, (2).

    Args:
        n: number of inputs.

    Returns:
        Where M and b lie in zeta.

    Raises:
        ProblemError: n is no whole number from 1 to 100.
    """
    positions = np.diag(np.arange(n))
    for k, (i, j) in enumerate(combinations(range(n), 2)):
        positions[i, j] = positions[j, i] = n + k
    size = half_length(n) + n
    return Parameters(inputs=n, size=size, hessian=positions, gradient=np.arange(size - n, size))


def hessian(zeta: Expr) -> Any:
    """The Hessian M in the parameters.

    Args:
        zeta: shape (p,) or (p, 1), or numbers (..., p).

    Returns:
        Shape (n, n), or numbers (..., n, n).

    Raises:
        ProblemError: p is none of 2, 5, 9, 14, ...
    """
    layout = layout_of(zeta)
    if isinstance(zeta, (ca.SX, ca.MX)):
        n = layout.inputs
        return ca.reshape(zeta[layout.hessian.ravel().tolist()], n, n)
    return _numbers(zeta)[..., layout.hessian]


def gradient(zeta: Expr) -> Any:
    """The gradient b in the parameters.

    Args:
        zeta: shape (p,) or (p, 1), or numbers (..., p).

    Returns:
        Shape (n,), as expression (n, 1), or numbers (..., n).

    Raises:
        ProblemError: p is none of 2, 5, 9, 14, ...
    """
    layout = layout_of(zeta)
    if isinstance(zeta, (ca.SX, ca.MX)):
        return zeta[layout.gradient.tolist()]
    return _numbers(zeta)[..., layout.gradient]


def layout_of(zeta: Expr) -> Parameters:
    """The layout of parameters by their number.

    Raises:
        ProblemError: no number of inputs has so many.
    """
    size = zeta.shape[0] if isinstance(zeta, (ca.SX, ca.MX)) else _numbers(zeta).shape[-1]
    inputs = round((np.sqrt(9 + 8 * size) - 3) / 2)
    if inputs < 1 or half_length(inputs) + inputs != size:
        raise wrong_argument("zeta", "n (n + 1) / 2 + n parameters: 2, 5, 9, 14, ...", f"{size}")
    return parameters(inputs)


def _numbers(zeta: Expr) -> Array:
    """Parameters as an array, a column of CasADi flat."""
    return np.atleast_1d(array("zeta", zeta).ravel() if isinstance(zeta, ca.DM) else array("zeta", zeta))


def regressor(step: Expr) -> Any:
    """h of (2): f(x + step) - f(x) = h'zeta for a quadratic f.

    Args:
        step: from the point of expansion to another point, shape (n,) or (n, 1), or a number.

    Returns:
        h, shape (p,), as expression (p, 1).

    Raises:
        ProblemError: no vector, NaN or inf.
    """
    d = matrix("step", step, (None, 1))
    (h,) = apply(lambda value: (regressor_row(value.T).T,), d, precision=precision(step))
    return h if is_symbolic(h) else restored(h, np.zeros(1))


def regressor_row(d: Expr) -> Any:
    """h' as a row, (1, p), of a step as a row."""
    columns = [d[:, i : i + 1] for i in range(d.shape[1])]
    parts = [0.5 * c * c for c in columns] + [a * b for a, b in combinations(columns, 2)] + columns
    return np.hstack(parts) if isinstance(d, np.ndarray) else ca.horzcat(*parts)


def transport(estimate: Expr, covariance: Expr, step: Expr, *, noise: Expr = 0) -> tuple[Any, Any]:
    """The exact change of the point of expansion, (4): M stays, b becomes b + M step; P becomes F P F'.

    Args:
        estimate: zeta at the old point, shape (p,) or (p, 1).
        covariance: P of its error, positive semidefinite, shape (p, p).
        step: from the old point to the new one, shape (n,) or (n, 1), or a number.
        noise: W, added to the covariance afterwards for what is of third order: a number (times the identity), (p,)
            (its diagonal) or (p, p), positive semidefinite.

    Returns:
        Estimate and covariance at the new point, in the shapes of the arguments.

    Raises:
        ProblemError: shapes that do not fit, NaN, a covariance or noise that is not positive semidefinite.
    """
    x = matrix("estimate", estimate, (None, 1))
    layout = layout_of(x)
    P, d = weight("covariance", covariance, layout.size), matrix("step", step, (layout.inputs, 1))
    W = spread("noise", noise, layout.size)

    def moved(x: Expr, P: Expr, d: Expr, W: Expr) -> tuple[Any, Any]:
        return time_update(x, P, transition(d), W, 0 * x)

    kind = precision(estimate, covariance, step, noise)
    point, around = apply(moved, x, P, d, W, precision=kind)
    return restored(point, estimate), restored(around, covariance)


def transition(d: Expr) -> Any:
    """F of (4), unit lower triangular, for a step d, (n, 1)."""
    layout = parameters(d.shape[0])
    F: Any = np.eye(layout.size, dtype=d.dtype) if isinstance(d, np.ndarray) else ca.SX.eye(layout.size)
    for i, row in enumerate(layout.gradient.tolist()):
        for j, column in enumerate(layout.hessian[i].tolist()):
            F[row, column] = d[j, 0]
    return F


def spread(name: str, value: Expr, size: int) -> Any:
    """A covariance given as a number, as its diagonal, or as a matrix.

    Raises:
        ProblemError: another shape, not positive semidefinite.
    """
    if is_symbolic(value):
        return weight(name, ca.diag(value) if value.shape == (size, 1) and size > 1 else value, size)
    numbers = array(name, value)
    if numbers.ndim == 0:
        numbers = np.diag(np.full(size, numbers))
    elif numbers.shape == (size,):
        numbers = np.diag(numbers)
    if numbers.shape != (size, size):
        expected = f"a number, {size} numbers (its diagonal) or shape {size} x {size}"
        raise wrong_argument(name, expected, "shape " + " x ".join(str(count) for count in numbers.shape))
    return weight(name, numbers, size)
