"""Inequalities as penalties d int c^2 1[c > 0] dt, with weights raised and shifts learnt (gradient method).

Path conditions and bounds on states and matrices count at the nodes of the mesh, with the trapezoidal weights of the
nodes; initial and final conditions and those at instants count once. Each row lower <= c <= upper has its own weight d
and its shift m/(2 d),

    d { c + m/(2d) - clip(c + m/(2d)) }^2,

so that the multiplier m is found without d growing without bound (M. J. D. Powell, in R. Fletcher (ed.), Optimization,
1969; M. R. Hestenes, J. Optimization Theory and Applications 4, 1969). The first pass has m = 0: the plain penalty.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr, slopes_by
from covocp.base.matrices import Array, stacked
from covocp.base.short_repr import short_repr
from covocp.solvers.gradient.influence import Run
from covocp.statement.interval import repeated
from covocp.statement.statement import Statement
from covocp.transcription.limit_units import limit_units
from covocp.transcription.mesh import Mesh
from covocp.transcription.nlp import Scales
from covocp.transcription.steering import quadrature_weights
from covocp.transcription.trajectory import at_nodes

Indices = NDArray[np.intp]

# Kind of a group of conditions at one instant.
INSTANT = "instant"

# The first weight makes a violation by the typical magnitude of a row, everywhere, cost this many times the cost.
FIRST_WEIGHT = 10.0
# Weights are raised by this factor where a pass did not reduce the violation to this share of the last one.
RAISE = 4.0
EXPECTED_DECREASE = 0.25


@dataclass(frozen=True, kw_only=True)
class Group:
    """Rows of one kind: at which nodes they count, with which weights of the nodes.

    function: (z, u, s, T, p, weights, shifts) -> penalty, its slopes by z, u and T, multipliers, violations,
    second slopes by u (Gauss and Newton's part), distances from the bound that has a multiplier, sizes of the slopes by
    z and u in the given scales. units: of the rows, where their limits are small.
    """

    kind: str
    names: tuple[str, ...]
    nodes: Indices
    shares: Array
    units: Array
    function: ca.Function

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Penalty:
    """Penalty and slopes at a run: by z at the nodes (N + 1, size), by u at the nodes (N + 1, nu), by T."""

    value: float
    jumps: Array
    control: Array
    duration: float
    multipliers: tuple[Array, ...]
    excess: tuple[Array, ...]
    room: tuple[Array, ...]
    curvature: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights d and shifts m/(2 d) of each group, (nodes, rows), and the magnitudes of the rows, (rows,)."""

    weights: tuple[Array, ...]
    shifts: tuple[Array, ...]
    scales: tuple[Array, ...]

    __repr__ = short_repr


def limits(statement: Statement) -> tuple[Array, Array]:
    """Lower and upper bounds of z = (x, e)."""
    upper = np.concatenate([statement.state_bounds[1], np.full(statement.ne, np.inf)])
    return np.concatenate([statement.state_bounds[0], statement.matrix_lower]), upper


def limited(statement: Statement) -> Indices:
    """Entries of z with a bound along the path; a constant keeps its own from the start."""
    bounded = np.flatnonzero(np.isfinite(limits(statement)).any(axis=0))
    return np.setdiff1d(bounded, statement.decisions)


def penalty_groups(
    statement: Statement, mesh: Mesh, exact: tuple[int, ...], *, follows: bool = False
) -> tuple[Group, ...]:
    """The groups of a statement that have rows.

    Args:
        statement: the problem.
        mesh: its nodes.
        exact: rows of the final conditions that influence functions meet, not penalties.
        follows: whether a phase before it gives z(0), which is then bounded by penalties too.
    """
    first = 0 if follows else 1
    n = mesh.intervals
    shares = quadrature_weights(replace(mesh, control="linear")) * statement.duration.guess
    every, once = np.arange(n + 1), np.ones(1)
    (lower, upper), bounded = limits(statement), limited(statement)
    names = (*statement.state_names, *statement.matrix_names)
    left = [i for i in range(statement.end.size) if i not in exact]
    path, end, start = statement.path, statement.end, statement.start
    own = start.size - (0 if statement.tied is None else len(statement.tied.states))  # the others hold by themselves
    candidates = [
        _group(statement, "path", path.names, every, shares, path.function, path.lower, path.upper),
        _group(
            statement,
            "start",
            start.names[:own],
            every[:1],
            once,
            lambda *arguments: start.function(*arguments)[:own],
            start.lower[:own],
            start.upper[:own],
        ),
        _group(
            statement,
            "end",
            tuple(end.names[i] for i in left),
            every[-1:],
            once,
            lambda *arguments: end.function(*arguments)[left],
            end.lower[left],
            end.upper[left],
        ),
        _group(
            statement,
            "bounds",
            tuple(f"bounds of {names[i]}" for i in bounded),
            every[first:],
            shares[first:],
            lambda *arguments: _entries(arguments[0], arguments[2], bounded.tolist()),
            lower[bounded],
            upper[bounded],
        ),
        *_at_instants(statement, mesh),
    ]
    return tuple(group for group in candidates if group is not None)


def _at_instants(statement: Statement, mesh: Mesh) -> list[Group | None]:
    """A group for the conditions at each instant."""
    inside = statement.inside
    result = []
    for part, k in zip(inside.parts, inside.nodes_among(mesh.nodes), strict=True):
        own = part.conditions
        rows = (own.function, own.lower, own.upper)
        result.append(_group(statement, INSTANT, own.names, np.array([k]), np.ones(1), *rows))
    return result


def _entries(x: Expr, e: Expr, chosen: list[int]) -> Any:
    stacked: Expr = ca.vertcat(x, e)
    return stacked[chosen]


def _group(
    statement: Statement,
    kind: str,
    names: tuple[str, ...],
    nodes: Indices,
    shares: Array,
    rows: Callable[..., Any],
    lower: Array,
    upper: Array,
) -> Group | None:
    if not names:
        return None
    symbolic: Any = statement.symbolic
    nx, nu, size, count = statement.nx, statement.nu, statement.nx + statement.ne, len(names)
    z, u, s, duration = symbolic.sym("z", size), symbolic.sym("u", nu), symbolic.sym("s"), symbolic.sym("T")
    p, weights, shifts = symbolic.sym("p", statement.np), symbolic.sym("d", count), symbolic.sym("shift", count)
    value = rows(z[:nx], u, z[nx:], s * duration, duration, p)

    def excess(rows: Expr) -> Any:
        over = [rows[i] - upper[i] if np.isfinite(upper[i]) else -1.0 for i in range(count)]
        under = [lower[i] - rows[i] if np.isfinite(lower[i]) else -1.0 for i in range(count)]
        return ca.vertcat(*(ca.fmax(o, 0) - ca.fmax(b, 0) for o, b in zip(over, under, strict=True)))

    def room(rows: Expr, multipliers: Expr) -> Any:
        left = []
        for i in range(count):
            above = ca.fmax(upper[i] - rows[i], 0) if np.isfinite(upper[i]) else 0.0
            below = ca.fmax(rows[i] - lower[i], 0) if np.isfinite(lower[i]) else 0.0
            left.append(ca.if_else(multipliers[i] > 0, above, ca.if_else(multipliers[i] < 0, below, 0.0)))
        return ca.vertcat(*left)

    shifted = excess(value + shifts)
    penalty = ca.dot(weights, shifted**2)
    by_control = ca.jacobian(value, u)
    active = 2 * weights * (shifted != 0)
    outputs = [
        penalty,
        *slopes_by(penalty, (z, u, duration)),
        2 * weights * shifted,
        ca.if_else(ca.fabs(value) < np.inf, excess(value), np.nan),  # the larger of NaN and 0 is 0, and would hold
        by_control.T @ (ca.repmat(active, 1, nu) * by_control),
        room(value, shifted),
        ca.fabs(ca.jacobian(value, z)),
        ca.fabs(by_control),
    ]
    function = ca.Function("penalty", [z, u, s, duration, p, weights, shifts], [ca.densify(v) for v in outputs])
    units = limit_units(lower, upper)
    return Group(kind=kind, names=names, nodes=nodes, shares=shares, units=units, function=function.map(nodes.size))


def first_weights(
    groups: tuple[Group, ...], mesh: Mesh, run: Run, parameters: Array, scales: Scales, size: float
) -> Weights:
    """Weights for the first pass: a violation by the magnitude of a row costs some times `size`; no shifts."""
    weights, magnitudes = [], []
    for group in groups:
        magnitude = _magnitudes(group, mesh, run, parameters, scales)
        magnitudes.append(_at_limits(group, magnitude))
        weights.append(FIRST_WEIGHT * size * group.shares[:, None] / group.shares.sum() / magnitude**2)
    return Weights(weights=tuple(weights), shifts=tuple(np.zeros_like(w) for w in weights), scales=tuple(magnitudes))


def judged_along(
    groups: tuple[Group, ...], mesh: Mesh, run: Run, parameters: Array, scales: Scales, weights: Weights
) -> Weights:
    """The same weights with the magnitudes of the rows along another run, where those are smaller.

    A start far away has magnitudes in which any violation is small.
    """
    found = [_at_limits(group, _magnitudes(group, mesh, run, parameters, scales)) for group in groups]
    return replace(weights, scales=tuple(map(np.minimum, weights.scales, found)))


def _magnitudes(group: Group, mesh: Mesh, run: Run, parameters: Array, scales: Scales) -> Array:
    """What changes of states, matrices and controls by their magnitudes make of the rows of a group, at most."""
    count, rows = group.nodes.size, len(group.names)
    zero, z_scale = np.zeros((count, rows)), np.concatenate([scales.x, scales.e])
    outputs = _evaluate(group, mesh, run, parameters, zero, zero)
    by_z, by_u = (v.reshape(rows, count, -1) for v in outputs[-2:])
    magnitude = (by_z @ z_scale + by_u @ scales.u).max(axis=1, initial=0.0)
    return np.where(magnitude > 0, magnitude, 1.0)


def _at_limits(group: Group, magnitude: Array) -> Array:
    """Magnitudes of the rows of a group, no more than limits that are small."""
    return np.where(group.units < 1.0, np.minimum(magnitude, group.units), magnitude)


def _evaluate(group: Group, mesh: Mesh, run: Run, parameters: Array, weights: Array, shifts: Array) -> list[Array]:
    count = group.nodes.size
    controls = at_nodes(mesh.acting(run.u.T).T, mesh.nodes.size)[group.nodes]
    outputs = group.function(
        run.z[group.nodes].T,
        controls.T,
        mesh.nodes[group.nodes][None, :],
        *repeated(run.duration, parameters, count),
        weights.T,
        shifts.T,
    )
    return [np.asarray(v.full()) for v in outputs]


def evaluate_penalty(groups: tuple[Group, ...], mesh: Mesh, run: Run, parameters: Array, weights: Weights) -> Penalty:
    """Penalty of a run, its slopes, multipliers and violations."""
    nodes, nu = mesh.intervals + 1, run.u.shape[1]
    value, by_duration = 0.0, 0.0
    jumps, control, curvature = np.zeros_like(run.z), np.zeros((nodes, nu)), np.zeros((nodes, nu, nu))
    multipliers, excess, room = [], [], []
    for group, d, shift in zip(groups, weights.weights, weights.shifts, strict=True):
        outputs = _evaluate(group, mesh, run, parameters, d, shift)
        value += float(outputs[0].sum())
        jumps[group.nodes] += outputs[1].T
        control[group.nodes] += outputs[2].T
        by_duration += float(outputs[3].sum())
        multipliers.append(outputs[4].T)
        excess.append(outputs[5].T)
        room.append(outputs[7].T)
        curvature[group.nodes] += stacked(outputs[6], group.nodes.size)
    return Penalty(
        value=value,
        jumps=jumps,
        control=control,
        duration=by_duration,
        multipliers=tuple(multipliers),
        excess=tuple(excess),
        room=tuple(room),
        curvature=curvature,
    )


def violation(penalty: Penalty, weights: Weights) -> Array:
    """Largest violation of each group, of the bound or of complementarity, in units of the magnitudes of the rows.

    The multiplier m' = 2 d (what c + m/(2d) exceeds) is right where m'/(2d) - m/(2d) = 0: c is on its bound, or it is
    inside and m = 0.
    """
    return np.array(
        [
            float((np.abs(np.where(d > 0, m / (2 * np.where(d > 0, d, 1.0)) - shift, excess)) / scale).max(initial=0.0))
            for m, d, shift, excess, scale in zip(
                penalty.multipliers, weights.weights, weights.shifts, penalty.excess, weights.scales, strict=True
            )
        ]
    )


def next_weights(penalty: Penalty, weights: Weights, before: Array, now: Array) -> Weights:
    """Shifts from the multipliers of a pass, weights raised where the violation did not fall enough."""
    raised = [
        d * (RAISE if after > EXPECTED_DECREASE * earlier else 1.0)
        for d, earlier, after in zip(weights.weights, before, now, strict=True)
    ]
    shifts = [m / (2 * d) if d.any() else np.zeros_like(m) for m, d in zip(penalty.multipliers, raised, strict=True)]
    return Weights(weights=tuple(raised), shifts=tuple(shifts), scales=weights.scales)
