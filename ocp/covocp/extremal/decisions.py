"""The necessary condition of decisions: int H_d dt + slopes of the end terms + multipliers of bounds = 0."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.residuals import VANISHING
from covocp.base.short_repr import short_repr
from covocp.extremal.cost_sizes import variable_cost
from covocp.extremal.costates import discrete_costates
from covocp.extremal.extremal import Extremal
from covocp.extremal.fine_mesh import refined
from covocp.extremal.hamiltonian import Costates
from covocp.extremal.inside import instant_jumps
from covocp.statement.interval import model_symbols
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.scales import magnitudes


@dataclass(frozen=True, kw_only=True, eq=False)
class DecisionSlopes:
    """Slopes of the Lagrangian by the decisions, an entry for each.

    Attributes:
        total: int H_d dt and all end terms, with the multipliers of the bounds.
        size: sum of the absolute terms.
        floor: a tenth of what of the cost is variable by the magnitude of the decision: what has no terms, as in a
            phase that does not use the decision, leaves a slope of roundoff, which is the whole of its size.
    """

    total: Array
    size: Array
    floor: Array

    __repr__ = short_repr

    @property
    def relative(self) -> float:
        """The largest relative to its terms, or to the floor where that is more."""
        size = np.maximum(np.maximum(self.size, self.floor), np.finfo(float).tiny)
        return float((np.abs(self.total) / size).max(initial=0.0))


def decision_slopes(
    extremal: Extremal, costates: Costates, given: Array | None = None, others: float = 0.0
) -> DecisionSlopes:
    """Slopes of the Lagrangian by the decisions along an extremal, by its costates.

    Args:
        extremal: the solution.
        costates: of its multipliers, at the nodes.
        given: multipliers of initial states that an earlier statement of a chain gives, (nx,).
        others: what of the cost of the rest of a chain is variable.
    """
    if extremal.mesh.points > 1:  # costates jump inside the intervals
        extremal = refined(extremal)
        costates = discrete_costates(extremal)[0]
    rows = extremal.statement.decisions
    at_start = start_slopes(extremal, costates)[rows]
    total = at_start + _mismatches(extremal, costates)[rows]
    total = total if given is None else total + given[rows]
    cost = VANISHING * (variable_cost(extremal) + others)
    return DecisionSlopes(total=total, size=_sizes(extremal, costates), floor=cost / _magnitudes(extremal))


def _magnitudes(extremal: Extremal) -> Array:
    """Of the decisions: the larger one of where they are and of what their guesses and bounds say."""
    st, t = extremal.statement, extremal.trajectory
    stated = magnitudes(st, t, extremal.parameters).x[st.decisions]
    return np.maximum(np.abs(t.x[0, st.decisions]), stated)


def start_slopes(extremal: Extremal, costates: Costates) -> Array:
    """Slopes of the Lagrangian by the initial state: costates, initial conditions, the matrices that follow it."""
    st, t, m = extremal.statement, extremal.trajectory, extremal.multipliers
    by_start, by_matrices = _start_terms(st)(
        t.x[0], extremal.controls[0], t.e[0], t.duration, extremal.parameters, m.start, costates.matrices[0]
    )
    return np.asarray(costates.state[0] + by_start.full().ravel() + by_matrices.full().ravel())


def with_tied_multipliers(extremal: Extremal) -> Extremal:
    """The extremal with the multipliers of initial states that decisions give: what makes their slopes vanish."""
    st = extremal.statement
    if st.tied is None or not st.tied.states:
        return extremal
    tied = list(st.tied.states)
    m, own = extremal.multipliers, st.start.size - len(tied)
    start = np.concatenate([m.start[:own], np.zeros(len(tied))])
    bare = replace(extremal, multipliers=replace(m, start=start))
    start = start.copy()
    start[own:] = -start_slopes(bare, discrete_costates(bare)[0])[tied]
    return replace(extremal, multipliers=replace(m, start=start))


@lru_cache(maxsize=KEPT)
def _start_terms(statement: Statement) -> ca.Function:
    """(x, u, e at 0, T, p, multipliers of initial conditions, costates of e) -> their slopes by x, by it through e."""
    st = statement
    x, u, e = (ca.MX.sym(name, size) for name, size in (("x", st.nx), ("u", st.nu), ("e", st.ne)))
    duration, p = ca.MX.sym("T"), ca.MX.sym("p", st.np)
    weights, costate = ca.MX.sym("m", st.start.size), ca.MX.sym("P", st.ne)
    value = ca.dot(weights, st.start.function(x, u, e, 0.0, duration, p)) if st.start.size else ca.MX(0)
    through = ca.dot(costate, st.started(x, p, ca.DM.zeros(st.ne))[1]) if st.ne else ca.MX(0)
    slopes = [ca.densify(ca.gradient(v, x)) for v in (value, through)]
    return ca.Function("start_terms", [x, u, e, duration, p, weights, costate], slopes)


def _mismatches(extremal: Extremal, costates: Costates) -> Array:
    """What the costates jump by where shooting segments meet: a decision that is not yet one number is not the best."""
    mesh, gaps, nx = extremal.mesh, extremal.multipliers.gaps, extremal.statement.nx
    if gaps.shape[0] != len(mesh.segments):
        return np.zeros(nx)
    inner = list(mesh.starts[1:-1])
    return np.asarray((costates.state[inner] - gaps[:-1, :nx]).sum(axis=0))


def _sizes(extremal: Extremal, costates: Costates) -> Array:
    """Sums of the absolute terms of int |H_d| dt and of the ends."""
    st, rows = extremal.statement, extremal.statement.decisions
    count = extremal.mesh.intervals + 1
    values = _terms(st).map(count)(*extremal.columns(), costates.state.T, costates.matrices.T)
    along = np.trapezoid(np.asarray(values.full())[rows], extremal.time, axis=1)
    matrices_alone = Costates(state=np.zeros_like(costates.state), matrices=costates.matrices)
    first = np.abs(start_slopes(extremal, matrices_alone))[rows]
    at_instants = np.abs(instant_jumps(extremal)[:, rows]).sum(axis=0)
    return np.asarray(along + np.abs(costates.state[-1, rows]) + first + at_instants)


@lru_cache(maxsize=KEPT)
def _terms(statement: Statement) -> ca.Function:
    """(six arguments, costates) -> sum of the absolute terms of H_x: of the running cost, and of each rate."""
    symbols = model_symbols(statement)
    symbolic = type(symbols[0])
    costate_x, costate_e = symbolic.sym("lx", statement.nx), symbolic.sym("le", statement.ne)
    rates, matrix_rates, running = statement.rates(*symbols)
    parts = [ca.jacobian(running, symbols[0])]
    for costate, rate in ((costate_x, rates), (costate_e, matrix_rates)):
        if rate.shape[0]:
            slope = ca.jacobian(rate, symbols[0])
            parts.append(ca.repmat(costate, 1, statement.nx) * slope)
    total = ca.sum1(ca.vertcat(*(ca.fabs(part) for part in parts)))
    return ca.Function("terms", [*symbols, costate_x, costate_e], [ca.densify(total.T)])
