"""Values between the nodes, as the integrator computes them there: knots so close that cubic polynomials join them.

Each interval is integrated again from its node (what runs backward from its later node) by steps of the integrator's
own kind, whose lengths follow from two comparisons: one step against two halves of it, and the cubic polynomial
through its ends against the middle. So a transient that the steps of the transcription pass over, and the steep fall of
a covariance within the first thousandth of an interval, are there on both sides, and a smooth interval costs two knots.
The values at the nodes stay those of the transcription; what they miss is spread linearly over their interval.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array, half_indices, read_only
from covocp.base.quadrature import hermite
from covocp.base.residuals import BETWEEN_NODES
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal
from covocp.extremal.nodes import rates_along
from covocp.extremal.polynomials import Dense, joined, lengths, rows_of, semidefinite
from covocp.passage.columns import Owner, numbers_in_columns
from covocp.statement.interval import one_sided, repeated
from covocp.statement.statement import Statement
from covocp.transcription.numbers import compiled_step
from covocp.transcription.scales import magnitudes
from covocp.transcription.steps import joint_interval, matrices_step, nominal_interval

# Largest error of a step and of the polynomial over it, relative to the range of an entry along the solution, and, for
# what is positive semidefinite, to the roots of the diagonal at this place.
OF_RANGE, OF_DEVIATIONS = BETWEEN_NODES, 1e-3
# An entry that hardly varies is known to this share of its size; what is below the second share is roundoff.
OF_SIZE, ROUNDOFF = 1e-6, 1e-11
# A state that is no more than this share of its magnitude, such as its deviation, is zero but for roundoff.
NOTHING = 1e-12
# Share of what its rate would move it by in a step by which an entry that is the same at all nodes is thought to move,
# and by how much less it moves between them to be the same.
OF_MOVE, SAME_AT_NODES = 1e-3, 1e-12
# A step grows and shrinks by no more than these factors, and never below this share of what is before it in its
# interval; the first, where a filter that begins with a large variance is fastest, never below the last share.
GROW, SHRINK, SMALLEST, FIRST = 4.0, 0.1, 1e-9, 1e-22
MOST_ROUNDS = 500
# The next step is this share of the longest that seems possible; errors below the second count as it.
SAFETY, TINY = 0.8, 1e-9
# Columns that a mapped function takes at a time.
CHUNKS = (1, 4, 16, 64, 256, 1024)
# Such functions that are kept.
MAPS = 32


def dense_output(extremal: Extremal, *, matrices: bool = True) -> Dense:
    """What a solution is between its nodes; remembered.

    Args:
        extremal: a trajectory that its mesh's steps made.
        matrices: False where only the states are asked for; their half-vectors are then cubic between the nodes.

    Returns:
        The polynomials, read-only; cubic between the nodes where the trajectory is not finite or a step cannot be
        solved.
    """
    return _remembered(extremal, matrices or not extremal.statement.ne)


@lru_cache(maxsize=4)
def _remembered(extremal: Extremal, matrices: bool) -> Dense:
    return read_only(_between(extremal, matrices))


def _between(extremal: Extremal, matrices: bool) -> Dense:
    """Polynomials between the nodes."""
    coarse = between_nodes(extremal)
    if not all(np.isfinite(v).all() for v in (coarse.values, coarse.first, coarse.last)):
        return coarse
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return joined(extremal, _tracks(extremal, coarse, matrices))
    except RuntimeError:  # CasADi's, of a linear system that is singular: the steps of the transcription were not
        return coarse


def between_nodes(extremal: Extremal) -> Dense:
    """Cubic polynomials through the nodes with the rates there: nothing is integrated."""
    t, duration = extremal.trajectory, extremal.trajectory.duration
    rates, ends = rates_along(extremal)
    values = np.hstack([t.x, t.e])
    return Dense(knots=extremal.mesh.nodes, values=values, first=duration * rates[:-1], last=duration * ends)


def _tracks(extremal: Extremal, coarse: Dense, matrices: bool) -> list[tuple[list[int], Dense]]:
    """Entries of (x, e) that are stepped together, with their polynomials."""
    st = extremal.statement
    nx, everything = st.nx, list(range(st.nx + st.ne))
    if st.coupled:
        return [(everything, _march(_Steps.of(extremal, coarse, everything, None)))]
    states = _march(_Steps.of(extremal, coarse, everything[:nx], None))
    tracks = [(everything[:nx], states)]
    for positions in (st.ahead, st.behind):
        rows = [nx + k for k in st.entries(positions)]
        if rows and matrices:
            tracks.append((rows, _march(_Steps.of(extremal, coarse, rows, states))))
        elif rows:
            tracks.append((rows, rows_of(coarse, rows)))
    if gathered := [nx + k for k in st.entries(st.summed)]:  # what they are at the nodes is what counts
        tracks.append((gathered, rows_of(coarse, gathered)))
    return tracks


@dataclass(frozen=True, kw_only=True, eq=False)
class _Steps:
    """Steps of some entries of (x, e), all intervals at once; shares c of an interval run in the direction of travel.

    Args:
        extremal: the solution.
        rows: the entries.
        backward: whether they run from the later node.
        states: the nominal, where these are matrices that it drives.
        start, goal: values at the node where an interval begins and ends, in the direction of travel, (N, rows).
        seen: smallest and largest values of the entries so far, (2, rows).
        size: of the entries along the solution, (rows,).
        pairs: for each entry of a covariance the positions of both variances among the rows, else -1, (2, rows).
    """

    extremal: Extremal
    rows: list[int]
    backward: bool
    states: Dense | None
    start: Array
    goal: Array
    seen: Array
    size: Array
    pairs: Any

    __repr__ = short_repr

    @staticmethod
    def of(extremal: Extremal, coarse: Dense, rows: list[int], states: Dense | None) -> _Steps:
        """The steps of these entries."""
        st = extremal.statement
        backward, moving = rows[0] - st.nx in st.entries(st.behind), sum(row < st.nx for row in rows)
        values = coarse.values[:, rows]
        step = np.diff(coarse.knots)[:, None] / extremal.mesh.substeps
        moved = np.abs(step * coarse.first[:, rows]).max(axis=0)
        still, pairs = np.ptp(values, axis=0) <= SAME_AT_NODES * moved, _variances(st, rows)
        still &= ~_varying(values, pairs)
        moved = np.where(still, OF_MOVE * moved, 0.0)
        size = np.maximum(np.abs(values).max(axis=0), moved)
        known = magnitudes(st, extremal.trajectory, extremal.parameters).x
        size[:moving] = np.where(size[:moving] > NOTHING * known[:moving], size[:moving], known[:moving])
        ends = (values[1:], values[:-1]) if backward else (values[:-1], values[1:])
        return _Steps(
            extremal=extremal,
            rows=rows,
            backward=backward,
            states=states,
            start=ends[0],
            goal=ends[1],
            seen=np.array([values.min(axis=0), np.maximum(values.max(axis=0), values.min(axis=0) + moved)]),
            size=np.where(size > 0, size, 1.0),
            pairs=pairs,
        )

    @property
    def smooth(self) -> bool:
        """Whether rates depend on the time through states and controls alone."""
        return self.extremal.statement.autonomous

    def place(self, k: Expr, c: Array) -> Array:
        """Normalised time at the share c of interval k."""
        nodes = self.extremal.mesh.nodes
        begin, end = (nodes[1:], nodes[:-1]) if self.backward else (nodes[:-1], nodes[1:])
        return np.asarray(np.where(c == 1.0, end[k], begin[k] + c * (end[k] - begin[k])))

    def control(self, k: Expr, c: Array) -> Array:
        """Controls there, (m, nu)."""
        return self.extremal.control(k, 1.0 - c if self.backward else c)

    def fixed(self, count: int) -> tuple[Array, Array]:
        """Terminal time and parameters, a column each."""
        return repeated(self.extremal.trajectory.duration, self.extremal.parameters, count)

    def advance(self, k: Expr, c: Array, d: Array, z: Array) -> Array:
        """The entries at the share d from those at c."""
        s, after = self.place(k, c), self.place(k, d)
        ends = (self.control(k, c).T, self.control(k, d).T, s[None, :], (after - s)[None, :])
        nothing = np.zeros((self.extremal.statement.readings, c.size))
        common = (*ends, *self.fixed(c.size), nothing)
        st, mesh = self.extremal.statement, self.extremal.mesh
        if self.states is None:
            function = joint_interval(st, 1) if st.coupled else nominal_interval(st, 1, mesh.step)
            return mapped(function, z.T, *common, owner=st)[0].T
        columns = [self.states.at(s).T, self.states.at(after).T, *common]
        positions = st.behind if self.backward else st.ahead
        passed = compiled_step(st, mesh, positions, z, columns)
        if passed is not None:
            return passed
        return mapped(matrices_step(st, positions, mesh.step, mesh.linear_solver), z.T, *columns)[0].T

    def slope(self, k: Expr, c: Array, h: Array, z: Array) -> Array:
        """Slopes by the share at c, as their limit from the side of a step h from there."""
        st, nx, s = self.extremal.statement, self.extremal.statement.nx, self.place(k, c)
        duration, parameters = self.fixed(c.size)
        full = np.zeros((c.size, nx + st.ne))
        if self.states is not None:
            full[:, :nx] = self.states.at(s)
        full[:, self.rows] = z
        time = duration * self.place(k, c + one_sided(0.0) * h)
        if st.nominal is not None and self.states is None:
            rates = mapped(st.nominal, full[:, :nx].T, self.control(k, c).T, time, duration, parameters, owner=st)[0].T
        else:
            arguments = (full[:, :nx].T, self.control(k, c).T, full[:, nx:].T, time, duration, parameters)
            rates = np.vstack(mapped(st.rates, *arguments, owner=st)[:2]).T
        length = np.diff(self.extremal.mesh.nodes)[k] * self.extremal.trajectory.duration
        return np.asarray((-length if self.backward else length)[:, None] * rates[:, self.rows])

    def saw(self, values: Array) -> None:
        """Values on the way, (m, rows): the nodes alone may not show how far an entry moves."""
        if values.size:
            self.seen[0] = np.minimum(self.seen[0], values.min(axis=0))
            self.seen[1] = np.maximum(self.seen[1], values.max(axis=0))

    def allowed(self, start: Array, end: Array) -> Array:
        """Largest errors of a step between these values."""
        spread = np.maximum(self.seen[1] - self.seen[0], OF_SIZE * self.size)
        allowed = np.broadcast_to(np.maximum(OF_RANGE * spread, ROUNDOFF * self.size), start.shape)
        known = self.pairs[0] >= 0
        if known.any():
            near = np.maximum(np.abs(start), np.abs(end))
            variances = near[:, self.pairs[0][known]] * near[:, self.pairs[1][known]]
            allowed = allowed.copy()
            # What a variance once was says nothing of the roundoff when it is less by many orders of magnitude.
            least = ROUNDOFF**2 * self.size[known]
            allowed[:, known] = np.clip(OF_DEVIATIONS * np.sqrt(variances), least, allowed[:, known])
        return np.asarray(allowed)


def _variances(statement: Statement, rows: list[int]) -> Any:
    """Positions among the rows of both variances of an entry of a covariance, -1 of anything else; (2, rows)."""
    result = np.full((2, len(rows)), -1, dtype=np.intp)
    where = {row: i for i, row in enumerate(rows)}
    for block in statement.matrices:
        definite = block.covariance or block.backward  # a covariance, or the weight S of a closed loop, of its size
        if definite and statement.nx + block.span.start in where:
            lower, columns = half_indices(block.size)
            entries = np.arange(block.span.start, block.span.stop) + statement.nx
            diagonal = entries[lower == columns]
            at = [where[entry] for entry in entries]
            result[0, at] = [where[diagonal[i]] for i in lower]
            result[1, at] = [where[diagonal[j]] for j in columns]
    return result


def mapped(function: ca.Function, *columns: Array, owner: Owner | None = None) -> list[Array]:
    """A function of columns, for many of them; evaluated in chunks, so that no graph grows with their number.

    Args:
        function: of columns, to columns.
        columns: of its arguments, (entries, count) each.
        owner: as of `in_columns`, of a function that is asked for often: the compiled library takes it where it can.

    Returns:
        Its outputs, (entries, count) each.
    """
    found = None if owner is None else numbers_in_columns(owner, function, columns)
    if found is not None:
        return found
    count, begin, parts = columns[0].shape[1], 0, []
    while begin < count:
        chunk = next((size for size in CHUNKS if size >= count - begin), CHUNKS[-1])
        taken = np.minimum(np.arange(begin, begin + chunk), count - 1)
        parts.append(_for_columns(function, chunk).evaluated(*(column[:, taken] for column in columns)))
        begin += chunk
    return [np.hstack(values)[:, :count] for values in zip(*parts, strict=True)]


@lru_cache(maxsize=MAPS)
def _for_columns(function: ca.Function, count: int) -> Matrices:
    """A function of so many columns, for numbers; steps of one interval after the other ask for the same ones."""
    return Matrices(function.map(count))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pieces:
    """Pieces of some intervals k, from the shares c to d: values at the ends, slopes by the share there."""

    k: Any
    c: Array
    d: Array
    low: Array
    high: Array
    first: Array
    last: Array

    __repr__ = short_repr

    def chosen(self, which: Expr) -> _Pieces:
        """Some of them."""
        return _Pieces(**{name: value[which] for name, value in vars(self).items()})

    @staticmethod
    def joined(parts: list[_Pieces]) -> _Pieces:
        """All of them, in the order of travel."""
        names = vars(parts[0])
        whole = _Pieces(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
        return whole.chosen(np.lexsort((whole.c, whole.k)))


def _read(steps: _Steps, k: Expr) -> _Pieces:
    """The intervals without length: from the values before what is read to those after it."""
    still, zero = np.zeros((k.size, len(steps.rows))), np.zeros(k.size)
    return _Pieces(k=k, c=zero, d=zero + 1.0, low=steps.start[k], high=steps.goal[k], first=still, last=still)


def _varying(values: Array, pairs: Any) -> Any:
    """Entries of covariances that differ from node to node by more than roundoff, (rows,).

    A filter that begins with a large variance and an accurate sensor has rates beside which any change seems none.
    """
    largest = np.abs(values).max(axis=0)
    deviations = np.sqrt(largest[pairs[0]]) * np.sqrt(largest[pairs[1]])
    return (pairs[0] >= 0) & (np.ptp(values, axis=0) > OF_SIZE * largest) & (largest > ROUNDOFF * deviations)


def _march(steps: _Steps) -> Dense:
    """All intervals from their start to their end by steps of their own lengths; one that is lost is left cubic."""
    n = steps.extremal.mesh.intervals
    c, h, z = np.zeros(n), np.ones(n), steps.start.copy()
    slope = steps.slope(np.arange(n), c, h, z)
    read = np.array(steps.extremal.mesh.instants, dtype=np.intp)
    found = [_read(steps, read)] if read.size else []
    c[read] = 1.0
    active = np.flatnonzero(c < 1.0)
    for _ in range(MOST_ROUNDS):
        k, at = active, c[active]
        to = np.where(h[k] >= 1.0 - at, 1.0, at + h[k])
        tried, error, after = _step(steps, k, (at, to), z[k], slope[k])
        last_try = to - at <= np.maximum(SMALLEST * at, FIRST)
        lost, good = last_try & np.isinf(error), (error <= 1.0) | (last_try & np.isfinite(error))
        h[k] = (to - at) * np.clip(SAFETY * np.maximum(error, TINY) ** -0.25, SHRINK, GROW)
        kept = k[good]
        found.append(tried.chosen(good))
        steps.saw(tried.high[good])
        c[kept], z[kept], slope[kept] = to[good], tried.high[good], after[good]
        active = active[(c[active] < 1.0) & ~lost]
        if not active.size:
            break
        if not steps.smooth:  # a rate may jump there, so that the next step has another slope at its start
            slope[kept] = steps.slope(kept, c[kept], h[kept], z[kept]) if kept.size else slope[kept]
    short = np.flatnonzero(c < 1.0)
    if short.size:
        rest = (short, c[short], np.ones(short.size), z[short], steps.goal[short])
        chords = (rest[4] - rest[3]) / (1.0 - rest[1])[:, None]
        found.append(_Pieces(k=rest[0], c=rest[1], d=rest[2], low=rest[3], high=rest[4], first=chords, last=chords))
    return _table(steps, _Pieces.joined(found))


def _step(
    steps: _Steps, k: Expr, part: tuple[Array, Array], start: Array, slope: Array
) -> tuple[_Pieces, Array, Array]:
    """A step as two halves: the piece, its error in units of what is allowed (inf: not finite), the slope at its end.

    The piece has the slopes of the model at its ends. Where something fast has died away these are large for the least
    error of the values, so that the parabola through the ends and the middle may be closer: then it has those of it.
    """
    at, to = part
    middle, width = 0.5 * (at + to), (to - at)[:, None]
    end, half = steps.advance(k, at, to, start), steps.advance(k, at, middle, start)
    finer = steps.advance(k, middle, to, half)
    after = steps.slope(k, to, at - to, finer)
    allowed = steps.allowed(start, finer)

    def worst(*differences: Array) -> Array:
        errors = np.max(np.abs(differences), axis=0) / allowed[: differences[0].shape[0]]
        return np.asarray(np.where(np.isfinite(errors), errors, np.inf).max(axis=1))

    stepped = worst(end - finer)
    curved = worst(hermite(start, finer, width * slope, width * after, 0.5) - half)
    first, last = slope.copy(), after.copy()
    look = np.flatnonzero((stepped <= 1.0) & (curved > 1.0))
    if look.size:
        ends = start[look], half[look], finer[look]
        quarters = 0.5 * (at + middle)[look], 0.5 * (middle + to)[look]
        seen = steps.advance(k[look], at[look], quarters[0], ends[0])
        later = steps.advance(k[look], middle[look], quarters[1], ends[1])
        allowed = allowed[look]
        parabola = worst(
            (3 * ends[0] + 6 * ends[1] - ends[2]) / 8 - seen, (-ends[0] + 6 * ends[1] + 3 * ends[2]) / 8 - later
        )
        better = parabola < curved[look]
        curved[look] = np.minimum(parabola, curved[look])
        chosen = look[better]
        first[chosen] = ((4 * ends[1] - 3 * ends[0] - ends[2]) / width[look])[better]
        last[chosen] = ((ends[0] - 4 * ends[1] + 3 * ends[2]) / width[look])[better]
    piece = _Pieces(k=k, c=at, d=to, low=start, high=finer, first=first, last=last)
    return piece, np.maximum(stepped, curved), after


def _table(steps: _Steps, pieces: _Pieces) -> Dense:
    """The polynomials of the pieces, with the values of the transcription at the nodes."""
    n, nodes = steps.extremal.mesh.intervals, steps.extremal.mesh.nodes
    k, arrived = pieces.k, pieces.d == 1.0
    missed = pieces.high[arrived] - steps.goal  # the pieces are in the order of the intervals, each has one last piece
    missed = _corrections(steps, pieces, missed)[k]
    low, high = pieces.low - pieces.c[:, None] * missed, pieces.high - pieces.d[:, None] * missed
    high[arrived] = steps.goal
    length = lengths(np.diff(nodes)[k][:, None])
    first, last = (pieces.first - missed) / length, (pieces.last - missed) / length
    places = steps.place(k, pieces.c), steps.place(k, pieces.d)
    if steps.backward:
        places, low, high, first, last = places[::-1], high, low, -last, -first
    order = np.argsort(places[0], kind="stable")
    instant = np.isin(k[order], steps.extremal.mesh.instants)
    kept = np.flatnonzero(instant | (places[1][order] > places[0][order]))  # the others are shorter than roundoff
    begins, order_kept = order[np.append(0, kept[:-1] + 1)], order[kept]
    return Dense(
        knots=np.append(places[0][order_kept], nodes[n]),
        values=np.vstack([low[begins], high[order[-1]]]),
        first=first[order_kept],
        last=last[order_kept],
    )


def _corrections(steps: _Steps, pieces: _Pieces, missed: Array) -> Array:
    """What is spread over each interval, (N, rows): what the transcription missed by, but keeping covariances such."""
    result, st = missed.copy(), steps.extremal.statement
    corrected = pieces.high - pieces.d[:, None] * missed[pieces.k]
    for block in st.matrices:
        if block.covariance and st.nx + block.span.start in steps.rows:
            where = [steps.rows.index(st.nx + i) for i in range(block.span.start, block.span.stop)]
            good = semidefinite(pieces.high[:, where], block.size) & (pieces.d < 1.0)
            bad = np.zeros(len(result), dtype=bool)
            bad[pieces.k[good & ~semidefinite(corrected[:, where], block.size)]] = True
            result[np.ix_(bad, np.array(where))] = 0.0
    return result
