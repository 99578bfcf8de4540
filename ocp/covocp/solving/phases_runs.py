"""Runs of a method on several phases: from several starts, with shorter steps, on other meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice, product
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import CovocpError, OutsideDomainError
from covocp.base.matrices import Array, is_semidefinite, pack, semidefinite_part, unpack
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.extremal.densities import JumpEnds, impossible_jump
from covocp.extremal.extremal import Guess, Merit
from covocp.extremal.links import ChainOutcome, completed
from covocp.extremal.mesh_error import OPTIMISED, finer_steps
from covocp.solving.attempts import NO_MERIT, TRIED, best_of, counted, worth_a_run
from covocp.solving.failure import with_stalled
from covocp.solving.from_classical import SOON
from covocp.solving.longer import longer, may_be_too_short
from covocp.solving.other_minima import TURNS, unless_it_fails
from covocp.solving.phases_classical import AroundClassical, DeterministicChain, around_classical
from covocp.solving.phases_outcome import phases_solution
from covocp.solving.random_starts import drawn_guess, phase_seed
from covocp.solving.refined_meshes import Measured, remade
from covocp.solving.refining import first_guesses, unseen, with_layers
from covocp.solving.turns import unwound
from covocp.solving.warm_start import make_guess
from covocp.statement.chain import Chain, Link, started_at
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import matrices_function
from covocp.transcription.grading import graded
from covocp.transcription.halved_steps import refined_run
from covocp.transcription.mesh import Mesh, Options, with_substeps
from covocp.transcription.mirrored import COMBINED, conditions_on_matrices
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.trajectory import Trajectory

Arrays = tuple[Array, ...]
Guesses = tuple[Guess, ...]
# Number, statement, options, mesh and parameters of a phase -> where it starts; None where there is no such start.
Made = Callable[[int, Statement, Options, Mesh, Array], Guess | None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Begun:
    """Where a method starts: a guess for each phase, parameters with what passes, graded options, statements.

    covariances: whether what each phase ends with is a covariance where it should be; else the nearest one is passed.
    merit: of all phases along the guesses, where it was asked for.
    """

    chain: Chain
    guesses: Guesses
    values: Arrays
    options: tuple[Options, ...]
    covariances: bool
    merit: Merit | None = None

    __repr__ = short_repr


class ChainRuns:
    """Runs of a method on a chain, in the way of `refined_meshes`."""

    def __init__(
        self,
        chain: Chain,
        method: str,
        prepare: Callable[..., Any],
        own: dict[str, Any],
        reporter: Progress,
        values: Arrays,
        guesses: list[list[Any]],
        classical: DeterministicChain | None = None,
    ) -> None:
        """Keep the chain, how the method is made ready, the parameters of each statement, and what was guessed.

        Several guesses are tried one after the other, until the method finds its way. `classical`: the deterministic
        problem where that has the optimum (`phases_classical`).
        """
        self._chain, self._method, self._prepare, self._own = chain, method, prepare, own
        self._reporter, self._values = reporter, values
        self._guesses, *self._others = guesses
        self._classical, self._at_once = classical, False

    @property
    def statements(self) -> tuple[Statement, ...]:
        """Of the phases."""
        return self._chain.statements

    @property
    def progress(self) -> Progress:
        """Of the iterations."""
        return self._reporter

    def solve(self, options: tuple[Options, ...], starts: tuple[int, int] | None = None) -> ChainOutcome:
        """Solve from the guesses, or from the best of several random starts, on meshes that are made anew if asked.

        Args:
            options: of each phase.
            starts: number of random starts and their seed; None: none.
        """
        begun = self._begun(options)
        while self._others and not begun.covariances:  # a guess along which the steps are too long for its gains
            begun = self._otherwise(options)
        found = self._from_starts(begun) if starts is None else self._best_of(begun, *starts)
        while self._others and not found.outcome.converged and not self._reporter.stop:
            failed, found = found.outcome, self._from_starts(self._otherwise(options))
            both = {**found.outcome.stats, **counted(failed, found.outcome)}
            found = replace(found, outcome=replace(found.outcome, stats=both))
        found = self._shorter(found)
        if not self._reporter.stop and found.outcome.converged:
            found = remade(found, self)
        assert isinstance(found.outcome, ChainOutcome)
        return found.outcome

    def _otherwise(self, options: tuple[Options, ...]) -> Begun:
        """Where the method starts from the next guess, which is the one from now on."""
        self._guesses, *self._others = self._others
        return self._begun(options)

    def cold(self, options: tuple[Options, ...], least: float) -> Measured:
        """From the phases' own start."""
        return self._from_starts(self._begun(options))

    def warm(self, options: tuple[Options, ...], start: Measured) -> Measured:
        """From a solution on other meshes, primal and dual."""
        chain = replace(self._chain, statements=tuple(extremal.statement for extremal in start.extremals))
        values = tuple(extremal.parameters for extremal in start.extremals)
        prepared = self._prepare(chain, options, **self._own)
        assert isinstance(start.outcome, ChainOutcome)
        known = phases_solution(chain, start.outcome, self._method, assess=False)
        parts = zip(chain.statements, prepared.meshes, values, known, strict=True)
        guesses = tuple(make_guess(st, mesh, own, phase, linked=True) for st, mesh, own, phase in parts)
        return self._measured(options, prepared, prepared.solve(values, guesses, self._reporter))

    def _measured(self, options: tuple[Options, ...], prepared: Any, outcome: ChainOutcome) -> Measured:
        """Meshes with what came of them, not measured; costates of converged ones are those within the whole."""
        extremals = outcome.extremals
        if outcome.converged:
            extremals = tuple(passed.extremal for passed in completed(outcome, self._chain.links))
        return Measured(
            options=options,
            meshes=prepared.meshes,
            prepared=prepared,
            outcome=outcome,
            extremals=extremals,
            cost=outcome.cost,
            least=unseen(self._own),
        )

    def _shorter(self, found: Measured) -> Measured:
        """Solved again from there where the default steps are too long; meshes that refine themselves see to it."""
        if found.refine is not None:
            return found
        automatic = tuple(own.substeps == "auto" for own in found.options)
        while found.outcome.converged and not self._reporter.stop:
            assert isinstance(found.outcome, ChainOutcome)
            extremals = found.outcome.extremals
            pairs = list(zip(extremals, found.options, automatic, strict=True))
            finer = tuple((finer_steps(x, own, OPTIMISED) if auto else None) or own for x, own, auto in pairs)
            if all(a is b for a, b in zip(finer, found.options, strict=True)):
                break
            chain = replace(self._chain, statements=tuple(x.statement for x in extremals))
            guesses = tuple(Guess(trajectory=x.trajectory, warm=True) for x in extremals)
            try:
                prepared = self._prepare(chain, finer, **self._own)
                values = tuple(x.parameters for x in extremals)
                around = self._around(chain, prepared, finer, values) if self._at_once else None
                optimum = None if around is None else around.optimum(strict=False)
                again = optimum or prepared.solve(values, guesses, self._reporter)
            except (CovocpError, RuntimeError):  # what the steps are off is told with the solution that there is
                break
            if not again.converged:
                break
            both = {**found.outcome.stats, **again.stats, **counted(found.outcome, again)}
            found = self._measured(finer, prepared, replace(again, stats=both))
        return found

    def _prepared(self, begun: Begun) -> Any:
        """The method made ready for the chain with these parameters as its own."""
        return self._prepare(begun.chain, begun.options, **self._own)

    def _from_starts(self, begun: Begun) -> Measured:
        """What `_found` is, without turns."""
        prepared = self._prepared(begun)
        around = self._around(begun.chain, prepared, begun.options, begun.values)
        free = around is not None and all(guess is None for guess in self._guesses)
        outcome = around.optimum(strict=True) if around is not None and free else None
        self._at_once = outcome is not None
        if outcome is None:
            outcome = self._soon(begun, around) or self._unwound(begun, prepared, self._found(begun, prepared))
        return self._measured(begun.options, prepared, outcome)

    def _around(
        self, chain: Chain, prepared: Any, options: tuple[Options, ...], values: Arrays
    ) -> AroundClassical | None:
        """What runs around the deterministic problem's nominal on the meshes of the whole; None where a run must tell.

        A run must where it is limited: that one knows no limits.
        """
        if self._classical is None or self._reporter.limited or self._reporter.stop:
            return None
        none: list[list[Any]] = [[None] * len(options)]
        known = self._classical.chain, self._method, self._prepare, self._own
        try:
            runs = ChainRuns(*known, self._reporter, self._classical.values, none)
            pairs = zip(options, prepared.meshes, strict=True)
            found = runs.cold(tuple(with_substeps(own, mesh, mesh.substeps) for own, mesh in pairs), 0.0).outcome
            assert isinstance(found, ChainOutcome)
            return None if self._reporter.stop else around_classical(chain, prepared.meshes, values, found)
        except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved
            return None

    def _soon(self, begun: Begun, around: AroundClassical | None) -> ChainOutcome | None:
        """What a few iterations find where runs creep, or else the optimum as the deterministic problem has it.

        None where that is none.
        """
        known = None if around is None else around.optimum(strict=False)
        if known is None:
            return None
        hasty = self._prepare(begun.chain, begun.options, **{**self._own, "max_iterations": SOON})
        outcome = self._unwound(begun, hasty, self._found(begun, hasty))
        if outcome.converged or self._reporter.stop:
            return outcome
        self._at_once = True
        return replace(known, stats={**outcome.stats, **known.stats, **counted(outcome, known)})

    def _found(self, begun: Begun, prepared: Any) -> ChainOutcome:
        """From the first start from which the method finds its way; from the first one where there is none.

        Beside it from starts that are bent to other sides, where these may learn more: the cheapest outcome counts.
        """
        values = begun.values
        (first, *beside), tried = self._sides(begun), 0
        start = first
        for attempt in range(TRIED):
            tentative = attempt < TRIED - 1 and not any(guess.warm for guess in start)
            given = tuple(replace(guess, tentative=tentative) for guess in start)
            outcome: ChainOutcome = prepared.solve(values, given, self._reporter)
            tried += 1
            if outcome.converged or not outcome.stats.get("wandered") or self._reporter.stop or not tentative:
                break
            start = self._begun(begun.options, attempt + 1).guesses
        if not outcome.converged and outcome.stats.get("wandered") and not self._reporter.stop:
            outcome = prepared.solve(values, first, self._reporter)
        left = 0
        for count, rival in enumerate(beside):
            if self._reporter.stop:
                left += len(beside) - count
                break
            again, tried = prepared.solve(values, rival, self._reporter), tried + 1
            left += int(not again.converged and bool(self._reporter.stop))
            better = again.converged and (not outcome.converged or again.cost < outcome.cost)
            found = again if better else outcome
            outcome = replace(found, stats={**found.stats, **counted(outcome, again)})
        outcome = self._from_longer(begun, prepared, outcome)
        told = {"tried": tried} if tried > 1 else {}
        if left and outcome.converged:
            told["untried"] = left
        return replace(outcome, stats={**outcome.stats, **told})

    def _from_longer(self, begun: Begun, prepared: Any, failed: ChainOutcome) -> ChainOutcome:
        """Solved from longer durations where a run has failed with conditions that are not met; else as it failed."""
        guessed = [[st.duration.guess, *longer(st.duration)] for st in self._chain.statements]
        once = any(guess.warm for guess in begun.guesses) or "max_iterations" in self._own
        if once or not may_be_too_short(failed, self._reporter):
            return failed
        failed = tried = with_stalled(failed, self._reporter)
        for k in range(1, max(map(len, guessed))):
            if self._reporter.stop:
                break
            try:
                start = self._begun(begun.options, durations=[own[min(k, len(own) - 1)] for own in guessed])
                again: ChainOutcome = prepared.solve(begun.values, start.guesses, self._reporter)
            except (CovocpError, RuntimeError):  # a model has no values there; CasADi's
                continue
            tried = replace(again, stats={**again.stats, **counted(tried, again)})
            if again.converged:
                return tried
        return replace(failed, stats={**failed.stats, **{name: tried.stats[name] for name in counted(failed, tried)}})

    def _sides(self, begun: Begun) -> list[Guesses]:
        """The start, and those whose phases are bent to other sides, that are worth a run beside it."""
        own = begun.guesses
        sided = [i for i, guess in enumerate(own) if guess.sides]
        signs = product((False, True), repeat=len(sided)) if len(sided) <= COMBINED else [(True,) * len(sided)]
        patterns = [{i for i, sign in zip(sided, each, strict=True) if sign} for each in signs]
        merits = []
        for turned in [set(), *filter(None, patterns)] if sided else []:
            with suppress(OutsideDomainError):
                found = self._begun(begun.options, turned=turned)
                merits.append((found.merit or NO_MERIT, turned, found.guesses))
        alone = next((merit for merit, turned, _ in merits if not turned), NO_MERIT)
        return [own, *worth_a_run(alone, [(merit, guesses) for merit, turned, guesses in merits if turned])]

    def _unwound(self, begun: Begun, prepared: Any, outcome: ChainOutcome) -> ChainOutcome:
        """Solved again without the turns that angles make between nodes, where that works and is cheaper."""
        return unless_it_fails(outcome, TURNS, lambda: self._straightened(begun, prepared, outcome))

    def _straightened(self, begun: Begun, prepared: Any, outcome: ChainOutcome) -> ChainOutcome:
        """What `_unwound` returns where nothing fails."""
        straight = [unwound(extremal) if outcome.converged else None for extremal in outcome.extremals]
        if self._reporter.stop or not any(straight):
            return outcome
        pairs = zip(straight, outcome.extremals, strict=True)
        guesses = tuple(Guess(trajectory=entry or extremal.trajectory) for entry, extremal in pairs)
        again: ChainOutcome = prepared.solve(begun.values, guesses, self._reporter)
        if not again.converged or not again.cost < outcome.cost:
            return outcome
        return replace(again, stats={**outcome.stats, **again.stats, **counted(outcome, again)})

    def _best_of(self, begun: Begun, count: int, seed: int) -> Measured:
        """The best of the phases' own start and of random ones, whose phases go on from where the one before ends."""
        prepared = self._prepared(begun)

        def own() -> tuple[ChainOutcome, None]:
            return self._found(begun, prepared), None

        drawn = (self._drawn(begun.options, count, seed, k) for k in range(count))
        starts = (guesses for guesses in drawn if guesses is not None)
        outcome = best_of(prepared, begun.values, starts, count + 1, self._reporter, own)
        return self._measured(begun.options, prepared, self._unwound(begun, prepared, outcome))

    def _drawn(self, options: tuple[Options, ...], count: int, seed: int, k: int) -> Guesses | None:
        """One random start; None where a phase or a jump of it lies outside the domain of the model."""

        def made(i: int, st: Statement, own: Options, mesh: Mesh, value: Array) -> Guess | None:
            return drawn_guess(st, mesh, value, count, phase_seed(seed, i), k)

        try:
            found = self._forward(options, self._values, made)
        except OutsideDomainError:
            return None
        return None if found is None else found.guesses

    def _begun(
        self,
        options: tuple[Options, ...],
        attempt: int = 0,
        turned: set[int] | None = None,
        durations: Sequence[float] = (),
    ) -> Begun:
        """A guess for each phase, each of which starts where the one before it ends.

        The parameters have the matrices that a phase then starts with, and the weights that the next one has where it
        begins; the options are graded for them. `turned`: the phases that are bent to the other side; then their merit
        is asked for, along starts as they are to be compared. `durations`: to begin with in place of what is guessed.
        """

        def made(i: int, st: Statement, own: Options, mesh: Mesh, value: Array) -> Guess:
            if durations:
                st = replace(st, duration=replace(st.duration, guess=durations[i]))
            guesses = first_guesses(own, st, mesh, value, self._guesses[i], linked=True)
            guess = list(islice(guesses, attempt + 1))[-1]
            if turned is None:
                return guess
            sides = guess.sides or (guess.trajectory,)
            trajectory, costs[i] = _along(st, mesh, sides[-1 if i in turned else 0], value)
            return Guess(trajectory=trajectory)

        costs: dict[int, float] = {}
        found = self._forward(options, self._values, made)
        if found is not None and any(link.weights for link in self._chain.links):
            found = self._forward(options, self._weighed(found), made)
        assert found is not None
        if turned is None:
            return found
        known = sum(float(np.abs(guess.trajectory.e[-1]).sum()) for guess in found.guesses)
        limited = any(conditions_on_matrices(st) for st in found.chain.statements)  # what they violate is not known
        return replace(found, merit=Merit(sum(costs.values()), float(limited), known))

    def _weighed(self, begun: Begun) -> Arrays:
        """The parameters with S of each later phase along its guess, where it begins; from the last to the first."""
        result = list(begun.values)
        for i in range(len(result) - 1, 0, -1):
            st, link, t = self._chain.statements[i], self._chain.links[i - 1], begun.guesses[i].trajectory
            mesh = resolve_mesh(st, begun.options[i], result[i])
            along = matrices_function(st, mesh)(t.x.T, t.u.T, t.duration, result[i])
            start = np.asarray(along[0].full())[list(link.behind), 0]
            if np.isfinite(start).all():
                result[i - 1] = link.weighed(result[i - 1], start)
        return tuple(result)

    def _forward(self, options: tuple[Options, ...], values: Arrays, made: Made) -> Begun | None:
        """Guesses from the first phase to the last, for the weights that are among the parameters.

        Returns:
            None where some phase has no guess.

        Raises:
            OutsideDomainError: what passes from a phase to the next is NaN or inf along a guess, or no covariance.
        """
        found: list[Guess] = []
        filled: list[Array] = []
        fine: list[Options] = []
        covariances = True
        for i, (st, own, value) in enumerate(zip(self._chain.statements, options, values, strict=True)):
            if i:
                link, t = self._chain.links[i - 1], found[-1].trajectory
                before = self._chain.statements[i - 1]
                ends, sound = nearest_covariances(before, t.e[-1])
                covariances = covariances and sound
                states, matrices = link.values(t.x[-1], ends, t.duration, filled[-1], value)
                link.check_finite(before, (t.x[-1], ends, t.duration), (states, matrices))
                _check_variances(link, before, st, (t.x[-1], ends, t.duration, filled[-1], value))
                value, st = link.filled(value, matrices), started_at(st, link, states)
            own = graded(st, own, value)
            fine.append(own if own.refine is None else with_layers(st, own, value))
            guess = made(i, st, fine[-1], resolve_mesh(st, fine[-1], value), value)
            if guess is None:
                return None
            filled.append(value)
            found.append(guess)
        statements = tuple(replace(st, values=own) for st, own in zip(self._chain.statements, filled, strict=True))
        return Begun(
            chain=replace(self._chain, statements=statements),
            guesses=tuple(found),
            values=tuple(filled),
            options=tuple(fine),
            covariances=covariances,
        )


def _along(statement: Statement, mesh: Mesh, guess: Trajectory, parameters: Array) -> tuple[Trajectory, float]:
    """A guess with the matrices that pass along it, and what it costs; NaN where that is no number."""
    with np.errstate(all="ignore"):
        run = refined_run(statement, mesh, guess, parameters, 1)
        found = replace(guess, e=run.matrices) if np.isfinite(run.matrices).all() else guess
        terminal = statement.terminal(found.x[-1], found.e[-1], found.duration, parameters)
        return found, run.running + float(np.sum(ca.DM(terminal).full()))


def _check_variances(link: Link, before: Statement, after: Statement, ends: JumpEnds) -> None:
    """No phase can start with a covariance that the noise of a jump makes negative; a method may leave a lesser one.

    Raises:
        OutsideDomainError: names what jumps.
    """
    wrong = impossible_jump(link, before, after, ends)
    if wrong is not None and not is_semidefinite(link.variances(after, *ends)[1][None]):
        raise wrong.error("at the guess", OutsideDomainError)


def nearest_covariances(statement: Statement, halves: Array) -> tuple[Array, bool]:
    """Half-vectors with the nearest covariances in place of what is none, and whether all were some but for roundoff.

    Along a guess whose gain is steep, long steps may leave the covariance of the estimate with negative variances: a
    method finds its way from there, but no phase can start with them. What a jump makes of a covariance stays as it is.
    """
    result, sound = halves.copy(), True
    for block in statement.matrices:
        matrix = unpack(halves[block.span], block.size)
        if not block.covariance or not np.isfinite(matrix).all():
            continue
        part = semidefinite_part(matrix)
        if part is not matrix:
            sound = sound and is_semidefinite(matrix[None])
            result[block.span] = pack(part)
    return result, sound
