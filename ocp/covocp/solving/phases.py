"""Solving several phases as one problem."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

from covocp.base.errors import CovocpError, ProblemError, SolveError, evaluating, no_option, warn_user
from covocp.base.expressions import Given
from covocp.base.progress import Progress
from covocp.extremal.densities import impossible_in_phases
from covocp.extremal.links import ChainOutcome
from covocp.extremal.phase_curvature import curvature_between_links, stayed
from covocp.problem.phases import Phases
from covocp.solution.doubts import mention_doubts, mention_gap, mention_limits
from covocp.solution.patience import longest
from covocp.solution.phases import PhasesSolution
from covocp.solution.report import OTHERWISE, stated_first
from covocp.solving.attempts import counted, interrupted
from covocp.solving.between_nodes import AT_NODES, check_between
from covocp.solving.failure import impossible_noises, with_stalled
from covocp.solving.methods import METHODS, mesh_options, method_options
from covocp.solving.other_ways import MOST_ITERATIONS, STEPS, STEPS_IN_WORDS
from covocp.solving.phases_classical import without_noise
from covocp.solving.phases_gain import best_gains, graded_for, meeting_conditions, told
from covocp.solving.phases_given import intervals_of, of_each, values_of
from covocp.solving.phases_outcome import phases_solution
from covocp.solving.phases_runs import ChainRuns
from covocp.solving.random_starts import multistart
from covocp.solving.refining import FIRST, adapted, first_options
from covocp.solving.unused import mention_forgotten_in, mention_lengths
from covocp.statement.chain import Chain
from covocp.transcription.mesh import INTERVALS, Options

BEST = "ipopt"  # solves phases with the best gain, from which others start


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
    prepare = _preparing(method, module, nominal)
    random = multistart(guess, options)
    chain = phases.chain()
    for statement in chain.statements:
        check_between(statement, method)
    given, own = _divided(method, _method_options(prepare), options)
    asked = _asked(chain, method, nominal, intervals, given)
    if asked[0].refine is not None:
        own = adapted(method_options(method), own, asked[0].refine)
    guesses = of_each(chain, None if random is not None else guess)
    _mention(phases, chain, asked, guesses)
    values = values_of(chain, {} if parameters is None else parameters)
    run = {"guess": guess, "parameters": parameters, **{name: v for name, v in given.items() if name != "refine"}}
    starts = [guesses]
    best = None if random is not None else best_gains(phases, guesses, _best_solver(asked, run))
    if best is not None:
        asked = graded_for(best, asked)
        near = meeting_conditions(phases, best, parameters or {})
        starts = [list(near), list(best)] if near is not best else [list(best)]
    at_once = random is None and _may_be_had(method, asked[0], own)
    classical = without_noise(phases, chain, parameters or {}) if at_once else None
    with evaluating(chain.name), Progress(chain.name or "solving", progress) as reporter:
        runs = ChainRuns(chain, method, prepare, own, reporter, values, starts, classical)
        outcome = runs.solve(asked, random)
        if best is not None and method in (BEST, "auto") and not (outcome.converged or "max_iterations" in own):
            most = Progress("", show=False, iterations=MOST_ITERATIONS, within=reporter)
            outcome = _by_gauss_steps(outcome, asked, ChainRuns(chain, method, prepare, own, most, values, starts))
        outcome = with_stalled(_if_possible(chain, outcome), reporter)
        solution = told(phases, phases_solution(chain, outcome, method), best)
        if reporter.stop:
            raise interrupted(solution)
    return _finished(solution, allow_failure)


def _by_gauss_steps(failed: ChainOutcome, asked: tuple[Options, ...], runs: ChainRuns) -> ChainOutcome:
    """The outcome by Gauss steps where others lost a gain that is optimised, see `other_ways`; else as it failed.

    Args:
        failed: the run before.
        asked: options of the meshes.
        runs: from the same starts, with so many iterations.
    """
    if runs.progress.stop or any(own.covariance_step != "auto" or own.covariances == "eliminated" for own in asked):
        return failed
    try:
        again = runs.solve(tuple(replace(own, **STEPS) for own in asked))
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved
        return failed
    both = counted(failed, again)
    if not again.converged:
        return replace(failed, stats={**failed.stats, **both})
    return replace(again, stats={**again.stats, **both, OTHERWISE: STEPS_IN_WORDS})


def _preparing(method: str, module: str, nominal: str) -> Callable[..., Any]:
    """What makes phases ready for a method.

    Raises:
        ProblemError: the method takes none, or no such nominal.
    """
    prepare = getattr(importlib.import_module(module), "prepare_chain", None)
    if prepare is None or nominal != "combined":
        raise ProblemError(
            "Phases are not solved that way.",
            expected="nominal='combined', and a method that takes phases",
            received=f"method='{method}'" if prepare is None else f"nominal='{nominal}'",
            remedy="leave the option out",
        )
    made_ready: Callable[..., Any] = prepare
    return made_ready


def _may_be_had(method: str, options: Options, own: dict[str, Any]) -> bool:
    """Whether an optimum may be had without a run: Ipopt's, of which no other digits or iterations are asked for."""
    asked = "max_iterations" in own or own.get("tolerance") is not None
    by_ipopt = method in (BEST, "auto") and own.get("plugin", BEST) == BEST
    return by_ipopt and options.refine is None and not asked


def _mention(phases: Phases, chain: Chain, asked: Sequence[Options], guesses: Sequence[Given]) -> None:
    """Warn of guesses that are of another length than the mesh of their phase, and of what nothing depends on."""
    for statement, options, guess in zip(chain.statements, asked, guesses, strict=True):
        if isinstance(guess, Mapping):
            mention_lengths({str(key): value for key, value in guess.items()}, options, statement)
    mention_forgotten_in(phases)


def _if_possible(chain: Chain, outcome: ChainOutcome) -> ChainOutcome:
    """The outcome; one whose densities are none has not converged to anything that means something."""
    impossible = impossible_in_phases(outcome.extremals, chain.links) if outcome.converged else ""
    if not impossible:
        return outcome
    return replace(outcome, converged=False, message=f"the solution found means nothing: {impossible}")


def _divided(method: str, of_method: Sequence[str], options: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of the mesh, and those of the method.

    Raises:
        ProblemError: one that neither has.
    """
    known = [field.name for field in fields(Options)]
    for name in options:
        if name not in known and name not in of_method:
            raise no_option(f"The method '{method}'", name, options[name], [*mesh_options(method), *of_method], ())
    of_mesh = {name: value for name, value in options.items() if name in known}
    return of_mesh, {name: value for name, value in options.items() if name in of_method}


def _best_solver(asked: tuple[Options, ...], run: dict[str, Any]) -> Callable[[Phases], PhasesSolution]:
    """Solves other phases on the meshes that are asked for, quietly, and with these arguments besides."""
    counts = [own.intervals for own in asked]
    quiet: dict[str, Any] = {"nominal": "combined", "progress": False, "allow_failure": True}
    return partial(solve_phases, method=BEST, module=METHODS[BEST], intervals=counts, **quiet, **run)


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


def _finished(solution: PhasesSolution, allow_failure: bool) -> PhasesSolution:
    """A solution with what the user must know about it, or the error that it did not converge."""
    if not solution.converged:
        if allow_failure:
            return solution
        lines = [f"  {name}: {value:.6g}" for name, value in stated_first(solution.violations)[:10]]
        violated = "\n  violated constraints, by their largest violation:\n" + "\n".join(lines) if lines else ""
        named = f" of '{solution.name}'" if solution.name else ""
        noise = impossible_noises([phase.extremal for phase in solution.phases], solution.message)
        raise SolveError(
            f"The phases{named} were not solved by {solution.method}: {solution.message}.{violated}{noise}"
            "\n  The last iterate is on this error (.solution): look at its phases, or use it as a guess.",
            solution=solution,  # type: ignore[arg-type]
            violations=solution.violations,
        )
    for phase in solution.phases:
        mention_doubts(phase)
        mention_limits(phase)
    mention_gap(solution.stats)
    _mention_saddles(solution)
    return solution


def _mention_saddles(solution: PhasesSolution) -> None:
    """Warn of phases that keep a decision or a free initial state where its slope vanishes at no minimum."""
    extremals, links = [phase.extremal for phase in solution.phases], solution.links
    for i, phase in enumerate(solution.phases):
        if not stayed(extremals[i], links[i - 1] if i else None):
            continue
        found = curvature_between_links(extremals, links, i, longest(phase.stats))
        if found is not None and found.verdict == "saddle":
            warn_user(
                f"The phase '{phase.name}' is no minimum: with its ends held the reduced Hessian has a negative "
                f"curvature, {found.value / found.largest:.1e} of its largest. Start elsewhere: another guess of its "
                "decisions and free initial values, or guess='multistart'."
            )
