"""Where a free duration ended at one of its limits: what would be learnt in the time that was guessed comes first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from covocp.base.errors import CovocpError
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Guess, Outcome, Prepared
from covocp.solution.solution import Solution
from covocp.solving.attempts import cost_of, counted, from_starts, with_stats
from covocp.solving.warm_start import make_guess, make_guesses
from covocp.statement.statement import Duration, Statement

# A duration is at a limit up to this share of it.
AT_LIMIT = 1e-4


def off_the_limit(
    ready: Callable[[Statement], Prepared],
    prepared: Prepared,
    outcome: Outcome,
    values: Array,
    reporter: Progress,
    start: Guess,
) -> Outcome:
    """The outcome, or a cheaper one with the duration guessed first, then free, where it had gone to a limit.

    In a short time nothing is learnt, whatever the controls do, and none of their slopes leads away from there.

    Args:
        ready: makes a program for another statement.
        prepared: what ran.
        outcome: of it.
        values: of the parameters.
        reporter: of iterations.
        start: of the run.
    """
    st, duration = outcome.extremal.statement, outcome.extremal.trajectory.duration
    own = st.duration
    near = min(abs(duration - own.lower), abs(own.upper - duration)) <= AT_LIMIT * abs(duration)
    if start.warm or reporter.stop or not (st.matrices and own.free and near and outcome.converged):
        return outcome
    if abs(own.guess - duration) <= AT_LIMIT * abs(duration):
        return outcome
    held = replace(st, duration=Duration(guess=own.guess, lower=own.guess, upper=own.guess))
    try:
        other = ready(held)
        first, _ = from_starts(other, values, make_guesses(held, other.mesh, values, None), reporter)
        if reporter.stop or not first.converged:
            return outcome
        plan = Solution.of(first, "ipopt", assess=False)
        guess = replace(make_guess(st, prepared.mesh, values, plan), warm=False, multipliers=None, costates=None)
        again = prepared.solve(values, guess, reporter)
    except (CovocpError, RuntimeError):  # what was found stays
        return outcome
    if not again.converged or not cost_of(again) < cost_of(outcome):
        return outcome
    return with_stats(again, **counted(outcome, with_stats(again, **counted(first, again))))
