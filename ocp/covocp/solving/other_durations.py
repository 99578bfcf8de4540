"""Other durations of what learns, compared on a coarse mesh: with a free duration it has many minima.

How often an experiment swings, or on which side of a beacon a vehicle turns, changes with the time it has, and each
such way is a minimum of its own in the duration too: a solver that starts from a guess ends at the nearest one, which
may cost three times the best. So from what was found shorter and longer ones are tried, each by the start that the
problem would have had with that guess; further ones around what is cheaper.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from covocp.base.errors import CovocpError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Guess, Outcome, Prepared
from covocp.solving.attempts import cost_of, counted, from_starts, with_stats
from covocp.solving.excitations import PATIENT, WORTH, excited, made_coarse, may_be_left, part, run_from
from covocp.solving.other_minima import CHEAPER
from covocp.solving.warm_start import make_guesses
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Options
from covocp.transcription.mirrored import learns
from covocp.transcription.steering import resampled

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


def of_other_duration(
    found: tuple[Outcome, Guess],
    prepared: Prepared,
    statement: Statement,
    options: Options,
    ready: Callable[..., Prepared],
    guess: Given,
    reporter: Progress,
    slow: bool = False,
) -> tuple[Outcome, Guess]:
    """The cheaper minimum of another duration, where a problem that learns in a free duration has one.

    Not where iterations or time are limited, nor where a guess says how the controls move.

    Args:
        found: the outcome, and the start from which it came.
        prepared: what ran.
        statement: of the problem.
        options: of its mesh.
        ready: makes the problem ready on the mesh of other `options`, by Ipopt.
        guess: what was given as such.
        reporter: of iterations.
        slow: whether the method that ran takes much longer than Ipopt.

    Returns:
        The outcome of the cheaper minimum with the iterations of both runs, and its start; else what was given.
    """
    outcome = found[0]
    if not may_be_left(found, statement, guess, reporter) or not _may_have(statement):
        return found
    coarse = made_coarse(outcome, prepared, statement, options, ready, slow)
    if coarse is None:
        return found
    best = _cheapest(statement, coarse, outcome, guess, reporter)
    if best is None:
        return found
    u = resampled(best.extremal.trajectory.u, coarse.mesh, prepared.mesh)
    values = outcome.extremal.parameters
    again = run_from(prepared, values, excited(statement, prepared.mesh, best, u), reporter)
    if again is None or not again[0].converged:
        return found
    other, at = again
    if cost_of(other) >= cost_of(outcome) - CHEAPER * abs(cost_of(outcome)):
        return found
    return with_stats(other, **counted(outcome, other), left_duration=outcome.extremal.trajectory.duration), at


def _may_have(statement: Statement) -> bool:
    """Whether the duration is free, and what is learnt on the way is worth something."""
    plain = statement.loop is None and not statement.behind and not statement.coupled
    return statement.duration.free and plain and learns(statement, linked=False)


def _cheapest(
    statement: Statement, coarse: Prepared, outcome: Outcome, guess: Given, reporter: Progress
) -> Outcome | None:
    """What is cheaper on the coarse mesh than the found one, the cheapest that was met; None: nothing."""
    values, mesh = outcome.extremal.parameters, coarse.mesh
    own = resampled(outcome.extremal.trajectory.u, outcome.extremal.mesh, mesh)
    base = run_from(coarse, values, excited(statement, mesh, outcome, own), part(reporter, PATIENT))
    if base is None or not base[0].converged:
        return None
    best = first = base[0]
    begun, ended = [statement.duration.guess], [first.extremal.trajectory.duration]
    middle, near = [*ended, *begun], False
    sure = SURE if _within(statement, ended[0]) else 0
    runs = back = 0
    for _ in range(ROUNDS):
        before = best
        for duration in _others(statement, middle, NEAR if near else FAR, (begun, ended)):
            if reporter.stop:
                return None
            begun.append(duration)
            run = _run(statement, coarse, values, duration, guess, reporter)
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


def _within(statement: Statement, duration: float) -> bool:
    """Whether a duration is no limit of it: from there nothing is learnt, and much may be further away."""
    lower, upper = statement.duration.lower, statement.duration.upper
    return duration > (1.0 + SAME) * lower and (1.0 + SAME) * duration < upper


def _run(
    statement: Statement, coarse: Prepared, values: Array, duration: float, guess: Given, reporter: Progress
) -> Outcome | None:
    """What is found where this duration is guessed; None where the model has no values there."""
    further = replace(statement, duration=replace(statement.duration, guess=duration))
    try:
        starts = make_guesses(further, coarse.mesh, values, guess)
        return from_starts(coarse, values, starts, part(reporter, MOST_ITERATIONS))[0]
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved: others may be
        return None


def _others(
    statement: Statement, middle: list[float], factors: tuple[float, ...], tried: tuple[list[float], list[float]]
) -> Iterator[float]:
    """Durations beside some, within its limits, where no run began (first list) or ended (second) [s]."""
    begun, ended = tried
    for factor in factors:
        for duration in middle:
            other = min(max(factor * duration, statement.duration.lower), statement.duration.upper)
            new = all(abs(other - one) > SAME * one for one in begun)
            if new and all(abs(other - one) > ENDS * one for one in ended):
                yield other
