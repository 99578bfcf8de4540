"""From starts to an outcome: one start after the other until the method finds its way, or the best of many."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from covocp.base.errors import Interrupted, OutsideDomainError, warn_user
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Guess, Outcome, Prepared
from covocp.extremal.links import ChainOutcome
from covocp.solution.phases import PhasesSolution
from covocp.solution.solution import Solution

AnyOutcome = Outcome | ChainOutcome
Found = TypeVar("Found", Outcome, Solution)
# Starts that are tried where a method loses its way.
TRIED = 4


def from_starts(
    prepared: Prepared, values: Array, guesses: Iterable[Guess], reporter: Progress
) -> tuple[Outcome, Guess]:
    """Solve from the first start from which the method finds its way.

    A method that loses its way (`wandered` among its counts) is stopped while other starts are left. Where it does from
    all of them, the first run counts: it is made again, and not stopped, where it was stopped. Where a run fails from a
    start that a feedback holds, there is another one that is left to itself. Of rivals, which come first, the cheapest
    outcome counts.

    Returns:
        The outcome, and the start from which it came.

    Raises:
        OutsideDomainError: no start lies within the domain of the model (says what the first one lacks).
    """
    tried: list[tuple[Outcome, Guess]] = []
    refused: list[OutsideDomainError] = []
    best: tuple[Outcome, Guess] | None = None
    others = 0
    for guess in guesses:
        others += not guess.rival
        if others > TRIED or (best is not None and others):
            break
        try:
            outcome = prepared.solve(values, replace(guess, tentative=not guess.warm), reporter)
        except OutsideDomainError as error:
            refused.append(error)
            continue
        tried.append((outcome, guess))
        if outcome.converged and guess.rival and not reporter.stop:
            best = min(best or tried[-1], tried[-1], key=lambda one: cost_of(one[0]))
        elif reporter.stop or (not guess.rival and (outcome.converged or not _goes_on(outcome, guess))):
            break
    if best is not None:
        return _with_all(best[0], [one for one, _ in tried]), best[1]
    if not tried:
        raise refused[0]
    outcome, guess = tried[-1]
    if not outcome.converged and tried[0][1].held and not tried[0][0].stats.get("wandered"):
        outcome, guess = tried[0]
    elif not outcome.converged and outcome.stats.get("wandered") and not reporter.stop:
        guess = tried[0][1]
        outcome = prepared.solve(values, guess, reporter)
    if len(tried) > 1:
        outcome = replace(outcome, stats={**outcome.stats, "tried": len(tried)})
    return outcome, guess


def _goes_on(outcome: Outcome, guess: Guess) -> bool:
    """Whether a run that failed says little of those from other starts."""
    return bool(outcome.stats.get("wandered")) or guess.held


def _with_all(best: Outcome, outcomes: list[Outcome]) -> Outcome:
    """The best outcome with the iterations and times of all runs."""
    if len(outcomes) == 1:
        return best
    names = [name for name in ("iterations", "solve_seconds") if name in best.stats]
    return with_stats(best, tried=len(outcomes), **{name: sum(one.stats[name] for one in outcomes) for name in names})


def mention_left(error: OutsideDomainError) -> None:
    """Warn that the solution given as a guess was left for the problem's own start."""
    problem = str(error).splitlines()[0]
    warn_user(f"The solution that was given is no guess for these values, so the own start was taken: {problem}")


def best_of(prepared: Any, values: Any, guesses: Iterable[Any], count: int, reporter: Progress) -> Any:
    """The cheapest converged outcome of several starts, with the costs of all of them (NaN: did not converge).

    Of one problem, or of several phases: then parameters and guesses are tuples, one for each.

    A start outside the domain of the model counts as one that did not converge.

    Raises:
        OutsideDomainError: all of them lie outside it (says what the first one lacks).
    """
    best: Any = None
    stopped: tuple[int, Any] | None = None
    refused: list[OutsideDomainError] = []
    costs: list[float] = []
    for guess in guesses:
        try:
            outcome = prepared.solve(values, _tentative(guess), reporter)
        except OutsideDomainError as error:
            refused.append(error)
            costs.append(np.nan)
            continue
        cost = cost_of(outcome)
        costs.append(cost if outcome.converged else np.nan)
        if best is None or (outcome.converged, -cost) > (best.converged, -cost_of(best)):
            best = outcome
        if stopped is None and outcome.stats.get("wandered"):
            stopped = len(costs) - 1, guess
        if reporter.stop:
            break
    if best is None:
        raise refused[0]
    if not best.converged and stopped is not None and not reporter.stop:
        place, guess = stopped
        best = prepared.solve(values, guess, reporter)
        costs[place] = cost_of(best) if best.converged else np.nan
    return replace(best, stats={**best.stats, "starts": costs, "asked": count})


def _tentative(guess: Guess | tuple[Guess, ...]) -> Any:
    """A guess, or one for each phase, from which a method need not find its way."""
    if isinstance(guess, Guess):
        return replace(guess, tentative=True)
    return tuple(replace(own, tentative=True) for own in guess)


def cost_of(outcome: Outcome | ChainOutcome) -> float:
    """All terms together."""
    return outcome.cost if isinstance(outcome, ChainOutcome) else float(sum(outcome.cost_terms.values()))


def rank(outcome: Outcome) -> tuple[float, float]:
    """Less is better: what meets the conditions by its cost, anything else by what it violates."""
    numbers = max(outcome.violations.values(), default=0.0), cost_of(outcome)
    violation, cost = (number if np.isfinite(number) else np.inf for number in numbers)
    return violation, cost


def counted(first: AnyOutcome | Solution, second: AnyOutcome) -> dict[str, Any]:
    """Iterations and times of two runs together."""
    names = ("iterations", "build_seconds", "solve_seconds")
    both = [name for name in names if name in first.stats and name in second.stats]
    return {name: first.stats[name] + second.stats[name] for name in both}


def with_stats(found: Found, /, **stats: Any) -> Found:
    """An outcome, or a solution, with more that is told of it."""
    return replace(found, stats={**found.stats, **stats})


def interrupted(solution: Solution | PhasesSolution) -> Interrupted:
    """What a run ends with that Ctrl-C stopped: it carries what was found until then."""
    starts = solution.stats.get("starts")
    if starts is None:
        found = "the last iterate" if not solution.converged else "a solution"
    else:
        found = f"the best of {len(starts)} of {solution.stats['asked']} starts"
        found += "" if solution.converged else ", of which none converged"
    return Interrupted(f"Interrupted. On this error (.solution): {found}.", solution=solution)  # type: ignore[arg-type]
