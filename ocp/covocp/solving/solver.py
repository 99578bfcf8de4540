"""Solving: methods are looked up by name, and an outcome becomes a solution or an error."""

from __future__ import annotations

import time
from collections.abc import Mapping
from copy import copy
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.base.arguments import checked, optional, positive, text, truth, whole
from covocp.base.errors import OutsideDomainError, evaluating
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.threads import methods_one_at_a_time
from covocp.extremal.extremal import Guess, Outcome, Prepared
from covocp.extremal.given_controls import evaluation_mesh
from covocp.extremal.guessed_steps import steps_along
from covocp.extremal.mesh_error import OPTIMISED
from covocp.problem.builder import Problem
from covocp.problem.expected_cost import deterministic, statement_of
from covocp.solution.doubts import mention_doubts, mention_form, mention_gap, mention_limits
from covocp.solution.solution import Solution
from covocp.solving import refining
from covocp.solving.attempts import best_of, counted, from_starts, interrupted, mention_left, with_stats
from covocp.solving.automatic import is_suited
from covocp.solving.beside_classical import ClassicalDesign, Deterministic
from covocp.solving.beside_found import beside_found
from covocp.solving.between_nodes import AT_NODES, check_between, watched
from covocp.solving.coarse_start import from_coarser
from covocp.solving.elsewhere import Elsewhere
from covocp.solving.elsewhere import later as later_of
from covocp.solving.exact_rows import made_ready
from covocp.solving.failure import failure, possible, with_stalled
from covocp.solving.farther import in_larger_units
from covocp.solving.from_best_gain import bounded_below, from_best, part
from covocp.solving.from_classical import SOON, impatient
from covocp.solving.gain_start import GainStart, beyond, gain_first, with_best_gain_problems, with_gain_told
from covocp.solving.held_duration import off_the_limit
from covocp.solving.kept_near import kept_near
from covocp.solving.longer import from_longer
from covocp.solving.loosened import PATIENCE
from covocp.solving.methods import check_method, divided_options, method_options
from covocp.solving.methods import check_problem as check_problem
from covocp.solving.other_minima import away_from_saddle, without_turns
from covocp.solving.other_starts import Falling, OtherStarts
from covocp.solving.random_starts import STARTS, check_multistart, random_guesses
from covocp.solving.silent import mention_silent
from covocp.solving.unused import mention_clock, mention_forgotten, mention_lengths
from covocp.solving.warm_start import Later, make_guesses
from covocp.statement.magnitudes import check_magnitudes
from covocp.statement.names import stacked_parameters
from covocp.statement.statement import Statement
from covocp.transcription.grading import graded
from covocp.transcription.instants import with_instants
from covocp.transcription.mesh import INTERVALS, Mesh, Options, step_unit, with_substeps
from covocp.transcription.starts import own_start, starts_kept

if TYPE_CHECKING:
    from covocp.solving.suited_mesh import Beginning

OTHER_WAY = "\n  method='auto' may find a way: it tries method 'reduced' first."
# Times of the runs of a solution [s], and of what else was waited for: runs that lead to its start, what is looked at.
RUN_SECONDS, OTHER_SECONDS = ("build_seconds", "solve_seconds"), "other_seconds"
# Rows of a covariance from which on a look at the steps along the guess is cheaper than a run that is made again.
LARGE = 16


@methods_one_at_a_time
class Solver(OtherStarts):
    """A problem made ready for one method: built once, solved again with new parameters and guesses.

    Args:
        problem: what to solve.
        method: a name in `methods()`.
        intervals: number of control intervals; None: 100, and 16 of the first mesh with `refine`.
        nominal: of an expected cost: "combined", chosen together with filter and feedback, or "deterministic", from
            the cost without noise (quadratic synthesis), filter and feedback around it.
        options: of the mesh (`control`, `substeps`, `grid`, `segments`, `covariances`, `covariance_step`, `points`,
            `refine`) and of the method.

    Raises:
        ProblemError: unknown method or option, or a statement that is wrong.
    """

    @checked(method=text, nominal=text)
    def __init__(
        self,
        problem: Problem,
        method: str = "ipopt",
        *,
        intervals: int | None = None,
        nominal: str = "combined",
        **options: Any,
    ) -> None:
        """Build the statement and make the method ready."""
        begin = time.perf_counter()
        check_method(method)
        check_problem(problem)
        given, own = divided_options(method, nominal, options)
        self.method = self._by = method  # what makes ready: another one where only that finds a way
        self.nominal = nominal
        self.statement: Statement = problem.statement()
        check_magnitudes(self.statement, self.statement.values)
        check_between(self.statement, method)
        self._problem = copy(problem)  # what is declared later belongs to later solvers
        self._elsewhere = Elsewhere(
            declarations=problem.declarations,
            statement=self.statement,
            duration_read=problem.duration_read,
            make=partial(Solver, method=method, intervals=intervals, nominal=nominal, **options),
        )
        count = INTERVALS if (refine := options.get("refine")) is None else refining.FIRST
        asked = Options(intervals=count if intervals is None else intervals, **given)
        if refine is not None:
            asked = refining.first_options(self.statement, asked, nominal, points=method != AT_NODES)
        best = with_best_gain_problems(problem)
        mesh = {field.name: getattr(asked, field.name) for field in fields(Options) if field.name != "refine"}
        self._best = tuple(Solver(one, "ipopt", **mesh) for one in best)
        self._ungraded = best[-1].statement() if best else self.statement, asked
        values = self.statement.values
        self._asked = with_instants(self.statement, graded(*self._ungraded, values), values)
        self._values = self.statement.values
        self._options = self._laid_out()
        self._classical = self._classical_design()
        self._own_steps = self._asked.substeps == "auto" and refine is None
        self._looked = self._ran = self._at_once = False  # at the steps along the guess; from a start; without a run
        self._last: tuple[Array, Outcome] | None = None  # values, and what came of them by itself
        self._borne: Beginning | None = None  # what the nodes are known to be graded for
        solved = self.statement if nominal == "combined" else statement_of(deterministic(problem.declarations))
        self._solved = solved
        self._own = own
        self._by_ipopt = method in ("ipopt", "auto") and str(self._own.get("plugin", "ipopt")) == "ipopt"
        self._counted = "max_iterations" in own  # by the user: nothing is run again in vain
        self._otherwise = bool(self._best) and self._by_ipopt and not self._counted
        if self._otherwise:  # there is another way
            self._own["max_iterations"] = PATIENCE
        whole = nominal == "combined" and self._by_ipopt and refine is None
        self._asked_for = "max_iterations" in own or own.get("tolerance") is not None
        self._patient: dict[str, Any] = {}  # options of a run that is not given up soon
        if whole and not self._asked_for and impatient(self.statement):
            self._own, self._patient = {**self._own, "max_iterations": SOON}, {"max_iterations": None}
        if asked.refine is not None:
            self._own = refining.adapted(method_options(method), self._own, asked.refine)
        self._prepared = self._ready(self._options)
        self._first, self._remade = (self._options, self._prepared), refine is not None or bool(watched(solved))
        if not problem.doubts_told:
            mention_silent(problem.declarations)
        mention_forgotten(problem)
        self._problem.doubts_told = True
        mention_lengths(self.statement.guesses, self._options, self.statement)
        self._made_in = time.perf_counter() - begin  # [s], told with the first solution

    @checked(
        progress=truth,
        allow_failure=truth,
        assess=truth,
        time_limit=optional(positive),
        iteration_limit=optional(whole(0)),
    )
    def solve(
        self,
        parameters: Mapping[str, Any] | None = None,
        *,
        initial: Mapping[Any, Any] | None = None,
        means: Mapping[Any, Any] | None = None,
        covariance: Given = None,
        duration: float | None = None,
        guess: Given = None,
        elapsed: float | None = None,
        progress: bool = True,
        allow_failure: bool = False,
        starts: int = STARTS,
        seed: int = 0,
        assess: bool = True,
        time_limit: float | None = None,
        iteration_limit: int | None = None,
    ) -> Solution:
        """Solve for some values of the parameters, or from elsewhere.

        With any of `initial`, `means`, `covariance` and `duration` the problem is that of `movable`, built at the first
        such call: its solution has "initial_<name>" among its parameters, and is evaluated and simulated from there.

        Args:
            parameters: new values of known parameters and of means of unknowns, by name; the others keep theirs.
            initial: other initial values of states, by symbol or name, NaN in entries that are free; the others keep
                theirs.
            means: other means of unknowns, by symbol or name.
            covariance: another initial covariance of what is estimated, (n, n), rows of states, then of unknowns; or
                initial values of matrices, by symbol or name.
            duration: another duration [s]; builds a solver of its own, of which the last few are kept.
            guess: None: the problem's own; a `Solution` (also on another mesh, or of another problem with the same
                names): warm start; "multistart": the best of several random starts; a dict of name to guess.
            elapsed: time that has passed of the plan in guess= [s]: what is left of it is where to start.
            progress: whether to show the iterations on a terminal.
            allow_failure: return the last iterate of a run that did not converge instead of raising.
            starts: number of random starts of "multistart".
            seed: of the random starts.
            assess: False in a loop that solves again and again: what is looked at after a run is left out (error of the
                mesh and steps that are too long, curvature where a run ends as it began, cost of the classical design,
                warnings). `mesh_error` is then nan; the residuals that a converged run must meet are the same.
            time_limit: of all runs together [s], looked at after each iteration; building and assessing take theirs.
            iteration_limit: of all runs together.

        Returns:
            The solution; where a limit was reached the best iterate, with what it violates, without raising:
            the cheapest that meets the conditions, else that which violates least (by "gradient" the last one).

        Raises:
            ProblemError: a name or a guess is wrong.
            SolveError: the method did not converge (carries the last iterate), or no feedback can keep a limit of X
            (carries the best solution without it).
            Interrupted: after Ctrl-C (a KeyboardInterrupt; carries the last iterate, or the best of several starts).
        """
        mention_clock(self.statement, elapsed, parameters)
        if not all(value is None for value in (initial, means, covariance, duration)):
            other, known = self._elsewhere.solver(duration)
            return other.solve(
                self._elsewhere.values(known, parameters, initial, means, covariance),
                guess=guess,
                elapsed=elapsed,
                progress=progress,
                allow_failure=allow_failure,
                starts=starts,
                seed=seed,
                assess=assess,
                time_limit=time_limit,
                iteration_limit=iteration_limit,
            )
        begin = time.perf_counter()
        check_multistart(guess, starts, seed)
        values = stacked_parameters(self.statement, {} if parameters is None else parameters)
        check_magnitudes(self.statement, values)
        if self._remade:
            self._keep(*self._first)
        with evaluating(self.statement.name):
            self._suit(values, nodes=assess)
        if isinstance(guess, Mapping):
            mention_lengths({str(key): value for key, value in guess.items()}, self._options, self.statement)
        guess = later_of(guess, elapsed)
        title = self.statement.name or "solving"
        with evaluating(self.statement.name), starts_kept():
            with Progress(title, progress, seconds=time_limit, iterations=iteration_limit) as reporter:
                if isinstance(guess, str):
                    outcome, first = self._from_many(values, (starts, seed), reporter, assess=assess), None
                else:
                    own, given = self._problem, parameters or {}
                    started = partial(gain_first, self._best, own, self._solved, given, allow_failure=allow_failure)
                    outcome, first = self._from_given(values, started, guess, reporter, assess=assess)
                outcome = without_turns(self._prepared, outcome, values, reporter) if assess else outcome
                outcome = self._with_finer_steps(outcome, values, reporter) if assess else outcome
                outcome = self._refined(outcome, values, reporter)
                without_noise = outcome
                if self.nominal == "deterministic":
                    outcome = self._closed(outcome, values, reporter)
            if reporter.asked:
                raise interrupted(Solution.of(outcome, self._by))
            outcome = with_gain_told(self._problem, outcome, first)
            if reporter.spent and not outcome.converged:
                outcome = replace(outcome, message=f"stopped at {reporter.spent}")
                return self._timed(self._finish(outcome, first, allow_failure=True, assess=assess), begin)
            outcome = with_stalled(outcome, reporter)
            solution = self._finish(outcome, first, allow_failure=allow_failure, assess=assess)
            if assess and self.nominal == "deterministic" and without_noise.converged and solution.converged:
                mention_form(without_noise.extremal, cost="the cost without noise", remedy="Use more intervals.")
            return self._timed(self._beside_classical(solution, values) if assess else solution, begin)

    def _timed(self, solution: Solution, begin: float) -> Solution:
        """The solution with the time that was waited for it beside that of its own runs: for others, and in looking."""
        waited, self._made_in = time.perf_counter() - begin + self._made_in, 0.0
        told = sum(float(solution.stats.get(name, 0.0)) for name in RUN_SECONDS)
        return with_stats(solution, **{OTHER_SECONDS: max(waited - told, 0.0)})

    def _from_guess(
        self, values: Array, gain_start: GainStart, guess: Given, reporter: Progress, *, assess: bool
    ) -> tuple[Outcome, Solution | None]:
        """Solve from a guess, an unusable solution left for None; also the best gain's solution where one was made."""
        given = guess
        first, guess = gain_start(guess, reporter)
        if isinstance(guess, Later | Solution):
            self._take_steps((guess.plan if isinstance(guess, Later) else guess).mesh)
        if guess is None and first is None:
            if assess:
                self._look_at_steps(values)
            if (optimum := self._at_classical(values, reporter)) is not None:
                return away_from_saddle(self._prepared, optimum, values, reporter, None) if assess else optimum, None
        self._at_once, found = False, None
        if isinstance(guess, Solution):
            own = first is guess
            further = own and self._by_ipopt
            found = from_best(self._solved, self._prepared, values, guess, reporter, further=further, own=own)
        if found is not None and found[2]:  # the optimum with the best gain: nobody looks for another one beside it
            return found[0], first
        try:
            outcome, start = found[:2] if found is not None else self._from_start(values, guess, first, reporter)
        except OutsideDomainError as error:
            if not isinstance(given, Later | Solution):
                raise
            mention_left(error)
            return self._from_guess(values, gain_start, None, reporter, assess=assess)
        if not self._counted:
            outcome, start = from_longer((outcome, start), self._prepared, self._solved, values, guess, reporter)
        ready, where = partial(self._ready, self._options), (values, reporter, start)
        outcome, prepared = in_larger_units(ready, self._prepared, outcome, *where, first=not self._ran)
        self._ran = True
        if not outcome.converged and self._by_ipopt and not self._counted:
            near, mesh = partial(self._ready, self._options, by="ipopt"), self._prepared.mesh
            guesses = partial(make_guesses, self._solved, mesh, values, guess)
            outcome, prepared = kept_near(near, prepared, outcome, guesses, reporter, self._own)
        if not outcome.converged:
            outcome, prepared = self._from_classical(outcome, prepared, values, reporter)
        if prepared is not self._prepared:
            self._keep(self._options, prepared)
        outcome = off_the_limit(ready, self._prepared, outcome, *where)
        if assess and first is None:
            outcome, start = self._beside((outcome, start), self._prepared, guess, reporter)
        return away_from_saddle(self._prepared, outcome, values, reporter, start) if assess else outcome, first

    def _from_many(self, values: Array, drawn: tuple[int, int], reporter: Progress, *, assess: bool) -> Outcome:
        """The best of what is found without random starts and of so many of these, with a seed."""
        here, prepared = (self._solved, self._prepared.mesh, values), self._prepared
        if self._patient:
            prepared = self._ready(self._options, **self._patient)

        def alone() -> tuple[Outcome, Guess]:
            found = from_starts(prepared, values, make_guesses(*here, None), reporter)
            return self._beside(found, prepared, None, reporter) if assess else found

        outcome: Outcome = best_of(prepared, values, random_guesses(*here, *drawn), drawn[0] + 1, reporter, alone)
        return away_from_saddle(self._prepared, outcome, values, reporter, None) if assess else outcome

    def _beside(self, found: tuple[Outcome, Guess], prepared: Prepared, guess: Given, reporter: Progress) -> Any:
        """What was found, or a cheaper minimum that other starts lead to on a coarse mesh, and its start."""
        if self._counted:
            return found
        slow, own = self._by == "gradient", self._own if self._by_ipopt else {}
        problem = self._solved, self._options, self._values
        return beside_found(found, prepared, problem, guess, reporter, slow=slow, own=own)

    def _from_start(
        self, values: Array, guess: Given, best: Solution | None, reporter: Progress
    ) -> tuple[Outcome, Guess]:
        """Solve from a guess; one that was made from the best gain, or None, perhaps by a coarser mesh."""
        guesses = refining.first_guesses(self._options, self._solved, self._prepared.mesh, values, guess)
        first = None
        if guess is None or best is not None:
            run = (values, guess, reporter)
            first = from_coarser(self._solved, self._options, self._prepared.mesh, self._ready, run)
        starts = [guesses]
        if first is not None:
            coarse = Solution.of(first, self._by, assess=False)
            starts.insert(0, make_guesses(self._solved, self._prepared.mesh, values, coarse))
        if best is not None and guess is not best:
            starts.append(make_guesses(self._solved, self._prepared.mesh, values, best))
        # what leads astray on such steps goes another way
        given = isinstance(guess, Later | Solution)
        watched_over = self._otherwise and self._prepared.mesh.step == "rk4" and bounded_below(self._solved)
        for several in starts:
            most = reporter
            if watched_over and (best is not None or given):
                most = Falling(reporter) if best is None else part(reporter, None, best)
            outcome, start = from_starts(self._prepared, values, several, most)
            if most is not reporter and most.spent and not outcome.converged:
                outcome = replace(outcome, message=f"stopped at {most.spent}")
            if outcome.converged or reporter.stop:
                break
        if best is not None and self._otherwise and not outcome.converged and not reporter.stop:
            outcome = self._otherwise_solved(outcome, best, guess if isinstance(guess, Solution) else best, reporter)
        elif not (outcome.converged or reporter.limited or self._counted or best or given) and self._by_ipopt:
            outcome = self._by_other_steps(outcome, guess, reporter)
        return (outcome if first is None else with_stats(outcome, **counted(first, outcome))), start

    def _laid_out(self) -> Options:
        """The options of the first mesh, for the values it is made for."""
        options = self._asked
        if options.refine is not None:
            options = refining.with_layers(self.statement, options, self._values)
        if self.nominal == "deterministic":  # the steps of what runs around it
            around = evaluation_mesh(self.statement, options, self._values)
            options = replace(options, substeps=around.substeps)
        return options

    def _ready(
        self, options: Options, statement: Statement | None = None, by: str | None = None, **changed: Any
    ) -> Prepared:
        """The problem, or one like it, made ready on a mesh, by another method or with other options of it."""
        statement = self._solved if statement is None else statement
        return made_ready(by or self._by, statement, options, self._values, **{**self._own, **changed})

    def _suit(self, values: Array, *, nodes: bool) -> None:
        """Another mesh for other values of the parameters where this one is too coarse for them, kept for later runs.

        Its steps are looked at always, its nodes where it takes no more time than what else is looked at, more is
        uncertain at the start than before, or the times at which the model jumps are others.
        """
        if np.array_equal(values, self._values):
            return
        from covocp.solving.suited_mesh import beginning, other_nodes, suits

        mesh, begin = self._prepared.mesh, beginning(*self._ungraded, values)
        borne = beginning(*self._ungraded, self._values) if self._borne is None else self._borne
        on_nodes = mesh.step == "rk4" and bool(self.statement.matrices)  # the steps depend on them
        nodes = nodes or on_nodes or begin.beyond(borne)
        more = other_nodes(self.statement, self._ungraded, self._asked, (self._values, values), look=nodes)
        if self.nominal == "deterministic":
            suited = evaluation_mesh(self.statement, self._asked, values).substeps <= mesh.substeps
        else:
            suited = suits(self._solved, self._first[0], mesh, values)
        borne = begin if more is not None else borne.beside(begin) if nodes else borne
        if suited and more is None:
            self._borne = borne
            return
        before = self._values, self._asked
        try:
            self._values, self._asked = values, self._asked if more is None else more
            options = self._laid_out()
            self._keep(options, self._ready(options))
        except BaseException:
            self._values, self._asked = before
            raise
        self._first, self._borne = (options, self._prepared), borne

    def _look_at_steps(self, values: Array) -> None:
        """Take shorter steps from the first run on where a large covariance or what is fast needs them, by a guess."""
        mesh = self._prepared.mesh
        large = mesh.eliminated and max((one.size for one in self._solved.matrices), default=0) >= LARGE
        if self._looked or not self._own_steps:
            return
        self._looked = True
        try:
            guess = own_start(self._solved, mesh, values).trajectory
            finer = steps_along(self._solved, mesh, guess, values, self._options, OPTIMISED, fast_alone=not large)
        except RuntimeError:  # CasADi's, of a linear system that is singular there: the run tells
            return
        if finer is not None:
            self._keep(finer, self._ready(finer))

    def _classical_design(self) -> ClassicalDesign:
        """The classical design on the present mesh."""
        make = partial(_deterministic, self._problem)
        return ClassicalDesign(statement=self.statement, options=self._options, make=make)

    def _take_steps(self, mesh: Mesh) -> None:
        """The integration steps of a solution to start from where they are shorter: on longer ones it is no optimum."""
        own = self._prepared.mesh
        alike = mesh.step == own.step and np.array_equal(mesh.nodes, own.nodes)
        if self._own_steps and alike and mesh.substeps > own.substeps:
            groups = -(-mesh.substeps // step_unit(self.statement, own))
            options = with_substeps(self._options, own, groups * step_unit(self.statement, own))
            self._keep(options, self._ready(options))

    def _keep(self, options: Options, prepared: Prepared) -> None:
        """Other steps from now on; what the classical design costs is then another number."""
        self._options, self._prepared = options, prepared
        self._classical = self._classical_design()

    def _refined(self, outcome: Outcome, values: Array, reporter: Progress) -> Outcome:
        """The outcome on a mesh of small error, with limits that hold between the nodes, where that is asked for."""
        if not self._remade or reporter.stop:
            return outcome
        from covocp.solving.refined_meshes import remade

        runs = refining.ProblemRuns(self._solved, values, self._by, self._ready, reporter)
        found = remade(runs.measured(self._options, self._prepared, outcome, refining.unseen(self._own)), runs)
        assert isinstance(found.outcome, Outcome)
        self._keep(found.options[0], found.prepared)
        return found.outcome

    def _finish(self, outcome: Outcome, best: Solution | None, *, allow_failure: bool, assess: bool) -> Solution:
        """An outcome, perhaps of a run from the best gain, as a solution, with what the user must know about it."""
        told, impossible = possible(outcome)
        solution = Solution.of(with_stats(told, **self._options.grading), self._by, assess=assess)
        if not told.converged and not allow_failure:
            other_way = "" if impossible else self._other_way(told, best)
            raise failure(self.statement.name, self.method, told, solution, other_way)
        if told.converged and assess:
            mention_doubts(solution)
            mention_gap(solution.stats)
            mention_limits(solution)
        return solution

    def _other_way(self, failed: Outcome, best: Solution | None) -> str:
        """A line for a run that failed, where another method or other options are known to be more robust."""
        from covocp.solution.report import OTHERWISE
        from covocp.solving.other_ways import long_intervals, other_covariances, told_ways

        if grown := long_intervals(self._solved, self._options, self._values):
            return grown
        if not self._by_ipopt or beyond(self._problem.declarations, best):
            return ""
        if self.method == "ipopt" and is_suited(self._solved, self._prepared.mesh):
            return OTHER_WAY + other_covariances(self._solved, self._options, self._prepared.mesh)
        told = told_ways(str(failed.stats.get(OTHERWISE, "")), self._other_ways() if self._best else ())
        return told or other_covariances(self._solved, self._options, self._prepared.mesh)


def _deterministic(problem: Problem, options: Options) -> Deterministic:
    """What solves for the classical design, on the mesh of some options."""
    mesh = {field.name: getattr(options, field.name) for field in fields(Options) if field.name != "refine"}
    solver = Solver(problem, "ipopt", nominal="deterministic", **mesh)
    return Deterministic(costs=solver._cost_of_values, nominal=solver._nominal_of_values)
