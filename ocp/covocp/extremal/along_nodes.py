"""Nominal and matrices along nodes that are known, by the compiled library alone: slopes, and their tangents.

Each interval is run from its own node, and the matrices pass along what that gives. Slopes, and the Hessian times a
direction, are those that CasADi gives of the same steps: without an expression of them, which takes longer to make than
to evaluate.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.base.threads import cached
from covocp.passage.columns import (
    FEWEST,
    OnColumns,
    Prepared,
    derivative_in_columns,
    numbers_in_columns,
    numbers_in_turn,
)
from covocp.passage.library import functions
from covocp.passage.sweep import Course
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import gauss_entries
from covocp.transcription.mesh import Mesh
from covocp.transcription.numbers import by_control_values, by_themselves, columns_of_parts
from covocp.transcription.shooting import control_ends
from covocp.transcription.steps import nominal_interval
from covocp.transcription.trajectory import Trajectory

# What `Interval` has behind the controls at both ends, of which slopes are taken by T alone.
LATER, DURATION = 5, 2


class Slopes(NamedTuple):
    """Costates at the nodes (N + 1, nx), slopes by control values and by T, costates of half-vectors (N + 1, ne)."""

    x: Array
    u: Array
    duration: float
    kicks: Array


class Way(NamedTuple):
    """A matrix on its way: its entries among all half-vectors, the function of its steps' entries, its passage."""

    own: slice
    function: ca.Function
    course: Course


@dataclass(frozen=True, kw_only=True, eq=False)
class AlongNodes:
    """All intervals run from their nodes, and the matrices along them.

    Attributes:
        statement, mesh: what is run.
        steps: states at both ends of each substep and what `Interval` has, a column each.
        ways: the matrices.
    """

    statement: Statement
    mesh: Mesh
    steps: list[Array]
    ways: tuple[Way, ...]

    __repr__ = short_repr

    @property
    def twice(self) -> bool:
        """Whether the library has second derivatives of all steps."""
        st = self.statement
        entries = all(_have(st, way.function, ("forward",), ("reverse", "forward")) for way in self.ways)
        return entries and _have(st, nominal_interval(st, 1, self.mesh.step), ("reverse", "forward"))

    def at(self, j: int) -> list[Array]:
        """States before substep j of all intervals, and what `Interval` has of it."""
        before, _, *columns = (np.asfortranarray(values[:, j :: self.mesh.substeps]) for values in self.steps)
        return [before, *columns]

    @cached
    def transitions(self) -> tuple[Array, Array, Array]:
        """Slopes of the states after each interval by those before it and by the controls at its two ends.

        Of constant controls the last two are shares of the same control. (N, nx, nx), (N, nx, nu), (N, nx, nu).
        """
        st, n, ahead = self.statement, self.mesh.intervals, Ahead(self)
        nx, nu = st.nx, st.nu
        units = np.eye(nx + 2 * nu)
        moved = np.empty((n, nx, units.shape[0]))
        for k, unit in enumerate(units):
            moved[:, :, k] = ahead(*(unit[part, None] for part in np.split(np.arange(unit.size), (nx, nx + nu)))).T
        return moved[:, :, :nx], moved[:, :, nx : nx + nu], moved[:, :, nx + nu :]

    def costates(self, weights: Array, last: Array, jumps: Array, restarts: tuple[Array, Array]) -> Slopes:
        """Costates of the states at the nodes and of the half-vectors; slopes of the Lagrangian by controls and T.

        Args:
            weights: of the half-vectors at the nodes, (N + 1, ne).
            last: costate at the end, (nx,).
            jumps: what is added at the nodes, (N + 1, nx).
            restarts: which costates to keep at the ends of the intervals (1 or 0) and what stands in place of the
                others, (nx, N).
        """
        seeds, (keep, known) = Seeds.of(self, weights), restarts
        own = Backward.of(self, seeds).x
        through, n = self.transitions[0].transpose(0, 2, 1), self.mesh.intervals
        result, after = np.empty((n + 1, last.size)), np.empty((n, last.size))
        result[n] = value = last
        for k in range(n - 1, -1, -1):
            after[k] = keep[:, k] * value + known[:, k]
            result[k] = value = through[k] @ after[k] + own[k] + jumps[k]
        found = Backward.of(self, seeds, after)
        by_u = by_control_values(self.mesh, found.begin, found.end)
        return Slopes(result, by_u, found.duration + seeds.duration, seeds.kicks)


def along_nodes(statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: Array) -> AlongNodes | None:
    """Run all intervals from their nodes; remembered.

    Args:
        statement: the problem.
        mesh: of it.
        trajectory: whose nodes they are.
        parameters: of the statement.

    Returns:
        None where the library cannot take the model or its steps, where running costs depend on the matrices, or where
        some of these run backward.
    """
    return _along_nodes(statement, mesh, trajectory, tuple(parameters.tolist()))


@lru_cache(maxsize=2)
def _along_nodes(
    statement: Statement, mesh: Mesh, trajectory: Trajectory, given: tuple[float, ...]
) -> AlongNodes | None:
    st, t, parameters, n, m = statement, trajectory, np.array(given), mesh.intervals, mesh.substeps
    plain = st.nominal is not None and mesh.step != "rodas" and functions() is not None and n * m >= FEWEST
    others = st.running_uses_matrices or st.behind or (st.matrices and not by_themselves(st, mesh))
    if not plain or others:
        return None
    columns, advance = columns_of_parts(mesh, m, t.u.T, t.duration, parameters), nominal_interval(st, 1, mesh.step)
    found = numbers_in_turn(st, advance, t.x[:n].T, columns, m)
    if found is None or not _have(st, advance, ("reverse",), ("forward",)):
        return None
    before = np.empty((n, m, st.nx))
    before[:, 0], before[:, 1:] = t.x[:n], found[0].T.reshape(n, m, -1)[:, :-1]
    steps = [np.asfortranarray(values) for values in (before.reshape(n * m, -1).T, found[0], *columns)]
    ways = [_way(st, mesh, i, t.e[0], steps) for i in st.ahead]
    if any(way is None for way in ways):
        return None
    return AlongNodes(statement=st, mesh=mesh, steps=steps, ways=tuple(way for way in ways if way is not None))


def _way(statement: Statement, mesh: Mesh, position: int, first: Array, steps: list[Array]) -> Way | None:
    """A matrix from its half-vector among all where it starts; None where the library cannot take its entries."""
    (function, pattern), block = gauss_entries(statement, position, mesh.step), statement.matrices[position]
    points = numbers_in_columns(statement, function, steps)
    if points is None or not _have(statement, function, ("reverse",)):
        return None
    course = Course(first[block.span], points, block.size, pattern, mesh.substeps)
    return Way(block.span, function, course)


def _have(statement: Statement, function: ca.Function, *all_kinds: tuple[str, ...]) -> bool:
    """Whether the library has derivatives of these kinds of a function."""
    return all(derivative_in_columns(statement, function, *kinds) is not None for kinds in all_kinds)


def derived(statement: Statement, function: ca.Function, *kinds: str) -> OnColumns:
    """A derivative that the library has."""
    found = derivative_in_columns(statement, function, *kinds)
    assert found is not None
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class Seeds:
    """Slopes of weighed half-vectors by the steps: what the way back over the nominal begins with.

    Attributes:
        before, after: by the states at both ends of each substep, (nx, N substeps).
        begin, end: by the controls there.
        duration: by T.
        kicks: costates of the half-vectors, (N + 1, ne).
        entries: of each matrix, its weights, and slopes by its entries at both points.
    """

    before: Array
    after: Array
    begin: Array
    end: Array
    duration: float
    kicks: Array
    entries: list[tuple[Array, list[Array]]]

    __repr__ = short_repr

    @staticmethod
    def of(along: AlongNodes, weights: Array) -> Seeds:
        """Of weights of the half-vectors at the nodes, (N + 1, ne)."""
        st, kicks, steps = along.statement, weights.copy(), along.steps
        total, duration, entries = [np.zeros_like(values) for values in steps[:4]], 0.0, []
        for way in along.ways:
            given = weights[:, way.own]
            seeds = np.asfortranarray(given[1:].T)
            start, points, passing = way.course.slopes(seeds)
            entries.append((seeds, points))
            kicks[:, way.own] = np.vstack([given[0] + start, passing.T])
            nothing = [np.zeros(0)] * 2
            by = derived(st, way.function, "reverse").of_numbers([*steps, *nothing, *points], steps[0].shape[1])
            for result, slopes in zip(total, by, strict=False):
                result += slopes
            duration += float(by[4 + DURATION].sum())
        before, after, begin, end = total
        return Seeds(before=before, after=after, begin=begin, end=end, duration=duration, kicks=kicks, entries=entries)


@dataclass(frozen=True, kw_only=True, eq=False)
class Backward:
    """The way back over the nominal, interval by interval.

    Attributes:
        x: slopes by the states at the starts of the intervals, (N, nx).
        begin, end: by the controls at both ends of each substep, (nu, N substeps), those of the seeds among them.
        duration: by T.
        seeds: slopes by the states after the first, second, ... substep of all intervals, (nx, N) each.
    """

    x: Array
    begin: Array
    end: Array
    duration: float
    seeds: list[Array]

    __repr__ = short_repr

    @staticmethod
    def of(along: AlongNodes, given: Seeds, costates: Array | None = None) -> Backward:
        """Of the running cost, what the seeds say, and the states after the intervals times costates (N, nx)."""
        st, mesh = along.statement, along.mesh
        n, m = mesh.intervals, mesh.substeps
        reverse = derived(st, nominal_interval(st, 1, mesh.step), "reverse")
        carried = np.zeros((st.nx, n)) if costates is None else costates.T
        begin, end, duration, seeds = given.begin.copy(), given.end.copy(), 0.0, []
        rest = [np.zeros(0)] * 3, [np.zeros((st.nx, n)), np.ones((1, n))]
        for j in range(m - 1, -1, -1):
            seeds.append(np.asfortranarray(given.after[:, j::m] + carried))
            by = reverse.of_numbers([*along.at(j), *rest[0], seeds[-1], *rest[1]], n)
            carried = by[0] + given.before[:, j::m]
            begin[:, j::m] += by[1]
            end[:, j::m] += by[2]
            duration += float(by[3 + DURATION].sum())
        return Backward(x=carried.T, begin=begin, end=end, duration=duration, seeds=seeds[::-1])


class Ahead:
    """Tangents of the states after all intervals, each from its own node.

    Attributes:
        steps: tangents before the first, second, ... substep of all intervals, of the controls at both ends of it, and
            after it, a column for each interval.
    """

    def __init__(self, along: AlongNodes) -> None:
        """Prepare them."""
        st, mesh = along.statement, along.mesh
        self._count, n = mesh.substeps, mesh.intervals
        forward = derived(st, nominal_interval(st, 1, mesh.step), "forward")
        self.steps: list[tuple[Array, Array, Array, Array]] = []
        self._runs = []
        moved = np.zeros((st.nx, n), order="F")
        for j in range(mesh.substeps):
            controls = [np.zeros((st.nu, n), order="F") for _ in range(2)]
            given = [*along.at(j), *([None] * 3), moved, *controls, *([None] * LATER)]
            self._runs.append(Prepared(forward, given, n))
            self.steps.append((moved, controls[0], controls[1], self._runs[-1].found[0]))
            moved = self._runs[-1].found[0]

    def __call__(self, x: Array, first: Array, last: Array) -> Array:
        """Along tangents of the states before the intervals (nx, N) and of the controls at both ends; (nx, N)."""
        self.steps[0][0][:] = x
        for j, (_, begin, end, _) in enumerate(self.steps):
            begin[:] = first + j / self._count * (last - first)
            end[:] = first + (j + 1) / self._count * (last - first)
            self._runs[j].run()
        return self.steps[-1][3]


class Hessian:
    """The Hessian of running cost, weighed half-vectors and continuity, by nodes and controls, times directions."""

    def __init__(self, along: AlongNodes, weights: Array, costates: Array) -> None:
        """Prepare it.

        Args:
            along: whose steps they are.
            weights: of the half-vectors at the nodes, (N + 1, ne).
            costates: of the states after the intervals, (N, nx).
        """
        st, mesh, self._mesh = along.statement, along.mesh, along.mesh
        n = mesh.intervals
        given = Seeds.of(along, weights)
        seeds = Backward.of(along, given, costates).seeds
        back = derived(st, nominal_interval(st, 1, mesh.step), "reverse", "forward")
        self._moved = [np.zeros_like(values, order="F") for values in along.steps[:4]]
        self._ahead, self._nominal = Ahead(along), []
        still, unread = [None] * LATER, [None] * 3
        cost = np.ones((1, n))
        for j, (moved, begin, end, _) in enumerate(self._ahead.steps):
            seed = np.zeros((st.nx, n), order="F")
            adjoint = [*along.at(j), *unread, seeds[j], None, cost, *([None] * (3 + LATER))]
            behind = Prepared(back, [*adjoint, moved, begin, end, *still, *unread, seed, None, None], n)
            self._nominal.append((seed, behind))
        self._ways = [_Moved(along, way, self._moved, *own) for way, own in zip(along.ways, given.entries, strict=True)]

    def __call__(self, x: Array, u: Array) -> tuple[Array, Array]:
        """The product with a direction of the states at the nodes (N + 1, nx) and of the control values, likewise."""
        n, m = self._mesh.intervals, self._mesh.substeps
        self._ahead(x[:n].T, *control_ends(self._mesh, u.T))
        for j, (moved, begin, end, after) in enumerate(self._ahead.steps):
            for whole, part in zip(self._moved, (moved, after, begin, end), strict=True):
                whole[:, j::m] = part
        total = [np.zeros_like(values) for values in self._moved]
        for way in self._ways:
            way.add(total)
        carried: Array | float = 0.0
        for j in range(m - 1, -1, -1):
            seed, behind = self._nominal[j]
            seed[:] = total[1][:, j::m] + carried
            behind.run()
            carried = total[0][:, j::m]
            if behind.found[0].size:
                carried = carried + behind.found[0]
            for whole, part in zip(total[2:], behind.found[1:3], strict=True):
                if part.size:
                    whole[:, j::m] += part
        result = np.zeros_like(x)
        result[:n] = np.asarray(carried).T
        return result, by_control_values(self._mesh, total[2], total[3])


class _Moved:
    """Tangents of the slopes of weighed half-vectors by the steps of one matrix."""

    def __init__(self, along: AlongNodes, way: Way, moved: Sequence[Array], seeds: Array, points: list[Array]) -> None:
        """Prepare them for steps that move by what lies in `moved`: states and controls at both ends of each."""
        st, count = along.statement, along.steps[0].shape[1]
        still, unread = [None] * LATER, [None] * 2
        self._course, self._seeds = way.course, seeds
        ahead, back = derived(st, way.function, "forward"), derived(st, way.function, "reverse", "forward")
        self._ahead = Prepared(ahead, [*along.steps, *unread, *moved, *still], count)
        self._slopes = [np.zeros_like(values, order="F") for values in points]
        adjoint = [*along.steps, *unread, *points, *([None] * (4 + LATER))]
        self._back = Prepared(back, [*adjoint, *moved, *still, *unread, *self._slopes], count)
        self._entries = [np.zeros_like(values, order="F") for values in points]

    def add(self, total: Sequence[Array]) -> None:
        """Add those by the states and controls at both ends of each step."""
        self._ahead.run()
        for entries, found in zip(self._entries, self._ahead.found, strict=True):
            if found.size:
                entries[:] = found
        self._course.tangents(self._seeds, self._entries, self._slopes)
        self._back.run()
        for result, found in zip(total, self._back.found, strict=False):
            if found.size:
                result += found
