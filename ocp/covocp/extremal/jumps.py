"""Jumps of the model that a solution meets where it compares states, controls or matrices.

Where a trajectory crosses g(x, u, E) = 0 and H jumps there, the costates of an optimum jump by dH/g' times the slope of
g. Derivatives of the rates have no such term, on whichever side: what is stationary by them is so by mistake unless
H is the same on both sides. Comparisons of the time, of parameters and of states that nothing chosen moves need none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.matrices import Array
from covocp.base.pieces import Borders, borders_of, calls, expanded, may_jump
from covocp.base.short_repr import short_repr
from covocp.extremal.costates import discrete_costates
from covocp.extremal.dense_output import dense_output, mapped
from covocp.extremal.extremal import Extremal
from covocp.extremal.nodes import rates_along
from covocp.extremal.path_limits import columns_between, places_along
from covocp.extremal.polynomials import Dense
from covocp.statement.statement import INPUTS, Statement
from covocp.transcription.covariance_steps import KEPT

# Numbers of the arguments that move with what is chosen.
MOVING = tuple(INPUTS.index(name) for name in ("state", "control", "matrices"))
# Equal parts of an interval at whose ends it is looked at, halvings after which a crossing is known to rounding.
PARTS, HALVINGS = 10, 50
# Share of the largest value of what is compared below which it is on the border, and by which it is moved to its sides
# (of an interval: by which points on both sides of a crossing are apart).
NEAR, BESIDE = 1e-7, 1e-9
# Jump of H in its largest terms that counts; without costates that of a rate in its largest value.
LEAST = 1e-5
# Share of the time at an end of the path within which it is on a border since it is given there.
EDGE = 0.01
# Gaps between points that are looked into where comparisons cannot be read, those with the largest changes.
GAPS = 8


@dataclass(frozen=True, kw_only=True)
class Jump:
    """A comparison at which the model jumps, as often as a solution meets it.

    Attributes:
        words: what is compared, such as 'x > 0'; empty where that is long or not known.
        names: entries of state, control and matrices that it depends on; none where that is not known.
        times: when it is met [s], rising.
        intervals: of the mesh, in which it is.
        crossed: whether it is crossed somewhere; else the border is reached only.
        what: jumps most in what it does to the cost: the name of a state, of an entry of a matrix, or empty for the
            running cost.
        share: by how much, relative to the larger of both values.
        size: of the jump of H, in its largest terms.
    """

    words: str
    names: tuple[str, ...]
    times: tuple[float, ...]
    intervals: tuple[int, ...]
    crossed: bool
    what: str
    share: float
    size: float

    __repr__ = short_repr


class _Met(NamedTuple):
    """A border that is met: its number (-1: not known), interval and normalised time, the arguments on both sides."""

    border: int
    interval: int
    s: float
    crossed: bool
    sides: tuple[Array, Array]


@lru_cache(maxsize=4)
def met_jumps(extremal: Extremal, *, linked: bool = False, optimised: bool = True) -> tuple[Jump, ...]:
    """Jumps of rates, matrices' rates and running cost with state, control or matrices that a solution meets.

    What costs nothing to jump is left out.

    Args:
        extremal: the solution.
        linked: whether its start is the end of a phase before it.
        optimised: whether its multipliers belong to its cost; else jumps of the states' rates are looked for.

    Returns:
        One for each comparison, the largest first; nothing where it cannot be told.
    """
    st = extremal.statement
    if not compares(st) or not all(np.isfinite(v).all() for v in (extremal.trajectory.x, extremal.trajectory.e)):
        return ()
    function, borders = _read(st)
    if borders is None and not calls(function):
        return ()
    try:
        dense = dense_output(extremal, matrices=borders is None or bool(borders.ends.jac_sparsity(0, 2).nnz()))
        found = _felt(extremal, dense) if borders is None else _crossings(extremal, dense, borders, linked)
        return _weighed(extremal, function, borders, list(found), optimised)
    except RuntimeError:  # CasADi's, of a linear system that is singular there
        return ()


@lru_cache(maxsize=KEPT)
def compares(statement: Statement) -> bool:
    """Whether rates or running cost may jump by what they compare."""
    parts = [statement.nominal, *statement.riccati]  # of fewer operations than what they make together
    functions = [part for part in parts if part is not None]
    if len(functions) < len(parts) or statement.running_uses_matrices:
        functions = [statement.rates]
    return any(may_jump(function) for function in functions)


@lru_cache(maxsize=KEPT)
def _read(statement: Statement) -> tuple[ca.Function, Borders | None]:
    """The rates, as scalar operations where they consist of such, and their borders."""
    function = expanded(statement.rates)
    return function, borders_of(function, MOVING)


def _points(extremal: Extremal, dense: Dense) -> tuple[NDArray[np.intp], Array]:
    """Intervals, and normalised times in them, in their order."""
    pairs = list(places_along(extremal.mesh, dense, PARTS))
    k, s = (np.concatenate([pair[i] for pair in pairs]) for i in (0, 1))
    k, s = np.asarray(k, dtype=np.intp), np.asarray(s)
    order = np.lexsort((s, k))
    order = order[np.diff(extremal.mesh.nodes)[k[order]] > 0]
    return k[order], s[order]


def _crossings(extremal: Extremal, dense: Dense, borders: Borders, linked: bool) -> Iterator[_Met]:
    """Where what is compared changes its side, or is on the border."""
    k, s = _points(extremal, dense)
    whole = np.array(borders.whole)
    values = mapped(borders.ends, *columns_between(extremal, dense, k, s))[0]
    sides = _sides(values, whole)
    border = np.where(whole[:, None], np.round(values), 0.0)
    sizes = np.where(whole, np.ptp(values, axis=1), np.abs(values).max(axis=1))
    near = np.abs(values - border) <= NEAR * sizes[:, None]
    within: list[tuple[int, int]] = []
    for row in np.flatnonzero(np.isfinite(values).all(axis=1) & _movable(extremal, borders, linked)):
        clear = np.flatnonzero(~near[row])
        ends = [-1, *clear.tolist(), s.size]
        apart = np.diff(ends) > 1
        changed = np.concatenate([[False], np.diff(sides[row, clear]) != 0, [False]])[: apart.size]
        for i in np.flatnonzero(apart | changed):
            a, b = ends[i], ends[i + 1]
            if b == a + 1:
                within += [(int(row), a)] if k[a] == k[b] else []  # else a control jumps from one side to the other
            elif not _given(extremal, borders, int(row), (a, b), s, linked):
                middle = (a + b) // 2
                at = [column[:, 0] for column in columns_between(extremal, dense, k[[middle]], s[[middle]])]
                pair = _beside(borders, int(row), at, BESIDE * sizes[row])
                if pair is not None:
                    yield _Met(int(row), int(k[middle]), float(s[middle]), bool(changed[i]), pair)
    if within:
        rows, points = (np.array(v) for v in zip(*within, strict=True))
        yield from _bisected(extremal, dense, borders, rows, (k[points], s[points], s[points + 1]))


def _movable(extremal: Extremal, borders: Borders, linked: bool) -> NDArray[np.bool_]:
    """Which borders are met at moments that depend on what is chosen; at others slopes are right."""
    st = extremal.statement
    sparsities = [borders.ends.jac_sparsity(0, i) for i in MOVING]
    by_state, by_control, by_matrices = (_pattern(sparsity) for sparsity in sparsities)
    if st.duration.free or linked:
        return np.ones(len(borders.whole), dtype=bool)
    slopes = [[_pattern(st.rates.jac_sparsity(row, i)) for i in MOVING] for row in (0, 1)]
    moved = np.concatenate([np.isnan(st.boundary_values(extremal.parameters).initial), np.zeros(st.ne, dtype=bool)])
    moved[st.decisions] = True
    moved |= np.concatenate([own[1].any(axis=1) for own in slopes])
    others = np.vstack([np.hstack([own[0], own[2]]) for own in slopes])
    while True:
        more = moved | others[:, moved].any(axis=1)
        if np.array_equal(more, moved):
            break
        moved = more
    return np.asarray(by_control.any(axis=1) | np.hstack([by_state, by_matrices])[:, moved].any(axis=1))


def _pattern(sparsity: ca.Sparsity) -> NDArray[np.bool_]:
    """Where a matrix may not be zero."""
    return np.asarray(ca.DM(sparsity, 1.0).full(), dtype=bool)


def _sides(values: Array, whole: Array) -> Array:
    """On which side of their borders some values are."""
    return np.where(whole if values.ndim == 1 else whole[:, None], np.floor(values), np.sign(values))


def _bisected(
    extremal: Extremal, dense: Dense, borders: Borders, rows: Array, gaps: tuple[Any, Array, Array]
) -> Iterator[_Met]:
    """The borders of some rows within gaps (interval, first, last normalised time), to rounding."""
    k, low, high = gaps
    whole, every = np.array(borders.whole)[rows], np.arange(rows.size)

    def side(s: Array) -> Array:
        return _sides(mapped(borders.ends, *columns_between(extremal, dense, k, s))[0][rows, every], whole)

    before = side(low)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        same = side(middle) == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    apart = BESIDE * np.diff(extremal.mesh.nodes)[k]  # on the border itself one of both sides has its value
    low, high = np.maximum(gaps[1], low - apart), np.minimum(gaps[2], high + apart)
    first, last = (columns_between(extremal, dense, k, s) for s in (low, high))
    for j in every:
        sides = tuple(np.concatenate([column[:, j] for column in columns]) for columns in (first, last))
        yield _Met(int(rows[j]), int(k[j]), float(high[j]), True, (sides[0], sides[1]))


def _given(extremal: Extremal, borders: Borders, row: int, run: tuple[int, int], s: Array, linked: bool) -> bool:
    """Whether a path is on a border since it begins or ends where that is given, and leaves it at once."""
    st, (a, b) = extremal.statement, run
    at_start, at_end = a < 0, b == s.size
    if at_start == at_end or (s[b - 1] - s[a + 1]) > EDGE:
        return False
    states, *others = (set(_columns(borders, row, i)) for i in MOVING)
    if any(others):
        return False
    values = st.boundary_values(extremal.parameters)
    free = states & set(np.flatnonzero(np.isnan(values.initial if at_start else values.final)).tolist())
    conditions = st.start if at_start else st.end
    if free and conditions.size:
        equal = np.flatnonzero(conditions.lower == conditions.upper)
        sparsity = conditions.function.jac_sparsity(0, 0)
        free -= {c for r, c in zip(sparsity.row(), sparsity.get_col(), strict=True) if r in equal}
    return not free or (at_start and linked)


def _columns(borders: Borders, row: int, argument: int) -> list[int]:
    """Entries of an argument that a border depends on."""
    sparsity = borders.ends.jac_sparsity(0, argument)
    return [c for r, c in zip(sparsity.row(), sparsity.get_col(), strict=True) if r == row]


@lru_cache(maxsize=KEPT)
def _slopes(ends: ca.Function) -> ca.Function:
    """Of what is compared, by state, control and matrices."""
    arguments: Any = ends.sx_in()
    by = ca.vertcat(*(arguments[i] for i in MOVING))
    return ca.Function("slopes", arguments, [ca.densify(ca.jacobian(ends(*arguments), by))])


def _beside(borders: Borders, row: int, at: list[Array], distance: float) -> tuple[Array, Array] | None:
    """Arguments on both sides of a border, near a point on it; None where it does not depend on what moves."""
    slope = np.asarray(_slopes(borders.ends)(*at).full())[row]
    value = float(np.asarray(borders.ends(*at).full()).ravel()[row])
    value -= round(value) if borders.whole[row] else 0.0
    moving = np.concatenate([at[i] for i in MOVING])
    units = np.where(slope != 0, np.maximum(np.abs(moving), np.abs(moving).max(initial=0.0) * NEAR), 0.0)
    units = np.where((slope != 0) & (units == 0), 1.0, units)
    square = float(((units * slope) ** 2).sum())
    if not 0 < square < np.inf or distance == 0:
        return None
    step, rest = units**2 * slope / square, np.concatenate(at[len(MOVING) :])
    first, last = (np.concatenate([moving + (target - value) * step, rest]) for target in (-distance, distance))
    return first, last


def _felt(extremal: Extremal, dense: Dense) -> Iterator[_Met]:
    """Jumps of rates whose comparisons cannot be read: changes between neighbouring points that do not shrink.

    The time is the same on both sides: what jumps with the time alone does not count.
    """
    k, s = _points(extremal, dense)
    same = np.flatnonzero(k[1:] == k[:-1])
    k, low, high = k[same], s[same], s[same + 1]
    largest = np.zeros(0)

    def changes(low: Array, high: Array, k: Any) -> tuple[Array, Any]:
        first, last = (list(columns_between(extremal, dense, k, s)) for s in (low, high))
        first[3] = last[3] = 0.5 * (first[3] + last[3])
        one, other = (np.vstack(mapped(extremal.statement.rates, *side)) for side in (first, last))
        sizes = largest if largest.size else np.abs(one).max(axis=1)
        scaled = np.abs(other - one) / np.where(sizes > 0, sizes, 1.0)[:, None]
        return np.where(np.isfinite(scaled), scaled, 0.0).max(axis=0, initial=0.0), (first, last, sizes)

    found, (*_, largest) = changes(low, high, k)
    chosen = np.sort(np.argsort(found)[-GAPS:])
    k, low, high = k[chosen], low[chosen], high[chosen]
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        left, right = changes(low, middle, k)[0], changes(middle, high, k)[0]
        low, high = np.where(left >= right, low, middle), np.where(left >= right, middle, high)
    left, (first, last, _) = changes(low, high, k)
    for j in np.flatnonzero(left > LEAST):
        sides = tuple(np.concatenate([column[:, j] for column in columns]) for columns in (first, last))
        yield _Met(-1, int(k[j]), float(high[j]), True, (sides[0], sides[1]))


def _weighed(
    extremal: Extremal, function: ca.Function, borders: Borders | None, met: list[_Met], optimised: bool
) -> tuple[Jump, ...]:
    """Jumps by what they do to H, those that do something, one for each comparison."""
    if not met:
        return ()
    st, nodes = extremal.statement, extremal.mesh.nodes
    sizes = (st.nx, st.nu, st.ne, 1, 1, st.np)
    both = [np.array([entry.sides[i] for entry in met]).T for i in (0, 1)]
    low, high = (np.vstack(mapped(function, *np.split(side, np.cumsum(sizes)[:-1]))) for side in both)
    rates = rates_along(extremal)[0]
    if optimised:
        costates = discrete_costates(extremal)[0]
        weights = np.hstack([costates.state, costates.matrices])
        terms = np.abs(weights * rates).sum(axis=1).max()
        k = np.array([entry.interval for entry in met])
        h = nodes[k + 1] - nodes[k]
        c = (np.array([entry.s for entry in met]) - nodes[k]) / h
        own = np.vstack([(weights[k] + c[:, None] * (weights[k + 1] - weights[k])).T, np.ones((1, len(met)))])
    else:
        terms, largest = 1.0, np.abs(rates).max(axis=0)
        known = (np.arange(largest.size) < st.nx) & (largest > 0)
        own = np.append(np.where(known, 1.0 / np.where(known, largest, 1.0), 0.0), 0.0)[:, None]
    acting = own * (high - low)
    terms = np.maximum(terms, np.maximum(np.abs(low[-1]), np.abs(high[-1])) if optimised else 0.0)
    total = np.abs(acting.sum(axis=0)) / np.where(terms > 0, terms, 1.0)
    grouped: dict[tuple[str, tuple[str, ...]], list[int]] = {}
    for j in np.flatnonzero(total > LEAST):
        grouped.setdefault(_told(st, borders, met[j].border), []).append(int(j))
    jumps = []
    for (words, names), group in grouped.items():
        worst = max(group, key=lambda j: total[j])
        i = int(np.argmax(np.abs(acting[:, worst])))
        share = abs(high[i, worst] - low[i, worst]) / max(abs(high[i, worst]), abs(low[i, worst]))
        jumps.append(
            Jump(
                words=words,
                names=names,
                times=tuple(sorted({met[j].s * extremal.trajectory.duration for j in group})),
                intervals=tuple(sorted({k for j in group for k in _around(nodes, met[j])})),
                crossed=any(met[j].crossed for j in group),
                what=(*st.state_names, *st.matrix_names, "")[i],
                share=float(share),
                size=float(total[worst]),
            )
        )
    return tuple(sorted(jumps, key=lambda jump: -jump.size))


def _around(nodes: Array, met: _Met) -> list[int]:
    """The interval in which a border is met; both beside a node."""
    k, h = met.interval, nodes[met.interval + 1] - nodes[met.interval]
    before = k > 0 and met.s - nodes[k] <= BESIDE * h
    after = k + 2 < nodes.size and nodes[k + 1] - met.s <= BESIDE * h
    return [k, *([k - 1] if before else []), *([k + 1] if after else [])]


def _told(statement: Statement, borders: Borders | None, row: int) -> tuple[str, tuple[str, ...]]:
    """What is compared, in words, and the entries that it depends on."""
    if borders is None:
        return "", ()
    names = (statement.state_names, statement.control_names, statement.matrix_names)
    entries = [ca.vertcat(*(ca.SX.sym(name) for name in own)) if own else ca.SX(0, 1) for own in names]
    others = [ca.SX.sym("time"), ca.SX.sym("duration"), _parameters(statement)]
    depends = [own[c] for own, i in zip(names, MOVING, strict=True) for c in _columns(borders, row, i)]
    return borders.words([*entries, *others], row), tuple(depends)


def _parameters(statement: Statement) -> Any:
    """Known parameters and unknowns by their names, where they are all vectors; else by numbers."""
    blocks = [b for kind in ("parameter", "unknown") for b in statement.of_kind(kind)]
    parts = [ca.SX.sym(b.name, b.length) for b in blocks]
    symbols = ca.vertcat(*parts) if parts else ca.SX(0, 1)
    return symbols if symbols.numel() == statement.np else ca.SX.sym("parameter", statement.np)
