"""Sizes of controls that a cost notices, where what they move tells other ones.

A start of 1e-16, such as sin(pi), is no magnitude of a state, and a target of 1e12 metres is none of a control: in
units in which the cost does not change any point looks like a minimum of it. Newton's step along constant controls from
rest is the size that the cost itself asks for, whatever is added to it and whatever unit it is counted in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.statement.statement import Statement
from covocp.transcription.ranking import merit
from covocp.transcription.steering import Run

# Units of controls below the first, or a cost at the start above the second, are reason to look.
SMALL_UNIT, LARGE_COST = 1e-4, 1e6
# Share of the cost by which it must bend over a step to be seen above roundoff; steps that are tried, each so many
# times the one before.
SEEN = 1e-10
STEPS, FURTHER = 20, 1e3
# A cost that changes by less than this share of itself over a unit does not see it.
UNSEEN = 1e-8
# A size counts where it is so many times the unit.
FAR = 1e2
# Share of the cost by which a point far away must be less to be a better one, and what it may violate.
GAINED, MISSED = 1e-6, 1e-9
# Share of the cost up to which a run from the start costs what the nodes do.
SAME = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Moved:
    """Controls (N + 1 or N, nu) and an initial state (nx,)."""

    u: Array
    start: Array

    __repr__ = short_repr


def looks_wrong(statement: Statement, start: Array, e0: Array, u: Array, units: Array, parameters: Array) -> bool:
    """Whether units of controls are so small, or the cost at the start is so large, that the cost may not see them.

    Args:
        statement: the problem.
        start: initial state, (nx,).
        e0: half-vectors there.
        u: controls there, (nu,).
        units: of the controls that nothing tells.
        parameters: of the statement.
    """
    if (units < SMALL_UNIT).any():
        return True
    duration = statement.duration.guess
    running = float(statement.rates(start, u, e0, 0.0, duration, parameters)[2])
    terminal = float(statement.terminal(start, e0, duration, parameters))
    return bool(np.isfinite([running, terminal]).all() and abs(running) * duration + abs(terminal) > LARGE_COST)


def noticed_units(run: Run, flat: Array, units: Array, untold: NDArray[np.bool_]) -> Array:
    """Units of controls, in their place the sizes that the cost asks for, where these are far larger.

    Args:
        run: of the nominal.
        flat: controls around which is looked.
        units: of the controls, (nu,).
        untold: controls of which nothing tells a size, (nu,).
    """
    result, run = units.copy(), _in_pairs(run)
    with np.errstate(all="ignore"):
        cost = merit(run, flat)[0]
        for i in np.flatnonzero(untold).tolist() if np.isfinite(cost) else ():
            cost_of, unit = _along(run, flat, i), float(units[i])
            if max(abs(cost_of(side * unit) - cost) for side in (1.0, -1.0)) > UNSEEN * abs(cost):
                continue  # a cost that sees the unit needs no other
            size = abs(newton_step(cost_of, cost, unit))
            if size > FAR * unit:
                result[i] = size
    return result


def further(
    run: Run, u: Array, known: float, units: Array, untold: NDArray[np.bool_], free: Mapping[int, float]
) -> Moved | None:
    """Controls and a start that cost less, far away in their units; None where there are none along their axes.

    Args:
        run: of the nominal, from where a solver says that nothing is gained.
        u: its controls.
        known: what it costs by the nodes of the solver; from the start of an unstable plant it would cost more.
        units: of the controls, (nu,).
        untold: controls of which nothing tells a size, (nu,).
        free: units of entries of the initial state that are free, of which nothing tells a size.
    """
    run = _in_pairs(run)
    with np.errstate(all="ignore"):
        cost, violation = merit(run, u)
        if not abs(cost - known) <= SAME * abs(known):
            return None
        start, moved = run.start.copy(), u.copy()
        for i in np.flatnonzero(untold).tolist():
            step = newton_step(_along(run, u, i), cost, float(units[i]))
            if abs(step) > FAR * units[i]:
                moved[:, i] += step
        for k, unit in free.items():
            step = newton_step(_from(run, u, k), cost, unit)
            start[k] += step if abs(step) > FAR * unit else 0.0
        moved = run.clip(moved)
        found = merit(_started(run, start), moved)
    if found[0] < cost - GAINED * abs(cost) and found[1] <= max(violation, MISSED):
        return Moved(u=moved, start=_started(run, start).start)
    return None


def _in_pairs(run: Run) -> Run:
    """The run with an even number of substeps, where a cost of matrices is integrated by Simpson's rule."""
    odd = run.statement.running_uses_matrices and run.mesh.substeps % 2
    return replace(run, mesh=replace(run.mesh, substeps=2 * run.mesh.substeps)) if odd else run


def _along(run: Run, u: Array, i: int) -> Callable[[float], float]:
    """The cost of controls of which one is changed by a constant, within its bounds."""
    constant = np.eye(u.shape[1])[i]
    return lambda step: merit(run, run.clip(u + step * constant))[0]


def _from(run: Run, u: Array, k: int) -> Callable[[float], float]:
    """The cost of controls from where one entry of the start is changed."""
    one = np.eye(run.start.size)[k]
    return lambda step: merit(_started(run, run.start + step * one), u)[0]


def _started(run: Run, start: Array) -> Run:
    """The run from another initial state, with what decisions give in it."""
    e0 = run.statement.boundary_values(run.parameters).initial_matrices
    return replace(run, start=np.asarray(run.statement.started(start, run.parameters, e0)[0]))


def newton_step(cost_of: Callable[[float], float], cost: float, unit: float) -> float:
    """-slope / curvature of a cost, measured over the first step that is long enough; 0 where it tells none."""
    step = unit
    for _ in range(STEPS):
        up, down = cost_of(step), cost_of(-step)
        if not np.isfinite([up, down]).all():
            return 0.0
        bend = up - 2.0 * cost + down
        if abs(bend) > SEEN * max(abs(cost), abs(up), abs(down)):
            return step * (down - up) / (2.0 * bend) if bend > 0 else 0.0
        step *= FURTHER
    return 0.0
