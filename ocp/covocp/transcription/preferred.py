"""Where a cost prefers states to be: what a soft target tells of the way that they go."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.steering import Run

# Step of second differences in scales of the states; share of a cost below which they are roundoff; steps by which a
# state is moved at most.
DIFFERENCE, CURVED, FAR = 0.1, 1e-9, 1e4
# Where a step is lost in the rounding of the cost, or the way is many steps, in units far smaller than what it is
# about, it is asked again with steps so many times as long.
LONGER = 1e5
# Shares of the time at which it is asked what the running cost prefers; share of a slope that is none.
SHARES, SETTLED = (1.0 / 6.0, 0.5, 5.0 / 6.0), 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class At:
    """Where a cost is looked at: state (nx,), control (nu,), half-vectors (ne,), T [s], parameters (np,)."""

    x: Array
    u: Array
    e: Array
    duration: float
    parameters: Array

    __repr__ = short_repr


def wanted_end(run: Run, u: Array, e: Array) -> Array:
    """Where the states shall be in the end (nx,): final values, else where the cost prefers each; NaN: nothing tells.

    Args:
        run: its start, scales and parameters.
        u: control (nu,).
        e: half-vectors (ne,).
    """
    statement, target = run.statement, run.statement.boundary_values(run.parameters)[1]
    free = np.isnan(target)
    for block in statement.states:
        free[block.span] &= block.role == "moving" and not block.tangent
    at = At(x=run.start, u=u, e=e, duration=run.duration, parameters=run.parameters)
    return np.where(np.isnan(target), preferred(statement, at, run.divisors, free), target)


def preferred(statement: Statement, at: At, scale: Array, free: NDArray[np.bool_]) -> Array:
    """Where the cost prefers some states to be, each by itself; NaN where it prefers none.

    By second differences of the running cost at some times, in the mean over all of the time, and of the terminal one;
    the slope must be about nothing there: a cost that falls on and on prefers no place.

    Args:
        statement: the problem.
        at: where it is looked from.
        scale: typical magnitudes of the states, (nx,), positive.
        free: which states may be elsewhere, (nx,).

    Returns:
        Places, (nx,).
    """
    places = np.full(at.x.size, np.nan)
    rows, steps = np.flatnonzero(free & _weighed(statement)), DIFFERENCE * scale
    if rows.size:
        places[rows], short = _places(statement, at, rows, steps)
        if (again := rows[short]).size:
            places[again] = _places(statement, at, again, LONGER * steps)[0]
    return places


def _places(statement: Statement, at: At, rows: NDArray[np.intp], steps: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Where the cost prefers some states (rows) to be, by differences of some steps (nx,), and which are too short."""
    cost, bend, slope = _differences(statement, at, rows, steps)
    with np.errstate(all="ignore"):
        seen = np.isfinite(bend) & np.isfinite(slope) & (bend > CURVED * np.abs(cost).max(initial=0.0))
        short = np.isfinite(bend) & (np.abs(bend) <= CURVED * np.abs(cost).max(initial=0.0))
        moved = np.where(seen, -slope / np.where(seen, bend, 1.0), 0.0)
    far = np.abs(moved) >= FAR
    short |= seen & far
    seen &= ~far
    goal = at.x.copy()
    goal[rows] += np.where(seen, moved, 0.0) * steps[rows]
    goal = np.clip(goal, *statement.state_bounds)
    after = _differences(statement, replace(at, x=goal), rows, steps)[2]
    with np.errstate(all="ignore"):
        seen &= np.abs(after) <= np.maximum(SETTLED * np.abs(slope), DIFFERENCE * bend)
    return np.where(seen, goal[rows], np.nan), short


def _differences(statement: Statement, at: At, rows: NDArray[np.intp], steps: Array) -> tuple[Array, Array, Array]:
    """Costs about a point, second and first differences by some states, by steps; NaN if they fail."""
    u, e, T, p = at.u, at.e, at.duration, at.parameters
    each = np.arange(rows.size)
    points = np.tile(at.x, (1 + 2 * rows.size, 1))
    points[1 + 2 * each, rows] += steps[rows]
    points[2 + 2 * each, rows] -= steps[rows]
    cost = np.full(points.shape[0], np.nan)
    try:
        for k, point in enumerate(points):
            running = [float(statement.rates(point, u, e, share * T, T, p)[2]) for share in SHARES]
            cost[k] = T * np.mean(running) + float(statement.terminal(point, e, T, p))
    except RuntimeError:  # CasADi's, or one of a function that the user gave
        pass
    above, below = cost[1::2], cost[2::2]
    with np.errstate(all="ignore"):
        return cost, above + below - 2.0 * cost[0], 0.5 * (above - below)


@lru_cache(maxsize=KEPT)
def _weighed(statement: Statement) -> NDArray[np.bool_]:
    """States on which the running or the terminal cost depends, (nx,)."""
    found = np.zeros(statement.nx, dtype=bool)
    for function, output in ((statement.rates, 2), (statement.terminal, 0)):
        found |= np.asarray(ca.DM(function.jac_sparsity(output, 0), 1.0).full() != 0.0).any(axis=0)
    found.setflags(write=False)
    return found
