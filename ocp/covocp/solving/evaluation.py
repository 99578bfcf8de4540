"""What a given nominal costs: costs, covariances and gains along a control history, without optimising.

Quadratic synthesis [Schmidt 6.3] is this with the nominal of the deterministic cost; the effect of incorrect
statistics [6.11] is this with the gains of the design and the covariances of the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast, overload

import numpy as np

from covocp.base.checks import check_kind
from covocp.base.errors import ProblemError, evaluating
from covocp.base.expressions import Given
from covocp.base.later import later
from covocp.base.matrices import Array, unpack
from covocp.base.threads import one_at_a_time
from covocp.extremal.closed_loop import close_loop, densities, start_covariance, variances
from covocp.extremal.densities import check_noise, check_truth
from covocp.extremal.extremal import Extremal
from covocp.extremal.joint import Statistics
from covocp.extremal.mesh_error import finer_steps
from covocp.problem.builder import Problem
from covocp.problem.phases import Phases
from covocp.solution.chances import reached
from covocp.solution.origin import METHOD, Origin
from covocp.solution.phases import PhasesSolution, check_whole
from covocp.solution.solution import Solution
from covocp.solving.given_nominal import first_options, options_along, run_along
from covocp.solving.missed import check_has_loop, missed_by_loop, told
from covocp.solving.not_finite import with_shortest_steps
from covocp.solving.unused import mention_forgotten
from covocp.statement.entries import entry_names
from covocp.statement.magnitudes import check_magnitudes
from covocp.statement.names import stacked_parameters
from covocp.statement.statement import Statement
from covocp.transcription.nlp import check_costs

# Relative difference of rates or slopes above which the truth is another system.
SAME = 1e-9


@overload
def evaluate(problem: Problem | Solution, **options: Any) -> Solution: ...


@overload
def evaluate(problem: Phases | PhasesSolution, **options: Any) -> PhasesSolution: ...


@one_at_a_time
def evaluate(
    problem: Problem | Solution | Phases | PhasesSolution,
    *,
    nominal: Given = None,
    truth: Given = None,
    intervals: Given = None,
    parameters: Mapping[str, Any] | None = None,
    **options: Any,
) -> Solution | PhasesSolution:
    """Evaluate costs, covariances and gains along a given nominal, or a solution under other statistics.

    Args:
        problem: the problem, or phases; or a solution of either, whose nominal and gains are kept.
        nominal: the control: a solution (of any problem with controls and decisions of these names), or a dict of
            control to number, array over the nodes, or function of s = t/T, and of decision to value; None: the
            guesses of controls and decisions. The states follow; what else is free (initial states, the duration, a
            constant gain) is taken from the solution, or as guessed. Of phases a `PhasesSolution`, or such a nominal
            for each phase: a list, or a dict by name of the phase.
        truth: what the statistics really are, for a solution with an expected cost: a problem of the same symbols
            (its variances and noise densities count), or a dict of parameter name to value; of phases `Phases`, the
            noise of whose jumps counts too, or such a dict.
        intervals: number of control intervals; None: 100, along a solution its own mesh. Of phases that of each, or a
            list of one for each. The nodes of a solution are added, twice where its control jumps: the control is the
            same on every mesh, but for a linear one of which `control="constant"` is asked for.
        parameters: values of parameters other than the declared ones, by name.
        options: of the mesh, as in `solve`.

    Returns:
        A solution by the method "evaluate"; conditions that the nominal misses are among its `violations`, by inf those
        that are NaN or inf along it: it has then not converged, and its message says which they are. Of
        phases a `PhasesSolution`. Under a truth, costs, `loop`, `covariance()`, chances, X and Xhat by subscript, and
        what is violated of conditions that contain X are those under it (at the nodes); E by subscript is what the
        filter of the design computes, the actual one is `loop.E`. Multipliers and costates are the design's.

    Raises:
        ProblemError: a control or a decision is not given, a name is unknown, `truth` has other symbols, noise along
            the nominal is none (negative, or of a measurement zero).
        SolveError: a phase, or what it gives to the next one, becomes NaN or inf along the nominal.
    """
    if isinstance(problem, (Solution, PhasesSolution)):
        _check_kept(nominal, intervals, parameters, options)
    if isinstance(problem, (Phases, PhasesSolution)):
        run = {"nominal": nominal, "truth": truth, "intervals": intervals, "parameters": parameters}
        return cast("PhasesSolution", later("solving.phases_evaluated").evaluate_phases(problem, **run, **options))
    if isinstance(problem, Solution):
        solution = problem
    else:
        with evaluating(str(getattr(problem, "name", ""))):
            solution = _along(problem, nominal, intervals, {} if parameters is None else parameters, options)
    if truth is None:
        return solution
    check_whole(solution, "evaluate() under another truth")
    return _under(solution, truth)


def _check_kept(nominal: Given, intervals: Given, parameters: Given, options: dict[str, Any]) -> None:
    """A solution is evaluated as it is.

    Raises:
        ProblemError: something else is given for it.
    """
    if nominal is not None or options or parameters is not None or intervals is not None:
        raise ProblemError(
            "evaluate(solution) keeps its nominal, mesh and parameters.",
            expected="truth=... only",
            received="nominal=, intervals=, parameters= or options of the mesh",
            remedy="evaluate the problem along the solution: evaluate(problem, nominal=solution)",
        )


def _along(
    problem: Problem, nominal: Given, intervals: Given, parameters: Mapping[str, Any], options: dict[str, Any]
) -> Solution:
    """The problem along a nominal."""
    check_kind(problem, Problem, "evaluate(problem, nominal=...), or evaluate(solution, truth=...)")
    st = problem.statement()
    mention_forgotten(problem)
    values = stacked_parameters(st, parameters)
    check_magnitudes(st, values)
    given = options_along(st, nominal, first_options(nominal, intervals, options), values)
    outcome = run_along(st, nominal, given, values)
    own_steps = given.substeps == "auto"
    outcome = with_shortest_steps(outcome, given, lambda shorter: run_along(st, nominal, shorter, values))
    while own_steps and outcome.converged and (finer := finer_steps(outcome.extremal, given)):
        shorter = run_along(st, nominal, finer, values)
        if not shorter.converged:
            break
        outcome, given = shorter, finer
    check_noise(outcome.extremal)
    if outcome.converged:
        terms = outcome.cost_terms
        check_costs(st, outcome.extremal.trajectory, terms["running"], terms["terminal"], evaluated=True)
    with np.errstate(over="ignore", invalid="ignore"):  # a condition that is infinite is told by its name
        solution = Solution.of(replace(outcome, stats=given.grading), METHOD)
    return told(solution) if solution.converged else solution


def _under(solution: Solution, truth: Given) -> Solution:
    """The solution with the covariances and the cost of other statistics, and the gains of its design."""
    if solution.loop is None:
        check_has_loop(solution)
        raise ProblemError(
            "truth= needs a closed loop.",
            expected="a solution of a problem with minimize_expected()",
            received=f"'{solution.name}' with a deterministic cost",
            remedy="for an estimator alone, simulate(solution, truth=...) shows the effect",
        )
    loop = close_loop(solution.extremal, true_statistics(solution.extremal, truth))
    if loop is None:
        raise ProblemError(
            "The covariances under this truth are no numbers.",
            expected="finite covariances with the gains of the design",
            received="inf or NaN on the way",
            remedy="check the variances and densities of truth=, and that the solution converged",
        )
    result = replace(
        solution,
        method=METHOD,
        message="evaluated under other statistics than the design's",
        stats={**solution.stats, "origin": Origin.OTHER_TRUTH.value},
        cost_terms=dict(loop.cost),
        loop=loop,
        stored_optimality=None,
    )
    return missed_by_loop(replace(result, chances=reached(result)))


def true_statistics(extremal: Extremal, truth: Given) -> Statistics:
    """Initial covariance and noise densities of a truth.

    Raises:
        ProblemError: where it is neither a problem nor a dict, or has other symbols, initial means, rates, measurements
            or another duration.
    """
    st = extremal.statement
    if isinstance(truth, Mapping):
        other, values = st, stacked_parameters(st, truth, extremal.parameters)
    elif isinstance(truth, Problem):
        other = truth.statement()
        values = other.values
        check_same(st, other)
    else:
        raise ProblemError(
            "The truth is of an unknown kind.",
            expected="a Problem with the same symbols, or a dict of parameter name to value",
            received=repr(truth)[:100],
            remedy="correct truth=",
        )
    return statistics_along(extremal, other, values)


def statistics_along(extremal: Extremal, other: Statement, values: Array) -> Statistics:
    """Initial covariance and noise densities of the statement of a truth, with these parameters.

    Raises:
        ProblemError: it is another system along the extremal, or has no expected cost, or what is no covariance.
    """
    _check_system(extremal, other, values)
    block = next((b for b in other.matrices if b.estimation), None)
    if block is None or other.loop is None:
        raise ProblemError(
            "The truth has no expected cost, so its statistics are not known.",
            expected="a problem built like the design's, with minimize_expected()",
            received=f"'{other.name}'",
            remedy="build it by the same function with other numbers",
        )
    statistics = Statistics(
        initial=unpack(start_covariance(other, extremal, values)[block.span], block.size),
        density=densities(other),
        parameters=values,
        variance=variances(other),
    )
    check_truth(extremal, other, values, statistics.initial)
    return statistics


def check_same(design: Statement, truth: Statement) -> None:
    """The symbols of both must agree; the linear equations know one system only, so must the rates."""

    def signature(statement: Statement) -> list[tuple[str, str, int]]:
        kinds = ("state", "control", "unknown")
        return [(b.kind, b.name, b.size) for b in statement.blocks if b.kind in kinds]

    measured = (_measured(design), _measured(truth))
    if signature(design) != signature(truth) or measured[0] != measured[1]:
        raise ProblemError(
            "The truth is another system than the design's.",
            expected=", ".join(f"{k} {n} ({s})" for k, n, s in signature(design)) + "; measured " + str(measured[0]),
            received=", ".join(f"{k} {n} ({s})" for k, n, s in signature(truth)) + "; measured " + str(measured[1]),
            remedy="declare the same states, controls, unknowns and measurements in the same order",
        )


def _measured(statement: Statement) -> tuple[str, ...]:
    """The measurements, those at instants with their number of these."""
    names = statement.measurement_names
    if statement.samples is None:
        return names
    pairs = zip(statement.samples.blocks, statement.samples.places, strict=True)
    return (*names, *(f"{block.name} at {len(places)} instants" for block, places in pairs))


def _check_system(design: Extremal, truth: Statement, parameters: Array) -> None:
    """The linear covariance equations know one nominal and one system along it: only its statistics may differ."""
    st = design.statement
    x, u, _, t, duration, own = (np.asarray(column) for column in design.columns())
    count = design.mesh.intervals + 1
    others = np.tile(parameters[:, None], (1, count))
    start, known = truth.boundary_values(parameters)[0], truth.duration
    first, lasts = x[:, :1], design.trajectory.duration if known.free else known.guess
    measured = (", ".join(st.measurement_names),)
    first_loop, other_loop = (None if s.loop is None else s.loop.expansion for s in (st, truth))
    compared: list[tuple[str, tuple[str, ...], Any, Any]] = [
        ("starts elsewhere: the initial mean", st.state_names, first, np.where(np.isnan(start), x[:, 0], start)),
        ("takes another time: the value", ("duration",), duration[:, :1], np.array([lasts])),
    ]
    if unknowns := st.of_kind("unknown"):
        places = ([k for b in s.of_kind("unknown") for k in range(b.span.start, b.span.stop)] for s in (st, truth))
        one, two = (v[rows, None] for v, rows in zip((design.parameters, parameters), places, strict=True))
        compared.append(("has another constant: the mean", entry_names(unknowns), one, two))
    functions: tuple[tuple[str, tuple[str, ...], int, Any, Any], ...] = (
        ("moves differently: the rate", st.state_names, 0, st.nominal, truth.nominal),
        ("moves differently: the slope", st.augmented, 0, first_loop, other_loop),
        ("is controlled differently: the slope", st.augmented, 1, first_loop, other_loop),
        ("is measured differently: the slope", measured, 1, st.measurement, truth.measurement),
    )
    if st.samples is not None and truth.samples is not None:
        if st.samples.places != truth.samples.places:
            raise ProblemError(
                "The truth is measured at other instants than the design's.",
                expected=f"the same instants: {len(st.samples.instants)} of them",
                received=f"{len(truth.samples.instants)} of them, some elsewhere",
                remedy="give the truth the instants of the design; or solve the problem with the others",
            )
        names = tuple(block.name for block in st.samples.blocks)
        label = (", ".join(names),)
        own_samples = ("is read differently: the slope", label, 1, st.samples.measurement, truth.samples.measurement)
        functions = (*functions, own_samples)
    for what, names, output, one, two in functions:
        if one is not None and two is not None:
            values = [f.map(count)(x, u, t, duration, p)[output].full() for f, p in ((one, own), (two, others))]
            compared.append((what, names, *values))
    for what, names, one, two in compared:
        two = two.reshape(two.shape[0], -1)
        off = np.array([True])
        if one.shape == two.shape:
            off = np.abs(one - two).max(axis=1) > SAME * np.maximum(np.abs(one).max(axis=1), np.finfo(float).tiny)
        if off.any():
            name = names[min(int(np.flatnonzero(off)[0]), len(names) - 1)]
            raise ProblemError(
                f"The truth {what} of '{name}' along the nominal is another one.",
                expected="the system of the design, with other variances and noise densities",
                received=f"'{truth.name}', which differs in more",
                remedy="use simulate(solution, truth=...), which takes any dynamics",
            )
