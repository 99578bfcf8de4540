"""Simulation of several phases: every run goes through all of them, each phase with its own step and prediction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from covocp.base.errors import ProblemError
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.simulation.batches import Cloud, StoppedError, run_stretch
from covocp.simulation.course import Course, Legs
from covocp.simulation.flown import sample_indices
from covocp.simulation.junction import Junction, junction
from covocp.simulation.monte_carlo import MonteCarlo
from covocp.simulation.phase_sample import PhasesMonteCarlo
from covocp.simulation.plan import Plan, make_plan
from covocp.simulation.prediction import Prediction, predict
from covocp.simulation.request import Request
from covocp.simulation.run_parts import Setting
from covocp.simulation.schedule import base_grid, indices, nominal_at, stored_times
from covocp.simulation.step_choice import PILOT_RUNS, StepChoice
from covocp.simulation.stretch import (
    chosen_step,
    designed,
    domain_of,
    examined_sample,
    limits_of,
    reporting,
    sample_of,
    tell_missing,
)
from covocp.simulation.workers import Harvest, simulate_batches
from covocp.solution.phases import PhasesSolution
from covocp.solution.solution import Solution


@dataclass(frozen=True, kw_only=True, eq=False)
class _Leg:
    """A phase made ready: its setting, prediction at all its times, step, plan, and where its pilot runs start."""

    setting: Setting
    expected: Prediction
    step: StepChoice
    plan: Plan
    stored: Any
    pilot: Cloud | None

    __repr__ = short_repr


def simulate_phases(solution: PhasesSolution, request: Request, *, executor: Any, progress: bool) -> PhasesMonteCarlo:
    """Simulate all phases; see `simulate`.

    Args:
        solution: of the phases, each with an estimation covariance.
        request: what was asked for.
        executor: of tasks, or None.
        progress: whether to show it.

    Raises:
        ProblemError: a phase estimates nothing, or the solution was read without its phases.
    """
    _check(solution)
    with Progress(f"simulating {solution.name}", progress) as reporter:
        try:
            legs, junctions = _legs(solution, request, reporter)
        except StoppedError:
            raise KeyboardInterrupt from None  # nothing is simulated yet
        course = Course(plans=tuple(leg.plan for leg in legs), junctions=tuple(junctions))
        tell = reporting(reporter)
        report: Callable[[Legs], None] = lambda done: tell(done.batches[-1])  # noqa: E731
        harvest = simulate_batches(course, request.ranges, executor, lambda: reporter.stop, report)
        tell_missing(harvest, request.runs)
        samples = tuple(_sample(leg, request, harvest, k, reporter) for k, leg in enumerate(legs))
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


def _legs(solution: PhasesSolution, request: Request, reporter: Progress) -> tuple[list[_Leg], list[Junction]]:
    """All phases made ready, each from where the predicted and the pilot runs of the one before it end."""
    legs = [_leg(solution[0], request, reporter)]
    junctions: list[Junction] = []
    for k, link in enumerate(solution.links):
        last, after = legs[-1], solution[k + 1]
        systems = last.setting.design, designed(after)
        junctions.append(junction(solution[k], after, *systems, link, request.filter))
        start = junctions[-1].predicted(last.expected.mean[-1], last.expected.covariance[-1])
        cloud = None if request.step is not None else junctions[-1].carried(_pilot_end(last, request, reporter))
        legs.append(_leg(after, request, reporter, start, cloud))
    return legs, junctions


def _leg(
    solution: Solution, request: Request, reporter: Progress, start: Any = None, pilot: Cloud | None = None
) -> _Leg:
    """A phase made ready."""
    design = designed(solution)
    base = base_grid(solution, request.store, request.step)
    expected = predict(solution, design, design, base, start)
    setting = Setting(
        solution=solution,
        design=design,
        actual=design,
        filter=request.filter,
        limits=limits_of(design, None),
        domain=domain_of(solution, expected),
    )
    stored = stored_times(base, request.store, sample_indices(None, base), design.statement.inside.places)
    chosen = chosen_step(setting, base, expected, request, reporter, pilot)
    plan = make_plan(setting, chosen.grid, stored[0], seed=int(request.seed), paths=request.paths)
    kept = expected.at(indices(base, stored[0]))
    return _Leg(setting=setting, expected=kept, step=chosen, plan=plan, stored=stored, pilot=pilot)


def _pilot_end(leg: _Leg, request: Request, reporter: Progress) -> Cloud:
    """Where the pilot runs of a phase end."""
    plan = make_plan(leg.setting, leg.step.grid, leg.step.grid.t[[0, -1]], seed=int(request.seed), pilot=True)
    count = min(int(request.runs), PILOT_RUNS)
    return run_stretch(plan, 0, count, lambda: reporter.stop, leg.pilot and leg.pilot.first(count))[1]


def _sample(leg: _Leg, request: Request, harvest: Harvest[Legs], number: int, reporter: Progress) -> MonteCarlo:
    """What the runs did in one phase."""
    own = Harvest(
        batches=tuple(legs.batches[number] for legs in harvest.batches),
        failures=harvest.failures,
        interrupted=harvest.interrupted,
    )
    nominal = nominal_at(leg.setting.solution, *leg.stored)
    predictions = leg.expected, leg.expected
    sample = sample_of(leg.setting, request, leg.step, nominal, predictions, own, None)
    if number and leg.pilot is None:  # examined from where runs start: that is known of the first phase only
        return sample
    return examined_sample(sample, leg.setting, reporter, leg.pilot)
