"""A system A0 + s D with S and Q as systems beside one another that do not act on one another.

In coordinates in which T_0 is the identity such a system is a sum of orthogonal ones exactly where symmetric matrices
other than multiples of the identity commute with A0, D and S (and so with Q): their eigenspaces are the parts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from covocp.blocks.scaling import diagonal_scales
from covocp.blocks.theta_d_series import Start, inverse_lyapunov

Array = NDArray[np.float64]
Part = tuple[Start, Array, Array, Array]

# Systems with more states are split in their own coordinates only: the matrices that commute are n (n + 1)/2 unknowns.
MOST_STATES = 12
# Relative: singular values of T_0 that are zero, of the map of commutators, and of what must vanish between two parts;
# differences of eigenvalues that belong to one part.
SINGULAR, COMMUTING, APART, ALIKE = 1e-8, 1e-10, 1e-9, 1e-5


def separate(begin: Start, A0: Array, Q: Array, direction: Array) -> list[Part]:
    """The parts, each with its start, A0, Q and D in coordinates of its own.

    Args:
        begin: of `series.start`.
        A0: (n, n) [1/s].
        Q: weight of the state, (n, n).
        direction: D, (n, n).
    """
    weight, units = begin.root @ begin.root.T, diagonal_scales(begin.riccati)
    values, vectors = np.linalg.eigh(begin.riccati / units[:, None] / units)
    if len(A0) > 1 and len(A0) <= MOST_STATES and values[0] > SINGULAR * values[-1]:
        roots = np.sqrt(values)
        left, right = (vectors * roots).T * units, (vectors / roots) / units[:, None]  # z = left x, x = right z
        turned = [left @ A0 @ right, left @ direction @ right, left @ weight @ left.T]
        pieces = [(piece.T @ left, right @ piece) for piece in _commuting(turned)]
    else:
        identity = np.eye(len(A0))
        pieces = [(identity[rows], identity[:, rows]) for rows in _connected([A0, direction, weight, Q])]
    if len(pieces) == 1:
        return [(begin, A0, Q, direction)]
    return [_part(begin, A0, Q, direction, *piece) for piece in pieces]


def _part(begin: Start, A0: Array, Q: Array, direction: Array, left: Array, right: Array) -> Part:
    """That of the coordinates left @ x, which x = right @ z belongs to."""
    closed = left @ begin.closed_loop @ right
    start = replace(
        begin,
        riccati=right.T @ begin.riccati @ right,
        closed_loop=closed,
        feedback=begin.feedback @ left.T,
        root=left @ begin.root,
        inverse=inverse_lyapunov(closed),
    )
    return start, left @ A0 @ right, right.T @ Q @ right, left @ direction @ right


def _commuting(matrices: list[Array]) -> list[Array]:
    """Orthonormal bases (n, k) of the parts that some matrices and their transposes are made of."""
    n = len(matrices[0])
    given = [matrix / size for matrix in matrices if (size := float(np.linalg.norm(matrix))) > 0.0]
    rows, columns = np.triu_indices(n)
    basis = np.zeros((rows.size, n, n))
    basis[np.arange(rows.size), rows, columns] = basis[np.arange(rows.size), columns, rows] = 1.0
    commutators = np.hstack([(basis @ matrix - matrix @ basis).reshape(rows.size, -1) for matrix in given])
    vectors, sizes, _ = np.linalg.svd(commutators, full_matrices=False)
    free = vectors[:, sizes <= COMMUTING * max(sizes[0], np.finfo(float).tiny)]
    if free.shape[1] < 2:
        return [np.eye(n)]
    mixed = np.tensordot(free @ np.cos(1.0 + np.arange(free.shape[1])), basis, 1)
    values, turned = np.linalg.eigh(mixed)
    ends = np.flatnonzero(np.diff(values) > ALIKE * (values[-1] - values[0])) + 1
    pieces = np.split(turned, ends, axis=1)
    seen = [turned.T @ matrix @ turned for matrix in given]
    between = np.ones((n, n), dtype=bool)
    for span in np.split(np.arange(n), ends):
        between[np.ix_(span, span)] = False
    return pieces if all(np.abs(matrix[between]).max(initial=0.0) < APART for matrix in seen) else [np.eye(n)]


def _connected(matrices: list[Array]) -> list[list[int]]:
    """Indices of states that act on one another, directly or by others."""
    linked = np.any([(matrix != 0.0) | (matrix.T != 0.0) for matrix in matrices], axis=0)
    left, found = set(range(len(linked))), []
    while left:
        group, fresh = set[int](), {min(left)}
        while fresh:
            group |= fresh
            fresh = {int(j) for i in fresh for j in np.flatnonzero(linked[i])} - group
        left -= group
        found.append(sorted(group))
    return found
