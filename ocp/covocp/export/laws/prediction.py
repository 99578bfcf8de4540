"""Prediction of the estimate between two measurements: piece by piece, each within one interval of the mesh.

At its nodes the control of the nominal jumps or has a kink, and with it the slopes along the nominal may: a rule of
integration that has two points in a step does not see that. So a step ends at the next node where one lies before its
end, and goes on from there. What is predicted to a node is kept until the step is done: the estimate, the covariance P
of its error, and the time that has gone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from covocp.base.expressions import Expr
from covocp.base.linear_solve import COMPILED_SOLVER, linear_solve
from covocp.base.quadrature import GAUSS_NODES, gauss_step
from covocp.export.laws.design import Design
from covocp.export.laws.history import History

# Up to this size linear systems are written out in scalars.
SCALAR_SIZE = 8
# Status of a call that has come to a node, or into a later phase, and is to be followed by another one.
CONTINUE = -1.0


class Piece(NamedTuple):
    """A part of a step: from where to where it goes [s], its length, whether the step goes on after it."""

    begin: Any
    end: Any
    length: Any
    more: Any


def next_piece(tables: History, begin: Expr, time: Expr, valid: Expr) -> Piece:
    """The part of a step up to the next node of the mesh, or to its end.

    A node that is as near to one of its ends as the clock may be wrong counts as that end.

    Args:
        tables: the nominal.
        begin: where it begins [s].
        time: where the step ends [s].
        valid: where it is zero the step has no length.
    """
    slack = tables.margin * tables.duration
    node = tables.node_after(begin + slack)
    more = ca.if_else(valid, node < time - slack, 0.0)
    end = ca.if_else(more, node, time)
    return Piece(begin=begin, end=end, length=ca.if_else(valid, end - begin, 0.0), more=more)


def predicted(design: Design, tables: History, given: tuple[Any, Any, Any], piece: Piece) -> tuple[Any, Any]:
    """Estimate and covariance of its error at the end of a piece, computed in units of typical deviations.

    Args:
        design: the model.
        tables: the nominal.
        given: estimate, covariance of its error and control held since the last step.
        piece: from where to where.
    """
    st, (n, m, _), h = design.statement, design.sizes, piece.length
    units, inverse = ca.diag(ca.DM(design.units)), ca.diag(1.0 / ca.DM(design.units))
    kind = design.symbolic if n <= SCALAR_SIZE else ca.MX
    own, error, du, dt = kind.sym("y", n), kind.sym("E", n, n), kind.sym("held", m), kind.sym("h")
    symbols = [[kind.sym("x", st.nx), kind.sym("u", st.nu), kind.sym("t")] for _ in GAUSS_NODES]
    slopes = [design.model(*three)[:2] for three in symbols]
    points = [dt * (inverse @ F @ units) for F, _ in slopes]
    forcing = [dt * (inverse @ (G @ (du - three[1][:m]))) for (_, G), three in zip(slopes, symbols, strict=True)]
    change, transition = gauss_step(points, forcing, inverse @ own, ca.DM.eye(n), solved)
    value, move = own + units @ change, units @ transition @ inverse
    spread = move @ error @ move.T + dt * design.noise(*symbols[1])
    inputs = [own, error, du, dt, *symbols[0], *symbols[1]]
    function = ca.Function("predict", inputs, [ca.densify(value), ca.densify(spread)])
    at = [piece.begin + c * h for c in GAUSS_NODES]
    nodes = [(now.x, now.u, t) for now, t in zip(map(tables.at, at), at, strict=True)]
    value, spread = function(*given, h, *nodes[0], *nodes[1])
    return value, spread


def solved(matrix: Expr, right: Expr) -> Any:
    """matrix^-1 right: written out in scalars where the expressions are SX, by QR factors otherwise."""
    return ca.solve(matrix, right) if isinstance(matrix, ca.SX) else linear_solve(matrix, right, COMPILED_SOLVER)
