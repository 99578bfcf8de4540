"""What a given nominal of several phases costs: covariances, gains and costs through the links, without optimising.

States and E run from the first phase to the last, each from what the link before it gives; S of a closed loop runs from
the last to the first along them, and does not move them. Then the covariances of the loops run forward. Under another
truth the gains are those of the design, and what a link adds is what the truth adds there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import OutsideDomainError, ProblemError, SolveError, evaluating, kind_and_name
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.densities import Truth, check_jump_noise, check_noise, check_true_jump
from covocp.extremal.extremal import Outcome
from covocp.extremal.joint import Statistics
from covocp.extremal.links import ChainOutcome
from covocp.extremal.mean_effect import noted
from covocp.extremal.mesh_error import finer_steps
from covocp.extremal.phase_loops import ChainStatistics, phase_loops
from covocp.problem.phase_feedback import in_phase
from covocp.problem.phases import Phases
from covocp.solution.chances import reached
from covocp.solution.doubts import mention_doubts
from covocp.solution.origin import METHOD, Origin
from covocp.solution.phases import PhasesSolution
from covocp.solving.evaluation import SAME, check_same, statistics_along
from covocp.solving.given_nominal import first_options, options_along, run_along
from covocp.solving.missed import check_has_loop, missed_by_loop, with_missed
from covocp.solving.phases_given import intervals_of, of_each, values_of
from covocp.solving.phases_outcome import phases_solution
from covocp.solving.unused import mention_forgotten_in
from covocp.statement.chain import Chain
from covocp.transcription.mesh import Options
from covocp.transcription.nlp import check_costs

Arrays = tuple[Array, ...]


def evaluate_phases(
    phases: Phases | PhasesSolution,
    *,
    nominal: Given,
    truth: Given,
    intervals: Given,
    parameters: Mapping[str, Any] | None,
    **options: Any,
) -> PhasesSolution:
    """Evaluate phases along a nominal, or their solution under other statistics; see `evaluate`.

    Args:
        phases: what to evaluate.
        nominal: None; a `PhasesSolution`; or, by name of the phase or one for each, what `evaluate` takes.
        truth: None; `Phases` of the same symbols, or a dict of parameter name to value.
        intervals: of each phase, or one number for each.
        parameters: values by name or symbol, in all phases that have them.
        options: of the mesh.

    Raises:
        ProblemError: what does not fit.
        SolveError: a phase, or what it gives to the next one, becomes NaN or inf along the nominal.
    """
    if isinstance(phases, PhasesSolution):
        solution = phases
    else:
        with evaluating(phases.name):
            solution = _along(phases.chain(), nominal, intervals, parameters, options)
        mention_forgotten_in(phases)
    return solution if truth is None else _under(solution, truth)


@dataclass(frozen=True, kw_only=True, eq=False)
class Runs:
    """One run along a nominal through all phases: what came out, parameters with what passes, options of the meshes."""

    outcomes: tuple[Outcome, ...]
    parameters: Arrays
    options: tuple[Options, ...]

    __repr__ = short_repr


def _along(
    chain: Chain, nominal: Given, intervals: Given, parameters: Mapping[str, Any] | None, options: dict[str, Any]
) -> PhasesSolution:
    """The phases along a nominal."""
    nominals = of_each(chain, nominal, "nominal")
    if isinstance(nominal, Mapping):  # a phase that is left out is given nothing
        nominals = [{} if entry is None else entry for entry in nominals]
    counts = [None] * len(chain.statements) if intervals is None else intervals_of(chain, intervals)
    asked = tuple(first_options(own, n, options) for own, n in zip(nominals, counts, strict=True))
    values = values_of(chain, {} if parameters is None else parameters)
    runs = run_all(chain, nominals, asked, values)
    if any(link.weights for link in chain.links):  # meshes are graded for S of the phases behind
        runs = run_all(chain, nominals, asked, runs.parameters)
    automatic = [own.substeps == "auto" for own in asked]
    while True:
        pairs = zip(runs.outcomes, runs.options, automatic, strict=True)
        finer = tuple((finer_steps(x.extremal, own) if auto else None) or own for x, own, auto in pairs)
        if all(a is b for a, b in zip(finer, runs.options, strict=True)):
            break
        try:
            runs = run_all(chain, nominals, finer, runs.parameters)
        except SolveError:  # what the steps are off is told with the solution that there is
            break
    return solved(chain, runs)


def run_all(chain: Chain, nominals: list[Any], options: tuple[Options, ...], values: Arrays) -> Runs:
    """States and matrices that run forward, from the first phase to the last; then those that run backward."""
    outcomes: list[Outcome] = []
    filled: list[Array] = []
    fine: list[Options] = []
    for i, (st, own, value, nominal) in enumerate(zip(chain.statements, options, values, nominals, strict=True)):
        linked: dict[int, float] = {}
        if i:
            link, t = chain.links[i - 1], outcomes[-1].extremal.trajectory
            states, matrices = link.values(t.x[-1], t.e[-1], t.duration, filled[-1], value)
            value, linked = link.filled(value, matrices), dict(zip(link.states, states.tolist(), strict=True))
        try:
            fine.append(options_along(st, nominal, own, value))
            outcomes.append(run_along(st, nominal, fine[-1], value, linked))
            check_noise(outcomes[-1].extremal)
        except ProblemError as error:
            raise in_phase(st, error) from error
        filled.append(value)
        if i < len(chain.links):  # first: what the jump makes of deviations is part of this phase's own cost
            _check_passes(chain, i, outcomes[-1], value, values[i + 1])
        _check_finite(st.name, outcomes[-1])
    for i in range(len(chain.links) - 1, -1, -1):
        link = chain.links[i]
        if link.weights:
            start = outcomes[i + 1].extremal.trajectory
            filled[i] = link.weighed(filled[i], start.e[0, list(link.behind)])
            given = dict(enumerate(outcomes[i].extremal.trajectory.x[0].tolist())) if i else {}
            linked = {entry: given[entry] for entry in chain.links[i - 1].states} if i else {}
            outcomes[i] = run_along(chain.statements[i], nominals[i], fine[i], filled[i], linked)
            _check_finite(chain.statements[i].name, outcomes[i])
    return Runs(outcomes=tuple(outcomes), parameters=tuple(filled), options=tuple(fine))


def _check_passes(chain: Chain, i: int, outcome: Outcome, parameters: Array, later: Array) -> None:
    """What a phase gives to the next one has a value, and the noise of the jump is one.

    Raises:
        SolveError: it has none, though the phase ends with numbers.
        ProblemError: noise of the jump is negative.
    """
    link, t = chain.links[i], outcome.extremal.trajectory
    given = link.values(t.x[-1], t.e[-1], t.duration, parameters, later)
    try:
        link.check_finite(chain.statements[i], (t.x[-1], t.e[-1], t.duration), given)
    except OutsideDomainError as error:  # of a nominal, not of a start that a solver could leave
        raise SolveError(
            error.problem, expected=error.expected, received=error.received, remedy=error.remedy
        ) from error
    check_jump_noise(link, outcome.extremal, chain.statements[i + 1], later)


def _check_finite(name: str, outcome: Outcome) -> None:
    """A phase has an end from which the next one can begin.

    Raises:
        SolveError: it has none.
    """
    if not outcome.converged:
        raise SolveError(f"The phase '{name}' becomes NaN or inf along this nominal: give another one, or bounds.")


def solved(chain: Chain, runs: Runs) -> PhasesSolution:
    """A run as solutions of the phases; what the user must know about them is said."""
    extremals = []
    for outcome, values in zip(runs.outcomes, runs.parameters, strict=True):
        extremal = outcome.extremal
        terms = outcome.cost_terms
        check_costs(extremal.statement, extremal.trajectory, terms["running"], terms["terminal"], evaluated=True)
        extremals.append(replace(extremal, stated=replace(extremal.statement, values=values)))
    missed = {
        f"{st.name}: {name}": value
        for st, outcome in zip(chain.statements, runs.outcomes, strict=True)
        for name, value in outcome.violations.items()
    }
    none = tuple(np.zeros(st.nx) for st in chain.statements)
    joined = ChainOutcome(
        extremals=tuple(extremals),
        link_multipliers=tuple(np.zeros(len(link.states)) for link in chain.links),
        bounds_at_ends=tuple(zip(none, none, strict=True)),
        cost_terms=tuple(outcome.cost_terms for outcome in runs.outcomes),
        converged=True,
        message="evaluated along a given nominal",
        violations=missed,
        stats={},
        given=True,
    )
    with np.errstate(invalid="ignore"):  # a condition that is infinite is told by its name
        solution = phases_solution(chain, joined, METHOD)
    pairs = zip(solution.phases, runs.options, strict=True)
    phases = tuple(with_missed(replace(phase, stats={**phase.stats, **own.grading})) for phase, own in pairs)
    violations = {f"{phase.name}: {name}": value for phase in phases for name, value in phase.violations.items()}
    whole = _as_converged(replace(solution, phases=phases, violations=violations))
    for phase in phases if whole.converged else ():  # else costates of all phases may mean nothing
        mention_doubts(phase)
    return whole


def _under(solution: PhasesSolution, truth: Given) -> PhasesSolution:
    """The solution with the covariances and the costs of other statistics, and the gains of its design."""
    if len(solution.links) != len(solution) - 1:
        raise ProblemError(
            "This solution knows no phases, so nothing passes between them.",
            expected="a solution with its phases",
            received=f"'{solution.name}', read from a file",
            remedy="load(path, phases) with the phases that were solved",
        )
    open_loops = [phase for phase in solution if phase.loop is None]
    if open_loops:
        for phase in open_loops:
            check_has_loop(phase, "the phase")
        raise ProblemError(
            "truth= needs a closed loop.",
            expected="a solution of phases with minimize_expected()",
            received=f"'{solution.name}' without one in every phase",
            remedy="leave truth= out",
        )
    extremals = [phase.extremal for phase in solution]
    loops = phase_loops(extremals, solution.links, _true_chain(solution, truth))
    phases = []
    for phase, closed in zip(solution, loops, strict=True):
        if closed.loop is None:
            raise ProblemError(
                f"The covariances of the phase '{phase.name}' under this truth are no numbers.",
                expected="finite covariances with the gains of the design",
                received="inf or NaN on the way",
                remedy="check the variances and densities of truth=, and that the solution converged",
            )
        assert phase.within is not None
        own = {**noted(closed.mean), "origin": Origin.OTHER_TRUTH.value}
        evaluated = replace(
            phase,
            method=METHOD,
            message="evaluated under other statistics than the design's",
            stats={**phase.stats, **own},
            cost_terms=dict(closed.loop.cost),
            loop=closed.loop,
            stored_optimality=None,
            within=replace(phase.within, deviations=closed.start, handed=0.0),
        )
        phases.append(missed_by_loop(replace(evaluated, chances=reached(evaluated))))
    message = "evaluated under other statistics than the design's"
    missed = {f"{phase.name}: {name}": by for phase in phases for name, by in phase.violations.items()}
    named = tuple(f"{phase.name}: " for phase in phases)
    between = {name: by for name, by in solution.violations.items() if not name.startswith(named)}
    whole = replace(solution, method=METHOD, message=message, phases=tuple(phases), violations=missed | between)
    return _as_converged(whole)


def _as_converged(solution: PhasesSolution) -> PhasesSolution:
    """Evaluated phases, as converged as each of them: one along which a condition has no value says so for all."""
    failed = next((phase for phase in solution if not phase.converged), None)
    if failed is None or not solution.converged:
        return solution
    return replace(solution, converged=False, message=f"the phase '{failed.name}': {failed.message}")


def _true_chain(solution: PhasesSolution, truth: Given) -> ChainStatistics:
    """What is truly uncertain in all phases and between them.

    Raises:
        ProblemError: the truth is of another kind, or of another system.
    """
    if isinstance(truth, Mapping):
        known = (replace(phase.extremal.statement, values=phase.parameters) for phase in solution)
        chain = Chain(name=solution.name, statements=tuple(known), links=solution.links)
        values = values_of(chain, truth)
    elif isinstance(truth, Phases) and len(truth.problems) == len(solution):
        chain = truth.chain()
        values = tuple(st.values for st in chain.statements)
    else:
        raise ProblemError(
            "The truth is of an unknown kind.",
            expected=f"Phases, {len(solution)} of them with the same symbols, or a dict of parameter name to value",
            received=f"{len(truth.problems)} phases" if isinstance(truth, Phases) else kind_and_name(truth),
            remedy="correct truth=",
        )
    found: list[Statistics] = []
    for phase, statement, own in zip(solution, chain.statements, values, strict=True):
        try:
            check_same(phase.extremal.statement, statement)
            found.append(statistics_along(phase.extremal, statement, own))
        except ProblemError as error:
            raise in_phase(statement, error) from error
    truly = ChainStatistics(phases=tuple(found), links=chain.links)
    for k in range(len(chain.links)):
        _check_jump(solution, truly, k)
        pair = zip(chain.statements[k : k + 2], values[k : k + 2], strict=True)
        one, two = (Truth(*entry) for entry in pair)
        check_true_jump(chain.links[k], solution[k].extremal, (one, two))
    return truly


def _check_jump(solution: PhasesSolution, truth: ChainStatistics, k: int) -> None:
    """What passes from a phase to the next is the same, and passes deviations by the same tangent.

    Raises:
        ProblemError: it is not.
    """
    t, n = solution[k].trajectory, len(solution[k].augmented)
    designed = (solution.links[k], solution[k].parameters, solution[k + 1].parameters)
    actual = (truth.links[k], truth.phases[k].parameters, truth.phases[k + 1].parameters)
    found = []
    for link, before, later in (designed, actual):
        assert link.deviations is not None
        states = link.values(t.x[-1], t.e[-1], t.duration, before, later)[0]
        J = link.deviations(t.x[-1], t.e[-1], t.duration, before, later, np.zeros((n, n)))[0]
        found.append((states, np.asarray(J.full())))
    for name, one, other in zip(("value", "slope"), *found, strict=True):
        if one.shape != other.shape or np.abs(one - other).max(initial=0.0) > SAME * np.abs(one).max(initial=0.0):
            raise ProblemError(
                f"The truth jumps differently from '{solution[k].name}' to '{solution[k + 1].name}'.",
                expected="the jumps of the design, with other noise",
                received=f"another {name} of a jump",
                remedy="give the truth the jumps of the design",
            )
