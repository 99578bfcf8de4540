"""The Hamiltonian along a trajectory, H = L + p' f + tr(P V)  [Schmidt 1971, section 3.2].

The matrices are half-vectors here, so tr(P V) becomes the product of the half-vector of V with its costate (P_ii on the
diagonal, 2 P_ij off it); `matrices.unpack_costate` gives P.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Annotated, Any

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr, slopes_by
from covocp.base.matrices import Array, stacked
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal
from covocp.extremal.hamiltonian_in_numbers import ByControls, by_controls_in_numbers, terms_in_numbers
from covocp.extremal.nodes import mapped
from covocp.extremal.slope_terms import absolute_terms
from covocp.statement.interval import model_symbols
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT


@dataclass(frozen=True, kw_only=True)
class Costates:
    """Costates at the nodes: p (N + 1, nx), those of the half-vectors (N + 1, ne)."""

    state: Annotated[Array, "nodes x"]
    matrices: Annotated[Array, "nodes e"]

    __repr__ = short_repr


def hamiltonian(
    statement: Statement, *, cost: bool = True, matrices: bool = True
) -> Callable[[str, Callable[..., list[Any]]], ca.Function]:
    """Maker of functions of (x, u, e, t, T, p, costate of x, costate of e) built on the Hamiltonian.

    Args:
        statement: the problem.
        cost: whether the running cost is in it; influence functions of terminal conditions are costates without.
        matrices: whether tr(P V) is in it; it is zero for conditions on the nominal alone.

    Returns:
        make(name, select): `select(H, x, u, e, t)` gives the outputs, expressions in the statement's own symbols.
    """
    symbols, (rates, matrix_rates, running) = _rates(statement)
    costate_x, costate_e = symbols[6:]
    value = ca.dot(costate_x, rates) + (ca.dot(costate_e, matrix_rates) if matrices else 0) + (running if cost else 0)

    def make(name: str, select: Callable[..., list[Any]]) -> ca.Function:
        outputs = select(value, *symbols[:4])
        return ca.Function(name, symbols, [ca.densify(v) for v in outputs])

    return make


@lru_cache(maxsize=KEPT)
def _rates(statement: Statement) -> tuple[list[Expr], tuple[Expr, ...]]:
    """Symbols of the arguments of H; rates of the states and of the half-vectors, running cost: written out once."""
    symbolic: Any = statement.symbolic
    symbols = model_symbols(statement)
    costates = [symbolic.sym("lx", statement.nx), symbolic.sym("le", statement.ne)]
    return [*symbols, *costates], tuple(statement.rates(*symbols))


@lru_cache(maxsize=KEPT)
def by_controls(statement: Statement) -> ca.Function:
    """(x, u, e, t, T, p, costate of x, costate of e) -> H_u, H_uu, absolute terms of H_u (`slope_terms`).

    No function is made twice of one statement. H itself, of many more operations, is had from the rates (`terms_of`).
    """
    symbols, parts = _rates(statement)
    rates, weights, u = ca.vertcat(*parts), ca.vertcat(*symbols[6:], 1), symbols[1]
    by_u = ca.jacobian(rates, u)  # of the few rates with a control in them: H itself goes through all
    # dense: a control may be in no rate, and CasADi takes no symmetric Jacobian of what has structural zeros
    scalar = statement.symbolic is ca.SX
    slope = ca.densify(by_u.T @ weights) if scalar else ca.gradient(ca.dot(weights, rates), u)
    bend = ca.jacobian(slope, u, {"symmetric": True}) if statement.nu else ca.DM(0, 0)
    outputs = [slope, bend, absolute_terms(by_u, weights)]
    return ca.Function("by_controls", symbols, [ca.densify(v) for v in outputs])


def by_controls_at(statement: Statement, columns: Sequence[Any], costates: Costates) -> ByControls:
    """What `by_controls` gives at some points: by numbers where that can be had, else by its function.

    Args:
        statement: the problem.
        columns: (x, u, e, t, T, p) of the points, a column each.
        costates: there.
    """
    found = by_controls_in_numbers(statement, columns, costates.state, costates.matrices)
    if found is not None:
        return found
    count = costates.state.shape[0]
    values = _mapped_by_controls(statement, count).evaluated(*columns, costates.state.T, costates.matrices.T)
    slope, bend, sizes = (stacked(value, count) for value in values)
    return ByControls(slope[:, :, 0], bend, sizes[:, :, 0])


@lru_cache(maxsize=KEPT)
def _mapped_by_controls(statement: Statement, count: int) -> Matrices:
    """`by_controls` at so many points."""
    return Matrices(by_controls(statement).map(count))


def duration_slope(statement: Statement) -> ca.Function:
    """(x, u, e, t, T, p, costate of x, costate of e) -> H_T, where rates or cost contain the duration itself."""
    inner = hamiltonian(statement)("value", lambda h, x, u, e, t: [h])
    symbolic: Any = statement.symbolic
    symbols = [symbolic.sym(inner.name_in(i), inner.size1_in(i)) for i in range(inner.n_in())]
    return ca.Function("duration_slope", symbols, [ca.densify(ca.gradient(inner(*symbols), symbols[4]))])


def along(function: ca.Function, extremal: Extremal, costates: Costates) -> list[Array]:
    """A function made by `hamiltonian` at all nodes; each output with the node first."""
    count = extremal.mesh.intervals + 1
    values = Matrices(function.map(count)).evaluated(*extremal.columns(), costates.state.T, costates.matrices.T)
    result = [stacked(value, count) for value in values]
    return [numbers[:, :, 0] if numbers.shape[2] == 1 else numbers for numbers in result]


def terms_of(statement: Statement, columns: Sequence[Any], costates: Costates) -> Array:
    """Terms of H at some points: p_i f_i, the same of the half-vectors, L; (points, nx + ne + 1).

    Args:
        statement: the problem.
        columns: (x, u, e, t, T, p) of the points, a column each.
        costates: there.
    """
    found = terms_in_numbers(statement, columns, costates.state, costates.matrices)
    if found is not None:
        return found
    rates = mapped(statement, "rates", costates.state.shape[0]).evaluated(*columns)
    weighed = [costates.state * rates[0].T, costates.matrices * rates[1].T, rates[2].T]
    return np.concatenate(weighed, axis=1)


def state_slope(statement: Statement, *, cost: bool = True, matrices: bool = True) -> ca.Function:
    """H_x and H_E stacked, as a function made by `hamiltonian`."""
    make = hamiltonian(statement, cost=cost, matrices=matrices)
    return make("slope", lambda h, x, u, e, t: [ca.vertcat(*slopes_by(h, (x, e)))])
