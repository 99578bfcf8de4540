"""Piecewise cubic polynomials of states and half-vectors, and one table of several that have knots of their own."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import SEMIDEFINITE_TOLERANCE, Array, distinct, unpack
from covocp.base.quadrature import hermite
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal
from covocp.statement.statement import Block
from covocp.transcription.mesh import SAME_NODE

# Points inside a piece at which a covariance is looked at.
LOOKS = 7
# Knots closer than this share of what is before them in their interval, or of it before its end, are one.
SAME = 1e-10


@dataclass(frozen=True, kw_only=True, eq=False)
class Dense:
    """States and half-vectors as piecewise cubic polynomials of the normalised time.

    Args:
        knots: normalised times, (P + 1,), rising from 0 to 1; the nodes of the mesh are among them, twice where a
            measurement is taken: the piece between has no length.
        values: x and e stacked there, (P + 1, nx + ne).
        first: slopes by the normalised time at the starts of the pieces, (P, nx + ne).
        last: slopes at their ends, which differ where a rate jumps.
    """

    knots: Array
    values: Annotated[Array, "knots xe"]
    first: Annotated[Array, "pieces xe"]
    last: Annotated[Array, "pieces xe"]

    __repr__ = short_repr

    def at(self, s: Array, *, before: bool = False) -> Array:
        """x and e stacked at some normalised times, (K, nx + ne); before or after what is read there."""
        side: Any = "left" if before else "right"
        k = np.clip(np.searchsorted(self.knots, s, side=side) - 1, 0, self.knots.size - 2)
        h = (self.knots[k + 1] - self.knots[k])[:, None]
        c = np.where(h > 0, (s[:, None] - self.knots[k][:, None]) / lengths(h), float(not before))
        with np.errstate(invalid="ignore", over="ignore"):  # of what left the range of numbers: its status says so
            first, last = h * self.first[k], h * self.last[k]
            return np.asarray(hermite(self.values[k], self.values[k + 1], first, last, c), dtype=float)


def lengths(h: Array) -> Array:
    """Lengths of pieces, to divide by: 1 of those that have none."""
    return np.where(h > 0, h, 1.0)


def rows_of(dense: Dense, rows: list[int]) -> Dense:
    """Some entries."""
    return Dense(knots=dense.knots, values=dense.values[:, rows], first=dense.first[:, rows], last=dense.last[:, rows])


def joined(extremal: Extremal, tracks: list[tuple[list[int], Dense]]) -> Dense:
    """One table of all entries, on the knots of all."""
    knots = _union(extremal.mesh.nodes, [dense.knots for _, dense in tracks])
    size = extremal.statement.nx + extremal.statement.ne
    values, first, last = np.zeros((knots.size, size)), *np.zeros((2, knots.size - 1, size))
    for rows, dense in tracks:
        parts = (dense.values, dense.first, dense.last)
        if not np.array_equal(dense.knots, knots):
            parts = _restricted(dense, knots)
        values[:, rows], first[:, rows], last[:, rows] = parts
    result = Dense(knots=knots, values=values, first=first, last=last)
    for block in extremal.statement.matrices:
        if block.covariance:
            _straighten(result, block, extremal.statement.nx)
    return result


def _union(nodes: Array, groups: list[Array]) -> Array:
    """The knots of all, without those that differ by roundoff from a node or from the one before."""
    inside = distinct(*groups)
    k = np.clip(np.searchsorted(nodes, inside) - 1, 0, nodes.size - 2)
    length = np.diff(nodes)[k]
    known = np.maximum(SAME**2 * length, SAME_NODE * nodes[k])
    kept = (inside - nodes[k] > known) & (nodes[k + 1] - inside > SAME * length)
    inside, passed = inside[kept], (inside - nodes[k])[kept]
    apart = np.diff(inside, prepend=-1.0) > SAME * passed
    return np.sort(np.concatenate([nodes, inside[apart]]))


def _restricted(dense: Dense, knots: Array) -> tuple[Array, Array, Array]:
    """Values and slopes of the same polynomials at other knots."""
    j = np.clip(np.searchsorted(dense.knots, 0.5 * (knots[1:] + knots[:-1])) - 1, 0, dense.knots.size - 2)
    j[np.diff(knots) == 0] = np.flatnonzero(np.diff(dense.knots) == 0)  # the same instants in both
    h = lengths((dense.knots[j + 1] - dense.knots[j])[:, None])
    a, b, slopes = dense.values[j], dense.values[j + 1], (h * dense.first[j], h * dense.last[j])

    def value(at: Array) -> Array:
        return np.asarray(hermite(a, b, *slopes, (at[:, None] - dense.knots[j][:, None]) / h))

    def slope(at: Array) -> Array:
        c = (at[:, None] - dense.knots[j][:, None]) / h
        chord = 6 * c * (1 - c) * (b - a)
        return np.asarray((chord + (1 - c) * (1 - 3 * c) * slopes[0] + c * (3 * c - 2) * slopes[1]) / h)

    values = np.vstack([value(knots[:-1]), dense.values[-1]])
    return values, slope(knots[:-1]), slope(knots[1:])


def _straighten(dense: Dense, block: Block, offset: int) -> None:
    """Make a covariance linear (in place) over the pieces where its cubic is indefinite and their ends are not."""
    rows = slice(block.span.start + offset, block.span.stop + offset)
    h = np.diff(dense.knots)[:, None, None]
    c = np.linspace(0.0, 1.0, LOOKS + 2)[None, :, None]
    ends = dense.values[:-1, None, rows], dense.values[1:, None, rows]
    looks = hermite(*ends, h * dense.first[:, None, rows], h * dense.last[:, None, rows], c)
    bad = ~semidefinite(looks, block.size)
    pieces = np.flatnonzero(bad.any(axis=1) & ~bad[:, 0] & ~bad[:, -1])
    chord = (dense.values[pieces + 1, rows] - dense.values[pieces, rows]) / lengths(h[pieces, 0])
    dense.first[pieces, rows] = dense.last[pieces, rows] = chord


def semidefinite(halves: Array, size: int) -> Any:
    """Whether covariances of half-vectors (..., entries) are positive semidefinite up to roundoff."""
    eigenvalues = np.linalg.eigvalsh(np.nan_to_num(unpack(halves, size)))
    return eigenvalues[..., 0] >= -SEMIDEFINITE_TOLERANCE * np.abs(eigenvalues[..., -1])
