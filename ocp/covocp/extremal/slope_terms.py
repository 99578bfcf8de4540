"""What a slope H_u of the Hamiltonian is compared with: the terms whose sum it is, and its change by the controls."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.statement.statement import Statement


def slope_terms(statement: Statement) -> ca.Function:
    """(x, u, e, t, T, p, costate of x, costate of e) -> |L_u| + sum |p_i f_i,u| + sum |P_ij V_ij,u|, shape (nu, 1).

    At an optimum the terms cancel, also those of the costates among themselves: where the running cost does not contain
    the control (minimum time), L_u = 0 and p' f_u = 0 say nothing about their own sizes.
    """
    symbolic: Any = statement.symbolic
    sizes = (statement.nx, statement.nu, statement.ne, 1, 1, statement.np, statement.nx, statement.ne)
    symbols = [symbolic.sym(f"a{i}", size) for i, size in enumerate(sizes)]
    slopes = ca.jacobian(ca.vertcat(*statement.rates(*symbols[:6])), symbols[1])
    return ca.Function("slope_terms", symbols, [absolute_terms(slopes, ca.vertcat(symbols[6], symbols[7], 1))])


def absolute_terms(slopes: Expr, weights: Expr) -> Any:
    """The same of the slopes of rates and running cost by the controls, (nx + ne + 1, nu), and their weights in H."""
    sizes: Any = ca.fabs(slopes)
    return ca.densify(sizes.T @ ca.fabs(weights))


def slope_sizes(terms: Array, curvature: Array, controls: Array) -> Array:
    """Sizes of H_u at the nodes, (K, nu).

    Where a single term must vanish (x' = u - u^2, the largest x(T)), its size is what a change of the controls by all
    of their magnitude makes of it.

    Args:
        terms: sum of the absolute terms of H_u, (K, nu).
        curvature: H_uu, (K, nu, nu).
        controls: at the nodes, (K, nu).
    """
    change: Array = np.abs(curvature) @ np.abs(controls).max(axis=0, initial=0.0)
    return np.maximum(terms, change)
