"""Solutions that were kept in files, with the problem that was solved attached again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import numpy as np

from covocp.base.checks import check_kind
from covocp.base.errors import ProblemError, kind_and_name
from covocp.base.threads import one_at_a_time
from covocp.problem.builder import Problem
from covocp.problem.phases import Phases
from covocp.solution.attaching import attached
from covocp.solution.phases import PhasesSolution
from covocp.solution.phases_storage import FORMAT as PHASES_FORMAT
from covocp.solution.phases_storage import VERSION as PHASES_VERSION
from covocp.solution.phases_storage import phases_from_tree
from covocp.solution.solution import Solution
from covocp.solution.storage import FORMAT, VERSION, from_tree, made, opened
from covocp.statement.chain import Link

# Difference at a link, relative to the size of what passes, above which it is another jump.
SAME_LINK = 1e-4


@overload
def load(path: str | Path, problem: Problem) -> Solution: ...


@overload
def load(path: str | Path, problem: Phases) -> PhasesSolution: ...


@overload
def load(path: str | Path, problem: None = None) -> Any: ...


@one_at_a_time
def load(path: str | Path, problem: Problem | Phases | None = None) -> Solution | PhasesSolution:
    """Read a solution that `save` wrote, of a problem or of phases; nothing in the file is executed.

    Args:
        path: a .npz or .json file.
        problem: the problem that was solved, attached again: expressions of its symbols, `check_path` and everything
            else that needs the model can then be asked for. Without it the solution knows names only. It is compared
            with the problem that was solved: symbols, duration, bounds, limits, initial and final values and variances,
            declared parameters and means, and the values of equations, noises, costs and constraints at points kept in
            the file. A parameter may also have the value that was solved for; guesses and scales may differ. Of phases:
            the `Phases`.

    Returns:
        The solution, equal to the saved one to the last bit. With a problem, what its values at the nodes violate is
        among its `violations`.

    Raises:
        ProblemError: no such file, not a file of this format or version, damaged (a checksum tells), or of another
            problem (says what differs).
    """
    tree = opened(path, {FORMAT: VERSION, PHASES_FORMAT: PHASES_VERSION})
    if tree["format"] == PHASES_FORMAT:
        return _of_phases(made(path, tree, phases_from_tree), problem)
    solution = made(path, tree, from_tree)
    if problem is None:
        return solution
    if isinstance(problem, Phases):
        raise ProblemError(
            f"The file holds the solution of one problem, '{solution.name}'.",
            expected="the Problem that was solved",
            received=kind_and_name(problem),
            remedy="give it, or load without a problem",
        )
    check_kind(problem, Problem, "give the problem that was solved, or load without one")
    return attached(solution, problem.statement())


def _of_phases(solution: PhasesSolution, phases: Problem | Phases | None) -> PhasesSolution:
    """The solution with the statements of the phases attached, where these are given."""
    if phases is None:
        return solution
    if not isinstance(phases, Phases):
        raise ProblemError(
            f"The file holds the solution of several phases, '{solution.name}'.",
            expected="the Phases that were solved",
            received=kind_and_name(phases),
            remedy="give them, or load without a problem",
        )
    chain = phases.chain()
    statements = list(chain.statements)
    if [st.name for st in statements] != [phase.name for phase in solution]:
        raise ProblemError(
            "The stored solution is of other phases.",
            expected=f"{len(solution)} phases: " + ", ".join(phase.name for phase in solution),
            received=f"{len(statements)}: " + ", ".join(st.name for st in statements),
            remedy="give the phases that were solved, or load without them",
        )
    for i, link in enumerate(chain.links):
        later = statements[i + 1]
        stored = solution[i + 1].parameters
        if stored.size == later.np:  # where its matrices start: what the jump gives is compared below
            filled = link.filled(later.values, stored[list(link.parameters)])
            statements[i + 1] = replace(later, values=filled)
        if link.weights and solution[i].parameters.size == statements[i].np:
            weighed = link.weighed(statements[i].values, solution[i].parameters[list(link.weights)])
            statements[i] = replace(statements[i], values=weighed)
    pairs = zip(solution.phases, statements, strict=True)
    whole = tuple(attached(phase, statement) for phase, statement in pairs)
    result = replace(solution, phases=whole, links=chain.links)
    for i, link in enumerate(chain.links):
        _check_link(link, result[i], result[i + 1])
    return result


def _check_link(link: Link, before: Solution, after: Solution) -> None:
    """What a stored phase starts with must be what the phase before it gives.

    Raises:
        ProblemError: it is not.
    """
    t, later = before.trajectory, after.trajectory
    given: tuple[Any, ...] = link.values(t.x[-1], t.e[-1], t.duration, before.parameters, after.parameters)
    stored: tuple[Any, ...] = (later.x[0, list(link.states)], later.e[0, list(link.matrices)])
    sizes: tuple[Any, ...] = (
        np.abs(later.x).max(axis=0)[list(link.states)],
        np.full(len(link.matrices), np.abs(later.e).max(initial=0)),
    )
    names = link.names
    if link.weights:
        weights = before.parameters[list(link.weights)], later.e[0, list(link.behind)]
        given, stored = (*given, weights[0]), (*stored, weights[1])
        sizes = (*sizes, np.full(weights[0].size, np.abs(weights[0]).max()))
        names = (*names, *(f"weight {after.extremal.statement.matrix_names[k]} of deviations" for k in link.behind))
    wrong = np.abs(np.concatenate(given) - np.concatenate(stored)) > SAME_LINK * np.concatenate(sizes)
    if before.converged and wrong.any():
        k = int(np.argmax(wrong))
        raise ProblemError(
            f"The stored solution is of other phases: the {names[k]} differs.",
            expected=f"as stored: {np.concatenate(stored)[k]:g}",
            received=f"as given: {np.concatenate(given)[k]:g}",
            remedy="give the phases that were solved, with their jumps, or load without them",
        )
