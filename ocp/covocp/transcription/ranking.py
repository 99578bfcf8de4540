"""Controls of several shapes as starts of a solver: brought to the final values, judged by cost and violations."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.statement.conditions import Conditions, beyond
from covocp.statement.interval import repeated
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.first_guess import matrices_function
from covocp.transcription.mesh import Mesh, control_places
from covocp.transcription.steering import Run, least_energy
from covocp.transcription.trajectory import at_nodes

# Bend that a start of the ranking keeps, in units of the bend, so that none is a symmetric point.
REMAINDER = 0.1
# Shapes of the controls of the starts, as cosines of that many half waves, and their sizes in units of the bend.
SHAPES = (0, 1, 2)
SIZES = (1.0, 3.0)
SIGNS = (1.0, -1.0)
# Controls that are bent apart from each other; more than these are bent together.
APART = 2
# Steps of each start before the first ranking, and of those that are left after it.
ROUGH_STEPS, FINE_STEPS = 6, 20
# A start counts as feasible up to this miss of final values and conditions, in their scales.
FEASIBLE = 1e-2
# Relative difference of costs below which two starts are one; starts that are kept at most.
SAME = 1e-3
LARGEST_NUMBER = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """Controls, what they cost, and what they violate (0 where that is little)."""

    u: Array
    cost: float
    violation: float

    __repr__ = short_repr


def judged(
    run: Run, fixed: tuple[int, ...], target: Array, shape: Array, flat: Array, steps: int, soft: tuple[int, ...] = ()
) -> Judged:
    """Controls near a shape, brought to the final values with little energy; those of some (soft) may be missed."""
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable nominal grows beyond what can be squared
        u, miss = least_energy(run, fixed, target, shape, flat, steps) if fixed else (shape, 0.0)
        cost, violation = merit(run, u)
        if soft:
            missed = (run.states(u)[-1, list(fixed)] - target) / run.divisors[list(fixed)]
            miss = float(np.abs(missed[[row not in soft for row in fixed]]).max(initial=0.0))
    violation = max(violation, miss)
    return Judged(u=u, cost=cost, violation=violation if violation > FEASIBLE else 0.0)


def distinct(judged: list[Judged]) -> list[Judged]:
    """The best of some starts, those left out that cost the same as a better one."""
    kept: list[Judged] = []
    for entry in sorted(judged, key=lambda e: (e.violation, e.cost)):
        if len(kept) == LARGEST_NUMBER or not np.isfinite(entry.cost):
            break
        twins = [k for k in kept if abs(entry.cost - k.cost) <= SAME * max(abs(entry.cost), abs(k.cost))]
        if not any((k.violation > 0) == (entry.violation > 0) for k in twins):
            kept.append(entry)
    return kept


def unsymmetric(run: Run, u: Array, flat: Array) -> Array:
    """Controls with a little of the bend, which follows their direction."""
    at = control_places(run.mesh.nodes, run.mesh.control)
    bend = run.units * (1.0 - at[:, None])
    return np.asarray(u + REMAINDER * np.where(np.sum((u - flat) * bend, axis=0) < 0, -1.0, 1.0) * bend)


def shapes(run: Run, flat: Array, own: Array) -> Iterator[Array]:
    """Controls from which the ranking begins."""
    nu = run.statement.nu
    at = control_places(run.mesh.nodes, run.mesh.control)
    patterns = np.eye(nu) if nu <= APART else np.vstack([np.ones(nu), np.where(np.arange(nu) % 2, -1.0, 1.0)])
    yield own
    yield flat
    for pattern in patterns:
        for waves in SHAPES:
            for size in SIZES:
                for sign in SIGNS:
                    wave = np.cos(np.pi * waves * at)[:, None]
                    yield run.clip(flat + sign * size * pattern * run.units * wave)


def merit(run: Run, u: Array) -> tuple[float, float]:
    """Cost of controls, and the largest violation of bounds and conditions, relative to their magnitude."""
    st, duration, p = run.statement, run.duration, run.parameters
    x = run.states(u)
    if not np.isfinite(x).all():
        return np.inf, np.inf
    e, running = np.zeros((x.shape[0], 0)), run.running(u)
    if st.matrices:
        values = matrices_of_run(st, run.mesh)(x.T, u.T, duration, p)
        e, running = np.asarray(values[0].full()).T, float(np.asarray(values[1].full()).sum())
    cost = running + float(st.terminal(x[-1], e[-1], duration, p))
    lower, upper = st.state_bounds
    violation = float((np.maximum(lower - x, x - upper) / run.divisors).max(initial=0.0))
    count = x.shape[0]
    columns = (x.T, at_nodes(u, count).T, e.T, run.mesh.nodes[None, :] * duration, *repeated(duration, p, count))
    places: list[tuple[Conditions, Any]] = [(st.path, slice(None)), (st.start, slice(1)), (st.end, slice(-1, None))]
    nearest = [int(np.abs(run.mesh.nodes - part.place).argmin()) for part in st.inside.parts]  # of a coarse mesh
    for conditions, at in [*places, *((p.conditions, [k]) for p, k in zip(st.inside.parts, nearest, strict=True))]:
        if conditions.size:
            chosen = [c[:, at] for c in columns]
            rows = conditions.function.map(chosen[0].shape[1])(*chosen).full().T
            limits = [np.nan_to_num(v, posinf=0.0, neginf=0.0) for v in (conditions.lower, conditions.upper)]
            excess = beyond(rows, conditions.lower, conditions.upper).max(axis=0)
            if not np.isfinite(excess).all():
                return np.inf, np.inf
            size = np.maximum.reduce([np.abs(rows).max(axis=0), np.abs(limits[0]), np.abs(limits[1])])
            violation = max(violation, float((excess / np.where(size > 0, size, 1.0)).max(initial=0.0)))
    return (cost, violation) if np.isfinite(violation) else (np.inf, np.inf)


@lru_cache(maxsize=KEPT)
def matrices_of_run(statement: Statement, mesh: Mesh) -> ca.Function:
    """See `guess.matrices_function`."""
    return matrices_function(statement, mesh)
