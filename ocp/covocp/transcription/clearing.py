"""Controls of little energy whose run meets some of the path conditions: penalised steps of Gauss and Newton."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.transcription.path_rows import Course, course, slopes_along
from covocp.transcription.steering import Run

# Weights of squared misses beside the energy, in units of what is due: of final values, of all else.
FINAL, LIMITS = 1e5, 300.0
# Linearisations, changes of what binds within one, shares of a step, the gain below which no other is worth while.
STEPS, CHANGES, LENGTHS, LITTLE = 10, 20, (1.0, 0.5, 0.2, 0.05), 3e-3
# Share by which a condition gives way beside what holds it, so that conditions that say the same have a solution.
SOFT = 1e-12
# A push is done where this share of it is left at most.
PUSHED = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class Push:
    """Half spaces of states at some nodes: normals @ x[node] >= levels, in units of a depth.

    nodes: (m,), normals: (m, nx), levels: (m,), depth: by how much the deepest one is pushed.
    """

    nodes: NDArray[np.intp]
    normals: Array
    levels: Array
    depth: float

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Clearing:
    """What a run is to meet, and what that may cost.

    Args:
        fixed, target: states with final values, and these.
        flat: controls without energy.
        sizes: of the excesses of the conditions and the bounded states, (rows,).
        energy: that counts as one.
    """

    fixed: tuple[int, ...]
    target: Array
    flat: Array
    sizes: Array
    energy: float

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rows:
    """Linear inequalities: values + slopes @ change <= 0."""

    values: Array
    slopes: Array

    __repr__ = short_repr


def energy(run: Run, u: Array, flat: Array) -> float:
    """Of the controls, beside those without."""
    return float(run.weights @ (u - flat).ravel() ** 2)


def cleared(
    along: Course,
    before: NDArray[np.bool_],
    meant: NDArray[np.bool_],
    task: Clearing,
    push: Push | None = None,
) -> tuple[Course, NDArray[np.bool_]]:
    """A course pushed to one side, then brought where the conditions that are meant are met, with little energy.

    Args:
        along: where to begin.
        before: what counts while it is pushed: what it is pushed out of would hold it back.
        meant: nodes and conditions that count, (K, rows); what is violated beside them is added to them.
        task: what else there is to meet.
        push: a side to which states must be moved first.

    Returns:
        The course, and what counted in the end.
    """
    value = np.inf
    for _ in range(STEPS):
        meant = _grown(meant, along.violated) if push is None else meant
        counted = meant if push is None else before
        value = _merit(along, counted, task, push)
        states, slopes = slopes_along(along)
        if not (np.isfinite(states).all() and np.isfinite(slopes).all()):
            return along, meant
        change = _change(along, states, _rows(along, counted, task, push, states, slopes), task)
        for length in LENGTHS:
            trial = course(along.run, along.run.clip(along.u + length * change.reshape(along.u.shape)))
            if trial is not None and (reached := _merit(trial, counted, task, push)) < value:
                break
        else:
            trial, reached = None, value
        along = along if trial is None else trial
        if push is not None and (trial is None or _left(along, push).max(initial=0.0) <= PUSHED):
            push = None
        elif trial is None or value - reached <= LITTLE * abs(value):
            break
    return along, _grown(meant, along.violated)


def _grown(meant: NDArray[np.bool_], violated: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What is meant, with what is violated at the nodes beside it without a break."""
    meant = meant.copy()
    for _ in range(meant.shape[0]):
        near = meant.copy()
        near[1:] |= meant[:-1]
        near[:-1] |= meant[1:]
        more = near & violated & ~meant
        if not more.any():
            break
        meant |= more
    return meant


def _left(along: Course, push: Push) -> Array:
    """What is left of a push, in units of its depth."""
    return np.asarray((push.levels - np.sum(push.normals * along.x[push.nodes], axis=1)) / push.depth)


def _misses(along: Course, task: Clearing) -> Array:
    """Of the final values, in the scales of the states."""
    rows = list(task.fixed)
    return np.asarray((along.x[-1, rows] - task.target) / along.run.divisors[rows])


def _merit(along: Course, meant: NDArray[np.bool_], task: Clearing, push: Push | None) -> float:
    """What is minimised."""
    beyond = np.maximum(along.excess / task.sizes, 0.0)[meant]
    value = energy(along.run, along.u, task.flat) / task.energy + FINAL * float(np.sum(_misses(along, task) ** 2))
    value += LIMITS * float(np.sum(beyond**2))
    return value if push is None else value + LIMITS * float(np.sum(np.maximum(_left(along, push), 0.0) ** 2))


def _rows(
    along: Course, meant: NDArray[np.bool_], task: Clearing, push: Push | None, states: Array, slopes: Array
) -> _Rows:
    """The inequalities of what is meant, and of a push, for a change of the controls."""
    nodes, rows = np.nonzero(meant)
    over, under = along.values - along.upper, along.lower - along.values
    sign = np.where(over > under, 1.0, -1.0)
    scale = sign[nodes, rows] / task.sizes[rows]
    values = [along.excess[nodes, rows] / task.sizes[rows]]
    parts = [scale[:, None] * slopes[nodes, rows]]
    if push is not None:
        values.append(_left(along, push))
        parts.append(-np.einsum("mi,min->mn", push.normals, states[push.nodes]) / push.depth)
    return _Rows(values=np.concatenate(values), slopes=np.vstack(parts))


def _change(along: Course, states: Array, rows: _Rows, task: Clearing) -> Array:
    """The change of the controls that is best to first order: what binds is found by repeated trial."""
    run, v = along.run, (along.u - task.flat).ravel()
    lower, upper = (np.broadcast_to(b, along.u.shape).ravel() for b in run.statement.control_bounds)
    unit = np.where(np.isfinite(upper - lower) & (upper > lower), upper - lower, 1.0)
    fixed = list(task.fixed)
    finals, misses = states[-1][fixed] / run.divisors[fixed][:, None], _misses(along, task)
    weights = run.weights / task.energy
    u, change, best, least = along.u.ravel(), np.zeros(v.size), np.zeros(v.size), np.inf
    for k in range(CHANGES):
        over, missed = np.maximum(rows.values + rows.slopes @ change, 0.0), misses + finals @ change
        outside = np.maximum(np.maximum(u + change - upper, lower - u - change) / unit, 0.0)
        value = weights @ (v + change) ** 2 + FINAL * missed @ missed + LIMITS * float(over @ over + outside @ outside)
        if value < least:
            best, least = change, value
        elif k > CHANGES // 2:
            break
        nearest = np.where(outside > 0, np.where(u + change > upper, upper - u, lower - u), 0.0)
        held = np.where(outside > 0, LIMITS / unit**2, 0.0)
        following = _least_squares(
            weights + held,
            held * nearest - weights * v,
            np.vstack([finals, rows.slopes[over > 0]]),
            np.append(misses, rows.values[over > 0]),
            np.append(np.full(misses.size, FINAL), np.full(np.count_nonzero(over > 0), LIMITS)),
        )
        if np.array_equal(following, change):
            break
        change = following
    return best


def _least_squares(own: Array, towards: Array, slopes: Array, values: Array, prices: Array) -> Array:
    """The z with the least z @ (own * z) / 2 - towards @ z + prices @ (values + slopes @ z)**2 / 2.

    By the rows, which are fewer than the unknowns, each in its own size: rows that say the same of what hardly moves
    leave the sum singular but for the last digits, so that each is held a little less than exactly.
    """
    plain, answers = towards / own, slopes / own
    gram = slopes @ answers.T + np.diag(1.0 / prices)
    sizes = np.sqrt(np.diag(gram))
    gram = gram / sizes / sizes[:, None] + SOFT * np.eye(sizes.size)
    forces = np.linalg.solve(gram, (values + slopes @ plain) / sizes) / sizes
    return np.asarray(plain - answers.T @ forces)


def in_sizes(task: Clearing, sizes: Array, unit: float) -> Clearing:
    """The task in other sizes of what is beyond the limits, and with another energy that counts as one."""
    return replace(task, sizes=sizes, energy=unit)
