"""What a run that failed says of its decisions and data: what went far away without a bound, what bends where."""

from __future__ import annotations

import numpy as np

from covocp.base.matrices import Array
from covocp.solution.solution import Solution
from covocp.statement.statement import entry_names

# A decision that moved by so many times its magnitude where no bound stops it has no end in sight.
FAR = 1e6


def far_away(solution: Solution) -> str:
    """A line that names the decisions that went to where no bound stops them; "" where none did."""
    statement = solution.statement
    if statement is None:
        return ""
    found, x = [], solution.trajectory.x[0]
    for block in (b for b in statement.states if b.role == "decision"):
        scale: Array = statement.scales.get(block.name, np.ones(block.size))
        bounds = [bound[block.span] for bound in statement.state_bounds]
        for k, name in enumerate(entry_names((block,))):
            value = float(x[block.span][k])
            side = "upper" if value > 0 else "lower"
            if not abs(value) <= FAR * scale[k] and not np.isfinite(bounds[int(value > 0)][k]):
                found.append(f"the decision '{name}' went to {value:.3g} and has no {side} bound")
    listed = "; ".join(found)
    return f"\n  {listed}: the cost may fall with it without end, give its bounds." if found else ""


def bent_data(solution: Solution) -> str:
    """A line on data with kinks under a free duration, whose slope by it jumps; "" where there are none."""
    statement = solution.statement
    if statement is None or not statement.duration.free:
        return ""
    bent = ", ".join(f"'{entry.name}'" for entry in statement.data if entry.kinks.size)
    if not bent:
        return ""
    return (
        f"\n  The data {bent} have kinks: where T is free its slope jumps whenever one of them passes a node. "
        "kind='cubic' is smooth; or solve for some fixed durations and compare."
    )
