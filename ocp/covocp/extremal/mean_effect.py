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
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Annotated, Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.base.gains import kalman_gain
from covocp.base.matrices import Array, stacked, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.extremal.closed_loop import ClosedLoop
from covocp.extremal.extremal import Extremal
from covocp.extremal.readings import Readings, readings_along
from covocp.statement.interval import model_symbols
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT

# Entries among the stats of a file, and their types.
NOTE = "mean_effect_"
MEAN_EFFECT: dict[str, Any] = {NOTE + "mean": Array, NOTE + "estimate": Array, NOTE + "cost": float}


@dataclass(frozen=True, kw_only=True, eq=False)
class MeanEffect:
    """The mean that the curvature of rates and measurements gives the deviations, and what that adds to the cost.

    mean: of the deviation of the augmented state at the nodes, (K, n); estimate: of its estimate, (K, n).
    cost: what it adds to the expected cost, to second order; not part of what was optimised.
    """

    mean: Annotated[Array, "nodes augmented"]
    estimate: Annotated[Array, "nodes augmented"]
    cost: float

    __repr__ = short_repr


def remembered(stats: Mapping[str, Any]) -> MeanEffect | None:
    """The effect that `noted` wrote among the stats of a solution; None where there is none."""
    found = {f.name: stats.get(NOTE + f.name) for f in fields(MeanEffect)}
    return None if any(value is None for value in found.values()) else MeanEffect(**found)  # type: ignore[arg-type]


def noted(effect: MeanEffect | None) -> dict[str, Any]:
    """An effect as entries of the stats of a solution, for its file."""
    return {} if effect is None else {NOTE + f.name: getattr(effect, f.name) for f in fields(MeanEffect)}


def mean_effect(extremal: Extremal, loop: ClosedLoop, start: tuple[Array, Array] | None = None) -> MeanEffect | None:
    """The effect of the rates' and measurements' curvature along a solution.

    None where rates contain a matrix, where the loop leaves the range of numbers or a step cannot be solved. `start` is
    what d and y begin with where a phase went before; None: zero.
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
    return MeanEffect(mean=states[:, :n], estimate=states[:, n:], cost=cost + float(slope @ states[-1, :n]))


def _bent_readings(extremal: Extremal, loop: ClosedLoop) -> list[tuple[Readings, Array]]:
    """What is read at each instant, and r/2 of its curvature."""
    found = readings_along(extremal)
    if not found:
        return []
    function = _curved_readings(extremal.statement)
    columns = [np.asarray(column) for column in extremal.columns()]
    spread = _spread(loop)
    return [
        (
            entry,
            np.asarray(function(*(c[:, entry.interval] for c in columns), spread[entry.interval]).full())[
                entry.rows, 0
            ],
        )
        for entry in found
    ]


def _spread(loop: ClosedLoop) -> Array:
    """< (d, y)(d, y)' > at the nodes, (K, 2n, 2n)."""
    with_estimate = loop.Xhat - loop.Z  # <d y'> of the deviation d = y - e
    return np.concatenate(
        [np.dstack([loop.X, with_estimate]), np.dstack([with_estimate.transpose(0, 2, 1), loop.Xhat])], 1
    )


def _evaluated(extremal: Extremal, loop: ClosedLoop, end: int) -> tuple[Array, Array, Array]:
    """Drift (N, 2n, 2n) of (d, y), its forcing (N, 2n), slope (N, 2n) of L by it, at one end of all intervals."""
    st, count = extremal.statement, extremal.mesh.intervals
    n = len(st.augmented)
    part = slice(end, count + end)
    x, u, e, t, duration, p = extremal.columns()
    held = extremal.mesh.control == "constant"
    columns = [np.asarray(value)[:, part] for value in (x, u, e, t, duration, p)]
    if held:
        columns[1] = np.asarray(u)[:, :count]
    spread = _spread(loop)
    values = _curved(st).map(count)(*columns, spread[part].transpose(1, 0, 2).reshape(2 * n, -1))
    drift, forcing, slope = (stacked(v, count) for v in values)
    return drift, forcing[:, :, 0], slope[:, :, 0]


class _Around(NamedTuple):
    """Symbols z of the augmented state and the controls that are fed back, and the arguments of the model in them."""

    six: list[Any]
    z: Any
    at: tuple[Any, ...]
    value: Any

    @classmethod
    def of(cls, st: Statement, m: int) -> _Around:
        """Of m controls that are fed back; `value` is z on the trajectory."""
        n, unknowns = len(st.augmented), st.unknowns
        symbolic: Any = st.symbolic
        x, u, _, t, duration, p = six = model_symbols(st)
        z = symbolic.sym("z", n + m)
        states, own, fed = ca.vertsplit(z, [0, n - unknowns, n, n + m])
        state = ca.vertcat(states, ca.vertsplit(x, [0, n - unknowns, st.nx])[1])
        control = ca.vertcat(fed, ca.vertsplit(u, [0, m, st.nu])[1])
        known, means = ca.vertsplit(p, [0, st.np - unknowns, st.np])
        value = ca.vertcat(ca.vertsplit(x, [0, n - unknowns, st.nx])[0], means, ca.vertsplit(u, [0, m, st.nu])[0])
        return cls(six, z, (state, control, t, duration, ca.vertcat(known, own)), value)


@lru_cache(maxsize=KEPT)
def _curved_readings(st: Statement) -> ca.Function:
    """(all six, < (d, y)(d, y)' > (2n, 2n)) -> r/2 of all values that can be read at instants."""
    symbolic: Any = st.symbolic
    assert st.loop is not None
    assert st.samples is not None
    n, m = len(st.augmented), int(st.loop.gain.size1_out(0))
    around, spread = _Around.of(st, m), symbolic.sym("spread", 2 * n, 2 * n)
    seen = _seen(st.loop.gain(*around.six), symbolic)
    bent = _bend(st.samples.measurement(*around.at)[0], around.z, seen @ spread @ seen.T) / 2
    inner = ca.Function("bent", [around.z, *around.six, spread], [ca.densify(bent)])
    return ca.Function("bent", [*around.six, spread], [inner(around.value, *around.six, spread)])


def _seen(gain: Expr, symbolic: Any) -> Any:
    """z of (d, y): the augmented state, and the controls that the estimate moves."""
    m, n = gain.shape
    return ca.blockcat([[symbolic.eye(n), symbolic.zeros(n, n)], [symbolic.zeros(m, n), -gain]])


@lru_cache(maxsize=KEPT)
def _curved(st: Statement) -> ca.Function:
    """(all six, < (d, y)(d, y)' > (2n, 2n)) -> drift of (d, y), forcing q/2 and K r/2, slope of L by (d, y)."""
    symbolic: Any = st.symbolic
    loop, n, unknowns = st.loop, len(st.augmented), st.unknowns
    assert loop is not None
    assert st.nominal is not None
    m = int(loop.gain.size1_out(0))
    spread = symbolic.sym("spread", 2 * n, 2 * n)
    six, z, at, value = _Around.of(st, m)
    e = six[2]
    rate = ca.vertcat(st.nominal(*at)[0][: n - unknowns], symbolic.zeros(unknowns))
    measured, M, U = symbolic.zeros(0), symbolic.zeros(0, n), symbolic.zeros(0, 0)
    if st.measurement is not None:
        measured, M, U = st.measurement(*at)
    E = unpack_symbolic(e[st.estimation.span], n)
    K = kalman_gain(E, M, U)
    C = loop.gain(*six)
    seen = _seen(C, symbolic)
    both = ca.vertcat(rate, measured)
    bent = _bend(both, z, seen @ spread @ seen.T) / 2
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


def _bend(values: Expr, z: Expr, covariance: Expr) -> Any:
    """tr(v_zz Z) of each of some values v, Z being their arguments' covariance."""
    size = z.shape[0]
    unit = ca.DM.eye(size)
    return sum(
        (ca.jtimes(ca.jtimes(values, z, covariance[:, j]), z, type(z)(unit[:, j])) for j in range(size)),
        type(z).zeros(values.shape[0]),
    )
