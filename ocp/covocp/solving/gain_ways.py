"""Other ways where the first run of a gain that is optimised fails: loosened limits, other steps, and both."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from covocp.base.progress import Progress
from covocp.extremal.extremal import Outcome, Prepared
from covocp.solution.report import OTHERWISE
from covocp.solution.solution import Solution
from covocp.solving.attempts import with_stats
from covocp.solving.loosened import tightened
from covocp.solving.other_ways import Way, by_other_ways
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Options

# (options, another statement like it, another method, **other options of it) -> made ready.
Ready = Callable[..., Prepared]
# The way that found a solution, and that made ready.
Kept = tuple[Way, Prepared] | None


def by_any_way(
    statement: Statement,
    options: Options,
    ready: Ready,
    ways: Callable[[], Iterator[Way]],
    failed: Outcome,
    starts: tuple[Solution, Solution],
    reporter: Progress,
    *,
    further: bool,
) -> tuple[Outcome, Kept]:
    """Solved from the best gain by loosened limits of the spread, or from nearby another way; else as it failed.

    Args:
        statement: the problem.
        options: of its mesh.
        ready: makes it ready.
        ways: those that are open.
        failed: the outcome without them.
        starts: the solution with the best gain, and what is nearest.
        reporter: of iterations.
        further: whether another way than loosened limits may change anything.

    Returns:
        The outcome, and the way of later runs where another one found it.
    """
    best, near = starts

    def loosened(other: Statement, most: int) -> Prepared:
        return ready(options, other, max_iterations=most)

    def by(way: Way) -> Prepared:
        return ready(replace(options, **way.mesh), by=way.method, **way.own)

    outcome = tightened(statement, failed, best, loosened, reporter)
    if outcome.converged or not further:
        return outcome, None
    outcome, kept = by_other_ways(outcome, near, ways(), by, reporter)
    if kept is None and not reporter.stop and (way := next((way for way in ways() if way.mesh), None)):
        return _tightened_by(way, statement, options, ready, outcome, best, reporter)
    return outcome, kept


def _tightened_by(
    way: Way,
    statement: Statement,
    options: Options,
    ready: Ready,
    failed: Outcome,
    best: Solution,
    reporter: Progress,
) -> tuple[Outcome, Kept]:
    """The outcome by loosened limits with the steps of another way, and that way made ready; else None."""
    options, tried = replace(options, **way.mesh), failed.stats.get(OTHERWISE)

    def loosened(other: Statement, most: int) -> Prepared:
        return ready(options, other, max_iterations=most)

    prepared = ready(options)
    outcome = tightened(statement, failed, best, loosened, reporter, prepared.mesh)
    if not outcome.converged:
        return (with_stats(outcome, **{OTHERWISE: tried}) if tried else outcome), None
    return with_stats(outcome, **{OTHERWISE: way.words}), (way, prepared)
