"""Costates and multipliers of a solution, by the names of what they belong to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array, unpack_costate
from covocp.solution.reading import name_in
from covocp.statement.names import block_of

if TYPE_CHECKING:
    from covocp.solution.solution import Solution


def costate_of(solution: Solution, symbol: Given) -> Array:
    """What `Solution.costate` returns, and its errors."""
    name = name_in(solution, symbol)
    b = block_of(name, solution.blocks)
    if b is None or b.kind not in ("state", "matrix"):
        names = ", ".join(q.name for q in solution.blocks if q.kind in ("state", "matrix"))
        raise ProblemError(
            f"'{name}' has no costate.",
            expected=f"a state or a matrix: {names}",
            received=name,
            remedy="ask for one of them",
        )
    if b.kind == "matrix":
        return unpack_costate(solution.costates.matrices[:, b.span], b.size)
    values = solution.costates.state[:, b.span]
    return np.asarray(values[:, 0] if b.size == 1 else values)


def multiplier_of(solution: Solution, key: Given) -> Array:
    """What `Solution.multiplier` returns, and its errors."""
    for place, names in solution.constraints.items():
        rows = [i for i, n in enumerate(names) if isinstance(key, str) and (n == key or n.startswith(f"{key}["))]
        if rows:
            values = getattr(solution.multipliers, "path_at_nodes" if place == "path" else place)[..., rows]
            return np.asarray(values[..., 0] if len(rows) == 1 else values)
    moving = tuple(b for b in solution.blocks if b.kind in ("state", "matrix"))
    others = tuple(dict.fromkeys(name.split("[")[0] for names in solution.constraints.values() for name in names))
    b = solution.block(name_in(solution, key, moving, others=others))
    if b.kind == "matrix":
        return unpack_costate(solution.final_multipliers[1][b.span], b.size)
    values = solution.final_multipliers[0][b.span]
    return np.asarray(values[0] if b.size == 1 else values)
