"""Other ways to a gain that is chosen freely, where steps of Runge and Kutta with exact second derivatives lead astray.

Where the estimate scatters little, as at the start, a gain counts for next to nothing, and a run may creep along it.
Far out classical Runge-Kutta steps take Xhat below zero, and the cost falls without end: of an optimum that the start
all but is, a run finds none, however many iterations it has. Gauss steps keep Xhat semidefinite, and an approximate
Hessian is positive definite, so that nothing looks as if it led there. Both have the optimum that is meant; Gauss steps
find it in the fewest iterations.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from covocp.base.errors import CovocpError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Outcome, Prepared
from covocp.solution.report import OTHERWISE
from covocp.solving.attempts import counted, rank, with_stats
from covocp.solving.from_best_gain import part
from covocp.solving.warm_start import make_guess
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.stiffness import stiffness

# Iterations with other steps: what finds a way by them mostly takes fewer, and each takes long.
MOST_ITERATIONS = 150
# Logarithm of what grows in an interval above which its length is the likely reason of a failure, and what is borne:
# of a double integrator with a spring that pushes exp(10) to an interval is solved, exp(20) is not.
MOST_GROWN, GROWN = 15.0, 8.0
STEPS: dict[str, Any] = {"covariance_step": "gauss"}
HESSIAN: dict[str, Any] = {"hessian": "limited-memory"}
STEPS_IN_WORDS = "covariance_step='gauss'"


class Way(NamedTuple):
    """How else a problem is made ready: what to write for it, the method, other options of the mesh and of the method.

    The method is None where it is the one that was asked for.
    """

    words: str
    method: str | None
    mesh: dict[str, Any]
    own: dict[str, Any]


def other_ways(
    statement: Statement, options: Options, mesh: Mesh, own: Mapping[str, Any], taken: Container[str]
) -> Iterator[Way]:
    """Ways that the user left open, the most robust one first.

    Args:
        statement: the problem.
        options: of the run that failed.
        mesh: likewise.
        own: options of the method that were given.
        taken: names of those that the method takes; "auto", which lets Ipopt run where a gain is free, has fewer.
    """
    if options.covariance_step == "auto" and mesh.step == "rk4" and statement.riccati_forms:
        yield Way(STEPS_IN_WORDS, None, STEPS, {})
    if own.get("hessian", "auto") == "auto" and not mesh.eliminated:
        if "hessian" in taken:
            yield Way("hessian='limited-memory'", None, {}, HESSIAN)
        else:
            yield Way("method='ipopt' with hessian='limited-memory'", "ipopt", {}, HESSIAN)


def by_other_ways(
    failed: Outcome, near: Given, ways: Iterable[Way], ready: Callable[[Way], Prepared], reporter: Progress
) -> tuple[Outcome, tuple[Way, Prepared] | None]:
    """The outcome of the first way that finds one, and the way made ready; else as it failed, and None.

    Where a limit ends a way, or the user does, it is not known whether it would have found one: of both outcomes the
    better one counts then.

    Args:
        failed: the run before.
        near: where to start, as that run did: a solution or a guess.
        ways: to try.
        ready: makes the problem ready that way.
        reporter: of iterations.
    """
    tried: list[str] = []
    for way in ways:
        if reporter.stop:
            break
        try:
            prepared = ready(way)
            start = make_guess(failed.extremal.statement, prepared.mesh, failed.extremal.parameters, near)
            most = part(reporter, MOST_ITERATIONS if way.mesh else None, near, floor=False)
            found = prepared.solve(failed.extremal.parameters, start, most)
        except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved; another way may apply
            tried.append(way.words)
            continue
        both = counted(failed, found) | ({"method": way.method} if way.method else {})
        if found.converged:
            return with_stats(found, **both, **{OTHERWISE: way.words}), (way, prepared)
        if reporter.stop:
            failed = with_stats(min(failed, found, key=rank), **both)
            break
        tried.append(way.words)
        failed = with_stats(failed, **counted(failed, found))
    return (with_stats(failed, **{OTHERWISE: " and ".join(tried)}) if tried else failed), None


def other_covariances(statement: Statement, options: Options, mesh: Mesh) -> str:
    """A line for a run that failed, of the formulation of the covariances that it did not take; "" where none is open.

    Whether they are variables is chosen by their size; what a run finds no way to in one it may find in the other.
    """
    if options.covariances != "auto" or not statement.riccati_forms or not statement.matrices:
        return ""
    other = "states" if mesh.eliminated else "eliminated"
    return f"\n  covariances='{other}' may find a way: this run took '{'eliminated' if mesh.eliminated else 'states'}'."


def long_intervals(statement: Statement, options: Options, parameters: Array) -> str:
    """A line for a run that failed where what grows does so beyond all numbers in an interval; "" where nothing does.

    Args:
        statement: the problem.
        options: of the mesh.
        parameters: values (np,).
    """
    try:
        growing = stiffness(statement, options, parameters).growing
    except CovocpError:  # where it starts there is no rate
        return ""
    if not MOST_GROWN < growing < np.inf:
        return ""
    count = int(np.ceil((options.nodes().size - 1) * growing / GROWN))
    return (
        f"\n  What grows fastest at the start is exp({growing:.0f}) times larger after an interval, more than numbers "
        f"can tell: give intervals={count} or more."
    )


def told_ways(tried: str, left: Iterable[Way]) -> str:
    """A line for a run that failed: what was tried in vain, or what may find a way; "" where there is nothing.

    Args:
        tried: in words; "": nothing.
        left: what there is to try.
    """
    if tried:
        return f"\n  From the same start {tried} found nothing either."
    listed = " or ".join(way.words for way in left)
    if not listed:
        return ""
    return f"\n  {listed} may find a way: the gain is free, and counts for next to nothing in places."
