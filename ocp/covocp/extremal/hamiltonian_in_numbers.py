"""H, its terms and its slopes by the controls where the rates of all matrices have Riccati form, without expressions.

What a control does to the rate of a covariance goes through the few entries of F, Q and W: as matrices of numbers it is
had in the time of some products, where the slopes of all entries of E' are long expressions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from covocp.base.matrices import Array, pack, unpack
from covocp.extremal.forms import Point, form_of, has_forms, rates_by, tangents
from covocp.passage.columns import numbers_in_columns
from covocp.statement.statement import Statement


class ByControls(NamedTuple):
    """H_u (K, nu), H_uu (K, nu, nu), sums of the absolute terms of H_u (K, nu)."""

    slope: Array
    curvature: Array
    sizes: Array


def terms_in_numbers(statement: Statement, columns: Sequence[Any], state: Array, matrices: Array) -> Array | None:
    """Terms of H, see `hamiltonian.terms_of`.

    Args:
        statement: the problem.
        columns: (x, u, e, t, T, p) of the points, a column each.
        state: costates of the states, (K, nx).
        matrices: of the half-vectors, (K, ne).

    Returns:
        (K, nx + ne + 1); None where a rate has another form, or the library cannot take the model.
    """
    st = statement
    if not has_forms(st) or st.nominal is None:
        return None
    point, e = _point(columns)
    nominal = numbers_in_columns(st, st.nominal, point)
    if nominal is None:
        return None
    weighed = np.zeros((e.shape[1], st.nx + st.ne + 1))
    weighed[:, : st.nx] = state * nominal[0].T
    for i, block in enumerate(st.matrices):
        form = form_of(st, i)
        entries = numbers_in_columns(st, form.function, point)
        if entries is None:
            return None
        rates = rates_by(form, entries, unpack(e[block.span].T, block.size))
        if rates is not None:
            weighed[:, st.nx + block.span.start : st.nx + block.span.stop] = matrices[:, block.span] * pack(rates)
    weighed[:, -1] = nominal[1].ravel()
    return weighed


def by_controls_in_numbers(
    statement: Statement, columns: Sequence[Any], state: Array, matrices: Array
) -> ByControls | None:
    """What `hamiltonian.by_controls` gives along some points; arguments and None as of `terms_in_numbers`."""
    st = statement
    if not has_forms(st):
        return None
    point, e = _point(columns)
    values, count = [unpack(e[block.span].T, block.size) for block in st.matrices], e.shape[1]
    slope, sizes, curvature = np.zeros((count, st.nu)), np.zeros((count, st.nu)), np.zeros((count, st.nu, st.nu))
    for i in range(st.nu):
        terms = _terms_by(st, point, values, (state, matrices), i)
        if terms is None:
            return None
        slope[:, i], sizes[:, i] = (sum(part.sum(axis=1) for part in parts) for parts in (terms, map(np.abs, terms)))
        for j in range(i, st.nu):
            further = _terms_by(st, point, values, (state, matrices), i, j)
            if further is None:
                return None
            curvature[:, i, j] = curvature[:, j, i] = sum(part.sum(axis=1) for part in further)
    return ByControls(slope, curvature, sizes)


def _point(columns: Sequence[Any]) -> tuple[Point, Array]:
    """Arguments of the nominal, and half-vectors, of (x, u, e, t, T, p)."""
    x, u, e, *others = (np.asfortranarray(column, dtype=float) for column in columns)
    return [x, u, *others], e


def _terms_by(
    statement: Statement, point: Point, values: list[Array], costates: tuple[Array, Array], *directions: int
) -> list[Array] | None:
    """Terms of a slope of H by one control, or by one and then another, (K, number) each; no zeros."""
    st, (state, matrices) = statement, costates
    assert st.nominal is not None
    nominal = tangents(st, st.nominal, point, *directions)
    if nominal is None:
        return None
    terms = [state * nominal[0].T] if nominal[0].size else []
    terms += [nominal[1].T] if nominal[1].size else []
    for i, block in enumerate(st.matrices):
        form = form_of(st, i)
        entries = tangents(st, form.function, point, *directions)
        if entries is None:
            return None
        rates = rates_by(form, entries, values[i])
        terms += [matrices[:, block.span] * pack(rates)] if rates is not None else []
    return terms
