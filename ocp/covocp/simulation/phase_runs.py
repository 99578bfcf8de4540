"""Simulation of several phases: every run goes through all of them, each phase with its own step and prediction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.simulation.batches import Cloud, StoppedError, run_stretch
from covocp.simulation.course import Course, Legs
from covocp.simulation.flown import sample_indices
from covocp.simulation.junction import Junction, junction
from covocp.simulation.monte_carlo import MonteCarlo
from covocp.simulation.noise_growth import Find, of_phase
from covocp.simulation.phase_asked import Asked, Flight, flight
from covocp.simulation.phase_sample import PhasesMonteCarlo
from covocp.simulation.plan import Plan, make_plan
from covocp.simulation.prediction import Prediction, predict
from covocp.simulation.request import Request
from covocp.simulation.run_parts import Setting
from covocp.simulation.schedule import base_grid, indices, nominal_at, stored_times
from covocp.simulation.step_choice import PILOT_RUNS, StepChoice
from covocp.simulation.stretch import (
    chosen_step,
    domain_of,
    examined_sample,
    pilot_setting,
    reporting,
    sample_of,
    tell_missing,
)
from covocp.simulation.unseen import seeing
from covocp.simulation.workers import Harvest, simulate_batches
from covocp.solution.phases import PhasesSolution


@dataclass(frozen=True, kw_only=True, eq=False)
class _Leg:
    """A phase made ready: its setting, predictions at all its times, step, plan, and where its pilot runs start.

    expected: by the design; true: of what is simulated.
    """

    setting: Setting
    expected: Prediction
    true: Prediction
    step: StepChoice
    plan: Plan
    stored: Any
    pilot: Cloud | None

    __repr__ = short_repr


def simulate_phases(
    solution: PhasesSolution, request: Request, asked: Asked, *, executor: Any, progress: bool
) -> PhasesMonteCarlo:
    """Simulate all phases; see `simulate`.

    Args:
        solution: of the phases, each with an estimation covariance.
        request: what was asked for.
        asked: what flies.
        executor: of tasks, or None.
        progress: whether to show it.

    Raises:
        ProblemError: a phase estimates nothing, the solution was read without its phases, or what flies does not fit.
    """
    _check(solution)
    flown = flight(solution, request, asked)
    with Progress(f"simulating {solution.name}", progress) as reporter:
        try:
            legs, junctions = _legs(flown, request, reporter)
        except StoppedError:
            raise KeyboardInterrupt from None  # nothing is simulated yet
        names = tuple(phase.name for phase in solution)
        course = Course(plans=tuple(leg.plan for leg in legs), junctions=tuple(junctions), names=names)
        tell = reporting(reporter)
        report: Callable[[Legs], None] = lambda done: tell(done.batches[-1])  # noqa: E731
        harvest = simulate_batches(course, request.ranges, executor, lambda: reporter.stop, report)
        tell_missing(harvest, request.runs)
        samples = tuple(_sample(flown, leg, request, harvest, k, reporter) for k, leg in enumerate(legs))
    return PhasesMonteCarlo(name=solution.name, phases=samples, starts=solution.starts)


def _check(solution: PhasesSolution) -> None:
    """All phases have a filter, and what passes between them is known.

    Raises:
        ProblemError: they do not.
    """
    if len(solution.links) != len(solution) - 1:
        raise ProblemError(
            "This solution knows no phases, so there is nothing to simulate.",
            expected="a solution with its phases",
            received=f"'{solution.name}', read from a file",
            remedy="load(path, phases) with the phases that were solved",
        )
    for phase in solution:
        if not any(block.estimation for block in phase.blocks):
            raise ProblemError(
                f"Nothing is estimated in the phase '{phase.name}', so its filter cannot be simulated.",
                expected="estimation_covariance() in every phase",
                received=f"'{phase.name}' without it",
                remedy="call it there too: what is not measured grows with its noise",
            )


def _legs(flown: Flight, request: Request, reporter: Progress) -> tuple[list[_Leg], list[Junction]]:
    """All phases made ready, each from where the predicted and the pilot runs of the one before it end."""
    legs = [_leg(flown, 0, request, reporter)]
    junctions: list[Junction] = []
    for k in range(len(flown.solution.links)):
        last = legs[-1]
        junctions.append(junction(*flown.ends(k), flown.filter))
        expected = junctions[-1].design.predicted(last.expected.mean[-1], last.expected.covariance[-1])
        true = junctions[-1].actual.predicted(last.true.mean[-1], last.true.covariance[-1])
        cloud = None if request.step is not None else junctions[-1].carried(_pilot_end(last, request, reporter))
        legs.append(_leg(flown, k + 1, request, reporter, (expected, true), cloud))
    return legs, junctions


def _leg(
    flown: Flight, k: int, request: Request, reporter: Progress, starts: Any = (None, None), pilot: Cloud | None = None
) -> _Leg:
    """A phase made ready.

    Args:
        flown: what flies.
        k: number of the phase.
        request: what was asked for.
        reporter: of the progress.
        starts: means and covariances with which the predictions start, of the design and of what is simulated.
        pilot: where its pilot runs start; None: drawn.
    """
    solution, design, actual, law = flown.solution[k], flown.designs[k], flown.actual.systems[k], flown.flown[k]
    base = base_grid(solution, request.store, request.step, None if law is None else law.times)
    base = seeing(solution, design, actual, base, int(request.runs))
    expected = predict(solution, design, design, base, starts[0])
    true = expected if actual is design else predict(solution, design, actual, base, starts[1])
    setting = Setting(
        solution=solution,
        design=design,
        actual=actual,
        filter=flown.filter,
        limits=flown.limits[k],
        domain=domain_of(solution, expected),
        flown=law,
    )
    stored = stored_times(base, request.store, sample_indices(law, base), design.statement.inside.places)
    chosen = chosen_step(setting, base, true, request, reporter, pilot)
    plan = make_plan(setting, chosen.grid, stored[0], seed=int(request.seed), paths=request.paths)
    kept = (prediction.at(indices(base, stored[0])) for prediction in (expected, true))
    return _Leg(
        setting=setting, expected=next(kept), true=next(kept), step=chosen, plan=plan, stored=stored, pilot=pilot
    )


def _pilot_end(leg: _Leg, request: Request, reporter: Progress) -> Cloud:
    """Where the pilot runs of a phase end."""
    setting, ends = pilot_setting(leg.setting), leg.step.grid.t[[0, -1]]
    plan = make_plan(setting, leg.step.grid, ends, seed=int(request.seed), pilot=True)
    count = min(int(request.runs), PILOT_RUNS)
    return run_stretch(plan, 0, count, lambda: reporter.stop, leg.pilot and leg.pilot.first(count))[1]


def _sample(
    flown: Flight, leg: _Leg, request: Request, harvest: Harvest[Legs], number: int, reporter: Progress
) -> MonteCarlo:
    """What the runs did in one phase."""
    own = Harvest(
        batches=tuple(legs.batches[number] for legs in harvest.batches),
        failures=harvest.failures,
        interrupted=harvest.interrupted,
    )
    nominal = nominal_at(leg.setting.solution, *leg.stored)
    told = flown.actual.words, float(flown.actual.costs[number])
    grown: Find = lambda: of_phase(flown.solution, number)  # noqa: E731
    sample = sample_of(leg.setting, request, leg.step, nominal, (leg.expected, leg.true), own, told, grown)
    if number and leg.pilot is None:  # examined from where runs start: that is known of the first phase only
        return sample
    return examined_sample(sample, leg.setting, reporter, leg.pilot)
