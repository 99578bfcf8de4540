"""The joint covariance of the error of the estimate and of the estimate, along a course with the gains of a design.

It passes by Gauss steps of equal parts of the intervals. Where a large covariance is measured well, the filter is
faster than any of them by orders of magnitude: there, as long as the covariance falls, the gain is that of a covariance
which is stepped with it, by parts that begin with its own time scale and grow with it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices, swept
from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.gains import kalman_gain
from covocp.base.linear_solve import LINEAR_SOLVER
from covocp.base.matrices import Array, pack, stacked, unpack, unpack_symbolic
from covocp.base.quadrature import GAUSS_NODES, gauss_matrix, hermite, lyapunov_after
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal
from covocp.extremal.readings import Readings, readings_along
from covocp.passage.columns import numbers_in_columns
from covocp.passage.library import functions
from covocp.passage.shape import Pattern
from covocp.passage.sweep import from_one
from covocp.statement.interval import Interval, one_sided, repeated
from covocp.statement.statement import Loop, Statement
from covocp.transcription.covariance_steps import KEPT, entries_of_points, moving_step
from covocp.transcription.numbers import columns_of_parts

# Time constants of the filter within an interval from which on it is too fast for equal parts, where it then slows down
# by the second factor: what it does at the start is over before the first part ends.
FAST, SLOWED = 50.0, 4.0
# The first part of such an interval in its time constants, and how much longer each following one is.
FIRST_PART, PART_RATIO = 0.2, 1.25


@dataclass(frozen=True, kw_only=True, eq=False)
class Statistics:
    """What is truly uncertain: covariance of the initial deviation, densities of process and measurement noise.

    initial: (n, n); density: (state, control, time, duration, parameters) -> Q (n, n), U (m, m); parameters: its own.
    variance: (state, control, time, duration, parameters) -> R of what is read at instants; None where nothing is.
    """

    initial: Array
    density: ca.Function
    parameters: Array
    variance: ca.Function | None = None

    __repr__ = short_repr


def joint_covariances(extremal: Extremal, fine: Array, statistics: Statistics, start: Array | None) -> Array:
    """[E Z; Z' Xhat] at the ends of all parts, with the gains of x, E and S there.

    Args:
        extremal: of a statement with a loop.
        fine: x and the half-vectors at the starts of equal parts of all intervals and at the ends, (N, m + 1, size).
        statistics: the true ones.
        start: at the start, (2n, 2n); None: nothing is estimated yet.

    Returns:
        (N m + 1, 2n, 2n).
    """
    st, n, m = extremal.statement, extremal.mesh.intervals, fine.shape[1] - 1
    size = len(st.augmented)
    course = _Course(extremal=extremal, fine=fine, statistics=statistics)
    values = np.zeros((n * m + 1, 2 * size, 2 * size))
    values[0, :size, :size] = statistics.initial
    if start is not None:
        values[0] = start
    begin = 0
    for k, constants in [*_fast_intervals(extremal), (n, 0.0)]:
        if k > begin:
            values[begin * m + 1 : k * m + 1] = course.by_equal_parts(begin, k, values[begin * m])
        if k < n:
            values[k * m + 1 : (k + 1) * m + 1] = course.by_growing_parts(k, constants, values[k * m])
        begin = k + 1
    return values


def _fast_intervals(extremal: Extremal) -> list[tuple[int, float]]:
    """Intervals within which the filter is far faster at the start than at the end, and its time constants in each."""
    st = extremal.statement
    if st.measurement is None or st.coupled or st.riccati[st.matrices.index(st.estimation)] is None:
        return []
    falling, h = _gains_inside(extremal), np.diff(extremal.time)
    looked = np.flatnonzero(h * np.trace(falling[0], axis1=1, axis2=2) > FAST)
    first, last = (h[looked] * np.abs(np.linalg.eigvals(own[looked])).max(axis=1, initial=0.0) for own in falling)
    fast = (first > FAST) & (first > SLOWED * last)
    return list(zip(looked[fast].tolist(), first[fast].tolist(), strict=True))


def _gains_inside(extremal: Extremal) -> tuple[Array, Array]:
    """K M of the filter where the intervals start and where they end, each as its limit from inside: (N, n, n)."""
    st, n = extremal.statement, extremal.mesh.intervals
    t, k = extremal.trajectory, np.arange(n)
    found = []
    for c in (0.0, 1.0):
        node, places = k + int(c), np.full(n, one_sided(c))
        time = extremal.time[:-1] + places * np.diff(extremal.time)
        fixed = repeated(t.duration, extremal.parameters, n)
        assert st.measurement is not None
        rows = st.measurement.map(n)(t.x[node].T, extremal.control(k, places).T, time[None], *fixed)
        _, M, U = (stacked(v, n) for v in rows)
        found.append(kalman_gain(unpack(t.e[node][:, st.estimation.span], len(st.augmented)), M, U) @ M)
    return found[0], found[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Course:
    """Along what the joint covariance passes; see `joint_covariances`."""

    extremal: Extremal
    fine: Array
    statistics: Statistics

    __repr__ = short_repr

    def by_equal_parts(self, begin: int, end: int, first: Array) -> Array:
        """At the ends of all parts of the intervals from `begin` to `end`."""
        m, t = self.fine.shape[1] - 1, self.extremal.trajectory
        chosen, size = slice(begin * m, end * m), first.shape[0]
        common = columns_of_parts(self.extremal.mesh, m, t.u.T, t.duration, self.extremal.parameters)
        course = self.fine[begin:end]
        before, after = (part.reshape((end - begin) * m, -1).T for part in (course[:, :-1], course[:, 1:]))
        columns = (before, after, *(column[:, chosen] for column in common))
        jumps = {
            entry.interval: _jump(self.extremal, entry, self.statistics)
            for entry in readings_along(self.extremal)
            if begin <= entry.interval < end
        }
        if functions() is not None and not jumps:
            return unpack(self._passed(pack(first), columns, size).T, size)
        values = [first]
        for k, D in enumerate(_transitions(self._points(columns), size), begin * m):
            value = lyapunov_after(D, values[-1])
            if k % m == m - 1 and k // m in jumps:
                transition, noise = jumps[k // m]
                value = transition @ value @ transition.T + noise
            values.append(value)
        return np.array(values[1:])

    def by_growing_parts(self, k: int, constants: float, first: Array) -> Array:
        """At the ends of all parts of interval k, by parts of it that begin with the time constant of the filter."""
        st, mesh, m = self.extremal.statement, self.extremal.mesh, self.fine.shape[1] - 1
        shortest = FIRST_PART / constants
        growing = shortest * PART_RATIO ** np.arange(np.ceil(-np.log(shortest) / np.log(PART_RATIO)))
        ends = np.arange(m + 1) / m
        c = np.unique(np.concatenate([ends, growing[growing < 1.0]]))
        common = _parts(self.extremal, k, c)
        z = self._between(k, c)
        own = st.nx + np.arange(st.estimation.span.start, st.estimation.span.stop)
        position = st.matrices.index(st.estimation)
        step = moving_step(st, (position,), "gauss" if mesh.step == "rk4" else mesh.step)
        x = z[:, : st.nx].T
        z[1:, own] = swept(step, z[0, own], x[:, :-1], x[:, 1:], *common)[0]
        values = [first]
        for D in _transitions(self._points((z[:-1].T, z[1:].T, *common)), first.shape[0]):
            values.append(lyapunov_after(D, values[-1]))
        return np.array([values[i] for i in np.searchsorted(c, ends[1:])])

    def _points(self, columns: tuple[Array, ...]) -> list[Any]:
        """h H at both Gauss points of parts whose columns these are."""
        function = _joint_points(self.extremal.statement, self.statistics.density)
        points: list[Any] = function.map(columns[0].shape[1]).call([*columns, self._true(columns)])
        return points

    def _true(self, columns: tuple[Array, ...]) -> Array:
        """Parameters of the truth, a column each."""
        return np.tile(self.statistics.parameters[:, None], (1, columns[0].shape[1]))

    def _passed(self, first: Array, columns: tuple[Array, ...], size: int) -> Array:
        """Half-vectors after each of some parts, a column each, by the compiled passage."""
        st = self.extremal.statement
        function, pattern = _joint_entries(st, self.statistics.density)
        given = (*columns, self._true(columns))
        points = numbers_in_columns(st, function, given)
        if points is None:
            points = Matrices(function.map(given[0].shape[1])).evaluated(*given)
        return from_one(first, points, size, pattern, 1)

    def _between(self, k: int, c: Array) -> Array:
        """x and the half-vectors at shares of interval k: x cubic, the others linear between its equal parts."""
        st, course, m = self.extremal.statement, self.fine[k], self.fine.shape[1] - 1
        ends = np.arange(m + 1) / m
        common = Interval(*_parts(self.extremal, k, np.append(ends, 1.0)))
        assert st.nominal is not None
        place = common.duration * common.s
        rates = st.nominal.map(m + 1)(course[:, : st.nx].T, common.start, place, common.duration, common.parameters)[0]
        h = self.extremal.trajectory.duration * np.diff(self.extremal.mesh.nodes)[k] / m
        slopes = h * np.asarray(rates.full()).T
        j = np.clip((c * m).astype(np.intp), 0, m - 1)
        share = (c * m - j)[:, None]
        z = course[j] + share * (course[j + 1] - course[j])
        x = course[:, : st.nx]
        z[:, : st.nx] = hermite(x[j], x[j + 1], slopes[j], slopes[j + 1], share)
        return np.asarray(z)


def _parts(extremal: Extremal, k: int, c: Array) -> tuple[Array, ...]:
    """The columns of `Interval` of the parts of interval k between shares of it."""
    st, nodes = extremal.statement, extremal.mesh.nodes
    count, ds = c.size - 1, nodes[k + 1] - nodes[k]
    u = extremal.control(np.full(c.size, k), c).T
    fixed = repeated(extremal.trajectory.duration, extremal.parameters, count)
    places = ((nodes[k] + ds * c[:-1])[None], ds * np.diff(c)[None])
    return (u[:, :-1], u[:, 1:], *places, *fixed, np.zeros((st.readings, count)))


def _transitions(points: list[Any], size: int) -> Array:
    """Step matrices of a covariance of some rows."""
    count = points[0].shape[1] // (2 * size)
    return stacked(_joint_step(size).map(count)(*(ca.densify(point) for point in points)), count)


def _jump(extremal: Extremal, readings: Readings, statistics: Statistics) -> tuple[Array, Array]:
    """Transition and noise of [E Z; Z' Xhat] where something is read, under the true variance of it."""
    variance = readings.R
    if statistics.variance is not None:
        k = readings.interval
        x, u, _, *rest = (np.asarray(column)[:, k] for column in extremal.columns())
        own = statistics.variance(x, u, *rest[:2], statistics.parameters)
        variance = np.asarray(own.full())[np.ix_(readings.rows, readings.rows)]
    return readings.jump(variance)


def loop_of(statement: Statement) -> Loop:
    """The loop of a statement that has one."""
    if statement.loop is None:
        raise ValueError("a problem without an expected cost has no loop")
    return statement.loop


@lru_cache(maxsize=KEPT)
def _joint_step(size: int) -> ca.Function:
    """(h H at both points) -> step matrix of a covariance of so many rows."""
    points = [ca.MX.sym(name, 2 * size, 2 * size) for name in ("first", "second")]
    return ca.Function("joint_step", points, [gauss_matrix(points, size, LINEAR_SOLVER)])


@lru_cache(maxsize=KEPT)
def _joint_points(statement: Statement, density: ca.Function) -> ca.Function:
    """(z at both ends of a substep, *common, parameters of the truth) -> h H of [E Z; Z' Xhat] at both Gauss points.

    x, E, S of the design between the ends by cubic Hermite polynomials.
    """
    symbolic: Any = statement.symbolic
    nx, size = statement.nx, len(statement.augmented)
    za, zb = (symbolic.sym(name, nx + statement.ne) for name in ("za", "zb"))
    common, q = Interval.symbols(statement), symbolic.sym("q", density.size1_in(4))
    duration, p, h = common.duration, common.parameters, common.h
    fa, fb = (ca.vertcat(*statement.rates(*common.at(c, z[:nx], z[nx:]))[:2]) for c, z in ((0.0, za), (1.0, zb)))
    loop = loop_of(statement)
    points = []
    for c in GAUSS_NODES:
        z, u, t = hermite(za, zb, h * fa, h * fb, c), common.control(c), common.time(c)
        F, G = loop.slopes(z[:nx], u, t, duration, p)[:2]
        C = loop.gain(z[:nx], u, z[nx:], t, duration, p)
        E = unpack_symbolic(z[nx:][statement.estimation.span], size)
        K, M = filter_of(statement, z[:nx], u, E, (t, duration, p))
        noise, measured = density(z[:nx], u, t, duration, q)
        drift = ca.blockcat([[F - K @ M, symbolic(size, size)], [-K @ M, F - G @ C]])
        spread = K @ measured @ K.T
        driven = ca.blockcat([[spread + noise, spread], [spread, spread]])
        points.append(h * ca.blockcat([[-drift.T, symbolic(2 * size, 2 * size)], [driven, drift]]))
    return ca.Function("joint_points", [za, zb, *common, q], points)


@lru_cache(maxsize=KEPT)
def _joint_entries(statement: Statement, density: ca.Function) -> tuple[ca.Function, Pattern]:
    """The same by what may be nonzero; rows and columns of it."""
    return entries_of_points(_joint_points(statement, density))


def filter_of(statement: Statement, x: Expr, u: Expr, E: Expr, rest: tuple[Any, ...]) -> tuple[Any, Any]:
    """Gain K = E M' U^-1 of the design, and M; no rows without measurements."""
    if statement.measurement is None:
        return E[:, :0], E[:0, :]
    _, M, U = statement.measurement(x, u, *rest)
    return kalman_gain(E, M, U), ca.densify(M)
