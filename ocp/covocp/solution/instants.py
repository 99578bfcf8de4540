"""Conditions at instants of the horizon: when they hold, and what a solution makes of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from covocp.base.pages import Section, Sentence, Table, number

if TYPE_CHECKING:
    from covocp.solution.solution import Solution
    from covocp.statement.conditions import Instant

# Rows that a printout lists.
MOST_ROWS = 20


def instant_times(solution: Solution) -> tuple[float, ...]:
    """Times at which conditions hold [s]; none where the problem is not known."""
    inside = None if solution.statement is None else solution.statement.inside
    return () if inside is None else tuple(place * solution.duration for place in inside.places)


def instant_section(solution: Solution) -> Section:
    """A table of the conditions at instants, with values, limits and multipliers."""
    st = solution.statement
    if st is None or not st.inside.size:
        return []
    values = next(rows[0] for _, place, rows in solution.extremal.inequalities() if place == "instants")
    whens = [_when(part, solution.duration) for part in st.inside.parts for _ in part.conditions.names]
    rows = []
    for i, name in enumerate(st.inside.names[:MOST_ROWS]):
        low, high = (number(float(v)) if np.isfinite(v) else "-" for v in (st.inside.lower[i], st.inside.upper[i]))
        row = [name, whens[i], low, number(float(values[i])), high]
        rows.append([*row, number(float(solution.multipliers.instants[i]))])
    left = st.inside.size - len(rows)
    table = Table(columns=["condition at an instant", "t [s]", "lower", "value", "upper", "multiplier"], rows=rows)
    return [table, Sentence(f"and {left} more")] if left else [table]


def _when(part: Instant, duration: float) -> str:
    """The time of an instant [s], with its side where that makes a difference."""
    side = "" if not part.apart else " after" if part.late else " before"
    return f"{number(part.place * duration, 6)}{side}"
