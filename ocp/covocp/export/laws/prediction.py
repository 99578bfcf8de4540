"""Prediction of the estimate between two measurements: piece by piece, each within one interval of the mesh.

At its nodes the control of the nominal jumps or has a kink, and with it the slopes along the nominal may: a rule of
integration that has two points in a step does not see that. So a step ends at the next node where one lies before its
end, and goes on from there; and before it where modes are faster than that (`paces`). What is predicted to a node is
kept until the step is done: the estimate, the integral of what is to be measured, the covariance of the errors of both,
and the time that has gone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from covocp.base.expressions import Expr
from covocp.base.linear_solve import COMPILED_SOLVER, linear_solve
from covocp.base.quadrature import GAP, GAUSS_NODES, gauss_stages
from covocp.export.laws.design import Design
from covocp.export.laws.history import History
from covocp.export.laws.paces import first_share, paces

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


def next_piece(design: Design, tables: History, begin: Expr, time: Expr, valid: Expr) -> Piece:
    """The part of a step up to the next node of the mesh, or to its end; a share of it where modes are fast.

    A node that is as near to one of its ends as the clock may be wrong counts as that end.

    Args:
        design: the model.
        tables: the nominal.
        begin: where it begins [s].
        time: where the step ends [s].
        valid: where it is zero the step has no length.
    """
    slack = tables.margin * tables.duration
    node = tables.node_after(begin + slack)
    more = ca.if_else(valid, node < time - slack, 0.0)
    end = ca.if_else(more, node, time)
    own = paces(design, tables)
    if own.matter:
        part = first_share(own.at(tables.interval(begin + slack)), end - begin, 2.0 * slack)
        more, end = ca.if_else(valid, ca.logic_or(more, part < 1.0), 0.0), begin + part * (end - begin)
    return Piece(begin=begin, end=end, length=ca.if_else(valid, end - begin, 0.0), more=more)


class Ahead(NamedTuple):
    """What is carried through a step; n: rows of the estimate, a: values that are measured all the time.

    estimate: (n,). expected: integral of what is to be measured since the last measurement, (a,). spread: covariance of
    the errors of both, that of the integral with the noise of the measurement, (n + a, n + a).
    """

    estimate: Any
    expected: Any
    spread: Any


def predicted(design: Design, tables: History, ahead: Ahead, held: Expr, piece: Piece) -> Ahead:
    """What a piece makes of it, computed in units of typical deviations.

    The covariance is that of the Gauss method for P' = A P + P A' + diag(Q, U), A of deviation and integral:
    transitions from the start, and from the two nodes, where the noise enters. It is semidefinite at any length, and
    keeps what is stationary.

    Args:
        design: the model.
        tables: the nominal.
        ahead: where the piece begins.
        held: control since the last step.
        piece: from where to where.
    """
    st, (n, m, _), a, h = design.statement, design.sizes, design.always, piece.length
    units, inverse = ca.diag(ca.DM(design.units)), ca.diag(1.0 / ca.DM(design.units))
    kind = design.symbolic if n <= SCALAR_SIZE else ca.MX
    own, seen, error = kind.sym("y", n), kind.sym("a", a), kind.sym("E", n + a, n + a)
    du, dt = kind.sym("held", m), kind.sym("h")
    symbols = [[kind.sym("x", st.nx), kind.sym("u", st.nu), kind.sym("t")] for _ in GAUSS_NODES]
    models = [design.model(*three) for three in symbols]
    moved = [du - three[1][:m] for three in symbols]
    points = [dt * (inverse @ at.F @ units) for at in models]
    forcing = [dt * (inverse @ (at.G @ by)) for at, by in zip(models, moved, strict=True)]
    # beside y, from rest, what a unit value of h f at the second node alone makes
    begun = ca.horzcat(inverse @ own, kind(n, n))
    forcing = [ca.horzcat(forcing[0], kind(n, n)), ca.horzcat(forcing[1], ca.DM.eye(n))]
    (*values, change), (*moves, turn) = gauss_stages(points, forcing, begun, ca.DM.eye(n), solved)
    late = [value[:, 1:] for value in (*values, change)]
    early = [response + GAP * move for response, move in zip(late, (*moves, turn), strict=True)]
    rows = [at.M[:a, :] for at in models]
    means = [
        at.h[:a, 0] + M @ (units @ y[:, 0]) + at.H[:a, :] @ by
        for at, M, y, by in zip(models, rows, values, moved, strict=True)
    ]
    slope = dt / 2 * sum((M @ units @ move for M, move in zip(rows, moves, strict=True)), kind(a, n))
    transition = ca.blockcat(ca.DM.eye(n) + units @ turn @ inverse, kind(n, a), slope @ inverse, ca.DM.eye(a))
    noise = ca.diagcat(kind(n, n), dt / 2 * sum((at.U[:a, :a] for at in models), kind(a, a)))
    for (*inside, after), point in zip((early, late), symbols, strict=True):
        seen_of_it = dt / 2 * sum((M @ units @ value for M, value in zip(rows, inside, strict=True)), kind(a, n))
        response = ca.vertcat(units @ after, seen_of_it) @ inverse
        noise += 2 * dt * (response @ design.noise(*point) @ response.T)
    outputs = [
        own + units @ change[:, 0],
        seen + dt / 2 * (means[0] + means[1]),
        transition @ error @ transition.T + noise,
    ]
    inputs = [own, seen, error, du, dt, *symbols[0], *symbols[1]]
    function = ca.Function("predict", inputs, [ca.densify(value) for value in outputs])
    at = [piece.begin + c * h for c in GAUSS_NODES]
    nodes = [(now.x, now.u, t) for now, t in zip(map(tables.at, at), at, strict=True)]
    return Ahead(*function(*ahead, held, h, *nodes[0], *nodes[1]))


def solved(matrix: Expr, right: Expr) -> Any:
    """matrix^-1 right: written out in scalars where the expressions are SX, by QR factors otherwise."""
    return ca.solve(matrix, right) if isinstance(matrix, ca.SX) else linear_solve(matrix, right, COMPILED_SOLVER)
