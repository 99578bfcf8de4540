"""The linearised constraints in the variables that are free to be chosen: states at the starts of segments follow.

At a point the continuity of the states reads dx+ = c + A dx + B dz, segment by segment, where z are the variables that
nothing gives: controls, free initial values, decisions, a free duration. So dx = D dz + d, and rows on states become
rows on z; the slopes of cost and rows by the states come back through the same recursion, transposed, as costates.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.transcription.program import Program

Indices = NDArray[np.intp]


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Bounds of the variables and of the rows."""

    lbx: Array
    ubx: Array
    lbg: Array
    ubg: Array

    __repr__ = short_repr


class Slopes(NamedTuple):
    """The Jacobian of the rows: of continuity by z, (segments, nx, nz), and by the states at the starts of the segments
    but the first, (segments - 1, nx, nx); of the others by z and by the states at the ends of all segments.
    """

    continuity: Array
    chain: Array
    others: Array
    others_by_state: Array


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which variables and rows of a program are what, and where the entries of its Jacobian belong.

    Args:
        chosen: variables that nothing gives.
        states: number of states.
        segments: number of shooting segments.
        rows: number of other rows than those of continuity, which come first.
        free: entries of the state at the end of each segment that are no given values.
        fixed: the other entries.
        bounded: which of the free ones have bounds.
        places: positions of the entries of the Jacobian that belong to each part of `Slopes`, and which these are.
    """

    chosen: Indices
    states: int
    segments: int
    rows: int
    free: tuple[Indices, ...]
    fixed: tuple[Indices, ...]
    bounded: tuple[Indices, ...]
    places: tuple[tuple[Indices, Indices], ...]

    __repr__ = short_repr

    @cached_property
    def free_rows(self) -> Indices:
        """The entries that are no given values, of the states at the ends of all segments, one below the other."""
        return np.concatenate([k * self.states + entries for k, entries in enumerate(self.free)])

    @cached_property
    def limited(self) -> tuple[int, ...]:
        """Segments at whose end states have given values or bounds."""
        return tuple(
            k for k, pair in enumerate(zip(self.fixed, self.bounded, strict=True)) if pair[0].size + pair[1].size
        )

    @property
    def gaps(self) -> int:
        """Number of rows of continuity."""
        return self.segments * self.states

    @property
    def given(self) -> slice:
        """The variables that continuity gives, the fixed ones among them."""
        return slice(self.states, self.states * (self.segments + 1))

    def slopes(self, entries: Array) -> Slopes:
        """The parts of the Jacobian with these entries."""
        n, nx, nz = self.segments, self.states, self.chosen.size
        shapes = ((n, nx, nz), (n - 1, nx, nx), (self.rows, nz), (self.rows, n * nx))
        parts = []
        for shape, (positions, which) in zip(shapes, self.places, strict=True):
            part = np.zeros(shape)
            part.ravel()[positions] = entries[which]
            parts.append(part)
        return Slopes(*parts)


@dataclass(frozen=True, kw_only=True)
class Subproblem:
    """The linearised problem in z: minimise q'dz + dz'B dz/2 where lower <= rows dz <= upper and low <= dz <= high.

    Args:
        slope: q, shape (nz,).
        rows: (m, nz): given values at ends of segments, then the other rows, then bounds on states that follow.
        lower, upper: (m,).
        low, high: (nz,).
        places: of the m rows among the rows of the program; -1 - i for a bound of its variable i.
        follows: D and d, how the states at the ends of the segments change, (segments, nx, nz + 1).
    """

    slope: Array
    rows: Array
    lower: Array
    upper: Array
    low: Array
    high: Array
    places: Indices
    follows: Array

    __repr__ = short_repr


def layout_of(program: Program, bounds: Bounds, pattern: ca.Sparsity) -> Layout:
    """The parts of a program whose matrices are no variables.

    Args:
        program: of one statement.
        bounds: fixed variables are no variables.
        pattern: of the Jacobian of its rows.
    """
    (part,) = program.parts
    nx, count = part.statement.nx, len(part.mesh.segments)
    inner = slice(nx, nx * (count + 1))
    free = bounds.ubx > bounds.lbx
    limited = np.isfinite(bounds.lbx) | np.isfinite(bounds.ubx)
    ends, near = (flags[inner].reshape(count, nx) for flags in (free, limited))
    chosen = free.copy()
    chosen[inner] = False
    row, column = (np.array(indices, dtype=np.intp) for indices in pattern.get_triplet())
    z = np.flatnonzero(chosen)
    own = np.full(free.size, -1)
    own[z] = np.arange(z.size)
    gaps, other = row < nx * count, row >= nx * count
    by_z, by_x = own[column] >= 0, (column >= nx) & (column < nx * (count + 1)) & free[column]
    later = by_x & gaps & (column < nx * (row // nx + 1)) & (row >= nx)  # not the end of the segment itself
    width = nx * count
    positions = (
        row * z.size + own[column],
        (row - nx) * nx + column - nx * (row // nx),
        (row - width) * z.size + own[column],
        (row - width) * width + column - nx,
    )
    which = [np.flatnonzero(flags) for flags in (by_z & gaps, later, by_z & other, by_x & other)]
    return Layout(
        chosen=z,
        states=nx,
        segments=count,
        rows=bounds.lbg.size - width,
        free=tuple(np.flatnonzero(flags) for flags in ends),
        fixed=tuple(np.flatnonzero(~flags) for flags in ends),
        bounded=tuple(np.flatnonzero(flags & close) for flags, close in zip(ends, near, strict=True)),
        places=tuple((place[entries], entries) for place, entries in zip(positions, which, strict=True)),
    )


def condensed(layout: Layout, bounds: Bounds, w: Array, slope: Array, g: Array, slopes: Slopes) -> Subproblem:
    """The problem linearised at a point, in the variables that are chosen.

    Args:
        layout: of the program.
        bounds: of variables and rows.
        w: the point.
        slope: of the cost there, by all variables.
        g: rows there.
        slopes: of the rows.
    """
    z, nx, nz = layout.chosen, layout.states, layout.chosen.size
    follows = np.concatenate([slopes.continuity, g[: layout.gaps].reshape(-1, nx, 1)], axis=2)
    for k in range(1, layout.segments):
        follows[k] += slopes.chain[k - 1] @ follows[k - 1]  # fixed entries have no columns there
    flat = follows.reshape(-1, nz + 1)
    q = slope[z] + slope[layout.given][layout.free_rows] @ flat[layout.free_rows, :nz]
    rows, values = slopes.others, g[layout.gaps :]
    if layout.rows:
        rows = rows + slopes.others_by_state @ flat[:, :nz]
        values = values + slopes.others_by_state @ flat[:, nz]
    parts = [(rows, bounds.lbg[layout.gaps :] - values, bounds.ubg[layout.gaps :] - values)]
    named = [np.arange(layout.gaps, g.size)]
    for k in layout.limited:
        fixed, bounded = layout.fixed[k], layout.bounded[k]
        if fixed.size:  # a given final value: the row of continuity itself
            gap = -follows[k, fixed, nz]
            parts.insert(0, (follows[k, fixed, :nz], gap, gap))
            named.insert(0, k * nx + fixed)
        if bounded.size:
            at, change = (k + 1) * nx + bounded, follows[k, bounded]
            now = w[at] + change[:, nz]
            parts.append((change[:, :nz], bounds.lbx[at] - now, bounds.ubx[at] - now))
            named.append(-1 - at)
    return Subproblem(
        slope=q,
        rows=np.vstack([rows for rows, _, _ in parts]),
        lower=np.concatenate([lower for _, lower, _ in parts]),
        upper=np.concatenate([upper for _, _, upper in parts]),
        low=bounds.lbx[z] - w[z],
        high=bounds.ubx[z] - w[z],
        places=np.concatenate(named),
        follows=follows,
    )


def moved(layout: Layout, sub: Subproblem, change: Array, size: int) -> Array:
    """The change of all variables where those that are chosen change so."""
    result = np.zeros(size)
    result[layout.chosen] = change
    follows = sub.follows[:, :, :-1] @ change + sub.follows[:, :, -1]
    for k, fixed in enumerate(layout.fixed):
        follows[k, fixed] = 0.0
    result[layout.given] = follows.ravel()
    return result


def reduced(layout: Layout, sub: Subproblem, slope: Array) -> Array:
    """A slope by all variables as one by those that are chosen, the others following."""
    by_state = slope[layout.given].reshape(layout.segments, -1).copy()
    for k, fixed in enumerate(layout.fixed):
        by_state[k, fixed] = 0.0
    return np.asarray(slope[layout.chosen] + np.tensordot(by_state, sub.follows[:, :, :-1], 2))


def weighed(layout: Layout, slopes: Slopes, weights: Array, size: int) -> Array:
    """Slope by all variables of the sum of the rows with some weights."""
    result = np.zeros(size)
    gaps, others = weights[: layout.gaps].reshape(layout.segments, -1), weights[layout.gaps :]
    result[layout.chosen] = np.tensordot(gaps, slopes.continuity, 2) + others @ slopes.others
    by_state = (others @ slopes.others_by_state).reshape(layout.segments, -1) - gaps
    by_state[:-1] += np.einsum("ki,kij->kj", gaps[1:], slopes.chain)
    result[layout.given] = by_state.ravel()
    return result


def all_multipliers(
    layout: Layout, sub: Subproblem, slope: Array, slopes: Slopes, of_rows: Array, of_bounds: Array
) -> tuple[Array, Array]:
    """Multipliers of all variables and rows from those of a subproblem; costates at the ends of segments among them.

    Args:
        layout: of the program.
        sub: the subproblem.
        slope: of the cost by all variables.
        slopes: of the rows.
        of_rows: multipliers of the rows of the subproblem, (m,).
        of_bounds: of its bounds, (nz,).

    Returns:
        Multipliers of the bounds of the variables, and of the rows.
    """
    lam_x, lam_g = np.zeros(slope.size), np.zeros(layout.gaps + layout.rows)
    lam_x[layout.chosen] = of_bounds
    own = sub.places >= 0
    lam_g[sub.places[own]] = of_rows[own]
    lam_x[-1 - sub.places[~own]] = of_rows[~own]
    by_state = slope[layout.given] + lam_x[layout.given]
    if layout.rows:
        by_state = by_state + lam_g[layout.gaps :] @ slopes.others_by_state
    wanted, gaps = by_state.reshape(layout.segments, -1), lam_g[: layout.gaps].reshape(layout.segments, -1)
    for k in range(layout.segments - 1, -1, -1):  # stationary by x at the end of segment k, whose gap has slope -1
        later = gaps[k + 1] @ slopes.chain[k] if k + 1 < layout.segments else 0.0
        gaps[k, layout.free[k]] = (wanted[k] + later)[layout.free[k]]
    return lam_x, lam_g
