"""Steps of matrices in sequence along a nominal, by CasADi's operations or the compiled passage, and what is read."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr, sequence_of
from covocp.base.linear_solve import LINEAR_SOLVER
from covocp.base.matrices import half_length
from covocp.passage.columns import in_columns
from covocp.passage.shape import Pattern
from covocp.passage.sweep import Entries, Told
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import fed, gauss_entries, moving_step, propagate_step, step_matrix
from covocp.transcription.mesh import Mesh
from covocp.transcription.steps import read_by, read_step, runge_kutta_step, told_at

# Steps that a sequence of numbers takes at a time; in compiled code as many as have so many entries of H.
NUMERIC_RUN, NUMERIC_ENTRIES = 10, 2_000_000

# How eliminated matrices pass: by CasADi's operations (None); where the steps allow it in compiled code (`passed_by`),
# of which CasADi sees no sparsity (slopes along directions, no Jacobians); or by what has the same arguments.
Passage = Callable[..., Any] | None

# (value, arguments, count) -> what a sequence of steps gives, a column for each step, or for those that are wanted.
Run = Callable[[Any, list[Any], int], list[Any]]


def in_sequence(
    statement: Statement,
    mesh: Mesh,
    passage: Passage,
    positions: tuple[int, ...],
    first: Expr,
    columns: tuple[Any, ...],
    kicks: Expr,
    every: int,
) -> tuple[Any, Any]:
    """Half-vectors of some matrices after substeps, in the order of travel: before and after the kicks.

    Args:
        statement: the problem.
        mesh: of it.
        passage: how they pass.
        positions: of the matrices.
        first: half-vectors where they start.
        columns: states before and after each substep, and the substeps.
        kicks: added at the ends of the intervals, a column each; None: nothing.
        every: 1: after each substep; mesh.substeps: at the ends of the intervals.
    """
    count = mesh.intervals * mesh.substeps
    reads = _reads(mesh) if mesh.step != "rk4" and read_by(statement, positions) else []
    if reads and passage is not None and len(positions) == 1:
        return _chosen(every, *_reading_passage(statement, mesh, passage, positions[0], first, columns, kicks))
    at_once = passage is not None and not reads and not (fed(statement, positions) and mesh.step != "rk4")
    own = every if at_once else 1
    if at_once and kicks is None and all(isinstance(value, ca.DM) for value in (first, *columns)):
        values = _in_runs(_steps(statement, mesh, passage, positions, False, own), first, columns, own)
        return _chosen(every // own, values, values)
    moving = [k for k in range(count) if k not in set(reads)] if reads else slice(None)
    chosen = [column[:, moving] for column in columns] if reads else columns
    matrices, run = _steps(statement, mesh, passage, positions, kicks is not None, own)(chosen, count - len(reads))
    read = read_step(statement, positions) if reads else None
    at_reads = [columns[0], *columns[2:]]
    if kicks is None:
        values = _stretches(run, read, first, (matrices, at_reads), reads, count)[0]
        return _chosen(every // own, values, values)
    at_nodes = kicks
    if own < mesh.substeps:
        at_nodes = ca.MX(first.shape[0], count)
        at_nodes[:, mesh.substeps - 1 :: mesh.substeps] = kicks
    given = ([*matrices, at_nodes[:, moving]], [*at_reads, at_nodes])
    passed, before = _stretches(run, None if read is None else _kicked(read), first, given, reads, count)
    return _chosen(every // own, before, passed)


def at_columns(statement: Statement, mesh: Mesh, function: ca.Function, count: int) -> ca.Function:
    """A function mapped over columns, by compiled code but where CasADi writes all out as C."""
    return in_columns(statement, function, count) if mesh.linear_solver == LINEAR_SOLVER else function.map(count)


def _chosen(every: int, before: Any, passed: Any) -> tuple[Any, Any]:
    """Every so many columns, the last of them each time."""
    return (before, passed) if every == 1 else (before[:, every - 1 :: every], passed[:, every - 1 :: every])


def _steps(
    statement: Statement, mesh: Mesh, passage: Passage, positions: tuple[int, ...], kicked: bool, every: int
) -> Callable[[Any, int], tuple[list[Any], Run]]:
    """What makes, from the columns of some steps, the arguments of a sequence of them and the sequence.

    Every so many values are wanted of it where it passes in compiled code.
    """
    kinds: list[ca.Function]
    if fed(statement, positions) and mesh.step != "rk4":  # steps of one that depend on another
        step = moving_step(statement, positions, mesh.step, mesh.linear_solver)
        step = _kicked(step) if kicked else step
        return lambda columns, _: (list(columns), partial(_accumulated, step))
    if passage is not None:
        sizes = [statement.matrices[i].size for i in positions]
        found = [gauss_entries(statement, i, mesh.step) for i in positions]
        kinds = [function for function, _ in found]
        run = partial(_compiled, passage, sizes, [pattern for _, pattern in found], kicked, every)
        return lambda columns, count: (
            [h for kind in kinds for h in at_columns(statement, mesh, kind, count).call(list(columns))],
            run,
        )
    if mesh.step == "rk4":
        step = runge_kutta_step(statement, positions)
        step = _kicked(step) if kicked else step
        return lambda columns, _: ([column for k, column in enumerate(columns) if k != 1], partial(_accumulated, step))
    step = propagate_step(statement, positions, mesh.step, mesh.linear_solver)
    step = _kicked(step) if kicked else step
    kinds = [step_matrix(statement, i, mesh.step, mesh.linear_solver) for i in positions]
    return lambda columns, count: ([kind.map(count)(*columns) for kind in kinds], partial(_accumulated, step))


def _compiled(
    passing: Callable[..., Any],
    sizes: list[int],
    patterns: list[Pattern],
    kicked: bool,
    every: int,
    first: Expr,
    arguments: list[Any],
    count: int,
) -> list[Any]:
    """What `_accumulated` gives, by the compiled passage: arguments are entries of h H at both points of each."""
    kicks = arguments[-1] if kicked else None
    ends = np.cumsum([0, *(half_length(size) for size in sizes)]).tolist()
    parts = []
    for k, (size, pattern, (i, j)) in enumerate(zip(sizes, patterns, pairwise(ends), strict=True)):
        own = None if kicks is None else kicks[i:j, :]
        one, two = arguments[2 * k : 2 * k + 2]
        points = Entries(size=size, pattern=pattern, first=one, second=two)
        parts.append(passing(first[i:j], points, own, every=every))
    passed = ca.vertcat(*parts) if len(parts) > 1 else parts[0]
    return [passed] if kicks is None else [passed, passed - kicks]


def _in_runs(
    make: Callable[[Any, int], tuple[list[Any], Run]], first: ca.DM, columns: tuple[Any, ...], every: int
) -> Any:
    """What `_compiled` gives of numbers, in short runs where the matrices are large: H of all steps takes memory."""
    length = max(NUMERIC_ENTRIES // (8 * first.shape[0] * every), 1) * every
    values = [first]
    for own in zip(*(ca.horzsplit(column, length) for column in columns), strict=True):
        matrices, run = make(own, own[0].shape[1])
        values += run(values[-1][:, -1], matrices, own[0].shape[1])
    return ca.horzcat(*values[1:])


def _reading_passage(
    statement: Statement,
    mesh: Mesh,
    passage: Callable[..., Any],
    position: int,
    first: Expr,
    columns: tuple[Any, ...],
    kicks: Expr,
) -> tuple[Any, Any]:
    """What `in_sequence` gives of the covariance of the error where it is read at instants, by the compiled passage.

    What a substep reads is a step of the passage for each group of rows.
    """
    assert statement.samples is not None
    count, groups = mesh.intervals * mesh.substeps, len(statement.samples.groups)
    reads = _reads(mesh)
    within = set(reads)
    moving = [k for k in range(count) if k not in within]
    lengths = np.where(np.isin(np.arange(count), reads), groups, 1)
    last = np.cumsum(lengths) - 1
    steps = tuple(int(last[k]) - groups + 1 + j for k in reads for j in range(groups))
    chosen = [column[:, reads] for column in (columns[0], *columns[2:])]
    height = max(len(group) for group in statement.samples.groups)
    told = Told(steps=steps, rows=height, columns=told_at(statement).map(len(reads))(*chosen))
    kind, pattern = gauss_entries(statement, position, mesh.step)
    one, two = at_columns(statement, mesh, kind, len(moving)).call([c[:, moving] for c in columns])
    points = Entries(size=statement.matrices[position].size, pattern=pattern, first=one, second=two)
    if kicks is None:
        values = passage(first, points, None, told)[:, last.tolist()]
        return values, values
    later = ca.MX(first.shape[0], int(last[-1]) + 1)
    later[:, last[mesh.substeps - 1 :: mesh.substeps].tolist()] = kicks
    passed = passage(first, points, ca.densify(later), told)[:, last.tolist()]
    at_nodes = ca.MX(first.shape[0], count)
    at_nodes[:, mesh.substeps - 1 :: mesh.substeps] = kicks
    return passed - at_nodes, passed


def _reads(mesh: Mesh) -> list[int]:
    """The substeps, in the order of travel forward, at which something is read."""
    return [k * mesh.substeps + j for k in mesh.instants if mesh.readings[:, k].any() for j in range(mesh.substeps)]


def _kicked(step: ca.Function) -> ca.Function:
    """A step with a kick after it: (*its arguments, kick) -> after the kick, before it."""
    inputs = step.mx_in()
    kick = ca.MX.sym("kick", inputs[0].shape[0])
    arrived = step(*inputs)
    return ca.Function("kicked", [*inputs, kick], [arrived + kick, arrived])


def _stretches(
    run: Run,
    read: ca.Function | None,
    first: Expr,
    given: tuple[list[Any], list[Any]],
    reads: list[int],
    count: int,
) -> list[Any]:
    """What steps give in sequence, and between them what is read, a column each.

    Args:
        run: (value, columns of `given[0]`, their count) -> values after the steps, perhaps more.
        read: (value, *columns of `given[1]`) -> the same.
        first: value at the start.
        given: arguments of the steps that move, without columns for the others; of those that read, a column for each.
        reads: which of all steps read.
        count: of all steps.
    """
    if read is None:
        return run(first, given[0], count)
    parts: list[list[Any]] = []
    value, moved, k = first, 0, 0
    for stop in [*reads, count]:
        if length := stop - k:
            own = [_columns(argument, moved, length, count - len(reads)) for argument in given[0]]
            parts.append(run(value, own, length))
            value, moved = parts[-1][0][:, -1], moved + length
        if stop < count:
            outputs = read(value, *(argument[:, stop] for argument in given[1]))
            parts.append(list(outputs) if isinstance(outputs, (tuple, list)) else [outputs])
            value = parts[-1][0]
        k = stop + 1
    return [ca.horzcat(*values) for values in zip(*parts, strict=True)]


def _columns(argument: Any, begin: int, length: int, count: int) -> Any:
    """The part of an argument that belongs to some steps, of which each has as many columns."""
    width = argument.shape[1] // count
    return argument[:, begin * width : (begin + length) * width]


def _accumulated(step: ca.Function, first: Expr, arguments: list[Any], count: int) -> list[Any]:
    """What a step function gives in sequence; numbers in short runs, because a long one takes memory for all of it."""
    if not isinstance(arguments[0], ca.DM):
        return sequence_of(step, count).call([first, *arguments])
    lengths = [min(NUMERIC_RUN, count - begin) for begin in range(0, count, NUMERIC_RUN)]
    parts = [ca.horzsplit(argument, NUMERIC_RUN * (argument.shape[1] // count)) for argument in arguments]
    value, passed = first, []
    for length, *columns in zip(lengths, *parts, strict=True):
        passed.append(sequence_of(step, length).call([value, *columns]))
        value = passed[-1][0][:, -1]
    return [ca.horzcat(*values) for values in zip(*passed, strict=True)]
