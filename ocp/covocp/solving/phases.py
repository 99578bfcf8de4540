"""Solving several phases as one problem."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import fields, replace
from itertools import islice
from typing import Any

import numpy as np

from covocp.base.arguments import is_whole
from covocp.base.errors import CovocpError, Interrupted, ProblemError, SolveError, evaluating, no_option, spelling
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Guess, Outcome
from covocp.extremal.links import ChainOutcome, completed, link_residual
from covocp.extremal.mean_effect import noted
from covocp.extremal.mesh_error import OPTIMISED, finer_steps
from covocp.extremal.phase_loops import PhaseLoop, phase_loops
from covocp.problem.phases import Phases
from covocp.solution.doubts import mention_doubts, mention_limits
from covocp.solution.phases import PhasesSolution
from covocp.solution.solution import Solution
from covocp.solving.attempts import TRIED
from covocp.solving.between_nodes import watched
from covocp.solving.unused import mention_lengths
from covocp.solving.warm_start import make_guesses
from covocp.statement.chain import Chain, started_at
from covocp.statement.names import name_of, stacked_parameters
from covocp.transcription.first_guess import matrices_function
from covocp.transcription.grading import graded
from covocp.transcription.mesh import Options
from covocp.transcription.stiffness import resolve_mesh

Arrays = tuple[Array, ...]
INTERVALS = 100  # of each phase, where none are asked for


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
        intervals: of each phase, or one number for each; None: 100.
        guess: None; a `PhasesSolution`; or, by name of the phase or one for each, what `solve` takes for one problem.
        nominal: "combined".
        progress: whether to show the iterations on a terminal.
        allow_failure: return the last iterate of a run that did not converge instead of raising.
        parameters: values by name or symbol, in all phases that have them.
        options: of mesh and method.

    Raises:
        ProblemError: what does not fit, or what cannot be done for phases.
        SolveError: the method did not converge (carries the last iterate).
        Interrupted: after Ctrl-C (carries the last iterate).
    """
    prepare = getattr(importlib.import_module(module), "prepare_chain", None)
    if prepare is None or nominal != "combined" or isinstance(guess, str):
        asked = f"nominal='{nominal}'" if nominal != "combined" else f"guess={guess!r}"
        raise ProblemError(
            "Phases are not solved that way.",
            expected="nominal='combined', and a guess for each phase or none",
            received=f"method='{method}'" if prepare is None else asked,
            remedy="leave the option out",
        )
    chain = phases.chain()
    _check_refinement(chain, options.get("refine"))
    known = [field.name for field in fields(Options)]
    own = _method_options(prepare)
    for name in options:
        if name not in known and name not in own:
            raise no_option(f"The method '{method}'", name, options[name], [*known, *own], ())
    mesh_options = {name: value for name, value in options.items() if name in known}
    asked_options = tuple(Options(intervals=n, **mesh_options) for n in _intervals(chain, intervals))
    guesses = _guess_of_each(chain, guess, asked_options)
    values = _values(chain, {} if parameters is None else parameters)
    with evaluating(chain.name), Progress(chain.name or "solving", progress) as reporter:
        run = _Run(chain, prepare, {k: v for k, v in options.items() if k in own}, reporter)
        outcome = run.solve(asked_options, values, guesses)
        if reporter.stop:
            message = "Interrupted. On this error (.solution): the last iterate."
            raise Interrupted(message, solution=_solution(chain, outcome, method))  # type: ignore[arg-type]
        solution = _solution(chain, outcome, method)
    return _finished(solution, allow_failure)


def _check_refinement(chain: Chain, refine: Given) -> None:
    """Meshes of phases stay as they are, and limits hold where they are imposed.

    Raises:
        ProblemError: something else is asked for.
    """
    between = [name for st in chain.statements for name in watched(st)]
    if refine is not None or between:
        raise ProblemError(
            "The meshes of phases do not refine themselves.",
            expected="intervals= for each phase, and points= for limits inside the intervals",
            received=f"refine={refine!r}" if refine is not None else f"between='auto' for {', '.join(between)}",
            remedy="leave it out, and take more intervals or points",
        )


def _method_options(prepare: Any) -> tuple[str, ...]:
    """Options of a method besides those of the mesh."""
    import inspect

    return tuple(n for n, p in inspect.signature(prepare).parameters.items() if p.kind is p.KEYWORD_ONLY)


def _intervals(chain: Chain, intervals: Given) -> list[int]:
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


def _guess_of_each(chain: Chain, guess: Given, options: tuple[Options, ...]) -> list[Any]:
    """The guess of each phase."""
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
            "The guess does not fit the phases.",
            expected=f"None, a PhasesSolution of {len(names)} phases, a list of {len(names)} guesses, or a dict by "
            "name of the phase: " + ", ".join(names),
            received=repr(guess)[:100],
            remedy="correct guess=; the guess of a phase is what solve() takes for one problem",
        )
    for own, entry in zip(options, listed, strict=True):
        if isinstance(entry, Mapping):
            mention_lengths({str(key): value for key, value in entry.items()}, own)
    return listed


def _values(chain: Chain, parameters: Mapping[str, Any]) -> Arrays:
    """Parameters of each statement; a name counts in all that have it."""
    carried = [{b.name for b in st.matrices} for st in chain.statements]
    own = [
        [b.name for b in st.blocks if b.kind in ("parameter", "unknown") and b.name[:-3] not in names]
        for st, names in zip(chain.statements, carried, strict=True)
    ]
    if not isinstance(parameters, Mapping):
        stacked_parameters(chain.statements[0], parameters)  # says what it should be
    pairs = list(zip(chain.statements, own, strict=True))
    by_name: dict[str, Any] = {}
    for key, value in parameters.items():
        found = [name for st, names in pairs if (name := name_of(key, st.symbols, tuple(names), missing_ok=True))]
        if not found:
            raise _no_such("parameter", key, [n for names in own for n in names])
        by_name[found[0]] = value
    return tuple(
        stacked_parameters(st, {name: value for name, value in by_name.items() if name in names}) for st, names in pairs
    )


def _no_such(what: str, name: Given, known: list[str]) -> ProblemError:
    """The error for a name that none of the phases has."""
    listed = list(dict.fromkeys(known))
    return ProblemError(
        f"There is no {what} '{name}'.",
        expected="one of " + ", ".join(listed) if listed else f"none: no phase has a {what}",
        received=repr(name)[:100],
        remedy=spelling(name, listed, "correct or remove it"),
    )


class _Run:
    """Runs of a method on a chain: from several starts, and with shorter steps where these are too long."""

    def __init__(self, chain: Chain, prepare: Any, own: dict[str, Any], reporter: Progress) -> None:
        """Keep the chain, and how the method is made ready."""
        self._chain, self._prepare, self._own, self._reporter = chain, prepare, own, reporter

    def solve(self, options: tuple[Options, ...], values: Arrays, guesses: list[Any]) -> ChainOutcome:
        """Solve from the guesses; `values` are the parameters of each statement."""
        long = tuple(own.substeps == "auto" for own in options)
        first, values, options = self._start(options, values, guesses, 0)
        outcome = self._from_starts(options, values, guesses, first)
        while outcome.converged and not self._reporter.stop:
            pairs = zip(outcome.extremals, options, long, strict=True)
            finer = tuple((finer_steps(x, own, OPTIMISED) if auto else None) or own for x, own, auto in pairs)
            if all(a is b for a, b in zip(finer, options, strict=True)):
                break
            own_guesses = tuple(Guess(trajectory=x.trajectory, warm=True) for x in outcome.extremals)
            try:
                again = self._prepared(finer, values).solve(values, own_guesses, self._reporter)
            except CovocpError:  # what the steps are off is told with the solution that there is
                break
            if not again.converged:
                break
            counts = ("iterations", "build_seconds", "solve_seconds")
            both = {name: outcome.stats[name] + again.stats[name] for name in counts}
            outcome, options = replace(again, stats={**outcome.stats, **again.stats, **both}), finer
        return outcome

    def _prepared(self, options: tuple[Options, ...], values: Arrays) -> Any:
        """The method made ready for the chain with these parameters as its own."""
        statements = tuple(replace(st, values=own) for st, own in zip(self._chain.statements, values, strict=True))
        return self._prepare(replace(self._chain, statements=statements), options, **self._own)

    def _from_starts(
        self, options: tuple[Options, ...], values: Arrays, guesses: list[Any], first: tuple[Guess, ...]
    ) -> ChainOutcome:
        """From the first start from which the method finds its way; from the first one where there is none."""
        prepared = self._prepared(options, values)
        start = first
        for attempt in range(TRIED):
            tentative = attempt < TRIED - 1 and not any(guess.warm for guess in start)
            given = tuple(replace(guess, tentative=tentative) for guess in start)
            outcome: ChainOutcome = prepared.solve(values, given, self._reporter)
            if outcome.converged or not outcome.stats.get("wandered") or self._reporter.stop or not tentative:
                break
            start = self._start(options, values, guesses, attempt + 1)[0]
        if not outcome.converged and outcome.stats.get("wandered") and not self._reporter.stop:
            outcome = prepared.solve(values, first, self._reporter)
        return outcome

    def _start(
        self, options: tuple[Options, ...], values: Arrays, guesses: list[Any], attempt: int
    ) -> tuple[tuple[Guess, ...], Arrays, tuple[Options, ...]]:
        """A guess for each phase, each of which starts where the one before it ends.

        Returns:
            The guesses; the parameters with the matrices that a phase then starts with, and with the weights that the
            next one has where it begins; the options, graded for them.
        """
        found = self._forward(options, values, guesses, attempt)
        if any(link.weights for link in self._chain.links):
            found = self._forward(options, self._weighed(*found), guesses, attempt)
        return found

    def _weighed(self, guesses: tuple[Guess, ...], values: Arrays, options: tuple[Options, ...]) -> Arrays:
        """The parameters with S of each later phase along its guess, where it begins; from the last to the first."""
        result = list(values)
        for i in range(len(values) - 1, 0, -1):
            st, link, t = self._chain.statements[i], self._chain.links[i - 1], guesses[i].trajectory
            mesh = resolve_mesh(st, options[i], result[i])
            along = matrices_function(st, mesh)(t.x.T, t.u.T, t.duration, result[i])
            start = np.asarray(along[0].full())[list(link.behind), 0]
            if np.isfinite(start).all():
                result[i - 1] = link.weighed(result[i - 1], start)
        return tuple(result)

    def _forward(
        self, options: tuple[Options, ...], values: Arrays, guesses: list[Any], attempt: int
    ) -> tuple[tuple[Guess, ...], Arrays, tuple[Options, ...]]:
        """What `_start` returns, from the first phase to the last, for the weights that are among the parameters."""
        found: list[Guess] = []
        filled: list[Array] = []
        fine: list[Options] = []
        for i, (st, own, value, guess) in enumerate(zip(self._chain.statements, options, values, guesses, strict=True)):
            if i:
                link, t = self._chain.links[i - 1], found[-1].trajectory
                states, matrices = link.values(t.x[-1], t.e[-1], t.duration, filled[-1], value)
                value, st = link.filled(value, matrices), started_at(st, link, states)
            filled.append(value)
            fine.append(graded(st, own, value))
            mesh = resolve_mesh(st, fine[-1], value)
            candidates = list(islice(make_guesses(st, mesh, value, guess, linked=True), attempt + 1))
            found.append(candidates[-1])
        return tuple(found), tuple(filled), tuple(fine)


def _solution(chain: Chain, outcome: ChainOutcome, method: str) -> PhasesSolution:
    """An outcome as solutions of the phases."""
    loops: tuple[PhaseLoop | None, ...] = (None,) * len(outcome.extremals)
    if chain.statements[0].loop is not None:
        loops = phase_loops(outcome.extremals, chain.links)
    try:
        passed = completed(outcome, chain.links)
    except (RuntimeError, ArithmeticError, ValueError):  # costates of a last iterate that is not finite
        if outcome.converged:
            raise
        passed = None
    phases = []
    for i, (st, terms, closed) in enumerate(zip(chain.statements, outcome.cost_terms, loops, strict=True)):
        prefix = f"{st.name}: "
        own = {name.removeprefix(prefix): v for name, v in outcome.violations.items() if name.startswith(prefix)}
        entry = None if passed is None else passed[i]
        within = None if entry is None else entry.within
        if within is not None and closed is not None:
            within = replace(within, deviations=closed.start, handed=closed.handed)
        single = Outcome(
            extremal=outcome.extremals[i] if entry is None else entry.extremal,
            cost_terms=terms,
            converged=outcome.converged,
            message=outcome.message,
            violations=own,
            stats={**outcome.stats, **noted(None if closed is None else closed.mean)},
        )
        phases.append(Solution.of(single, method, within, closed))
    residuals = (
        ()
        if passed is None
        else tuple(link_residual(passed[i], passed[i + 1], link) for i, link in enumerate(chain.links))
    )
    return PhasesSolution(
        name=chain.name,
        method=method,
        converged=outcome.converged,
        message=outcome.message,
        phases=tuple(phases),
        link_residuals=residuals or (float("nan"),) * len(chain.links),
        violations=dict(outcome.violations),
        stats=dict(outcome.stats),
        links=chain.links,
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
