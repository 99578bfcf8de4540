"""The Hamiltonian along a trajectory, H = L + p' f + tr(P V)  [Schmidt 1971, section 3.2].

The matrices are half-vectors here, so tr(P V) becomes the product of the half-vector of V with its costate (P_ii on the
diagonal, 2 P_ij off it); `matrices.unpack_costate` gives P.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

import casadi as ca

from covocp.base.buffered import Matrices
from covocp.base.expressions import Expr, slopes_by
from covocp.base.matrices import Array, stacked
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal
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
    symbolic: Any = statement.symbolic
    sizes = {"x": statement.nx, "u": statement.nu, "e": statement.ne, "t": 1, "T": 1, "p": statement.np}
    symbols = {name: symbolic.sym(name, size) for name, size in sizes.items()}
    costate_x, costate_e = symbolic.sym("lx", statement.nx), symbolic.sym("le", statement.ne)
    rates, matrix_rates, running = statement.rates(*symbols.values())
    value = ca.dot(costate_x, rates) + (ca.dot(costate_e, matrix_rates) if matrices else 0) + (running if cost else 0)

    def make(name: str, select: Callable[..., list[Any]]) -> ca.Function:
        outputs = select(value, symbols["x"], symbols["u"], symbols["e"], symbols["t"])
        return ca.Function(name, [*symbols.values(), costate_x, costate_e], [ca.densify(v) for v in outputs])

    return make


@lru_cache(maxsize=KEPT)
def by_controls(statement: Statement) -> ca.Function:
    """(x, u, e, t, T, p, costate of x, costate of e) -> H, H_u, H_uu, absolute terms of H_u (`slope_terms`).

    No function is made twice of one statement.
    """
    symbols, rates, weights = _terms(statement)
    h, u = ca.dot(weights, rates), symbols[1]
    by_u = ca.jacobian(rates, u)  # of the few rates with a control in them: H itself goes through all
    slope = by_u.T @ weights if statement.symbolic is ca.SX else ca.gradient(h, u)
    bend = ca.jacobian(slope, u, {"symmetric": True}) if statement.nu else ca.DM(0, 0)
    outputs = [h, slope, bend, absolute_terms(by_u, weights)]
    return ca.Function("by_controls", symbols, [ca.densify(v) for v in outputs])


def _terms(statement: Statement) -> tuple[list[Expr], Expr, Expr]:
    """Symbols of the arguments of H, and the rates and running cost whose products with weights are its terms."""
    symbolic: Any = statement.symbolic
    symbols = model_symbols(statement)
    costates = [symbolic.sym("lx", statement.nx), symbolic.sym("le", statement.ne)]
    return [*symbols, *costates], ca.vertcat(*statement.rates(*symbols)), ca.vertcat(*costates, 1)


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


def state_slope(statement: Statement, *, cost: bool = True, matrices: bool = True) -> ca.Function:
    """H_x and H_E stacked, as a function made by `hamiltonian`."""
    make = hamiltonian(statement, cost=cost, matrices=matrices)
    return make("slope", lambda h, x, u, e, t: [ca.vertcat(*slopes_by(h, (x, e)))])
