"""Which constraints hold a solution: always, by a multiplier that is not zero, or only just."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal

# A bound holds a value where the multiplier, as a share of the largest of its kind, is above the distance from the
# bound, as a share of its range: an interior method makes one of the two small, and their product is its last barrier.
# Smaller multipliers and larger distances are those of bounds that do not hold.
SMALLEST_MULTIPLIER = 1e-9
LARGEST_DISTANCE = 1e-3
# Without a multiplier a value is at its bound within these shares of how far it goes from there and of its size.
NEAR = 1e-5
WIDENED = 1e-7
# Rows held, of unit length, whose part across the others is below this say nothing new.
DEPENDENT = 1e-9

Entries = tuple[tuple[str, tuple[int, ...]], ...]


@dataclass(frozen=True, kw_only=True)
class Held:
    """Rows that hold a solution, besides the controls at their bounds.

    Attributes:
        entries: for each kind ("final", "final_matrices", "states", "matrices", "path", "start", "end", "instants") the
            positions of its rows, nodes first.
        side: of all rows in this order, 0 for an equality, 1 at the upper bound, -1 at the lower one.
        strict: whether the row is an equality or has a multiplier; the others only just hold.
        controls: side of the control values at a bound with a multiplier, 0 elsewhere, (N + 1 or N, nu).
        touching: side of those at a bound without.
    """

    entries: Entries
    side: Array
    strict: NDArray[np.bool_]
    controls: Array
    touching: Array

    __repr__ = short_repr

    def bare(self, extremal: Extremal) -> Extremal:
        """The extremal with the multipliers of what holds it alone: those of other bounds are what a barrier leaves."""
        m, st = extremal.multipliers, extremal.statement
        _, xf, _, ef = st.boundary_values(extremal.parameters)
        kept = {kind: np.zeros(getattr(m, kind).size, dtype=bool) for kind in ("states", "matrices", "path")}
        for kind, positions in self.strictly:
            if kind in kept:
                kept[kind][list(positions)] = True
        values = {
            kind: np.where(mask.reshape(getattr(m, kind).shape), getattr(m, kind), 0.0) for kind, mask in kept.items()
        }
        ends = {kind: kept[kind].reshape(getattr(m, kind).shape)[-1] for kind in ("states", "matrices")}
        behind = np.zeros(st.ne, dtype=bool)
        behind[st.entries(st.behind)] = True
        values["final"] = np.where(~np.isnan(xf) | ends["states"], m.final, 0.0)
        values["final_matrices"] = np.where(~np.isnan(ef) | ends["matrices"] | behind, m.final_matrices, 0.0)
        return replace(extremal, multipliers=replace(m, **values))

    @property
    def strictly(self) -> Entries:
        """Positions of the strict rows only."""
        result, offset = [], 0
        for kind, positions in self.entries:
            kept = self.strict[offset : offset + len(positions)]
            result.append((kind, tuple(p for p, keep in zip(positions, kept, strict=True) if keep)))
            offset += len(positions)
        return tuple(result)


def held_by(extremal: Extremal, points: int = 1) -> Held:
    """What holds an extremal.

    Args:
        extremal: at whose nodes all limits are imposed.
        points: number of its intervals between the nodes of the mesh that was solved, where equations hold.
    """
    st, m, t = extremal.statement, extremal.multipliers, extremal.trajectory
    _, xf, _, ef = st.boundary_values(extremal.parameters)
    states = m.states.copy()
    states[-1] += np.where(np.isnan(xf), m.final, 0.0)  # that of a bound on x(T) is there
    state_sides, state_strict = _sides(t.x, *st.state_bounds, states)
    state_sides[0] = 0.0  # where x(0) is free, its bound is treated by itself
    state_sides[-1, ~np.isnan(xf)] = 0.0
    state_sides[:, st.decisions] = 0.0  # bounded once, at the start
    matrices = m.matrices.copy()
    matrices[-1] += np.where(np.isnan(ef), m.final_matrices, 0.0)
    matrix_sides, matrix_strict = _sides(t.e, st.matrix_lower, np.full(st.ne, np.inf), matrices)
    matrix_sides = np.where(matrix_strict, matrix_sides, 0.0)
    known = ~np.isnan(ef)
    known[st.entries(st.behind)] = False
    groups = [
        ("final", np.flatnonzero(~np.isnan(xf)), None, None),
        ("final_matrices", np.flatnonzero(known), None, None),
        ("states", np.flatnonzero(state_sides), state_sides, state_strict),
        ("matrices", np.flatnonzero(matrix_sides), matrix_sides, matrix_strict),
    ]
    for conditions, kind, values in extremal.inequalities():
        multipliers = np.atleast_2d(getattr(m, kind))
        sides, strict = _sides(values, conditions.lower, conditions.upper, multipliers)
        equal = np.broadcast_to(conditions.lower == conditions.upper, sides.shape)
        if kind == "path" and points > 1:
            between = np.arange(sides.shape[0]) % points != 0
            sides = np.where(between[:, None] & equal, 0.0, sides)
            equal = equal & ~between[:, None]
        groups.append((kind, np.flatnonzero((sides != 0) | equal), np.where(equal, 0.0, sides), strict | equal))
    entries, side, strictly = [], [], []
    for kind, positions, sides_of, strict_of in groups:
        entries.append((kind, tuple(positions.tolist())))
        side.append(np.zeros(positions.size) if sides_of is None else sides_of.ravel()[positions])
        strictly.append(
            np.ones(positions.size, dtype=bool) if strict_of is None else strict_of.ravel()[positions].astype(bool)
        )
    control_sides, control_strict = _sides(t.u, *st.control_bounds, m.controls)
    return Held(
        entries=tuple(entries),
        side=np.concatenate(side),
        strict=np.concatenate(strictly),
        controls=np.where(control_strict, control_sides, 0.0),
        touching=np.where(control_strict, 0.0, control_sides),
    )


def _sides(values: Array, lower: Array, upper: Array, multipliers: Array) -> tuple[Array, NDArray[np.bool_]]:
    """At which bound each value (K, n) lies, 0 where at none, and whether a multiplier holds it there."""
    result, strict = np.zeros(values.shape), np.zeros(values.shape, dtype=bool)
    size = np.abs(values).max(axis=0, initial=0.0)
    share = np.abs(multipliers) / max(float(np.abs(multipliers).max(initial=0.0)), float(np.finfo(float).tiny))
    with np.errstate(invalid="ignore"):
        width = np.where(np.isfinite(upper - lower), upper - lower, 0.0)
    for bound, sign in ((lower, -1.0), (upper, 1.0)):
        exists = np.isfinite(bound)
        limit = np.where(exists, bound, 0.0)
        distance = sign * (limit - values)
        reach = np.abs(distance).max(axis=0, initial=0.0)
        unit = np.maximum.reduce([reach, width, size, np.abs(limit), np.full(size.shape, np.finfo(float).tiny)])
        holds = exists & (sign * multipliers > 0) & (share > SMALLEST_MULTIPLIER)
        holds &= (distance < share * unit) & (distance < LARGEST_DISTANCE * unit)
        touches = exists & (distance <= NEAR * reach + WIDENED * np.maximum(size, np.abs(limit)))
        result = np.where(holds | (touches & (result == 0)), sign, result)
        strict |= holds
    return result, strict


def null_space(rows: Array, size: int) -> Array:
    """Orthonormal basis of the vectors of some size that are across all rows, whatever the units of each row."""
    lengths = np.linalg.norm(rows, axis=1)
    kept = rows[lengths > 0] / lengths[lengths > 0][:, None]
    if not kept.shape[0]:
        return np.eye(size)
    _, values, vectors = np.linalg.svd(kept)
    return np.asarray(vectors[int(np.sum(values > DEPENDENT * values[0])) :].T)
