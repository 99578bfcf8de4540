"""What of a solution is computed when it is first asked for, by modules that no solve needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from covocp.extremal.mean_effect import MeanEffect, mean_effect, remembered
from covocp.extremal.optimality import Optimality, assess, identities, mention_saddle
from covocp.solution.patience import longest

if TYPE_CHECKING:
    from covocp.solution.solution import Solution


def optimality_of(solution: Solution) -> Optimality:
    """See `Solution.optimality`."""
    if solution.stored_optimality is not None:
        return solution.stored_optimality
    known = (solution.mesh_error, solution.smallest_eigenvalue, solution.loop, solution.cost_identity)
    if not solution.optimised:
        return identities(solution.extremal, *known)
    found = assess(solution.extremal, solution.costates, *known, solution.within, longest(solution.stats))
    if solution.converged:
        mention_saddle(found.curvature)
    return found


def mean_effect_of(solution: Solution) -> MeanEffect | None:
    """See `Solution.mean_effect`."""
    if solution.loop is None or solution.statement is None or solution.within is not None:
        return remembered(solution.stats)
    return mean_effect(solution.extremal, solution.loop)
