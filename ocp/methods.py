"""Solving: methods are looked up by name, and an outcome becomes a solution or an error."""

from __future__ import annotations

import importlib
import inspect
import warnings
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, cast

import numpy as np

from covocp.checks import check_kind, is_whole
from covocp.densities import impossible_density
from covocp.errors import CovocpError, CovocpWarning, ProblemError, SolveError, describe, no_option, spelling, warn_user
from covocp.evaluate import evaluate_controls, evaluation_mesh
from covocp.expected import deterministic
from covocp.extremal import Guess, Outcome, Prepared
from covocp.lookup import stacked_parameters
from covocp.matrices import Array
from covocp.mesh import Options
from covocp.problem import Problem
from covocp.progress import Progress
from covocp.solution import Solution
from covocp.starting import make_guess, random_guesses
from covocp.statement import Statement

METHODS = {"ipopt": "covocp.solvers.ipopt", "gradient": "covocp.solvers.gradient"}

# Relative error of the cost, estimated by halving the steps, above which a mesh counts as too coarse.
COARSE_MESH = 2e-4
# A run that ends after so few iterations began at a stationary point, which need not be a minimum.
SUSPICIOUS_ITERATIONS = 3
# A run whose control moved no further than this share of it (or in its unit) ended where it began: the same suspicion.
UNMOVED = 1e-6
NEGATIVE_CURVATURE = -1e-6
ESCAPES = (1.0, -1.0)
STARTS = 8
# Arguments of `solve` beside the options of mesh and method.
ARGUMENTS = ("method", "guess", "nominal", "progress", "allow_failure", "parameters", "starts", "seed")
NOMINALS = ("combined", "deterministic")
# Share of the cost of the problem's own guess below which costs differ by the solver's tolerance only: one of slopes,
# so that costs have its square. Nothing else tells the size of a cost whose optimum is zero.
ROUNDOFF = 1e-10
# Relative decrease of the cost from which on it is asked whether both are zero.
SUSPICIOUS_GAIN = 0.5
# Relative excess of the cost over the classical design's above which a solution is a spurious stationary point.
WORSE = 1e-6


def methods() -> tuple[str, ...]:
    """Names of the methods installed."""
    return tuple(METHODS)


def method_options(method: str) -> dict[str, Any]:
    """Options of a method besides those of the mesh, with their defaults."""
    parameters = inspect.signature(importlib.import_module(METHODS[method]).prepare).parameters
    return {name: p.default for name, p in parameters.items() if p.kind is p.KEYWORD_ONLY}


def check_problem(problem: Any) -> None:
    """What is solved or compared must be a problem.

    Raises:
        ProblemError: it is something else.
    """
    check_kind(problem, Problem, "pass the Problem itself (solutions go into guess=)")


class Solver:
    """A problem made ready for one method: built once, solved again with new parameters and guesses.

    Args:
        problem: what to solve.
        method: a name in `methods()`.
        intervals: number of control intervals.
        nominal: of an expected cost: "combined", chosen together with filter and feedback, or "deterministic", from
            the cost without noise (quadratic synthesis), filter and feedback around it.
        options: of the mesh (`control`, `substeps`, `grid`, `segments`, `covariances`, `covariance_step`) and of the
            method.

    Raises:
        ProblemError: unknown method or option, or a statement that is wrong.
    """

    def __init__(
        self,
        problem: Problem,
        method: str = "ipopt",
        *,
        intervals: int = 100,
        nominal: str = "combined",
        **options: Any,
    ) -> None:
        """Build the statement and make the method ready."""
        if method not in METHODS:
            raise ProblemError(
                describe(
                    "There is no such method.",
                    expected="one of " + ", ".join(repr(name) for name in METHODS),
                    received=repr(method),
                    remedy=spelling(method, METHODS, "correct method="),
                )
            )
        check_problem(problem)
        prepare = importlib.import_module(METHODS[method]).prepare
        known, own = {field.name for field in fields(Options)}, method_options(method)
        for name in options:
            if name not in known and name not in own:
                raise no_option(f"The method '{method}'", name, options[name], [*known, *own], ARGUMENTS)
        if nominal not in NOMINALS:
            raise ProblemError(
                describe(
                    "The option 'nominal' has an unknown value.",
                    expected="'combined' or 'deterministic'",
                    received=repr(nominal),
                    remedy="correct nominal=; evaluate(problem, nominal=...) takes any given nominal",
                )
            )
        self.method = method
        self.nominal = nominal
        self.statement: Statement = problem.statement()
        self._problem, self._classical = problem, cast("Solver | None", None)
        self._options = Options(intervals=intervals, **{k: v for k, v in options.items() if k in known})
        if nominal == "deterministic":  # the steps of what runs around it
            around = evaluation_mesh(self.statement, self._options, self.statement.values)
            self._options = replace(self._options, substeps=around.substeps)
        solved = self.statement if nominal == "combined" else deterministic(problem).statement()
        self._solved = solved
        self._prepared = cast(
            Prepared, prepare(solved, self._options, **{k: v for k, v in options.items() if k in own})
        )

    def solve(
        self,
        parameters: Mapping[str, Any] | None = None,
        *,
        guess: Any = None,
        progress: bool = True,
        allow_failure: bool = False,
        starts: int = STARTS,
        seed: int = 0,
    ) -> Solution:
        """Solve for some values of the parameters.

        Args:
            parameters: new values of known parameters and of means of unknowns, by name; the others keep theirs.
            guess: None: the problem's own; a `Solution` (also on another mesh, or of another problem with the same
                names): warm start; "multistart": the best of several random starts; a dict of name to guess.
            progress: whether to show the iterations on a terminal.
            allow_failure: return the last iterate of a run that did not converge instead of raising.
            starts: number of random starts of "multistart".
            seed: of the random starts.

        Returns:
            The solution. After Ctrl-C the last iterate, with a warning; its `converged` is false.

        Raises:
            ProblemError: a name or a guess is wrong.
            SolveError: the method did not converge (carries the last iterate).
        """
        values = stacked_parameters(self.statement, parameters or {})
        with Progress(self.statement.name or "solving", progress) as reporter:
            if isinstance(guess, str):
                outcome = self._multistart(guess, values, starts, seed, reporter)
            else:
                start = make_guess(self._solved, self._prepared.mesh, values, guess)
                outcome = self._prepared.solve(values, start, reporter)
                outcome = self._leave_saddle(outcome, values, reporter, start)
        if self.nominal == "deterministic":
            outcome = self._closed(outcome)
        solution = self._finish(outcome, allow_failure, interrupted=reporter.stop)
        return self._beside_classical(solution, values)

    def _closed(self, outcome: Outcome) -> Outcome:
        """Filter and feedback around the nominal of the deterministic cost."""
        found = outcome.extremal
        mesh = evaluation_mesh(self.statement, self._options, found.parameters)
        t = found.trajectory
        closed = evaluate_controls(self.statement, mesh, t.u, t.duration, found.parameters, t.x[0])
        return replace(
            closed,
            converged=outcome.converged and closed.converged,
            message=f"{outcome.message}: nominal of the deterministic cost, filter and feedback around it",
            violations=outcome.violations,
            stats={**outcome.stats, "nominal": "deterministic"},
        )

    def _beside_classical(self, solution: Solution, values: Array) -> Solution:
        """The solution with the cost of the classical design beside it; a worse one is a spurious stationary point."""
        if self.nominal != "combined" or not self.statement.behind or not solution.converged:
            return solution
        try:
            if self._classical is None:
                mesh = {field.name: getattr(self._options, field.name) for field in fields(Options)}
                self._classical = Solver(self._problem, "ipopt", nominal="deterministic", **mesh)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", CovocpWarning)  # they concern another solution
                given = values[: self.statement.np]
                classical = self._classical._solve_values(given)
        except CovocpError as error:  # no deterministic cost: there is nothing to compare with
            return _noted(solution, classical_missing=str(error).partition("\n")[0])
        if classical is None:
            return _noted(solution, classical_missing="The problem without noise was not solved.")
        excess = solution.cost - classical
        worse = excess > (WORSE + solution.mesh_error) * abs(classical)
        suspicious = worse or excess < -SUSPICIOUS_GAIN * abs(classical)
        if suspicious and is_roundoff(excess, self.statement, self._options, given):
            return _noted(solution, classical_cost=classical, classical_same=True)
        if worse:
            warn_user(
                f"This is a spurious stationary point: its expected cost {solution.cost:.8g} is above that of the "
                f"classical design, {classical:.8g}. Start from it: guess=solve(problem, nominal='deterministic')."
            )
        return _noted(solution, classical_cost=classical)

    def _solve_values(self, values: Array) -> float | None:
        """Cost of the classical design for stacked parameters; None where it was not found."""
        with Progress("", show=False) as reporter:
            start = make_guess(self._solved, self._prepared.mesh, values, None)
            outcome = self._closed(self._prepared.solve(values, start, reporter))
        return float(sum(outcome.cost_terms.values())) if outcome.converged else None

    def _multistart(self, guess: str, values: Array, starts: int, seed: int, reporter: Progress) -> Outcome:
        """The best of the problem's own start and several random ones."""
        if guess != "multistart":
            raise ProblemError(
                describe(
                    "The guess is an unknown word.",
                    expected="None, 'multistart', a Solution, or a dict of name to guess",
                    received=repr(guess),
                    remedy="correct guess=",
                )
            )
        for name, number, least in (("starts", starts, 0), ("seed", seed, 0)):
            if not is_whole(number, least):
                raise ProblemError(
                    describe(
                        f"The option '{name}' is not a whole number.",
                        expected="0, 1, 2, ...",
                        received=repr(number),
                        remedy=f"correct {name}=",
                    )
                )
        best: Outcome | None = None
        costs = []
        for start in random_guesses(self._solved, self._prepared.mesh, values, starts, seed):
            outcome = self._prepared.solve(values, start, reporter)
            cost = sum(outcome.cost_terms.values())
            costs.append(cost if outcome.converged else np.nan)
            if best is None or (outcome.converged, -cost) > (best.converged, -sum(best.cost_terms.values())):
                best = outcome
            if reporter.stop:
                break
        assert best is not None
        return _with_stats(best, starts=costs)

    def _leave_saddle(self, outcome: Outcome, values: Array, reporter: Progress, start: Guess) -> Outcome:
        """Where a run ended as soon, or where, it began, look at the curvature, and leave a saddle along it."""
        iterations = outcome.stats.get("iterations", -1)
        exact = outcome.stats.get("hessian") == "exact"
        few = iterations <= SUSPICIOUS_ITERATIONS and (start.warm or not exact or iterations <= 0)
        before, after = start.trajectory.u, outcome.extremal.trajectory.u
        stayed = before.size > 0 and bool(np.abs(after - before).max() <= UNMOVED * np.abs(before).max() + UNMOVED)
        if not outcome.converged or not (few or stayed):
            return outcome
        from covocp.curvature import smallest_curvature

        curvature = smallest_curvature(outcome.extremal)
        if curvature is None or curvature.value > NEGATIVE_CURVATURE * curvature.largest:
            return outcome
        candidates = []
        for sign in ESCAPES:
            moved = curvature.displaced(outcome.extremal, sign)
            displaced = make_guess(self._solved, self._prepared.mesh, values, moved)
            candidates.append(self._prepared.solve(values, displaced, reporter))
        better = [
            c for c in candidates if c.converged and sum(c.cost_terms.values()) < sum(outcome.cost_terms.values())
        ]
        if not better:
            return outcome
        warn_user(
            "The run ended at a saddle (negative curvature of the reduced Hessian); it was left along that direction."
        )
        return _with_stats(min(better, key=lambda c: sum(c.cost_terms.values())), left_saddle=True)

    def _finish(self, outcome: Outcome, allow_failure: bool, interrupted: bool) -> Solution:
        """An outcome as a solution, with what the user must know about it."""
        impossible = impossible_density(outcome.extremal) if outcome.converged else ""
        if impossible:
            outcome = replace(outcome, converged=False, message=f"the solution found means nothing: {impossible}")
        solution = Solution.of(outcome, self.method)
        if not outcome.converged:
            if interrupted:
                message = "Interrupted: this is the last iterate, not a solution."
                warn_user(message)
            if allow_failure or interrupted:
                return solution
            lines = [f"  {name}: {value:.6g}" for name, value in list(outcome.violations.items())[:10]]
            violated = "\n  violated constraints, by their largest violation:\n" + "\n".join(lines) if lines else ""
            raise SolveError(
                f"'{self.statement.name or 'The problem'}' was not solved by {self.method}: {outcome.message}."
                f"{violated}"
                "\n  The last iterate is on this error (.solution): plot it, save it, or use it as a guess.",
                solution=solution,
                violations=outcome.violations,
            )
        error = solution.mesh_error
        if not error <= COARSE_MESH:
            warn_user(
                f"The mesh is too coarse: halving the integration steps changes the cost by {error:.1e} (relative). "
                "Use more intervals or substeps."
            )
        smallest = solution.smallest_eigenvalue
        if smallest < 0 and not solution.semidefinite:
            warn_user(
                f"A covariance is indefinite (smallest eigenvalue {smallest:.3g}); use covariance_step='gauss' or "
                "more intervals."
            )
        return solution


def is_roundoff(cost: float, statement: Statement, options: Options, parameters: Array) -> bool:
    """Whether a cost, or a difference of costs, is nothing beside the cost of the problem's own guess."""
    mesh = evaluation_mesh(statement, options, parameters)
    start = make_guess(statement, mesh, parameters, None).trajectory
    outcome = evaluate_controls(statement, mesh, start.u, start.duration, parameters, start.x[0])
    return abs(cost) <= ROUNDOFF * abs(sum(outcome.cost_terms.values()))


def _with_stats(outcome: Outcome, **stats: Any) -> Outcome:
    return replace(outcome, stats={**outcome.stats, **stats})


def _noted(solution: Solution, **stats: Any) -> Solution:
    return replace(solution, stats={**solution.stats, **stats})


def solve(
    problem: Problem,
    method: str = "ipopt",
    *,
    intervals: int = 100,
    guess: Any = None,
    nominal: str = "combined",
    progress: bool = True,
    allow_failure: bool = False,
    parameters: Mapping[str, Any] | None = None,
    **options: Any,
) -> Solution:
    """Solve a problem; `Solver` behind it solves again without rebuilding.

    Args:
        problem: what to solve.
        method: a name in `methods()`.
        intervals: number of control intervals.
        guess: where to start; see `Solver.solve`.
        nominal: of an expected cost: "combined" or "deterministic"; see `Solver`.
        progress: whether to show the iterations on a terminal.
        allow_failure: return the last iterate of a run that did not converge instead of raising.
        parameters: values of parameters other than the declared ones, by name.
        options: of the mesh and of the method; see `Solver`.

    Returns:
        The solution. After Ctrl-C the last iterate, with a warning; its `converged` is false.

    Raises:
        ProblemError: the statement or an option is wrong.
        SolveError: the method did not converge (carries the last iterate).
    """
    extra = {name: options.pop(name) for name in ("starts", "seed") if name in options}
    if extra and not isinstance(guess, str):
        raise ProblemError(
            describe(
                "The options of multistart are given, but not multistart.",
                expected="guess='multistart'",
                received=", ".join(f"{name}={value!r}" for name, value in extra.items()) + " without it",
                remedy="add guess='multistart', or remove them",
            )
        )
    solver = Solver(problem, method, intervals=intervals, nominal=nominal, **options)
    return solver.solve(parameters, guess=guess, progress=progress, allow_failure=allow_failure, **extra)
