"""What a solver does with the classical design: its nominal, its cost, and what runs around it."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from covocp.base.errors import evaluating
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Outcome, Prepared
from covocp.extremal.mesh_error import OPTIMISED, finer_steps
from covocp.extremal.unseen import changes_within_steps
from covocp.solution.solution import Solution
from covocp.solving.around_nominal import closed_around
from covocp.solving.attempts import cost_of, counted, from_starts, with_stats
from covocp.solving.beside_classical import ClassicalDesign
from covocp.solving.continued import again_on, continued
from covocp.solving.from_classical import at_classical, from_classical, patiently
from covocp.solving.methods import method_options
from covocp.solving.warm_start import make_guesses
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Options

# Before a solution is called spurious, the run goes on from it with this share of its tolerance, or of the usual one.
CONTINUED = 1e-3
TOLERANCE = 1e-7


class ClassicalRuns:
    """The part of a solver that deals with the classical design, and with runs that are made again on shorter steps."""

    method: str
    nominal: str
    statement: Statement
    _solved: Statement
    _by: str
    _own: dict[str, Any]
    _options: Options
    _prepared: Prepared
    _classical: ClassicalDesign
    _own_steps: bool
    _counted: bool
    _patient: dict[str, Any]
    _at_once: bool
    _asked_for: bool
    _last: tuple[Array, Outcome] | None

    def _ready(
        self, options: Options, statement: Statement | None = None, by: str | None = None, **changed: Any
    ) -> Prepared:
        raise NotImplementedError

    def _suit(self, values: Array, *, nodes: bool) -> None:
        raise NotImplementedError

    def _keep(self, options: Options, prepared: Prepared) -> None:
        raise NotImplementedError

    def _from_classical(
        self, failed: Outcome, prepared: Prepared, values: Array, reporter: Progress
    ) -> tuple[Outcome, Prepared]:
        """From the nominal of the deterministic cost where a run failed; one that was given up soon at last goes on.

        Not where the user asked for so many iterations or digits, which that would not keep to.
        """
        if self.nominal != "combined" or not self.statement.behind or self._asked_for:
            return failed, prepared
        ready, nominal = partial(self._ready, self._options, **self._patient), partial(self._classical.nominal, values)
        if (told := self._at_classical(values, reporter, strict=False)) is not None:
            return with_stats(told, **{**failed.stats, **told.stats, **counted(failed, told)}), prepared
        outcome, prepared = from_classical(failed, prepared, ready, nominal, values, reporter)
        return patiently(outcome, prepared, ready, values, reporter) if self._patient else (outcome, prepared)

    def _at_classical(self, values: Array, reporter: Progress, *, strict: bool = True) -> Outcome | None:
        """The nominal of the deterministic cost where it is the optimum for certain; None where a run must tell.

        A run must where it is limited: that one knows no limits.
        """
        self._at_once = False
        if not self._patient or reporter.limited or reporter.stop:
            return None
        try:
            nominal = self._classical.nominal(values)
        except KeyboardInterrupt:  # the run, which ends as soon as it begins, has an iterate to carry
            reporter.asked = True
            return None
        found = at_classical(self.statement, self._prepared.mesh, nominal, values, strict=strict)
        self._at_once = found is not None and not reporter.stop
        return found if self._at_once else None

    def _beside_classical(self, solution: Solution, values: Array) -> Solution:
        """The solution with the cost of the classical design beside it; a worse one is a spurious stationary point."""
        if self.nominal != "combined" or not self.statement.behind or not solution.converged:
            return solution
        given = values[: self.statement.np]
        return self._classical.beside(solution, self._prepared.mesh, given, partial(self._continued, given))

    def _continued(self, values: Array, solution: Solution) -> Solution:
        """The solution after going on from it with a smaller tolerance, where that makes it better."""
        tolerance = self._own.get("tolerance") or method_options(self.method).get("tolerance") or TOLERANCE
        again = partial(self._ready, self._options, tolerance=CONTINUED * tolerance)
        return continued(again, self._solved, values, solution, self._by)

    def _nominal_of_values(self, values: Array) -> Outcome:
        """The outcome without what is looked at after a run, for stacked parameters; the last one is remembered."""
        with evaluating(self.statement.name), Progress("", show=False) as reporter:
            if self._last is None or not np.array_equal(self._last[0], values):
                self._suit(values, nodes=False)
                guesses = make_guesses(self._solved, self._prepared.mesh, values, None)
                self._last = values, from_starts(self._prepared, values, guesses, reporter)[0]
            if reporter.stop:
                self._last = None
                raise KeyboardInterrupt
            return self._last[1]

    def _cost_of_values(self, values: Array) -> tuple[float, str]:
        """Cost of the classical design for stacked parameters, and why there is none."""
        outcome = self._nominal_of_values(values)
        with evaluating(self.statement.name), Progress("", show=False) as reporter:
            outcome = self._closed(outcome, values, reporter)
            if reporter.stop:
                raise KeyboardInterrupt
        if outcome.converged:
            return cost_of(outcome), ""
        return np.nan, f"The problem without noise was not solved: {outcome.message}."

    def _with_finer_steps(self, outcome: Outcome, values: Array, reporter: Progress) -> Outcome:
        """Solved again from there where the default steps are too long for what is at the nodes; so are later runs.

        A run that fails may have missed what changes within the steps: of a disturbance of which they see nothing no
        more than roundoff is left to minimise.
        """
        while self._own_steps and not reporter.stop:
            finer = self._finer_for(outcome)
            if finer is None:
                break
            again = self._at_once_by(finer, outcome, values, reporter)
            again = self._again_by(finer, outcome, values, reporter) if again is None else again
            if again is None:
                break
            outcome = again
        return outcome

    def _finer_for(self, outcome: Outcome) -> Options | None:
        """Options with the shorter steps that an outcome needs, a failed one where the model is faster than these."""
        made = partial(finer_steps, outcome.extremal, self._options, OPTIMISED, outcome.cost_terms["running"])
        if outcome.converged:
            return made()
        try:
            return made() if not self._counted and changes_within_steps(outcome.extremal) else None
        except (RuntimeError, ArithmeticError, np.linalg.LinAlgError):  # there are no values where it ended
            return None

    def _at_once_by(self, finer: Options, outcome: Outcome, values: Array, reporter: Progress) -> Outcome | None:
        """What was found from the deterministic cost at once, by shorter steps; None where a run must tell."""
        if not self._at_once:
            return None
        before = self._options, self._prepared
        self._keep(finer, self._ready(finer))
        again = self._at_classical(values, reporter, strict=False)
        if again is None:
            self._keep(*before)
            return None
        return with_stats(again, **{**outcome.stats, **again.stats, **counted(outcome, again)})

    def _again_by(self, finer: Options, outcome: Outcome, values: Array, reporter: Progress) -> Outcome | None:
        """An outcome by shorter steps, which later runs take then; None where that fails."""
        found = again_on(partial(self._ready, finer), self._solved, values, outcome, self._by, reporter)
        if found is None:
            return None
        again, prepared = found
        self._keep(finer, prepared)
        return with_stats(again, **{**outcome.stats, **again.stats, **counted(outcome, again)})

    def _closed(self, outcome: Outcome, values: Array, reporter: Progress) -> Outcome:
        """Filter and feedback around the nominal of the deterministic cost."""
        again = partial(self._again_by, outcome=outcome, values=values, reporter=reporter)
        return closed_around(outcome, self.statement, self._options, own_steps=self._own_steps, again=again)
