"""An order in which the system of a Gauss step is eliminated by its nonzeros, where that is less work."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr

# Largest share of the operations on the whole matrix: those by nonzeros are slower, three times on chains of masses.
LARGEST_SHARE = 0.3
# Rows of a covariance from which on it is looked at.
SMALLEST = 8


@dataclass(frozen=True, kw_only=True)
class Ordering:
    """Rows of the order of elimination, and the pattern behind the diagonal that it leads to.

    order: the row that is eliminated first, second, ... begins: where the columns behind the diagonal of each begin,
    and their end. columns: rising, counted in the order.
    """

    order: NDArray[np.intc]
    begins: NDArray[np.intc]
    columns: NDArray[np.intc]

    __repr__ = short_repr


def ordering(size: int, rows: list[int], columns: list[int]) -> Ordering | None:
    """An order for the pattern of h H; None where exchanging rows of the whole matrix is hardly more work.

    Args:
        size: n of the covariance.
        rows, columns: of the nonzeros of H.
    """
    if size < SMALLEST:
        return None
    height = 2 * size
    own = ca.Sparsity.triplet(height, height, rows, columns)
    product = ca.mtimes(ca.DM(own, 1.0), ca.DM(own, 1.0)).sparsity()
    pattern = own + product + ca.Sparsity.diag(height)
    transposed, order = (pattern + pattern.T).ldl(True)
    by_rows = transposed.T
    begins, inside = np.array(by_rows.colind()), np.array(by_rows.row())
    counts = np.diff(begins).astype(float)
    few = 2 * np.sum(counts**2) + 4 * counts.sum() * size
    whole = (2 / 3) * height**3 + 2 * height**2 * size
    if few > LARGEST_SHARE * whole:
        return None
    return Ordering(order=np.array(order, np.intc), begins=begins.astype(np.intc), columns=inside.astype(np.intc))
