"""Solving from elsewhere: other initial values, covariances, means and durations, of a problem that is built once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.arguments import checked, is_number
from covocp.base.checks import check_kind, check_positive
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.short_repr import short_repr
from covocp.problem.builder import Problem
from covocp.problem.checks import find_name
from covocp.problem.data import check_data_cover
from covocp.problem.declarations import Declarations
from covocp.solution.solution import Solution
from covocp.solving.warm_start import Later
from covocp.statement.names import stacked_parameters
from covocp.statement.statement import Statement

if TYPE_CHECKING:
    from covocp.problem.restart import Start
    from covocp.solving.solver import Solver

# Solvers of other durations that are kept.
KEPT = 4


@checked()
def movable(problem: Problem) -> Problem:
    """The same problem with its start as parameters, "initial_<name>": what `Solver.solve(initial=)` solves.

    Files of such solutions are loaded with it; the duration is no parameter: what was solved with `duration=` is loaded
    with that of the problem stated with that duration. A start that depends on other parameters has its declared value
    here.

    Args:
        problem: whose known initial values of states and matrices become parameters.

    Returns:
        A problem of its own; what is declared later in the other one is not in it.

    Raises:
        ProblemError: no problem, or its statement is wrong.
    """
    from covocp.problem.restart import restartable

    check_kind(problem, Problem, "movable(problem): give the problem itself, of several phases each one")
    return Problem.of(restartable(problem.declarations, problem.statement()).declarations)


@dataclass(frozen=True, kw_only=True, eq=False)
class Elsewhere:
    """What solves a problem from elsewhere.

    Args:
        declarations: of the problem, as it was stated.
        statement: of the same.
        duration_read: whether the number of its duration may be in the expressions.
        make: the solver of another problem with the same method and options.
    """

    declarations: Declarations
    statement: Statement
    duration_read: bool
    make: Callable[[Problem], Solver]
    _kept: dict[float | None, tuple[Solver, tuple[Start, ...]]] = field(default_factory=dict)

    __repr__ = short_repr

    def solver(self, duration: float | None) -> tuple[Solver, tuple[Start, ...]]:
        """The solver for a duration, and which of its parameters are initial values.

        Raises:
            ProblemError: the duration is no argument.
        """
        from covocp.problem.restart import restartable

        if duration is not None:
            duration = self._checked(duration)
        if duration not in self._kept:
            own, statement = self.declarations, self.statement
            if duration is not None:
                own = replace(own, duration=duration)
                check_data_cover(own)
                statement = Problem.of(own).statement()
            found = restartable(own, statement)
            problem = Problem.of(found.declarations)
            problem.doubts_told = True  # when this solver was made
            while len(self._kept) >= KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[duration] = self.make(problem), found.starts
        return self._kept[duration]

    def _checked(self, duration: float) -> float | None:
        """The duration, None where it is that of the problem.

        Raises:
            ProblemError: it is free, something is read or holds at instants, or its number may be in the expressions.
        """
        own = self.declarations
        value = check_positive("duration", duration, unit="s")
        if own.free_duration is not None:
            raise ProblemError(
                "The duration is given, but the problem chooses it.",
                expected="a problem with a fixed duration",
                received=f"duration={value:g}, and {own.free_duration}",
                remedy="leave duration= out, or state the problem with a number",
            )
        held = [entry.name for entry in own.constraints if entry.instant is not None and not entry.relative]
        if own.sampled or held:
            what = f"'{own.sampled[0].name}' is read at instants" if own.sampled else f"'{held[0]}' holds at an instant"
            raise ProblemError(
                f"{what}, which another duration would have elsewhere.",
                expected="continuous measurements (none at=, at shares neither), conditions at shares (relative=True)",
                received=f"duration={value:g}",
                remedy="state the problem anew, with the instants that are left",
            )
        if value == float(own.duration):
            return None
        if self.duration_read:
            raise ProblemError(
                "Problem.duration was read where the problem is stated: its number may be in the expressions.",
                expected="expressions without the number of the duration",
                received=f"duration={value:g}, and a problem stated with {float(own.duration):g} s",
                remedy="state the problem anew with this duration; or make what depends on it a parameter()",
            )
        return value

    def values(
        self, starts: tuple[Start, ...], parameters: Given, initial: Given, means: Given, covariance: Given
    ) -> dict[Any, Any]:
        """All values as parameters.

        Raises:
            ProblemError: one of them is wrong.
        """
        from covocp.problem.restart import declared_values, values_of

        own = self.declarations
        for argument, given in (("parameters", parameters), ("means", means)):
            if given is not None and not isinstance(given, Mapping):
                raise ProblemError(
                    f"The values of {argument}= are not given by name.",
                    expected="a dict of symbol or name to value",
                    received=repr(given)[:100],
                    remedy=f"write {argument}={{'name': value}}",
                )
        result = dict(parameters or {})
        for key, value in (means or {}).items():
            name = find_name(key, "means=", list(own.unknowns), own.unknowns)
            if any(find_name_or_none(given, own.unknowns) == name for given in result):
                raise ProblemError(
                    f"The mean of '{name}' is given twice.",
                    expected="one value",
                    received="one in parameters= and one in means=",
                    remedy="leave one of them out",
                )
            result[name] = value
        given = values_of(starts, initial, covariance)
        follow = declared_values(starts, self.statement, stacked_parameters(self.statement, result))
        return follow | result | given


def find_name_or_none(key: Given, entries: tuple[Any, ...]) -> str:
    """Name of an entry from its symbol or name; "" where it is none of them."""
    return next((e.name for e in entries if key is e.symbol or (isinstance(key, str) and key == e.name)), "")


def later(guess: Given, elapsed: Given) -> Given:
    """A plan of which some time has passed.

    Raises:
        ProblemError: no plan is given, or no time.
    """
    if elapsed is None:
        return guess
    if not isinstance(guess, Solution):
        raise ProblemError(
            "Time has passed, but of no plan.",
            expected="guess=, the solution before, beside elapsed=",
            received=f"guess={guess!r}"[:100],
            remedy="give the plan as guess=, or leave elapsed= out",
        )
    number = float(elapsed) if is_number(elapsed) else np.nan
    if not 0.0 <= number <= guess.duration:
        raise ProblemError(
            "The time that has passed is not within the plan.",
            expected=f"0 to {guess.duration:g} s",
            received=repr(elapsed),
            remedy="correct elapsed=",
        )
    return Later(plan=guess, elapsed=number)
