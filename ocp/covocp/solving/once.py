"""Solving a problem, or several phases as one, in one call."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast, overload

from covocp.base.arguments import checked, text, truth
from covocp.base.expressions import Given
from covocp.base.later import later
from covocp.base.threads import one_at_a_time
from covocp.problem.builder import Problem
from covocp.solution.solution import Solution
from covocp.solving.methods import METHODS, check_method
from covocp.solving.random_starts import multistart
from covocp.solving.solver import Solver

if TYPE_CHECKING:
    from covocp.problem.phases import Phases
    from covocp.solution.phases import PhasesSolution


@overload
def solve(problem: Problem, method: str = "ipopt", **options: Any) -> Solution: ...


@overload
def solve(problem: Phases, method: str = "ipopt", **options: Any) -> PhasesSolution: ...


@one_at_a_time
@checked(method=text, nominal=text, progress=truth, allow_failure=truth)
def solve(
    problem: Problem | Phases,
    method: str = "ipopt",
    *,
    intervals: Given = None,
    guess: Given = None,
    nominal: str = "combined",
    progress: bool = True,
    allow_failure: bool = False,
    parameters: Mapping[str, Any] | None = None,
    **options: Any,
) -> Solution | PhasesSolution:
    """Solve a problem; `Solver` behind it solves again without rebuilding. Or several phases as one problem.

    Args:
        problem: what to solve.
        method: a name in `methods()`.
        intervals: number of control intervals; None: 100, and 16 of the first mesh with `refine`. Of phases that of
            each, or a list of one for each.
        guess: where to start; see `Solver.solve`. Of phases a `PhasesSolution`, "multistart", or a guess for each
            phase: a list, or a dict by name of the phase.
        nominal: of an expected cost: "combined" or "deterministic"; see `Solver`.
        progress: whether to show the iterations on a terminal.
        allow_failure: return the last iterate of a run that did not converge instead of raising.
        parameters: values of parameters other than the declared ones, by name.
        options: of the mesh and of the method; see `Solver`.

    Returns:
        The solution; a `PhasesSolution` of phases.

    Raises:
        ProblemError: the statement or an option is wrong.
        SolveError: the method did not converge (carries the last iterate), or no feedback can keep a limit of X
            (carries the best solution without it).
        Interrupted: after Ctrl-C (a KeyboardInterrupt; carries the last iterate, or the best of several starts).
    """
    if not isinstance(problem, Problem):
        from covocp.problem.phases import Phases

        if isinstance(problem, Phases):
            check_method(method)
            run = {"intervals": intervals, "guess": guess, "nominal": nominal, "progress": progress}
            run |= {"allow_failure": allow_failure, "parameters": parameters, **options}
            return cast("PhasesSolution", later("solving.phases").solve_phases(problem, method, METHODS[method], **run))
    random = multistart(guess, options)
    extra: dict[str, Any] = {} if random is None else dict(zip(("starts", "seed"), random, strict=True))
    solver = Solver(problem, method, intervals=intervals, nominal=nominal, **options)
    return solver.solve(parameters, guess=guess, progress=progress, allow_failure=allow_failure, **extra)
