"""Slopes of the ends of shooting segments as products of those of their intervals.

Differentiated as a whole a segment of L intervals passes nx + nu (L + 1) directions through each of them. Here every
interval has its own slopes once, by its state, the controls at its two ends and T, and a segment multiplies them from
its end: R <- R A, slopes by the controls R B.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.statement.interval import Interval
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.steps import nominal_interval

# States from which on a segment is differentiated by its intervals.
SMALLEST_CHAINED = 8


def chains(statement: Statement, mesh: Mesh) -> bool:
    """Whether slopes of segments are taken interval by interval: states of more than a few entries alone."""
    alone = mesh.eliminated and not statement.coupled and statement.nu > 0
    return alone and statement.nx >= SMALLEST_CHAINED and max(mesh.segments) > 1


def segment_slopes(statement: Statement, mesh: Mesh, x: Expr, intervals: Interval, w: Expr, starts: Expr) -> Any:
    """Slopes of the states at the ends of all segments by the variables of the NLP.

    Args:
        statement: an uncoupled problem whose matrices are eliminated.
        mesh: of it.
        x: states at the nodes, (nx, N + 1).
        intervals: a column for each.
        w: the variables.
        starts: states at the starts of the segments, linear in w.

    Returns:
        (nx segments, entries of w), sparse.
    """
    nx, nu, n = statement.nx, statement.nu, mesh.intervals
    slopes = _interval_slopes(statement, mesh).map(n)(x[:, :n], *intervals)
    width = 2 * nu + int(statement.duration.free)
    by_start, by_rest = _products(mesh, slopes, nx, width)
    inside = [ca.vec(starts), ca.vec(ca.vertcat(intervals.start, intervals.end))]
    rows = [_blocks(by_start, nx, [(s, s) for s in range(len(mesh.segments))], nx, len(mesh.segments))]
    places = [(s, k) for s, (i, j) in enumerate(pairwise(mesh.starts)) for k in range(i, j)]
    order = np.argsort([k for _, k in places])
    assert np.all(np.diff(order) == 1)
    controls = ca.horzcat(*(by_rest[:, k * width : k * width + 2 * nu] for k in range(n)))
    rows.append(_blocks(controls, nx, places, 2 * nu, n))
    if statement.duration.free:
        inside.append(intervals.duration[0])
        times = [by_rest[:, k * width + 2 * nu] for k in range(n)]
        sums: list[Any] = [sum(times[i + 1 : j], times[i]) for i, j in pairwise(mesh.starts)]
        rows.append(ca.vertcat(*sums))
    linear = ca.jacobian(ca.vertcat(*inside), w)
    (constant,) = ca.Function("linear", [w], [linear]).call([ca.DM.zeros(w.shape[0])])
    return ca.mtimes(ca.horzcat(*rows), constant)


def _interval_slopes(statement: Statement, mesh: Mesh) -> ca.Function:
    """(x, *interval) -> slopes of the end of an interval by x, by the controls at its ends, by T where that is free."""
    step = nominal_interval(statement, mesh.substeps, mesh.step)
    symbols = step.sx_in() if step.is_a("SXFunction") else step.mx_in()
    interval = Interval(*symbols[1:])
    by = [symbols[0], interval.start, interval.end, *([interval.duration] if statement.duration.free else [])]
    slope = ca.jacobian(step(*symbols)[0], ca.vertcat(*by))
    return ca.Function("interval_slopes", symbols, [ca.densify(slope)])


def _products(mesh: Mesh, slopes: Expr, nx: int, width: int) -> tuple[Any, Any]:
    """Slopes of the ends of the segments by their starts, side by side, and by the rest of each interval."""
    R, J = ca.MX.sym("R", nx, nx), ca.MX.sym("J", nx, nx + width)
    step = ca.Function("chain", [R, J], [R @ J[:, :nx], R @ J[:, nx:]])
    by_start: dict[int, Any] = {}
    by_rest: dict[int, Any] = {}
    for length in set(mesh.segments):
        chosen = [s for s, own in enumerate(mesh.segments) if own == length]
        turned = [k for s in chosen for k in range(mesh.starts[s + 1] - 1, mesh.starts[s] - 1, -1)]
        columns = [k * (nx + width) + c for k in turned for c in range(nx + width)]
        run = step.mapaccum("chain", length) if length > 1 else step
        run = run.map(len(chosen)) if len(chosen) > 1 else run
        first, rest = run(ca.repmat(ca.DM.eye(nx), 1, len(chosen)), slopes[:, columns])
        for place, s in enumerate(chosen):
            last = (place + 1) * length * nx
            by_start[s] = first[:, last - nx : last]
        for place, k in enumerate(turned):
            by_rest[k] = rest[:, place * width : (place + 1) * width]
    return tuple(ca.horzcat(*(parts[i] for i in sorted(parts))) for parts in (by_start, by_rest))


def _blocks(values: Expr, rows: int, places: list[tuple[int, int]], columns: int, count: int) -> Any:
    """A matrix of blocks (rows, columns) that lie side by side in `values`, block k at places[k]."""
    row = [i * rows + r for i, _ in places for _ in range(columns) for r in range(rows)]
    column = [j * columns + c for _, j in places for c in range(columns) for _ in range(rows)]
    height = rows * (max(i for i, _ in places) + 1)
    pattern = ca.Sparsity.triplet(height, columns * count, row, column)
    return ca.sparsity_cast(ca.vec(values), pattern) if pattern.nnz() else ca.MX(height, columns * count)
