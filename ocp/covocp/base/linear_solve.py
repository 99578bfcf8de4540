"""Linear systems inside CasADi functions: which solver, and what keeps their accuracy."""

from __future__ import annotations

from typing import Any

import casadi as ca

from covocp.base.expressions import Expr

# Fastest for dense systems of this size; COMPILED_SOLVER can be written out as C code.
LINEAR_SOLVER = "lapacklu"
COMPILED_SOLVER = "qr"
# One that becomes scalar operations where a function is expanded.
SCALAR_SOLVER = "symbolicqr"
# With equilibration LAPACK's interface prints every matrix that has a zero row. By default a pivot of the QR's is zero
# below 1e-12, whatever the units.
SOLVER_OPTIONS: dict[str, dict[str, Any]] = {"lapacklu": {"equilibration": False}, "qr": {"eps": 1e-300}}


def linear_solve(matrix: Expr, right: Expr, solver: str) -> Any:
    """matrix^-1 right; where the matrix is singular the evaluation fails, without a word on the terminal.

    CasADi's QR does not exchange rows, so it loses what rows of different units differ by (Mars entry in feet and
    radians: 11 digits of the cost). So they are divided by their norms, on which the result and its slope do not
    depend, and one step of refinement restores the rest (Higham, BIT 31, 1991).
    """
    options = SOLVER_OPTIONS.get(solver, {})
    if solver not in (COMPILED_SOLVER, SCALAR_SOLVER):
        return ca.solve(matrix, right, solver, options)
    norms = ca.sum2(ca.fabs(matrix))
    inverse_norms = ca.diag(1 / norms if solver == SCALAR_SOLVER else ca.stop_diff(1 / norms, 1))
    matrix, right = inverse_norms @ matrix, inverse_norms @ right
    first = ca.solve(matrix, right, solver, options)
    return first + ca.solve(matrix, right - matrix @ first, solver, options)
