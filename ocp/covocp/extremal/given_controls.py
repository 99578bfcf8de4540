"""The extremal of given controls: one run along them, what it costs, and what it misses."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal, Outcome
from covocp.extremal.row_units import varied_by
from covocp.passage.sweep import values_by
from covocp.statement.conditions import Conditions, Inside, beyond
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import starts
from covocp.transcription.halved_steps import refined_run
from covocp.transcription.limit_units import limit_units
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.nlp import Scales
from covocp.transcription.scales import choose_scales, magnitudes
from covocp.transcription.shooting import shoot, single_shooting
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.trajectory import Multipliers, Trajectory

# A run along the controls of a nominal that leaves it by more than this, in magnitudes of the states, is another one.
DRIFTED = 1e-3
# Miss of a prescribed final value or a bound that is reported, relative to the largest value; of conditions in the unit
# of their limits.
MISS = 1e-6
# Limits of zero have no unit: theirs is at most so many times what the row varies by, which solvers do not see. By a
# small share of that a limit which is rounding itself (sin(pi)) may be missed.
FAR, ROUNDING = 1e3, 1e-14
# By how much Ipopt may pass a bound of a variable, in its scale, on short intervals by more: its nominals miss nothing.
RELAXED = 1e-7
# The message of a run that is not finite.
NOT_FINITE = "the model becomes NaN or inf along this nominal"


def evaluation_mesh(statement: Statement, options: Options, parameters: Array) -> Mesh:
    """One segment over the whole time, with the matrices propagated along it."""
    mesh = resolve_mesh(statement, options, parameters)
    return replace(mesh, segments=(mesh.intervals,), eliminated=True, points=1)


def evaluate_controls(
    statement: Statement,
    mesh: Mesh,
    u: Array,
    duration: float,
    parameters: Array,
    start: Array | None = None,
    held: Array | None = None,
) -> Outcome:
    """The outcome of given controls: states and matrices from the start, costs, what is missed.

    Args:
        statement: the problem.
        mesh: of one segment; where states are held of those that begin there.
        u: control values, (N + 1 or N, nu).
        duration: T [s].
        parameters: of the statement.
        start: state at the start; None: the statement's, free entries guessed.
        held: states at the nodes, (N + 1, nx), of a plan that these controls belong to: each segment is run from its
            own, where one run from the start would not stay there. None: one run; also of a coupled problem.
    """
    x0, e0 = starts(statement, mesh, parameters)
    x0, e0 = statement.started(x0 if start is None else start, parameters, e0)
    u = np.asarray(mesh.acting(u.T)).T
    if held is None or statement.coupled:
        given: tuple[Any, ...] = (u.T, x0, e0, duration, parameters)
        run = _one_run(statement, mesh)
    else:
        given = (u.T, np.vstack([x0, held[list(mesh.starts[1:])]]).T, e0, duration, parameters)
        run = _runs_of_segments(statement, mesh)
    at_nodes, halves, running = (np.asarray(value.full()) for value in run(*given))
    trajectory = Trajectory(x=at_nodes.T, u=u, e=halves.T, duration=duration)
    terminal = float(statement.terminal(trajectory.x[-1], trajectory.e[-1], duration, parameters))
    extremal = Extremal(
        stated=statement,
        mesh=mesh,
        trajectory=trajectory,
        parameters=parameters,
        multipliers=Multipliers.zero(statement, mesh),
    )
    finite = bool(np.isfinite(at_nodes).all() and np.isfinite(halves).all() and np.isfinite(running).all())
    return Outcome(
        extremal=extremal,
        cost_terms={"terminal": terminal, "running": float(running.item())},
        converged=finite,
        message="evaluated along a given nominal" if finite else NOT_FINITE,
        violations=missed(extremal) if finite else {},
        stats={},
    )


def with_costates(outcome: Outcome, costates: Array) -> Outcome:
    """An outcome whose intervals are run from states that are held, with costates of these at the nodes, (N + 1, nx).

    They tell what gaps between the intervals, by shorter steps, change of the cost; along an unstable plant those that
    are swept from the end are roundoff of what is there.
    """
    own = outcome.extremal
    if len(own.mesh.segments) != own.mesh.intervals or not np.isfinite(costates).all():
        return outcome
    return replace(outcome, extremal=replace(own, multipliers=replace(own.multipliers, gaps=costates[1:])))


def gaps_left(run: Extremal) -> float:
    """What the segments of a run miss of the states where the next ones begin, all together, in their magnitudes."""
    statement, t = run.statement, run.trajectory
    gaps = refined_run(statement, run.mesh, t, run.parameters, parts=1).jumps[:, : statement.nx]
    with np.errstate(over="ignore", invalid="ignore"):
        return float((np.abs(gaps).sum(axis=0) / magnitudes(statement, t, run.parameters).x).max(initial=0.0))


def drift(x: Array, run: Extremal) -> float:
    """By how much a run along the controls leaves states at the nodes that are meant, in their magnitudes."""
    scale = magnitudes(run.statement, replace(run.trajectory, x=x), run.parameters).x
    with np.errstate(over="ignore", invalid="ignore"):
        return float((np.abs(run.trajectory.x - x) / scale).max(initial=0.0))


def each_interval(mesh: Mesh) -> Mesh:
    """The mesh with a shooting segment for each interval."""
    return replace(mesh, segments=(1,) * mesh.intervals)


def _symbols(statement: Statement, mesh: Mesh, starts: int) -> list[ca.MX]:
    """Controls, states at so many places, half-vectors at the start, T and parameters."""
    return [
        ca.MX.sym("u", statement.nu, mesh.control_nodes),
        ca.MX.sym("x", statement.nx, starts),
        ca.MX.sym("e0", statement.ne),
        ca.MX.sym("T"),
        ca.MX.sym("p", statement.np),
    ]


def _one_run(statement: Statement, mesh: Mesh) -> ca.Function:
    """States and half-vectors at the nodes and the running cost of one run from the start."""
    symbols = _symbols(statement, mesh, 1)
    x, e, cost = single_shooting(statement, mesh, symbols[0], tuple(symbols[1:]))
    return ca.Function("along", symbols, [x, e, ca.sum2(cost)])


def _runs_of_segments(statement: Statement, mesh: Mesh) -> ca.Function:
    """The same of segments that are run each from a state of its own, the matrices along all of them."""
    symbols = _symbols(statement, mesh, len(mesh.starts))
    variables = SimpleNamespace(**dict(zip(("u", "x", "e", "duration", "parameters"), symbols, strict=True)))
    found = shoot(statement, mesh, variables, passage=values_by)
    return ca.Function("along", symbols, [found["x"], found["e"], ca.sum2(found["cost"])])


def missed(extremal: Extremal) -> dict[str, float]:
    """Prescribed final values, bounds, terminal and path inequalities that the nominal does not meet, by name.

    Those that are NaN or inf somewhere are missed by inf.
    """
    st, t = extremal.statement, extremal.trajectory
    result = {}
    target = st.boundary_values(extremal.parameters)[1]
    scale = np.maximum(np.abs(t.x).max(axis=0, initial=0.0), np.abs(np.nan_to_num(target)))
    for name, value, goal, size in zip(st.state_names, t.x[-1], target, scale, strict=True):
        if abs(value - goal) > MISS * size:  # NaN where it is free
            result[f"final value of {name}"] = float(abs(value - goal))
    units = choose_scales(st, extremal.mesh, t, extremal.parameters)
    for names, rows, (lower, upper), unit in (
        (st.state_names, t.x, st.state_bounds, units.x),
        (st.control_names, t.u, st.control_bounds, units.u),
    ):
        excess = np.maximum(lower - rows, rows - upper).max(axis=0, initial=0.0)
        sizes = np.abs([lower, upper])
        unit = np.minimum(unit, np.where(sizes > 0, sizes, np.inf).min(axis=0))
        allowed = MISS * np.abs(rows).max(axis=0, initial=0.0) + RELAXED * unit
        result |= {f"bounds of {n}": float(v) for n, v, a in zip(names, excess, allowed, strict=True) if v > a}
    for conditions, _, rows in extremal.inequalities():
        excess = beyond(rows, conditions.lower, conditions.upper).max(axis=0)
        allowed = _allowed(extremal, conditions, units)
        result |= {n: float(v) for n, v, a in zip(conditions.names, excess, allowed, strict=True) if v > a}
    return result


def _allowed(extremal: Extremal, conditions: Conditions | Inside, units: Scales) -> Array:
    """By how much each row of some conditions may be passed and is called met."""
    if isinstance(conditions, Inside):
        return np.concatenate([_allowed(extremal, part.conditions, units) for part in conditions.parts])
    limits = limit_units(conditions.lower, conditions.upper)
    varied = varied_by(extremal, conditions.function, units)
    known = np.isfinite(varied) & (varied > 0.0)
    own = np.where(known, np.minimum(limits, FAR * varied), limits)
    return np.asarray(np.maximum(MISS * own, np.where(known, ROUNDING * varied, 0.0)))


def without_value(extremal: Extremal) -> dict[str, float]:
    """Inequalities that are NaN or inf at a node where they are to hold, and the first time of that [s], by name."""
    result: dict[str, float] = {}
    for conditions, place, rows in extremal.inequalities():
        known = np.isfinite(rows)
        for i in np.flatnonzero(~known.all(axis=0)):
            if place == "instants":
                time = _instants(extremal)[i]
            else:
                time = float(extremal.time[-1] if place == "end" else extremal.time[known[:, i].argmin()])
            result[conditions.names[i]] = min(time, result.get(conditions.names[i], time))
    return result


def _instants(extremal: Extremal) -> list[float]:
    """The time of each row of the conditions at instants [s]."""
    parts = extremal.statement.inside.parts
    return [part.place * extremal.trajectory.duration for part in parts for _ in part.conditions.names]
