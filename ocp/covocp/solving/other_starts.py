"""Where a run from a solution fails by itself: it is left for other starts, which a run without a guess would have.

A plan for other values is a start like any other. It may lie where the method finds no way, and the problem's own start
where it does. A gain that is chosen freely starts from the best one along the plan: with that of other values long
steps of Runge and Kutta take Xhat below zero, where the cost falls without end, and Gauss steps from there may end at
gains of thousands which are right at the nodes alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from covocp.base.errors import CovocpError, SolveError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Outcome, Prepared
from covocp.problem.builder import Problem
from covocp.solution.solution import Solution
from covocp.solving.attempts import counted, rank, with_stats
from covocp.solving.classical_runs import ClassicalRuns
from covocp.solving.failure import passed_at_the_start, with_stalled
from covocp.solving.gain_start import GainStart, beyond, free_gain_block
from covocp.solving.methods import method_options
from covocp.solving.warm_start import Later
from covocp.statement.statement import Statement
from covocp.transcription.grading import graded
from covocp.transcription.instants import with_instants
from covocp.transcription.mesh import Options

if TYPE_CHECKING:
    from covocp.solving.other_ways import Way

# A run has lost its way after so many iterates in a row whose cost is below that of the first one by more than so many
# times its size, and which violate less than this (scaled): far below any optimum, and not on the way back to one.
LOST, TIMES, NEAR = 10, 10.0, 0.1
# Iterations of runs from the own start: what finds a way from there mostly takes fewer, and where the conditions
# contradict a run without a guess, with all that it tries, may take ten times as long as one that fails from a guess.
MOST_ITERATIONS = 300
ALONG, OWN = "the best gain along it", "the own start"

# An outcome, and the best gain's solution where one was made.
Found = tuple[Outcome, Solution | None]


class Falling(Progress):
    """A part of what is reported: a run whose cost falls far below where it began is given up.

    Args:
        within: of what it is a part.
    """

    def __init__(self, within: Progress) -> None:
        """Nothing is known of the cost before the first iterate."""
        super().__init__("", show=False, within=within)
        self._begun: float | None = None
        self._fallen = 0

    def update(self, iteration: int, cost: float, violation: float) -> None:
        """Report an iteration; arguments as of `Progress.update`."""
        self._begun = cost if self._begun is None else self._begun
        fallen = cost < self._begun - TIMES * abs(self._begun) and violation < NEAR
        self._fallen = self._fallen + 1 if fallen else 0
        super().update(iteration, cost, violation)

    @property
    def spent(self) -> str:
        """The limit that is reached, in words; "" where none is."""
        if self._begun is not None and self._fallen >= LOST:
            return f"a cost that has fallen far below the {self._begun:.4g} of the start"
        return super().spent


class OtherStarts(ClassicalRuns):
    """The part of a solver that runs again where a run failed: from another start, or another way."""

    _problem: Problem
    _asked: Options
    _ungraded: tuple[Statement, Options]
    _first: tuple[Options, Prepared]
    _remade: bool
    _looked: bool
    _otherwise: bool
    _ran: bool
    _values: Array

    def _laid_out(self) -> Options:
        raise NotImplementedError

    def _from_guess(
        self, values: Array, gain_start: GainStart, guess: Given, reporter: Progress, *, assess: bool
    ) -> Found:
        raise NotImplementedError

    def _from_given(
        self, values: Array, gain_start: GainStart, guess: Given, reporter: Progress, *, assess: bool
    ) -> Found:
        """Solve from a guess, from other starts where a solution leads nowhere; also the best gain's if one was made.

        Not where the user asked for so many iterations. Where limits were set what is left of them is the user's, but
        for a gain, whose other ways are limited by them.
        """
        outcome, first = self._from_guess(values, gain_start, guess, reporter, assess=assess)
        if self._counted or outcome.converged or reporter.stop:
            return outcome, first
        if passed_at_the_start(outcome) or (reporter.limited and not self._otherwise):
            return outcome, first
        if not isinstance(guess, Later | Solution):
            same = partial(self._from_guess, values, gain_start, guess, assess=assess)
            return self._anew(values, same, (outcome, first), reporter)
        from covocp.solution.report import OTHER_START

        outcome = with_stalled(outcome, reporter)  # of the iterations of this run, not of all together
        kept, looked = (self._options, self._prepared), self._looked
        for name, run in self._others(values, gain_start, guess, reporter, assess=assess):
            try:
                again = run()
            except SolveError:  # there is no solution
                raise
            except (CovocpError, RuntimeError):  # the model has no values there; CasADi's
                continue
            if again is None:
                continue
            both = counted(outcome, again[0])
            if again[0].converged:
                return with_stats(again[0], **both, **{OTHER_START: name}), again[1]
            chosen = min(outcome, again[0], key=rank) if reporter.stop else outcome
            outcome, self._at_once = with_stats(chosen, **both), False
            if reporter.stop:
                break
        if self._prepared is not kept[1]:
            self._keep(*kept)
            self._looked = looked
        own = partial(self._from_guess, values, gain_start, None, assess=assess)
        return self._anew(values, own, (outcome, first), reporter)

    def _anew(self, values: Array, run: Callable[..., Found], failed: Found, reporter: Progress) -> Found:
        """Solve with mesh and units that are made for these values, where those for others led nowhere.

        What is found so is what a solver would find that was made for them; it is kept for later runs.
        """
        if reporter.stop or reporter.limited or np.array_equal(values, self._values):
            return failed
        kept = self._options, self._prepared
        before = self._values, self._asked, self._looked, self._first
        again: Found | None = None
        try:
            self._values, self._looked, self._ran = values, False, False
            self._asked = with_instants(self.statement, graded(*self._ungraded, values), values)
            options = self._laid_out()
            self._keep(options, self._ready(options))
            self._first = self._options, self._prepared
            again = run(reporter=reporter)
        except SolveError:  # there is no solution
            raise
        except (CovocpError, RuntimeError):  # the model has no values there; CasADi's: what failed first is told
            return failed
        finally:
            if again is None or not again[0].converged:
                self._values, self._asked, self._looked, self._first = before
                self._keep(*kept)
        return (with_stats(again[0], **counted(failed[0], again[0])), again[1]) if again[0].converged else failed

    def _others(
        self, values: Array, gain_start: GainStart, guess: Later | Solution, reporter: Progress, *, assess: bool
    ) -> Iterator[tuple[str, Callable[[], Found | None]]]:
        """Other starts than a guess, by name, with what solves from there; that returns None where there is none."""

        def along() -> Found | None:
            first, start = gain_start(guess, reporter, along=True)
            if first is None:
                return None
            return self._from_guess(values, lambda *_, **__: (first, start), None, reporter, assess=assess)

        def own() -> Found:
            most = Progress("", show=False, iterations=MOST_ITERATIONS, within=reporter)
            return self._from_guess(values, gain_start, None, most, assess=assess)

        if self._otherwise:
            yield ALONG, along
        yield OWN, own

    def _otherwise_solved(self, failed: Outcome, best: Solution, near: Solution, reporter: Progress) -> Outcome:
        """Solved from the best gain by loosened limits of the spread, or from nearby another way; else as it failed.

        The way that finds a solution is that of later runs.
        """
        from covocp.solving.gain_ways import by_any_way

        given = (self._solved, self._options, self._ready, self._other_ways, failed, (best, near), reporter)
        outcome, kept = by_any_way(*given, further=not beyond(self._problem.declarations, best))
        if kept is not None:
            self._keep_way(*kept)
        return outcome

    def _by_other_steps(self, failed: Outcome, guess: Given, reporter: Progress) -> Outcome:
        """Solved by Gauss steps where a gain fails whose guess was no solution; else as it failed."""
        if free_gain_block(self._solved) is None:
            return failed
        from covocp.solving.other_ways import by_other_ways

        def ready(way: Way) -> Prepared:
            return self._ready(replace(self._options, **way.mesh), **way.own)

        ways = [way for way in self._other_ways() if way.mesh]
        outcome, kept = by_other_ways(failed, guess, ways, ready, reporter)
        if kept is not None:
            self._keep_way(*kept)
        return outcome

    def _other_ways(self) -> Iterator[Way]:
        """Those that are open."""
        from covocp.solving.other_ways import other_ways

        taken = method_options(self._by)
        return other_ways(self._solved, self._options, self._prepared.mesh, self._own, taken)

    def _keep_way(self, way: Way, prepared: Prepared) -> None:
        """Later runs begin this way, also on other meshes."""
        self._by, self._own = way.method or self._by, {**self._own, **way.own}
        self._ungraded = self._ungraded[0], replace(self._ungraded[1], **way.mesh)
        self._asked = replace(self._asked, **way.mesh)
        self._keep(replace(self._options, **way.mesh), prepared)
        self._first = (self._options, prepared) if self._remade else (replace(self._first[0], **way.mesh), prepared)
