"""Rates of Riccati form, E' = F E + E F' + Q - E W E, by matrices of numbers at many points."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.matrices import Array
from covocp.passage.columns import Prepared, derivative_in_columns, numbers_in_columns
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT

# (x, u, t, T, parameters) of all points, a column for each.
Point = list[Array]
# Place of the controls among these.
CONTROLS = 1


class Pattern(NamedTuple):
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


class Form(NamedTuple):
    """Entries of F, Q and W of a matrix that may be nonzero, as a function of the arguments of the model."""

    function: ca.Function
    patterns: tuple[Pattern, ...]


def has_forms(statement: Statement) -> bool:
    """Whether all matrices run forward along the nominal by rates of Riccati form, and cost nothing on the way."""
    st = statement
    others = st.coupled or st.behind or st.summed or st.running_uses_matrices or st.samples is not None
    return st.nominal is not None and not others and st.riccati_forms


@lru_cache(maxsize=KEPT)
def form_of(statement: Statement, position: int) -> Form:
    """The form of a matrix of a statement that `has_forms`; it can be differentiated by states and controls."""
    form = statement.riccati[position]
    assert form is not None
    symbolic: Any = statement.symbolic
    symbols = [symbolic.sym(form.name_in(i), form.size1_in(i)) for i in range(form.n_in())]
    parts = form.call(symbols)
    entries = [ca.sparsity_cast(part, ca.Sparsity.dense(part.nnz(), 1)) for part in parts]
    places = [part.sparsity().get_triplet() for part in parts]
    patterns = tuple(Pattern(rows, columns, sorted(set(rows)), sorted(set(columns))) for rows, columns in places)
    told = {"is_diff_in": [True] * 2 + [False] * (len(symbols) - 2)}
    return Form(ca.Function("form_entries", symbols, entries, told), patterns)


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
    form = form_of(statement, position)
    entries = numbers_in_columns(statement, form.function, point)
    if entries is None:
        return None
    drift, information = (filled(values.shape[1], form.patterns[k], entries[k]) for k in (0, 2))
    among, into = form.patterns[2].own_rows, form.patterns[2].own_columns  # where few entries are measured
    drift[:, :, into] -= values[:, :, among] @ information[:, among][:, :, into]
    return drift


def filled(size: int, pattern: Pattern, entries: Array) -> Array:
    """Matrices (K, size, size) of entries, a column for each matrix."""
    result = np.zeros((entries.shape[1], size, size))
    result[:, pattern.rows, pattern.columns] = entries.T
    return result


def rates_by(form: Form, entries: Sequence[Array], values: Array) -> Array | None:
    """F E + E F' + Q - E W E at some points, (K, n, n); None where no entry is anything.

    Args:
        form: of E.
        entries: of F, Q and W, or of tangents of them, a column for each point; empty where they are zero.
        values: E, (K, n, n).
    """
    drift, noise, information = entries
    if not any(part.size for part in entries):
        return None
    size, result = values.shape[1], np.zeros_like(values)
    if drift.size:
        moved = filled(size, form.patterns[0], drift) @ values
        result += moved
        result += moved.transpose(0, 2, 1)
    if noise.size:
        result += filled(size, form.patterns[1], noise)
    if information.size:
        pattern = form.patterns[2]
        small = np.zeros((values.shape[0], len(pattern.own_rows), len(pattern.own_columns)))
        small[:, pattern.among_rows, pattern.among_columns] = information.T
        result -= values[:, :, pattern.own_rows] @ small @ values[:, pattern.own_columns]
    return result


def tangents(statement: Statement, function: ca.Function, point: Point, *directions: int) -> list[Array] | None:
    """Slopes of a function of the model's arguments by one control, or by one and then by another.

    Args:
        statement: the problem.
        function: of (x, u, t, T, parameters).
        point: these, a column for each.
        directions: the controls, by their positions.

    Returns:
        Of each result, a column for each point; empty where it does not move. None where the library cannot take it.
    """
    told = derivative_in_columns(statement, function, "forward")
    if told is not None and len(directions) > 1 and any(shape.nnz() for shape in told.outputs):
        told = derivative_in_columns(statement, function, *["forward"] * len(directions))
    if told is None:
        return None
    if not any(shape.nnz() for shape in told.outputs):
        return [np.zeros((0, 0))] * function.n_out()
    given: list[Array | None] = list(point)
    results, count = function.n_out(), point[0].shape[1]
    for position in directions:
        moved = np.zeros((statement.nu, count), order="F")
        moved[position] = 1.0
        along = [moved if i == CONTROLS else None for i in range(len(given))]
        given = [*given, *[None] * results, *along]
    run = Prepared(told, given, count)
    run.run()
    return run.found


def slopes_by_states(statement: Statement, point: Point) -> tuple[Array, Array] | None:
    """f_x (K, nx, nx) and L_x (K, nx) of the nominal.

    Args:
        statement: the problem, with a nominal.
        point: (x, u, t, T, parameters), a column for each.

    Returns:
        None where the library cannot take it.
    """
    assert statement.nominal is not None
    told, (size, count) = derivative_in_columns(statement, statement.nominal, "forward"), point[0].shape
    if told is None:
        return None
    rates, costs = np.zeros((count, size, size)), np.zeros((count, size))
    moved = np.zeros((size, count), order="F")
    run = Prepared(told, [*point, None, None, moved, *[None] * (len(point) - 1)], count)
    by_rate, by_cost = run.found
    for i in range(size):
        moved[i] = 1.0
        run.run()
        moved[i] = 0.0
        if by_rate.size:
            rates[:, :, i] = by_rate.T
        if by_cost.size:
            costs[:, i] = by_cost[0]
    return rates, costs
