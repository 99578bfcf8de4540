"""The model around a trajectory: its symbols, what moves them in a closed loop, and traces of second derivatives."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.extremal.closed_loop import ClosedLoop
from covocp.extremal.extremal import Extremal
from covocp.statement.interval import model_symbols
from covocp.statement.statement import Statement


def spread_of(loop: ClosedLoop) -> Array:
    """< (d, y)(d, y)' > of the deviation and its estimate at the nodes, (K, 2n, 2n)."""
    with_estimate = loop.Xhat - loop.Z  # <d y'> of the deviation d = y - e
    return np.concatenate(
        [np.dstack([loop.X, with_estimate]), np.dstack([with_estimate.transpose(0, 2, 1), loop.Xhat])], 1
    )


def side(extremal: Extremal, end: int) -> list[Array]:
    """All six arguments of the model at the start (0) or the end (1) of all intervals, a column each."""
    count = extremal.mesh.intervals
    values = [np.asarray(value) for value in extremal.columns()]
    columns = [value[:, end : count + end] for value in values]
    if extremal.mesh.control == "constant":
        columns[1] = values[1][:, :count]
    return columns


class Around(NamedTuple):
    """Symbols z of the augmented state and the controls that are fed back, and the arguments of the model in them."""

    six: list[Any]
    z: Any
    at: tuple[Any, ...]
    value: Any

    @classmethod
    def of(cls, st: Statement, m: int) -> Around:
        """Of m controls that are fed back; `value` is z on the trajectory."""
        n, unknowns = len(st.augmented), st.unknowns
        symbolic: Any = st.symbolic
        x, u, _, t, duration, p = six = model_symbols(st)
        z = symbolic.sym("z", n + m)
        states, own, fed = ca.vertsplit(z, [0, n - unknowns, n, n + m])
        state = ca.vertcat(states, ca.vertsplit(x, [0, n - unknowns, st.nx])[1])
        control = ca.vertcat(fed, ca.vertsplit(u, [0, m, st.nu])[1])
        known, means = ca.vertsplit(p, [0, st.np - unknowns, st.np])
        value = ca.vertcat(ca.vertsplit(x, [0, n - unknowns, st.nx])[0], means, ca.vertsplit(u, [0, m, st.nu])[0])
        return cls(six, z, (state, control, t, duration, ca.vertcat(known, own)), value)


def seen_by(gain: Expr, symbolic: Any) -> Any:
    """z of (d, y): the augmented state, and the controls that the estimate moves."""
    m, n = gain.shape
    return ca.blockcat([[symbolic.eye(n), symbolic.zeros(n, n)], [symbolic.zeros(m, n), -gain]])


def bend(values: Expr, z: Expr, covariance: Expr) -> Any:
    """tr(v_zz Z) of each of some values v, Z being their arguments' covariance."""
    size = z.shape[0]
    unit = ca.DM.eye(size)
    return sum(
        (ca.jtimes(ca.jtimes(values, z, covariance[:, j]), z, type(z)(unit[:, j])) for j in range(size)),
        type(z).zeros(values.shape[0]),
    )
