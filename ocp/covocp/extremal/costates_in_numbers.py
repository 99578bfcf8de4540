"""Costates integrated backward where the rates of all matrices have Riccati forms: by products of matrices of numbers.

Slopes of H by all entries of a covariance E are long expressions: here P' = -(F - E W)' P - P (F - E W) is passed as a
matrix, by Runge-Kutta steps of its transitions, before the costates p' = -f_x' p - L_x - tr(P E')_x of the nominal.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from covocp.base.matrices import Array, pack_costate, unpack, unpack_costate
from covocp.extremal.extremal import Extremal
from covocp.extremal.forms import Point, drift_matrices, form_of, slopes_by_states
from covocp.passage.columns import derivative_in_columns
from covocp.statement.interval import Interval
from covocp.statement.statement import Statement
from covocp.transcription.numbers import columns_of_parts

# Places of the stages of a step on the way back, among its start, middle and end; by how much each goes on from the
# costate after the step along the slope of the stage before it, in steps, and its weight in the slope of the step.
PLACES, SHARES, WEIGHTS = (2, 1, 1, 0), (0.0, 0.5, 0.5, 1.0), np.array([1.0, 2.0, 2.0, 1.0]) / 6.0


def costates_in_numbers(
    extremal: Extremal, pairs: int, values: Array, last: Array, jumps: Array, restarts: tuple[Array, Array]
) -> Array | None:
    """Costates at the nodes, (N + 1, nx + ne).

    Args:
        extremal: the trajectory; of a statement that `has_forms`.
        pairs: Runge-Kutta steps an interval.
        values: x and e at the starts, middles and ends of the steps, (N, 2 pairs + 1, nx + ne).
        last: costates at the end, (nx + ne,).
        jumps: what is added at the nodes, (N + 1, nx + ne).
        restarts: which costates to keep at the ends of the intervals and what stands in place of the others,
            (nx + ne, N).

    Returns:
        None where the library cannot take the model.
    """
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    steps = Interval(*columns_of_parts(mesh, pairs, t.u.T, t.duration, extremal.parameters))
    places = (slice(0, -1, 2), slice(1, None, 2), slice(2, None, 2))
    z = [values[:, place].reshape(-1, values.shape[2]) for place in places]
    separate = zip(*[steps.at(j / 2, z[j][:, : st.nx].T) for j in range(3)], strict=True)
    point = [np.asfortranarray(np.concatenate(parts, axis=1), dtype=float) for parts in separate]
    nominal = slopes_by_states(st, point)
    if nominal is None:
        return None
    by_rate, forcing = nominal
    h, halves = np.asarray(steps.h).ravel(), np.concatenate(z)
    result = np.empty((mesh.intervals + 1, last.size))
    for i, block in enumerate(st.matrices):
        own = slice(st.nx + block.span.start, st.nx + block.span.stop)
        among = jumps[:, own], (restarts[0][own].T, restarts[1][own].T)
        found = _matrix(st, i, (point, halves[:, own], h), pairs, last[own], *among)
        if found is None:
            return None
        result[:, own], by_x = found
        forcing = forcing + by_x
    own = slice(0, st.nx)
    among = jumps[:, own], (restarts[0][own].T, restarts[1][own].T)
    result[:, own] = _nominal_costates(by_rate.transpose(0, 2, 1), forcing, h, pairs, last[own], *among)
    return result


def _matrix(
    statement: Statement,
    position: int,
    steps: tuple[Point, Array, Array],
    pairs: int,
    last: Array,
    jumps: Array,
    restarts: tuple[Array, Array],
) -> tuple[Array, Array] | None:
    """Costates of one matrix at the nodes, and the slopes by x of tr(P E') at the three places of all steps."""
    form, size, (point, halves, h) = form_of(statement, position), statement.matrices[position].size, steps
    reverse, E = derivative_in_columns(statement, form.function, "reverse"), unpack(halves, size)
    A = drift_matrices(statement, position, point, E)
    if reverse is None or A is None:
        return None
    nodes, ends = _passed_back(_by_places(A), h, pairs, unpack_costate(last, size), jumps, restarts)
    P = np.concatenate(_three_places(_by_places(A), h, ends))
    drift, noise, information = form.patterns
    loaded = P @ E  # 2 P E, P, - E P E are weights of F, Q, W in tr(P (F E + E F' + Q - E W E))
    through = -E[:, information.own_rows] @ loaded[:, :, information.own_columns]
    seeds = [2.0 * loaded[:, drift.rows, drift.columns], P[:, noise.rows, noise.columns]]
    seeds.append(through[:, information.among_rows, information.among_columns])
    seeds = [np.asfortranarray(seed.T) for seed in seeds]
    slopes = reverse.of_numbers([*point, *[np.zeros(0)] * 3, *seeds], E.shape[0])
    return nodes, slopes[0].T


def _by_places(values: Array) -> list[Array]:
    """At the starts, the middles and the ends of the steps, of what stands one below the other."""
    return np.split(values, 3)


def _passed_back(
    A: list[Array], h: Array, pairs: int, P: Array, jumps: Array, restarts: tuple[Array, Array]
) -> tuple[Array, tuple[Array, Array]]:
    """P' = -A' P - P A backward: half-vectors of costates at the nodes; P at the start and at the end of each step.

    P = M M' for M' = -A' M where it has a root: each step is a congruence, by the Runge-Kutta step of M.
    """
    size, (keep, known) = P.shape[0], restarts
    starts, ends = np.empty((2, h.size, size, size))
    nodes = np.empty((jumps.shape[0], size, size))
    nodes[-1] = P
    through = _steps([matrices.transpose(0, 2, 1) for matrices in A], h, np.eye(size))
    turned = np.ascontiguousarray(through.transpose(0, 2, 1))
    all_kept, still = bool(keep.all()), not jumps.any()
    for k in range(jumps.shape[0] - 2, -1, -1):
        if not all_kept:
            P = unpack_costate(keep[k] * pack_costate(P) + known[k], size)
        for step in range((k + 1) * pairs - 1, k * pairs - 1, -1):
            ends[step] = P
            P = through[step] @ P @ turned[step]
            starts[step] = P
        if not still:
            P = P + unpack_costate(jumps[k], size)
        nodes[k] = P
    return pack_costate(nodes), (starts, ends)


def _three_places(A: list[Array], h: Array, ends: tuple[Array, Array]) -> tuple[Array, Array, Array]:
    """P at the starts, middles and ends of all steps: a cubic polynomial by its slopes."""
    slopes = [half + half.transpose(0, 2, 1) for half in (P @ A[j] for P, j in zip(ends, (0, 2), strict=True))]
    start, end = ends
    return start, 0.5 * (start + end) + h[:, None, None] / 8.0 * (slopes[1] - slopes[0]), end


def _steps(slopes: list[Array], h: Array, unit: Array, forcing: list[Array] | None = None) -> Array:
    """Runge-Kutta steps backward of value' = -slope value - forcing from a unit, (K, n, columns).

    Args:
        slopes: at the start, the middle and the end of each step, (K, n, n).
        h: lengths of the steps.
        unit: (n, columns).
        forcing: added to the slope of the last column at these places, (K, n).
    """
    value: Any = np.broadcast_to(unit, (h.size, *unit.shape))
    total: Any = 0.0
    slope, length = value, h[:, None, None]
    for j, share, weight in zip(PLACES, SHARES, WEIGHTS, strict=True):
        slope = slopes[j] @ (value + share * length * slope if share else value)
        if forcing is not None:
            slope[:, :, -1] += forcing[j]
        total = total + weight * slope
    return np.asarray(value + length * total)


def _nominal_costates(
    slopes: Array,
    forcing: Array,
    h: Array,
    pairs: int,
    last: Array,
    jumps: Array,
    restarts: tuple[Array, Array],
) -> Array:
    """p' = -f_x' p - g backward: each step is one matrix and what is added. f_x' (K, nx, nx), g at the three places."""
    size, (keep, known) = last.size, restarts
    unit = np.concatenate([np.eye(size), np.zeros((size, 1))], axis=1)
    through = _steps(_by_places(slopes), h, unit, _by_places(forcing))
    nodes = np.empty((jumps.shape[0], size))
    nodes[-1] = p = last
    for k in range(jumps.shape[0] - 2, -1, -1):
        p = keep[k] * p + known[k]
        for step in range((k + 1) * pairs - 1, k * pairs - 1, -1):
            p = through[step, :, :-1] @ p + through[step, :, -1]
        p = p + jumps[k]
        nodes[k] = p
    return nodes
