"""What a solution does to its limits between the points at which they are imposed, along its true path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.extremal.dense_output import OF_RANGE, Dense, mapped
from covocp.extremal.extremal import Extremal
from covocp.statement.interval import repeated

# Points that are looked at together: what bounds the memory.
TOGETHER = 1 << 15
# Share of a limit by which it may be passed between the points where it is imposed without a word.
NOTED = 1e-4


@dataclass(frozen=True, kw_only=True)
class Passed:
    """A limit that is passed somewhere.

    Attributes:
        name: of the state or the constraint.
        by: largest violation, in the unit of the constraint.
        share: the same relative to the limit (see `_sizes`).
        time: where it is largest relative to the limit [s].
    """

    name: str
    by: float
    share: float
    time: float


def limited(extremal: Extremal) -> bool:
    """Whether a state or an expression has a limit along the path."""
    st = extremal.statement
    return bool(st.path.size) or bool(np.isfinite(st.state_bounds).any())


def passed_limits(extremal: Extremal, dense: Dense, points: int) -> tuple[Passed, ...]:
    """Bounds of states and path constraints that the true path passes, the worst relative to its limit first.

    Args:
        extremal: the solution.
        dense: its path between the nodes.
        points: equal parts of each interval at whose ends it is looked at; so it is at all knots.

    Returns:
        Those that are passed by more than the error of the path.
    """
    st, mesh = extremal.statement, extremal.mesh
    names = (*st.state_names, *st.path.names)
    if not limited(extremal):
        return ()
    lower, upper = (np.concatenate(pair) for pair in zip(st.state_bounds, (st.path.lower, st.path.upper), strict=True))
    worst, largest = np.zeros((2, len(names))), np.zeros(len(names))
    when = np.zeros((2, len(names)))
    inner = dense.knots[~np.isin(dense.knots, mesh.nodes)]
    regular = mesh.intervals * (points + 1)
    for begin in range(0, regular + inner.size, TOGETHER):
        at = np.arange(begin, min(begin + TOGETHER, regular + inner.size))
        own = at[at < regular]
        k, j = own // (points + 1), own % (points + 1)
        s = mesh.nodes[k] + j / points * np.diff(mesh.nodes)[k]
        extra = inner[at[at >= regular] - regular]
        s = np.concatenate([s, extra])
        k = np.concatenate([k, np.searchsorted(mesh.nodes, extra) - 1])
        values = _values(extremal, dense, k, s)
        largest = np.maximum(largest, np.abs(values).max(axis=0))
        for side, excess in enumerate((lower - values, values - upper)):
            place = excess.argmax(axis=0)
            found = excess[place, np.arange(len(names))]
            when[side] = np.where(found > worst[side], s[place], when[side])
            worst[side] = np.maximum(worst[side], found)
    shares = worst / _sizes(lower, upper, largest)
    side = shares.argmax(axis=0)
    result = [
        Passed(
            name=name,
            by=float(worst[:, i].max()),
            share=float(shares[side[i], i]),
            time=float(when[side[i], i] * extremal.trajectory.duration),
        )
        for i, name in enumerate(names)
        if shares[side[i], i] > OF_RANGE
    ]
    return tuple(sorted(result, key=lambda entry: -entry.share))


def _sizes(lower: Array, upper: Array, largest: Array) -> Array:
    """What a violation is relative to, (2, rows): the limit, the width between both, the least of them.

    Where the limit is zero, it is the largest value along the path.
    """
    limits = np.abs(np.array([lower, upper]))
    sizes = np.where(np.isfinite(limits) & (limits > 0), limits, largest)
    width = upper - lower
    sizes = np.where(np.isfinite(width) & (width > 0), np.minimum(sizes, width), sizes)
    return np.where(sizes > 0, sizes, 1.0)


def _values(extremal: Extremal, dense: Dense, k: Expr, s: Array) -> Array:
    """States and path constraints at normalised times s of the intervals k, (K, rows)."""
    st, mesh = extremal.statement, extremal.mesh
    z, ends = dense.at(s), s == mesh.nodes[k + 1]
    z[ends] = dense.at(s[ends], before=True)  # what is read at an instant belongs to what follows
    x = z[:, : st.nx]
    if not st.path.size:
        return x
    h = np.diff(mesh.nodes)[k]
    controls = extremal.control(k, (s - mesh.nodes[k]) / np.where(h > 0, h, 1.0))
    duration = extremal.trajectory.duration
    fixed = repeated(duration, extremal.parameters, s.size)
    rows = mapped(st.path.function, x.T, controls.T, z[:, st.nx :].T, duration * s[None, :], *fixed)[0]
    return np.hstack([x, rows.T])
