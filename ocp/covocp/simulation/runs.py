"""Monte Carlo simulation of the actual nonlinear system with its noises, its filter and its feedback."""

from __future__ import annotations

from typing import Any, overload

from covocp.base.arguments import checked, truth
from covocp.base.expressions import Given
from covocp.base.progress import Progress
from covocp.base.threads import one_at_a_time
from covocp.extremal.densities import check_truth
from covocp.simulation.actual import actual_system
from covocp.simulation.flown import flown_law, sample_indices
from covocp.simulation.monte_carlo import MonteCarlo
from covocp.simulation.phase_asked import Asked
from covocp.simulation.phase_runs import simulate_phases
from covocp.simulation.phase_sample import PhasesMonteCarlo
from covocp.simulation.plan import make_plan
from covocp.simulation.prediction import predict
from covocp.simulation.request import Request, wrong_argument
from covocp.simulation.run_parts import Setting
from covocp.simulation.sampling import THREE_SIGMA
from covocp.simulation.schedule import FilterKind, base_grid, indices, nominal_at, stored_times
from covocp.simulation.stretch import (
    chosen_step,
    designed,
    domain_of,
    examined_sample,
    in_words,
    limits_of,
    reporting,
    sample_of,
    tell_missing,
    true_cost,
)
from covocp.simulation.unseen import seeing
from covocp.simulation.workers import simulate_batches
from covocp.solution.phases import PhasesSolution, check_begins
from covocp.solution.solution import Solution

# Runs in a batch: wide enough that numpy's operations outweigh their calls, and tasks enough for some workers.
LARGEST_BATCH, LARGEST_TASK = 2048, 512


@overload
def simulate(solution: Solution, runs: int, seed: int, **options: Any) -> MonteCarlo: ...


@overload
def simulate(solution: PhasesSolution, runs: int, seed: int, **options: Any) -> PhasesMonteCarlo: ...


@one_at_a_time  # type: ignore[misc]  # options by name are those below
@checked(progress=truth)
def simulate(
    solution: Solution | PhasesSolution,
    runs: int,
    seed: int,
    *,
    truth: Given = None,
    law: Given = None,
    period: float | None = None,
    executor: Any = None,
    filter: FilterKind = "perturbation",
    step: float | None = None,
    limits: Given = None,
    store: int = 101,
    paths: int = 20,
    batch: int | None = None,
    level: float = THREE_SIGMA,
    progress: bool = True,
) -> MonteCarlo | PhasesMonteCarlo:
    """Simulate the actual system of a solution many times [Schmidt 6.2-1, 6.2-2, 6.2-12, 6.2-33].

    Initial deviation and unknowns, process and measurement noise are normal; the filter starts at the mean. The control
    is u - C dx', with the gain C of the solution. Where the cost is deterministic nothing is fed back: plant and filter
    run along the open-loop control, which validates the estimation covariance. Run k has the same numbers whatever the
    number of batches and workers, and for a given step whatever the number of runs. Memory: `batch` runs at a time,
    some 5 kB each, in every process, and for all runs the terminal values; histories of the first `paths` runs only.

    Args:
        solution: of a problem with an expected cost or an estimation covariance; or of phases with one each: every run
            then goes through all of them, with their jumps.
        runs: number of runs.
        seed: of the random numbers, a whole number.
        truth: what is simulated instead of the design's system: a problem with the same states, unknowns, controls and
            measurements and any dynamics, noises and variances; or a dict of parameter or unknown to the value that it
            has in every run. Of phases: `Phases` of such problems, or the dict for all that have the name. Filter and
            feedback stay those of the design.
        law: what flies instead of the design's filter and feedback: an object with `step(measurement, time)` that
            returns the whole control, (m,), such as a CPackage's `python()`. Each run has a deep copy of it, started by
            its `init()` where it has one, stepped every `period` from time zero on: with the mean of the actual
            measurement over the period before, (r,), NaN at time zero, and below it what was read at instants since
            its last step, NaN where nothing was; its control is held until the next step. Where
            it has an `estimate` of the deviation from the nominal, (n,), its errors are reported too. Of phases: a
            list or a dict by name, a law for each phase, which starts there anew in the time of the phase.
        period: time between two steps of the law [s]; None: its own attribute `period`.
        executor: anything with the `concurrent.futures` interface (processes, MPI, a Dask client's `get_executor()`);
            None: this process. Runs of a task that fails are named in a warning and in `.failed`; the rest is kept.
        filter: "perturbation" (gains of the design, about the nominal) or "extended" (relinearised at the estimate);
            a law has its own.
        step: longest integration step [s], shorter where loop, filter or the model with the time are faster; None:
            halved until the terminal second moments change by less than a fifth of their sampling error.
        limits: what the actual control can do: None (no limits: the bounds of the problem are those of the nominal),
            "bounds" (those of the problem), or a dict of control to (lower, upper), the others without limits. The
            share of runs that ask for more is reported in each case.
        store: number of times at which moments are kept.
        paths: number of runs whose histories are kept at these times.
        batch: number of runs that are simulated together, rounded up to a multiple of 64; None: up to 2048 here, 512 in
            a task of an executor.
        level: probability of the confidence bands.
        progress: whether to show the progress on a terminal.

    Returns:
        Moments, terminal scatter, costs, shares of runs, and a verdict on the linear prediction. After Ctrl-C those of
        the finished runs, with a warning.

    Raises:
        ProblemError: an argument is wrong, the truth does not fit, or there is nothing to simulate.
        SolveError: no run could be simulated.
    """
    size = (LARGEST_BATCH if executor is None else LARGEST_TASK) if batch is None else batch
    request = Request(runs=runs, seed=seed, store=store, paths=paths, batch=size, level=level, filter=filter, step=step)
    if isinstance(solution, PhasesSolution):
        asked = Asked(truth=truth, law=law, period=period, limits=limits)
        return simulate_phases(solution, request, asked, executor=executor, progress=progress)
    design = designed(solution)
    check_begins(solution, "simulate()")
    flown = flown_law(law, period, design, solution.duration)
    if flown is not None and filter != "perturbation":
        raise wrong_argument("filter", "no filter= beside law=: the law has its own", filter)
    actual = actual_system(design, truth)
    if truth is not None:
        check_truth(solution.extremal, actual.statement, actual.parameters, actual.variance)
    base = base_grid(solution, store, step, None if flown is None else flown.times)
    base = seeing(solution, design, actual, base, runs)
    expected = predict(solution, design, design, base)
    true = expected if truth is None else predict(solution, design, actual, base)
    setting = Setting(
        solution=solution,
        design=design,
        actual=actual,
        filter=filter if flown is None else "law",
        limits=limits_of(design, limits),
        domain=domain_of(solution, expected),
        flown=flown,
    )
    t, intervals = stored_times(base, store, sample_indices(flown, base), design.statement.inside.places)
    with Progress(f"simulating {solution.name}", progress) as reporter:
        chosen = chosen_step(setting, base, true, request, reporter)
        plan = make_plan(setting, chosen.grid, t, seed=int(seed), paths=paths)
        harvest = simulate_batches(plan, request.ranges, executor, lambda: reporter.stop, reporting(reporter))
        tell_missing(harvest, runs)
        at = indices(base, t)
        kept = tuple(prediction.at(at) for prediction in (expected, true))
        told = in_words(truth), true_cost(solution, truth)
        result = sample_of(setting, request, chosen, nominal_at(solution, t, intervals), kept, harvest, told)
        return examined_sample(result, setting, reporter)
