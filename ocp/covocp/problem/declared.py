"""What a problem has been told so far: the groups of its declarations, how it reads, and how it changes."""

from __future__ import annotations

from typing import Any, TypeVar

import casadi as ca

from covocp.base.expressions import Given
from covocp.base.threads import methods_one_at_a_time
from covocp.problem.chances import with_chance_conditions
from covocp.problem.checks import check_name, check_size
from covocp.problem.declarations import Chance, Declarations
from covocp.problem.expected_cost import statement_of
from covocp.statement.statement import Statement

Entry = TypeVar("Entry")


@methods_one_at_a_time
class Declared:
    """Declarations that can be read, printed and frozen; `Problem` makes them.

    Arguments, attributes and errors are those of `Problem`.
    """

    _declarations: Declarations
    _statement: Statement | None
    _expanded: Declarations | None
    doubts_told: bool
    duration_read: bool

    @property
    def declarations(self) -> Declarations:
        """What is declared so far; once the cost is known, with conditions on probabilities as constraints."""
        if self._expanded is None:
            self._expanded = with_chance_conditions(self._declarations)
        return self._expanded

    @property
    def stated(self) -> Declarations:
        """What is declared so far, conditions on probabilities as they were stated."""
        return self._declarations

    @property
    def chances(self) -> tuple[Chance, ...]:
        """Conditions on probabilities as they were stated."""
        given = self._declarations
        return (*(c.chance for c in given.constraints if c.chance is not None), *given.chances)

    @property
    def name(self) -> str:
        """Its name."""
        return self._declarations.name

    # What is declared can be read by its groups.
    states = property(lambda self: self._declarations.states)
    unknowns = property(lambda self: self._declarations.unknowns)
    parameters = property(lambda self: self._declarations.parameters)
    controls = property(lambda self: self._declarations.controls)
    matrices = property(lambda self: self._declarations.matrices)
    rates = property(lambda self: self._declarations.rates)
    measurements = property(lambda self: self._declarations.measurements)
    constraints = property(lambda self: self._declarations.constraints)
    cost = property(lambda self: self._declarations.cost)
    expected = property(lambda self: self._declarations.expected)
    expansion = property(lambda self: self._declarations.expansion)
    free_duration = property(lambda self: self._declarations.free_duration)

    def __repr__(self) -> str:
        """What is declared, by name."""
        groups = ((kind, getattr(self._declarations, kind)) for kind in ("states", "unknowns", "controls", "matrices"))
        listed = "".join(f", {kind} {', '.join(q.name for q in group)}" for kind, group in groups if group)
        return f"Problem('{self.name}'{listed})"

    def __str__(self) -> str:
        """What print shows: symbols with their data, and the equations in their names."""
        from covocp.base.pages import as_text
        from covocp.problem.description import sections

        return as_text(sections(self))

    def _repr_html_(self) -> str:
        """What a notebook shows: the same tables."""
        from covocp.base.pages import as_html
        from covocp.problem.description import sections

        return as_html(sections(self))

    @property
    def time(self) -> ca.MX:
        """Symbol of the running time [s]."""
        return self._declarations.time

    @property
    def duration(self) -> Any:
        """Symbol of the terminal time [s], or its number where it is fixed."""
        self.duration_read = self.duration_read or self.free_duration is None
        return self._declarations.duration

    def statement(self) -> Statement:
        """The frozen problem that solvers read; built once and kept until something is added.

        Raises:
            ProblemError: dynamics or cost missing, symbols of another problem, measurement noise singular.
        """
        if self._statement is None:
            self._statement = statement_of(self.declarations)
        return self._statement

    def _declare(self, name: str, size: Given) -> int:
        """Check that the name is new and the size sensible."""
        check_name(name, list(self._declarations.taken))
        return check_size(name, size)

    def _add(self, group: str, entry: Entry) -> Entry:
        """One more declaration in a group."""
        self._change(self._declarations.adding(**{group: entry}))
        return entry

    def _change(self, declarations: Declarations) -> None:
        """Other declarations from now on: another statement, and other doubts about it."""
        self._declarations, self._statement, self.doubts_told = declarations, None, False
        self._expanded = None
