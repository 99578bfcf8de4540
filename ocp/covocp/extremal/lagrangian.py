"""The Lagrangian of a discretised problem with every node of the nominal a variable, and its second derivatives.

Each interval is a shooting segment, so nothing passes through the whole horizon but the matrices, which are propagated
along the nodes (where they drive the nominal they are variables like it).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.buffered import Buffered
from covocp.base.matrices import Array, stacked
from covocp.extremal.active_constraints import Entries
from covocp.extremal.along_nodes import Hessian, along_nodes
from covocp.extremal.costates import terminal_costates
from covocp.extremal.extremal import Extremal
from covocp.extremal.hamiltonian import Costates
from covocp.passage.columns import in_columns
from covocp.passage.sweep import passed_by
from covocp.statement.conditions import Columns, Conditions, Inside
from covocp.statement.interval import Interval
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.nlp import terminal_bends
from covocp.transcription.shooting import compiled_steps, interval_columns, matrices_along
from covocp.transcription.staged import interval_transitions, is_staged
from covocp.transcription.steps import full_interval, interval_slopes, nominal_interval

# Rows that hold states alone.
OF_STATES = ("final", "states")


def node_size(statement: Statement) -> int:
    """Entries of a node: the states, and the half-vectors where these drive them."""
    return statement.nx + (statement.ne if statement.coupled else 0)


def arguments(extremal: Extremal, costates: Costates) -> tuple[Any, ...]:
    """The arguments of `second_order`: nodes and controls stacked, half-vectors at 0, T, parameters, multipliers.

    At last zeros, which stand where a tangent is none: CasADi asks what a node does with an argument that is zero by
    its form, in a time that grows with its entries times their number.
    """
    st, t, m = extremal.statement, extremal.trajectory, extremal.multipliers
    z, costate = t.x, costates.state
    if st.coupled:
        z, costate = np.hstack([z, t.e]), np.hstack([costate, costates.matrices])
    final_matrices = m.final_matrices.copy()
    final_matrices[st.entries(st.behind)] = 0.0  # they start there: nothing holds them
    return (
        *(np.concatenate([z.ravel(), t.u.ravel()]), t.e[0], t.duration, extremal.parameters, costate.T),
        *(m.final, final_matrices, m.start, m.end, m.instants, m.path.T, m.states.T, m.matrices.T),
        np.zeros(2),
    )


def _sees_matrices(statement: Statement, held: Entries) -> bool:
    """Whether some of the rows that are held contain entries of matrices."""
    st = statement
    conditions: dict[str, Conditions | Inside] = {"path": st.path, "start": st.start, "end": st.end}
    conditions["instants"] = st.inside
    named = [kind for kind, positions in held if positions]
    return any(kind not in conditions or conditions[kind].uses_matrices for kind in named if kind not in OF_STATES)


@lru_cache(maxsize=4)
def second_order(
    statement: Statement, mesh: Mesh, held: Entries, *, alone: bool = False
) -> tuple[ca.Function | None, ca.Function | None]:
    """The Hessian of the Lagrangian times a direction, and the Jacobian of what is held.

    Args:
        statement: the problem.
        mesh: of it.
        held: rows that are held.
        alone: of what stands at the nodes alone, without intervals and matrices (`Hessian` is of these).

    Returns:
        (*arguments, direction) -> the product, None where it is zero by its form; (*arguments) -> Jacobian of the rows
        held that are no states, None where there are none (`held_rows` has all of them). Directions and columns: the
        nodes one after the other, then the controls.
    """
    st, n = statement, mesh.intervals
    curved = bool(st.path.size or st.start.size or st.end.size or st.inside.size) or terminal_bends(st).states
    if alone and not curved:  # nor is any row held but states
        return None, None
    size = node_size(st)
    split = size * (n + 1)
    w = ca.MX.sym("w", split + st.nu * mesh.control_nodes)
    z, u = ca.reshape(w[:split], size, n + 1), ca.reshape(w[split:], st.nu, mesh.control_nodes)
    lengths = {"e0": st.ne, "T": 1, "p": st.np}
    e0, duration, p = (ca.MX.sym(name, length) for name, length in lengths.items())
    costate = ca.MX.sym("costate", size, n + 1)
    lengths = {"final": st.nx, "final_e": st.ne, "start": st.start.size, "end": st.end.size, "instants": st.inside.size}
    final, final_e, start, end, instants = (ca.MX.sym(name, length) for name, length in lengths.items())
    lengths = {"path": st.path.size, "states": st.nx, "matrices": st.ne}
    path, states, matrices = (ca.MX.sym(name, length, n + 1) for name, length in lengths.items())
    none = ca.MX.sym("none", 2)
    x = z[: st.nx, :]
    if alone:
        e = seen = ca.MX(st.ne, n + 1)
        value = ca.MX(0.0)
    else:
        common = interval_columns(mesh, u, duration, p)
        e, seen, cost, ends = _passed(st, mesh, held, (z, e0, p, none), common)
        value = ca.sum2(cost) + ca.dot(costate[:, 1:], ends - z[:, 1:])
        value += ca.dot(final_e, e[:, -1]) + ca.dot(matrices, e)
    value += st.terminal(x[:, -1], e[:, -1], duration, p) + ca.dot(final, x[:, -1]) + ca.dot(states, x)
    rows = {"final_matrices": seen[:, -1], "matrices": seen}
    at_nodes = u if mesh.control == "linear" else ca.horzcat(u, u[:, -1])
    time = duration * ca.DM(mesh.nodes).T
    for kind, conditions, weights, at in (
        ("path", st.path, path, list(range(n + 1))),
        ("start", st.start, start, [0]),
        ("end", st.end, end, [n]),
    ):
        if conditions.size:
            places = Columns(x[:, at], at_nodes[:, at], e[:, at], time[:, at])
            value += ca.dot(weights, conditions.columns(places, duration, p))
            rows[kind] = conditions.columns(places._replace(matrices=seen[:, at]), duration, p)
    own_rows = []
    for part, k, weights in zip(
        st.inside.parts, st.inside.nodes_among(mesh.nodes), st.inside.split(instants), strict=True
    ):
        places = Columns(x[:, k], at_nodes[:, k], e[:, k], time[:, k])
        value += ca.dot(weights, part.conditions.columns(places, duration, p))
        own_rows.append(part.conditions.columns(places._replace(matrices=seen[:, k]), duration, p))
    rows["instants"] = ca.vertcat(ca.MX(0, 1), *own_rows)
    kept = [ca.vec(rows[kind])[list(positions)] for kind, positions in held if positions and kind not in OF_STATES]
    inputs = [w, e0, duration, p, costate, final, final_e, start, end, instants, path, states, matrices, none]
    function = None
    if not alone or curved:
        direction = ca.MX.sym("direction", w.shape[0])
        gradient = ca.gradient((1 + none[0]) * value, w)
        product = ca.densify(ca.forward([gradient], [w, none], [[direction, ca.repmat(none[1], 2, 1)]])[0][0])
        function = ca.Function("product", [*inputs, direction], [product])
    if not kept:
        return function, None
    return function, ca.Function("held", inputs, [ca.jacobian(ca.vertcat(*kept), w)])


def _passed(
    statement: Statement, mesh: Mesh, held: Entries, at: tuple[Any, ...], common: Interval
) -> tuple[Any, Any, Any, Any]:
    """Half-vectors at the nodes, the same for rows that are held, running costs, and the nodes after the intervals."""
    st, n, (z, e0, p, none) = statement, mesh.intervals, at
    if st.coupled:
        ends, _, cost = full_interval(st, mesh.substeps, mesh.step).map(n)(z[:, :-1], *common)
        return z[st.nx :, :], z[st.nx :, :], cost, ends
    x = z[: st.nx, :]
    advance = in_columns(st, nominal_interval(st, mesh.substeps, mesh.step), n)
    ends, fine, cost = advance(z[:, :-1], *common)
    e = seen = ca.MX(0, n + 1)
    if st.matrices:
        passing = (st, mesh, x, fine, common, p, st.started(x[:, 0], p, e0)[1] + none[0])
        e, matrix_cost = matrices_along(*passing, passage=passed_by)
        seen = matrices_along(*passing)[0] if compiled_steps(mesh) and _sees_matrices(st, held) else e
        cost = cost + matrix_cost
    return e, seen, cost, ends


class Product(NamedTuple):
    """A product with directions, and the slopes of the rows that are held.

    Attributes:
        applied: direction -> the product, NaN where it fails.
        jacobian: that `second_order` gives.
        given: its arguments.
        alone: whether the library has all of it.
    """

    applied: Callable[[Array], Array]
    jacobian: ca.Function | None
    given: tuple[Any, ...]
    alone: bool


def product_along(extremal: Extremal, costates: Costates, held: Entries) -> Product:
    """The Hessian of the Lagrangian along an extremal, times a direction.

    Args:
        extremal: along which.
        costates: at its nodes.
        held: rows that are held.

    Returns:
        The product, and the Jacobian of the rows.
    """
    st, given, numbers = extremal.statement, arguments(extremal, costates), _hessian(extremal, costates, held)
    product, jacobian = second_order(st, extremal.mesh, held, alone=numbers is not None)
    if numbers is None:
        assert product is not None
        return Product(_applied(product, given), jacobian, given, alone=False)
    others = None if product is None else _applied(product, given)
    shape, split = extremal.trajectory.u.shape, extremal.trajectory.x.size

    def product_with(direction: Array) -> Array:
        by_x, by_u = numbers(direction[:split].reshape(-1, st.nx), direction[split:].reshape(shape))
        found = np.concatenate([by_x.ravel(), by_u.ravel()])
        return found if others is None else found + others(direction)

    return Product(product_with, jacobian, given, alone=others is None)


def _applied(product: ca.Function, given: tuple[Any, ...]) -> Callable[[Array], Array]:
    """A product with a direction, its other arguments given: NaN where it fails."""
    call, known = Buffered(product), [np.asarray(value, dtype=float).ravel(order="F") for value in given]

    def product_with(direction: Array) -> Array:
        outputs = call(*known, direction)
        return np.full(direction.shape, np.nan) if outputs is None else outputs[0]

    return product_with


def _hessian(extremal: Extremal, costates: Costates, held: Entries) -> Hessian | None:
    """The part of the Hessian of the Lagrangian that `second_order` leaves out where it stands alone.

    Args:
        extremal: along which.
        costates: at its nodes.
        held: rows that are held.

    Returns:
        None where the library cannot take it, or where it is no weighed sum of the half-vectors: not by itself.
    """
    st, m = extremal.statement, extremal.multipliers
    conditions: list[Conditions | Inside] = [st.path, st.start, st.end, st.inside]
    seen = any(kind.uses_matrices for kind in conditions if kind.size) or _sees_matrices(st, held)
    if seen or st.tied is not None:
        return None
    weights, along = m.matrices.copy(), along_nodes(st, extremal.mesh, extremal.trajectory, extremal.parameters)
    if along is None or not along.twice:
        return None
    if st.ne:
        if terminal_bends(st).matrices:
            return None
        weights[-1] += terminal_costates(extremal)[1]
    return Hessian(along, weights, costates.state[1:])


def held_rows(jacobian: ca.Function | None, held: Entries, extremal: Extremal, given: tuple[Any, ...]) -> Array:
    """Slopes of the rows held by nodes and controls one after the other, (rows, entries of both).

    Args:
        jacobian: that `second_order` gives of them.
        held: the rows.
        extremal: at whose nodes they are.
        given: arguments of the former.
    """
    st, n = extremal.statement, extremal.mesh.intervals
    size = node_size(st)
    result = np.zeros((sum(len(positions) for _, positions in held), size * (n + 1) + extremal.trajectory.u.size))
    others = np.zeros((0, result.shape[1])) if jacobian is None else np.asarray(jacobian(*given).full())
    first, taken = 0, 0
    for kind, positions in held:
        at, count = first + np.arange(len(positions)), len(positions)
        if kind in OF_STATES:
            node, state = np.divmod(np.array(positions, dtype=np.intp), st.nx) if kind == "states" else (n, positions)
            result[at, np.asarray(node * size + np.asarray(state, dtype=np.intp))] = 1.0
        else:
            result[at], taken = others[taken : taken + count], taken + count
        first += count
    return result


def slopes_of_intervals(extremal: Extremal) -> tuple[Array, Array, Array]:
    """Slopes of the node after each interval by the node before it and by the controls at its two ends.

    Returns:
        (N, n, n), (N, n, nu), (N, n, nu); of constant controls the last two are shares of the same control.
    """
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    along = along_nodes(st, mesh, t, extremal.parameters)
    if along is not None:
        return along.transitions
    z = t.x if not st.coupled else np.hstack([t.x, t.e])
    common = interval_columns(mesh, ca.DM(t.u.T), t.duration, ca.DM(extremal.parameters))
    if is_staged(st, mesh):
        return interval_transitions(st, mesh, z[:-1].T, common)
    values = interval_slopes(st, mesh.substeps, mesh.step).map(mesh.intervals)(z[:-1].T, *common)
    A, first, last = (stacked(v, mesh.intervals) for v in values)
    return A, first, last
