"""The nominal of a solution as a CasADi expression of the time: tables at the nodes, interpolated as `Solution.at`.

The tables are constants and are read by index, which CasADi writes as a pointer into a constant array: the C code has
each number once and copies one column of a table a call.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from covocp.errors import ExportError, describe
from covocp.export.laws import LARGEST, status_of
from covocp.integrators import hermite
from covocp.matrices import Array, is_semidefinite, unpack
from covocp.solution import Solution

# Times this far outside, relative to the duration, count as inside: sums of steps end there.
MARGINS = {"double": 1e-9, "single": 1e-6}
# Points of an interval at which a covariance is looked at.
LOOKS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Nominal:
    """Values at some time, symbolic: x (nx,), u (nu,), half-vectors e (ne,)."""

    x: Any
    u: Any
    e: Any


@dataclass(frozen=True, kw_only=True, eq=False)
class Clock:
    """A time made safe: `time` is within [0, T]; `within` tells whether it was there before.

    conditions: what was wrong with it, with names of statuses.
    """

    time: Any
    within: Any
    conditions: list[tuple[Any, str]]


@dataclass(frozen=True, kw_only=True, eq=False)
class History:
    """Tables at the nodes of a solution.

    Attributes:
        nodes: times [s], (K,).
        z: states and half-vectors, (K, nx + ne).
        first: slopes of z at the starts of the intervals, (K - 1, nx + ne).
        last: slopes at their ends.
        u: controls, (K, nu) where they are linear, (K - 1, nu) where they are constant.
        states: nx.
        margin: relative, within which a time counts as inside.
    """

    nodes: Array
    z: Array
    first: Array
    last: Array
    u: Array
    states: int
    margin: float

    @property
    def duration(self) -> float:
        """The last time [s]."""
        return float(self.nodes[-1])

    def clock(self, time: Any, fallback: Any = 0.0) -> Clock:
        """A time made safe; one that is not finite becomes `fallback`."""
        finite = ca.fabs(time) <= LARGEST
        known = ca.if_else(finite, time, fallback)
        inside = ca.fmin(ca.fmax(known, 0.0), self.duration)
        slack = self.margin * self.duration
        before, after = known < -slack, known > self.duration + slack
        within = ca.if_else(ca.logic_or(before, after), 0.0, finite)
        conditions = [(ca.logic_not(finite), "TIME_NOT_FINITE"), (before, "TIME_BEFORE"), (after, "TIME_AFTER")]
        return Clock(time=inside, within=within, conditions=conditions)

    def at(self, time: Any) -> Nominal:
        """The nominal at a time within [0, T], an MX expression."""
        k = self._interval(time)
        nodes = ca.MX(ca.DM(self.nodes))
        start, end = nodes[k], nodes[k + 1]
        smooth = _hermite(self.z.shape[1])
        za, zb = _column(self.z, k), _column(self.z, k + 1)
        shared = np.array_equal(self.first[1:], self.last[:-1])
        slopes = np.vstack([self.first, self.last[-1:]]) if shared else self.first
        fa, fb = _column(slopes, k), _column(slopes, k + 1) if shared else _column(self.last, k)
        z = smooth(za, zb, fa, fb, start, end, time)
        u = _column(self.u, k)
        if self.u.shape[0] == self.nodes.size:
            u = _linear(self.u.shape[1])(u, _column(self.u, k + 1), start, end, time)
        x, e = ca.vertsplit(z, [0, self.states, self.z.shape[1]])
        return Nominal(x=x, u=u, e=e)

    def _interval(self, time: Any) -> Any:
        """Index of the interval that contains a time, from 0 to K - 2."""
        intervals = self.nodes.size - 1
        guess = np.floor(self.nodes * (intervals / self.duration) + 0.5)
        if not np.array_equal(guess, np.arange(intervals + 1)):
            return ca.low(ca.MX(ca.DM(self.nodes)), time, {"lookup_mode": "binary"})
        # equal intervals: computed, and corrected by one where rounding or a graded grid moves a node
        k = ca.fmin(ca.fmax(ca.floor(time * (intervals / self.duration)), 0.0), intervals - 1.0)
        nodes = ca.MX(ca.DM(self.nodes))
        k = k + (time >= nodes[k + 1]) - (time < nodes[k])
        return ca.fmin(ca.fmax(k, 0.0), intervals - 1.0)


def history(solution: Solution, precision: str) -> History:
    """The tables of a solution.

    Raises:
        ExportError: where a value is NaN or infinite.
    """
    trajectory = solution.trajectory
    z = np.hstack([trajectory.x, trajectory.e])
    first, last = solution.rates[:-1].copy(), solution.end_rates.copy()
    for what, values in (("a state or a matrix", z), ("a control", trajectory.u), ("a rate", first), ("a rate", last)):
        if not np.isfinite(values).all():
            raise ExportError(
                describe(
                    f"{what.capitalize()} of the solution is NaN or infinite.",
                    expected="finite values at all nodes",
                    received=f"'{solution.name}', {solution.status}",
                    remedy="export a solution that converged",
                )
            )
    nodes = np.asarray(solution.t)
    _straighten(solution, nodes, z, first, last)
    return History(
        nodes=nodes,
        z=z,
        first=first,
        last=last,
        u=trajectory.u,
        states=trajectory.x.shape[1],
        margin=MARGINS[precision],
    )


def time_status(clock: Clock) -> Any:
    """The status of a time."""
    return status_of(clock.conditions)


def _straighten(solution: Solution, nodes: Array, z: Array, first: Array, last: Array) -> None:
    """Make a covariance linear (in place) in the intervals where its cubic is indefinite somewhere."""
    c = np.linspace(0.0, 1.0, LOOKS + 1)[None, 1:-1, None]
    h = np.diff(nodes)[:, None]
    offset = solution.trajectory.x.shape[1]
    for block in solution.blocks:
        if block.kind != "matrix" or not block.covariance:
            continue
        rows = slice(block.span.start + offset, block.span.stop + offset)
        ends = (z[:-1, None, rows], z[1:, None, rows])
        slopes = (h[:, :, None] * first[:, None, rows], h[:, :, None] * last[:, None, rows])
        between = hermite(*ends, *slopes, c)
        for k, values in enumerate(between):
            if not is_semidefinite(unpack(values, block.size)):
                first[k, rows] = last[k, rows] = (z[k + 1, rows] - z[k, rows]) / h[k]


def _column(table: Array, k: Any) -> Any:
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
