"""Where a run ended at what is no minimum, or at one that only the form of the controls makes: better points near."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from covocp.base.errors import CovocpError, last_line, warn_user
from covocp.base.later import later
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Extremal, Guess, Outcome, Prepared
from covocp.solution.patience import longest
from covocp.solving.attempts import cost_of, counted, with_stats
from covocp.solving.turns import unwound
from covocp.solving.warm_start import make_guess
from covocp.transcription.first_guess import controls_guess
from covocp.transcription.scales import WIDE_BOUNDS, choose_scales, unvanishing
from covocp.transcription.starts import moving_units
from covocp.transcription.trajectory import Trajectory

if TYPE_CHECKING:
    from covocp.extremal.curvature import Curvature
    from covocp.extremal.links import ChainOutcome

# A run that ends after so few iterations began at a stationary point, which need not be a minimum.
SUSPICIOUS_ITERATIONS = 3
# A run whose control moved no further than this share of it (or of its unit) ended where it began: the same suspicion.
UNMOVED = 1e-6
# So does one that is no further from its guess than this share of its unit, by which it moves some state.
IDLE = 0.03
# The same of a decision or an initial state that started beside its guess (`first_guess.BESIDE`).
UNMOVED_START = 0.03
# A saddle is left by the size of the controls, or by this share of what moves a state by its scale: in these units a
# step is none too small for the solver to see, nor so large that it leads to another valley.
DISPLACEMENT = 0.3
ESCAPES = (1.0, -1.0)
# A step to where the curvature alone sees a share of the cost is tried too where it is so many times as long.
FURTHER = 3.0
# Share of the cost by which another end must be cheaper than the saddle, to be another one: not the same with roundoff.
CHEAPER = 1e-9

# Among the counts of a run what is told of several starts.
OF_STARTS = ("starts", "asked", "excited", "left_duration")
# What is looked for.
SADDLE, TURNS = "the run ended at a saddle", "angles turn full circle between its nodes"

Looked = TypeVar("Looked", Outcome, "ChainOutcome")


def away_from_saddle(
    prepared: Prepared, outcome: Outcome, values: Array, reporter: Progress, start: Guess | None
) -> Outcome:
    """Where a run ended as soon, or where, it began, or saw a negative curvature, look at it; leave a saddle along it.

    The look takes no longer than what else is looked at after a run, nor than a limit of the time leaves. Where it
    fails the run counts as it ended, with a warning.

    Args:
        prepared: what ran.
        outcome: of it.
        values: of the parameters.
        reporter: of iterations.
        start: of the run; None: of the best of several, which is looked at however it ended.
    """
    return unless_it_fails(outcome, SADDLE, lambda: _off_saddle(prepared, outcome, values, reporter, start))


def unless_it_fails(outcome: Looked, what: str, look: Callable[[], Looked]) -> Looked:
    """What a look at an outcome finds; where it fails, the outcome: what is solved is not lost for a look at it.

    Args:
        outcome: of one problem or of several phases.
        what: is looked for, a clause.
        look: at the outcome; returns it, or a better one.
    """
    try:
        return look()
    except (CovocpError, RuntimeError) as error:  # CasADi's, of a step that cannot be solved
        warn_user(
            f"The look whether {what} failed ({last_line(error)}). The solution is that of before it; compare it with "
            "one from another guess."
        )
        return outcome


def _off_saddle(
    prepared: Prepared, outcome: Outcome, values: Array, reporter: Progress, start: Guess | None
) -> Outcome:
    """What `away_from_saddle` returns."""
    if not outcome.converged or reporter.stop or not (start is None or _suspicious(outcome, start)):
        return outcome
    left, longer = reporter.left[0], longest(outcome.stats)
    seconds = longer if left is None else min(left, longer)
    curvature = later("extremal.curvature").smallest_curvature(outcome.extremal, seconds)
    if curvature is None or curvature.verdict != "saddle":
        return outcome
    from covocp.extremal.optimality import mention_saddle
    from covocp.extremal.worth import HARDLY, worth_telling

    limit = cost_of(outcome) - CHEAPER * abs(cost_of(outcome))
    candidates: list[Outcome] = []
    for moved in _displaced(outcome.extremal, curvature):
        for away in moved:
            displaced = make_guess(outcome.extremal.statement, prepared.mesh, values, away)
            with suppress(CovocpError, RuntimeError):  # outside of the domain of the model; others may be within
                candidates.append(prepared.solve(values, displaced, reporter))
        better = [c for c in candidates if c.converged and cost_of(c) < limit]
        least = min(map(cost_of, better), default=cost_of(outcome))
        if reporter.stop or cost_of(outcome) - least > HARDLY * abs(cost_of(outcome)):
            break
    if not candidates:
        warn_user(
            "The run ended at a saddle (negative curvature of the reduced Hessian), and runs from beside it fail: the "
            "model has no values there. Start from another guess."
        )
    if not better:
        if candidates and worth_telling(outcome.extremal, curvature):
            mention_saddle(curvature.value / curvature.largest)
        return outcome
    best = min(better, key=cost_of)
    together = counted(outcome, best) | {name: outcome.stats[name] for name in OF_STARTS if name in outcome.stats}
    if cost_of(outcome) - cost_of(best) <= HARDLY * abs(cost_of(outcome)):
        _mention_left(best, seconds)
        return with_stats(best, **together)
    warn_user(
        "The run ended at a saddle (negative curvature of the reduced Hessian); it was left along that direction."
    )
    return with_stats(best, **together, left_saddle=True)


def _suspicious(outcome: Outcome, start: Guess) -> bool:
    """Whether a run ended as soon, or where, it began, or saw a negative curvature."""
    iterations = outcome.stats.get("iterations", -1)
    exact = outcome.stats.get("hessian") == "exact"
    if iterations <= SUSPICIOUS_ITERATIONS and (start.warm or not exact or iterations <= 0):
        return True
    if outcome.stats.get("concave") or _stayed(start, outcome.extremal):
        return True
    return _start_stayed(start, outcome.extremal)


def _mention_left(outcome: Outcome, seconds: float) -> None:
    """Warn where a run from beside a saddle went no further, as where a state is in far too small a unit for it."""
    from covocp.extremal.optimality import mention_saddle
    from covocp.extremal.worth import worth_telling

    curvature = later("extremal.curvature").smallest_curvature(outcome.extremal, seconds)
    if curvature is not None and curvature.verdict == "saddle" and worth_telling(outcome.extremal, curvature):
        mention_saddle(curvature.value / curvature.largest)


def _stayed(start: Guess, extremal: Extremal) -> bool:
    """Whether no control moved by more than a small share of its size or unit, or one came to nothing from a bend."""
    u, before = extremal.trajectory.u, start.trajectory.u
    moved, sizes = (np.abs(values).max(axis=0, initial=0.0) for values in (u - before, before))
    if not moved.size:
        return False
    if (moved <= UNMOVED * sizes).all():
        return True
    st = extremal.statement
    units = choose_scales(st, extremal.mesh, extremal.trajectory, extremal.parameters).u
    if (moved <= UNMOVED * (sizes + units)).all():
        return True
    flat = controls_guess(st, extremal.mesh.nodes, extremal.mesh.control, sign=0.0)
    return bool(not start.warm and (np.abs(u - flat).max(axis=0) <= IDLE * units).any())


def _start_stayed(start: Guess, extremal: Extremal) -> bool:
    """Whether an initial state that is free, or a decision, ended about where it began.

    Where its slope vanishes by symmetry it does, however far the controls go. A cold start is a little beside its
    guess, and may lead back to it, or no further: in the unit that far bounds tell this is none.
    """
    free = list(later("extremal.free_starts").free_start(extremal))
    if not free:
        return False
    t = extremal.trajectory
    units = unvanishing(extremal.statement, extremal.mesh, t, extremal.parameters)
    share = UNMOVED if start.warm else UNMOVED_START
    return bool((np.abs(t.x[0] - start.trajectory.x[0]) <= share * units)[free].any())


def _displaced(extremal: Extremal, curvature: Curvature) -> list[list[Trajectory]]:
    """The trajectory moved to both sides along the direction of the smallest curvature; if need be further as well.

    Bounds may tell too large a magnitude of an initial state, and none at all where they are left out: it is moved so
    far that by its curvature a share of the cost is gained, between what the bounds count for at least and at most.
    That may be next to nothing where a state begins near zero and goes far: then by its curvature alone.
    """
    from covocp.extremal.cost_sizes import variable_cost

    t, st = extremal.trajectory, extremal.statement
    units = moving_units(st, extremal.mesh, t, extremal.parameters)
    controls = np.maximum(np.sqrt(np.mean(t.u**2, axis=0)), DISPLACEMENT * units)
    moved = float((np.abs(curvature.direction) / controls).max(initial=0.0))
    steps = []
    for wide in (1.0, WIDE_BOUNDS):
        sizes = DISPLACEMENT * unvanishing(st, extremal.mesh, t, extremal.parameters, wide)
        steps.append(1.0 / max(moved, float((np.abs(curvature.start) / sizes).max(initial=0.0))))
    seen = float(np.sqrt(2.0 * DISPLACEMENT**2 * variable_cost(extremal) / abs(curvature.value)))
    near = float(np.clip(seen, steps[0], steps[1]))
    sizes_of_steps = [near] if seen <= FURTHER * near else [near, seen]
    return [[_beside(extremal, curvature, sign * size) for sign in ESCAPES] for size in sizes_of_steps]


def _beside(extremal: Extremal, curvature: Curvature, step: float) -> Trajectory:
    """The trajectory after a step along the direction of the smallest curvature, within bounds."""
    t, st = extremal.trajectory, extremal.statement
    x = t.x.copy()
    x[0] = np.clip(x[0] + step * curvature.start, *st.state_bounds)
    x[1:, st.decisions] = x[0, st.decisions]
    u = np.clip(t.u + step * curvature.direction, *st.control_bounds)
    return Trajectory(x=x, u=u, e=t.e, duration=t.duration)


def without_turns(prepared: Prepared, outcome: Outcome, values: Array, reporter: Progress) -> Outcome:
    """Solved again without the turns that angles make between nodes, where that works and is cheaper.

    Args:
        prepared: what ran.
        outcome: of it.
        values: of the parameters.
        reporter: of iterations.
    """
    return unless_it_fails(outcome, TURNS, lambda: _unwound(prepared, outcome, values, reporter))


def _unwound(prepared: Prepared, outcome: Outcome, values: Array, reporter: Progress) -> Outcome:
    """What `without_turns` returns."""
    straight = unwound(outcome.extremal) if outcome.converged and not reporter.stop else None
    if straight is None:
        return outcome
    again = prepared.solve(values, Guess(trajectory=straight), reporter)
    if not again.converged or not cost_of(again) < cost_of(outcome):
        return outcome
    return with_stats(again, **{**outcome.stats, **again.stats, **counted(outcome, again)})
