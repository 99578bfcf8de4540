"""Second-order condition: the smallest eigenvalue of the reduced Hessian of the Lagrangian over the controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.extremal import Extremal
from covocp.matrices import Array
from covocp.mesh import Mesh
from covocp.shooting import repeat, single_shooting
from covocp.statement import Statement
from covocp.trajectory import Trajectory

# A constraint whose multiplier is above this share of the largest one is active.
ACTIVE = 1e-5
LANCZOS_STEPS = 30
LANCZOS_LEAST = 8
# Residual of the smallest Ritz value, relative to the largest eigenvalue, at which its sign is known well enough.
LANCZOS_TOLERANCE = 1e-3
DISPLACEMENT = 0.3


@dataclass(frozen=True, kw_only=True)
class Curvature:
    """Extreme eigenvalues of the reduced Hessian in the metric int du' du dt, and the direction of the smallest."""

    value: float
    largest: float
    direction: Array

    def displaced(self, extremal: Extremal, sign: float) -> Trajectory:
        """The trajectory with its control moved along the direction, by the size of the control or of one unit."""
        u = extremal.trajectory.u
        size = max(float(np.sqrt(np.mean(u**2))), DISPLACEMENT)
        moved = u + sign * size * self.direction / np.abs(self.direction).max()
        t = extremal.trajectory
        return Trajectory(x=t.x, u=np.clip(moved, *extremal.statement.control_bounds), e=t.e, duration=t.duration)


def smallest_curvature(extremal: Extremal) -> Curvature | None:
    """Extreme eigenvalues of the reduced Hessian with the terminal time held; None where they cannot be computed.

    The controls are the only variables (states and matrices follow from them); the directions keep, to first order,
    the terminal conditions, the active bounds and the active inequalities.
    """
    st, mesh = extremal.statement, extremal.mesh
    if not st.nu:
        return None
    product, jacobian = _functions(st, mesh, _Active.of(extremal))
    arguments = _arguments(extremal)
    multipliers = extremal.multipliers.controls.ravel()
    free = np.abs(multipliers) <= ACTIVE * max(1e-300, float(np.abs(multipliers).max(initial=0.0)))
    if not free.any():
        return None
    from scipy.linalg import cholesky, solve_triangular  # here: importing scipy takes longer than all of covocp

    root = cholesky(mass_matrix(mesh, extremal.trajectory.duration, st.nu)[np.ix_(free, free)], lower=True)
    u = extremal.trajectory.u.ravel()
    rows = np.asarray(jacobian(u, *arguments).full())[:, free]
    if not np.isfinite(rows).all():
        return None
    basis = _null_space(solve_triangular(root, rows.T, lower=True).T)
    size = basis.shape[1]

    def direction(v: Array) -> Array:
        full = np.zeros(u.size)
        full[free] = solve_triangular(root.T, basis @ v, lower=False)
        return full

    def apply(v: Array) -> Array:
        image = np.asarray(product(u, *arguments, direction(v)).full()).ravel()[free]
        return np.asarray(basis.T @ solve_triangular(root, image, lower=True))

    if size == 0 or not np.isfinite(np.asarray(product(u, *arguments, direction(np.ones(size))).full())).all():
        return None
    values, vectors = lanczos(apply, size)
    return Curvature(
        value=float(values[0]),
        largest=float(np.abs(values).max()),
        direction=direction(vectors[:, 0]).reshape(-1, st.nu),
    )


def held_jacobian(extremal: Extremal) -> Array:
    """Jacobian by the control values, node by node, of what is held: final values, active inequalities and bounds."""
    st, mesh = extremal.statement, extremal.mesh
    _, jacobian = _functions(st, mesh, _Active.of(extremal))
    return np.asarray(jacobian(extremal.trajectory.u.ravel(), *_arguments(extremal)).full())


def mass_matrix(mesh: Mesh, duration: float, count: int) -> Array:
    """The matrix of int du' du dt for the control values, each of `count` entries."""
    h = np.diff(mesh.nodes) * duration
    if mesh.control == "constant":
        matrix = np.diag(h)
    else:
        matrix = np.diag(np.append(h, 0.0) + np.append(0.0, h)) / 3.0 + (np.diag(h, 1) + np.diag(h, -1)) / 6.0
    return np.asarray(np.kron(matrix, np.eye(count)))


def lanczos(apply: Callable[[Array], Array], size: int) -> tuple[Array, Array]:
    """Ritz values (rising) and vectors of a symmetric operator after a few Lanczos steps, fully reorthogonalised.

    An isolated extreme eigenvalue, such as the negative one of a saddle, converges first; inside a cluster the Ritz
    values lie in it, which is all that is asked here (an iteration to a tolerance would never end there).
    """
    from scipy.linalg import eigh_tridiagonal

    steps = min(size, LANCZOS_STEPS)
    basis = np.zeros((steps, size))
    diagonal, beside = np.zeros(steps), np.zeros(steps)
    vector = np.random.default_rng(0).standard_normal(size)
    vector /= np.linalg.norm(vector)
    for j in range(steps):
        basis[j] = vector
        image = apply(vector)
        diagonal[j] = image @ vector
        for _ in range(2):
            image -= basis[: j + 1].T @ (basis[: j + 1] @ image)
        beside[j] = np.linalg.norm(image)
        values, vectors = eigh_tridiagonal(diagonal[: j + 1], beside[:j])
        residual = beside[j] * (np.abs(vectors[-1, 0]) if j >= LANCZOS_LEAST else 1.0)
        tolerance = LANCZOS_TOLERANCE if j >= LANCZOS_LEAST else 1e-10
        if residual <= tolerance * max(float(np.abs(values).max()), 1e-300):
            steps = j + 1
            break
        vector = image / beside[j]
    return np.asarray(values, dtype=float), np.asarray(basis[:steps].T @ vectors, dtype=float)


def _null_space(rows: Array) -> Array:
    """Orthonormal basis of the directions along which no row changes."""
    if not rows.shape[0]:
        return np.eye(rows.shape[1])
    _, values, vectors = np.linalg.svd(rows)
    rank = int(np.sum(values > 1e-10 * max(float(values.max(initial=0.0)), 1e-300)))
    return np.asarray(vectors[rank:].T)


@dataclass(frozen=True, kw_only=True)
class _Active:
    """Positions of what is held: final states and half-vectors, rows of path and end conditions, bounded states."""

    final: tuple[int, ...]
    final_matrices: tuple[int, ...]
    path: tuple[int, ...]
    end: tuple[int, ...]
    states: tuple[int, ...]

    @staticmethod
    def of(extremal: Extremal) -> _Active:
        """What is held along an extremal."""
        _, xf, _, ef = extremal.statement.boundary_values(extremal.parameters)
        multipliers = extremal.multipliers

        def active(values: Array) -> tuple[int, ...]:
            sizes = np.abs(values).ravel()
            return tuple(np.flatnonzero(sizes > ACTIVE * max(1e-300, float(sizes.max(initial=0.0)))).tolist())

        return _Active(
            final=tuple(np.flatnonzero(~np.isnan(xf)).tolist()),
            final_matrices=tuple(np.flatnonzero(~np.isnan(ef)).tolist()),
            path=active(multipliers.path),
            end=active(multipliers.end),
            states=active(multipliers.states),
        )


def _arguments(extremal: Extremal) -> tuple[Any, ...]:
    """The arguments of `_functions` after the control: start, T, parameters, multipliers."""
    t, m = extremal.trajectory, extremal.multipliers
    final_matrices = m.final_matrices.copy()
    final_matrices[extremal.statement.entries(extremal.statement.behind)] = 0.0  # they start there: nothing holds them
    return (
        *(t.x[0], t.e[0], t.duration, extremal.parameters),
        *(m.final, final_matrices, m.end, m.path.T, m.states.T),
    )


@lru_cache(maxsize=4)
def _functions(statement: Statement, mesh: Mesh, active: _Active) -> tuple[ca.Function, ca.Function]:
    """(u, *arguments, v) -> Hessian of the Lagrangian times v; (u, *arguments) -> Jacobian of what is held.

    Both by single shooting from the start of the extremal; `_arguments` gives the arguments.
    """
    st, count = statement, mesh.intervals + 1
    u = ca.MX.sym("u", st.nu * mesh.control_nodes)
    x0, e0, t, p = (ca.MX.sym(name, n) for name, n in (("x0", st.nx), ("e0", st.ne), ("T", 1), ("p", st.np)))
    final, final_e, end = (
        ca.MX.sym(name, n) for name, n in (("final", st.nx), ("final_e", st.ne), ("end", st.end.size))
    )
    path, states = ca.MX.sym("path", st.path.size, count), ca.MX.sym("states", st.nx, count)
    controls = ca.reshape(u, st.nu, mesh.control_nodes)
    x, e, cost = single_shooting(st, mesh, controls, (x0, e0, t, p))
    last_x, last_e = x[:, -1], e[:, -1]
    value = ca.sum2(cost) + st.terminal(last_x, last_e, t, p) + ca.dot(final, last_x) + ca.dot(final_e, last_e)
    value += ca.dot(states, x)
    held = [_entries(last_x, active.final), _entries(last_e, active.final_matrices), _entries(x, active.states)]
    at_nodes = controls if controls.shape[1] == count else ca.horzcat(controls, controls[:, -1])
    time = t * ca.DM(mesh.nodes).T
    for conditions, weights, at, rows_held in (
        (st.path, path, list(range(count)), active.path),
        (st.end, end, [count - 1], active.end),
    ):
        if conditions.size:
            k = len(at)
            columns = (v[:, at] for v in (x, at_nodes, e, time))
            rows = conditions.function.map(k)(*columns, ca.repmat(t, 1, k), repeat(p, k))
            value += ca.dot(weights, rows)
            held.append(_entries(rows, rows_held))
    arguments = [u, x0, e0, t, p, final, final_e, end, path, states]
    direction = ca.MX.sym("v", u.shape[0])
    product = ca.densify(ca.jtimes(ca.gradient(value, u), u, direction))
    kept = ca.densify(ca.jacobian(ca.vertcat(ca.MX(0, 1), *held), u))
    return ca.Function("product", [*arguments, direction], [product]), ca.Function("held", arguments, [kept])


def _entries(values: Any, positions: tuple[int, ...]) -> Any:
    """Some entries of a matrix, in the order of its transpose flattened (time first), as a column."""
    return ca.vec(values)[list(positions)] if positions else ca.MX(0, 1)
