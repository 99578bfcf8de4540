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
        bands: of R, the diagonal last.
        turned: of R', the diagonal first.
    """

    bands: Array
    turned: Array

    __repr__ = short_repr

    @staticmethod
    def of(matrix: ca.DM) -> Root:
        """Of a sparse symmetric matrix.

        Raises:
            LinAlgError: it is not positive definite.
        """
        from scipy.linalg import cholesky_banded

        rows, columns = (np.array(place, dtype=np.intp) for place in matrix.sparsity().get_triplet())
        upper = columns >= rows
        rows, columns, values = rows[upper], columns[upper], np.array(matrix.nonzeros())[upper]
        width = int((columns - rows).max(initial=0))
        bands = np.zeros((width + 1, matrix.shape[0]))
        bands[width + rows - columns, columns] = values
        bands = cholesky_banded(bands, check_finite=False)
        turned = np.zeros_like(bands)
        for apart in range(width + 1):
            turned[apart, : bands.shape[1] - apart] = bands[width - apart, apart:]
        return Root(bands=bands, turned=turned)

    def solved(self, columns: Array, *, turned: bool = False) -> Array:
        """R^-1 of some columns, or R'^-1."""
        from scipy.linalg import solve_banded

        if not columns.shape[1]:
            return columns
        width = self.bands.shape[0] - 1
        shape, bands = ((width, 0), self.turned) if turned else ((0, width), self.bands)
        return np.asarray(solve_banded(shape, bands, columns, check_finite=False))
