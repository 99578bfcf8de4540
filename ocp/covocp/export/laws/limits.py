"""The limits of the control that a controller gives out: what keeps them, what is said of them."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import warn_user
from covocp.base.expressions import Expr
from covocp.export.laws.history import History
from covocp.export.text.names import identifier
from covocp.statement.entries import entry_names
from covocp.statement.names import Limits
from covocp.statement.statement import Statement

# Share of its size by which a nominal control may lie outside without a word: solvers widen bounds by less.
ROUNDING = 1e-6


def clipped(value: Expr, limits: Limits) -> Any:
    """A control within its limits, an expression."""
    rows = []
    for i, (low, high) in enumerate(zip(*(bound.tolist() for bound in limits), strict=True)):
        row = ca.fmax(value[i], low) if np.isfinite(low) else value[i]
        rows.append(ca.fmin(row, high) if np.isfinite(high) else row)
    return ca.vertcat(*rows)


def limits_text(statement: Statement, limits: Limits) -> str:
    """What the header and the README say: the limits, or that there are none."""
    if any(np.isfinite(bound).any() for bound in limits):
        return f"Limits of the control, held from init on: {'; '.join(_ranges(statement, limits))}."
    missed = _missed(statement, limits)
    return "The control is not limited" + (f", not even {missed}." if missed else ".")


def limits_notes(statement: Statement, limits: Limits) -> tuple[str, ...]:
    """What the package says of itself: that the bounds of the problem are not kept, where they are not."""
    missed = _missed(statement, limits)
    return (f"the control is not limited {missed}",) if missed else ()


def limit_constants(statement: Statement, limits: Limits) -> dict[str, float]:
    """The finite limits as constants of the header."""
    m, units = limits[0].size, _units(statement)
    taken: set[str] = set()
    result = {}
    for i, name in enumerate(statement.control_names[:m]):
        label, unit = identifier(name.upper(), taken), f" [{units[name]}]" if units[name] else ""
        for bound, what in zip(limits, ("LOWER", "UPPER"), strict=True):
            if np.isfinite(bound[i]):
                result[f"LIMIT_{label}_{what}{unit}"] = float(bound[i])
    return result


def warn_outside(statement: Statement, limits: Limits, tables: History) -> None:
    """Warn where the nominal control itself lies outside the limits: what flies is not the plan then."""
    m, units, found = limits[0].size, _units(statement), []
    for i, name in enumerate(statement.control_names[:m]):
        u, low, high = tables.u[:, i], limits[0][i], limits[1][i]
        excess = np.maximum(low - u, u - high)
        k = int(np.argmax(excess))
        sizes = [abs(v) for v in (*u.tolist(), low, high) if np.isfinite(v)]
        if excess[k] > ROUNDING * max(sizes):
            reached = f"{u[k]:.4g}" + (f" [{units[name]}]" if units[name] else "")
            found.append(f"'{name}' is {reached} at {tables.nodes[k]:.4g} s, its limits {low:.12g} to {high:.12g}")
    if found:
        warn_user(
            "The nominal control lies outside the limits of the controller: "
            + "; ".join(found)
            + ". The controller gives out the limit there, so the plan is not what flies: "
            "solve with these limits as bounds of the control, or widen limits=."
        )


def _ranges(statement: Statement, limits: Limits) -> list[str]:
    """The limits of each control in words."""
    units, words = _units(statement), []
    for name, low, high in zip(statement.control_names, *(bound.tolist() for bound in limits), strict=False):
        if np.isfinite(low) and np.isfinite(high):
            text = f"from {low:.12g} to {high:.12g}"
        elif np.isfinite(low) or np.isfinite(high):
            text = f"at least {low:.12g}" if np.isfinite(low) else f"at most {high:.12g}"
        else:
            words.append(f"{name} not limited")
            continue
        words.append(f"{name} {text}" + (f" [{units[name]}]" if units[name] else ""))
    return words


def _missed(statement: Statement, limits: Limits) -> str:
    """The bounds of the problem that a controller without limits does not keep; "" where there are none."""
    m = limits[0].size
    bounds = (statement.control_bounds[0][:m], statement.control_bounds[1][:m])
    limited, bounded = (any(np.isfinite(bound).any() for bound in pair) for pair in (limits, bounds))
    if limited or not bounded:
        return ""
    ranges = "; ".join(text for text in _ranges(statement, bounds) if not text.endswith("not limited"))
    return f'to the bounds of the problem ({ranges}): limits="bounds" at the export does that'


def _units(statement: Statement) -> dict[str, str]:
    """Units of the controls by the names of their entries."""
    return {name: block.unit for block in statement.controls for name in entry_names((block,))}
