"""Monte Carlo simulation of the actual nonlinear system with its noises, its filter and its feedback."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from covocp.base.arguments import checked, truth
from covocp.base.errors import ProblemError, SolveError, warn_user
from covocp.base.expressions import Given
from covocp.base.geometry import Geometry
from covocp.base.matrices import Array, read_only
from covocp.base.progress import Progress
from covocp.base.threads import one_at_a_time
from covocp.simulation.actual import System, actual_system, design_system
from covocp.simulation.batches import Batch, StoppedError
from covocp.simulation.constraints import counted_rows, promised
from covocp.simulation.flown import flown_law, sample_indices
from covocp.simulation.monte_carlo import MonteCarlo
from covocp.simulation.plan import make_plan
from covocp.simulation.prediction import Prediction, control_spread, predict
from covocp.simulation.request import Request, wrong_argument
from covocp.simulation.run_parts import Limits, Setting
from covocp.simulation.sampling import THREE_SIGMA, moments_of
from covocp.simulation.schedule import FilterKind, Grid, Nominal, base_grid, indices, nominal_at, stored_times
from covocp.simulation.step_choice import StepChoice, choose_step, examined, given_step
from covocp.simulation.verdict import LEFT
from covocp.simulation.workers import Harvest, simulate_batches
from covocp.solution.origin import Origin
from covocp.solution.phases import check_begins
from covocp.solution.solution import Solution
from covocp.solving.evaluation import evaluate
from covocp.statement.names import control_limits

# What stands for no such limit; a number, so that a comparison finds inf and NaN.
UNLIMITED = 1e300
# Runs in a batch: wide enough that numpy's operations outweigh their calls, and tasks enough for some workers.
LARGEST_BATCH, LARGEST_TASK = 2048, 512


@one_at_a_time
@checked(progress=truth)
def simulate(
    solution: Solution,
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
) -> MonteCarlo:
    """Simulate the actual system of a solution many times [Schmidt 6.2-1, 6.2-2, 6.2-12, 6.2-33].

    Initial deviation and unknowns, process and measurement noise are normal; the filter starts at the mean. The control
    is u - C dx', with the gain C of the solution. Where the cost is deterministic nothing is fed back: plant and filter
    run along the open-loop control, which validates the estimation covariance. Run k has the same numbers whatever the
    number of batches and workers, and for a given step whatever the number of runs. Memory: `batch` runs at a time,
    some 5 kB each, in every process, and for all runs the terminal values; histories of the first `paths` runs only.

    Args:
        solution: of a problem with an expected cost or an estimation covariance.
        runs: number of runs.
        seed: of the random numbers, a whole number.
        truth: what is simulated instead of the design's system: a problem with the same states, unknowns, controls and
            measurements and any dynamics, noises and variances; or a dict of parameter or unknown to the value that it
            has in every run. Filter and feedback stay those of the design.
        law: what flies instead of the design's filter and feedback: an object with `step(measurement, time)` that
            returns the whole control, (m,), such as a CPackage's `python()`. Each run has a deep copy of it, started by
            its `init()` where it has one, stepped every `period` from time zero on: with the mean of the actual
            measurement over the period before, (r,), NaN at time zero, and below it what was read at instants since
            its last step, NaN where nothing was; its control is held until the next step. Where
            it has an `estimate` of the deviation from the nominal, (n,), its errors are reported too.
        period: time between two steps of the law [s]; None: its own attribute `period`.
        executor: anything with the `concurrent.futures` interface (processes, MPI, a Dask client's `get_executor()`);
            None: this process. Runs of a task that fails are named in a warning and in `.failed`; the rest is kept.
        filter: "perturbation" (gains of the design, about the nominal) or "extended" (relinearised at the estimate);
            a law has its own.
        step: longest integration step [s]; None: halved until the terminal second moments change by less than a fifth
            of their sampling error.
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
    design = _design(solution)
    flown = flown_law(law, period, design, solution.duration)
    if flown is not None and filter != "perturbation":
        raise wrong_argument("filter", "no filter= beside law=: the law has its own", filter)
    actual = actual_system(design, truth)
    base = base_grid(solution, store, step, None if flown is None else flown.times)
    expected = predict(solution, design, design, base)
    true = expected if truth is None else predict(solution, design, actual, base)
    setting = Setting(
        solution=solution,
        design=design,
        actual=actual,
        filter=filter if flown is None else "law",
        limits=_limits(design, limits),
        domain=_domain(solution, expected),
        flown=flown,
    )
    t, intervals = stored_times(base, store, sample_indices(flown, base))
    with Progress(f"simulating {solution.name}", progress) as reporter:
        chosen = _step(setting, base, true, request, reporter)
        plan = make_plan(setting, chosen.grid, t, seed=int(seed), paths=paths)
        harvest = simulate_batches(plan, request.ranges, executor, lambda: reporter.stop, _reporting(reporter))
        _tell(harvest, runs)
        at = indices(base, t)
        kept = tuple(prediction.at(at) for prediction in (expected, true))
        result = _result(setting, request, chosen, nominal_at(solution, t, intervals), kept, harvest, truth)
        return _told(result, setting, reporter)


def _design(solution: Solution) -> System:
    """The system of a solution, which should have converged."""
    if not isinstance(solution, Solution):
        raise ProblemError(
            "This cannot be simulated.",
            expected="a Solution",
            received=type(solution).__name__,
            remedy=getattr(
                solution, "instead", "solve or evaluate the problem first: simulate(solve(problem), runs, seed)"
            ),
        )
    check_begins(solution, "simulate()")
    if solution.origin is Origin.OTHER_TRUTH:
        raise ProblemError(
            "This solution was evaluated under other statistics, which simulate() does not see in it.",
            expected="the solution of the design",
            received=f"'{solution.name}', {solution.message}",
            remedy="simulate(design, runs, seed, truth=...) with the same truth",
        )
    design = design_system(solution)
    if not solution.converged:
        warn_user(
            f"The solution that is simulated did not converge ({solution.message}): its nominal, filter and feedback "
            "may mean nothing."
        )
    return design


def _limits(design: System, limits: Given) -> Limits:
    """What the actual control can do, and what counts as all that there is."""
    lower, upper = control_limits(design.statement, design.fed_back, limits)
    least, most = (bound[: design.fed_back] for bound in design.statement.control_bounds)
    return Limits(
        lower=lower,
        upper=upper,
        least=np.where(np.isfinite(lower), lower, least),
        most=np.where(np.isfinite(upper), upper, most),
    )


def _domain(solution: Solution, expected: Prediction) -> Array:
    """Largest deviations that count as inside: what the solution promises, whatever gains between its nodes do."""
    spread = expected.deviation if solution.loop is None else solution.loop.X
    squares = np.diagonal(spread, axis1=1, axis2=2)
    squares = np.where(np.isfinite(squares), squares, 0.0).clip(0.0).max(axis=0)
    return np.asarray(np.where(squares > 0, LEFT * np.sqrt(squares), UNLIMITED))


def _step(setting: Setting, base: Grid, true: Prediction, request: Request, reporter: Progress) -> StepChoice:
    """The given step, or the one at which the statistics settle."""
    if request.step is not None:
        return given_step(base, float(request.step), true.step_rates)
    try:
        chosen = choose_step(
            _pilot(setting), base, true.step_rates, runs=request.runs, seed=request.seed, stop=lambda: reporter.stop
        )
    except StoppedError:
        raise KeyboardInterrupt from None  # nothing is simulated yet
    if not chosen.settled:
        warn_user(
            f"The statistics did not settle: at a step of {chosen.longest:.3g} s {chosen.reason}. Give step=, smaller."
        )
    return chosen


def _pilot(setting: Setting) -> Setting:
    """What flies in pilot runs: a law would take long, and the system moves as fast under the design's own filter."""
    return replace(setting, filter="perturbation", flown=None) if setting.flown else setting


def _told(sample: MonteCarlo, setting: Setting, reporter: Progress) -> MonteCarlo:
    """A result of which the step, where it was given and the prediction fails, is examined: it may be to blame."""
    if not sample.step.given or sample.verdict.holds or sample.interrupted:
        return sample
    try:
        step = examined(sample.step, _pilot(setting), runs=sample.runs, seed=sample.seed, stop=lambda: reporter.stop)
    except StoppedError:
        return sample
    if not step.settled:
        words = f"The given step of {step.longest:.3g} s is too long: {step.reason}."
        warn_user(f"{words} Give a smaller one, or leave step= out.")
    return replace(sample, step=step)


def _reporting(reporter: Progress) -> Callable[[Batch], None]:
    """What tells the progress after each batch: runs, mean cost, share of the runs that left the domain."""
    counts = {"runs": 0, "left": 0, "costs": 0}
    total = [0.0]

    def report(batch: Batch) -> None:
        costs = batch.cost[np.isfinite(batch.cost)]
        counts["runs"] += batch.runs
        counts["left"] += int(np.isfinite(batch.left).sum())
        counts["costs"] += costs.size
        total[0] += float(costs.sum())
        reporter.update(counts["runs"], total[0] / max(1, counts["costs"]), counts["left"] / counts["runs"])

    return report


def _tell(harvest: Harvest, runs: int) -> None:
    """Warn of runs that are missing.

    Raises:
        SolveError: where all are.
    """
    done = sum(batch.runs for batch in harvest.batches)
    if harvest.interrupted:
        if not done:
            raise KeyboardInterrupt
        warn_user(f"Interrupted: {done} of {runs} runs were simulated.")
    if not harvest.failures:
        return
    listed = "".join(f"\n  {failure}" for failure in harvest.failures[:10])
    if not done:
        raise SolveError(f"No run was simulated: every task failed.{listed}")
    warn_user(f"{done} of {runs} runs were simulated; the others failed:{listed}")


def _result(
    setting: Setting,
    request: Request,
    chosen: StepChoice,
    nominal: Nominal,
    predictions: tuple[Prediction, ...],
    harvest: Harvest,
    truth: Given,
) -> MonteCarlo:
    """The batches put together."""
    design, solution, (expected, true) = setting.design, setting.solution, predictions
    unknowns = np.tile(design.start[design.entries :], (nominal.t.size, 1))
    states = _values(design.motion, nominal.x)
    limits, m = setting.limits, design.fed_back
    costs = _predicted_costs(solution, truth) if setting.costs else (np.nan, np.nan)

    return MonteCarlo(
        **_of_runs(harvest.batches),
        name=solution.name,
        requested=int(request.runs),
        seed=int(request.seed),
        filter=setting.filter,
        period=np.nan if setting.flown is None else setting.flown.period,
        estimated=setting.flown is None or setting.flown.estimates,
        fed_back=m > 0,
        truth=_in_words(truth),
        level=float(request.level),
        step=chosen,
        t=nominal.t,
        nominal=np.hstack([*states, unknowns]),
        nominal_control=nominal.u[:, :m],
        predicted=true.deviation,
        predicted_error=true.error,
        predicted_mean=true.mean[:, : design.size],
        predicted_control=control_spread(solution, design, true, nominal),
        intended=np.full(design.size, np.nan) if solution.loop is None else np.diagonal(solution.loop.X[-1]).copy(),
        design=expected.deviation,
        design_error=expected.error,
        design_cost=costs[0],
        predicted_cost=costs[1],
        domain=setting.domain,
        limits=(limits.least, limits.most),
        limited=bool(np.isfinite(limits.lower).any() or np.isfinite(limits.upper).any()),
        inequalities=counted_rows(design),
        promised=promised(solution, design, nominal, true),
        failed=harvest.failures,
        interrupted=harvest.interrupted,
        blocks=design.statement.blocks,
        augmented=design.statement.augmented,
        symbols=design.statement.symbols,
    )


def _values(motion: Geometry, x: Array) -> list[Array]:
    """The nominal that deviations are added to: zero where the state is no vector."""
    return [x[:, p.rows] if p.chart is None else np.zeros((x.shape[0], p.chart.tangent)) for p in motion.parts]


def _of_runs(batches: Sequence[Batch]) -> dict[str, Any]:
    """What the result has for each run, and the sums over them."""
    names = {"deviations": "deviation", "estimates": "estimate", "costs": "cost"}
    names |= {name: name for name in ("left", "unanswered", "asked", "violated", "at_end", "paths")}
    values = {name: np.concatenate([getattr(batch, own) for batch in batches]) for name, own in names.items()}
    values["numbers"] = np.concatenate([np.arange(batch.first, batch.first + batch.runs) for batch in batches])
    for name in ("asking", "violating"):
        values[name] = np.sum([getattr(batch, name) for batch in batches], axis=0) / values["numbers"].size
    return {**read_only(values), "moments": moments_of(batches)}


def _predicted_costs(solution: Solution, truth: Given) -> tuple[float, float]:
    """Expected cost by the design, and by linear theory for the truth; NaN where that knows other dynamics."""
    if truth is None:
        return solution.cost, solution.cost
    try:
        return solution.cost, evaluate(solution, truth=truth).cost
    except (ProblemError, RuntimeError):  # `evaluate` takes other statistics only, of what has second derivatives
        return solution.cost, np.nan


def _in_words(truth: Given) -> str:
    """The truth in a few words; "" where it is the design's system."""
    if truth is None:
        return ""
    if isinstance(truth, Mapping):
        return ", ".join(f"{key} = {value}" for key, value in truth.items())
    return str(truth.name) or "another system"
