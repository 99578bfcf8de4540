"""One step of covariances along a nominal whose ends are known: gauss and strang, and what one gains as another loses.

Covariance steps for V = F E + E F' + Q - E W E, by *step matrices* that do not depend on E:

- gauss: two-stage Gauss method for X' = -F'X + W Y, Y' = Q X + F Y, E = Y X^-1. Symplectic, order 4, positive
  semidefinite at any step size (Dieci and Eirola, Numer. Math. 67, 1994). A 2n x 2n matrix D with
  E+ = (D21 + D22 E)(D11 + D12 E)^-1.
- strang: half a measurement update, half the noise, transition with the tangent of the Runge-Kutta step, half the
  noise, half a measurement update. Order 2, positive semidefinite at any step size; the update with G = (I + E W)^-1
  in Joseph's form, E+ = G E G' + G (E W E) G'. In roundoff it ends where a step measures 1e10 times better than the
  prior, eps (h E W) near 1e-6: there gauss is the one to use. Its matrices side by side, n x 5n: transition, noise and
  information of the first half, noise and information of the second.

Their last arguments are those of an `Interval`, as of all steps.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr, times
from covocp.base.linear_solve import LINEAR_SOLVER, SCALAR_SOLVER, linear_solve
from covocp.base.matrices import pack_symbolic, unpack_symbolic
from covocp.base.quadrature import GAUSS_NODES, gauss_arrivals, gauss_matrix, hermite, riccati_step
from covocp.passage.shape import Pattern
from covocp.statement.interval import Interval
from covocp.statement.statement import Statement
from covocp.transcription.rosenbrock import between

StepKind = Literal["gauss", "strang", "rk4", "rodas"]

# Rows of a covariance up to which a step of matrices that feed each other is written out in scalars: its exact second
# derivatives take 5 ms on 40 intervals with two rows, with calls of linear solvers 31; with three rows 22 and 72.
SCALAR_ROWS = 4
# The same of matrices that do not: a loop with two rows, read at instants, is designed in 1.2 s, with calls of linear
# solvers in 2.2; with three rows in as long, but with 500 MB more.
SCALAR_ROWS_ALONE = 2

# Functions of the last statements are kept: transcription, costates and checks all ask for the same ones.
KEPT = 16


def slopes_wanted(statement: Statement, count: int) -> dict[str, Any]:
    """Option of a function of `count` values and the interval: what it is never differentiated by.

    The adjoint of a step is the dearest function of all; slopes by the mesh and the parameters would add a third.
    """
    return {"is_diff_in": [True] * (count + 2) + [False, False, statement.duration.free, False, False]}


@lru_cache(maxsize=KEPT)
def step_matrix(statement: Statement, index: int, step: StepKind, solver: str = LINEAR_SOLVER) -> ca.Function:
    """The step matrix of one matrix state over one substep, given the nominal at both ends of it.

    Returns:
        (xa, xb, *interval of the substep) -> D (2n, 2n) of gauss, parts of strang (n, 5n); they do not depend on E.
    """
    size = statement.matrices[index].size
    xa, xb = ca.MX.sym("xa", statement.nx), ca.MX.sym("xb", statement.nx)
    interval = Interval.symbols(statement, ca.MX)
    if step == "strang":
        value = ca.horzcat(*_strang_parts(statement, index)(xa, xb, *interval))
    else:
        value = gauss_matrix(gauss_points(statement, index, step)(xa, xb, *interval), size, solver)
    return ca.Function("step_matrix", [xa, xb, *interval], [value], slopes_wanted(statement, 2))


@lru_cache(maxsize=KEPT)
def gauss_points(statement: Statement, index: int, step: StepKind) -> ca.Function:
    """h H at the two Gauss points, H = [-F' W; Q F], the nominal there by its own polynomial (`between`)."""
    form = _form(statement, index)
    inside = between(statement, GAUSS_NODES) if step == "rodas" else None
    symbolic: Any = statement.symbolic if inside is None or inside.is_a("SXFunction") else ca.MX
    xa, xb = symbolic.sym("xa", statement.nx), symbolic.sym("xb", statement.nx)
    interval = Interval.symbols(statement, symbolic)
    known = _hermite_points(statement, xa, xb, interval) if inside is None else inside(xa, xb, *interval)
    points = []
    for j, c in enumerate(GAUSS_NODES):
        drift, noise, information = form(*interval.at(c, known[:, j]))
        points.append(times(interval.h, ca.blockcat([[-drift.T, information], [noise, drift]])))
    return ca.Function("gauss_points", [xa, xb, *interval], points, slopes_wanted(statement, 2))


@lru_cache(maxsize=KEPT)
def gauss_entries(statement: Statement, index: int, step: StepKind) -> tuple[ca.Function, Pattern]:
    """`gauss_points` by what of h H may be nonzero at one of the points, a column for each; rows and columns of it."""
    return entries_of_points(gauss_points(statement, index, step), slopes_wanted(statement, 2))


def entries_of_points(function: ca.Function, options: dict[str, Any] | None = None) -> tuple[ca.Function, Pattern]:
    """A function to h H at two points by what may be nonzero at one of them: a column each, and rows and columns."""
    symbols: Any = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
    pattern = function.sparsity_out(0) + function.sparsity_out(1)
    column = ca.Sparsity.dense(pattern.nnz(), 1)
    points = [ca.sparsity_cast(ca.project(point, pattern), column) for point in function.call(symbols)]
    rows, columns = pattern.get_triplet()
    own = ca.Function("gauss_entries", symbols, points, options or {})
    return own, (tuple(rows), tuple(columns))


def _hermite_points(statement: Statement, xa: Expr, xb: Expr, interval: Interval) -> Expr:
    """The nominal at the Gauss points of a step, by a cubic Hermite polynomial between its ends."""
    fa, fb = (times(interval.h, state_slope(statement, *interval.at(c, x))) for c, x in ((0.0, xa), (1.0, xb)))
    return ca.horzcat(*(hermite(xa, xb, fa, fb, c) for c in GAUSS_NODES))


@lru_cache(maxsize=KEPT)
def _strang_parts(statement: Statement, index: int) -> ca.Function:
    """Transition matrix of the Runge-Kutta step, noise and information at both ends (times h/2)."""
    form = _form(statement, index)
    symbolic: Any = statement.symbolic
    size = statement.matrices[index].size
    xa, xb = symbolic.sym("xa", statement.nx), symbolic.sym("xb", statement.nx)
    interval = Interval.symbols(statement)

    def rate(value: Expr, c: float) -> Expr:
        x, transition = value[: statement.nx], ca.reshape(value[statement.nx :], size, size)
        moved, drift = state_slope(statement, *interval.at(c, x)), form(*interval.at(c, x))[0]
        return ca.vertcat(moved, ca.vec(drift @ transition))

    after = statement.geometry.step(rate, ca.vertcat(xa, ca.vec(ca.DM.eye(size))), interval.h)
    ends = [form(*interval.at(c, x))[1:] for c, x in ((0.0, xa), (1.0, xb))]
    halves = [interval.h / 2 * entry for end in ends for entry in end]
    dense = [ca.densify(entry) for entry in (ca.reshape(after[statement.nx :], size, size), *halves)]
    return ca.Function("strang_parts", [xa, xb, *interval], dense, slopes_wanted(statement, 2))


def _form(statement: Statement, index: int) -> ca.Function:
    form = statement.riccati[index]
    if form is None:
        raise ValueError("the rate of this matrix has no Riccati form")
    return form


def state_slope(statement: Statement, *point: Expr) -> Expr:
    """Rate of the nominal at (x, u, t, T, p)."""
    if statement.nominal is None:
        raise ValueError("a coupled problem has no separate nominal")
    return statement.nominal.call(point)[0]


def _gauss_step(matrix: Expr, half: Expr, size: int, solver: str) -> Any:
    """Half-vector of E+ = (D21 + D22 E)(D11 + D12 E)^-1, symmetrised."""
    covariance = unpack_symbolic(half, size)
    return pack_symbolic(riccati_step(matrix, covariance, lambda above, below: linear_solve(above, below, solver)))


def _strang_step(parts: Expr, half: Expr, size: int, solver: str) -> Any:
    """Half-vector after update, noise, transition, noise, update."""
    transition, noise_a, information_a, noise_b, information_b = ca.horzsplit(parts, size)
    covariance = _updated(unpack_symbolic(half, size), information_a, solver) + noise_a
    covariance = transition @ covariance @ transition.T + noise_b
    return pack_symbolic(_updated(covariance, information_b, solver))


def _updated(covariance: Expr, information: Expr, solver: str) -> Any:
    """(E^-1 + W)^-1 in Joseph's form."""
    size = covariance.shape[0]
    product = covariance @ information
    right = ca.horzcat(covariance + product @ covariance, ca.DM.eye(size))
    solved = linear_solve(ca.DM.eye(size) + product, right, solver)
    return solved[:, :size] @ solved[:, size:].T


@lru_cache(maxsize=KEPT)
def propagate_step(
    statement: Statement, positions: tuple[int, ...], step: StepKind = "gauss", solver: str = LINEAR_SOLVER
) -> ca.Function:
    """Half-vectors of some matrices over one substep, given their step matrices.

    Returns:
        (their half-vectors stacked, step matrix of the first, of the second, ...) -> half-vectors after the substep.
    """
    blocks = [statement.matrices[i] for i in positions]
    e = ca.MX.sym("e", sum(block.length for block in blocks))
    shape = (1, 5) if step == "strang" else (2, 2)
    matrices = [ca.MX.sym(f"d_{block.name}", shape[0] * block.size, shape[1] * block.size) for block in blocks]
    offsets = np.cumsum([0, *(block.length for block in blocks)]).tolist()
    apply = _strang_step if step == "strang" else _gauss_step
    halves = [
        apply(matrix, e[i:j], block.size, solver)
        for matrix, block, i, j in zip(matrices, blocks, offsets, offsets[1:], strict=False)
    ]
    return ca.Function("propagate_step", [e, *matrices], [ca.vertcat(*halves)])


@lru_cache(maxsize=KEPT)
def moving_step(
    statement: Statement, positions: tuple[int, ...], step: StepKind, solver: str = LINEAR_SOLVER
) -> ca.Function:
    """Some matrices over one step of gauss or strang, between readings.

    Returns:
        (their half-vectors stacked, x at the start, x at the end, *interval) -> their half-vectors at the end.
    """
    if fed(statement, positions):
        return fed_step(statement, positions, step, scalar_solver(statement, positions, solver))
    xa, xb = ca.MX.sym("xa", statement.nx), ca.MX.sym("xb", statement.nx)
    interval = Interval.symbols(statement, ca.MX)
    e = ca.MX.sym("e", len(statement.entries(positions)))
    steps = [step_matrix(statement, i, step, solver)(xa, xb, *interval) for i in positions]
    end = propagate_step(statement, positions, step, solver)(e, *steps)
    return ca.Function("moving_step", [e, xa, xb, *interval], [end])


def fed(statement: Statement, positions: tuple[int, ...]) -> bool:
    """Whether some of the matrices gain what another one loses by what is measured."""
    return any(statement.sources[i] is not None for i in positions)


def scalar_solver(statement: Statement, positions: tuple[int, ...], solver: str) -> str:
    """The linear solver of a step, that of scalars where all is written out in them."""
    most = SCALAR_ROWS if fed(statement, positions) else SCALAR_ROWS_ALONE if solver == LINEAR_SOLVER else 0
    small = max((statement.matrices[i].size for i in positions), default=0) <= most
    return SCALAR_SOLVER if small and statement.symbolic is ca.SX else solver


@lru_cache(maxsize=KEPT)
def fed_step(
    statement: Statement, positions: tuple[int, ...], step: StepKind, solver: str = LINEAR_SOLVER
) -> ca.Function:
    """`moving_step` where one of the matrices, Xhat, has the rate A Xhat + Xhat A' + Q + E W E, E another of them.

    E takes three steps, to the two Gauss points and to the end, so that it is known there to the order of a step. Then
    Xhat+ = Phi Xhat Phi' + 1/2 sum_i Psi_i h (Q + E W E)_i Psi_i', Phi and Psi_i the transitions of the Gauss method
    from the start and from the points to the end: a sum of congruences, positive semidefinite whatever A and h are.
    """
    xa, xb = ca.MX.sym("xa", statement.nx), ca.MX.sym("xb", statement.nx)
    interval = Interval.symbols(statement, ca.MX)
    ends = np.cumsum([0, *(statement.matrices[i].length for i in positions)]).tolist()
    e = ca.MX.sym("e", ends[-1])
    own = {i: e[j:k] for i, j, k in zip(positions, ends, ends[1:], strict=False)}
    inside = _inside_points(statement)(xa, xb, *interval)
    places, states = (0.0, *GAUSS_NODES, 1.0), (xa, inside[:, 0], inside[:, 1], xb)
    after: dict[int, Any] = {}
    for i in sorted(positions, key=lambda i: statement.sources[i] is not None):
        source = statement.sources[i]
        if source is None:
            passed = [own[i]]
            for c, d, x, y in zip(places, places[1:], states, states[1:], strict=False):
                matrix = step_matrix(statement, i, step, solver)(x, y, *interval.part(c, d))
                passed.append(propagate_step(statement, (i,), step, solver)(passed[-1], matrix))
            after[i], known = passed[-1], passed[1:3]
        else:
            after[i] = _fed_half(statement, (i, source), (own[i], *known), inside, interval, solver)
    function = ca.Function("fed_step", [e, xa, xb, *interval], [ca.vertcat(*(after[i] for i in positions))])
    return function.expand("fed_step", {"cse": True}) if solver == SCALAR_SOLVER else function


def _fed_half(
    statement: Statement,
    which: tuple[int, int],
    halves: tuple[Any, ...],
    inside: Expr,
    interval: Interval,
    solver: str,
) -> Any:
    """Half-vector of Xhat after a step.

    Args:
        statement: the problem.
        which: positions of Xhat and E.
        halves: half-vectors of Xhat before the step, of E at both Gauss points.
        inside: the nominal there.
        interval: of the step.
        solver: of linear systems.
    """
    size = statement.matrices[which[0]].size
    drifts, gained = [], []
    for j, c in enumerate(GAUSS_NODES):
        point = interval.at(c, inside[:, j])
        drift, noise, _ = _form(statement, which[0])(*point)
        information = _form(statement, which[1])(*point)[2]
        E = unpack_symbolic(halves[1 + j], size)
        drifts.append(interval.h * drift)
        gained.append(interval.h * (noise + E @ information @ E))
    transitions = gauss_arrivals(drifts, ca.DM.eye(size), lambda a, b: linear_solve(a, ca.densify(b), solver))
    parts = (unpack_symbolic(halves[0], size), gained[0] / 2, gained[1] / 2)
    total: Any = sum(turned.T @ part @ turned for turned, part in zip(transitions, parts, strict=True))
    return pack_symbolic(total)


@lru_cache(maxsize=KEPT)
def _inside_points(statement: Statement) -> ca.Function:
    """The nominal at the Gauss points of a step, (nx, 2)."""
    symbolic: Any = statement.symbolic
    xa, xb = symbolic.sym("xa", statement.nx), symbolic.sym("xb", statement.nx)
    interval = Interval.symbols(statement)
    value = ca.densify(_hermite_points(statement, xa, xb, interval))
    return ca.Function("inside_points", [xa, xb, *interval], [value], slopes_wanted(statement, 2))
