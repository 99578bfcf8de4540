"""The metric of the step with what past steps have shown of the curvature: limited-memory BFGS.

B = B_0 - V N^-1 V',   V = [B_0 S, Y],   N = [[S' B_0 S, L], [L', -D]],

S and Y the last changes of the point and of the slopes of the Lagrangian along them, S'Y = L + D + (what is above), L
strictly lower, D diagonal [R. H. Byrd, J. Nocedal, R. B. Schnabel, Math. Programming 63, 1994, theorem 2.3]. B_0 = w W,
the metric of the source: the reduced Hessian differs from int du' H_uu du dt by an integral operator, which a few pairs
describe. Changes of slope that would make B indefinite are damped [M. J. D. Powell, Math. Programming 14, 1978].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import lu_factor, lu_solve
from scipy.sparse.linalg import splu

from covocp.base.expressions import Expr
from covocp.base.matrices import Array

# Share of d' B d below which the curvature seen along a step d is damped.
DAMPED = 0.2

Pair = tuple[Array, Array]


class Metric:
    """A symmetric positive definite matrix: a sparse one less V N^-1 V'."""

    def __init__(self, base: Expr, columns: Array, middle: Array) -> None:
        """Keep B_0, V, N."""
        self._base, self._columns, self._middle = base, columns, middle
        self._factor = lu_factor(middle) if middle.size else None

    @property
    def learns(self) -> bool:
        """Whether it has learnt something."""
        return self._factor is not None

    def plain(self) -> Metric:
        """The sparse one alone."""
        return Metric(self._base, self._columns[:, :0], self._middle[:0, :0])

    def __matmul__(self, vector: Array) -> Array:
        """B times a vector or the columns of a matrix."""
        product = np.asarray(self._base @ vector)
        if self._factor is None:
            return product
        return np.asarray(product - self._columns @ lu_solve(self._factor, self._columns.T @ vector))

    def __rmul__(self, factor: float) -> Metric:
        """A multiple of it."""
        return Metric(factor * self._base, factor * self._columns, factor * self._middle)

    def inverse(self, free: Expr) -> Callable[[Array], Array]:
        """right -> B_ff^-1 right, B_ff the rows and columns of some entries."""
        solve = splu(self._base[free][:, free].tocsc()).solve
        if self._factor is None:
            return solve
        rows = self._columns[free]
        solved = solve(rows)
        inner = lu_factor(self._middle - rows.T @ solved)

        def apply(right: Array) -> Array:
            first = solve(right)
            return np.asarray(first + solved @ lu_solve(inner, rows.T @ first))

        return apply


def learnt(base: Expr, pairs: Sequence[Pair]) -> Metric:
    """The metric from B_0 and the pairs (change of the point, change of the slope), the oldest first."""
    size = base.shape[0]
    if not pairs:
        return Metric(base, np.zeros((size, 0)), np.zeros((0, 0)))
    changes, turned = (np.column_stack(columns) for columns in zip(*pairs, strict=True))
    along = base @ changes
    products = changes.T @ turned
    lower = np.tril(products, -1)
    middle = np.block([[changes.T @ along, lower], [lower.T, -np.diag(np.diag(products))]])
    return Metric(base, np.hstack([along, turned]), middle)


def damped(change: Array, turned: Array, image: Array) -> Array:
    """The change of slope along a step, moved towards B d where the curvature seen is too small or negative.

    Args:
        change: the step d.
        turned: change of the slope along it.
        image: B d, for the B of the step.
    """
    seen, expected = float(change @ turned), float(change @ image)
    if seen >= DAMPED * expected:
        return turned
    share = (1 - DAMPED) * expected / (expected - seen)
    return np.asarray(share * turned + (1 - share) * image)
