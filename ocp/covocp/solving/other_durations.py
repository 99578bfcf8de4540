"""Other durations of what learns or is fed back, compared on a coarse mesh: with a free duration it has many minima.

How often an experiment swings, or on which side of a beacon a vehicle turns, changes with the time it has, and each
such way is a minimum of its own in the duration too: a solver that starts from a guess ends at the nearest one, which
may cost three times the best. So from what was found shorter and longer ones are tried, each by the start that the
problem would have had with that guess; further ones around what is cheaper.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from covocp.base.errors import CovocpError
from covocp.extremal.extremal import Outcome, Prepared
from covocp.solving.attempts import cost_of, from_starts
from covocp.solving.coarse_search import WORTH, Found, Search, made_coarse, may_be_left, part, solved_finely
from covocp.solving.warm_start import make_guesses
from covocp.statement.statement import Duration, Statement
from covocp.transcription.mirrored import learns

# Durations that are tried beside one: so many times as long; where none of these is better, nearer ones.
FAR, NEAR = (0.5, 2.0, 0.75, 1.5, 3.0), (0.8, 1.25)
# After so many runs that have all led back to what was found, which is no limit, there is no other one.
SURE = 4
# Share of the cost up to which two minima are the same.
AGAIN = 1e-5
# Runs from two that differ by less than this share lead to the same; what was found ends there up to the second one.
SAME, ENDS = 0.15, 0.05
# Times that others are tried around the cheapest, and iterations of a run.
ROUNDS, MOST_ITERATIONS = 6, 60


def of_other_duration(search: Search, found: Found) -> Found:
    """The cheaper minimum of another duration, where a problem that learns, or a loop, has one in a free duration.

    Args:
        search: what is at hand.
        found: the outcome, and the start from which it came.

    Returns:
        The outcome of the cheaper minimum with the iterations of both runs, and its start; else what was given.
    """
    if not _may_have(search.statement) or not may_be_left(search, found):
        return found
    compared = made_coarse(search, found[0])
    best = None if compared is None else _cheapest(search, *compared)
    if compared is None or best is None:
        return found
    told = {"left_duration": found[0].extremal.trajectory.duration}
    return solved_finely(search, found, best.extremal.trajectory, compared[0].mesh, told) or found


def _may_have(statement: Statement) -> bool:
    """Whether the duration is free, and a feedback or what is learnt on the way is worth something."""
    return (
        statement.duration.free
        and not statement.coupled
        and (statement.loop is not None or learns(statement, linked=False))
    )


def _cheapest(search: Search, coarse: Prepared, first: Outcome) -> Outcome | None:
    """The cheapest minimum that is met on the coarse mesh, if cheaper than the found one is there (`first`)."""
    limits = search.statement.duration
    best, ends_at = first, first.extremal.trajectory.duration
    begun, ended = [limits.guess], [ends_at]
    middle, near = [*ended, *begun], False
    sure = SURE if _within(limits, ends_at) else 0
    runs = back = 0
    for _ in range(ROUNDS):
        before = best
        for duration in _others(limits, middle, NEAR if near else FAR, (begun, ended)):
            if search.reporter.stop:
                return None
            begun.append(duration)
            run = _from_guessed(search, coarse, first, duration)
            if run is not None and run.converged:
                ended.append(run.extremal.trajectory.duration)
                best = run if cost_of(run) < cost_of(best) - WORTH * abs(cost_of(best)) else best
                back += abs(cost_of(run) - cost_of(first)) <= AGAIN * abs(cost_of(first))
            runs += 1
            if back == runs == sure:
                return None
        if best is before and near:
            break
        middle, near = [best.extremal.trajectory.duration], best is before
    return None if best is first else best


def _within(limits: Duration, duration: float) -> bool:
    """Whether a duration is at no limit: from there nothing is learnt, and much may be further away."""
    return duration > (1.0 + SAME) * limits.lower and (1.0 + SAME) * duration < limits.upper


def _from_guessed(search: Search, coarse: Prepared, first: Outcome, duration: float) -> Outcome | None:
    """What is found where this duration is guessed [s]; None where the model has no values there."""
    values, statement = first.extremal.parameters, search.statement
    further = replace(statement, duration=replace(statement.duration, guess=duration))
    try:
        starts = make_guesses(further, coarse.mesh, values, search.guess)
        return from_starts(coarse, values, starts, part(search.reporter, MOST_ITERATIONS))[0]
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved: others may be
        return None


def _others(
    limits: Duration, middle: list[float], factors: tuple[float, ...], tried: tuple[list[float], list[float]]
) -> Iterator[float]:
    """Durations beside some, within the limits, where no run began (first list) or ended (second) [s]."""
    begun, ended = tried
    for factor in factors:
        for duration in middle:
            other = min(max(factor * duration, limits.lower), limits.upper)
            new = all(abs(other - one) > SAME * one for one in begun)
            if new and all(abs(other - one) > ENDS * one for one in ended):
                yield other
