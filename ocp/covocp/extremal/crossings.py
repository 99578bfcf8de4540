"""Where the path of a solution meets borders between pieces of its model, and the arguments on both sides of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.buffered import Matrices
from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.pieces import Borders
from covocp.base.quadrature import hermite
from covocp.extremal.dense_output import between_nodes, dense_output, mapped
from covocp.extremal.extremal import Extremal
from covocp.extremal.path_limits import columns_between, places_along
from covocp.extremal.polynomials import Dense
from covocp.statement.interval import repeated
from covocp.statement.statement import INPUTS, Statement
from covocp.transcription.covariance_steps import KEPT

# Numbers of the arguments that move with what is chosen.
MOVING = tuple(INPUTS.index(name) for name in ("state", "control", "matrices"))
CONTROL, TIME, DURATION, PARAMETERS = (INPUTS.index(n) for n in ("control", "time", "duration", "parameters"))
# Equal parts of an interval at whose ends it is looked at.
PARTS = 10
# Share of the largest value of what is compared below which it is on the border, and by which it is moved to its sides
# (of an interval: by which points on both sides of a crossing are apart).
NEAR, BESIDE = 1e-7, 1e-9
# Share of the gap in which a crossing is by which it may be missed by the secant, and the most such steps.
CLOSE, MOST_STEPS = 1e-3, 50
# Change of a rate, relative to its largest value (of the cost: to its own), that is none.
NO_CHANGE = 1e-6
# Share of the time at an end of the path within which it is on a border since it is given there: of a chain of n
# integrators t^n is below NEAR up to t = NEAR^(1/n).
EDGE = 0.1
# Share of the range of what is compared that is a jump of a control, within this share of the time at most.
LARGE, SHORT = 0.5, 0.25
# Share of a step across a border beyond a limit from which it is forbidden; squared sine of normals that are parallel.
BEYOND, PARALLEL = 0.25, 1e-10
# Gaps between points that are looked into where comparisons cannot be read, those with the largest changes, into how
# many places they are divided, and how often: to 4e-11 of a gap; change of a rate, in its largest value, that counts.
GAPS, DIVIDED, TIMES, FELT = 8, 32, 7, 1e-5
# Points at which a function is evaluated together, numbers of them that get a function of their own.
TOGETHER, COUNTS = 1024, 64


class Met(NamedTuple):
    """A border that is met: its number (-1: not known), interval and normalised time, the arguments on both sides."""

    border: int
    interval: int
    s: float
    crossed: bool
    sides: tuple[Array, Array]


@dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """The states, controls and matrices of a solution between its nodes.

    simple: whether its pieces are the intervals.
    """

    extremal: Extremal
    dense: Dense
    simple: bool

    @classmethod
    def of(cls, extremal: Extremal, *, matrices: bool) -> Path:
        """Cubic from node to node where an explicit step leads there, which no transient survives; else integrated.

        matrices: whether what the covariances are between the nodes matters.
        """
        mesh = extremal.mesh
        if matrices or mesh.step == "rodas" or mesh.substeps > 1:
            return cls(extremal=extremal, dense=dense_output(extremal, matrices=matrices), simple=False)
        return cls(extremal=extremal, dense=between_nodes(extremal), simple=True)

    @property
    def largest(self) -> Array:
        """Largest sizes of the rates of x and e."""
        slopes = np.vstack([np.abs(self.dense.first), np.abs(self.dense.last)]).max(axis=0)
        return np.asarray(slopes / self.extremal.trajectory.duration)

    def points(self) -> tuple[NDArray[np.intp], Array]:
        """Intervals, and normalised times in them, in their order."""
        mesh = self.extremal.mesh
        pairs = list(places_along(mesh, self.dense, PARTS))
        k, s = (np.concatenate([pair[i] for pair in pairs]) for i in (0, 1))
        k, s = np.asarray(k, dtype=np.intp), np.asarray(s)
        order = np.arange(k.size) if self.simple else np.lexsort((s, k))
        order = order[np.diff(mesh.nodes)[k[order]] > 0]
        return k[order], s[order]

    def columns(self, k: Any, s: Array) -> list[Array]:
        """All six arguments of the model at normalised times s of the intervals k, a column each."""
        if not self.simple:
            return list(columns_between(self.extremal, self.dense, k, s))
        st, nodes, dense = self.extremal.statement, self.extremal.mesh.nodes, self.dense
        h = nodes[k + 1] - nodes[k]
        c = (s - nodes[k]) / h
        slopes = h[:, None] * dense.first[k], h[:, None] * dense.last[k]
        z = np.asarray(hermite(dense.values[k], dense.values[k + 1], *slopes, c[:, None])).T
        duration = self.extremal.trajectory.duration
        fixed = repeated(duration, self.extremal.parameters, s.size)
        return [z[: st.nx], self.extremal.control(k, c).T, z[st.nx :], duration * s[None, :], *fixed]


def evaluated(function: ca.Function, *columns: Array) -> list[Array]:
    """Outputs of a function of columns, for as many of them as there are again and again: in groups of equal size."""
    count = columns[0].shape[1]
    size = -(-count // -(-count // TOGETHER))
    if size == count:
        return _for_columns(function, count).evaluated(*columns)
    groups = [np.minimum(np.arange(begin, begin + size), count - 1) for begin in range(0, count, size)]
    call = _for_columns(function, size)
    parts = [call.evaluated(*(column[:, taken] for column in columns)) for taken in groups]
    return [np.hstack(values)[:, :count] for values in zip(*parts, strict=True)]


@lru_cache(maxsize=COUNTS)
def _for_columns(function: ca.Function, count: int) -> Matrices:
    """A function of so many columns, for numbers."""
    return Matrices(function.map(count))


class _Runs(NamedTuple):
    """Where borders are met: points just before crossings, with their border; and border, point, whether crossed."""

    points: tuple[Any, Array]
    values: Array
    sizes: Array
    within: list[tuple[int, int]]
    reached: list[tuple[int, int, bool]]
    close: bool


def crossings(path: Path, borders: Borders, linked: bool) -> Iterator[Met]:
    """Where what is compared changes its side, or is on the border; those across which some rate changes.

    linked: whether the start is the end of a phase before it.
    """
    movable = _movable(path.extremal, borders, linked)
    if not movable.any():
        return
    runs = _runs(path, borders, movable, linked)
    if path.simple and (runs.reached or runs.close):  # what rates that jump make of an interval is not cubic
        path = Path(extremal=path.extremal, dense=dense_output(path.extremal, matrices=False), simple=False)
        runs = _runs(path, borders, movable, linked)
    (k, s), values = runs.points, runs.values
    for row, i, crossed in runs.reached:
        found = _moved(path, borders, (row, int(k[i]), float(s[i])), BESIDE * runs.sizes[row])
        if found is not None and not _forbidden(path.extremal.statement, borders, row, found):
            yield Met(row, int(k[i]), float(s[i]), crossed, found[:2])
    if not runs.within:
        return
    rows, points = (np.array(v) for v in zip(*runs.within, strict=True))
    gaps = k[points], s[points], s[points + 1]
    for met in _bracketed(path, borders, rows, gaps, (values[rows, points], values[rows, points + 1])):
        found = _moved(path, borders, met[:3], BESIDE * runs.sizes[met.border])
        if found is None or not _forbidden(path.extremal.statement, borders, met.border, found):
            yield met


def _runs(path: Path, borders: Borders, movable: NDArray[np.bool_], linked: bool) -> _Runs:
    """Points beside which borders are met."""
    k, s = path.points()
    whole = np.array(borders.whole)
    values = evaluated(borders.ends, *path.columns(k, s))[0]
    sides = _sides(values, whole)
    distance = np.abs(values - np.where(whole[:, None], np.round(values), 0.0))
    sizes = np.where(whole, np.ptp(values, axis=1), np.abs(values).max(axis=1))
    near = distance <= NEAR * sizes[:, None]
    passed = near | np.pad(np.diff(sides, axis=1) != 0, ((0, 0), (0, 1)))
    movable = movable & np.isfinite(values).all(axis=1)
    within, reached = [], []
    for row in np.flatnonzero(movable & passed.any(axis=1)):
        clear = np.flatnonzero(~near[row])
        ends = [-1, *clear.tolist(), s.size]
        apart = np.diff(ends) > 1
        changes = np.concatenate([[False], np.diff(sides[row, clear]) != 0, [False]])[: apart.size]
        for i in np.flatnonzero(apart | changes):
            a, b = ends[i], ends[i + 1]
            if changes[i] and _by_jump(path, borders, int(row), (k, values[row]), (a, b)):
                continue
            if b == a + 1:
                within += [(int(row), a)] if k[a] == k[b] else []  # else a control jumps from one side to the other
            elif not _given(path.extremal, borders, int(row), (a, b), s, linked):
                reached.append((int(row), (a + b) // 2, bool(changes[i])))
    close = path.simple and _close(*(own[movable].reshape(-1, s.size) for own in (values, distance, passed)))
    return _Runs((k, s), values, sizes, within, reached, close)


def _close(values: Array, distance: Array, passed: Array) -> bool:
    """Whether an interval comes as close to a border as it moves, where neither it nor one beside it meets it."""
    intervals = [own.reshape(own.shape[0], -1, PARTS + 1) for own in (values, distance, passed)]
    met = np.pad(intervals[2].any(axis=2), ((0, 0), (1, 1)))
    beside = met[:, 1:-1] | met[:, 2:] | met[:, :-2]
    return bool(((intervals[1].min(axis=2) < np.ptp(intervals[0], axis=2)) & ~beside).any())


def _by_jump(path: Path, borders: Borders, row: int, points: tuple[Any, Array], run: tuple[int, int]) -> bool:
    """Whether controls alone pass a border, by a change that is a jump but for their form: it needs none of costates.

    points: intervals, and what is compared there.
    run: points before and behind the border.
    """
    if any(columns_of(borders, row, i) for i in range(len(INPUTS)) if i not in (CONTROL, PARAMETERS)):
        return False
    (k, values), nodes = points, path.extremal.mesh.nodes
    first, last = k[run[0]], k[run[1]]
    for more in (0, 1):
        start, stop = max(first - more, 0), min(last + more, nodes.size - 2)
        taken = values[(k >= start) & (k <= stop)]
        if nodes[stop + 1] - nodes[start] <= SHORT and np.ptp(taken) >= LARGE * np.ptp(values):
            return True
    return False


def _moved(
    path: Path, borders: Borders, place: tuple[int, int, float], distance: float
) -> tuple[Array, Array, Array] | None:
    """Arguments on both sides of a border (its number, interval, normalised time), and its slope."""
    row, k, s = place
    at = [column[:, 0] for column in path.columns(np.array([k]), np.array([s]))]
    return _beside(borders, row, at, distance)


def _forbidden(statement: Statement, borders: Borders, row: int, found: tuple[Array, Array, Array]) -> bool:
    """Whether one side of a border is beyond a bound, or a condition along the path, whose limit is the border.

    A border that moves with the time is none of them.
    """
    times = (TIME, DURATION) if statement.duration.free else (TIME,)
    if any(columns_of(borders, row, i) for i in times):
        return False
    (first, last, slope), st = found, statement
    moving = slope.size
    step = (last - first)[:moving]
    lower = np.concatenate([st.state_bounds[0], st.control_bounds[0], st.matrix_lower])
    upper = np.concatenate([st.state_bounds[1], st.control_bounds[1], np.full(st.ne, np.inf)])
    (alone,) = np.nonzero(slope)
    if alone.size == 1 and _beyond(first[alone], last[alone], step[alone], lower[alone], upper[alone]):
        return True
    if not st.path.size:
        return False
    sizes = (st.nx, st.nu, st.ne, 1, 1, st.np)
    both = [_path_values(st.path.function)(*np.split(side, np.cumsum(sizes)[:-1])) for side in (first, last)]
    one, other = (np.asarray(value.full()).ravel() for value, _ in both)
    normals = np.asarray(both[0][1].full())
    along, size = normals @ slope, (normals**2).sum(axis=1)
    parallel = (size > 0) & (along**2 >= (1 - PARALLEL) * size * (slope @ slope)) & ~st.path.equations
    return _beyond(
        one[parallel], other[parallel], (other - one)[parallel], st.path.lower[parallel], st.path.upper[parallel]
    )


def _beyond(first: Array, last: Array, step: Array, lower: Array, upper: Array) -> bool:
    """Whether a side of a border is beyond a limit of its own."""
    room = BEYOND * np.abs(step)
    outside = [(value > upper + room) | (value < lower - room) for value in (first, last)]
    return bool((outside[0] | outside[1]).any())


@lru_cache(maxsize=KEPT)
def _path_values(function: ca.Function) -> ca.Function:
    """Conditions along the path, and their slopes by state, control and matrices."""
    symbols: Any = function.mx_in()
    value: Any = function(*symbols)
    slopes = ca.horzcat(*(ca.jacobian(value, symbols[i]) for i in MOVING))
    return ca.Function("limits", symbols, [ca.densify(value), ca.densify(slopes)])


def _bracketed(
    path: Path, borders: Borders, rows: Array, gaps: tuple[Any, Array, Array], ends: tuple[Array, Array]
) -> Iterator[Met]:
    """The borders of some rows within gaps (interval, first, last normalised time), to rounding.

    A secant from end to end, and points as near on both sides of it; halves where that fails. What has nearly the same
    rates at both ends is left.

    ends: what is compared at the ends of the gaps.
    """
    found = _Brackets(path, borders, rows, gaps, ends)
    k, apart = gaps[0], found.apart
    for _ in range(MOST_STEPS):
        if not found.closer():
            break
    low, high = np.maximum(gaps[1], found.low - apart), np.minimum(gaps[2], found.high + apart)
    kept = np.flatnonzero(found.kept)
    first, last = (path.columns(k[kept], s[kept]) for s in (low, high)) if kept.size else ([], [])
    for i, j in enumerate(kept):
        sides = tuple(np.concatenate([column[:, i] for column in columns]) for columns in (first, last))
        yield Met(int(rows[j]), int(k[j]), float(high[j]), True, (sides[0], sides[1]))


class _Brackets:
    """Borders of some rows between two normalised times each, which come closer."""

    def __init__(self, path: Path, borders: Borders, rows: Array, gaps: tuple[Any, Array, Array], ends: Any) -> None:
        """Begin with gaps (interval, first, last normalised time); ends: what is compared at their ends."""
        self.path, self.borders, self.rows = path, borders, rows
        self.k, self.low, self.high = gaps[0], gaps[1].copy(), gaps[2].copy()
        self.whole = np.array(borders.whole)[rows]
        self.before = _sides(ends[0], self.whole)
        self.border = np.where(self.whole, np.where(ends[1] > ends[0], self.before + 1, self.before), 0.0)
        self.values = np.array(ends) - self.border
        self.rates = np.full((2, path.largest.size + 1, rows.size), np.nan)
        self.apart = BESIDE * np.diff(path.extremal.mesh.nodes)[self.k]
        self.kept, self.halved = np.ones((2, rows.size), dtype=bool)
        self.halved[:] = False

    def closer(self) -> bool:
        """One step, of those that are not close; whether there were any."""
        width = self.high - self.low
        (left,) = np.nonzero(self.kept & (width > self.apart))
        if not left.size:
            return False
        start, end = self.values[:, left]
        share = np.where(start != end, start / np.where(start != end, start - end, 1.0), 0.5)
        shares = [np.where(self.halved[left], 0.5, np.clip(share + side, 0.0, 1.0)) for side in (-CLOSE, CLOSE)]
        places = np.array([self.low[left] + own * width[left] for own in shares])
        columns = self.path.columns(np.tile(self.k[left], 2), places.ravel())
        compared = mapped(self.borders.ends, *columns)[0].reshape(-1, 2, left.size)
        values = compared[self.rows[left], :, np.arange(left.size)].T
        rates = np.vstack(mapped(self.path.extremal.statement.rates, *columns)).reshape(-1, 2, left.size)
        same = np.array([_sides(own, self.whole[left]) == self.before[left] for own in values])
        every = np.arange(left.size)
        for end_at, moved, taken in ((0, same[0], same.all(axis=0)), (1, ~same.all(axis=0), same[0])):
            j, i = taken.astype(int)[moved], every[moved]
            (self.low, self.high)[end_at][left[moved]] = places[j, i]
            self.values[end_at, left[moved]] = values[j, i] - self.border[left[moved]]
            self.rates[end_at][:, left[moved]] = rates[:, j, i]
        self.halved[left] = self.high[left] - self.low[left] > 0.5 * width[left]
        self.kept[left] = changed(self.path, *self.rates[:, :, left])
        return True


def changed(path: Path, first: Array, last: Array) -> NDArray[np.bool_]:
    """For which columns rates and running cost on two sides differ by more than nothing; also where not known."""
    largest = np.broadcast_to(path.largest[:, None], first[:-1].shape)
    sizes = np.vstack([largest, np.maximum(np.abs(first[-1]), np.abs(last[-1]))])
    return np.asarray(~(np.abs(last - first) <= NO_CHANGE * sizes).all(axis=0))


def felt(path: Path) -> Iterator[Met]:
    """Jumps of rates whose comparisons cannot be read: changes between neighbouring points that do not shrink.

    The time is the same on both sides: what jumps with the time alone does not count.
    """
    k, s = path.points()
    first = np.flatnonzero(k[1:] == k[:-1])
    one, other = _neighbours(path, path.columns(k, s), (first, first + 1), evaluated)
    sizes = np.abs(one).max(axis=1, initial=0.0)
    sizes = np.where(sizes > 0, sizes, 1.0)[:, None]
    found = _finite((other - one) / sizes).max(axis=0, initial=0.0)
    chosen = np.sort(np.argsort(found)[-GAPS:])
    chosen = first[chosen[found[chosen] > FELT]]
    k, low, high = k[chosen], s[chosen], s[chosen + 1]
    for _ in range(TIMES):
        if not k.size:
            return
        shares = np.linspace(0.0, 1.0, DIVIDED)
        places = low[:, None] * (1 - shares) + high[:, None] * shares
        begins = np.arange(places.size).reshape(places.shape)[:, :-1].ravel()
        columns = path.columns(np.repeat(k, DIVIDED), places.ravel())
        one, other = _neighbours(path, columns, (begins, begins + 1), mapped)
        steps = ((other - one) / sizes).reshape(-1, k.size, DIVIDED - 1)
        beside = _finite(steps - np.median(steps, axis=2, keepdims=True)).max(axis=0)  # what is smooth has equal steps
        best, every = beside.argmax(axis=1), np.arange(k.size)
        left = beside[every, best] > FELT
        k, low, high = k[left], places[every, best][left], places[every, best + 1][left]
    both = [path.columns(k, at) for at in (low, high)]
    both[0][TIME] = both[1][TIME] = 0.5 * (both[0][TIME] + both[1][TIME])
    for j in range(k.size):
        sides = [np.concatenate([column[:, j] for column in columns]) for columns in both]
        yield Met(-1, int(k[j]), float(high[j]), True, (sides[0], sides[1]))


def _neighbours(
    path: Path, columns: list[Array], pairs: tuple[Any, Any], run: Callable[..., list[Array]]
) -> tuple[Array, Array]:
    """Rates and running cost at pairs of points, at the time in the middle of both."""
    function, (first, last) = path.extremal.statement.rates, pairs
    if path.extremal.statement.autonomous:
        values = np.vstack(run(function, *columns))
        return values[:, first], values[:, last]
    taken = [column[:, np.concatenate(pairs)] for column in columns]
    taken[TIME] = np.tile(0.5 * (columns[TIME][:, first] + columns[TIME][:, last]), 2)
    values = np.vstack(run(function, *taken))
    return values[:, : first.size], values[:, first.size :]


def _finite(values: Array) -> Array:
    """Sizes, 0 of what is no number."""
    return np.where(np.isfinite(values), np.abs(values), 0.0)


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


def _given(extremal: Extremal, borders: Borders, row: int, run: tuple[int, int], s: Array, linked: bool) -> bool:
    """Whether a path is on a border since it begins or ends where that is given, and leaves it at once."""
    st, (a, b) = extremal.statement, run
    at_start, at_end = a < 0, b == s.size
    if at_start == at_end or (s[b - 1] - s[a + 1]) > EDGE:
        return False
    states, *others = (set(columns_of(borders, row, i)) for i in MOVING)
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


def columns_of(borders: Borders, row: int, argument: int) -> list[int]:
    """Entries of an argument that a border depends on."""
    sparsity = borders.ends.jac_sparsity(0, argument)
    return [c for r, c in zip(sparsity.row(), sparsity.get_col(), strict=True) if r == row]


@lru_cache(maxsize=KEPT)
def _slopes(ends: ca.Function) -> ca.Function:
    """Of what is compared, by state, control and matrices."""
    arguments: Any = ends.sx_in()
    by = ca.vertcat(*(arguments[i] for i in MOVING))
    return ca.Function("slopes", arguments, [ca.densify(ca.jacobian(ends(*arguments), by))])


def _beside(borders: Borders, row: int, at: list[Array], distance: float) -> tuple[Array, Array, Array] | None:
    """Arguments on both sides of a border, near a point on it, and its slope; None where nothing moves it."""
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
    return first, last, slope
