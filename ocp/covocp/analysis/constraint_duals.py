"""Multipliers of the convex constraints of an identification as functions of time, for its quadratic lower bound.

Any multipliers of the right sign bound the cost; these come from the solution. A constraint on the states alone acts at
the nodes, one with the control as a density between them: a control of finite energy has no value at a point. What is
asked of the control at the initial or the terminal time alone binds no such control, and gets none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.analysis.conditions import condition
from covocp.analysis.stages import Stages
from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal
from covocp.statement.statement import Conditions

# Integrals of the products of the two linear polynomials that are 1 at one end of [0, 1] and 0 at the other.
LINEAR_PRODUCTS = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6.0


@dataclass(frozen=True, kw_only=True)
class Duals:
    """Slopes of the sum of multipliers times constraints by all nodes (n + 1, s) and controls (n, 2 nu), and its slack.

    slack: what the multipliers would gain were the inequalities all met with equality [cost].
    """

    by_xi: Array
    by_w: Array
    slack: float

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class _Points:
    """Both ends of each stage: z = (x, u) (n, 2, nz), times (n, 2) [s], lengths of the stages (n,) [s]."""

    z: Array
    times: Array
    lengths: Array

    __repr__ = short_repr

    @staticmethod
    def of(extremal: Extremal, stages: Stages, zeta: Array) -> _Points:
        nx, nodes = extremal.statement.nx, stages.reduction.mesh.nodes * extremal.statement.duration.guess
        w = zeta[:-1, stages.size : -1].reshape(zeta.shape[0] - 1, 2, -1)
        x = np.stack([zeta[:-1, :nx], zeta[1:, :nx]], axis=1)
        return _Points(
            z=np.concatenate([x, w], axis=2),
            times=np.stack([nodes[:-1], nodes[1:]], axis=1),
            lengths=np.diff(nodes),
        )


def duals(extremal: Extremal, stages: Stages, zeta: Array, gradient: Callable[[Array, Array], Array]) -> Duals:
    """The multipliers of a solution along a trajectory on the stages.

    Args:
        extremal: the solution.
        stages: on a mesh that contains its nodes.
        zeta: trajectory near the solution's.
        gradient: slopes of the lower bound by the controls, given those of the multipliers by nodes and controls.
    """
    st, m = extremal.statement, extremal.multipliers
    result = Duals(
        by_xi=np.zeros((zeta.shape[0], stages.size)), by_w=np.zeros(zeta[:-1, stages.size : -1].shape), slack=0.0
    )
    points = _Points.of(extremal, stages, zeta)
    at = np.searchsorted(stages.reduction.mesh.nodes, extremal.mesh.nodes - 1e-12).astype(np.intp)
    fixed = ~np.isnan(st.boundary_values(extremal.parameters)[1])
    states = m.states.copy()
    states[-1] += np.where(fixed, 0.0, m.final)
    weights, slack = acting(states, zeta[at, : st.nx], *st.state_bounds)
    result.by_xi[at, : st.nx] += weights
    slack += _path(extremal, points, at, result)
    slack += _end(extremal, points, result)
    equalities = np.where(fixed, m.final, 0.0)  # they tell how the controls at their bounds are held, nothing more
    ends = result.by_xi.copy()
    ends[-1, : st.nx] += equalities + _end_equalities(extremal, points)
    by_w, more = _control_bounds(extremal, points, gradient(ends, result.by_w))
    return Duals(by_xi=result.by_xi, by_w=result.by_w + by_w, slack=slack + more)


def acting(multipliers: Array, values: Array, lower: Array, upper: Array) -> tuple[Array, float]:
    """Multipliers of bounds that exist, and the sum of multiplier times distance from the bound [cost]."""
    above = np.where(np.isfinite(upper), np.maximum(multipliers, 0.0), 0.0)
    below = np.where(np.isfinite(lower), np.maximum(-multipliers, 0.0), 0.0)
    high, low = np.where(np.isfinite(upper), upper, 0.0), np.where(np.isfinite(lower), lower, 0.0)
    return above - below, float(np.sum(above * (high - values) + below * (values - low)))


def _path(extremal: Extremal, points: _Points, at: NDArray[np.intp], result: Duals) -> float:
    """Path conditions: adds to the slopes, returns the slack."""
    st, mesh = extremal.statement, extremal.mesh
    if not st.path.size:
        return 0.0
    nx, nu, shape = st.nx, st.nu, points.times.shape
    values, maps = evaluated(extremal, st.path, points.z.reshape(-1, nx + nu), points.times.ravel())
    values, maps = values.reshape(*shape, -1), maps.reshape(*shape, st.path.size, nx + nu)
    controlled = np.abs(maps[..., nx:]).max(axis=(0, 1, 3)) > 0
    h = np.diff(extremal.time)
    if mesh.control == "constant":
        density = extremal.multipliers.path[:-1] / h[:, None]
        density[-1] += extremal.multipliers.path[-1] / h[-1]
        owner = np.searchsorted(at, np.arange(shape[0]), side="right") - 1
        both = np.repeat(density[owner][:, None, :], 2, axis=1)
    else:
        nodal = extremal.multipliers.path / (0.5 * (np.append(h, 0.0) + np.append(0.0, h)))[:, None]
        both = np.stack([np.interp(points.times, extremal.time, column) for column in nodal.T], axis=2)
    weights = points.lengths[:, None, None] * np.einsum("ab,kbr->kar", LINEAR_PRODUCTS, np.where(controlled, both, 0.0))
    last = shape[0] - 1
    for node, k in enumerate(at):  # conditions on the states alone act at the nodes of the solution
        weights[min(k, last), int(k > last)] += np.where(controlled, 0.0, extremal.multipliers.path[node])
    weights, slack = acting(weights, values, st.path.lower, st.path.upper)
    slopes = np.einsum("kar,kari->kai", weights, maps)
    result.by_xi[:-1, :nx] += slopes[:, 0, :nx]
    result.by_xi[1:, :nx] += slopes[:, 1, :nx]
    result.by_w[...] += slopes[:, :, nx:].reshape(result.by_w.shape)
    return slack


def _end(extremal: Extremal, points: _Points, result: Duals) -> float:
    """Terminal inequalities on the state: adds to the slopes, returns the slack."""
    st = extremal.statement
    if not st.end.size:
        return 0.0
    values, maps = evaluated(extremal, st.end, points.z[-1:, 1], points.times[-1:, 1])
    kept = (np.abs(maps[0, :, st.nx :]).max(axis=1, initial=0.0) == 0) & (st.end.lower != st.end.upper)
    weights, slack = acting(np.where(kept, extremal.multipliers.end, 0.0), values[0], st.end.lower, st.end.upper)
    result.by_xi[-1, : st.nx] += weights @ maps[0, :, : st.nx]
    return slack


def _end_equalities(extremal: Extremal, points: _Points) -> Array:
    """Slope by x(T) of the terminal equalities times their multipliers."""
    st = extremal.statement
    if not st.end.size:
        return np.zeros(st.nx)
    _, maps = evaluated(extremal, st.end, points.z[-1:, 1], points.times[-1:, 1])
    return np.asarray(np.where(st.end.lower == st.end.upper, extremal.multipliers.end, 0.0) @ maps[0, :, : st.nx])


def _control_bounds(extremal: Extremal, points: _Points, slopes: Array) -> tuple[Array, float]:
    """Multipliers of the control bounds: where the slope pushes against a bound that is near enough to pay for it.

    A multiplier nu of a bound at the distance d loses nu d; the slope it takes away, left alone, about nu^2 / (2 H_uu).
    """
    st = extremal.statement
    lower, upper = st.control_bounds
    if not np.isfinite([lower, upper]).any():
        return np.zeros_like(slopes), 0.0
    count, nu = slopes.shape[0], st.nu
    mass = points.lengths[:, None, None] * LINEAR_PRODUCTS
    density = np.linalg.solve(mass, slopes.reshape(count, 2, nu))
    u = points.z[:, :, st.nx :]
    energy = _energy_density(extremal, points)
    result = np.zeros_like(density)
    for bound, sign in ((upper, 1.0), (lower, -1.0)):
        distance = np.where(np.isfinite(bound), sign * (np.where(np.isfinite(bound), bound, 0.0) - u), np.inf)
        pushed = np.maximum(-sign * density, 0.0)
        result += np.where(2 * energy * distance < pushed, sign * pushed, 0.0)
    weights = np.einsum("kab,kbi->kai", mass, result)
    _, slack = acting(weights, u, lower, upper)
    return weights.reshape(slopes.shape), slack


def _energy_density(extremal: Extremal, points: _Points) -> Array:
    """The diagonal of L_uu at the points, (n, 2, nu)."""
    st = extremal.statement
    z, time = ca.MX.sym("z", st.nx + st.nu), ca.MX.sym("t")
    duration = st.duration.guess
    cost = st.rates(z[: st.nx], z[st.nx :], ca.DM.zeros(st.ne), time, duration, extremal.parameters)[2]
    diagonal = ca.Function("energy", [z, time], [ca.densify(ca.diag(ca.hessian(cost, z)[0][st.nx :, st.nx :]))])
    flat = points.z.reshape(-1, st.nx + st.nu)
    values = np.asarray(diagonal.map(flat.shape[0])(flat.T, points.times.reshape(1, -1)).full())
    return np.asarray(values.T.reshape(*points.times.shape, st.nu))


def evaluated(extremal: Extremal, conditions: Conditions, z: Array, times: Array) -> tuple[Array, Array]:
    """Affine conditions (k, rows) and their slopes by z (k, rows, nz) at some z (k, nz) and times (k,) [s]."""
    symbol, time, expression = condition(extremal.statement, conditions, extremal.parameters)
    outputs: list[Any] = [ca.densify(expression), ca.densify(ca.jacobian(expression, symbol))]
    function = ca.Function("rows", [symbol, time], outputs)
    values, maps = (np.asarray(v.full()) for v in function.map(z.shape[0])(z.T, times[None, :]))
    return values.T, maps.reshape(conditions.size, z.shape[0], -1).transpose(1, 0, 2)


def terminal_rows(extremal: Extremal, x: Array) -> tuple[Array, Array]:
    """Slopes by x(T) of the terminal conditions that are equalities (rows, nx), and what x misses them by (rows,)."""
    st = extremal.statement
    target = st.boundary_values(extremal.parameters)[1]
    fixed = ~np.isnan(target)
    rows, missed = [np.eye(st.nx)[fixed]], [(x - target)[fixed]]
    if st.end.size:
        z = np.concatenate([x, extremal.controls[-1]])[None, :]
        values, maps = evaluated(extremal, st.end, z, np.array([st.duration.guess]))
        equal = (st.end.lower == st.end.upper) & (np.abs(maps[0, :, st.nx :]).max(axis=1, initial=0.0) == 0)
        rows.append(maps[0, equal, : st.nx])
        missed.append((values[0] - st.end.lower)[equal])
    return np.vstack(rows), np.concatenate(missed)
