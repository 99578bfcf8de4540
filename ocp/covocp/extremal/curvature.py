"""Second-order condition: the smallest curvature of the Lagrangian in the directions that what holds a solution leaves.

The reduced Hessian is that of the controls, and of initial states that are free, on the null space of *all* constraints
that hold: terminal conditions, bounds and inequalities with a multiplier. It is applied to a direction by way of the
nodes (`tangents` there, the second derivatives of each interval, and back), so that nothing is amplified by the
horizon where the plant is unstable. Limits inside the intervals count like those at the nodes: rows and second
derivatives are those of the mesh that has all these points as nodes. Where inequalities only just hold, without a
multiplier, a direction counts only if they allow it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Literal, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.krylov import LEAST_STEPS, krylov
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.active_constraints import held_by, null_space
from covocp.extremal.costates import discrete_costates
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import refined
from covocp.extremal.free_starts import free_start, largest, start_weights
from covocp.extremal.hamiltonian import Costates
from covocp.extremal.lagrangian import arguments, held_rows, node_size, product_along, second_order, slopes_of_intervals
from covocp.extremal.metric import Root, mass_matrix
from covocp.extremal.tangents import Between, Tangents

LANCZOS_STEPS = 120
# Residual of the smallest Ritz value, relative to the largest eigenvalue, at which it is known well enough; its sign
# is where the residual is below half of it.
LANCZOS_TOLERANCE = 1e-3
GOLDEN = 0.5 * np.sqrt(5.0) - 0.5
# Controls count in units of their own where these differ by more than this factor.
FAR_APART = 1e3
# An eigenvalue below its error is zero: this multiple of the asymmetry of the operator as it was computed, or this
# share of the largest eigenvalue, to which solvers meet the conditions that the multipliers come from.
SAFETY = 10.0
SOLVED = 1e-9
# Steps of the search for a direction that constraints without multipliers allow; what they may be missed by.
CONE_STEPS = 60
CONE_MISS = 1e-9
# Entries up to which what all directions do to the points is one matrix; up to which nobody waits for products that the
# library has alone, and how long one of these counts to take [s].
FEW_ENTRIES, FEW_NUMBERS, LEAST_SECONDS = 1_000_000, 100_000, 1e-6

Verdict = Literal["minimum", "saddle", "flat", "unknown"]


@dataclass(frozen=True, kw_only=True)
class Curvature:
    """The smallest curvature and its direction, in the metric int du' du dt; see `_shares`.

    Attributes:
        value: smallest curvature in the directions that are left.
        largest: largest absolute eigenvalue of the reduced Hessian.
        error: of both, by roundoff and by the tolerance of the solution.
        direction: of the controls, (N + 1 or N, nu); of the initial states in `start` (nx,).

    The value is NaN where it would take longer to find than was allowed.
    """

    value: float
    largest: float
    error: float
    direction: Array
    start: Array

    __repr__ = short_repr

    @property
    def verdict(self) -> Verdict:
        """ "minimum", "saddle", "flat" where the sign is below the error, or "unknown"."""
        if np.isnan(self.value):
            return "unknown"
        if abs(self.value) <= self.error:
            return "flat"
        return "minimum" if self.value > 0 else "saddle"


def smallest_curvature(extremal: Extremal, seconds: float = np.inf) -> Curvature | None:
    """The smallest curvature with the terminal time held; None where nothing can move or it cannot be computed.

    Args:
        extremal: the solution.
        seconds: about as long as it may take. A product with the Hessian of a gain that is free takes a second where
            there are four states, and there may be a hundred of them.
    """
    if not extremal.statement.nu:
        return None
    try:
        return _smallest(extremal, seconds)
    except _TooLongError:
        return _unknown(extremal)
    except (RuntimeError, ArithmeticError, np.linalg.LinAlgError):  # a step that cannot be differentiated or solved
        return None


def _smallest(extremal: Extremal, seconds: float) -> Curvature | None:
    """What `smallest_curvature` returns where nothing fails."""
    reduced = _Reduced.of(extremal, seconds)
    if reduced is None:
        return None
    strict = reduced.null_space(reduced.strict)
    if not strict.shape[1]:
        return None
    operator = _finite(reduced.operator(strict))
    left = seconds / reduced.seconds - _for_units(extremal.statement.nu, reduced.tangents.start)
    products = _Products(left=max(left, LEAST_STEPS))
    values, vectors, error, known = _extremes(operator, strict, products)
    if not known and values[0] >= -error:  # a negative one is there whatever else is
        return _unknown(extremal)
    value, v = float(values[0]), vectors[:, 0]
    largest = float(np.abs(values).max())
    error = max(error, SOLVED * largest)
    if value < -error and reduced.loose.shape[0]:
        value, v, known = _in_the_cone(reduced, v, value, largest, error, products)
        if not known and value >= -error:
            return _unknown(extremal)
    z, u = reduced.tangents.forward(reduced.unscaled(v)[:, None])
    start = np.zeros(extremal.statement.nx)
    moving = list(reduced.tangents.start)
    start[moving] = z[0, moving, 0]
    return Curvature(value=value, largest=largest, error=error, direction=u[:, :, 0], start=start)


def _finite(operator: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """An operator that fails where what it gives is no number."""

    def image(direction: Array) -> Array:
        found = operator(direction)
        if not np.isfinite(found).all():
            raise ArithmeticError("the Hessian is not finite")
        return found

    return image


class _TooLongError(Exception):
    """A few products with the Hessian take longer than all of it may."""


def _unknown(extremal: Extremal) -> Curvature:
    """What is not known."""
    nothing = np.zeros_like(extremal.trajectory.u), np.zeros(extremal.statement.nx)
    return Curvature(value=np.nan, largest=np.nan, error=np.inf, direction=nothing[0], start=nothing[1])


@dataclass(kw_only=True)
class _Products:
    """How many products with the Hessian may still be waited for, in all parts of the search together."""

    left: float

    def steps(self, most: int) -> int:
        """Steps of one product each that are left, and no more than some number."""
        return int(min(most, max(self.left, 0.0)))


class _Extremes(NamedTuple):
    """Ritz values (rising) and vectors on a subspace, how far the operator on it was from symmetric, whether known.

    Those after all steps count as known: only products that are missing leave it open.
    """

    values: Array
    vectors: Array
    error: float
    known: bool


def _extremes(operator: Callable[[Array], Array], basis: Array, products: _Products) -> _Extremes:
    """Ritz pairs of an operator on a subspace after some Lanczos steps."""

    def known(value: float, residual: float, largest: float) -> bool:
        return residual <= min(LANCZOS_TOLERANCE * largest, max(0.5 * abs(value), SOLVED * largest))

    order = np.arange(1.0, basis.shape[1] + 1.0)
    start = np.modf(order**2 * GOLDEN)[0] - 0.5  # like random numbers: across no direction
    steps = products.steps(LANCZOS_STEPS)
    if not steps:
        return _Extremes(np.array([np.inf]), np.zeros((basis.shape[0], 1)), 0.0, False)
    found = krylov(operator, start, steps, known)
    products.left -= found.values.size
    settled = found.values.size == start.size or found.beside[-1] == 0.0 or steps == LANCZOS_STEPS
    settled = settled or known(float(found.values[0]), found.residual, float(np.abs(found.values).max()))
    return _Extremes(found.values, np.asarray(basis @ found.vectors), SAFETY * found.asymmetry, bool(settled))


def _in_the_cone(
    reduced: _Reduced, v: Array, value: float, largest: float, error: float, products: _Products
) -> tuple[float, Array, bool]:
    """The smallest curvature found among the directions that constraints without a multiplier allow; whether known.

    Negative only with a direction that shows it: the direction itself or its opposite, one that keeps those constraints
    as they are, or one that descends into the cone they leave. That there is none is known only after all steps.
    """
    rows = reduced.loose / np.maximum(np.linalg.norm(reduced.loose, axis=1), np.finfo(float).tiny)[:, None]
    for sign in (1.0, -1.0):
        if (rows @ (sign * v) >= -CONE_MISS).all():
            return value, sign * v, True
    basis = reduced.null_space(np.vstack([reduced.strict, reduced.loose]))
    best, kept, known = np.inf, np.zeros_like(v), True
    if basis.shape[1]:
        values, vectors, _, known = _extremes(reduced.operator(basis), basis, products)
        best, kept = float(values[0]), vectors[:, 0]
    if best < -error:
        return best, kept, True
    strict = reduced.null_space(reduced.strict)
    for sign in (1.0, -1.0):
        d = _onto_cone(sign * strict.T @ v, rows @ strict)
        for _ in range(CONE_STEPS):
            length = float(np.linalg.norm(d))
            if length <= CONE_MISS:
                break
            if not products.steps(1):
                return best, kept, False
            products.left -= 1
            d /= length
            image = strict.T @ reduced.apply(strict @ d)
            found = float(d @ image)
            if found < best:
                best, kept = found, strict @ d
            if best < -error:
                return best, kept, True
            d = _onto_cone(d - (image - found * d) / largest, rows @ strict)
    return best, kept, known


def _onto_cone(d: Array, rows: Array) -> Array:
    """The nearest direction along which no row falls: d + rows' y, y >= 0 (non-negative least squares)."""
    from scipy.optimize import nnls

    weights, _ = nnls(np.vstack([rows.T, np.zeros((1, rows.shape[0]))]), np.append(-d, 0.0))
    return np.asarray(d + rows.T @ weights)


@dataclass(frozen=True, kw_only=True)
class _Reduced:
    """The reduced Hessian as an operator on v in units of the root of the metric.

    Attributes:
        tangents: from v to nodes and controls.
        between: from there to all points at which limits are imposed, the nodes among them.
        root: R of the metric R' R of v.
        product: Hessian of the Lagrangian by points and controls there, times a direction of them.
        strict: slopes by v of the rows held with a multiplier, (rows, V), in these units.
        loose: of those without, such that a direction is allowed along which none falls.
        seconds: that one product takes.
    """

    tangents: Tangents
    between: Between
    root: Root
    product: Callable[[Array], Array]
    strict: Array
    loose: Array
    seconds: float

    __repr__ = short_repr

    @staticmethod
    def of(extremal: Extremal, seconds: float) -> _Reduced | None:
        """The operator along an extremal; None where nothing can move.

        Raises:
            _TooLongError: the products that are needed in any case take longer than this.
        """
        st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
        fine = refined(extremal)
        held = held_by(fine, extremal.mesh.points)
        fine = held.bare(fine)
        own, touching = held.controls[:: mesh.points], held.touching[:: mesh.points]  # those between follow from them
        free = own == 0
        free[mesh.idle] = False  # what moves them acts for no time
        tangents = tangents_along(extremal, free, free_start(extremal))
        if not tangents.size:
            return None
        between = _between(extremal, fine)
        costates = _costates(fine, through=tangents.gain is None)
        applied, jacobian, given, alone = product_along(fine, costates, held.entries)
        once = LEAST_SECONDS
        if not alone or fine.trajectory.x.size + fine.trajectory.e.size > FEW_NUMBERS:
            once = _seconds(applied, node_size(st) * (fine.mesh.intervals + 1) + fine.trajectory.u.size)
        if once * (LEAST_STEPS + _for_units(st.nu, tangents.start)) > seconds:
            raise _TooLongError
        moving = np.flatnonzero(tangents.free).tolist()
        weights = np.zeros(0)
        if tangents.start:
            curved = _curved(tangents, between, applied)
            weights = start_weights(extremal, tangents.start, curved, len(moving))
        shares = ca.diag(ca.DM(_shares(fine, applied)[np.array(moving, dtype=np.intp) % st.nu]))
        metric = shares @ mass_matrix(mesh, t.duration, st.nu)[moving, moving] @ shares
        root = Root.of(ca.diagcat(metric, ca.diag(ca.DM(weights))))
        slopes = between.backward(*_split(fine, held_rows(jacobian, held.entries, fine, given)))
        rows = root.solved(_by_v(tangents, *slopes), turned=True).T
        if not np.isfinite(rows).all():
            return None
        at_bounds = np.flatnonzero(touching * tangents.free)
        units = np.zeros((tangents.free.size, at_bounds.size))
        units[at_bounds, np.arange(at_bounds.size)] = 1.0
        still = np.zeros((mesh.intervals + 1, node_size(st), at_bounds.size))
        beside = root.solved(_by_v(tangents, still, units.reshape(*t.u.shape, -1)), turned=True).T
        loose = np.vstack([rows[~held.strict], beside])
        side = np.concatenate([held.side[~held.strict], touching.ravel()[at_bounds]])
        return _Reduced(
            tangents=tangents,
            between=between,
            root=root,
            product=applied,
            strict=rows[held.strict],
            loose=-side[:, None] * loose,
            seconds=once,
        )

    def unscaled(self, v: Array) -> Array:
        """v of the tangents."""
        return self.root.solved(v[:, None])[:, 0]

    def moved(self, v: Array) -> Array:
        """Changes of points and controls there, one below the other, (rows, m), of v (V, m)."""
        z, u = self.between.forward(*self.tangents.forward(self.root.solved(v)))
        return np.vstack([z.reshape(-1, v.shape[1]), u.reshape(-1, v.shape[1])])

    def operator(self, basis: Array) -> Callable[[Array], Array]:
        """The reduced Hessian on a subspace, of coordinates in a basis (V, size).

        What the basis does to the points is one matrix where that has few entries; else each direction is run through
        all of them, and its slopes back.
        """
        count = (self.between.A.shape[0] * max(self.between.A.shape[1], 1) + 1) * sum(self.tangents.before.shape[1:])
        if basis.shape[1] * count > FEW_ENTRIES:
            return lambda c: np.asarray(basis.T @ self.apply(basis @ c))
        moved = self.moved(basis)
        return lambda c: np.asarray(moved.T @ self.product(moved @ c))

    def apply(self, v: Array) -> Array:
        """The reduced Hessian times v."""
        z, u = self.between.forward(*self.tangents.forward(self.unscaled(v)[:, None]))
        image = self.product(np.concatenate([z.ravel(), u.ravel()]))
        slopes = self.between.backward(image[: z.size].reshape(z.shape), image[z.size :].reshape(u.shape))
        by_v = self.tangents.backward(*slopes)
        return self.root.solved(by_v, turned=True)[:, 0]

    def null_space(self, rows: Array) -> Array:
        """Orthonormal basis of the directions along which no row changes, (V, number)."""
        return null_space(rows, self.tangents.size)


def _seconds(product: Callable[[Array], Array], size: int) -> float:
    """How long one product with a direction of this size takes [s]."""
    begin = time.perf_counter()
    product(np.zeros(size))
    return max(time.perf_counter() - begin, LEAST_SECONDS)


def _for_units(controls: int, start: tuple[int, ...]) -> int:
    """Products with the Hessian that the units of the metric take."""
    return controls + (1 + len(start) if start else 0)


def _curved(tangents: Tangents, between: Between, product: Callable[[Array], Array]) -> Callable[[Array], float]:
    """Second slope of the Lagrangian along v of the tangents."""

    def along(v: Array) -> float:
        z, u = between.forward(*tangents.forward(v[:, None]))
        moved = np.concatenate([z.ravel(), u.ravel()])
        return float(moved @ product(moved))

    return along


def _shares(fine: Extremal, product: Callable[[Array], Array]) -> Array:
    """Units of the metric (nu,): 1, or where they are far apart the roots of the curvature of each control by itself.

    Beside a control in units of 1e-7 one in units of 1 would have no curvature but rounding.
    """
    count, u = fine.statement.nu, fine.trajectory.u
    if count == 1:
        return np.ones(1)
    first = node_size(fine.statement) * (fine.mesh.intervals + 1)
    roots = np.zeros(count)
    for i in range(count):
        direction = np.zeros(first + u.size)
        direction[first + i :: count] = 1.0
        roots[i] = np.sqrt(abs(direction @ product(direction)))
    own = roots[roots > 0]
    if not own.size or own.max() <= FAR_APART * own.min():
        return np.ones(count)
    return np.where(roots > 0, roots / own.mean(), 1.0)


def _by_v(tangents: Tangents, by_z: Array, by_u: Array) -> Array:
    """Slopes of rows by v from those by nodes and controls, (V, rows)."""
    return tangents.backward(by_z, by_u) if by_z.shape[2] else np.zeros((tangents.size, 0))


def _split(extremal: Extremal, rows: Array) -> tuple[Array, Array]:
    """Slopes of rows by nodes (N + 1, n, rows) and controls (N + 1 or N, nu, rows), from a Jacobian by both."""
    u, nodes, n = extremal.trajectory.u, extremal.mesh.intervals + 1, node_size(extremal.statement)
    by_z, by_u = rows[:, : n * nodes].T, rows[:, n * nodes :].T
    return by_z.reshape(nodes, n, rows.shape[0]), by_u.reshape(*u.shape, rows.shape[0])


def _between(extremal: Extremal, fine: Extremal) -> Between:
    """From the nodes of an extremal to those of its refined one."""
    constant = extremal.mesh.control == "constant"
    if extremal.mesh.points == 1:
        none = np.zeros((extremal.mesh.intervals, 1, 0, 0))  # there is nothing to pass through
        return Between(A=none, before=none, after=none, constant=constant)
    slopes = slopes_of_intervals(fine)
    if constant:
        slopes = (slopes[0], slopes[1] + slopes[2], np.zeros_like(slopes[2]))
    A, before, after = (v.reshape(extremal.mesh.intervals, extremal.mesh.points, *v.shape[1:]) for v in slopes)
    return Between(A=A, before=before, after=after, constant=constant)


def tangents_along(
    extremal: Extremal, free: NDArray[np.bool_], start: tuple[int, ...] = (), *, feedback: bool = True
) -> Tangents:
    """The linearised nominal along an extremal, as a map from the controls that are free and the initial states."""
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    A, before, after = slopes_of_intervals(extremal)
    z = t.x if not st.coupled else np.hstack([t.x, t.e])
    scales = (largest(z), largest(t.u))
    constant = mesh.control == "constant"
    if constant:
        before = before + after
    if not feedback:
        return Tangents(A=A, before=before, after=None if constant else after, free=free, start=start, gain=None)
    return Tangents.of(A, before, None if constant else after, free, start, scales)


def _costates(extremal: Extremal, *, through: bool) -> Costates:
    """Costates at the nodes: through the whole horizon from its end, or from the end of each shooting segment.

    The first are exact for every trajectory, the second where the multipliers of the continuity are, but the plant
    amplifies the error at the end of a segment only, not of the horizon.
    """
    if through:
        none = np.zeros((0, extremal.statement.nx))
        extremal = replace(extremal, multipliers=replace(extremal.multipliers, gaps=none))
    return discrete_costates(extremal)[0]


def held_jacobian(extremal: Extremal) -> Array:
    """Jacobian by the control values, node by node, of what is held by conditions, inequalities and state bounds."""
    fine = refined(extremal)
    held = held_by(fine, extremal.mesh.points)
    fine = held.bare(fine)
    _, jacobian = second_order(fine.statement, fine.mesh, held.strictly)
    everything = np.ones(extremal.trajectory.u.shape, dtype=bool)
    everything[extremal.mesh.idle] = False
    tangents = tangents_along(extremal, everything, feedback=False)
    rows = held_rows(jacobian, held.strictly, fine, arguments(fine, _costates(fine, through=True)))
    slopes = _between(extremal, fine).backward(*_split(fine, rows))
    by_v = _by_v(tangents, *slopes).T
    result = np.zeros((by_v.shape[0], everything.size))
    result[:, everything.ravel()] = by_v
    return result
