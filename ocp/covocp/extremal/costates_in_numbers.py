"""Costates integrated backward where the rates of all matrices have Riccati forms: by products of matrices of numbers.

Slopes of H by all entries of a covariance E are long expressions: here P' = -(F - E W)' P - P (F - E W) is passed as a
matrix, by Runge-Kutta steps of its transitions, before the costates p' = -f_x' p - L_x - tr(P E')_x of the nominal.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.matrices import Array, pack_costate, unpack, unpack_costate
from covocp.extremal.extremal import Extremal
from covocp.passage.columns import derivative_in_columns, numbers_in_columns
from covocp.statement.interval import Interval
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.numbers import columns_of_parts

# Places of the stages of a step on the way back, among its start, middle and end; by how much each goes on from the
# costate after the step along the slope of the stage before it, in steps, and its weight in the slope of the step.
PLACES, SHARES, WEIGHTS = (2, 1, 1, 0), (0.0, 0.5, 0.5, 1.0), np.array([1.0, 2.0, 2.0, 1.0]) / 6.0

# (x, u, t, T, parameters) of all steps at one place of them, a column for each.
Point = list[Array]


class _Pattern(NamedTuple):
    """Rows and columns of the entries of a matrix that may be nonzero; the different ones among them."""

    rows: list[int]
    columns: list[int]
    own_rows: list[int]
    own_columns: list[int]

    @property
    def among_rows(self) -> list[int]:
        """Positions of the rows among the different ones."""
        return [self.own_rows.index(row) for row in self.rows]

    @property
    def among_columns(self) -> list[int]:
        """The same of the columns."""
        return [self.own_columns.index(column) for column in self.columns]


class _Form(NamedTuple):
    """Entries of F, Q and W of a matrix that may be nonzero, as a function of the arguments of the model."""

    function: ca.Function
    patterns: tuple[_Pattern, ...]


def has_forms(statement: Statement) -> bool:
    """Whether all matrices run forward along the nominal by rates of Riccati form, and cost nothing on the way."""
    st = statement
    others = st.coupled or st.behind or st.summed or st.running_uses_matrices or st.samples is not None
    return st.nominal is not None and not others and st.riccati_forms


@lru_cache(maxsize=KEPT)
def _form(statement: Statement, position: int) -> _Form:
    form = statement.riccati[position]
    assert form is not None
    symbolic: Any = statement.symbolic
    symbols = [symbolic.sym(form.name_in(i), form.size1_in(i)) for i in range(form.n_in())]
    parts = form.call(symbols)
    entries = [ca.sparsity_cast(part, ca.Sparsity.dense(part.nnz(), 1)) for part in parts]
    places = [part.sparsity().get_triplet() for part in parts]
    patterns = tuple(_Pattern(rows, columns, sorted(set(rows)), sorted(set(columns))) for rows, columns in places)
    told = {"is_diff_in": [True] + [False] * (len(symbols) - 1)}
    return _Form(ca.Function("form_entries", symbols, entries, told), patterns)


@lru_cache(maxsize=KEPT)
def _nominal_slopes(statement: Statement) -> ca.Function:
    """(x, u, t, T, parameters) -> f_x column by column, L_x."""
    nominal = statement.nominal
    assert nominal is not None
    symbolic: Any = statement.symbolic
    symbols = [symbolic.sym(nominal.name_in(i), nominal.size1_in(i)) for i in range(nominal.n_in())]
    rate, cost = nominal.call(symbols)
    slopes = [ca.vec(ca.densify(ca.jacobian(rate, symbols[0]))), ca.densify(ca.gradient(cost, symbols[0]))]
    return ca.Function("nominal_slopes", symbols, slopes)


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
    points = [list(steps.at(j / 2, z[j][:, : st.nx].T)) for j in range(3)]
    nominal = [numbers_in_columns(st, _nominal_slopes(st), point) for point in points]
    if any(found is None for found in nominal):
        return None
    h = np.asarray(steps.h).ravel()
    result, forcing = np.empty((mesh.intervals + 1, last.size)), [found[1].T for found in nominal]  # type: ignore[index]
    for i, block in enumerate(st.matrices):
        own = slice(st.nx + block.span.start, st.nx + block.span.stop)
        halves = [part[:, own] for part in z]
        among = jumps[:, own], (restarts[0][own].T, restarts[1][own].T)
        found = _matrix(st, i, (points, halves, h), pairs, last[own], *among)
        if found is None:
            return None
        result[:, own], by_x = found
        forcing = [one + other for one, other in zip(forcing, by_x, strict=True)]
    slopes = [found[0].T.reshape(-1, st.nx, st.nx) for found in nominal]  # type: ignore[index]
    own = slice(0, st.nx)
    among = jumps[:, own], (restarts[0][own].T, restarts[1][own].T)
    result[:, own] = _nominal_costates(slopes, forcing, h, pairs, last[own], *among)
    return result


def _matrix(
    statement: Statement,
    position: int,
    steps: tuple[list[Point], list[Array], Array],
    pairs: int,
    last: Array,
    jumps: Array,
    restarts: tuple[Array, Array],
) -> tuple[Array, list[Array]] | None:
    """Costates of one matrix at the nodes, and the slopes by x of tr(P E') at the three places of all steps."""
    form, size, (points, halves, h) = _form(statement, position), statement.matrices[position].size, steps
    reverse = derivative_in_columns(statement, form.function, "reverse")
    E = [unpack(half, size) for half in halves]
    found = [drift_matrices(statement, position, *place) for place in zip(points, E, strict=True)]
    A = [matrices for matrices in found if matrices is not None]
    if reverse is None or len(A) < len(found):
        return None
    nodes, ends = _passed_back(A, h, pairs, unpack_costate(last, size), jumps, restarts)
    by_x = []
    for j, P in enumerate(_three_places(A, h, ends)):
        drift, noise, information = form.patterns
        loaded = P @ E[j]  # 2 P E, P, - E P E are weights of F, Q, W in tr(P (F E + E F' + Q - E W E))
        through = -E[j][:, information.own_rows] @ loaded[:, :, information.own_columns]
        seeds = [2.0 * loaded[:, drift.rows, drift.columns], P[:, noise.rows, noise.columns]]
        seeds.append(through[:, information.among_rows, information.among_columns])
        seeds = [np.asfortranarray(seed.T) for seed in seeds]
        slopes = reverse.of_numbers([*points[j], *[np.zeros(0)] * 3, *seeds], h.size)
        by_x.append(slopes[0].T)
    return nodes, by_x


def drift_matrices(statement: Statement, position: int, point: Point, values: Array) -> Array | None:
    """F - E W of a matrix whose rate has Riccati form, (K, n, n).

    Args:
        statement: the problem.
        position: of the matrix.
        point: (x, u, t, T, parameters), a column for each.
        values: E there, (K, n, n).

    Returns:
        None where the library cannot take the model.
    """
    form = _form(statement, position)
    entries = numbers_in_columns(statement, form.function, point)
    if entries is None:
        return None
    drift, information = (_filled(values.shape[1], form.patterns[k], entries[k]) for k in (0, 2))
    among, into = form.patterns[2].own_rows, form.patterns[2].own_columns  # where few entries are measured
    drift[:, :, into] -= values[:, :, among] @ information[:, among][:, :, into]
    return drift


def _filled(size: int, pattern: _Pattern, entries: Array) -> Array:
    """Matrices (K, size, size) of entries, a column for each matrix."""
    result = np.zeros((entries.shape[1], size, size))
    result[:, pattern.rows, pattern.columns] = entries.T
    return result


def _passed_back(
    A: list[Array], h: Array, pairs: int, P: Array, jumps: Array, restarts: tuple[Array, Array]
) -> tuple[Array, tuple[Array, Array]]:
    """P' = -A' P - P A backward: half-vectors of costates at the nodes; P at the start and at the end of each step.

    P = M M' for M' = -A' M where it has a root: each step is a congruence, by the Runge-Kutta step of M.
    """
    size, (keep, known) = P.shape[0], restarts
    starts, ends = np.empty((2, h.size, size, size))
    nodes = np.empty((jumps.shape[0], jumps.shape[1]))
    nodes[-1] = pack_costate(P)
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
        nodes[k] = pack_costate(P)
    return nodes, (starts, ends)


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
    slopes: list[Array],
    forcing: list[Array],
    h: Array,
    pairs: int,
    last: Array,
    jumps: Array,
    restarts: tuple[Array, Array],
) -> Array:
    """p' = -f_x' p - g backward: each step is one matrix and what is added. f_x' (K, nx, nx), g at the three places."""
    size, (keep, known) = last.size, restarts
    through = _steps(slopes, h, np.concatenate([np.eye(size), np.zeros((size, 1))], axis=1), forcing)
    nodes = np.empty((jumps.shape[0], size))
    nodes[-1] = p = last
    for k in range(jumps.shape[0] - 2, -1, -1):
        p = keep[k] * p + known[k]
        for step in range((k + 1) * pairs - 1, k * pairs - 1, -1):
            p = through[step, :, :-1] @ p + through[step, :, -1]
        p = p + jumps[k]
        nodes[k] = p
    return nodes
