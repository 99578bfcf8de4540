"""Runs that go on from where one ended: on shorter steps, or to a smaller tolerance."""

from __future__ import annotations

from collections.abc import Callable

from covocp.base.errors import CovocpError, Interrupted
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Outcome, Prepared
from covocp.solution.solution import Solution
from covocp.solving.attempts import counted, with_stats
from covocp.solving.other_minima import away_from_saddle
from covocp.solving.warm_start import make_guess
from covocp.statement.statement import Statement


def again_on(
    ready: Callable[[], Prepared], statement: Statement, values: Array, outcome: Outcome, by: str, reporter: Progress
) -> tuple[Outcome, Prepared] | None:
    """A run from an outcome on what is made ready, and that; None where it fails: the outcome is what there is.

    What the first one did not see may make a saddle of where it ended.

    Args:
        ready: makes the problem ready, on other steps.
        statement: of the problem.
        values: of its parameters.
        outcome: where the run starts.
        by: the method that found it.
        reporter: of the call.
    """
    try:
        prepared = ready()
        coarse = Solution.of(outcome, by, assess=False)
        start = make_guess(statement, prepared.mesh, values, coarse)
        again = prepared.solve(values, start, reporter)
    except (CovocpError, RuntimeError):  # what the steps are off is told with the solution that there is
        return None
    return (away_from_saddle(prepared, again, values, reporter, start), prepared) if again.converged else None


def continued(
    ready: Callable[[], Prepared], statement: Statement, values: Array, solution: Solution, by: str
) -> Solution:
    """The solution after going on from it, where that makes it better; arguments as of `again_on`.

    Raises:
        Interrupted: with the solution that there was.
    """
    try:
        prepared = ready()
        with Progress("", show=False) as reporter:
            outcome = prepared.solve(values, make_guess(statement, prepared.mesh, values, solution), reporter)
    except (CovocpError, RuntimeError):  # a plugin that has no tolerance; CasADi's, of a step that cannot be solved
        return solution
    if reporter.stop:
        message = "Interrupted while the solution was made more exact. On this error (.solution): a solution."
        raise Interrupted(message, solution=solution)
    if not outcome.converged or not sum(outcome.cost_terms.values()) < solution.cost:
        return solution
    return with_stats(Solution.of(outcome, by), **{**solution.stats, **counted(solution, outcome)})
