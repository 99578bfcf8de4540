"""What the user asked a simulation of phases for, by phase: systems that fly, laws and limits of the control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from covocp.base.dataclass import dataclass
from covocp.base.errors import spelling
from covocp.base.expressions import Given
from covocp.base.short_repr import short_repr
from covocp.simulation.actual import System
from covocp.simulation.flown import Flown, flown_law
from covocp.simulation.junction import Ends
from covocp.simulation.phase_truth import ActualPhases, actual_phases, in_its_phase
from covocp.simulation.request import Request, wrong_argument
from covocp.simulation.run_parts import Limits
from covocp.simulation.schedule import Estimator
from covocp.simulation.stretch import designed, limits_of
from covocp.solution.phases import PhasesSolution, limits_of_each


@dataclass(frozen=True, kw_only=True)
class Asked:
    """Options of `simulate` that say what flies, as the user gave them."""

    truth: Given = None
    law: Given = None
    period: Given = None
    limits: Given = None

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Flight:
    """What flies in each phase, checked: the design's systems, the actual ones, laws and limits."""

    solution: PhasesSolution
    designs: tuple[System, ...]
    actual: ActualPhases
    flown: tuple[Flown | None, ...]
    limits: tuple[Limits, ...]
    filter: Estimator

    __repr__ = short_repr

    def ends(self, k: int) -> tuple[Ends, Ends]:
        """The end of a phase and the start of the next one, for the design and for the system that flies."""
        before, after = self.solution[k], self.solution[k + 1]
        one, two = self.designs[k : k + 2]
        design = Ends(before=before, after=after, earlier=one, later=two, link=self.solution.links[k])
        if self.actual.systems is self.designs:
            return design, design
        one, two = self.actual.systems[k : k + 2]
        return design, replace(design, earlier=one, later=two, link=self.actual.links[k], fixed=self.actual.fixed)


def flight(solution: PhasesSolution, request: Request, asked: Asked) -> Flight:
    """What flies, checked.

    Raises:
        ProblemError: what was asked for does not fit the phases.
    """
    laws = _laws(solution, asked.law, asked.period)
    if asked.law is not None and request.filter != "perturbation":
        raise wrong_argument("filter", "no filter= beside law=: the law has its own", request.filter)
    limits = limits_of_each(solution, asked.limits)
    designs = tuple(designed(phase) for phase in solution)
    every = zip(solution, designs, laws, limits, strict=True)
    found = [
        (
            in_its_phase(phase, flown_law, law, asked.period, design, phase.duration),
            in_its_phase(phase, limits_of, design, given),
        )
        for phase, design, law, given in every
    ]
    return Flight(
        solution=solution,
        designs=designs,
        actual=actual_phases(solution, designs, asked.truth),
        flown=tuple(law for law, _ in found),
        limits=tuple(kept for _, kept in found),
        filter=request.filter if asked.law is None else "law",
    )


def _laws(solution: PhasesSolution, law: Given, period: Given) -> list[Any]:
    """The law of each phase, None in all of them where none is given.

    Raises:
        ProblemError: no law for each phase, or a period without a law.
    """
    names = [phase.name for phase in solution]
    if law is None:
        if period is not None:
            expected = "law= with it: it is the time between two steps of these laws"
            raise wrong_argument("period", expected, period, "give law=, or leave period= out")
        return [None] * len(names)
    if isinstance(law, Mapping):
        for name in law:
            if name not in names:
                expected = "laws by name of the phase: " + ", ".join(map(repr, names))
                raise wrong_argument("law", expected, repr(name), spelling(name, names, "correct law="))
        listed = [law.get(name) for name in names]
    else:
        listed = list(law) if isinstance(law, (list, tuple)) else []
    if len(listed) != len(names) or any(own is None for own in listed):
        expected = f"a list of {len(names)} laws, one for each phase, or a dict by name: " + ", ".join(map(repr, names))
        remedy = "give each phase a law of its own; it starts there anew, its times those of the phase"
        raise wrong_argument("law", expected, law, remedy)
    return listed
