"""Solving several phases as one problem."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from covocp.base.arguments import is_whole
from covocp.base.errors import ProblemError, SolveError, evaluating, no_option, spelling
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.problem.phases import Phases
from covocp.solution.doubts import mention_doubts, mention_limits
from covocp.solution.phases import PhasesSolution
from covocp.solving.attempts import interrupted
from covocp.solving.between_nodes import AT_NODES, check_between
from covocp.solving.methods import method_options
from covocp.solving.phases_outcome import phases_solution
from covocp.solving.phases_runs import ChainRuns
from covocp.solving.random_starts import multistart
from covocp.solving.refining import FIRST, adapted, first_options
from covocp.solving.unused import mention_lengths
from covocp.statement.chain import Chain
from covocp.statement.names import name_of, stacked_parameters
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Options

Arrays = tuple[Array, ...]
INTERVALS = 100  # of each phase, where none are asked for
TAKEN_BY = {"guess": "solve", "nominal": "evaluate"}


def solve_phases(
    phases: Phases,
    method: str,
    module: str,
    *,
    intervals: Given,
    guess: Given,
    nominal: str,
    progress: bool,
    allow_failure: bool,
    parameters: Mapping[str, Any] | None,
    **options: Any,
) -> PhasesSolution:
    """Solve all phases as one problem.

    Args:
        phases: what to solve.
        method: name of the method.
        module: that has it.
        intervals: of each phase, or one number for each; None: 100, and 16 of the first mesh with `refine`.
        guess: None; a `PhasesSolution`; "multistart"; or, by name of the phase or one for each, what `solve` takes for
            one problem.
        nominal: "combined".
        progress: whether to show the iterations on a terminal.
        allow_failure: return the last iterate of a run that did not converge instead of raising.
        parameters: values by name or symbol, in all phases that have them.
        options: of mesh and method; of "multistart" the number of `starts` and the `seed`.

    Raises:
        ProblemError: what does not fit, or what cannot be done for phases.
        SolveError: the method did not converge (carries the last iterate).
        Interrupted: after Ctrl-C (carries the last iterate, or the best of several starts).
    """
    prepare = getattr(importlib.import_module(module), "prepare_chain", None)
    if prepare is None or nominal != "combined":
        raise ProblemError(
            "Phases are not solved that way.",
            expected="nominal='combined', and a method that takes phases",
            received=f"method='{method}'" if prepare is None else f"nominal='{nominal}'",
            remedy="leave the option out",
        )
    random = multistart(guess, options)
    chain = phases.chain()
    for statement in chain.statements:
        check_between(statement, method)
    known = [field.name for field in fields(Options)]
    own = {name: value for name, value in options.items() if name in _method_options(prepare)}
    for name in options:
        if name not in known and name not in own:
            raise no_option(f"The method '{method}'", name, options[name], [*known, *_method_options(prepare)], ())
    asked = _asked(chain, method, nominal, intervals, {k: v for k, v in options.items() if k in known})
    if asked[0].refine is not None:
        own = adapted(method_options(method), own, asked[0].refine)
    guesses = of_each(chain, None if random is not None else guess)
    for mesh_of_phase, entry in zip(asked, guesses, strict=True):
        if isinstance(entry, Mapping):
            mention_lengths({str(key): value for key, value in entry.items()}, mesh_of_phase)
    values = values_of(chain, {} if parameters is None else parameters)
    with evaluating(chain.name), Progress(chain.name or "solving", progress) as reporter:
        outcome = ChainRuns(chain, method, prepare, own, reporter, values, guesses).solve(asked, random)
        solution = phases_solution(chain, outcome, method)
        if reporter.stop:
            raise interrupted(solution)
    return _finished(solution, allow_failure)


def _asked(chain: Chain, method: str, nominal: str, intervals: Given, options: dict[str, Any]) -> tuple[Options, ...]:
    """The options of the first mesh of each phase."""
    refine = options.get("refine")
    count = INTERVALS if refine is None else FIRST
    asked = [Options(intervals=n, **options) for n in intervals_of(chain, count if intervals is None else intervals)]
    if refine is None:
        return tuple(asked)
    points = method != AT_NODES
    return tuple(first_options(st, own, nominal, points) for st, own in zip(chain.statements, asked, strict=True))


def _method_options(prepare: Any) -> tuple[str, ...]:
    """Options of a method besides those of the mesh."""
    import inspect

    return tuple(n for n, p in inspect.signature(prepare).parameters.items() if p.kind is p.KEYWORD_ONLY)


def intervals_of(chain: Chain, intervals: Given) -> list[int]:
    """Number of control intervals of each phase; one number is that of each."""
    count = len(chain.statements)
    intervals = INTERVALS if intervals is None else intervals
    listed = list(intervals) if isinstance(intervals, (list, tuple, np.ndarray)) else [intervals] * count
    if len(listed) != count or not all(is_whole(n) for n in listed):
        raise ProblemError(
            "The option 'intervals' has a value that does not apply.",
            expected=f"a positive whole number, or one for each of the {count} phases",
            received=repr(intervals)[:100],
            remedy="correct intervals=",
        )
    return [int(n) for n in listed]


def of_each(chain: Chain, guess: Given, what: str = "guess") -> list[Any]:
    """The guess of each phase, or the nominal; None where there is none.

    Raises:
        ProblemError: it does not fit the phases.
    """
    names = [st.name for st in chain.statements]
    if guess is None:
        return [None] * len(names)
    if isinstance(guess, Mapping):
        for name in guess:
            if name not in names:
                raise _no_such("phase", name, names)
        listed = [guess.get(name) for name in names]
    else:
        listed = list(guess) if isinstance(guess, (PhasesSolution, list, tuple)) else []
    if len(listed) != len(names):
        raise ProblemError(
            f"The {what} does not fit the phases.",
            expected=f"None, a PhasesSolution of {len(names)} phases, a list of {len(names)} entries, or a dict by "
            "name of the phase: " + ", ".join(names),
            received=repr(guess)[:100],
            remedy=f"correct {what}=; that of a phase is what {TAKEN_BY[what]}() takes for one problem",
        )
    return listed


def values_of(chain: Chain, parameters: Mapping[str, Any]) -> Arrays:
    """Parameters of each statement; a name counts in all that have it."""
    if not isinstance(parameters, Mapping):
        stacked_parameters(chain.statements[0], parameters)  # says what it should be
    pairs = zip(chain.statements, given_of_each(chain.statements, parameters), strict=True)
    return tuple(stacked_parameters(st, given) for st, given in pairs)


def given_of_each(statements: Sequence[Statement], parameters: Mapping[Any, Any]) -> list[dict[str, Any]]:
    """For each statement the values by name of its parameters and unknowns, from those of all.

    Raises:
        ProblemError: none has a parameter or unknown of that name.
    """
    carried = [{b.name for b in st.matrices} for st in statements]
    own = [
        tuple(b.name for b in st.blocks if b.kind in ("parameter", "unknown") and b.name[:-3] not in names)
        for st, names in zip(statements, carried, strict=True)
    ]
    pairs = list(zip(statements, own, strict=True))
    by_name: dict[str, Any] = {}
    for key, value in parameters.items():
        found = [name for st, names in pairs if (name := name_of(key, st.symbols, names, missing_ok=True))]
        if not found:
            raise _no_such("parameter", key, [n for names in own for n in names])
        by_name[found[0]] = value
    return [{name: value for name, value in by_name.items() if name in names} for names in own]


def _no_such(what: str, name: Given, known: list[str]) -> ProblemError:
    """The error for a name that none of the phases has."""
    listed = list(dict.fromkeys(known))
    return ProblemError(
        f"There is no {what} '{name}'.",
        expected="one of " + ", ".join(listed) if listed else f"none: no phase has a {what}",
        received=repr(name)[:100],
        remedy=spelling(name, listed, "correct or remove it"),
    )


def _finished(solution: PhasesSolution, allow_failure: bool) -> PhasesSolution:
    """A solution with what the user must know about it, or the error that it did not converge."""
    if not solution.converged:
        if allow_failure:
            return solution
        lines = [f"  {name}: {value:.6g}" for name, value in list(solution.violations.items())[:10]]
        violated = "\n  violated constraints, by their largest violation:\n" + "\n".join(lines) if lines else ""
        named = f" of '{solution.name}'" if solution.name else ""
        raise SolveError(
            f"The phases{named} were not solved by {solution.method}: {solution.message}.{violated}"
            "\n  The last iterate is on this error (.solution): look at its phases, or use it as a guess.",
            solution=solution,  # type: ignore[arg-type]
            violations=solution.violations,
        )
    for phase in solution.phases:
        mention_doubts(phase)
        mention_limits(phase)
    return solution
