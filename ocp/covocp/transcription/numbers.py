"""Trajectories of numbers by the compiled library alone: without a node, or a matrix of CasADi's, for each of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.matrices import Array
from covocp.passage.columns import numbers_in_columns, numbers_in_turn
from covocp.passage.sweep import from_many, from_one
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT, fed, gauss_entries
from covocp.transcription.mesh import Mesh
from covocp.transcription.sequences import NUMERIC_ENTRIES
from covocp.transcription.shooting import compiled_steps, control_ends, parted_intervals
from covocp.transcription.steps import nominal_interval, read_by, simpson_interval


class Segments(NamedTuple):
    """Segments that were run: gaps of the states at their ends (nx, segments), running cost of each interval (N,),
    states and half-vectors at the nodes that are wanted, a column each; those at which a segment starts as given.
    """

    gaps: Array
    costs: Array
    x: Array
    e: Array


def segments_of_numbers(
    statement: Statement, mesh: Mesh, starts: Array, e0: Array, controls: tuple[Array, float, Array], apart: int = 1
) -> Segments | None:
    """What `shoot` gives of numbers where the nominal runs alone and all that is wanted lies at the nodes.

    Args:
        statement: the problem.
        mesh: of it.
        starts: states where the segments start, and at the end, (nx, segments + 1).
        e0: half-vectors at the start, (ne,).
        controls: (nu, control nodes); T [s]; parameters of the statement.
        apart: of the nodes every so many are wanted; a share of the intervals.

    Returns:
        The segments; None where the library cannot take the model, or does not pay.
    """
    if statement.matrices and not (mesh.eliminated and by_themselves(statement, mesh)):
        return None
    n, m, (u, duration, parameters) = mesh.intervals, mesh.substeps, controls
    columns = columns_of_parts(mesh, m, u, duration, parameters)
    found = _nominal(statement, mesh, starts, columns)
    if found is None:
        return None
    after, costs = found
    ends, nodes = after[:, m - 1 :: m], starts
    if len(mesh.segments) < n:
        places = np.arange(n + 1) + len(mesh.segments)  # of the ends of the intervals, behind the starts
        places[list(mesh.starts)] = np.arange(len(mesh.starts))
        nodes = np.hstack([starts, ends])[:, places]
    before = np.empty((n, m, statement.nx))
    before[:, 0], before[:, 1:] = nodes[:, :n].T, after.T.reshape(n, m, -1)[:, :-1]
    steps = [before.reshape(n * m, -1).T, after, *columns]
    every = 1 if statement.running_uses_matrices else m * apart
    e = _matrices(statement, mesh, e0, _last(statement, nodes[:, -1], duration, parameters), steps, every)
    if e is None:
        return None
    if statement.running_uses_matrices:
        along = nodes[:, :n], e[:, :-1:m], after, e[:, 1:], *columns_of_parts(mesh, 1, u, duration, parameters)
        costs = costs + matrix_costs(statement, mesh, along)
    gaps = ends[:, [i - 1 for i in mesh.starts[1:]]] - starts[:, 1:]
    wanted = e if every > 1 or m * apart == 1 else e[:, :: m * apart].copy()
    return Segments(gaps=gaps, costs=costs, x=nodes[:, ::apart].copy(), e=wanted)


def matrix_costs(statement: Statement, mesh: Mesh, columns: tuple[Array, ...]) -> Array:
    """Running cost of each interval where it depends on the matrices, (N,).

    Args:
        statement: the problem.
        mesh: of it.
        columns: states and half-vectors where the intervals start, states and half-vectors after all substeps, and what
            `Interval` has, a column each.
    """
    n, m = mesh.intervals, mesh.substeps
    own = [column.T.reshape(n, -1) if k in (2, 3) else column.T for k, column in enumerate(columns)]
    result, parted = np.zeros(n), parted_intervals(statement, mesh)
    for by_parts in (True, False):
        span = np.flatnonzero(parted == by_parts)
        if not span.size:
            continue
        function, given = simpson_interval(statement, m, by_parts), [values[span].T for values in own]
        found = numbers_in_columns(statement, function, given)
        if found is None:
            found = Matrices(function.map(span.size)).evaluated(*given)
        result[span] = found[0][0]
    return result


def compiled_step(
    statement: Statement, mesh: Mesh, positions: tuple[int, ...], halves: Array, columns: Sequence[Array]
) -> Array | None:
    """Some matrices over one step each, along a nominal that is known at both ends of it: many steps at once.

    Args:
        statement: the problem.
        mesh: whose steps they are.
        positions: of the matrices, all those that run in one direction.
        halves: their half-vectors before each step, (steps, entries).
        columns: states before and after each step and what `Interval` has, of which nothing is read.

    Returns:
        The half-vectors after it; None where the steps are others than compiled ones, or do not pay.
    """
    if not compiled_steps(mesh) or fed(statement, positions) or read_by(statement, positions):
        return None
    result, begin = np.empty_like(halves), 0
    for i in positions:
        block, (function, pattern) = statement.matrices[i], gauss_entries(statement, i, mesh.step)
        points = numbers_in_columns(statement, function, columns)
        if points is None:
            return None
        own, begin = slice(begin, begin + block.length), begin + block.length
        result[:, own] = from_many(halves[:, own], [v.T for v in points], block.size, pattern, 1)[:, 0]
    return result


def columns_of_parts(mesh: Mesh, parts: int, u: Array, duration: float, parameters: Array) -> list[Array]:
    """What `Interval` has, of the parts of all intervals, numbers in a column each; controls: a column each."""
    n, (begin, end) = mesh.intervals * parts, control_ends(mesh, u)
    if parts > 1:
        own, places = (begin, end), [j / parts for j in range(parts + 1)]
        controls = [own[int(c)] if c in (0.0, 1.0) else begin + c * (end - begin) for c in places]
        begin, end = _beside(controls[:-1]), _beside(controls[1:])
    s, ds, reading = _parts_of(mesh, parts)
    return [begin, end, s, ds, np.full((1, n), duration), np.tile(parameters[:, None], (1, n)), reading]


@lru_cache(maxsize=KEPT)
def _parts_of(mesh: Mesh, parts: int) -> tuple[Array, Array, Array]:
    """Starts and lengths of the parts of all intervals, and what they read, a column each."""
    s, ds = mesh.nodes[None, :-1], np.diff(mesh.nodes)[None]
    reading = mesh.readings if mesh.readings.size else np.zeros((0, mesh.intervals))
    places = [(j / parts, (j + 1) / parts) for j in range(parts)]
    return (
        _beside([s + c * ds for c, _ in places]),
        _beside([(d - c) * ds for c, d in places]),
        _beside([(d - c) * reading for c, d in places]),
    )


def _beside(each: list[Array]) -> Array:
    """Columns of the first, second, ... part of each interval, in their order."""
    return np.stack(each, axis=2).reshape(each[0].shape[0], each[0].shape[1] * len(each))


def by_control_values(mesh: Mesh, begin: Array, end: Array) -> Array:
    """Slopes by the control values, a row each, of those by the controls at both ends of each substep."""
    n, m = mesh.intervals, mesh.substeps
    first, last = begin.T, end.T
    if m > 1:
        one, other = first.reshape(n, m, -1), last.reshape(n, m, -1)
        share = np.arange(m)[:, None] / m
        first = ((1.0 - share) * one + (1.0 - share - 1.0 / m) * other).sum(axis=1)
        last = (share * one + (share + 1.0 / m) * other).sum(axis=1)
    result = np.zeros((mesh.control_nodes, begin.shape[0]))
    result[:n] += first
    result[int(mesh.control == "linear") :][:n] += last
    return mesh.gathered(result)


def by_themselves(statement: Statement, mesh: Mesh) -> bool:
    """Whether all matrices pass along a nominal that is known, by compiled steps of their own alone."""
    st = statement
    plain = not st.coupled and not st.summed and st.samples is None and compiled_steps(mesh)
    return plain and not fed(st, st.ahead + st.behind)


def _nominal(statement: Statement, mesh: Mesh, starts: Array, columns: Sequence[Array]) -> tuple[Array, Array] | None:
    """States after all substeps, of segments from their starts, and the running cost of each interval."""
    m = mesh.substeps
    if mesh.step == "rodas" and m > 1:
        return None
    advance = nominal_interval(statement, 1, mesh.step)
    states, costs, segment, step = [], [], 0, 0
    for length in sorted(set(mesh.segments), reverse=True):  # as they lie in a mesh
        count = mesh.segments.count(length)
        span = slice(step, step + count * length * m)
        own = [column[:, span] for column in columns]
        found = numbers_in_turn(statement, advance, starts[:, segment : segment + count], own, length * m)
        if found is None:
            return None
        states.append(found[0])
        costs.append(found[2])
        segment, step = segment + count, span.stop
    return np.hstack(states), np.cumsum(np.hstack(costs).reshape(-1, m), axis=1)[:, -1]


def _last(statement: Statement, x: Array, duration: float, parameters: Array) -> Array:
    """Half-vectors at the end of what runs backward, zeros of the others, (ne,)."""
    result = np.zeros(statement.ne)
    if statement.matrix_end is not None:
        found = statement.matrix_end(x, duration, parameters)
        result[statement.entries(statement.behind)] = np.asarray(found.full()).ravel()
    return result


def _matrices(statement: Statement, mesh: Mesh, e0: Array, last: Array, steps: list[Array], every: int) -> Array | None:
    """Half-vectors at the start and after every so many substeps, each time.

    Of `steps`: states before and after each substep and what `Interval` has, a column each.
    """
    result = np.empty((statement.ne, steps[0].shape[1] // every + 1))
    for i in statement.ahead:
        own = statement.matrices[i].span
        passed = _passed(statement, mesh, i, e0[own], steps, every)
        if passed is None:
            return None
        result[own, 0], result[own, 1:] = e0[own], passed
    back = turned(steps, slice(None, None, -1)) if statement.behind else []
    for i in statement.behind:
        own = statement.matrices[i].span
        passed = _passed(statement, mesh, i, last[own], back, every)
        if passed is None:
            return None
        result[own, -1], result[own, :-1] = last[own], passed[:, ::-1]
    return result


def turned(steps: Sequence[Array], order: Any) -> list[Array]:
    """Steps passed backward: states before and after each and what `Interval` has, a column each, in an order."""
    before, after, begin, end, s, ds, *rest = (column[:, order] for column in steps)
    return [after, before, end, begin, s + ds, -ds, *rest]


def _passed(
    statement: Statement, mesh: Mesh, index: int, first: Array, steps: Sequence[Array], every: int
) -> Array | None:
    """Half-vectors of one matrix after every so many substeps, in the order of travel."""
    function, pattern = gauss_entries(statement, index, mesh.step)
    size, count = statement.matrices[index].size, steps[0].shape[1]
    length = max(NUMERIC_ENTRIES // (8 * first.size * every), 1) * every  # H of all steps takes memory
    passed = []
    for begin in range(0, count, length):
        points = numbers_in_columns(statement, function, [column[:, begin : begin + length] for column in steps])
        if points is None:
            return None
        passed.append(from_one(first, points, size, pattern, every))
        first = passed[-1][:, -1]
    return np.hstack(passed)
