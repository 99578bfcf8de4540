"""The nominal of stiff systems by linearly implicit steps: the Rosenbrock method RODAS, order 4, L-stable.

Explicit steps must be shorter than the fastest time constant of the system although nothing happens that fast; these
need not be. A step solves six linear systems with one matrix and the exact slopes of the rates, and iterates nothing:
so it is as smooth as the rates, and is differentiated like an explicit one [Hairer and Wanner, Solving Ordinary
Differential Equations II, IV.7 and VI.4; there the form without products of the Jacobian with the stages K]:

    (I / (g h) - f_x) K_i = f(x + sum_j A_ij K_j, t + c_i h) + sum_j C_ij K_j / h + d_i h f_t

The control moves in time: f_t is the slope along its course.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca

from covocp.base.expressions import Expr
from covocp.base.linear_solve import COMPILED_SOLVER, linear_solve
from covocp.statement.interval import Interval, one_sided
from covocp.statement.statement import Statement

GAMMA = 0.25
NODES = (0.0, 0.386, 0.21, 0.63, 1.0, 1.0)
SLOPES_IN_TIME = (0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0)
STAGES: tuple[tuple[float, ...], ...] = (
    (),
    (1.544,),
    (0.9466785280815826, 0.2557011698983284),
    (3.314825187068521, 2.896124015972201, 0.9986419139977817),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0),
)
COUPLINGS: tuple[tuple[float, ...], ...] = (
    (),
    (-5.6688,),
    (-2.430093356833875, -0.2063599157091915),
    (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
    (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
    (8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054),
)
# x(c) = (1 - c) x + c (x+ + (1 - c) (sum_j D2_j K_j + c sum_j D3_j K_j)), order 3.
DENSE = (
    (10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823, 1.025137723295662),
    (-0.6762803392801253, 6.087714651680015, 16.43084320892478, 24.76722511418386, -6.594389125716872),
)
# Length [s] in place of none: nothing moves in it.
SHORTEST = 1e-60
# States up to which a step is written out in scalar operations, its linear systems too.
SCALAR_STATES = 6
KEPT = 16


@lru_cache(maxsize=KEPT)
def implicit_step(statement: Statement, fractions: tuple[float, ...]) -> ca.Function:
    """One step of the nominal.

    Args:
        statement: a problem whose nominal does not depend on matrices.
        fractions: where else the state is asked for, shares of the step.

    Returns:
        (x, control at the start, at the end, s, ds, T, p) -> state at the end, states at the fractions
        (nx, len(fractions)).
    """
    nominal = statement.nominal
    if nominal is None:
        raise ValueError("a coupled problem has no separate nominal")
    nx = statement.nx
    scalar = statement.symbolic is ca.SX and nx <= SCALAR_STATES
    kind: Any = ca.SX if scalar else ca.MX
    x, interval = kind.sym("x", nx), Interval.symbols(statement, kind)
    value, c, side = kind.sym("value", nx), kind.sym("c"), kind.sym("side")
    time = interval.duration * (interval.s + (c + side) * interval.ds)
    rate = nominal(value, interval.control(c), time, interval.duration, interval.parameters)[0]
    at = ca.Function("at", [value, c, side, *interval], [rate])
    slopes = ca.Function("slopes", [value, c, side, *interval], [ca.jacobian(rate, value), ca.jacobian(rate, c)])
    h = interval.h
    if statement.instants:  # an interval of no length
        h = ca.if_else(h == 0, SHORTEST, h)
    slope, in_time = slopes(x, 0.0, one_sided(0.0), *interval)
    solve = _solver(ca.DM.eye(nx) / (GAMMA * h) - slope, scalar)
    moves: list[Any] = []
    for node, by_time, stage, coupling in zip(NODES, SLOPES_IN_TIME, STAGES, COUPLINGS, strict=True):
        point = x + sum((a * move for a, move in zip(stage, moves, strict=True)), kind.zeros(nx))
        right = at(point, node, one_sided(node) - node, *interval) + by_time * in_time
        right += sum((a * move for a, move in zip(coupling, moves, strict=True)), kind.zeros(nx)) / h
        moves.append(solve(right))
    end = statement.geometry.like(point + moves[-1], x)
    second, third = (sum(a * move for a, move in zip(row, moves[:5], strict=True)) for row in DENSE)
    inside = [(1 - c) * x + c * (end + (1 - c) * (second + c * third)) for c in fractions]
    return ca.Function("implicit_step", [x, *interval], [end, ca.horzcat(kind(nx, 0), *inside)])


def _solver(matrix: Expr, scalar: bool) -> Any:
    """right -> matrix^-1 right: factorised once where it is written out, else by what C code has too."""
    if not scalar:
        return lambda right: linear_solve(matrix, right, COMPILED_SOLVER)
    unitary, upper = ca.qr(ca.densify(matrix))
    return lambda right: ca.solve(upper, unitary.T @ right)


@lru_cache(maxsize=KEPT)
def implicit_interval(statement: Statement, substeps: int, nodes: tuple[float, ...]) -> ca.Function:
    """The nominal over one control interval.

    Args:
        statement: a problem whose nominal does not depend on matrices.
        substeps: number of steps.
        nodes: of the quadrature of the running cost, shares of a step, all of the same weight.

    Returns:
        (x, control at the start, at the end, s, ds, T, p) -> state at the end, states at the ends of the substeps
        (nx, substeps), integral of the running cost.
    """
    nominal: Any = statement.nominal
    step = implicit_step(statement, nodes)
    kind: Any = ca.SX if step.is_a("SXFunction") else ca.MX
    start, interval = kind.sym("x", statement.nx), Interval.symbols(statement, kind)
    x, states, total = start, [], kind.zeros(1)
    for j in range(substeps):
        part = interval.part(j / substeps, (j + 1) / substeps)
        x, inside = step(x, *part)
        total += sum(nominal(*part.at(c, inside[:, k]))[1] for k, c in enumerate(nodes)) / (substeps * len(nodes))
        states.append(x)
    options = {"is_diff_in": [True] * 3 + [False, False, statement.duration.free, False, False]}  # as explicit steps
    outputs = [x, ca.horzcat(*states), interval.h * total]
    return ca.Function("implicit_interval", [start, *interval], outputs, options)


@lru_cache(maxsize=KEPT)
def between(statement: Statement, fractions: tuple[float, ...]) -> ca.Function:
    """States inside a step, by the step's own polynomial.

    Returns:
        (state at either end, state at the other, *interval) -> states at the fractions of the way from the first,
        (nx, len(fractions)). A step that is turned round (ds < 0) is taken from its later end, as it was.
    """
    count = len(fractions)
    step = implicit_step(statement, (*fractions, *(1.0 - c for c in fractions)))
    kind: Any = ca.SX if step.is_a("SXFunction") else ca.MX
    xa, xb, interval = kind.sym("x", statement.nx), kind.sym("xb", statement.nx), Interval.symbols(statement, kind)
    ahead = interval.ds > 0
    forward = Interval(*(ca.if_else(ahead, a, b) for a, b in zip(interval, interval.turned(), strict=True)))
    inside = step(ca.if_else(ahead, xa, xb), *forward)[1]
    return ca.Function("between", [xa, xb, *interval], [ca.if_else(ahead, inside[:, :count], inside[:, count:])])
