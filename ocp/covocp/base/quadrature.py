"""Steps and rules of integration, written once: Runge-Kutta, Gauss, Simpson, Hermite; numbers and expressions alike."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr, over, plus, times
from covocp.base.linear_solve import linear_solve
from covocp.base.matrices import Array

# Nodes of the two-stage Gauss method, shares of a step, both of weight 1/2.
GAP = math.sqrt(3.0) / 6.0
GAUSS_NODES = (0.5 - GAP, 0.5 + GAP)
# a of `gauss_transition`.
SHARE = 0.5 - 2.0 * GAP


def classical_step(rate: Callable[[Any, float], Any], value: Expr, h: Expr, first: Expr = None) -> Any:
    """One step of the classical Runge-Kutta method.

    Args:
        rate: (value, share of the step) -> slope.
        value: at the start.
        h: length of the step.
        first: the slope at the start, where it is known already.
    """
    half = over(h, 2)
    k1 = rate(value, 0.0) if first is None else first
    k2 = rate(plus(value, times(half, k1)), 0.5)
    k3 = rate(plus(value, times(half, k2)), 0.5)
    k4 = rate(plus(value, times(h, k3)), 1.0)
    total = plus(plus(plus(k1, times(2, k2)), times(2, k3)), k4)
    return plus(value, times(over(h, 6), total))


def hermite(start: Expr, end: Expr, slope_start: Expr, slope_end: Expr, c: Expr) -> Any:
    """Cubic Hermite polynomial at c in [0, 1]; slopes per unit of c."""
    shares = ((1 + 2 * c) * (1 - c) ** 2, c * (1 - c) ** 2, c**2 * (3 - 2 * c), c**2 * (c - 1))
    values = (start, slope_start, end, slope_end)
    first, second, third, fourth = (times(share, value) for share, value in zip(shares, values, strict=True))
    return plus(plus(plus(first, second), third), fourth)


def interpolated(values: Array, old: Array, new: Array) -> Array:
    """Columns, (K, n), interpolated linearly from their places to others."""
    return np.array([np.interp(new, old, column) for column in values.T]).reshape(values.shape[1], new.size).T


def simpson_weight(j: int, count: int) -> float:
    """Weight of point j of `count` equal steps, an even number, in the integral over [0, 1] by Simpson's rule."""
    return (1 if j in (0, count) else 4 if j % 2 else 2) / (3 * count)


def gauss_transition(points: Any, unit: Any, solve: Callable[[Any, Any], Any]) -> Any:
    """D = I + V, V = h/2 (H1 Y1 + H2 Y2), of the two-stage Gauss method with stages Y1, Y2 = Y1 + 2 g V.

    With g = sqrt(3)/6 (GAP) and a = 1/2 - 2 g (SHARE) the first stage is (I - g h H1) Y1 = I + a V, so V is had from Y1
    without a solve, and inserting it leaves one system of the size of H instead of twice that:

        [(I - g h H2)(I - g h H1) - a h/2 (H1 + H2)] Y1 = I - g h H2.

    Its matrix is regular where the Gauss method is (for constant H it is I - hH/2 + (hH)^2/12), and its factors keep
    the sparsity of F.

    Args:
        points: h H at the two nodes; numbers, stacks of them, or expressions.
        unit: the identity.
        solve: (matrix, right side) -> solution.
    """
    left, right, matrix = _eliminated(points, unit)
    return unit + (right @ solve(matrix, left) - unit) / SHARE


def gauss_arrivals(points: Any, unit: Any, solve: Callable[[Any, Any], Any]) -> tuple[Any, Any, Any]:
    """Transitions of the two-stage Gauss method to the end of a step of y' = A y, transposed: from its start and nodes.

    The method is its own adjoint: they are the last value and the stages of the step back, z' = -A' z from z(h) = I.
    Unlike an inverse of the transition from the start they exist where the step itself does.

    Args:
        points: h A at the two nodes.
        unit: the identity.
        solve: (matrix, right side) -> solution.

    Returns:
        Phi', Psi_1', Psi_2'.
    """
    left, right, matrix = _eliminated((points[1].T, points[0].T), unit)
    second = solve(matrix, left)
    change = (right @ second - unit) / SHARE
    return unit + change, second + 2 * GAP * change, second


def gauss_step(points: Any, forcing: Any, start: Expr, unit: Any, solve: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
    """The change of y over a step of y' = H y + f by the two-stage Gauss method, and its transition D.

    Args:
        points: h H at the two nodes, expressions.
        forcing: h f there.
        start: y.
        unit: the identity.
        solve: (matrix, right side) -> solution.
    """
    (_, _, change), (_, _, turn) = gauss_stages(points, forcing, start, unit, solve)
    return change, unit + turn


def gauss_stages(
    points: Any, forcing: Any, start: Expr, unit: Any, solve: Callable[[Any, Any], Any]
) -> tuple[tuple[Any, Any, Any], tuple[Any, Any, Any]]:
    """A step as `gauss_step` takes it, with y and its transition at the two nodes: their mean integrates y.

    Args:
        points, forcing, start, unit, solve: as of `gauss_step`; of several y, a column of each.

    Returns:
        Of y, and of the transition from the start: values at the first and the second node, change over the step.
    """
    left, right, matrix = _eliminated(points, unit)
    first, second = forcing
    ahead = start + GAP * first
    stages = solve(matrix, ca.horzcat(left @ ahead + SHARE / 2 * (first + second), left))
    y, transition = stages[:, : start.shape[1]], stages[:, start.shape[1] :]
    change, turn = (right @ y - ahead) / SHARE, (right @ transition - unit) / SHARE
    return (y, y + 2 * GAP * change, change), (transition, transition + 2 * GAP * turn, turn)


def _eliminated(points: Any, unit: Any) -> tuple[Any, Any, Any]:
    """I - g h H2, I - g h H1, and the matrix of the system that is left."""
    first, second = points
    left, right = unit - GAP * second, unit - GAP * first
    return left, right, left @ right - SHARE / 2 * (first + second)


def riccati_step(matrix: Expr, covariance: Expr, solve: Callable[[Any, Any], Any]) -> Any:
    """(D21 + D22 E)(D11 + D12 E)^-1, transposed: E after a step with the transition D; symmetric up to rounding."""
    size = covariance.shape[0]
    moved = matrix[:, :size] + matrix[:, size:] @ covariance
    return solve(moved[:size, :].T, moved[size:, :].T)


def covariance_after(matrix: Array, covariance: Array) -> Array:
    """A covariance after a step of a Riccati equation with the transition D."""
    after = riccati_step(matrix, covariance, np.linalg.solve)
    return np.asarray(0.5 * (after + after.T))


def lyapunov_after(matrix: Array, covariance: Array) -> Array:
    """The same for a Lyapunov equation: D12 is zero, and what rounding leaves there does not count.

    In Mars entry (feet and radians) it would change the expected cost by 5e-7 of itself.
    """
    size = covariance.shape[0]
    moved = matrix[size:, :size] + matrix[size:, size:] @ covariance
    after = np.linalg.solve(matrix[:size, :size].T, moved.T)
    return np.asarray(0.5 * (after + after.T))


def gauss_matrix(points: Any, size: int, solver: str) -> Expr:
    """The transition of 2 `size` rows as an expression, with a solver of CasADi's."""
    return gauss_transition(
        points, ca.DM.eye(2 * size), lambda matrix, right: linear_solve(matrix, ca.densify(right), solver)
    )
