"""Panels of conditions on probabilities: the value along the nominal, and how far from a limit it has to be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from covocp.plot.curves import Bound, Curve, Drawn, Panel
from covocp.solution.chances import widths
from covocp.solution.solution import Solution
from covocp.statement.chances import ChanceLimits

# The word of a quantity that is a condition on a probability.
CHANCE = "chance"


def on_the_way(solution: Solution) -> tuple[ChanceLimits, ...]:
    """The conditions on probabilities along the path whose spread a solution knows."""
    st = solution.statement
    if st is None:
        return ()
    return tuple(q for q in st.chances if q.place == "path" and (q.matrix is not None or solution.loop is not None))


def chance_names(solutions: Sequence[Solution]) -> tuple[str, ...]:
    """Names of all of them, in their order."""
    return tuple(dict.fromkeys(limits.name for solution in solutions for limits in on_the_way(solution)))


def chance_panels(drawn: Sequence[Drawn], name: str) -> list[Panel]:
    """A panel for each row of a condition, with its limits; rows differ by name."""
    curves: dict[str, list[Curve]] = {}
    bounds: dict[str, dict[Bound, None]] = {}
    for d in drawn:
        for limits in (q for q in on_the_way(d.solution) if q.name == name):
            values, needed = widths(d.solution, limits)
            for i, row in enumerate(limits.names):
                there = np.isfinite([limits.lower[i], limits.upper[i]])
                sides = there[:, None] * needed[:, i]
                curve = Curve(t=d.solution.t, y=values[:, i], needed=sides, order=d.order)
                curves.setdefault(row, []).append(curve)
                bounds.setdefault(row, {}).update(dict.fromkeys(d.bounds((limits.lower[i], limits.upper[i]))))
    return [
        Panel(label=row, entries=(row,), curves=tuple(own), bounds=tuple(bounds[row])) for row, own in curves.items()
    ]
