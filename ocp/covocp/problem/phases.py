"""Phases: problems one after the other, with what their states and estimates do where one ends and the next begins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from covocp.base.checks import caller, check_kind, density_matrix, shape_error
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, kind_and_name
from covocp.base.expressions import Given, symbol_of
from covocp.base.short_repr import short_repr
from covocp.base.threads import methods_one_at_a_time
from covocp.problem.builder import Problem
from covocp.problem.checks import column_expression
from covocp.problem.declarations import Declarations, State
from covocp.problem.phase_chain import chain_of
from covocp.statement.chain import Chain


@dataclass(frozen=True, kw_only=True, eq=False)
class Jump:
    """What a state starts with in a phase: an expression of what the phase before ended with, and its variance."""

    phase: int
    name: str
    expression: ca.MX
    noise: ca.MX
    where: str

    __repr__ = short_repr


@methods_one_at_a_time
class Phases:
    """Problems that follow each other in time: states, decisions and unknowns of the same name go on.

    Each phase has its own dynamics, controls, measurements, constraints, costs and duration, fixed or free; costs add
    up. `Problem.time` is the time since the phase began. A state that goes on is declared with `initial=None` in the
    later phase; one that is not there before appears with its own `initial` and `variance`; one that is not there
    afterwards ends. Where every phase has an estimation covariance, it goes on with its correlations, and the estimates
    of unknowns are kept.

    Args:
        problems: the phases in their order, at least two.
        name: appears in printouts and plots.

    Attributes:
        doubts_told: the chain of which it was said what is probably forgotten in it.

    Raises:
        ProblemError: no sequence of two or more different problems.
    """

    # What functions say that take one problem.
    instead = "phases are solved by solve(phases); this takes one Problem"

    def __init__(self, problems: Sequence[Problem], name: str = "") -> None:
        """Keep the problems; what does not fit is told when they are solved."""
        check_kind(name, str, "give name= in words")
        if not isinstance(problems, (list, tuple)) or len(problems) < 2:
            raise ProblemError(
                "Phases are two problems or more.",
                expected="a list of Problem, such as Phases([first, second])",
                received=kind_and_name(problems) if not isinstance(problems, (list, tuple)) else f"{len(problems)}",
                remedy="give all phases in their order; a problem by itself is solved by solve(problem)",
            )
        for problem in problems:
            check_kind(problem, Problem, "give the phases as a list of problems, in their order")
        if len({id(problem) for problem in problems}) < len(problems):
            raise ProblemError(
                "A problem is given twice as a phase.",
                expected="a problem of its own for each phase",
                received="the same Problem more than once",
                remedy="build it again by a function that returns a new Problem each time",
            )
        self._problems = tuple(problems)
        self._name = name
        self._jumps: tuple[Jump, ...] = ()
        self.doubts_told: Chain | None = None
        self._chain: tuple[tuple[Any, ...], Chain] | None = None

    @property
    def problems(self) -> tuple[Problem, ...]:
        """The phases in their order."""
        return self._problems

    @property
    def name(self) -> str:
        """Its name."""
        return self._name

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the phases: of the problems, or "phase 1", "phase 2", ... where one has none.

        Raises:
            ProblemError: two phases have the same name.
        """
        names = tuple(problem.name or f"phase {k + 1}" for k, problem in enumerate(self._problems))
        for name in names:
            if names.count(name) > 1:
                raise ProblemError(
                    f"Two phases have the name '{name}'.",
                    expected="a name of its own for each phase",
                    received=", ".join(names),
                    remedy="give Problem(..., name=...) another one",
                )
        return names

    @property
    def jumps(self) -> tuple[Jump, ...]:
        """What was stated by `jump`."""
        return self._jumps

    def __repr__(self) -> str:
        """The names."""
        return f"Phases('{self._name}': {', '.join(problem.name or '-' for problem in self._problems)})"

    def jump(self, x: Given, expression: Given, noise: Given = None) -> None:
        """State what a state starts with in a phase, in place of going on: a mass drop, an impact, an impulse.

        Args:
            x: symbol of a state of the later one of the two phases.
            expression: of states, unknowns, parameters, decisions and the duration of the phase before, shape (n, 1).
            noise: variance that is added to its estimate there: scalar, vector (diagonal) or matrix; an expression of
                the same, or None. The covariance E before becomes J E J' + noise, J the tangent of all jumps.

        Raises:
            ProblemError: no state of a later phase, stated twice, a shape that does not fit, a variance that is
                negative; when the phases are solved: symbols of another phase.
        """
        phase, state = self._state_of(x)
        value = column_expression(state.name, "jump", expression)
        if value.shape != (state.size, 1):
            raise shape_error(state.name, "jump", f"shape ({state.size}, 1)", f"shape {value.shape}")
        for other in self._jumps:
            if (other.phase, other.name) == (phase, state.name):
                raise ProblemError(
                    f"The jump of '{state.name}' is stated twice.",
                    expected="one jump() for each state of a phase",
                    received=f"a first one at {other.where}",
                    remedy="remove one of them",
                )
        variance = density_matrix(state.name, "noise of the jump", 0.0 if noise is None else noise, state.size)
        jump = Jump(phase=phase, name=state.name, expression=value, noise=variance, where=caller())
        self._jumps = (*self._jumps, jump)

    def chain(self) -> Chain:
        """The frozen phases that solvers read; built again when one of them has changed.

        Raises:
            ProblemError: what does not fit: names, sizes, units, initial values, covariances.
        """
        stated = (*(problem.stated for problem in self._problems), self._jumps)
        if self._chain is None or any(a is not b for a, b in zip(self._chain[0], stated, strict=True)):
            found = chain_of(self._name, self.names, stated[:-1], self._jumps)
            self._chain = (stated, found)
        return self._chain[1]

    def _state_of(self, x: Given) -> tuple[int, State]:
        """The phase, not the first one, and the state that a symbol stands for."""
        x = symbol_of(x)
        for k, problem in enumerate(self._problems):
            for state in problem.states:
                same = isinstance(x, ca.MX) and x.is_symbolic() and ca.is_equal(x, state.symbol)
                if not same or state.role == "integral":
                    continue
                if k and state.role == "moving":
                    return k, state
                raise ProblemError(
                    f"'{state.name}' cannot jump there.",
                    expected="a state of a phase that follows another one",
                    received=f"a state of the first phase, '{self.names[0]}'" if not k else "a decision: one constant",
                    remedy="give the state's symbol of the later phase; initial= says how the first one starts",
                )
        raise ProblemError(
            "jump() was given something that is not a state of these phases.",
            expected="the symbol that state() of the later phase returned",
            received=str(x)[:100],
            remedy="give the symbol itself, not its name: several phases may have that name",
        )


def with_declarations(phases: Phases, declarations: Sequence[Declarations]) -> Phases:
    """Phases with other declarations on the same symbols, and the same jumps."""
    result = Phases([Problem.of(own) for own in declarations], phases.name)
    result._jumps = phases.jumps
    return result
