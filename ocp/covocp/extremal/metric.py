"""The metric int du' du dt of control values, and its root."""

from __future__ import annotations

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.transcription.mesh import Mesh


def mass_matrix(mesh: Mesh, duration: float, count: int) -> ca.DM:
    """The sparse matrix of int du' du dt for the control values, each of `count` entries."""
    h = np.diff(mesh.nodes) * duration
    matrix = ca.diag(ca.DM(h))
    if mesh.control == "linear":
        n = h.size
        beside = ca.DM.triplet(list(range(n)), list(range(1, n + 1)), ca.DM(h / 6.0), n + 1, n + 1)
        matrix = ca.diag(ca.DM(np.append(h, 0.0) + np.append(0.0, h)) / 3.0) + beside + beside.T
    return ca.kron(matrix, ca.DM.eye(count))


@dataclass(frozen=True, kw_only=True)
class Root:
    """Upper triangular R of a banded matrix R' R.

    Attributes:
        diagonal: of R, (V,).
        above: of each row what stands beside the diagonal, R[i, i + 1], R[i, i + 2], ..., (V, width).
        beside: of each column what stands above the diagonal, ..., R[i - 2, i], R[i - 1, i], (V, width).
    """

    diagonal: Array
    above: Array
    beside: Array

    __repr__ = short_repr

    @staticmethod
    def of(matrix: ca.DM) -> Root:
        """Of a sparse symmetric matrix.

        Raises:
            LinAlgError: it is not positive definite.
        """
        pivots, upper, _ = ca.ldl(matrix, False)
        squares, size = np.asarray(pivots.full()).ravel(), matrix.shape[0]
        if not (squares > 0.0).all():
            raise np.linalg.LinAlgError("the metric is not positive definite")
        diagonal = np.sqrt(squares)
        rows, columns = (np.array(place, dtype=np.intp) for place in upper.sparsity().get_triplet())
        width = int((columns - rows).max(initial=0))
        above, beside = np.zeros((2, size, width))
        above[rows, columns - rows - 1] = beside[columns, width - (columns - rows)] = diagonal[rows] * np.array(
            upper.nonzeros()
        )
        return Root(diagonal=diagonal, above=above, beside=beside)

    def solved(self, columns: Array, *, turned: bool = False) -> Array:
        """R^-1 of some columns, or R'^-1."""
        size, width = self.above.shape
        if not width or not columns.shape[1]:
            return columns / self.diagonal[:, None]
        found = columns.astype(float)
        for i in range(size) if turned else range(size - 1, -1, -1):
            if turned and i:
                reach = min(width, i)
                found[i] -= self.beside[i, width - reach :] @ found[i - reach : i]
            elif not turned and i < size - 1:
                reach = min(width, size - 1 - i)
                found[i] -= self.above[i, :reach] @ found[i + 1 : i + 1 + reach]
            found[i] /= self.diagonal[i]
        return found
