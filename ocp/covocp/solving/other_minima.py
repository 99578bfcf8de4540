"""Where a run ended at what is no minimum, or at one that only the form of the controls makes: better points near."""

from __future__ import annotations

import numpy as np

from covocp.base.errors import warn_user
from covocp.base.later import later
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Guess, Outcome, Prepared
from covocp.solving.attempts import cost_of, counted, with_stats
from covocp.solving.turns import unwound
from covocp.solving.warm_start import make_guess

# A run that ends after so few iterations began at a stationary point, which need not be a minimum.
SUSPICIOUS_ITERATIONS = 3
# A run whose control moved no further than this share of it (or in its unit) ended where it began: the same suspicion.
UNMOVED = 1e-6
ESCAPES = (1.0, -1.0)


def away_from_saddle(prepared: Prepared, outcome: Outcome, values: Array, reporter: Progress, start: Guess) -> Outcome:
    """Where a run ended as soon, or where, it began, look at the curvature, and leave a saddle along it.

    Args:
        prepared: what ran.
        outcome: of it.
        values: of the parameters.
        reporter: of iterations.
        start: of the run.
    """
    iterations = outcome.stats.get("iterations", -1)
    exact = outcome.stats.get("hessian") == "exact"
    few = iterations <= SUSPICIOUS_ITERATIONS and (start.warm or not exact or iterations <= 0)
    before, after = start.trajectory.u, outcome.extremal.trajectory.u
    stayed = before.size > 0 and bool(np.abs(after - before).max() <= UNMOVED * np.abs(before).max() + UNMOVED)
    if not outcome.converged or not (few or stayed):
        return outcome
    curvature = later("extremal.curvature").smallest_curvature(outcome.extremal)
    if curvature is None or curvature.verdict != "saddle":
        return outcome
    candidates = []
    for sign in ESCAPES:
        moved = curvature.displaced(outcome.extremal, sign)
        displaced = make_guess(outcome.extremal.statement, prepared.mesh, values, moved)
        candidates.append(prepared.solve(values, displaced, reporter))
    better = [c for c in candidates if c.converged and cost_of(c) < cost_of(outcome)]
    if not better:
        return outcome
    warn_user(
        "The run ended at a saddle (negative curvature of the reduced Hessian); it was left along that direction."
    )
    return with_stats(min(better, key=cost_of), left_saddle=True)


def without_turns(prepared: Prepared, outcome: Outcome, values: Array, reporter: Progress) -> Outcome:
    """Solved again without the turns that angles make between nodes, where that is cheaper.

    Args:
        prepared: what ran.
        outcome: of it.
        values: of the parameters.
        reporter: of iterations.
    """
    straight = unwound(outcome.extremal) if outcome.converged and not reporter.stop else None
    if straight is None:
        return outcome
    again = prepared.solve(values, Guess(trajectory=straight), reporter)
    if not again.converged or not cost_of(again) < cost_of(outcome):
        return outcome
    return with_stats(again, **{**outcome.stats, **again.stats, **counted(outcome, again)})
