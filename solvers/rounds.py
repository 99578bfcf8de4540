"""Runs one after the other from where the last one ended: which helped, which is the best."""

from __future__ import annotations

import numpy as np

from covocp.base.residuals import VIOLATION
from covocp.solvers.reached import Round

# Residuals that are larger by less than this factor are those of the same point.
UNMOVED = 1.0 + 1e-9
# A point that has converged is left for the next one as long as that has no more than this share of its residuals.
HELPED = 0.5
# Share of the cost by which one of several points that have converged is dearer than another.
DEARER = 1e-6
# A run that met its tolerance, but not the limit, in scales that stay: the next one has so much less of it, as a share
# of what is too much, between these.
ENOUGH, STRICTEST, STRICTER = 0.3, 1e-3, 0.3


def left(entry: Round) -> float:
    """The largest change of the cost that a point leaves, in the unit of the cost; inf where that is not known."""
    found = entry.residuals
    return np.inf if found is None or found.violation > VIOLATION else found.worst * found.size


def helped(rounds: list[Round]) -> bool:
    """Whether the last run left less than the ones before, or did not move at all, so that more is to be asked."""
    if len(rounds) == 1:
        return True
    if rounds[-1].point.iterations == 0:
        return rounds[-2].point.iterations > 0
    return left(rounds[-1]) <= HELPED * left(best_of(rounds[:-1]))


def best_of(rounds: list[Round]) -> Round:
    """The round with the least residuals in the smallest cost without violations; the last where it did not move.

    One that converged before all others, and of several the cheapest: beside large penalties both may leave much.
    """
    converged = [entry for entry in rounds if entry.converged]
    if converged:
        cheapest = min(cost(entry) for entry in converged)
        rounds = [entry for entry in converged if cost(entry) <= cheapest + DEARER * abs(cheapest)]
    judged = [entry.residuals for entry in rounds]
    size = min((found.size for found in judged if found and found.violation <= VIOLATION), default=np.inf)
    worst = [np.inf if found is None else found.beside(size) for found in judged]
    least = int(np.argmin(worst))
    return rounds[-1] if worst[-1] <= UNMOVED * worst[least] else rounds[least]


def cost(entry: Round) -> float:
    """Of the point where a run ended, with what its violations may have saved."""
    found = entry.residuals
    saved = 0.0 if found is None else found.infeasibility * found.size
    return float(sum(part["running"] + part["terminal"] for part in entry.where[1]["parts"])) + saved


def share_for(times: float) -> float:
    """How much less is asked for, as a share, where there is so many times too much."""
    return float(np.clip(ENOUGH / times, STRICTEST, STRICTER))
