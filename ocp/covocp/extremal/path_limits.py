"""What a solution does to its limits between the points at which they are imposed, along its true path."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.extremal.dense_output import OF_RANGE, mapped
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import refined
from covocp.extremal.polynomials import Dense
from covocp.extremal.row_units import varied_by
from covocp.statement.conditions import Conditions
from covocp.statement.interval import repeated
from covocp.statement.offsets import offset_of
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.scales import choose_scales

# Problems whose rows are kept taken apart.
KEPT = 8
# Points that are looked at together: what bounds the memory.
TOGETHER = 1 << 15
# Share of a limit by which it may be passed between the points where it is imposed without a word.
NOTED = 1e-4
# A limit of zero is met up to this share of the unit of its row: of a row that is zero all the way rounding is all.
MET = 1e-7
# A limit acts where a value is closer to it than this, in its range or the limit itself.
TOUCHED = 1e-4
# Share of what a limit is passed by that is much of it, and parts of an interval within which a point is one.
MUCH, SAME_PLACE = 0.5, 1e-9


@dataclass(frozen=True, kw_only=True)
class Passed:
    """A limit that is passed somewhere.

    Attributes:
        name: of the state or the constraint.
        by: largest violation, in the unit of the constraint; inf where the constraint is NaN or inf.
        share: the same relative to the limit (see `limit_sizes`).
        time: where it is largest relative to the limit [s]; where it has no value, the first such time.
        equation: whether both limits are one, which is imposed at the nodes alone.
        imposed: whether much of it is at points where it is imposed, not between them.
    """

    name: str
    by: float
    share: float
    time: float
    equation: bool = False
    imposed: bool = False

    @property
    def defined(self) -> bool:
        """Whether what has the limit has a value everywhere."""
        return bool(np.isfinite(self.by))

    def remedy(self, points: int) -> str:
        """What makes it less, of a solution with so many points of each interval where limits are imposed."""
        if self.imposed:
            return "start again from it (guess=), or ask for a smaller tolerance="
        if self.equation:
            return "equations are imposed at the nodes alone: use more intervals, or eliminate a control by it"
        return (
            f"impose it at more points of each interval (points={2 * points}, method 'ipopt'), use more intervals, "
            "or keep a margin"
        )


def limited(extremal: Extremal) -> bool:
    """Whether a state or an expression has a limit along the path."""
    return limited_along(extremal.statement)


def limited_along(statement: Statement) -> bool:
    """The same of a problem."""
    return bool(statement.path.size) or bool(np.isfinite(statement.state_bounds).any())


def acting(extremal: Extremal) -> dict[str, float]:
    """Conditions along the path, and states, that are at a limit, by the share of the time in which they are.

    States at bounds where they are given, at the ends, are not held by them.

    Args:
        extremal: the solution.
    """
    if not limited(extremal):
        return {}
    steps = np.diff(refined(extremal).mesh.nodes)
    shares = 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
    found: dict[str, float] = {}
    for name, at in _at_limits(extremal):
        if at.any():
            found[name] = max(float(shares @ at), found.get(name, 0.0))
    return found


def acting_nodes(extremal: Extremal) -> NDArray[np.bool_]:
    """Points of the mesh at which limits are imposed, and one of them acts."""
    result = np.zeros(extremal.mesh.intervals * extremal.mesh.points + 1, dtype=bool)
    for _, at in _at_limits(extremal) if limited(extremal) else ():
        result |= at
    return result


def _at_limits(extremal: Extremal) -> list[tuple[str, NDArray[np.bool_]]]:
    """Each state with bounds and each condition along the path, and at which points it is at a limit."""
    extremal = refined(extremal)  # limits act at all its nodes
    st, bounded = extremal.statement, extremal.statement.bounded_states
    near = _touching(extremal.trajectory.x[:, bounded], *(bound[bounded] for bound in st.state_bounds))
    near[[0, -1]] = False
    rows = [(st.state_names[i], near[:, j]) for j, i in enumerate(bounded)]
    for conditions, place, values in extremal.inequalities():
        if place == "path":
            near = _touching(values, conditions.lower, conditions.upper)
            rows += [(name, near[:, j]) for j, name in enumerate(conditions.names)]
    return rows


def _touching(values: Array, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Which values (K, rows) are at a limit; those of equations always are."""
    result = np.broadcast_to(lower == upper, values.shape).copy()
    for limits in (lower, upper):
        known = np.isfinite(limits)
        limits = np.where(known, limits, 0.0)
        result |= known & (np.abs(values - limits) <= TOUCHED * (np.ptp(values, axis=0) + np.abs(limits)))
    return result


def passed_limits(extremal: Extremal, dense: Dense, points: int) -> tuple[Passed, ...]:
    """Bounds of states and path constraints that the true path passes, the worst relative to its limit first.

    Args:
        extremal: the solution.
        dense: its path between the nodes.
        points: equal parts of each interval at whose ends it is looked at; so it is at all knots.

    Returns:
        Those that are passed by more than the error of the path.
    """
    st = extremal.statement
    if not limited(extremal):
        return ()
    names = (*st.state_names, *st.path.names)
    limits = tuple(np.concatenate(pair) for pair in zip(st.state_bounds, (st.path.lower, st.path.upper), strict=True))

    def values(k: Expr, s: Array) -> Array:
        x = _before(extremal, dense, k, s)[:, : st.nx]
        return np.hstack([x, _conditions(extremal, dense, st.path, k, s)]) if st.path.size else x

    def sizes(when: Array, largest: Array) -> Array:
        terms = np.concatenate([np.zeros(st.nx), _equation_terms(extremal)])
        beside = _beside_zero(extremal, when[:, st.nx :])
        own = np.where(beside > 0, np.minimum(beside, largest[st.nx :]), largest[st.nx :])
        return np.where(terms > 0, terms, np.hstack([np.tile(largest[: st.nx], (2, 1)), own]))

    found = _passed(extremal, dense, points, names, limits, values, sizes)
    zero = (np.array(limits) == 0.0).any(axis=0)
    if not found or not zero.any():
        return found
    met = dict(zip(names, np.where(zero, MET * _units(extremal), 0.0), strict=True))
    return tuple(entry for entry in found if entry.by > met[entry.name])


def _units(extremal: Extremal) -> Array:
    """Units of the states and of the rows along the path, 0 where none are known."""
    st = extremal.statement
    units = choose_scales(st, extremal.mesh, extremal.trajectory, extremal.parameters)
    rows = varied_by(extremal, st.path.function, units) if st.path.size else np.zeros(0)
    return np.concatenate([units.x, np.where(np.isfinite(rows), rows, 0.0)])


@lru_cache(maxsize=KEPT)
def _offset(statement: Statement) -> ca.Function | None:
    """What the rows along the path compare with where their limits are zero; None: what that is cannot be told."""
    path = statement.path
    return offset_of(path) if path.of_zero.any() else None


def _beside_zero(extremal: Extremal, when: Array) -> Array:
    """Sizes of what the rows along the path compare with beside a limit of zero, at normalised times (2, rows)."""
    offset = _offset(extremal.statement)
    if offset is None:
        return np.zeros(when.shape)
    duration = extremal.trajectory.duration
    fixed = repeated(duration, extremal.parameters, when.size)
    found = np.abs(np.asarray(mapped(offset, duration * when.reshape(1, -1), *fixed)[0]))
    rows = np.tile(np.arange(when.shape[1]), 2)
    return np.asarray(np.nan_to_num(found[rows, np.arange(when.size)].reshape(when.shape)))


def _equation_terms(extremal: Extremal) -> Array:
    """Sizes of the terms of the equations along the path, at the nodes; 0 of other conditions.

    What an equation u - w = 0 is passed by is nothing beside u, but all of u - w.
    """
    path = extremal.statement.path
    if not path.equations.any():
        return np.zeros(path.size)
    inputs = [ca.MX.sym(path.function.name_in(i), path.function.size1_in(i)) for i in range(path.function.n_in())]
    value = path.function(*inputs)
    terms = sum(ca.fabs(ca.jacobian(value, v)) @ ca.fabs(v) for v in inputs[:3])
    function = ca.Function("terms", inputs, [ca.densify(terms)]).map(extremal.mesh.intervals + 1)
    return np.asarray(np.where(path.equations, finite_sizes(np.asarray(function(*extremal.columns()).full()).T), 0.0))


def left_tables(extremal: Extremal, dense: Dense, points: int) -> tuple[Passed, ...]:
    """Tables whose outermost knots the true path passes, the worst first; their argument is what is called a limit.

    Args:
        extremal: the solution.
        dense: its path between the nodes, with the matrices.
        points: equal parts of each interval at whose ends it is looked at.
    """
    tables = extremal.statement.tables
    if tables is None:
        return ()

    def values(k: Expr, s: Array) -> Array:
        return _conditions(extremal, dense, tables, k, s)

    return _passed(extremal, dense, points, tables.names, (tables.lower, tables.upper), values)


def _passed(
    extremal: Extremal,
    dense: Dense,
    points: int,
    names: Sequence[str],
    limits: tuple[Array, ...],
    values_at: Callable[[Any, Array], Array],
    sizes_at: Callable[[Array, Array], Array] | None = None,
) -> tuple[Passed, ...]:
    """Rows that pass their limits along the true path, from what gives them at normalised times of intervals.

    sizes_at: normalised times, of each limit (2, rows), and the largest value of each row -> what the rows compare
        where a limit is zero; None: that value.
    """
    mesh, (lower, upper) = extremal.mesh, limits
    worst, largest, held = np.zeros((2, len(names))), np.zeros(len(names)), np.zeros(len(names))
    limited_rows = np.isfinite(lower) | np.isfinite(upper)
    when = np.zeros((2, len(names)))
    for k, s in places_along(mesh, dense, points):
        values = values_at(k, s)
        largest = np.maximum(largest, finite_sizes(values))
        unknown = ~np.isfinite(values) & limited_rows
        with np.errstate(invalid="ignore"):
            sides = lower - values, values - upper
        for side, excess in enumerate(sides):
            excess[unknown] = np.inf  # what has no value meets no limit
            place = excess.argmax(axis=0)
            found = excess[place, np.arange(len(names))]
            when[side] = np.where(found > worst[side], s[place], when[side])
            worst[side] = np.maximum(worst[side], found)
            there = np.where(lower == upper, _imposed(mesh, k, s, 1), _imposed(mesh, k, s, mesh.points))
            held = np.maximum(held, np.where(there, excess, 0.0).max(axis=0, initial=0.0))
    if sizes_at is not None and worst.any():
        largest = sizes_at(when, largest)
    shares = worst / limit_sizes(lower, upper, largest)
    side = shares.argmax(axis=0)
    result = [
        Passed(
            name=name,
            by=float(worst[:, i].max()),
            share=float(shares[side[i], i]),
            time=float(when[side[i], i] * extremal.trajectory.duration),
            equation=bool(lower[i] == upper[i]),
            imposed=bool(held[i] > MUCH * worst[:, i].max()),
        )
        for i, name in enumerate(names)
        if shares[side[i], i] > OF_RANGE
    ]
    return tuple(sorted(result, key=lambda entry: -entry.share))


def places_along(mesh: Mesh, dense: Dense, points: int) -> Iterator[tuple[NDArray[np.intp], Array]]:
    """Intervals, and normalised times in them: the ends of so many equal parts of each, and the knots."""
    nearest = np.clip(np.searchsorted(mesh.nodes, dense.knots), 0, mesh.intervals)
    inner = dense.knots[mesh.nodes[nearest] != dense.knots]
    regular = mesh.intervals * (points + 1)
    for begin in range(0, regular + inner.size, TOGETHER):
        at = np.arange(begin, min(begin + TOGETHER, regular + inner.size))
        own = at[at < regular]
        k, j = own // (points + 1), own % (points + 1)
        s = mesh.nodes[k] + j / points * np.diff(mesh.nodes)[k]
        extra = inner[at[at >= regular] - regular]
        yield np.concatenate([k, np.searchsorted(mesh.nodes, extra) - 1]), np.concatenate([s, extra])


def _imposed(mesh: Mesh, k: NDArray[np.intp], s: Array, points: int) -> NDArray[np.bool_]:
    """Which normalised times s are ends of so many equal parts of the intervals k, a column."""
    h = np.diff(mesh.nodes)[k]
    part = (s - mesh.nodes[k]) / np.where(h > 0, h, 1.0) * points
    return np.asarray(np.abs(part - np.round(part)) <= SAME_PLACE)[:, None]


def finite_sizes(values: Array) -> Array:
    """Largest size of each column among its finite values, 0 where there are none."""
    return np.asarray(np.where(np.isfinite(values), np.abs(values), 0.0).max(axis=0))


def limit_sizes(lower: Array, upper: Array, largest: Array) -> Array:
    """What a violation is relative to, (2, rows): the limit, the width between both, the least of them.

    Where the limit is zero, it is the largest value along the path, or what else is given for it.
    """
    limits = np.abs(np.array([lower, upper]))
    sizes = np.where(np.isfinite(limits) & (limits > 0), limits, largest)
    width = upper - lower
    sizes = np.where(np.isfinite(width) & (width > 0), np.minimum(sizes, width), sizes)
    return np.where(sizes > 0, sizes, 1.0)


def _before(extremal: Extremal, dense: Dense, k: Expr, s: Array) -> Array:
    """States and half-vectors at normalised times s of the intervals k; at their ends before what happens there."""
    z, ends = dense.at(s), s == extremal.mesh.nodes[k + 1]
    z[ends] = dense.at(s[ends], before=True)  # what is read at an instant belongs to what follows
    return z


def _conditions(extremal: Extremal, dense: Dense, rows: Conditions, k: Expr, s: Array) -> Array:
    """Conditions at normalised times s of the intervals k, (K, rows)."""
    return np.asarray(mapped(rows.function, *columns_between(extremal, dense, k, s))[0].T)


def columns_between(extremal: Extremal, dense: Dense, k: Expr, s: Array) -> tuple[Array, ...]:
    """All six arguments of the model at normalised times s of the intervals k, a column each."""
    st, mesh = extremal.statement, extremal.mesh
    z = _before(extremal, dense, k, s)
    h = np.diff(mesh.nodes)[k]
    controls = extremal.control(k, (s - mesh.nodes[k]) / np.where(h > 0, h, 1.0))
    duration = extremal.trajectory.duration
    fixed = repeated(duration, extremal.parameters, s.size)
    return z[:, : st.nx].T, controls.T, z[:, st.nx :].T, duration * s[None, :], *fixed
