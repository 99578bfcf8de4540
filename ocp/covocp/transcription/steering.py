"""Controls that bring the nominal to its final values, or along given states: steps of Gauss and Newton on one run."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.dataclass import dataclass
from covocp.base.expressions import sequence_of
from covocp.base.matrices import Array
from covocp.base.quadrature import interpolated
from covocp.base.short_repr import short_repr
from covocp.passage.columns import numbers_in_turn
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.end_slopes import end_slopes
from covocp.transcription.mesh import Mesh, control_places
from covocp.transcription.numbers import columns_of_parts
from covocp.transcription.shooting import interval_columns
from covocp.transcription.steps import nominal_interval

STEERING_STEPS = 4
STEERING_TOLERANCE = 1e-6
# A start needs no more digits than these. Shares of a step towards the final values, and of that towards least energy.
DIGITS = 1e-3
LENGTHS = ((1.0, 1.0), (1.0, 0.0), (0.4, 0.4), (0.4, 0.0), (0.15, 0.15), (0.15, 0.0), (0.03, 0.03))
TRACKING_STEPS = 20
CUTS = 5
# Share of the control's energy in what tracking minimises, beside the squared miss in units of the states.
TRACKING_ENERGY = 1e-4
# Operations up to which a run and its slopes are written out in scalars where they are called often.
SHORT = 50_000
# Weight of a control that acts for no time, in mean weights.
NO_TIME = 1e-3
# Smallest singular value, relative to the largest, of directions in which the controls move what is aimed at.
RANK = 1e-8
# Where nothing tells the unit of a control, or of a final value, it is one, unless what it moves, or is moved by, tells
# so many times more or less. A bend of one would be none where a control is counted in grains, and far away in tons.
FAR_UNIT = 100.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One run of the nominal from its start over a mesh.

    Args:
        statement: an uncoupled problem with controls.
        mesh: its nodes and substeps count.
        start: initial state, (nx,).
        duration: T [s].
        parameters: of the statement.
        scale: typical magnitudes of the states, (nx,); zero where nothing tells them.
        units: typical magnitudes of the controls, (nu,), positive.
    """

    statement: Statement
    mesh: Mesh
    start: Array
    duration: float
    parameters: Array
    scale: Array
    units: Array

    __repr__ = short_repr

    @property
    def divisors(self) -> Array:
        """The scales of the states, 1 where nothing tells them."""
        return np.where(self.scale > 0, self.scale, 1.0)

    def states(self, u: Array) -> Array:
        """States at the nodes (N + 1, nx) of controls (nodes, nu); NaN or inf where the run diverges."""
        return nominal_states(self.statement, self.mesh, self.start, u, self.duration, self.parameters)

    def running(self, u: Array) -> float:
        """Integral of the running cost; zero where that depends on the matrices."""
        return _numbers_along(self.statement, self.mesh, self.start, u, self.duration, self.parameters)[1]

    @property
    def weights(self) -> Array:
        """Weight of each control value in the energy, flattened like the controls, in their units."""
        return np.asarray((quadrature_weights(self.mesh)[:, None] / self.units**2).ravel())

    def clip(self, u: Array) -> Array:
        """Controls within their bounds."""
        return np.asarray(np.clip(u, *self.statement.control_bounds))


def quadrature_weights(mesh: Mesh) -> Array:
    """Weight of each control value in the integral over s: trapezoidal for linear controls, lengths for constant.

    Where a value acts for no time, small ones in place of none.
    """
    steps = np.diff(mesh.nodes)
    weights = steps if mesh.control == "constant" else 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
    return np.asarray(np.where(weights > 0, weights, NO_TIME * weights.mean()))


@lru_cache(maxsize=KEPT)
def _along(statement: Statement, mesh: Mesh) -> ca.Function:
    """(start, controls, T, p) -> states at the ends of the intervals, integral of the running cost."""
    x0, duration, p = ca.MX.sym("x0", statement.nx), ca.MX.sym("T"), ca.MX.sym("p", statement.np)
    u = ca.MX.sym("u", statement.nu, mesh.control_nodes)
    run = sequence_of(nominal_interval(statement, mesh.substeps, mesh.step), mesh.intervals)
    ends, _, cost = run(x0, *interval_columns(mesh, u, duration, p))
    return ca.Function("along", [x0, u, duration, p], [ends, ca.sum2(cost)])


@lru_cache(maxsize=KEPT)
def _along_of_casadi(statement: Statement, mesh: Mesh) -> Matrices:
    """The same, for numbers."""
    return Matrices(_along(statement, mesh))


def compiled_along(
    statement: Statement, mesh: Mesh, start: Array, u: Array, duration: float, parameters: Array
) -> tuple[Array, float] | None:
    """The nominal along controls by the compiled library.

    Args:
        statement: a problem whose nominal runs alone.
        mesh: of it.
        start: state where it begins, (nx,).
        u: controls, (nodes, nu).
        duration: T [s].
        parameters: of the statement.

    Returns:
        States at the ends of the intervals (nx, N) and the integral of the running cost, 0 where that depends on the
        matrices; None where the library cannot take the model.
    """
    parts = mesh.substeps if mesh.step != "rodas" else 1  # step by step: one function for all numbers of substeps
    advance = nominal_interval(statement, mesh.substeps // parts, mesh.step)
    columns = columns_of_parts(mesh, parts, u.T, duration, parameters)
    found = numbers_in_turn(statement, advance, start[:, None], columns, mesh.intervals * parts)
    if found is None:
        return None
    costs = np.cumsum(found[2].reshape(-1, parts), axis=1)[:, -1]
    return found[0][:, parts - 1 :: parts], float(np.cumsum(costs)[-1])


def _numbers_along(
    statement: Statement, mesh: Mesh, start: Array, u: Array, duration: float, parameters: Array
) -> tuple[Array, float]:
    """The same, by CasADi where the library cannot."""
    found = compiled_along(statement, mesh, start, u, duration, parameters)
    if found is not None:
        return found
    ends, cost = _along_of_casadi(statement, mesh).evaluated(start, u.T, duration, parameters)
    return ends, float(cost.item())


def nominal_states(
    statement: Statement, mesh: Mesh, start: Array, u: Array, duration: float, parameters: Array
) -> Array:
    """States at the nodes (N + 1, nx) of a run of the nominal; NaN or inf where it diverges."""
    return np.vstack([start, _numbers_along(statement, mesh, start, u, duration, parameters)[0].T])


@lru_cache(maxsize=KEPT)
def _aims(
    statement: Statement, mesh: Mesh, columns: tuple[int, ...], rows: tuple[int, ...], often: bool
) -> ca.Function:
    """(start, controls as one column, T, p) -> some states at the ends of some intervals, their Jacobian by u."""
    u = ca.MX.sym("u", statement.nu * mesh.control_nodes)
    x0, duration, p = ca.MX.sym("x0", statement.nx), ca.MX.sym("T"), ca.MX.sym("p", statement.np)
    matrix = ca.reshape(u, statement.nu, mesh.control_nodes)
    ends = _along(statement, mesh)(x0, matrix, duration, p)[0]
    value = ca.vec(ends[list(rows), list(columns)])
    function = ca.Function("aims", [x0, u, duration, p], [value, ca.jacobian(value, u)])
    if not often:
        return function
    length = nominal_interval(statement, mesh.substeps, mesh.step).n_instructions() * mesh.intervals * value.shape[0]
    scalar = statement.symbolic is ca.SX and mesh.step != "rodas"  # implicit steps solve linear systems
    return function.expand() if scalar and length <= SHORT else function


def final_pull(run: Run, fixed: tuple[int, ...], target: Array, u: Array, often: bool = True) -> tuple[Array, Array]:
    """Miss of the final values of some states in their scales, and its Jacobian by the controls."""
    found = end_slopes(run.statement, run.mesh, run.start, u, run.duration, run.parameters, fixed)
    if found is None:
        aims = _aims(run.statement, run.mesh, (run.mesh.intervals - 1,), fixed, often)
        value, slope = aims(run.start, u.ravel(), run.duration, run.parameters)
        found = np.asarray(value.full()).ravel(), np.asarray(slope.full())
    scale = run.divisors[list(fixed)]
    return (found[0] - target) / scale, found[1] / scale[:, None]


def in_told_units(run: Run, fixed: tuple[int, ...], plain: Array, often: bool = True) -> Run:
    """The run with scales of final values of which nothing tells any: what moves the others by theirs moves these so.

    They are left at 1 where that is about it. A speed from rest to rest has no size of its own: in metres per
    microsecond, or nanometres per year, steering would see nothing beside it, or nothing of it.
    """
    rows = list(fixed)
    untold = run.scale[rows] == 0
    if not untold.any() or untold.all():
        return run
    slope = final_pull(run, fixed, np.zeros(len(fixed)), plain, often)[1]
    with np.errstate(all="ignore"):
        answers = np.sqrt((slope**2) @ (1.0 / run.weights))
        sizes = answers / answers[~untold].max()
    far = untold & np.isfinite(sizes) & (sizes > 0) & ((sizes > FAR_UNIT) | (sizes < 1.0 / FAR_UNIT))
    scale = run.scale.copy()
    scale[rows] = np.where(far, sizes, scale[rows])
    return replace(run, scale=scale)


def steer(run: Run, fixed: tuple[int, ...], target: Array, plain: Array) -> tuple[Array, float]:
    """Add the control of least energy that brings the nominal to its final values.

    Steps of Gauss and Newton on the miss, kept only while the miss falls.

    Returns:
        The controls, and the share of the miss that the first step leaves where no bound stops it: 0 where the states
        answer in proportion.
    """
    run = in_told_units(run, fixed, plain, often=False)
    best, (gap, slope) = plain, final_pull(run, fixed, target, plain, often=False)
    norm, left = float(np.linalg.norm(gap)), 0.0
    for k in range(STEERING_STEPS):
        if not np.isfinite(slope).all() or not norm >= STEERING_TOLERANCE:
            break
        wanted = best + _least_change(slope, -gap, run.weights).reshape(best.shape)
        trial = run.clip(wanted)
        following, its_slope = final_pull(run, fixed, target, trial, often=False)
        if k == 0:
            bounded = not np.array_equal(trial, wanted)
            free = final_pull(run, fixed, target, wanted, often=False)[0] if bounded else following
            left = float(np.nan_to_num(np.linalg.norm(free) / norm, nan=np.inf))
        if not np.linalg.norm(following) < norm:
            break
        best, gap, slope, norm = trial, following, its_slope, float(np.linalg.norm(following))
    return best, left


def _least_change(slope: Array, wanted: Array, weights: Array) -> Array:
    """The change of least energy for which slope @ change is what is wanted (least squares where it cannot be)."""
    weighted = slope / weights
    gram = weighted @ slope.T
    if not np.isfinite(gram).all():  # slopes that are numbers, but too large to be squared
        return np.zeros(slope.shape[1])
    return np.asarray(weighted.T @ np.linalg.pinv(gram, rcond=RANK) @ wanted)


def least_energy(
    run: Run, fixed: tuple[int, ...], target: Array, first: Array, plain: Array, steps: int
) -> tuple[Array, float]:
    """Controls near the given ones that reach the final values with the least energy of (u - plain).

    Each step removes the miss to first order and the energy that the final values do not need; it is cut until energy
    and miss together fall, or else removes the miss alone.

    Returns:
        The controls, the miss that is left (in the scales of the states).
    """
    run, weights = in_told_units(run, fixed, plain), run.weights
    u, (gap, slope) = first, final_pull(run, fixed, target, first)
    price = 0.0
    for _ in range(steps):
        if not np.isfinite(slope).all() or not np.isfinite(gap).all():
            break
        v = (u - plain).ravel()
        reaching = _least_change(slope, -gap, weights)
        shedding = _least_change(slope, slope @ v, weights) - v
        gain = float(weights @ (shedding * (2 * v + shedding)))  # of the energy, to first order free of charge
        miss = float(np.linalg.norm(gap))
        if miss < DIGITS and -gain < DIGITS * float(weights @ v**2):
            break
        energy = float(weights @ v**2)
        wanted = (float(weights @ (v + reaching) ** 2) - energy) / max(miss, DIGITS)
        price = max(price, 2.0 * wanted, energy)
        for length, share in LENGTHS:
            trial = run.clip(u + (length * reaching + share * shedding).reshape(u.shape))
            its_gap, its_slope = final_pull(run, fixed, target, trial)
            value = float(weights @ (trial - plain).ravel() ** 2) + price * float(np.linalg.norm(its_gap))
            if np.isfinite(its_slope).all() and value < energy + price * miss:
                u, gap, slope = trial, its_gap, its_slope
                break
        else:
            break
    return u, float(np.linalg.norm(gap))


def track(run: Run, rows: tuple[int, ...], path: Array, plain: Array) -> Array:
    """Controls along which some states follow a path, by least squares with a little energy.

    Args:
        run: the run.
        rows: states that follow.
        path: their values at the nodes, (N + 1, rows).
        plain: controls without energy, and the first ones.

    Returns:
        The controls.
    """
    aims = _aims(run.statement, run.mesh, tuple(range(run.mesh.intervals)), rows, True)
    lengths = np.repeat(np.diff(run.mesh.nodes), len(rows))
    scale = np.sqrt(lengths) / np.tile(run.divisors[list(rows)], run.mesh.intervals)
    goal, root = path[1:].ravel(), np.sqrt(TRACKING_ENERGY * run.weights)

    def residual(u: Array) -> tuple[Array, Array]:
        value, slope = (np.asarray(v.full()) for v in aims(run.start, u.ravel(), run.duration, run.parameters))
        return np.append(scale * (value.ravel() - goal), root * (u - plain).ravel()), np.vstack(
            [scale[:, None] * slope, np.diag(root)]
        )

    u, damping = plain, 1e-3
    r, J = residual(u)
    for _ in range(TRACKING_STEPS):
        if not np.isfinite(J).all() or not np.isfinite(r).all():
            break
        square = J.T @ J
        for _ in range(CUTS):
            step = np.linalg.solve(square + damping * np.diag(run.weights), -J.T @ r)
            trial = run.clip(u + step.reshape(u.shape))
            its_r, its_J = residual(trial)
            if np.isfinite(its_r).all() and its_r @ its_r < r @ r:
                break
            damping *= 10.0
        else:
            break
        small = r @ r - its_r @ its_r < DIGITS * (r @ r)
        u, r, J, damping = trial, its_r, its_J, 0.1 * damping
        if small:
            break
    return u


def resampled(values: Array, old: Mesh, new: Mesh) -> Array:
    """Controls of one mesh on another, interpolated linearly."""
    return interpolated(values, *(control_places(mesh.nodes, mesh.control) for mesh in (old, new)))
