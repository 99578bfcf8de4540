"""What residuals are compared with: the size of the cost, and what of it can change."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.extremal.extremal import Extremal
from covocp.extremal.nodes import mapped
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.scales import magnitudes

# What no cost is in any unit, but what is left of zero: of a plant that is at rest.
ZERO_COST = 1e-30
# Least share of its size that counts as variable. Solvers compare costs, whose sums are known to some 1e-13: so much is
# below a residual of 1e-4 of a tenth of it.
RESOLVED = 1e-8


@lru_cache(maxsize=4)
def absolute_cost(extremal: Extremal) -> float:
    """Sum of the sizes of terminal and running cost (trapezoidal, for a scale)."""
    st, t = extremal.statement, extremal.trajectory
    terminal = float(st.terminal(t.x[-1], t.e[-1], t.duration, extremal.parameters))
    function, columns = "rates", extremal.columns()
    if st.nominal is not None and not st.running_uses_matrices:  # without the rates of all matrices
        function, columns = "nominal", (*columns[:2], *columns[3:])
    running = mapped(st, function, extremal.mesh.intervals + 1).evaluated(*columns)[-1]
    return abs(terminal) + abs(float(np.trapezoid(running.ravel(), extremal.time)))


@lru_cache(maxsize=KEPT)
def variable_cost(extremal: Extremal) -> float:
    """The part of the size of the cost that changes, to second order, if all that is in it changes by its magnitude.

    A constant is no part of it, so that none hides what a wrong decision costs. No more than the size itself: what is
    far from zero, as an altitude above the centre of a planet, would change the cost by more than there is of it.
    """
    st, t, p = extremal.statement, extremal.trajectory, extremal.parameters
    scales, count = magnitudes(st, t, p), extremal.mesh.intervals + 1
    units = np.concatenate([scales.x, scales.u, scales.e, [t.duration if st.duration.free else 0.0]])
    x, u, e, time, duration, parameters = extremal.columns()
    moved = np.vstack([x, u, e, np.full(count, t.duration)])
    running, terminal = (
        np.asarray(function.map(count)(moved, time, parameters, np.tile(units[:, None], count)).full()).ravel()
        for function in _changes(st)
    )
    size = absolute_cost(extremal)
    changed = float(np.trapezoid(running, extremal.time)) + float(terminal[-1])
    return float(np.fmin(size, max(changed, RESOLVED * size)))  # its size where it has no second derivative


@lru_cache(maxsize=KEPT)
def _changes(statement: Statement) -> tuple[ca.Function, ca.Function]:
    """(x, u, e and T, time, parameters, units of the first) -> change of the running cost, and of the terminal one."""
    kind: Any = statement.symbolic
    st = statement
    ends = np.cumsum([0, st.nx, st.nu, st.ne, 1]).tolist()
    moved, time, p, units = (kind.sym(f"a{i}", size) for i, size in enumerate((ends[-1], 1, st.np, ends[-1])))
    x, u, e, duration = ca.vertsplit(moved, ends)

    def changed(value: Expr) -> Expr:
        slope = ca.gradient(value, moved)
        return ca.dot(units, ca.fabs(slope) + ca.fabs(ca.jtimes(slope, moved, units)) / 2)

    running, terminal = st.rates(x, u, e, time, duration, p)[2], st.terminal(x, e, duration, p)
    longer = ca.fabs(running) * units[-1] / duration  # a free duration changes all of the integral
    arguments = [moved, time, p, units]
    return (
        ca.Function("running", arguments, [ca.densify(changed(running) + longer)]),
        ca.Function("terminal", arguments, [ca.densify(changed(terminal))]),
    )
