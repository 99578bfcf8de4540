"""What is evaluated along a trajectory when a method is done: rates at the nodes, the gain of the filter."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.expressions import Expr
from covocp.base.gains import kalman_gain
from covocp.base.matrices import Array, stacked, unpack
from covocp.extremal.extremal import Extremal
from covocp.statement.interval import one_sided
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT


def rates_along(extremal: Extremal) -> tuple[Array, Array]:
    """Rates of x and e stacked at the starts of the intervals and the end, and at the ends of the intervals.

    Each with the control of its interval and the limit of the time from inside it.
    """
    function = mapped(extremal.statement, "rates", extremal.mesh.intervals + 1)

    def stacked(u: Expr, time: Array) -> Array:
        state, matrices, _ = function.evaluated(x, u, e, time[None, :], *rest)
        return np.vstack([state, matrices]).T

    x, u, e, _, *rest = extremal.columns()
    t = extremal.time
    h = np.diff(t)
    rates = stacked(u, np.append(t[:-1] + one_sided(0.0) * h, t[-1] - one_sided(0.0) * h[-1]))
    if extremal.mesh.control == "linear" and extremal.statement.autonomous:
        return rates, rates[1:].copy()
    before = u if extremal.mesh.control == "linear" else np.hstack([np.asarray(u)[:, :1], np.asarray(u)[:, :-1]])
    return rates, stacked(before, np.append(t[0], t[1:] - one_sided(0.0) * h))[1:]


def filter_gains(extremal: Extremal) -> Array | None:
    """Kalman gain K = E M' U^-1 at the nodes [Schmidt 2.5-3]."""
    st = extremal.statement
    if not st.estimated or st.measurement is None:
        return None
    block = st.estimation
    x, u, _, t, duration, p = extremal.columns()
    count = extremal.mesh.intervals + 1
    _, M, U = (stacked(v, count) for v in mapped(st, "measurement", count).evaluated(x, u, t, duration, p))
    E = unpack(extremal.trajectory.e[:, block.span], block.size)
    try:
        return np.asarray(kalman_gain(E, M, U))
    except np.linalg.LinAlgError:  # a density that is singular somewhere: the iterate is kept, without its gain
        return None


@lru_cache(maxsize=2 * KEPT)
def mapped(statement: Statement, function: str, count: int) -> Matrices:
    """A function of the statement for so many points."""
    return Matrices(getattr(statement, function).map(count))
