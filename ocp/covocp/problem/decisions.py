"""Decisions: constants that the optimiser chooses, held as states that do not move and are no part of the filter."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.checks import bound_columns, check_inside, column
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.problem.declarations import Declarations, Dynamics, State
from covocp.problem.matrices import Matrix


def with_constant(
    own: Declarations, symbol: dict[str, Any], lower: Given, upper: Given, guess: Given, *, sized: bool = True
) -> Declarations:
    """The declarations with one more constant that is chosen.

    Args:
        own: of a problem.
        symbol: name, symbol, size, where and unit.
        lower: bounds, numbers or one for each component.
        upper: likewise.
        guess: where it starts, likewise.
        sized: whether guess and bounds tell its magnitude.

    Raises:
        ProblemError: bounds crossed, the guess NaN, infinite or outside of them.
    """
    name, size = symbol["name"], symbol["size"]
    low, high = bound_columns(name, lower, upper, size)
    start = column(name, "guess", guess, size)
    check_inside(name, "guessed", start, low, high)
    free = ca.MX(ca.DM.nan(size, 1))
    entry = State(
        **symbol,
        initial=free,
        final=free,
        lower=low,
        upper=high,
        guess=start,
        scale=_magnitude(start, low, high) if sized else None,
        variance=ca.MX(size, size),
        role="decision",
    )
    still = Dynamics(rate=ca.MX.zeros(size, 1), noise=None, where=symbol["where"])
    return own.adding(states=entry, rates={name: still})


def _magnitude(guess: Array, lower: Array, upper: Array) -> Array:
    """That of the guess; where it is zero the range of the bounds, else 1."""
    range_of = np.where(np.isfinite(lower) & np.isfinite(upper) & (upper > lower), upper - lower, 1.0)
    return np.where(guess != 0.0, np.abs(guess), range_of)


def decisions_of(problem: Declarations) -> list[State]:
    """The constants of a problem that are chosen."""
    return [state for state in problem.states if state.role == "decision"]


def check_decisions(problem: Declarations) -> None:
    """Something must depend on each decision, and the cost must not fall for ever with one.

    Raises:
        ProblemError: where it does not, or where that can be said from its cost alone.
    """
    costs = list(problem.cost or ())
    others = _everything_but_costs(problem)
    for entry in decisions_of(problem):
        elsewhere = entries_used(others, entry.symbol)
        if names := unused_names(entry, elsewhere | entries_used(costs, entry.symbol)):
            raise ProblemError(
                f"Nothing depends on the decision {names} (declared at {entry.where}).",
                expected="its symbol in dynamics, noise, measurements, initial values or variances that count, "
                "costs or constraints",
                received="none of them contains it",
                remedy=f"use {names} where it acts, or remove it (a variance counts where "
                "estimation_covariance() or minimize_expected() makes it do so)",
            )
        _check_bounded(entry, costs, elsewhere)


def entries_used(expressions: list[Any], symbol: ca.MX) -> NDArray[np.bool_]:
    """For each entry of a symbol whether some expression depends on it."""
    used = [value for value in expressions if isinstance(value, ca.MX) and ca.depends_on(value, symbol)]
    if not used:
        return np.zeros(symbol.numel(), dtype=bool)
    return np.asarray(ca.which_depends(ca.veccat(*used), symbol, 1, False), dtype=bool)


def unused_names(entry: State, used: NDArray[np.bool_]) -> str:
    """What of a decision nothing depends on, as a message names it: the whole, or its entries; "" where all is used.

    No solver would move such an entry from the middle of its bounds, and a solution would show it as if chosen.
    """
    if used.all():
        return ""
    if not used.any():
        return f"'{entry.name}'"
    return " and ".join(f"'{entry.name}[{k}]'" for k in np.flatnonzero(~used))


def matters(problem: Declarations, symbol: ca.MX) -> bool:
    """Whether anything that is stated, costs included, depends on a symbol."""
    return _uses(stated(problem), symbol)


def stated(problem: Declarations) -> list[Any]:
    """All expressions of a problem that matter for its solution, costs included."""
    return [*_everything_but_costs(problem), *(problem.cost or ())]


def _everything_but_costs(problem: Declarations) -> list[Any]:
    """All expressions of a problem that matter for its solution, without its cost."""
    used: list[Any] = [value for rate in problem.rates.values() for value in (rate.rate, rate.noise)]
    used += [value for m in problem.measurements for value in (m.expression, m.noise, m.information)]
    used += [c.expression for c in problem.constraints]
    started: list[Any] = [*problem.states, *problem.matrices]
    used += [value for entry in started for value in (entry.initial, entry.final)]
    used += [value for m in problem.matrices if m.backward is not None for value in (m.backward.end, *m.backward.form)]
    return [value for value in used if isinstance(value, ca.MX)]


def _uses(expressions: list[Any], symbol: ca.MX) -> bool:
    return any(ca.depends_on(expression, symbol) for expression in expressions)


def _check_bounded(entry: State, costs: list[Any], elsewhere: NDArray[np.bool_]) -> None:
    """A cost that is linear in a decision, on which nothing else depends, falls without end where no bound stops it.

    Args:
        entry: the decision.
        costs: terminal and running cost.
        elsewhere: of its entries, whether something else depends on them.
    """
    slopes = [ca.jacobian(cost, entry.symbol) for cost in costs]
    if any(ca.symvar(slope) for slope in slopes):
        return
    values = [np.asarray(ca.evalf(ca.densify(slope)).full()).ravel() for slope in slopes]
    for k in np.flatnonzero(~elsewhere):
        own = [value[k] for value in values if value[k] != 0.0]
        sides = (("upper", entry.upper[k], -1.0), ("lower", entry.lower[k], 1.0))
        for side, bound, sign in sides:
            if own and all(value * sign > 0 for value in own) and not np.isfinite(bound):
                name = entry.name if entry.size == 1 else f"{entry.name}[{k}]"
                raise ProblemError(
                    f"The problem is unbounded: its cost falls without end as the decision '{name}' "
                    f"{'grows' if side == 'upper' else 'falls'}.",
                    expected=f"an {side} bound of '{name}'" if side == "upper" else f"a lower bound of '{name}'",
                    received=f"a cost that is linear in '{name}', no {side} bound, and nothing else depends on it",
                    remedy=f"give {side}= to decision('{entry.name}', ...), or say what else it costs",
                )


def check_matrix(name: str, problem_matrix: Matrix, decisions: list[State]) -> None:
    """A matrix with a positive lower bound cannot start at what decisions give: nothing would hold the bound there."""
    lower, initial = problem_matrix.lower, problem_matrix.initial
    if lower is not None and lower > 0 and initial is not None and _uses([initial], _stacked(decisions)):
        raise ProblemError(
            f"The initial value of '{name}' depends on a decision and has a lower bound.",
            expected="lower=0 or None where decisions give the initial value",
            received=f"lower={lower:g}",
            remedy="bound the decision instead: lower= of decision(), or subject_to(..., at='initial')",
        )


def _stacked(entries: list[State]) -> Any:
    return ca.vertcat(ca.MX(0, 1), *(entry.symbol for entry in entries))
