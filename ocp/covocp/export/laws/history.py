"""The nominal of a solution as a CasADi expression of the time: tables at the knots of `Solution.at`, with its cubics.

The tables are constants and are read by index, which CasADi writes as a pointer into a constant array: the C code has
each number once and copies one column of a table a call.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ExportError
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.quadrature import hermite
from covocp.base.short_repr import short_repr
from covocp.export.laws.law import LARGEST, status_of
from covocp.solution.solution import Solution

# Times this far outside, relative to the duration, count as inside: sums of steps end there.
MARGINS = {"double": 1e-9, "single": 1e-6}
# Distance of two knots, relative to the duration, that the clock of a machine of this precision resolves.
RESOLVED = {"double": 1e-12, "single": 1e-5}
# By so much of the duration a time may be before a knot and is that knot: what some thousand sums of a step leave.
COUNTED = 0.25 * RESOLVED["double"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Nominal:
    """Values at some time, symbolic: x (nx,), u (nu,), half-vectors e (ne,)."""

    x: Any
    u: Any
    e: Any

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Clock:
    """A time made safe: `time` is within [0, T]; `within` tells whether it was there before.

    conditions: what was wrong with it, with names of statuses.
    """

    time: Any
    within: Any
    conditions: list[tuple[Any, str]]

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class History:
    """Tables of a solution.

    Attributes:
        nodes: times of the nodes [s], (K,).
        knots: times between which the states are cubic [s], (P + 1,); the nodes, and what lies between them where the
            solution is steep.
        z: states and half-vectors at the starts of the pieces, and at the end, (P + 1, nx + ne).
        ends: at their ends, (P, nx + ne), which are others where a measurement is taken.
        first: slopes of z at the starts of the pieces, (P, nx + ne).
        last: slopes at their ends.
        u: controls at the starts of the intervals, and at the end where they are linear, (K, nu) or (K - 1, nu).
        u_ends: at their ends, (K - 1, nu).
        states: nx.
        units: rows of x that are of unit length together: the quaternions of attitudes.
        margin: relative, within which a time counts as inside.
    """

    nodes: Array
    knots: Array
    z: Array
    ends: Array
    first: Array
    last: Array
    u: Array
    u_ends: Array
    states: int
    units: tuple[slice, ...]
    margin: float

    __repr__ = short_repr

    @property
    def duration(self) -> float:
        """The last time [s]."""
        return float(self.nodes[-1])

    def clock(self, time: Expr, fallback: Expr = 0.0) -> Clock:
        """A time made safe; one that is not finite becomes `fallback`."""
        return clock(time, self.duration, self.margin, fallback)

    def interval(self, time: Expr) -> Any:
        """Number of the interval of the mesh that a time before the end is in; an MX expression."""
        return _piece(self.nodes, time)

    def node_after(self, time: Expr) -> Any:
        """The first node after a time before the end, the end where there is none; an MX expression."""
        return ca.MX(ca.DM(self.nodes))[self.interval(time) + 1]

    def at(self, time: Expr) -> Nominal:
        """The nominal at a time within [0, T], an MX expression."""
        k = _piece(self.knots, time)
        knots = ca.MX(ca.DM(self.knots))
        start, end = knots[k], knots[k + 1]
        smooth = _hermite(self.z.shape[1])
        jumps = not np.array_equal(self.z[1:], self.ends)
        za, zb = _column(self.z, k), _column(self.ends, k) if jumps else _column(self.z, k + 1)
        shared = np.array_equal(self.first[1:], self.last[:-1])
        slopes = np.vstack([self.first, self.last[-1:]]) if shared else self.first
        fa, fb = _column(slopes, k), _column(slopes, k + 1) if shared else _column(self.last, k)
        z = smooth(za, zb, fa, fb, start, end, time)
        if not np.array_equal(self.z[-1], self.ends[-1]):
            z = ca.if_else(time >= self.duration, ca.DM(self.z[-1]), z)
        if not np.array_equal(self.knots, self.nodes):
            k = _piece(self.nodes, time)
        u = _control(self, k, time)
        x, e = ca.vertsplit(z, [0, self.states, self.z.shape[1]])
        for own in self.units:  # interpolation keeps their length up to its error
            x[own] = x[own] / ca.norm_2(x[own])
        return Nominal(x=x, u=u, e=e)

    def mean_control(self, begin: Expr, end: Expr) -> Any:
        """The mean of the control between two times within [0, T], (nu,), that at `begin` where no time lies between.

        Exact for controls that are constant or linear in each interval: to the value halfway within the first one comes
        what the control differs from it later, over whole intervals from a table of integrals, about the mean of all.
        """
        first, last = _piece(self.nodes, begin), _piece(self.nodes, ca.fmax(begin, end))
        nodes, lengths = ca.MX(ca.DM(self.nodes)), np.diff(self.nodes)[:, None]
        starts, ends = self.u[: lengths.size], self.u_ends
        parts = lengths / 2 * (starts + ends)
        mean = parts.sum(axis=0, keepdims=True) / lengths.sum()
        integrals = np.vstack([0.0 * mean, np.cumsum(parts - lengths * mean, axis=0)])
        split = last > first
        until = ca.if_else(split, nodes[first + 1], ca.fmax(begin, end))
        halfway = _control(self, first, (begin + until) / 2)
        since = nodes[last]
        rest = _control(self, last, (since + end) / 2)
        between = _column(integrals, last) - _column(integrals, first + 1)
        between += (since - nodes[first + 1]) * (ca.DM(mean.T) - halfway)
        more = (between + (end - since) * (rest - halfway)) / ca.if_else(split, end - begin, 1.0)
        return halfway + ca.if_else(split, more, 0.0)

    def rows(self, t: Array) -> tuple[Array, Array, Array]:
        """x, u, e at some times, a row for each."""
        time = ca.MX.sym("time")
        now = self.at(time)
        values = ca.Function("nominal", [time], [now.x, now.u, now.e]).map(t.size)(t[None, :])
        x, u, e = (np.asarray(v.full()).T for v in values)
        return x, u, e


def clock(time: Expr, duration: float, margin: float, fallback: Expr = 0.0) -> Clock:
    """A time made safe.

    Args:
        time: that is asked for [s], an expression.
        duration: the last time that there is [s].
        margin: share of it by which a time outside counts as inside.
        fallback: in the place of a time that is not finite.
    """
    finite = ca.fabs(time) <= LARGEST
    known = ca.if_else(finite, time, fallback)
    inside = ca.fmin(ca.fmax(known, 0.0), duration)
    slack = margin * duration
    before, after = known < -slack, known > duration + slack
    within = ca.if_else(ca.logic_or(before, after), 0.0, finite)
    conditions = [(ca.logic_not(finite), "TIME_NOT_FINITE"), (before, "TIME_BEFORE"), (after, "TIME_AFTER")]
    return Clock(time=inside, within=within, conditions=conditions)


def history(solution: Solution, precision: str) -> History:
    """The tables of a solution.

    Raises:
        ExportError: where a value is NaN or infinite.
    """
    trajectory, dense = solution.trajectory, solution.dense
    slopes = dense.first / solution.duration, dense.last / solution.duration
    checked = (("a state or a matrix", dense.values), ("a control", trajectory.u), *(("a rate", v) for v in slopes))
    for what, values in checked:
        if not np.isfinite(values).all():
            raise ExportError(
                f"{what.capitalize()} of the solution is NaN or infinite.",
                expected="finite values at all nodes",
                received=f"'{solution.name}', {solution.status}",
                remedy="export a solution that converged",
            )
    times, least = dense.knots * solution.duration, RESOLVED[precision] * solution.duration
    long = np.diff(times) > 0  # where something is read the values jump, in pieces of no length
    pieces = (dense.values[:-1][long], dense.values[1:][long], slopes[0][long], slopes[1][long])
    knots, z, ends, first, last = _resolved(np.append(times[:-1][long], times[-1]), pieces, least)
    u, intervals = trajectory.u, np.diff(solution.t) > 0
    linear = u.shape[0] == solution.t.size
    u_starts = (u[:-1] if linear else u)[intervals]
    return History(
        nodes=np.append(solution.t[:-1][intervals], solution.t[-1]),
        knots=knots,
        z=np.vstack([z, dense.values[-1:]]),
        ends=ends,
        first=first,
        last=last,
        u=np.vstack([u_starts, u[-1:]]) if linear else u_starts,
        u_ends=u[1:][intervals] if linear else u_starts,
        states=trajectory.x.shape[1],
        units=tuple(block.span for block in solution.blocks if block.tangent),
        margin=MARGINS[precision],
    )


def _piece(table: Array, time: Expr) -> Any:
    """Index of the piece between two entries of a table of times that contains a time, from 0.

    A time that counting up has left just before an entry is that entry, as for the solution.
    """
    pieces, duration = table.size - 1, float(table[-1])
    time = time + COUNTED * duration
    guess = np.floor(table * (pieces / duration) + 0.5)
    times = ca.MX(ca.DM(table))
    if not np.array_equal(guess, np.arange(pieces + 1)):
        return ca.low(times, time, {"lookup_mode": "binary"})
    # equal pieces: computed, and corrected by one where rounding or a graded grid moves an end
    k = ca.fmin(ca.fmax(ca.floor(time * (pieces / duration)), 0.0), pieces - 1.0)
    k = k + (time >= times[k + 1]) - (time < times[k])
    return ca.fmin(ca.fmax(k, 0.0), pieces - 1.0)


def time_status(clock: Clock) -> Any:
    """The status of a time."""
    return status_of(clock.conditions)


def _resolved(knots: Array, pieces: tuple[Array, ...], least: float) -> tuple[Array, ...]:
    """The polynomials without the knots that a clock of this precision cannot tell apart.

    Where some fall away the piece becomes a chord: the slope of a fall that is over at once would carry it far below.

    Args:
        knots: times, (P + 1,).
        pieces: values at the starts and at the ends of the pieces, slopes there.
        least: distance of two knots [s].

    Returns:
        Knots, and the same of the pieces between them.
    """
    starts, ends, first, last = pieces
    kept = [0]
    for i in range(1, knots.size - 1):
        if knots[i] - knots[kept[-1]] >= least and knots[-1] - knots[i] >= least:
            kept.append(i)
    chosen = np.array([*kept, knots.size - 1])
    starts, ends = starts[chosen[:-1]], ends[chosen[1:] - 1]
    first, last = first[chosen[:-1]].copy(), last[chosen[1:] - 1].copy()
    merged = np.diff(chosen) > 1
    chords = (ends - starts) / np.diff(knots[chosen])[:, None]
    first[merged] = last[merged] = chords[merged]
    return knots[chosen], starts, ends, first, last


def _control(tables: History, k: Expr, time: Expr) -> Any:
    """The control at a time in interval k of the mesh."""
    u = _column(tables.u, k)
    if tables.u.shape[0] != tables.nodes.size:
        return u
    jumps = not np.array_equal(tables.u[1:], tables.u_ends)
    after = _column(tables.u_ends, k) if jumps else _column(tables.u, k + 1)
    nodes = ca.MX(ca.DM(tables.nodes))
    return _linear(tables.u.shape[1])(u, after, nodes[k], nodes[k + 1], time)


def _column(table: Array, k: Expr) -> Any:
    """A row of a table as a column; without entries where it has none."""
    return ca.MX(ca.DM(table.T))[:, k] if table.shape[1] else ca.MX(0, 1)


def _hermite(size: int) -> ca.Function:
    """(za, zb, slopes there, times of both ends, time) -> z."""
    za, zb, fa, fb = (ca.SX.sym(name, size) for name in ("za", "zb", "fa", "fb"))
    start, end, time = ca.SX.sym("start"), ca.SX.sym("end"), ca.SX.sym("time")
    h = end - start
    z = hermite(za, zb, h * fa, h * fb, (time - start) / h)
    return ca.Function("smooth", [za, zb, fa, fb, start, end, time], [ca.densify(z)])


def _linear(size: int) -> ca.Function:
    """(ua, ub, times of both ends, time) -> u."""
    ua, ub = ca.SX.sym("ua", size), ca.SX.sym("ub", size)
    start, end, time = ca.SX.sym("start"), ca.SX.sym("end"), ca.SX.sym("time")
    c = (time - start) / (end - start)
    return ca.Function("straight", [ua, ub, start, end, time], [ca.densify(ua + c * (ub - ua))])
