"""One stretch of simulated flight, that of a problem or of a phase: its domain, limits and step, and what comes out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from covocp.base.errors import ProblemError, SolveError, warn_user
from covocp.base.expressions import Given
from covocp.base.geometry import Geometry
from covocp.base.matrices import Array, read_only
from covocp.base.progress import Progress
from covocp.extremal.closed_loop import COVARIANCES
from covocp.simulation.actual import System, design_system
from covocp.simulation.batches import Batch, Cloud, StoppedError
from covocp.simulation.constraints import counted_rows, promised
from covocp.simulation.monte_carlo import MonteCarlo
from covocp.simulation.noise_growth import Find, grown_at_end, of_solution
from covocp.simulation.prediction import Prediction, control_spread
from covocp.simulation.request import Request
from covocp.simulation.run_parts import Limits, Setting
from covocp.simulation.sampling import moments_of
from covocp.simulation.schedule import Grid, Nominal
from covocp.simulation.step_choice import StepChoice, choose_step, examined, given_step
from covocp.simulation.verdict import LEFT
from covocp.simulation.workers import Harvest
from covocp.solution.origin import Origin
from covocp.solution.solution import Solution
from covocp.solving.evaluation import evaluate
from covocp.statement.names import control_limits, name_of

# What stands for no such limit; a number, so that a comparison finds inf and NaN.
UNLIMITED = 1e300


def designed(solution: Given) -> System:
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


def limits_of(design: System, limits: Given) -> Limits:
    """What the actual control can do, and what counts as all that there is."""
    lower, upper = control_limits(design.statement, design.fed_back, limits)
    least, most = (bound[: design.fed_back] for bound in design.statement.control_bounds)
    return Limits(
        lower=lower,
        upper=upper,
        least=np.where(np.isfinite(lower), lower, least),
        most=np.where(np.isfinite(upper), upper, most),
    )


def domain_of(solution: Solution, expected: Prediction) -> Array:
    """Largest deviations that count as inside: what the solution promises, whatever gains between its nodes do."""
    spread = expected.deviation if solution.loop is None else solution.loop.X
    squares = np.diagonal(spread, axis1=1, axis2=2)
    squares = np.where(np.isfinite(squares), squares, 0.0).clip(0.0).max(axis=0)
    return np.asarray(np.where(squares > 0, LEFT * np.sqrt(squares), UNLIMITED))


def chosen_step(
    setting: Setting,
    base: Grid,
    true: Prediction,
    request: Request,
    reporter: Progress,
    cloud: Cloud | None = None,
) -> StepChoice:
    """The given step, or the one at which the statistics settle; `cloud`: where pilot runs start."""
    if request.step is not None:
        return given_step(base, float(request.step), true.step_rates)
    try:
        chosen = choose_step(
            pilot_setting(setting),
            base,
            true.step_rates,
            runs=request.runs,
            seed=request.seed,
            stop=lambda: reporter.stop,
            cloud=cloud,
        )
    except StoppedError:
        raise KeyboardInterrupt from None  # nothing is simulated yet
    if not chosen.settled:
        remedy = "Their bands are too narrow for that." if chosen.stalled else "Give step=, smaller."
        warn_user(f"The statistics did not settle: at a step of {chosen.longest:.3g} s {chosen.reason}. {remedy}")
    return chosen


def pilot_setting(setting: Setting) -> Setting:
    """What flies in pilot runs: a law would take long, and the system moves as fast under the design's own filter."""
    return replace(setting, filter="perturbation", flown=None) if setting.flown else setting


def examined_sample(sample: MonteCarlo, setting: Setting, reporter: Progress, cloud: Cloud | None = None) -> MonteCarlo:
    """A result of which the step, where it was given and the prediction fails, is examined: it may be to blame."""
    if not sample.step.given or sample.verdict.holds or sample.interrupted:
        return sample
    try:
        asked: Any = {"runs": sample.runs, "seed": sample.seed, "stop": lambda: reporter.stop, "cloud": cloud}
        step = examined(sample.step, pilot_setting(setting), **asked)
    except StoppedError:
        return sample
    if not step.settled:
        words = f"The given step of {step.longest:.3g} s is too long: {step.reason}."
        warn_user(f"{words} Give a smaller one, or leave step= out.")
    return replace(sample, step=step)


def reporting(reporter: Progress) -> Callable[[Batch], None]:
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


def tell_missing(harvest: Harvest[Any], runs: int) -> None:
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


def sample_of(
    setting: Setting,
    request: Request,
    chosen: StepChoice,
    nominal: Nominal,
    predictions: tuple[Prediction, ...],
    harvest: Harvest[Batch],
    truth: tuple[str, float],
    grown: Find | None = None,
) -> MonteCarlo:
    """The batches put together; `truth`: in words, and what linear theory says that it costs.

    `grown`: what finds what noise that varies adds, where that is not of the solution alone.
    """
    design, solution, (expected, true) = setting.design, setting.solution, predictions
    unknowns = np.tile(design.start[design.entries :], (nominal.t.size, 1))
    states = _values(design.motion, nominal.x)
    limits, m = setting.limits, design.fed_back
    costs = (cost_of_runs(solution), truth[1]) if setting.costs else (np.nan, np.nan)
    sample = MonteCarlo(
        **_of_runs(harvest.batches),
        name=solution.name,
        requested=int(request.runs),
        seed=int(request.seed),
        filter=setting.filter,
        period=np.nan if setting.flown is None else setting.flown.period,
        estimated=setting.flown is None or setting.flown.estimates,
        fed_back=m > 0,
        truth=truth[0],
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
        grown=np.zeros((2 * design.size, 2 * design.size)),
        design=expected.deviation,
        design_error=expected.error,
        design_cost=costs[0],
        predicted_cost=costs[1],
        spread_cost=cost_of_spread(solution) if setting.costs else 0.0,
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
    if sample.verdict.holds:  # nothing is to be explained
        return sample
    return replace(sample, grown=grown_at_end(grown or (lambda: of_solution(solution)), setting))


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


def cost_of_runs(solution: Solution) -> float:
    """The expected cost of runs: without what is not linear in the covariance of the closed loop, which no run has."""
    return solution.cost - cost_of_spread(solution)


def cost_of_spread(solution: Solution) -> float:
    """What of the expected cost is not linear in the covariance of the closed loop."""
    return 0.0 if solution.loop is None else float(solution.loop.cost.get(COVARIANCES, 0.0))


def true_cost(solution: Solution, truth: Given) -> float:
    """Expected cost of runs by linear theory for the truth; NaN where that knows other dynamics or constants."""
    if truth is None:
        return cost_of_runs(solution)
    unknowns = tuple(block.name for block in solution.blocks if block.kind == "unknown")
    if isinstance(truth, Mapping) and any(name_of(k, solution.symbols, unknowns, missing_ok=True) for k in truth):
        return np.nan  # what has one value in every run is not uncertain any more
    try:
        return cost_of_runs(evaluate(solution, truth=truth))
    except (ProblemError, RuntimeError):  # `evaluate` takes other statistics only, of what has second derivatives
        return np.nan


def in_words(truth: Given) -> str:
    """The truth in a few words; "" where it is the design's system."""
    if truth is None:
        return ""
    if isinstance(truth, Mapping):
        return ", ".join(f"{key} = {value}" for key, value in truth.items())
    return str(truth.name) or "another system"
