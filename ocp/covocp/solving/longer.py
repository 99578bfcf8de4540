"""Where a run of a free duration ends with conditions that are not met: the guessed duration may be too short.

From a duration in which the controls cannot do what is asked, the slopes of what is missing may lead to no longer one:
at the end of a flight that overshoots it is later still that more is missing. From longer ones they do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from covocp.base.errors import CovocpError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Guess, Outcome, Prepared
from covocp.solving.attempts import counted, from_starts, with_stats
from covocp.solving.failure import passed_at_the_start, with_stalled
from covocp.solving.warm_start import make_guesses
from covocp.statement.statement import Duration, Statement

if TYPE_CHECKING:
    from covocp.extremal.links import ChainOutcome

# What a run says that has used up its iterations: nothing of the duration.
ITERATIONS = "largest number of iterations"
# The guessed duration is made so many times as long, as far as it may.
LONGER = (2.0, 4.0, 16.0)


def from_longer(
    failed: tuple[Outcome, Guess],
    prepared: Prepared,
    statement: Statement,
    values: Array,
    guess: Given,
    reporter: Progress,
) -> tuple[Outcome, Guess]:
    """Solve from longer durations where a run from the guessed one has failed with conditions that are not met.

    Not where its iterations or its time are limited, nor from a solution, nor where no duration will help.

    Args:
        failed: the outcome, and the start from which it came.
        prepared: what ran.
        statement: of the problem.
        values: of the parameters, (np,).
        guess: what was given as such.
        reporter: of iterations.

    Returns:
        The first that converges, with the iterations of all, and its start; else what was given.
    """
    outcome, start = failed
    if start.warm or not may_be_too_short(outcome, reporter) or passed_at_the_start(outcome):
        return failed
    outcome = tried = with_stalled(outcome, reporter)  # of the iterations of this run, not of all together
    named = guess if isinstance(guess, Mapping) else {}
    begun = replace(statement, duration=replace(statement.duration, guess=start.trajectory.duration))
    for duration in longer(begun.duration):
        if reporter.stop:
            break
        further = replace(begun, duration=replace(begun.duration, guess=duration))
        try:
            again, at = from_starts(prepared, values, make_guesses(further, prepared.mesh, values, named), reporter)
        except (CovocpError, RuntimeError):  # the model has no values there; CasADi's
            continue
        tried = with_stats(again, **counted(tried, again))
        if again.converged:
            return tried, at
    return with_stats(outcome, **{name: tried.stats[name] for name in counted(outcome, tried)}), start


def may_be_too_short(failed: Outcome | ChainOutcome, reporter: Progress) -> bool:
    """Whether a run ended, by itself and without limits, where conditions are not met."""
    ended = not failed.converged and ITERATIONS not in failed.message
    return ended and bool(failed.violations) and not reporter.limited and not reporter.stop


def longer(duration: Duration) -> list[float]:
    """Longer ones than the guess, up to the bound [s]; none where it is not free."""
    if not duration.free:
        return []
    return sorted({min(factor * duration.guess, duration.upper) for factor in LONGER} - {duration.guess})
