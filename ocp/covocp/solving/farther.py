"""Where a run ended at once because its cost does not see the units that it works in: it goes on in larger ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from covocp.base.later import later
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Extremal, Guess, Outcome, Prepared
from covocp.solving.attempts import cost_of, counted, with_stats
from covocp.transcription.noticed import LARGE_COST, further
from covocp.transcription.scales import choose_scales
from covocp.transcription.starts import base_run, completed, untold_controls
from covocp.transcription.trajectory import Trajectory

# Iterations up to which a run ended at once.
FEW = 3


def in_larger_units(
    ready: Callable[[], Prepared],
    prepared: Prepared,
    outcome: Outcome,
    values: Array,
    reporter: Progress,
    start: Guess,
    *,
    first: bool,
) -> tuple[Outcome, Prepared]:
    """Where a run ended as soon as it began, or at a large cost, look whether this sees the units; else go far away.

    Args:
        ready: makes a program for another start.
        prepared: what ran.
        outcome: of it.
        values: of the parameters.
        reporter: of iterations.
        start: of the run.
        first: whether none went before: of later ones those are looked at that made no step.

    Returns:
        The outcome, perhaps of another run, and what ran.
    """
    cost = cost_of(outcome)
    few = 0 <= outcome.stats.get("iterations", -1) <= (FEW if first else 0)
    suspicious = few or abs(cost) > LARGE_COST
    passed = start.warm or reporter.stop or outcome.extremal.statement.coupled
    if passed or not outcome.converged or not suspicious:
        return outcome, prepared
    found = _further(outcome.extremal, cost)
    if found is None:
        return outcome, prepared
    larger = ready()
    again = larger.solve(values, Guess(trajectory=found), reporter)
    if again.converged and cost_of(again) >= cost:
        return outcome, prepared
    return with_stats(again, **counted(outcome, again)), larger


def _further(extremal: Extremal, cost: float) -> Trajectory | None:
    """A trajectory that costs less, far away in the units of a solution; None where there is none."""
    st, mesh, t, p = extremal.statement, extremal.mesh, extremal.trajectory, extremal.parameters
    untold = untold_controls(st, np.zeros_like(t.u))
    free = [k for k in later("extremal.free_starts").free_start(extremal) if _untold_start(extremal, k)]
    if not untold.any() and not free:
        return None
    units = choose_scales(st, mesh, t, p, reached=True)
    run = replace(base_run(st, mesh, p, t.x[0], t.u), duration=t.duration)
    found = further(run, t.u, cost, units.u, untold, {k: float(units.x[k]) for k in free})
    if found is None:
        return None
    return completed(st, mesh, p, found.u, start=found.start, duration=t.duration)


def _untold_start(extremal: Extremal, k: int) -> bool:
    """Whether neither bounds nor a scale say of what size an entry of the initial state is."""
    st = extremal.statement
    lower, upper = st.state_bounds
    block = next(b for b in st.states if b.span.start <= k < b.span.stop)
    if block.role == "decision":  # whose scale is that of its guess
        return not np.isfinite(upper[k] - lower[k]) and not np.any(st.guesses[block.name])
    return not np.isfinite(upper[k] - lower[k]) and block.name not in st.scales
