"""What really flies in phases: the system of each, what passes between them, and what linear theory says it costs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, kind_and_name
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.densities import Truth, check_true_jump, check_truth
from covocp.problem.phase_chain import chain_of
from covocp.problem.phase_feedback import in_phase
from covocp.problem.phases import Phases
from covocp.simulation.actual import System, actual_system, plain_truth, stated_system
from covocp.simulation.stretch import cost_of_runs, in_words
from covocp.solution.phases import PhasesSolution
from covocp.solution.solution import Solution
from covocp.solving.evaluation import evaluate
from covocp.solving.phases_given import given_of_each
from covocp.statement.chain import Link

Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True, eq=False)
class ActualPhases:
    """The systems that are simulated, one a phase, and the links between them.

    fixed: names of the unknowns that have one value in all runs, which is not drawn. words: the truth in a few words;
    "" where it is the design's. costs: of each phase by linear theory; NaN where that does not know the truth.
    """

    systems: tuple[System, ...]
    links: tuple[Link, ...]
    fixed: frozenset[str]
    words: str
    costs: Array

    __repr__ = short_repr


def actual_phases(solution: PhasesSolution, designs: tuple[System, ...], truth: Given) -> ActualPhases:
    """The systems that are simulated.

    Args:
        solution: of the design.
        designs: its systems.
        truth: None: the same; a dict of parameter or unknown to the value that it has in every run, in all phases that
            have it; or `Phases` with the same states, unknowns, controls and measurements in each, and any dynamics,
            jumps, noises and variances.

    Raises:
        ProblemError: it is none of these, or names or sizes differ.
    """
    costs = np.array([cost_of_runs(phase) for phase in solution])
    if truth is None:
        return ActualPhases(systems=designs, links=solution.links, fixed=frozenset(), words="", costs=costs)
    fixed: set[str] = set()
    links, systems = solution.links, []
    if isinstance(truth, Mapping):
        given = given_of_each([phase.extremal.statement for phase in solution], truth)
        for phase, design, own in zip(solution, designs, given, strict=True):
            systems.append(in_its_phase(phase, actual_system, design, own))
            fixed |= {block.name for block in phase.blocks if block.kind == "unknown" and block.name in own}
    elif isinstance(truth, Phases) and len(truth.problems) == len(solution):
        plain = [plain_truth(problem.stated) for problem in truth.problems]
        chain = chain_of(truth.name, truth.names, plain, truth.jumps)
        links = chain.links
        for k, (phase, design) in enumerate(zip(solution, designs, strict=True)):
            stated = truth.problems[k].stated, chain.statements[k]
            systems.append(in_its_phase(phase, stated_system, design, *stated))
    else:
        raise ProblemError(
            "The truth is of an unknown kind.",
            expected=f"Phases, {len(solution)} of them with the same symbols, or a dict of name to value",
            received=f"{len(truth.problems)} phases" if isinstance(truth, Phases) else kind_and_name(truth),
            remedy="correct truth=",
        )
    for phase, system in zip(solution, systems, strict=True):
        checked = (phase.extremal, system.statement, system.parameters, system.variance)
        in_its_phase(phase, check_truth, *checked)
    truths = [Truth(system.statement, system.parameters) for system in systems]
    for link, phase, both in zip(links, solution, pairwise(truths), strict=False):
        check_true_jump(link, phase.extremal, both)
    known = np.full(len(solution), np.nan) if fixed else _true_costs(solution, truth)
    return ActualPhases(systems=tuple(systems), links=links, fixed=frozenset(fixed), words=in_words(truth), costs=known)


def in_its_phase(phase: Solution, make: Callable[..., Made], *arguments: Any) -> Made:
    """What is made for a phase; what does not fit is said with its name.

    Raises:
        ProblemError: what `make` says.
    """
    try:
        return make(*arguments)
    except ProblemError as error:
        raise in_phase(phase.extremal.statement, error) from error


def _true_costs(solution: PhasesSolution, truth: Given) -> Array:
    """Expected costs by linear theory; NaN where that knows other statistics only."""
    try:
        return np.array([cost_of_runs(phase) for phase in evaluate(solution, truth=truth)])
    except (ProblemError, RuntimeError):
        return np.full(len(solution), np.nan)
