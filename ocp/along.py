"""What is evaluated along a trajectory when a method is done: rates at the nodes, the gain of the filter."""

from __future__ import annotations

from typing import Any

import numpy as np

from covocp.extremal import Extremal
from covocp.matrices import Array, unpack


def rates_along(extremal: Extremal) -> tuple[Array, Array]:
    """Rates of x and e stacked at the nodes, and at the ends of the intervals with the control of the interval."""
    function = extremal.statement.rates.map(extremal.mesh.intervals + 1)

    def stacked(columns: tuple[Any, ...]) -> Array:
        state, matrices, _ = function(*columns)
        return np.vstack([np.asarray(state.full()), np.asarray(matrices.full())]).T

    x, u, *rest = extremal.columns()
    rates = stacked((x, u, *rest))
    if extremal.mesh.control == "linear":
        return rates, rates[1:].copy()
    before = np.hstack([np.asarray(u)[:, :1], np.asarray(u)[:, :-1]])
    return rates, stacked((x, before, *rest))[1:]


def filter_gain(extremal: Extremal) -> Array | None:
    """Kalman gain K = E M' U^-1 at the nodes [Schmidt 2.5-3]."""
    st = extremal.statement
    block = next((b for b in st.matrices if b.estimation), None)
    if block is None or st.measurement is None:
        return None
    x, u, _, t, duration, p = extremal.columns()
    count = extremal.mesh.intervals + 1
    _, jacobian, density = st.measurement.map(count)(x, u, t, duration, p)
    size, m = block.size, density.shape[0]
    M = np.asarray(jacobian.full()).reshape(m, count, size).transpose(1, 0, 2)
    U = np.asarray(density.full()).reshape(m, count, m).transpose(1, 0, 2)
    E = unpack(extremal.trajectory.e[:, block.span], size)
    try:
        return np.asarray(np.linalg.solve(U, M @ E).transpose(0, 2, 1))
    except np.linalg.LinAlgError:  # a density that is singular somewhere: the iterate is kept, without its gain
        return None
