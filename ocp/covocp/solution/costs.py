"""The cost of a solution by its terms, and against the closed loop's own covariances."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from covocp.extremal.closed_loop import COVARIANCES, ClosedLoop

if TYPE_CHECKING:
    from covocp.solution.solution import Solution


def split_cost(terms: Mapping[str, float], loop: ClosedLoop | None, handed: float) -> dict[str, float]:
    """Cost by term; of an expected cost the nominal's terms and what the deviations add, also those handed over."""
    if loop is None:
        return dict(terms)
    nominal = {name: loop.cost[name] for name in ("terminal", "running", COVARIANCES) if name in loop.cost}
    return nominal | {"deviations": float(sum(terms.values())) + handed - sum(nominal.values())}


def identity_of_costs(solution: Solution) -> float | None:
    """What `Solution.cost_identity` is."""
    if solution.loop is None or solution.cost_terms.keys() == solution.loop.cost.keys():
        return None
    own = solution.loop.expected_cost
    return abs(solution.cost - own) / max(abs(own), float(np.finfo(float).tiny))
