"""The inequalities of a problem as functions: those of each place, and of each instant inside the horizon."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.problem.closed_loop_covariance import floored, used_in
from covocp.problem.declarations import Constraint, Declarations, Where
from covocp.problem.stacked import Stacked
from covocp.statement.conditions import Conditions, Inside, Instant

# Share of the terminal time within which two instants are one: sums and divisions part them by rounding.
SAME = 1e-9


def row_names(constraint: Constraint) -> list[str]:
    """Names of the rows of a constraint."""
    size = constraint.lower.size
    return [constraint.name] if size == 1 else [f"{constraint.name}[{i}]" for i in range(size)]


def conditions_at(problem: Declarations, stacked: Stacked, at: Where) -> Conditions:
    """The inequalities of one place as one function."""
    return _conditions(problem, stacked, at, [c for c in problem.constraints if c.at == at])


def conditions_inside(problem: Declarations, stacked: Stacked) -> Inside:
    """The conditions at instants of the horizon, instant by instant; at each those before what happens there first."""
    chosen = [(c, c.instant) for c in problem.constraints if c.instant is not None]
    sampled = sorted({place for entry in problem.sampled for place in entry.instants})
    places = _merged(sampled, sorted({instant for _, instant in chosen}))
    parts = []
    for place in sorted(set(places.values())):
        for late in (False, True):
            own = [c for c, instant in chosen if places[instant] == place and c.late == late]
            if own:
                conditions = _conditions(problem, stacked, "inside", own)
                parts.append(
                    Instant(
                        place=place,
                        late=late,
                        apart=place in sampled or bool(conditions.function.jac_sparsity(0, 1).nnz()),
                        conditions=conditions,
                    )
                )
    return Inside(parts=tuple(parts))


def _merged(known: list[float], given: list[float]) -> dict[float, float]:
    """What stands for each of some rising instants: the first of those that are the same, known ones before others."""
    result: dict[float, float] = {}
    for place in given:
        near = [other for other in (*known, *result.values()) if abs(other - place) <= SAME]
        result[place] = near[0] if near else place
    return result


def _conditions(problem: Declarations, stacked: Stacked, at: Where, chosen: list[Constraint]) -> Conditions:
    """Some inequalities as one function."""
    values = ca.vertcat(stacked.symbolic(0, 1), *stacked.substitute(*(c.expression for c in chosen)))
    names = [name for c in chosen for name in row_names(c)]
    realised, scattered, spread = None, None, problem.spread
    if spread is not None and any(used_in(problem, c.expression) for c in chosen):
        none: Any = floored(stacked.symbolic.zeros(spread.symbol.shape[0]), spread.size)  # type: ignore[attr-defined]
        own = stacked.substitute(*(c.expression for c in chosen), spread=none)
        realised = stacked.function(f"{at}_realised", [ca.vertcat(*own)])
        scattered = stacked.with_spread(f"{at}_scattered", [c.expression for c in chosen], spread.size)
    return Conditions(
        function=stacked.function(f"{at}_conditions", [values]),
        realised=realised,
        scattered=scattered,
        names=tuple(names),
        between=tuple(c.between for c in chosen for _ in range(c.lower.size)),
        lower=np.concatenate([np.zeros(0), *(c.lower for c in chosen)]),
        upper=np.concatenate([np.zeros(0), *(c.upper for c in chosen)]),
        uses_matrices=bool(chosen and problem.matrices and ca.depends_on(values, stacked.inputs[2])),
    )
