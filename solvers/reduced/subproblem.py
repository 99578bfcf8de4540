"""Convex quadratic subproblems with bounds and rows: by their active set where it is nearly known, else by DAQP."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr

# Sets that are tried from the last one before a solver of its own is asked, and after it.
TRIED = 12
# Violations and wrong signs below this, in the units of the problem, are roundoff.
ROUNDOFF = 1e-10
# Relative residual of the equations of a set, how often they are solved for what is left of them to reach it, and what
# is left where they depend on each other.
REFINED, MOST_REFINED = 1e-14, 4
DEPENDENT = 1e-8
# Share of the curvature that keeps the system of dependent rows solvable.
REGULAR = 1e-14
SETTINGS: dict[str, Any] = {"error_on_fail": False, "daqp": {"primal_tol": 1e-9, "iter_limit": 10000}}


@dataclass(frozen=True, kw_only=True)
class Quadratic:
    """Minimise q'd + d'B d/2 where lower <= rows d <= upper and low <= d <= high; B, and its inverse."""

    curvature: Array
    inverse: Array
    slope: Array
    rows: Array
    lower: Array
    upper: Array
    low: Array
    high: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Step:
    """The minimiser, multipliers of rows and bounds (positive at upper ones), and what is active (-1, 0, 1)."""

    change: Array
    of_rows: Array
    of_bounds: Array
    active_rows: Array
    active_bounds: Array

    __repr__ = short_repr


def solved(problem: Quadratic, active_rows: Array, active_bounds: Array) -> Step | None:
    """The minimiser, from a guess of what is active; None where there is none.

    Args:
        problem: to solve.
        active_rows: -1, 0 or 1 for each row: at its lower limit, at none, at its upper one.
        active_bounds: the same of the bounds.
    """
    step = _by_sets(problem, active_rows, active_bounds)
    if step is not None:
        return step
    found = _by_daqp(problem)
    if found is None:
        return None
    return _by_sets(problem, found.active_rows, found.active_bounds) or found


def _by_sets(problem: Quadratic, active_rows: Array, active_bounds: Array) -> Step | None:
    """Primal-dual active sets: what is violated joins, what pulls inwards leaves; None where that does not end."""
    equal = problem.lower == problem.upper
    for _ in range(TRIED):
        active_rows = np.where(equal, 1.0, active_rows)
        step = _with_active(problem, active_rows, active_bounds)
        if step is None:
            return None
        value = problem.rows @ step.change
        rows = _next_set(value, problem.lower, problem.upper, step.of_rows, active_rows)
        bounds = _next_set(step.change, problem.low, problem.high, step.of_bounds, active_bounds)
        rows = np.where(equal, 1.0, rows)
        if np.array_equal(rows, active_rows) and np.array_equal(bounds, active_bounds):
            return step
        active_rows, active_bounds = rows, bounds
    return None


def _next_set(value: Array, lower: Array, upper: Array, multiplier: Array, active: Array) -> Array:
    """What is active next."""
    room = ROUNDOFF * (1.0 + np.abs(value))
    outside = np.where(value > upper + room, 1.0, np.where(value < lower - room, -1.0, 0.0))
    stays = (active != 0) & (active * multiplier >= -ROUNDOFF * (1.0 + np.abs(multiplier).max(initial=0.0)))
    return np.asarray(np.where(active != 0, np.where(stays, active, 0.0), outside))


def _with_active(problem: Quadratic, active_rows: Array, active_bounds: Array) -> Step | None:
    """The minimiser where these limits are met as equations."""
    free, held = active_bounds == 0, active_rows != 0
    change = np.where(active_bounds > 0, problem.high, problem.low)
    change[free] = 0.0
    target = np.where(active_rows > 0, problem.upper, problem.lower)[held]
    B, A = problem.curvature, problem.rows[held]
    b = target - A @ change
    if held.sum() > free.sum():
        return None
    if free.all():
        found = _with_equations(B, problem.inverse, A, problem.slope, b)
    else:
        q = (problem.slope + B @ change)[free]
        inverse = _inverse_of(problem.inverse, free)
        found = None if inverse is None else _with_equations(B[np.ix_(free, free)], inverse, A[:, free], q, b)
    if found is None:
        return None
    change[free], multipliers = found
    of_rows = np.zeros(active_rows.size)
    of_rows[held] = multipliers
    of_bounds = np.where(free, 0.0, -(problem.slope + B @ change + problem.rows.T @ of_rows))
    return Step(
        change=change,
        of_rows=of_rows,
        of_bounds=of_bounds,
        active_rows=active_rows,
        active_bounds=active_bounds,
    )


def _inverse_of(inverse: Array, free: Array) -> Array | None:
    """The inverse of the free part of B from that of the whole; None where that has lost its rank to roundoff."""
    held = np.logical_not(free)
    across = inverse[np.ix_(free, held)]
    try:
        inner = np.linalg.solve(inverse[np.ix_(held, held)], across.T)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(inverse[np.ix_(free, free)] - across @ inner)


def _with_equations(B: Array, H: Array, A: Array, q: Array, b: Array) -> tuple[Array, Array] | None:
    """The minimiser of q'd + d'B d/2 with A d = b, and its multipliers; None where the equations depend on each other.

    By the inverse H of B that was learnt beside it, and for what that leaves once more.
    """
    W = H @ A.T
    S = A @ W
    S += REGULAR * np.diag(np.diag(S))
    change, multipliers = np.zeros(q.size), np.zeros(b.size)
    for _ in range(MOST_REFINED):
        left, missed = q + B @ change + multipliers @ A, A @ change - b
        if _is_small(left, q) and _is_small(missed, b):
            break
        y = H @ left
        if b.size:
            try:
                more = np.linalg.solve(S, missed - A @ y)
            except np.linalg.LinAlgError:
                return None
            y = y + W @ more
            multipliers = multipliers + more
        change = change - y
    if not (np.isfinite(change).all() and np.isfinite(multipliers).all()):
        return None
    unmet = np.abs(A @ change - b).max(initial=0.0) > DEPENDENT * (1.0 + np.abs(b).max(initial=0.0))
    return None if unmet else (change, multipliers)


def _is_small(left: Array, whole: Array) -> bool:
    """Whether what is left of an equation is roundoff."""
    return bool(np.abs(left).max(initial=0.0) <= REFINED * np.abs(whole).max(initial=0.0))


@lru_cache(maxsize=8)
def _daqp(variables: int, rows: int) -> ca.Function:
    """DAQP for dense problems of this size."""
    shapes = {"h": ca.Sparsity.dense(variables, variables), "a": ca.Sparsity.dense(rows, variables)}
    return ca.conic("qp", "daqp", shapes, SETTINGS)


def _by_daqp(problem: Quadratic) -> Step | None:
    """The minimiser by DAQP; None where it finds none."""
    solver = _daqp(problem.slope.size, problem.rows.shape[0])
    found = solver(
        h=problem.curvature,
        g=problem.slope,
        a=problem.rows,
        lba=problem.lower,
        uba=problem.upper,
        lbx=problem.low,
        ubx=problem.high,
    )
    if not solver.stats()["success"]:
        return None
    change, of_rows, of_bounds = (np.asarray(found[name].full()).ravel() for name in ("x", "lam_a", "lam_x"))
    equal = problem.lower == problem.upper
    return Step(
        change=np.clip(change, problem.low, problem.high),
        of_rows=of_rows,
        of_bounds=of_bounds,
        active_rows=np.where(equal, 1.0, np.sign(of_rows)),
        active_bounds=np.sign(of_bounds),
    )


def eased(problem: Quadratic, active_rows: Array, active_bounds: Array, price: float) -> tuple[Step, float] | None:
    """The minimiser where rows that d = 0 violates are eased by a common share of that, which has a price.

    Returns:
        The step and the share that is left of the violations, in [0, 1]; None where no step is found.
    """
    need = np.where(problem.lower > 0, problem.lower, np.where(problem.upper < 0, problem.upper, 0.0))
    n = problem.slope.size
    curvature = np.zeros((n + 1, n + 1))
    curvature[:n, :n] = problem.curvature
    curvature[n, n] = price
    inverse = np.zeros((n + 1, n + 1))
    inverse[:n, :n] = problem.inverse
    inverse[n, n] = 1.0 / price
    wide = Quadratic(
        curvature=curvature,
        inverse=inverse,
        slope=np.append(problem.slope, price),
        rows=np.column_stack([problem.rows, need]),
        lower=problem.lower,
        upper=problem.upper,
        low=np.append(problem.low, 0.0),
        high=np.append(problem.high, 1.0),
    )
    step = solved(wide, active_rows, np.append(active_bounds, 0.0))
    if step is None:
        return None
    cut = replace(step, change=step.change[:n], of_bounds=step.of_bounds[:n], active_bounds=step.active_bounds[:n])
    return cut, float(step.change[n])
