"""Controls that hold an unstable nominal: a run under the feedback of least energy, where runs by themselves explode.

Controls that are known beforehand take an unstable nominal anywhere: to the scales of what it grows to, an inverted
pendulum round and round. Of least energy is the feedback that minimises

    sum_k w_k |u_k - v_k|^2 + |x_N - goal|^2

for the nominal linearised along a reference, with controls v that break symmetries: it mirrors the unstable poles and
leaves the stable ones, in any units. The first reference is a straight line to the final values, or to where the cost
prefers the states to be; the next ones are the runs under the feedback.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.buffered import Buffered, Matrices
from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.statement.interval import Interval, model_symbols, repeated
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT, StepKind
from covocp.transcription.shooting import interval_columns
from covocp.transcription.steering import Run
from covocp.transcription.steps import nominal_interval
from covocp.transcription.stiffness import state_jacobian
from covocp.transcription.trajectory import Trajectory, at_nodes

# Runs under feedback, each with that of the nominal linearised along the last one.
RUNS = 4
# Weights of the squared miss of final values in units of the states, and of what grows, by how much it does: about the
# weights to which the cost to go comes over a long time, so that it is held to the end.
FINAL, HELD = 1e4, 2.0
# A run is no better than another one by less than this share.
BETTER = 1e-3
# Growth exponent of a nominal over the whole time from which on it is held: by itself it grows a thousand times.
EXPLOSIVE = 6.9
# A run that is held is too dear from so many times the cost of one that by itself goes where it shall, but for a miss.
DEAR, MISSED = 3.0, 0.3
# Places along a line at which it is asked what grows.
PLACES = 10
# Share of what a control moves below which it does not act on a mode.
UNFELT = 1e-9
# Share of an excitation below which there is none.
LEAST_SHARE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Held:
    """A run under feedback: states at the nodes (N + 1, nx) and the controls that it applied."""

    x: Array
    u: Array

    __repr__ = short_repr


class Aim(NamedTuple):
    """Where a run shall end (nx,), and the weight of the square of what it misses in units of the states (nx, nx)."""

    goal: Array
    weight: Array


class _Slopes(NamedTuple):
    """Slopes of the ends of the intervals, in units, and what they are beyond the next nodes of a reference.

    By the states at their starts (N, nx, nx), by the controls at their starts and at their ends (N, nx, nu); (N, nx).
    """

    state: Array
    first: Array
    last: Array
    jumps: Array


class _Law(NamedTuple):
    """Changes of the control values along a reference: first (nu,), then gains (N, nu, rows) and what is added."""

    first: Array
    gains: Array
    added: Array


def aim(run: Run, line: Array, u: Array, e: Array, target: Array) -> Aim | None:
    """Where a run that is held near a line shall end.

    Args:
        run: its scales and duration.
        line: states at the nodes, (N + 1, nx).
        u: control there (nu,).
        e: half-vectors there (ne,).
        target: final values of the states, (nx,); nan where there is none.

    Returns:
        None unless all along the line something that controls move grows by far over the time it has: where the end is
        stable, or what is between, the nominal goes there by itself.
    """
    found = None
    for k in sorted({round(place) for place in np.linspace(0, line.shape[0] - 1, PLACES)}):
        found = _growing(run, (line[k], u, e, run.duration * run.mesh.nodes[k], run.duration, run.parameters))
        if found is None:
            return None
    assert found is not None
    growth, across = found
    weight = (HELD * across * growth) @ across.conj().T
    fixed = np.diag(np.where(np.isnan(target), 0.0, FINAL))
    return Aim(goal=np.where(np.isnan(target), line[-1], target), weight=weight.real + fixed)


def _growing(run: Run, at: tuple[Any, ...]) -> tuple[Array, Any] | None:
    """Exponents over the whole time, left eigenvectors (columns) of what grows and controls move; None if by little."""
    slope = np.asarray(state_jacobian(run.statement)(*at).full())
    if not np.isfinite(slope).all():
        return None
    rates, across = np.linalg.eig((slope * run.divisors / run.divisors[:, None]).T)
    growth = run.duration * rates.real
    if not growth.max(initial=0.0) > EXPLOSIVE:
        return None
    acting = np.asarray(_by_controls(run.statement)(*at).full()) / run.divisors[:, None]
    felt = np.abs(across.T @ acting) > UNFELT * np.linalg.norm(acting, axis=0)  # else no control changes what grows
    chosen = (growth > 0.0) & felt.any(axis=1)
    return (growth[chosen], across[:, chosen]) if growth[chosen].max(initial=0.0) > EXPLOSIVE else None


@lru_cache(maxsize=KEPT)
def _by_controls(statement: Statement) -> ca.Function:
    """f_u as a function of the six arguments."""
    symbols = model_symbols(statement)
    assert statement.nominal is not None
    rate = statement.nominal(*symbols[:2], *symbols[3:])[0]
    return ca.Function("by_controls", symbols, [ca.densify(ca.jacobian(rate, symbols[1]))])


def too_dear(run: Run, held: Trajectory, left: Trajectory) -> bool:
    """Whether a run that is held costs far more than one that is left to itself and goes where it shall, too.

    What covariances cost is left out: of both they are about the same.
    """
    final = run.statement.boundary_values(run.parameters)[1]
    with np.errstate(all="ignore"):
        missed = np.nan_to_num(np.abs(left.x[-1] - final)) / run.divisors
        apart = np.abs(run.states(left.u)[-1] - left.x[-1]) / np.maximum(run.divisors, np.abs(left.x).max(axis=0))
        if not max(missed.max(initial=0.0), apart.max(initial=0.0)) < MISSED:
            return False
        costs = [_rough_cost(run, start) for start in (held, left)]
    return bool(np.isfinite(costs).all() and costs[0] > DEAR * max(costs[1], 0.0) and costs[0] > costs[1])


def _rough_cost(run: Run, start: Trajectory) -> float:
    """The cost of states and controls at the nodes by the trapezoidal rule, with no covariances."""
    st, T, p, count = run.statement, run.duration, run.parameters, start.x.shape[0]
    e = np.zeros(st.ne)
    columns = (start.x.T, at_nodes(start.u, count).T, np.zeros((st.ne, count)), run.mesh.nodes[None, :] * T)
    try:
        running = np.asarray(st.rates.map(count)(*columns, *repeated(T, p, count))[2].full()).ravel()
        return T * float(np.trapezoid(running, run.mesh.nodes)) + float(st.terminal(start.x[-1], e, T, p))
    except RuntimeError:
        return float("nan")


def in_moving_units(run: Run, line: Array, flat: Array) -> Run:
    """The run with controls in units of what moves some state by its scale if it acts all the time, and nothing else.

    The feedback of least energy is then the same in all units.
    """
    slopes = _linearised(run, line, flat)
    if slopes is None:
        return run
    moved = np.abs(slopes.first + slopes.last).sum(axis=0).max(axis=0)
    told = np.isfinite(moved) & (moved > 0.0)
    return replace(run, units=np.where(told, run.units / np.where(told, moved, 1.0), run.units))


def excited(run: Run, line: Array, aim: Aim, flat: Array, bend: Array) -> Held | None:
    """`held` about flat controls with as much of a bend as moves the run by no more than the scales of the states."""
    still = held(run, line, aim, flat)
    share = 1.0
    while still is not None and share > LEAST_SHARE:
        bent = held(run, line, aim, run.clip(flat + share * bend))
        moved = np.inf if bent is None else float((np.abs(bent.x - still.x) / run.divisors).max())
        if moved <= 1.0:
            return bent
        share *= max(0.5 / moved, 1e-3)
    return still


def held(run: Run, line: Array, aim: Aim, wanted: Array) -> Held | None:
    """The run of least energy that a feedback holds.

    Args:
        run: its start, mesh and units.
        line: the first reference, states at the nodes (N + 1, nx).
        aim: where it shall end.
        wanted: controls from which energy counts, and the first ones.

    Returns:
        The best of some runs; None where none stays finite.
    """
    x, u, best, least = line, wanted, None, np.inf
    for _ in range(RUNS):
        law = _law(run, x, u, wanted, aim)
        if law is None:
            break
        x, u = _run_under(run, law, x, u)
        if not np.isfinite(x).all():
            break
        missed = (x[-1] - aim.goal) / run.divisors
        value = float(run.weights @ (u - wanted).ravel() ** 2 + missed @ aim.weight @ missed)
        if not value < (1.0 - BETTER) * least:
            break
        best, least = Held(x=x, u=u), value
    return best


@lru_cache(maxsize=KEPT)
def _intervals(statement: Statement, substeps: int, step: StepKind, count: int) -> Matrices:
    """(states at the starts of intervals, *intervals) -> states at their ends, slopes by state and both controls."""
    x, interval = ca.MX.sym("x", statement.nx), Interval.symbols(statement, ca.MX)
    end = nominal_interval(statement, substeps, step)(x, *interval)[0]
    outputs = [end, *(ca.densify(ca.jacobian(end, by)) for by in (x, interval.start, interval.end))]
    return Matrices(ca.Function("slopes", [x, *interval], outputs).map(count))


def _law(run: Run, x: Array, u: Array, wanted: Array, aim: Aim) -> _Law | None:
    """The feedback of least energy along a reference, in units of the states and controls; None where it has no value.

    Between nodes a linear control is one of two values, of which the first is decided before: it is a state as well.
    """
    slopes = _linearised(run, x, u)
    if slopes is None:
        return None
    nu, count, linear = run.statement.nu, run.mesh.intervals, run.mesh.control == "linear"
    n, scale, units = x.shape[1], run.divisors, run.units
    energy = run.weights.reshape(u.shape) * units**2  # of the squares of controls in their units
    departure = (u - wanted) / units
    rows = n + nu if linear else n
    P, p = np.zeros((rows, rows)), np.zeros(rows)
    P[:n, :n] = aim.weight
    p[:n] = aim.weight @ ((x[-1] - aim.goal) / scale)
    gains, added = np.zeros((count, nu, rows)), np.zeros((count, nu))
    for k in range(count - 1, -1, -1):
        F, G, jump = _stage(slopes, k, linear)
        at = k + 1 if linear else k
        R, ahead = np.diag(energy[at]), P @ jump + p
        solved = _solved(R + G.T @ P @ G, np.column_stack([G.T @ P @ F, G.T @ ahead + R @ departure[at]]))
        if solved is None:
            return None
        gains[k], added[k] = -solved[:, :-1], -solved[:, -1]
        moved = F + G @ gains[k]
        p = moved.T @ ahead + gains[k].T @ (R @ departure[at])
        P = moved.T @ P @ moved + gains[k].T @ R @ gains[k]
    first = np.zeros((nu, 1))
    if linear:
        R = np.diag(energy[0])
        solved = _solved(R + P[n:, n:], (p[n:] + R @ departure[0])[:, None])
        if solved is None:
            return None
        first = -solved
    return _Law(first=first[:, 0], gains=gains, added=added)


def _solved(matrix: Array, right: Array) -> Array | None:
    """What solves a linear system; None where it is singular, or not finite."""
    try:
        found = np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(found) if np.isfinite(found).all() else None


def _linearised(run: Run, x: Array, u: Array) -> _Slopes | None:
    """The nominal linearised along a reference."""
    st, mesh, scale = run.statement, run.mesh, run.divisors
    columns = interval_columns(mesh, ca.DM(u.T), run.duration, ca.DM(run.parameters))
    function = _intervals(st, mesh.substeps, mesh.step, mesh.intervals)
    try:
        ends, *slopes = function.evaluated(x[:-1].T, *(np.asarray(column.full()) for column in columns))
    except RuntimeError:
        return None
    by_x, by_first, by_last = (
        np.moveaxis(v.reshape(st.nx, mesh.intervals, -1), 1, 0) * by / scale[:, None]
        for v, by in zip(slopes, (scale, run.units, run.units), strict=True)
    )
    return _Slopes(state=by_x, first=by_first, last=by_last, jumps=(ends.T - x[1:]) / scale)


def _stage(slopes: _Slopes, k: int, linear: bool) -> tuple[Array, Array, Array]:
    """State matrix, input matrix and jump of interval k; with the control at its start among the states."""
    A, B0, B1, jump = (each[k] for each in slopes)
    if not linear:
        return A, B0 + B1, jump
    nu = B0.shape[1]
    still = np.zeros((nu, A.shape[0] + nu))
    return np.vstack([np.hstack([A, B0]), still]), np.vstack([B1, np.eye(nu)]), np.append(jump, np.zeros(nu))


def _run_under(run: Run, law: _Law, x: Array, u: Array) -> tuple[Array, Array]:
    """States and controls of a run under feedback along a reference, controls within their bounds."""
    st, mesh, linear = run.statement, run.mesh, run.mesh.control == "linear"
    advance = Buffered(nominal_interval(st, mesh.substeps, mesh.step))
    lower, upper = st.control_bounds
    _, _, s, ds, _, _, reading = interval_columns(mesh, ca.DM(u.T), run.duration, ca.DM(run.parameters))
    places, lengths, readings = (np.asarray(v.full()) for v in (s, ds, reading))
    states, controls = np.full_like(x, np.nan), u.copy()
    states[0] = run.start
    if linear:
        controls[0] = np.clip(u[0] + law.first * run.units, lower, upper)
    for k in range(mesh.intervals):
        deviation = (states[k] - x[k]) / run.divisors
        if linear:
            deviation = np.append(deviation, (controls[k] - u[k]) / run.units)
        at = k + 1 if linear else k
        controls[at] = np.clip(u[at] + (law.gains[k] @ deviation + law.added[k]) * run.units, lower, upper)
        ends = (controls[k], controls[at], places[:, k], lengths[:, k])
        outputs = advance(states[k], *ends, np.array([run.duration]), run.parameters, readings[:, k])
        if outputs is None or not np.isfinite(outputs[0]).all():
            break
        states[k + 1] = outputs[0]
    return states, controls
