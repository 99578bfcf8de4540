"""Path conditions and bounds on states along a run of the nominal, with their slopes by the controls."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.statement.conditions import beyond
from covocp.statement.interval import model_symbols, repeated
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.ranking import matrices_of_run
from covocp.transcription.shooting import interval_columns
from covocp.transcription.steering import Run
from covocp.transcription.steps import interval_slopes
from covocp.transcription.trajectory import at_nodes

# Share of the largest value of a condition along a run, and of its limits, up to which it counts as met.
MET = 1e-3
# Curvatures below this share of the largest one are none.
ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Course:
    """What the path conditions, and the bounds on states after them, are along a run.

    Args:
        run: of the nominal.
        u: its controls.
        x: its states at the nodes, (K, nx).
        e: half-vectors there, zero where no condition reads any, (K, ne).
        values: of the conditions and the bounded states, (K, rows).
        lower, upper: their limits, (rows,).
    """

    run: Run
    u: Array
    x: Array
    e: Array
    values: Array
    lower: Array
    upper: Array

    __repr__ = short_repr

    @property
    def excess(self) -> Array:
        """How far each lies beyond its limits, negative within them, (K, rows)."""
        return beyond(self.values, self.lower, self.upper)

    @property
    def magnitudes(self) -> Array:
        """Of the conditions along the run and their limits, (rows,)."""
        limits = [np.nan_to_num(np.abs(v), posinf=0.0) for v in (self.lower, self.upper)]
        size = np.maximum.reduce([np.abs(self.values).max(axis=0), *limits])
        return np.where(size > 0, size, 1.0)

    @property
    def violated(self) -> NDArray[np.bool_]:
        """Which conditions are not met at which nodes, (K, rows)."""
        return np.asarray(self.excess > MET * self.magnitudes)

    def points(self, nodes: NDArray[np.intp], x: Array) -> list[Array]:
        """The arguments of the conditions for other states at some nodes, a column each."""
        at = at_nodes(self.u, self.x.shape[0])[nodes]
        times = self.run.mesh.nodes[nodes][None, :] * self.run.duration
        return [x.T, at.T, self.e[nodes].T, times, *repeated(self.run.duration, self.run.parameters, nodes.size)]


def course(run: Run, u: Array, given: Array | None = None) -> Course | None:
    """The conditions along the run of some controls; None where something there has no value.

    Half-vectors may be given, else they are those of the run.
    """
    st, x = run.statement, run.states(u)
    if not np.isfinite(x).all():
        return None
    e = np.zeros((x.shape[0], st.ne)) if given is None else given
    if st.path.uses_matrices and given is None:
        e = np.asarray(matrices_of_run(st, run.mesh)(x.T, u.T, run.duration, run.parameters)[0].full()).T
    rows = st.bounded_states
    lower, upper = st.state_bounds
    bare = Course(
        run=run,
        u=u,
        x=x,
        e=e,
        values=np.zeros((0, 0)),
        lower=np.append(st.path.lower, lower[rows]),
        upper=np.append(st.path.upper, upper[rows]),
    )
    nodes = np.arange(x.shape[0])
    values = np.hstack([st.path.function.map(nodes.size)(*bare.points(nodes, x)).full().T, x[:, rows]])
    return replace(bare, values=values) if np.isfinite(values).all() else None


def slopes_along(along: Course) -> tuple[Array, Array]:
    """Slopes by all controls, node after node: of the states (K, nx, n), of the conditions (K, rows, n)."""
    run, st, x = along.run, along.run.statement, along.x
    count, nu, n = x.shape[0], st.nu, along.u.size
    mesh = run.mesh
    columns = interval_columns(mesh, ca.DM(along.u.T), run.duration, ca.DM(run.parameters))
    of_intervals = interval_slopes(st, mesh.substeps, mesh.step).map(mesh.intervals)
    parts = [np.asarray(v.full()) for v in of_intervals(x[:-1].T, *columns)]
    moved, first, second = (v.reshape(st.nx, count - 1, -1).swapaxes(0, 1) for v in parts)
    linear = mesh.control == "linear"
    states = np.zeros((count, st.nx, n))
    for k in range(count - 1):
        states[k + 1] = moved[k] @ states[k]
        own, following = slice(k * nu, (k + 1) * nu), slice((k + linear) * nu, (k + linear + 1) * nu)
        states[k + 1][:, own] += first[k]
        states[k + 1][:, following] += second[k]
    by_x, by_u = (np.asarray(v.full()) for v in _row_slopes(st).map(count)(*along.points(np.arange(count), x)))
    by_x = by_x.reshape(st.path.size, count, st.nx).swapaxes(0, 1)
    by_u = by_u.reshape(st.path.size, count, nu).swapaxes(0, 1)
    rows = by_x @ states
    for k in range(count):
        j = min(k, along.u.shape[0] - 1)
        rows[k][:, j * nu : (j + 1) * nu] += by_u[k]
    return states, np.concatenate([rows, states[:, st.bounded_states]], axis=1)


@lru_cache(maxsize=KEPT)
def states_read(statement: Statement) -> tuple[tuple[int, ...], ...]:
    """The states that each path condition reads."""
    pattern = statement.path.function.jac_sparsity(0, 0)
    entries = list(zip(*pattern.get_triplet(), strict=True))
    return tuple(tuple(sorted(c for r, c in entries if r == row)) for row in range(statement.path.size))


@lru_cache(maxsize=KEPT)
def reads_time(statement: Statement) -> tuple[bool, ...]:
    """Whether each path condition reads the time, so that what it forbids may move."""
    rows = set(statement.path.function.jac_sparsity(0, 3).row())
    return tuple(row in rows for row in range(statement.path.size))


@lru_cache(maxsize=KEPT)
def curved_rows(statement: Statement) -> tuple[int, ...]:
    """The path conditions, equations apart, that are not linear in the states: what the others allow is convex."""
    symbols = model_symbols(statement)
    by_x, open_ = ca.jacobian(statement.path.function(*symbols), symbols[0]), ~statement.path.equations
    rows = [k for k, read in enumerate(states_read(statement)) if read and open_[k]]
    return tuple(k for k in rows if ca.depends_on(by_x[k, :], symbols[0]))


def bulges(along: Course, row: int) -> bool:
    """Whether a condition is violated so that it may be met on two sides: where it is deepest, it is not convex.

    Nor known to be where it has no curvature, as the walls of a box.
    """
    second = inward(along, row, int(np.argmax(along.excess[:, row])))
    if second is None:
        return True
    values = np.linalg.eigvalsh(second)
    return bool(values.min() < -ROUNDING * np.abs(values).max() or not values.any())


def inward(along: Course, row: int, node: int) -> Array | None:
    """Second slopes of what a condition is beyond its limit at a node, by the states; None where they have no value."""
    st = along.run.statement
    at = along.points(np.array([node]), along.x[[node]])
    second = np.asarray(_row_curvatures(st)(*at).full())[row * st.nx : (row + 1) * st.nx]
    sign = 1.0 if along.values[node, row] > along.upper[row] else -1.0
    return 0.5 * sign * (second + second.T) if np.isfinite(second).all() else None


@lru_cache(maxsize=KEPT)
def row_gradients(statement: Statement) -> ca.Function:
    """The arguments of the path conditions -> their slopes by the states."""
    symbols = model_symbols(statement)
    by_x = ca.densify(ca.jacobian(statement.path.function(*symbols), symbols[0]))
    return ca.Function("row_gradients", symbols, [by_x])


@lru_cache(maxsize=KEPT)
def _row_curvatures(statement: Statement) -> ca.Function:
    """The arguments of the path conditions -> their second slopes by the states, one condition below the other."""
    symbols = model_symbols(statement)
    by_x = ca.jacobian(statement.path.function(*symbols), symbols[0])
    rows = [ca.densify(ca.jacobian(by_x[k, :].T, symbols[0])) for k in range(statement.path.size)]
    return ca.Function("row_curvatures", symbols, [ca.vertcat(*rows)])


@lru_cache(maxsize=KEPT)
def _row_slopes(statement: Statement) -> ca.Function:
    """The arguments of the path conditions -> their slopes by the states and by the controls."""
    symbols = model_symbols(statement)
    values = statement.path.function(*symbols)
    return ca.Function("row_slopes", symbols, [ca.densify(ca.jacobian(values, symbols[i])) for i in (0, 1)])
