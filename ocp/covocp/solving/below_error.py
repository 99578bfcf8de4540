"""Conditions on probabilities that no feedback meets: the filter's error alone scatters too much for them."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array
from covocp.base.normal import margin
from covocp.problem.declarations import Chance, Declarations
from covocp.problem.inequalities import row_names
from covocp.solution.solution import Solution


def chances_below(own: Declarations, along: Solution) -> list[str]:
    """What E asks of the limits of each condition that no nominal and no feedback can meet along a solution, in words.

    Between two limits the best value is their middle; one at the end may be prescribed. Where there is one limit, and
    the value is free, the nominal can always stay further away.

    Args:
        own: the problem, its conditions on probabilities as constraints.
        along: a solution with the same states and unknowns, whose E counts.
    """
    told = []
    for constraint in own.constraints:
        chance = constraint.chance
        if chance is None or chance.slopes is None or along.loop is None:
            continue
        at = {"path": slice(None), "initial": slice(0, 1), "final": slice(-1, None)}[chance.at]
        times = along.t[at]
        for i, name in enumerate(row_names(constraint)):
            s = _deviations(chance, i, along)[at]
            limits = float(chance.lower[i]), float(chance.upper[i])
            fixed = chance.at == "final" and _prescribed(own, chance.expression[i])
            if not fixed and not np.isfinite(limits).all():
                continue
            y = _along(chance.expression[i], along)[at] if fixed else np.full(times.size, sum(limits) / 2)
            rooms = margin(y, s, *limits, chance.each)
            k = int(np.argmin(rooms))
            if rooms[k] < 0:
                more = "each of its limits" if np.isfinite(limits).all() else "its limit"
                told.append(
                    f"the deviation of '{name}' is {s[k]:.4g} at {times[k]:.4g} s with E for X: for {chance.each:.6g} "
                    f"{more} would have to be {-rooms[k]:.4g} wider"
                )
    return told


def _deviations(chance: Chance, row: int, along: Solution) -> Array:
    """Standard deviations of a row at the nodes by E alone, (K,)."""
    assert along.loop is not None
    assert chance.slopes is not None
    slope = ca.densify(chance.slopes[0][row, :])
    J = np.stack([_along(slope[j], along) for j in range(slope.shape[1])], axis=1)
    return np.asarray(np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", J, along.loop.E, J), 0.0)))


def _along(expression: Any, along: Solution) -> Array:
    """The values of a number at the nodes, (K,)."""
    if not ca.symvar(expression):
        return np.full(along.t.size, float(ca.evalf(expression)))
    return np.broadcast_to(np.asarray(along[expression], dtype=float).ravel(), along.t.shape)


def _prescribed(own: Declarations, expression: Any) -> bool:
    """Whether an expression at the end is one of prescribed values alone."""
    ends = {s.symbol.__hash__(): s.final for s in own.states if s.target is None and s.chart is None}
    symbols = [symbol.__hash__() for symbol in ca.symvar(expression)]
    known = [key in ends and ends[key].is_constant() for key in symbols]
    return all(known) and not any(np.isnan(ca.evalf(ends[key]).full()).any() for key in symbols)
