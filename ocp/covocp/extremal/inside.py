"""Conditions at instants of the horizon along an extremal: costates and the Hamiltonian jump there."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from covocp.base.expressions import slopes_by
from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal
from covocp.statement.interval import model_symbols
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT


def instant_jumps(extremal: Extremal) -> Array:
    """Slopes by x and e, stacked, of the conditions at instants times their multipliers, (N + 1, nx + ne)."""
    st = extremal.statement
    result = np.zeros((extremal.mesh.intervals + 1, st.nx + st.ne))
    for number, k in enumerate(st.inside.nodes_among(extremal.mesh.nodes)):
        by_x, _, by_e, *_ = _slopes_at(extremal, number, k)
        result[k] += np.concatenate([by_x, by_e])
    return result


def instant_control_slopes(extremal: Extremal) -> Array:
    """The same by the control values, (N + 1 or N, nu)."""
    st, mesh = extremal.statement, extremal.mesh
    result = np.zeros((mesh.control_nodes, st.nu))
    for number, k in enumerate(st.inside.nodes_among(mesh.nodes)):
        result[k] += _slopes_at(extremal, number, k)[1]
    return result


def instant_duration_slope(extremal: Extremal) -> float:
    """The same by the terminal time, with which the instants move."""
    st, mesh = extremal.statement, extremal.mesh
    total = 0.0
    for number, (part, k) in enumerate(zip(st.inside.parts, st.inside.nodes_among(mesh.nodes), strict=True)):
        *_, by_time, by_duration = _slopes_at(extremal, number, k)
        total += part.place * float(by_time[0]) + float(by_duration[0])
    return total


def controlled_nodes(extremal: Extremal) -> list[int]:
    """Nodes at which a condition at an instant contains the control."""
    st, pairs = extremal.statement, []
    for part, k in zip(st.inside.parts, st.inside.nodes_among(extremal.mesh.nodes), strict=True):
        if part.conditions.function.jac_sparsity(0, 1).nnz():
            pairs += [k, k + 1] if part.late else [k]
    return sorted(set(pairs))


def instant_change(extremal: Extremal, states: Array, matrices: Array) -> float:
    """Change of the conditions at instants times their multipliers, with other states and half-vectors at the nodes."""
    st, (x, u, e, *rest) = extremal.statement, [np.asarray(column) for column in extremal.columns()]
    weights, total = st.inside.split(extremal.multipliers.instants), 0.0
    for part, k, own in zip(st.inside.parts, st.inside.nodes_among(extremal.mesh.nodes), weights, strict=True):
        given = [column[:, k] for column in rest]
        before, after = (
            np.asarray(part.conditions.function(y, u[:, k], f, *given).full()).ravel()
            for y, f in ((x[:, k], e[:, k]), (states[k], matrices[k]))
        )
        total += float(own @ (after - before))
    return total


def _slopes_at(extremal: Extremal, number: int, k: int) -> list[Array]:
    """Slopes by x, u, e, t and T of the conditions at one instant times their multipliers, at its node."""
    st = extremal.statement
    weights = st.inside.split(extremal.multipliers.instants)[number]
    columns = [np.asarray(column)[:, k] for column in extremal.columns()]
    return [np.asarray(v.full()).ravel() for v in _slopes(st, number)(*columns, weights)]


@lru_cache(maxsize=4 * KEPT)
def _slopes(statement: Statement, number: int) -> ca.Function:
    """(all six, weights) -> slopes of the weighted conditions at one instant by x, u, e, t and T."""
    symbols, conditions = model_symbols(statement), statement.inside.parts[number].conditions
    weights = type(symbols[0]).sym("weights", conditions.size)
    value = ca.dot(weights, conditions.function(*symbols))
    return ca.Function("slopes", [*symbols, weights], slopes_by(value, symbols[:5]))
