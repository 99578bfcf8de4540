"""What a run that failed says of what it could choose and of data: what went away without a bound, what bends where."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.kinks import MOSTLY_SMOOTH, kinks
from covocp.base.matrices import Array
from covocp.solution.solution import Solution
from covocp.solving.gain_start import free_gain_block
from covocp.statement.entries import entry_names
from covocp.statement.interval import model_symbols

# A decision or a control (in any unit) that is so many times its magnitude where no bound stops it has no end in sight.
FAR, FAR_CONTROL = 1e6, 1e12


def far_away(solution: Solution) -> str:
    """A line that names the decisions and controls that went to where no bound stops them; "" where none did."""
    statement = solution.statement
    if statement is None:
        return ""
    t, found = solution.trajectory, []
    decided = [block for block in statement.states if block.role == "decision"]
    for what, blocks, values, limits, far in (
        ("decision", decided, t.x[:1], statement.state_bounds, FAR),
        ("control", statement.controls, t.u, statement.control_bounds, FAR_CONTROL),
    ):
        for block in blocks:
            scale: Array = statement.scales.get(block.name, np.ones(block.size))
            bounds, own = [bound[block.span] for bound in limits], values[:, block.span]
            for k, name in enumerate(entry_names((block,))):
                value = float(own[np.argmax(np.abs(own[:, k])), k])
                side = "upper" if value > 0 else "lower"
                if not abs(value) <= far * scale[k] and not np.isfinite(bounds[int(value > 0)][k]):
                    found.append(f"the {what} '{name}' went to {value:.3g} and has no {side} bound")
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


def bent_cost(solution: Solution) -> str:
    """A line on a running cost with kinks in a control; "" where there are none, or something is violated."""
    statement = solution.statement
    if statement is None or not statement.nu or solution.violations:
        return ""
    kind: Any = statement.symbolic
    symbols = model_symbols(statement)
    controls = [kind.sym(block.name, block.size) for block in statement.controls]
    running = statement.rates(symbols[0], ca.vertcat(*controls), *symbols[2:])[2]
    own = free_gain_block(statement)  # which is in the cost by what this toolbox writes
    bends = [
        set() if block == own else kinks(running, [control]) - MOSTLY_SMOOTH
        for block, control in zip(statement.controls, controls, strict=True)
    ]
    if not any(bends):
        return ""
    names = " and ".join(f"'{block.name}'" for block, bent in zip(statement.controls, bends, strict=True) if bent)
    words = ", ".join(sorted(set().union(*bends)))
    return (
        f"\n  The running cost has kinks or jumps in {names} ({words}), where its slope may jump: a likely reason. "
        "Smooth it, sqrt(u**2 + s**2) for abs(u) with a small s; or split the control, u = p - n with p, n >= 0 and "
        "p + n for abs(u)."
    )
