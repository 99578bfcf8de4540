"""What curved rates and measurements do to the mean of a closed loop, and that to its cost: left out of the cost.

The expected cost expands L and k to second order in the deviations, and takes rates and measurements as linear
[Schmidt 6.2, 6.3]. Their own second-order terms move the mean d of the deviation, y of its estimate, from zero:

    d' = F d - G C y + q/2,    y' = (F - G C) y + K (M (d - y) + r/2),
    q_i = tr(f_i,zz Z),  r_i = tr(h_i,zz Z),  z = (augmented state, control),  Z = < dz dz' >,  du = -C dx',

and where something is read at an instant y jumps by K (H (d - y) + r/2). To the same order this adds
k_x d(T) + int (L_x d - L_u C y) dt to the cost. Integrated along the nodes by the trapezoidal rule, which no gain makes
unstable.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import lru_cache
from typing import Annotated, Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.gains import kalman_gain
from covocp.base.matrices import Array, stacked, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.extremal.around import Around, bend, seen_by, side, spread_of
from covocp.extremal.closed_loop import ClosedLoop
from covocp.extremal.extremal import Extremal
from covocp.extremal.grown_noise import Grown, grown_noise
from covocp.extremal.readings import Readings, readings_along
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT

# Entries among the stats of a file, and their types.
NOTE = "mean_effect_"
MEAN_EFFECT: dict[str, Any] = {
    NOTE + "mean": Array,
    NOTE + "estimate": Array,
    NOTE + "cost": float,
    NOTE + "noise_cost": float,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class MeanEffect:
    """The mean that the curvature of rates and measurements gives the deviations, and what that adds to the cost.

    mean: of the deviation of the augmented state at the nodes, (K, n); estimate: of its estimate, (K, n).
    cost: what it adds to the expected cost, to second order; not part of what was optimised.
    noise_cost: the same of noise densities that vary with state and control, whose mean is not that of the nominal,
        summed along the nodes by the trapezoidal rule: its error falls with the square of the number of intervals.
    """

    mean: Annotated[Array, "nodes augmented"]
    estimate: Annotated[Array, "nodes augmented"]
    cost: float
    noise_cost: float

    __repr__ = short_repr


def remembered(stats: Mapping[str, Any]) -> MeanEffect | None:
    """The effect that `noted` wrote among the stats of a solution; None where there is none."""
    found = {f.name: stats.get(NOTE + f.name) for f in fields(MeanEffect)}
    return None if any(value is None for value in found.values()) else MeanEffect(**found)  # type: ignore[arg-type]


def noted(effect: MeanEffect | None) -> dict[str, Any]:
    """An effect as entries of the stats of a solution, for its file."""
    return {} if effect is None else {NOTE + f.name: getattr(effect, f.name) for f in fields(MeanEffect)}


def mean_effect(
    extremal: Extremal, loop: ClosedLoop, start: tuple[Array, Array] | None = None, grown: Grown | None = None
) -> MeanEffect | None:
    """The effect of the rates' and measurements' curvature along a solution, and what its deviations add to the noise.

    None where rates contain a matrix, where the loop leaves the range of numbers or a step cannot be solved. `start` is
    what d and y begin with where a phase went before; None: zero. `grown` is what the noise adds where it is known.
    """
    st = extremal.statement
    if st.nominal is None or st.loop is None:
        return None
    n, count = len(st.augmented), extremal.mesh.intervals
    sides = [_evaluated(extremal, loop, end) for end in (0, 1)]
    if not all(np.isfinite(values).all() for side in sides for values in side):
        return None
    state, h, cost = np.zeros(2 * n), np.diff(extremal.time), 0.0
    if start is not None:
        state = np.concatenate(start)
    states = np.zeros((count + 1, 2 * n))
    states[0] = state
    jumps = {
        entry.interval: (entry.gain @ entry.H, entry.gain @ bent) for entry, bent in _bent_readings(extremal, loop)
    }
    for k in range(count):
        if k in jumps:
            fed, forced = jumps[k]
            state[n:] += fed @ (state[:n] - state[n:]) + forced
        (A, a, c), (B, b, e) = ((drift[k], forcing[k], slope[k]) for drift, forcing, slope in sides)
        right = state + h[k] / 2 * (A @ state + a + b)
        try:
            after = np.linalg.solve(np.eye(2 * n) - h[k] / 2 * B, right)
        except np.linalg.LinAlgError:  # a step that is as long as one over a rate of growth
            return None
        cost += h[k] / 2 * float(c @ state + e @ after)
        states[k + 1] = state = after
    end = (extremal.trajectory.x[-1], extremal.trajectory.duration, extremal.parameters)
    at_end = st.loop.terminal.jacobian()(*end, *st.loop.terminal(*end))
    unknowns = [i for b in st.of_kind("unknown") for i in range(b.span.start, b.span.stop)]
    slope = np.hstack([np.asarray(at_end[0].full())[0, : n - len(unknowns)], np.asarray(at_end[2].full())[0, unknowns]])
    return MeanEffect(
        mean=states[:, :n],
        estimate=states[:, n:],
        cost=cost + float(slope @ states[-1, :n]),
        noise_cost=(grown_noise(extremal, loop) if grown is None else grown).cost,
    )


def _bent_readings(extremal: Extremal, loop: ClosedLoop) -> list[tuple[Readings, Array]]:
    """What is read at each instant, and r/2 of its curvature."""
    found = readings_along(extremal)
    if not found:
        return []
    function = _curved_readings(extremal.statement)
    columns = [np.asarray(column) for column in extremal.columns()]
    spread = spread_of(loop)
    return [
        (
            entry,
            np.asarray(function(*(c[:, entry.interval] for c in columns), spread[entry.interval]).full())[
                entry.rows, 0
            ],
        )
        for entry in found
    ]


def _evaluated(extremal: Extremal, loop: ClosedLoop, end: int) -> tuple[Array, Array, Array]:
    """Drift (N, 2n, 2n) of (d, y), its forcing (N, 2n), slope (N, 2n) of L by it, at one end of all intervals."""
    st, count = extremal.statement, extremal.mesh.intervals
    n = len(st.augmented)
    spread = spread_of(loop)
    own = spread[end : count + end].transpose(1, 0, 2).reshape(2 * n, -1)
    values = _curved(st).map(count)(*side(extremal, end), own)
    drift, forcing, slope = (stacked(v, count) for v in values)
    return drift, forcing[:, :, 0], slope[:, :, 0]


@lru_cache(maxsize=KEPT)
def _curved_readings(st: Statement) -> ca.Function:
    """(all six, < (d, y)(d, y)' > (2n, 2n)) -> r/2 of all values that can be read at instants."""
    symbolic: Any = st.symbolic
    assert st.loop is not None
    assert st.samples is not None
    n, m = len(st.augmented), int(st.loop.gain.size1_out(0))
    around, spread = Around.of(st, m), symbolic.sym("spread", 2 * n, 2 * n)
    seen = seen_by(st.loop.gain(*around.six), symbolic)
    bent = bend(st.samples.measurement(*around.at)[0], around.z, seen @ spread @ seen.T) / 2
    inner = ca.Function("bent", [around.z, *around.six, spread], [ca.densify(bent)])
    return ca.Function("bent", [*around.six, spread], [inner(around.value, *around.six, spread)])


@lru_cache(maxsize=KEPT)
def _curved(st: Statement) -> ca.Function:
    """(all six, < (d, y)(d, y)' > (2n, 2n)) -> drift of (d, y), forcing q/2 and K r/2, slope of L by (d, y)."""
    symbolic: Any = st.symbolic
    loop, n, unknowns = st.loop, len(st.augmented), st.unknowns
    assert loop is not None
    assert st.nominal is not None
    m = int(loop.gain.size1_out(0))
    spread = symbolic.sym("spread", 2 * n, 2 * n)
    six, z, at, value = Around.of(st, m)
    e = six[2]
    rate = ca.vertcat(st.nominal(*at)[0][: n - unknowns], symbolic.zeros(unknowns))
    measured, M, U = symbolic.zeros(0), symbolic.zeros(0, n), symbolic.zeros(0, 0)
    if st.measurement is not None:
        measured, M, U = st.measurement(*at)
    E = unpack_symbolic(e[st.estimation.span], n)
    K = kalman_gain(E, M, U)
    C = loop.gain(*six)
    seen = seen_by(C, symbolic)
    both = ca.vertcat(rate, measured)
    bent = bend(both, z, seen @ spread @ seen.T) / 2
    of_rate, of_measured = ca.vertsplit(ca.jacobian(both, z), [0, n, n + measured.shape[0]])
    F, G = _columns(of_rate, n, m)
    H, _ = _columns(of_measured, n, m)
    of_rates, of_readings = ca.vertsplit(bent, [0, n, n + measured.shape[0]])
    drift = ca.blockcat([[F, -G @ C], [K @ H, F - G @ C - K @ H]])
    forcing = ca.vertcat(of_rates, K @ of_readings)
    of_state, of_control = ca.vertsplit(ca.gradient(loop.running(*at), z), [0, n, n + m])
    cost = ca.vertcat(of_state, -(C.T @ of_control))
    values = [ca.densify(value) for value in (drift, forcing, cost)]
    inner = ca.Function("curved", [z, *six, spread], values)
    return ca.Function("curved", [*six, spread], inner.call([value, *six, spread]))


def _columns(slopes: Expr, states: int, controls: int) -> tuple[Any, Any]:
    """Slopes by the augmented state and by the controls that are fed back."""
    by_state, by_control = ca.horzsplit(slopes, [0, states, states + controls])
    return by_state, by_control
