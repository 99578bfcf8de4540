"""Unknowns of the gradient method: control values, free terminal time, free initial values; what holds at a point.

A point stacks the control values (node by node), T where it is free, and the free entries of z(0) = (x(0), E(0)).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy import sparse

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Guess
from covocp.solvers.gradient.descent import Step, control_metric, positive_definite, solve_step, with_extra
from covocp.solvers.gradient.influence import (
    Later,
    Run,
    Slopes,
    Sweeps,
    control_curvature,
    control_sizes,
    reweigh,
    sweep_backward,
    sweep_forward,
)
from covocp.solvers.gradient.memory import learnt
from covocp.solvers.gradient.penalty import (
    INSTANT,
    Group,
    Indices,
    Penalty,
    Weights,
    evaluate_penalty,
    first_weights,
    judged_along,
    limited,
    limits,
)
from covocp.solvers.gradient.records import Iterate, Linear, Measures
from covocp.solvers.gradient.unknowns import ZERO, Unknowns
from covocp.transcription.nlp import Scales
from covocp.transcription.scales import choose_scales
from covocp.transcription.steering import quadrature_weights
from covocp.transcription.trajectory import Multipliers, Trajectory

# Eigenvalues of H_uu, in units of the control scales, are not taken below this share of the largest.
SMALLEST_CURVATURE = 1e-3
# T changes by no more than these shares of itself in one step.
SHORTEN, LENGTHEN = 0.3, 0.5
CHORD_STEPS = 60
CHORD_TOLERANCE = 1e-13


@dataclass(frozen=True, kw_only=True)
class Space(Unknowns):
    """The unknowns, their scales and bounds, and the compiled sweeps.

    Args:
        sweeps: forward and backward.
        groups: inequalities met by penalties.
        weights: of the penalties.
        parameters: of the statement.
        start: z(0), free entries included.
        free: the free entries of z(0).
        scales: typical magnitudes of x, u, e, T.
        unit: typical magnitudes of the entries of a point.
        lower, upper: bounds of the entries of a point.
        fixed_metric: diagonal of the metric of the stop test, int |du/s|^2 dt.
        miss_scale: magnitudes of the terminal conditions.
        extra: weights of T and of the free initial values in the metric of the step, b.
    """

    sweeps: Sweeps
    groups: tuple[Group, ...]
    weights: Weights
    parameters: Array
    start: Array
    free: Indices
    scales: Scales
    unit: Array
    lower: Array
    upper: Array
    fixed_metric: Array
    miss_scale: Array
    extra: Array

    __repr__ = short_repr

    @property
    def names(self) -> tuple[str, ...]:
        """Of the terminal conditions with influence functions."""
        return self.sweeps.terminal.names

    @property
    def others(self) -> Indices:
        """Entries of a point that are no control values: durations and free initial values."""
        return np.arange(self.controls, self.unit.size)

    @property
    def durations(self) -> Indices:
        """Entries of a point that are durations."""
        return self.others[: int(self.sweeps.statement.duration.free)]

    @property
    def controls(self) -> int:
        """Number of control values, the first entries of a point."""
        return self.sweeps.mesh.control_nodes * self.sweeps.statement.nu

    def at(self, point: Array) -> Iterate:
        """Forward sweep and penalties at a point."""
        u, duration, start = self.split(point)
        run = sweep_forward(self.sweeps, u, duration, start, self.parameters)
        return Iterate(point=point, run=run, penalty=self._penalty(run))

    def _penalty(self, run: Run) -> Penalty:
        return evaluate_penalty(self.groups, self.sweeps.mesh, run, self.parameters, self.weights)

    def split(self, point: Array) -> tuple[Array, float, Array]:
        """Controls (K, nu), T, z(0) of a point."""
        st = self.sweeps.statement
        u = point[: self.controls].reshape(self.sweeps.mesh.control_nodes, st.nu)
        rest = point[self.controls :]
        duration = float(rest[0]) if st.duration.free else st.duration.guess
        start = self.start.copy()
        start[self.free] = rest[int(st.duration.free) :]
        return u, duration, np.concatenate(st.started(start[: st.nx], self.parameters, start[st.nx :]))

    def first(self, guess: Guess) -> Iterate:
        """The iterate of a guess: its controls, terminal time and free initial values."""
        return self.at(point_of(self, guess.trajectory))

    def with_weights(self, weights: Weights) -> Space:
        """The same with other penalties."""
        return replace(self, weights=weights)

    def judged_at(self, iterate: Iterate) -> Space:
        """The same with the magnitudes of the inequalities there, where those are smaller."""
        run, sweeps = iterate.run, self.sweeps
        if not self.groups or not run.finite:
            return self
        scales = self._scales_along(run)
        known = (self.groups, sweeps.mesh, run, self.parameters, scales)
        return self.with_weights(judged_along(*known, self.weights))

    def _scales_along(self, run: Run) -> Scales:
        """The magnitudes along a run that was reached."""
        nx = self.sweeps.statement.nx
        trajectory = Trajectory(x=run.z[:, :nx], u=run.u, e=run.z[:, nx:], duration=run.duration)
        return choose_scales(self.sweeps.statement, self.sweeps.mesh, trajectory, self.parameters, reached=True)

    def linearise(self, iterate: Iterate, later: Later | None = None, first: Array | None = None) -> Linear:
        """Backward sweep at an iterate.

        Args:
            iterate: where.
            later: what phases that follow say of its end.
            first: what Y begins with where a phase goes before.
        """
        slopes = sweep_backward(self.sweeps, iterate.run, self.parameters, iterate.penalty.jumps, later, first)
        return self._linear(iterate.penalty, slopes, iterate.run.z[0, : self.sweeps.statement.nx])

    def _linear(self, penalty: Penalty, slopes: Slopes, start_state: Array) -> Linear:
        count, free = self.controls, self.sweeps.statement.duration.free
        by_time = slopes.duration.copy()
        by_time[0] += penalty.duration
        control = slopes.control.copy()
        control[0] += self._fold(penalty.control)
        start = slopes.start @ self.tied_slopes(start_state, self.free)
        stacked = np.hstack([control.reshape(control.shape[0], count), by_time[:, None][:, : int(free)], start])
        cost = np.abs(slopes.cost).ravel()
        sizes = np.abs(stacked[0])
        sizes[:count] = cost + np.abs(control[0].ravel() - slopes.cost.ravel())
        return Linear(slope=stacked[0], rows=stacked[1:], sizes=sizes, slopes=slopes)

    def tied_slopes(self, state: Array, entries: Indices) -> Array:
        """Slopes of z(0) by some of its entries: those that decisions give follow them."""
        st, size = self.sweeps.statement, self.start.size
        result = np.eye(size)[:, entries]
        if st.tied is None:
            return result
        rows = [*st.tied.states, *(st.nx + k for k in st.tied.matrices)]
        by_state = np.zeros((len(rows), size))
        by_state[:, : st.nx] = np.asarray(st.tied.slopes(state, self.parameters).full())
        result[rows] = by_state[:, entries]
        return result

    def _fold(self, nodal: Array) -> Array:
        """Values at the N + 1 nodes as values of the controls: with constant controls the last node has the last."""
        mesh = self.sweeps.mesh
        if mesh.control == "linear":
            return mesh.gathered(nodal)
        folded = nodal[:-1].copy()
        folded[-1] += nodal[-1]
        return mesh.gathered(folded)

    def cost_size(self, iterate: Iterate) -> float:
        """Sum of the absolute terms of the cost."""
        return abs(iterate.run.running) + abs(iterate.run.terminal)

    def size_of(self, iterate: Iterate, linear: Linear) -> float:
        """Size of the cost, of its slopes where it is next to nothing."""
        return max(self.cost_size(iterate), SMALLEST_CURVATURE * self.slope_size(linear))

    def slope_size(self, linear: Linear) -> float:
        """Sum of the absolute changes of the cost by the control values, each in its unit."""
        count = self.controls
        return float(np.abs(linear.slope[:count] * self.unit[:count]).sum())

    def sizes_along(self, iterate: Iterate, linear: Linear, ell: Array) -> Array:
        """Sizes of the slopes by the control values from those of H_u at the nodes."""
        nodal = control_sizes(self.sweeps, iterate.run, linear.slopes.columns, ell, self.parameters)
        weights = quadrature_weights(self.sweeps.mesh)[:, None] * iterate.run.duration
        return np.asarray((weights * nodal[: weights.size]).ravel())

    def reach(self, iterate: Iterate, linear: Linear) -> Array:
        """What changes of z at the end by its largest values along the run make of each terminal condition."""
        columns = linear.slopes.columns[-1][:, 1 : 1 + self.conditions]
        return np.asarray(np.abs(columns).T @ np.abs(iterate.run.z).max(axis=0))

    def reached_units(self, iterate: Iterate, linear: Linear, measures: Measures) -> tuple[Array, float]:
        """Magnitudes of the entries of a point there, and the change of the cost by those of the controls."""
        run, st = iterate.run, self.sweeps.statement
        at_controls = np.maximum(self._scales_along(run).u, ZERO * self.unit[: st.nu])
        unit = np.concatenate([np.tile(at_controls, run.u.shape[0]), self.unit[self.controls :]])
        columns = linear.slopes.columns
        curvature = control_curvature(self.sweeps, run, run.u, columns, measures.ell, self.parameters)
        weights = quadrature_weights(replace(self.sweeps.mesh, control="linear")) * run.duration
        change = float(np.einsum("kij,i,j,k->", np.abs(curvature), at_controls, at_controls, weights)) if st.nu else 0.0
        return unit, change

    def metric(self, iterate: Iterate, linear: Linear, ell: Array, weight: Expr) -> Any:
        """Matrix of int du' W du dt + b dT^2 + ...: W = H_uu made positive definite, or the given one."""
        return self.metric_along(iterate, iterate.run.u, linear, ell, weight)

    def metric_along(
        self, iterate: Iterate, u: Array, linear: Linear, ell: Array, weight: Expr, size: float | None = None
    ) -> Any:
        """`metric` with another control along the same z; `size`: of the cost, None: of this part alone."""
        run, penalty = iterate.run, iterate.penalty.curvature
        st, mesh = self.sweeps.statement, self.sweeps.mesh
        if isinstance(weight, str):
            blocks = control_curvature(self.sweeps, run, u, linear.slopes.columns, ell, self.parameters)
            # where the cost is zero its slopes tell its unit; where they too are zero any metric will do
            size = self.size_of(iterate, linear) if size is None else size
            unit = (size if size > np.finfo(float).tiny / np.finfo(float).eps else 1.0) / run.duration
            blocks = np.where(np.isfinite(blocks).all(axis=(1, 2), keepdims=True), blocks, 0.0)
            blocks = positive_definite(blocks, self.scales.u, unit, SMALLEST_CURVATURE)
        else:
            given = np.asarray(weight, dtype=float)
            given = given * np.eye(st.nu) if given.ndim == 0 else np.diag(given) if given.ndim == 1 else given
            blocks = np.broadcast_to(given, (mesh.intervals + 1, st.nu, st.nu))
        metric = control_metric(mesh, run.duration, blocks)
        if penalty.any():
            metric = metric + sparse.block_diag(list(self._fold(penalty)), format="csc")
        return with_extra(metric, self.extra)

    def room(self, iterate: Iterate) -> tuple[Array, Array]:
        """Bounds of a step: to the bounds of the point; T changes by no more than a share of itself."""
        lower, upper = self.lower - iterate.point, self.upper - iterate.point
        if self.sweeps.statement.duration.free:
            at, duration = self.controls, iterate.run.duration
            lower[at], upper[at] = max(lower[at], -SHORTEN * duration), min(upper[at], LENGTHEN * duration)
        return lower, upper

    def with_extra(self, extra: Array) -> Space:
        """The same with other weights of what is no control value."""
        return replace(self, extra=extra)

    def chord(self, iterate: Iterate, linear: Linear, active: Array | None) -> Step:
        """The change to u_c, which minimises the Hamiltonian along the present x, E, p, P [4.2-10].

        Newton's method on H_u(x, E, p + R l, P, u_c) = 0 with int R' [f(u_c) - f(u)] dt = -dz to first order; T and
        free initial values change as in the gradient step with w = 1.
        """
        total, lower, upper = np.zeros(iterate.point.size), *self.room(iterate)
        present, ell, target = linear, np.zeros(self.conditions), -iterate.run.miss
        step = None
        u, rows = iterate.run.u, linear.rows.copy()
        for _ in range(CHORD_STEPS):
            metric = learnt(self.metric_along(iterate, u, linear, ell, "curvature"), ())
            slope = present.slope.copy()
            slope[self.controls :] = linear.slope[self.controls :] + self.extra * total[self.controls :]
            rows[:, : self.controls] = present.rows[:, : self.controls]
            step = solve_step(metric, slope, rows, target, lower - total, upper - total, active)
            total = np.clip(total + step.change, lower, upper)
            target, ell, active = target - rows @ step.change, step.ell, step.active
            if (np.abs(step.change) / self.unit).max(initial=0.0) <= CHORD_TOLERANCE:
                break
            u = (iterate.point + total)[: self.controls].reshape(u.shape)
            slopes = reweigh(self.sweeps, linear.slopes, u, iterate.run.duration, self.parameters)
            present = self._linear(iterate.penalty, slopes, iterate.run.z[0, : self.sweeps.statement.nx])
        assert step is not None
        return replace(step, change=total)

    def multipliers(self, iterate: Iterate, measures: Measures) -> Multipliers:
        """Multipliers of the statement's constraints: l, penalties' slopes, slopes at active control bounds."""
        st, mesh = self.sweeps.statement, self.sweeps.mesh
        zero = Multipliers.zero(st, mesh)
        terminal = self.sweeps.terminal
        final = np.zeros(st.nx + st.ne)
        ell = measures.ell[: self.conditions]
        final[list(terminal.fixed)] += ell[: len(terminal.fixed)]
        end, bounds = zero.end.copy(), np.zeros((mesh.intervals + 1, st.nx + st.ne))
        end[list(terminal.rows)] = ell[len(terminal.fixed) :]
        path, start, instants = zero.path, zero.start, [np.zeros(0)]
        for group, values in zip(self.groups, iterate.penalty.multipliers, strict=True):
            if group.kind == "path":
                path = values
            elif group.kind == INSTANT:
                instants.append(values[0])
            elif group.kind == "start":
                start = start.copy()
                start[: values[0].size] = values[0]
            elif group.kind == "end":
                end[[i for i in range(st.end.size) if i not in terminal.rows]] = values[0]
            else:
                bounds[-values.shape[0] :, limited(st)] = values
        held = -np.where(measures.active, measures.residual, 0.0)
        chosen = np.isin(self.free, st.decisions)
        bounds[0, self.free[chosen]] = held[self.controls + int(st.duration.free) :][chosen]
        final += bounds[-1]
        bounds[-1] = 0.0
        controls = held[: self.controls].reshape(zero.controls.shape)
        return replace(
            zero,
            final=final[: st.nx],
            final_matrices=final[st.nx :],
            end=end,
            start=start,
            instants=np.concatenate(instants),
            path=path,
            states=bounds[:, : st.nx],
            matrices=bounds[:, st.nx :],
            controls=controls,
        )

    def violations(self, iterate: Iterate, tolerance: float) -> dict[str, float]:
        """Largest violation of each violated constraint, in its own unit, by name."""
        miss = np.abs(iterate.run.miss)
        result = {
            name: float(value)
            for name, value, scale in zip(self.sweeps.terminal.names, miss, self.miss_scale, strict=True)
            if value > tolerance * scale
        }
        for group, excess, scales in zip(self.groups, iterate.penalty.excess, self.weights.scales, strict=True):
            worst = np.where(np.isnan(excess), np.inf, np.abs(excess)).max(axis=0)
            result |= {
                name: float(value)
                for name, value, scale in zip(group.names, worst, scales, strict=True)
                if value > tolerance * scale
            }
        return dict(sorted(result.items(), key=lambda entry: -entry[1]))


def point_of(space: Space, trajectory: Trajectory) -> Array:
    """The point of a trajectory."""
    duration = [trajectory.duration] if space.sweeps.statement.duration.free else []
    start = np.concatenate([trajectory.x[0], trajectory.e[0]])
    point = np.concatenate([trajectory.u.ravel(), duration, start[space.free]])
    return np.asarray(np.clip(point, space.lower, space.upper))


def make_space(
    sweeps: Sweeps, groups: tuple[Group, ...], parameters: Array, guess: Guess, given: tuple[int, ...] = ()
) -> Space:
    """The unknowns at a guess, which gives the scales.

    Args:
        sweeps: compiled.
        groups: inequalities met by penalties.
        parameters: of the statement.
        guess: where the iterations start.
        given: entries of z(0) that a phase before gives, as the guess has them.
    """
    st, mesh = sweeps.statement, sweeps.mesh
    x0, _, e0, _ = st.boundary_values(parameters)
    e0[st.entries(st.behind)] = 0.0  # what runs backward has no initial value of its own
    known = np.concatenate([x0, e0])
    if st.tied is not None:  # they follow the decisions
        known[[*st.tied.states, *(st.nx + k for k in st.tied.matrices)]] = 0.0
    free = np.setdiff1d(np.flatnonzero(np.isnan(known)), given)
    guessed = np.concatenate([guess.trajectory.x[0], guess.trajectory.e[0]])
    start = np.where(np.isnan(known), guessed, known)
    start = np.concatenate(st.started(start[: st.nx], parameters, start[st.nx :]))
    u, duration = guess.trajectory.u, guess.trajectory.duration
    run = sweep_forward(sweeps, u, duration, start, parameters)
    finite = run.z if np.isfinite(run.z).all() else np.tile(start, (mesh.intervals + 1, 1))
    trajectory = Trajectory(x=finite[:, : st.nx], u=u, e=finite[:, st.nx :], duration=duration)
    scales = choose_scales(st, mesh, trajectory, parameters)
    z_scale = np.concatenate([scales.x, scales.e])
    timed = int(st.duration.free)
    unit = np.concatenate([np.tile(scales.u, mesh.control_nodes), [scales.duration] * timed, z_scale[free]])
    z_lower, z_upper = limits(st)
    bounds = []
    for control, time, z in (
        (st.control_bounds[0], st.duration.lower, z_lower),
        (st.control_bounds[1], st.duration.upper, z_upper),
    ):
        bounds.append(np.concatenate([np.tile(control, mesh.control_nodes), [time] * timed, z[free]]))
    areas = np.repeat(quadrature_weights(mesh) * scales.duration, st.nu)
    metric = np.concatenate([areas, np.full(timed + free.size, scales.duration)]) / unit**2
    size = max(abs(run.running) + abs(run.terminal), np.finfo(float).tiny) if run.finite else 1.0
    _, _, by_z, *_ = sweeps.terminal.function(finite[-1], duration, parameters, 0.0)
    reach = np.abs(np.asarray(by_z.full()))[:, 1:].T @ z_scale
    count = mesh.control_nodes * st.nu
    return Space(
        sweeps=sweeps,
        groups=groups,
        weights=first_weights(groups, mesh, replace(run, z=finite), parameters, scales, size),
        parameters=parameters,
        start=start,
        free=free,
        scales=scales,
        unit=unit,
        lower=bounds[0],
        upper=bounds[1],
        fixed_metric=metric,
        miss_scale=np.where(reach > 0, reach, 1.0),
        extra=size / unit[count:] ** 2,
    )
