"""The quadratic lower bound of the cost of an identification, for all controls of finite energy.

q(u + v) = q(u) + <g, v> + <v, B v>/2 touches the cost at a control u that keeps the terminal conditions (`certificate`
has the formula); B is the identity plus a compact operator in the metric <v, v> = int v' L_uu v dt. Constraints enter
with multipliers of the right sign, as densities over time where they concern the controls: then no admissible control
costs less than q(u) - slack - <g, (B + sigma)^-1 g>/2 - sigma R^2/2 for any sigma >= 0 with B + sigma > 0, where R is
how far a control that costs no more can be.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from covocp.analysis.conditions import end_slopes, terminal_cost, terminal_weight
from covocp.analysis.constraint_duals import duals, terminal_rows
from covocp.analysis.reduction import Reduction
from covocp.analysis.stages import Stages
from covocp.base.dataclass import dataclass
from covocp.base.krylov import Krylov, krylov
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal
from covocp.transcription.mesh import Mesh

LARGEST_STEPS = 150
# Residuals, relative to the largest eigenvalue, at which the smallest eigenvalue and a solution are known well enough.
EIGENVALUE_RESIDUAL = 1e-9
SOLUTION_RESIDUAL = 1e-8
# Shifts sigma beyond what makes B positive, among which the best bound is taken.
SHIFTS = tuple(10.0**k for k in range(-12, -1))


@dataclass(frozen=True, kw_only=True)
class Bound:
    """The bound on one mesh, with n stages of 2 nu control values each.

    Attributes:
        stages: the reduction on the mesh.
        zeta: trajectory of the control that the bound touches, moved to where it keeps the terminal conditions.
        cost: its cost, with the reduction on this mesh.
        magnitude: what the terms of the cost (of the stages, of x(T), of Lambda) add up to without their signs [cost].
        uncertain: tr(C Lambda^-1), the part of it that q is linear in.
        information: Lambda (nb, nb).
        curvature: Hessian of q by zeta in each stage; `own`: of the cost of x and u alone.
        last: Hessian of the terminal cost by x(T).
        slope: of q by the control values in units of the roots, with the multipliers of inequalities, on the controls
            that keep the terminal conditions; `own_slope`: of the cost of x and u alone.
        slack: what the multipliers of inequalities lose because they do not all hold [cost].
        held: orthonormal directions, in the same units, that would change the terminal conditions, (n 2 nu, rows).
    """

    stages: Stages
    zeta: Array
    cost: float
    magnitude: float
    uncertain: float
    information: Array
    curvature: Array
    own: Array
    last: Array
    slope: Array
    own_slope: Array
    slack: float
    held: Array

    __repr__ = short_repr

    @staticmethod
    def at(extremal: Extremal, mesh: Mesh, w: Array) -> Bound:
        """The bound at a control of an extremal, given at both ends of the intervals of a mesh, (n, 2 nu).

        Raises:
            numpy.linalg.LinAlgError: where the running cost is not strictly convex in the control.
        """
        st, parameters = extremal.statement, extremal.parameters
        stages = Stages.of(Reduction(st, mesh, parameters))
        held, zeta = _admissible(extremal, stages, w)
        nx, x = st.nx, zeta[-1, : st.nx]
        information = stages.information(zeta)
        covariance = np.linalg.inv(information)
        weight = terminal_weight(st, parameters)[nx:, nx:]
        uncertain = float(np.trace(weight @ covariance))
        running = 0.5 * np.einsum("ki,kij,kj->k", zeta[:-1], stages.running, zeta[:-1])
        terminal = terminal_cost(st, parameters, x)
        own, last = stages.running, end_slopes(st, parameters, x)
        curvature = own - stages.weighted(covariance @ weight @ covariance)

        def gradient(by_xi: Array, by_w: Array) -> Array:
            return _gradient(stages, curvature, last[0], zeta, by_xi, by_w)

        given = duals(extremal, stages, zeta, gradient)
        nothing = (np.zeros((zeta.shape[0], stages.size)), np.zeros_like(w))

        def projected(slopes: Array) -> Array:
            value = stages.in_roots(slopes)
            return np.asarray(value - held @ (held.T @ value))

        return Bound(
            stages=stages,
            zeta=zeta,
            cost=float(running.sum()) + terminal + uncertain,
            magnitude=float(np.abs(running).sum()) + abs(terminal) + abs(uncertain),
            uncertain=uncertain,
            information=information,
            curvature=curvature,
            own=own,
            last=last[1],
            slope=projected(gradient(given.by_xi, given.by_w)),
            own_slope=projected(_gradient(stages, own, last[0], zeta, *nothing)),
            slack=given.slack,
            held=held,
        )

    def apply(self, curvature: Array, v: Array) -> Array:
        """The second variation with some Hessians of the stages times v, on the admissible controls.

        On the directions that are held it is the unit operator, whose eigenvalue it comes close to anyway: compact
        operators do.
        """
        stages, s = self.stages, self.stages.size
        fixed = self.held @ (self.held.T @ v)
        v = v - fixed
        shape = (stages.ends.shape[0], stages.energy.shape[1])
        w = stages.controls(v.reshape(shape))
        xi = stages.changes(w)
        local = np.einsum("kij,kj->ki", curvature[:, :-1, :-1], np.hstack([xi[:-1], w]))
        by_xi = np.vstack([local[:, :s], np.zeros((1, s))])
        nx = self.last.shape[0]
        by_xi[-1, :nx] = self.last @ xi[-1, :nx]
        slopes = stages.slopes(by_xi, local[:, s:])
        image = stages.in_roots(slopes)
        return np.asarray(image - self.held @ (self.held.T @ image) + fixed)

    def smallest(self, curvature: Array) -> tuple[float, float]:
        """Smallest eigenvalue of the second variation with some Hessians, and its error; inf where nothing is free."""
        start = np.random.default_rng(0).standard_normal(self.slope.size)
        start -= self.held @ (self.held.T @ start)
        if start.size <= self.held.shape[1]:
            return np.inf, 0.0
        found = self._lanczos(curvature, start, EIGENVALUE_RESIDUAL)
        return float(found.values[0]), found.residual + found.asymmetry

    def _lanczos(self, curvature: Array, start: Array, residual: float) -> Krylov:
        return krylov(
            lambda v: self.apply(curvature, v),
            start,
            LARGEST_STEPS,
            lambda _, left, largest: left <= residual * largest,
        )

    def reach(self, excess: float) -> float:
        """R: how far, in the metric, a control can be that costs no more than this one by `excess`.

        J(u + v) <= J(u) + excess and tr(C Lambda^-1) >= 0 give slope R + own R^2 / 2 <= tr(C Lambda*^-1) + excess for
        the cost of x and u alone.
        """
        value, error = self.smallest(self.own)
        value -= error
        if not np.isfinite(value):
            return 0.0
        if value <= 0:
            return np.inf
        slope = float(np.linalg.norm(self.own_slope))
        return float((slope + np.sqrt(slope**2 + 2 * value * (self.uncertain + excess))) / value)

    def room(self, eigenvalue: float, error: float, reach: Callable[[], float]) -> float:
        """What another admissible control can save beyond the slack.

        Args:
            eigenvalue: smallest of the second variation as it was computed.
            error: that all its eigenvalues may be too large by.
            reach: gives R.
        """
        if not np.isfinite(eigenvalue):
            return 0.0
        length, best = float(np.linalg.norm(self.slope)), np.inf
        start = self.slope if length > 0.0 else np.ones_like(self.slope)
        found = self._lanczos(self.curvature, start, SOLUTION_RESIDUAL)
        least = min(float(found.values[0]), eigenvalue)
        if least > error:
            best = 0.5 * found.inverse_form(-error, length, least)
        if least - error < SHIFTS[-1] and np.isfinite(radius := reach()):
            for extra in SHIFTS:
                shift = max(0.0, -least) + extra
                saved = 0.5 * found.inverse_form(shift, length, least) + 0.5 * (shift + error) * radius**2
                best = min(best, saved)
        return float(best)


def _gradient(stages: Stages, curvature: Array, terminal: Array, zeta: Array, by_xi: Array, by_w: Array) -> Array:
    """Slopes by the controls (n, 2 nu) of quadratic costs along a trajectory, and of what has these slopes besides."""
    s = stages.size
    local = np.einsum("kij,kj->ki", curvature, zeta[:-1])
    nodes = by_xi + np.vstack([local[:, :s], np.zeros((1, s))])
    nodes[-1, : terminal.size] += terminal
    return stages.slopes(nodes, by_w + local[:, s:-1])


def _admissible(extremal: Extremal, stages: Stages, w: Array) -> tuple[Array, Array]:
    """Directions that change the terminal conditions, and the trajectory of the nearest control that keeps them.

    Nearest in the metric: what another integration misses the targets by is taken up by the control.
    """
    shape = w.shape
    zeta = stages.trajectory(w)
    rows, missed = terminal_rows(extremal, zeta[-1, : extremal.statement.nx])
    slopes = np.zeros((w.size, rows.shape[0]))
    for i, row in enumerate(rows):
        by_xi = np.zeros((shape[0] + 1, stages.size))
        by_xi[-1, : row.size] = row
        slopes[:, i] = stages.in_roots(stages.slopes(by_xi, np.zeros(shape)))
    if not rows.shape[0]:
        return slopes, zeta
    units = np.linalg.norm(slopes, axis=0)  # conditions on states in other units count alike
    units = np.where(units > 0.0, units, 1.0)
    slopes, missed = slopes / units, missed / units
    left, values, right = np.linalg.svd(slopes, full_matrices=False)
    kept = values > 1e-10 * max(float(values[0]), float(np.finfo(float).tiny))
    held = left[:, kept]
    step = -held @ ((right[kept] @ missed) / values[kept])
    return held, stages.trajectory(w + stages.controls(step.reshape(shape)))
