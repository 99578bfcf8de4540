"""One control interval: the nominal by Runge-Kutta, the covariances given the nominal by gauss, strang or rk4 steps.

Where a measurement is taken at an instant the interval has no length: a step leaves everything as it is, and after it
the covariance of the estimation error falls by what is read (`Samples.update`), in Joseph's form: exact and positive
semidefinite at any accuracy.

All functions made here take one control interval [s, s + ds] of the normalised time s = t/T, the controls at its two
ends, and cut it into `substeps` equal steps. Their last arguments, after state (and half-vectors), are those
of an `Interval`: control at the start, at the end, s, ds, T, parameters; `*interval` below.

The steps of covariances, gauss and strang, are those of `covariance_steps`. rk4 is the classical Runge-Kutta step of
nominal and half-vectors together, for any rate. rodas is the linearly implicit step of a stiff nominal (`rosenbrock`),
with gauss steps of the covariances along its own polynomial.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr, over
from covocp.base.linear_solve import LINEAR_SOLVER, SCALAR_SOLVER
from covocp.base.matrices import pack_symbolic
from covocp.base.quadrature import GAUSS_NODES, hermite, simpson_weight
from covocp.statement.interval import Interval
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT, StepKind, moving_step, scalar_solver, slopes_wanted, state_slope
from covocp.transcription.rosenbrock import between, implicit_interval

# Intervals as long as one from it to the end within which what runs backward may be steep.
NEAR_END = 10.0


@lru_cache(maxsize=KEPT)
def nominal_interval(statement: Statement, substeps: int, step: StepKind) -> ca.Function:
    """The nominal over one control interval, by classical Runge-Kutta steps or, with "rodas", implicit ones.

    Returns:
        (x, *interval) -> state at the end, states at the ends of the substeps (nx, substeps), integral of the running
        cost (0 where that depends on the matrices).
    """
    if step == "rodas":
        return implicit_interval(statement, substeps, GAUSS_NODES)
    symbolic: Any = statement.symbolic
    nominal = statement.nominal
    if nominal is None:
        raise ValueError("a coupled problem has no separate nominal")
    x, interval = symbolic.sym("x", statement.nx), Interval.symbols(statement)

    def rate(part: Interval, value: Expr, c: float) -> Expr:
        return ca.vertcat(*nominal.call(part.at(c, value[:-1])))

    states, cost = _classical_steps(statement, rate, ca.vertcat(x, 0), interval, substeps)
    return ca.Function("nominal_interval", [x, *interval], [states[:, -1], states, cost], slopes_wanted(statement, 1))


@lru_cache(maxsize=KEPT)
def joint_interval(statement: Statement, substeps: int) -> ca.Function:
    """Nominal and half-vectors together by classical Runge-Kutta steps (covariance step rk4).

    Returns:
        (x and e stacked, *interval) -> the stack at the end, at the ends of the substeps (nx + ne, substeps), integral
        of the running cost.
    """
    symbolic: Any = statement.symbolic
    nx = statement.nx
    z, interval = symbolic.sym("z", nx + statement.ne), Interval.symbols(statement)
    by_parts = taken_by_parts(statement, interval.s, interval.ds)

    def rate(part: Interval, value: Expr, c: float) -> Expr:
        point = part.at(c, value[:nx], value[nx:-1])
        moved, grown, cost = statement.rates(*point)
        if statement.behind:
            cost = ca.if_else(by_parts, _by_parts(statement)(*point)[0], cost)
        return ca.vertcat(moved, grown, cost)

    def read(part: Interval, value: Expr) -> Expr:
        after, gained = read_at(statement, part, value[:nx], value[nx:-1])
        return ca.vertcat(value[:nx], after, value[-1] + ca.if_else(by_parts, 0, gained))

    start = ca.vertcat(z, 0)
    stacked, cost = _classical_steps(statement, rate, start, interval, substeps, read if statement.samples else None)
    if statement.behind:
        ends = ((0.0, z), (1.0, stacked[:, -1]))
        before, after = (_by_parts(statement)(*interval.at(c, v[:nx], v[nx:]))[1] for c, v in ends)
        cost = cost + ca.if_else(by_parts, before - after, 0)
    return ca.Function("joint_interval", [z, *interval], [stacked[:, -1], stacked, cost], slopes_wanted(statement, 1))


def _classical_steps(
    statement: Statement,
    rate: Callable[[Interval, Expr, float], Expr],
    start: Expr,
    interval: Interval,
    substeps: int,
    read: Callable[[Interval, Expr], Expr] | None = None,
) -> tuple[Expr, Expr]:
    """Classical Runge-Kutta over the parts of an interval: values at their ends, and the last entry, the cost.

    What is read at the end of a part changes the values there.
    """
    values = [start]
    for j in range(substeps):
        part = interval.part(j / substeps, (j + 1) / substeps)
        after = statement.geometry.step(partial(rate, part), values[-1], over(interval.h, substeps))
        values.append(after if read is None else read(part, after))
    stacked: Expr = ca.horzcat(*values[1:])
    return stacked[:-1, :], stacked[-1, -1]


def read_at(statement: Statement, part: Interval, x: Expr, e: Expr) -> tuple[Any, Any]:
    """Half-vectors after what a part of an interval reads, and what that adds to the running cost."""
    assert statement.samples is not None
    after, cost = statement.samples.update(*part.at(0.0, x, e), part.reading)
    return after, cost


def read_by(statement: Statement, positions: tuple[int, ...]) -> bool:
    """Whether measurements at instants change some of the matrices."""
    return statement.samples is not None and any(statement.matrices[i].estimation for i in positions)


@lru_cache(maxsize=KEPT)
def read_step(statement: Statement, positions: tuple[int, ...]) -> ca.Function:
    """(half-vectors of some matrices, state, *interval without length) -> half-vectors after what is read."""
    entries = statement.entries(positions)
    own, x = ca.MX.sym("e", len(entries)), ca.MX.sym("x", statement.nx)
    interval = Interval.symbols(statement, ca.MX)
    e = ca.MX.zeros(statement.ne)
    e[entries] = own
    after, _ = read_at(statement, interval, x, e)
    return ca.Function("read_step", [own, x, *interval], [after[entries]])


@lru_cache(maxsize=KEPT)
def told_at(statement: Statement) -> ca.Function:
    """What is read in an interval without length, as the compiled passage is told it (`Told`): a column for each group.

    Returns:
        (state, *interval without length) -> rows of M and half-vector of R, for each group of rows.
    """
    samples = statement.samples
    assert samples is not None
    symbolic: Any = statement.symbolic
    x, interval = symbolic.sym("x", statement.nx), Interval.symbols(statement)
    _, H, R = samples.measurement(*interval.at(0.0, x))
    height, columns = max(len(group) for group in samples.groups), []
    for group in samples.groups:
        rows = list(group)
        own = next(j for j, block in enumerate(samples.blocks) if rows[0] in range(block.span.start, block.span.stop))
        M = ca.vertcat(ca.sqrt(interval.reading[own]) * H[rows, :], symbolic.zeros(height - len(rows), H.shape[1]))
        noise = ca.diagcat(R[rows, rows], ca.DM.eye(height - len(rows)))
        columns.append(ca.vertcat(ca.vec(ca.densify(M).T), pack_symbolic(noise)))
    return ca.Function("told", [x, *interval], [ca.densify(ca.horzcat(*columns))], slopes_wanted(statement, 1))


@lru_cache(maxsize=KEPT)
def simpson_interval(statement: Statement, substeps: int, by_parts: bool = False) -> ca.Function:
    """Integral of a running cost that depends on the matrices, by Simpson's rule over pairs of substeps.

    Args:
        statement: the problem.
        substeps: an even number.
        by_parts: integrate the cost of a closed loop by parts (`Loop.by_parts`).

    Returns:
        (x, e, states at the ends of the substeps, half-vectors there, *interval) -> integral.
    """
    if substeps % 2:
        raise ValueError("Simpson's rule needs an even number of substeps")
    symbolic: Any = statement.symbolic
    nx, ne = statement.nx, statement.ne
    x, e = symbolic.sym("x", nx), symbolic.sym("e", ne)
    states, halves = symbolic.sym("xf", nx, substeps), symbolic.sym("ef", ne, substeps)
    interval = Interval.symbols(statement)
    rates = _by_parts(statement) if by_parts else _running(statement)
    total: Any = 0
    passed: list[Any] = []
    for j in range(substeps + 1):
        xj, ej = (x, e) if j == 0 else (states[:, j - 1], halves[:, j - 1])
        cost, product = rates(*interval.at(j / substeps, xj, ej))
        total = total + simpson_weight(j, substeps) * cost
        passed.append(product)
    value = interval.h * total + passed[0] - passed[-1]
    if statement.samples is not None and not by_parts:
        for j in range(substeps):
            xj, ej = (x, e) if j == 0 else (states[:, j - 1], halves[:, j - 1])
            value += read_at(statement, interval.part(j / substeps, (j + 1) / substeps), xj, ej)[1]
    return ca.Function("simpson_interval", [x, e, states, halves, *interval], [value], slopes_wanted(statement, 4))


def _running(statement: Statement) -> Callable[..., tuple[Any, Any]]:
    """(all six) -> running cost, and nothing integrated by parts."""
    return lambda *six: (statement.rates(*six)[2], 0.0)


def _by_parts(statement: Statement) -> Callable[..., tuple[Any, Any]]:
    """(all six) -> running cost of a closed loop integrated by parts, and what its growth takes off."""
    if statement.loop is None or statement.loop.by_parts is None:
        raise ValueError("only the cost of a closed loop with the best gain is integrated by parts")
    function = statement.loop.by_parts
    return lambda *six: tuple(function(*six))


def taken_by_parts(statement: Statement, s: Expr, ds: Expr) -> Any:
    """Whether the cost of a closed loop is taken by parts over intervals [s, s + ds]: not where they are near the end.

    There what runs backward may change within an interval, as before a jump of its rate; elsewhere the covariance of
    the error may, where a sensor comes to see something.
    """
    middle = s + ds / 2
    away = ca.logic_or(middle < 0.5, 1 - middle > NEAR_END * ds)
    for place in statement.falls:
        away = ca.logic_and(away, ca.logic_or(middle > place, place - middle > NEAR_END * ds))
    return away


@lru_cache(maxsize=KEPT)
def moving_interval(statement: Statement, substeps: int, step: StepKind) -> ca.Function:
    """The interval of what cannot be told apart: x and e stacked where rates of x contain e, else x."""
    return (full_interval if statement.coupled else nominal_interval)(statement, substeps, step)


@lru_cache(maxsize=KEPT)
def interval_slopes(statement: Statement, substeps: int, step: StepKind) -> ca.Function:
    """Slopes of the end of an interval of what moves along it, dense.

    Returns:
        The arguments of `moving_interval` -> slopes by its start (n, n), by the controls at both ends (n, nu) each.
    """
    interval = moving_interval(statement, substeps, step)
    symbols = interval.mx_in()
    end = interval(*symbols)[0]
    slopes = [ca.densify(ca.jacobian(end, symbols[i])) for i in range(3)]
    return ca.Function("interval_slopes", symbols, slopes)


def full_interval(statement: Statement, substeps: int, step: StepKind, solver: str = LINEAR_SOLVER) -> ca.Function:
    """Nominal and half-vectors over one control interval with the given covariance step.

    Returns:
        (x and e stacked, *interval) -> the stack at the end, at the ends of the substeps (nx + ne, substeps), integral
        of the running cost.
    """
    if step == "rk4" or (not statement.matrices and step != "rodas"):
        return joint_interval(statement, substeps)
    if not statement.matrices:
        return nominal_interval(statement, substeps, step)
    z = ca.MX.sym("z", statement.nx + statement.ne)
    x, e = z[: statement.nx], z[statement.nx :]
    interval = Interval.symbols(statement, ca.MX)
    _, states, cost = nominal_interval(statement, substeps, step)(x, *interval)
    starts = ca.horzcat(x, states[:, : substeps - 1])
    stepped = statement.ahead + statement.behind  # what is variable at both ends runs forward here
    solver = scalar_solver(statement, stepped, solver)
    move = moving_step(statement, stepped, step, solver)
    own, gathered = e[statement.entries(stepped), :], e[statement.entries(statement.summed), :]
    columns = []
    for j in range(substeps):
        part = interval.part(j / substeps, (j + 1) / substeps)
        after = move(own, starts[:, j], states[:, j], *part)
        if read_by(statement, stepped):
            whole: Any = ca.MX.zeros(statement.ne)
            whole[statement.entries(stepped)] = after
            after = read_at(statement, part, starts[:, j], whole)[0][statement.entries(stepped)]
        if statement.summed:
            ends = (own[: ahead_size(statement)], after[: ahead_size(statement)], starts[:, j], states[:, j])
            gathered = gathered + gathering_step(statement, step, solver)(*ends, *part)
        own = after
        columns.append(ca.vertcat(own, gathered))
    halves = in_order(statement, ca.horzcat(*columns))
    if statement.running_uses_matrices:
        arguments = (x, e, states, halves, *interval)
        cost = simpson_interval(statement, substeps)(*arguments)
        if statement.behind:
            cost = ca.if_else(
                taken_by_parts(statement, interval.s, interval.ds),
                simpson_interval(statement, substeps, True)(*arguments),
                cost,
            )
    fine = ca.vertcat(states, halves)
    options = slopes_wanted(statement, 1)
    function = ca.Function("full_interval", [z, *interval], [fine[:, -1], fine, cost], options)
    return function.expand("full_interval", options | {"cse": True}) if solver == SCALAR_SOLVER else function


def ahead_size(statement: Statement) -> int:
    """Entries of the half-vectors that run forward, integrals of them left out."""
    return len(statement.entries(statement.ahead))


def in_order(statement: Statement, *parts: Expr) -> Any:
    """Rows of what runs forward, then backward, then is gathered, in the order of the statement."""
    order = np.argsort(statement.entries(statement.ahead + statement.behind + statement.summed)).tolist()
    rows: Expr = ca.vertcat(*parts) if len(parts) > 1 else parts[0]
    return rows if order == sorted(order) else rows[order, :]


@lru_cache(maxsize=KEPT)
def gathering_step(statement: Statement, step: StepKind, solver: str = LINEAR_SOLVER) -> ca.Function:
    """Integrals of what depends on matrices over one step, by Simpson's rule.

    The middle is that of the steps themselves: the nominal there by its own polynomial, the matrices by half a step.

    Returns:
        (half-vectors that run forward at the start, at the end, x at the start, at the end, *interval) -> what the
        integrals gain over the step.
    """
    count, nx = ahead_size(statement), statement.nx
    ea, eb, xa, xb = (ca.MX.sym(name, size) for name, size in (("ea", count), ("eb", count), ("xa", nx), ("xb", nx)))
    interval = Interval.symbols(statement, ca.MX)
    if step == "rodas":
        middle = between(statement, (0.5,))(xa, xb, *interval)
    else:
        fa, fb = (interval.h * state_slope(statement, *interval.at(c, x)) for c, x in ((0.0, xa), (1.0, xb)))
        middle = hermite(xa, xb, fa, fb, 0.5)
    half = matrices_step(statement, statement.ahead, step, solver)(ea, xa, middle, *interval.part(0.0, 0.5))
    rows: list[int] = statement.entries(statement.summed)
    total: Any = 0
    for c, x, own, weight in ((0.0, xa, ea, 1.0), (0.5, middle, half, 4.0), (1.0, xb, eb, 1.0)):
        e = ca.MX.zeros(statement.ne)
        e[statement.entries(statement.ahead)] = own
        total = total + weight / 6.0 * statement.rates(*interval.at(c, x, e))[1][rows]
    return ca.Function("gathering_step", [ea, eb, xa, xb, *interval], [interval.h * total], slopes_wanted(statement, 4))


@lru_cache(maxsize=KEPT)
def runge_kutta_step(statement: Statement, positions: tuple[int, ...]) -> ca.Function:
    """(half-vectors of some matrices, state, *interval of the substep) -> half-vectors after a classical step."""
    entries = statement.entries(positions)
    symbolic: Any = statement.symbolic
    own, x = symbolic.sym("e", len(entries)), symbolic.sym("x", statement.nx)
    interval = Interval.symbols(statement)
    e = symbolic.zeros(statement.ne)
    e[entries] = own
    end = joint_interval(statement, 1)(ca.vertcat(x, e), *interval)[0]
    return ca.Function("matrix_step", [own, x, *interval], [end[statement.nx :][entries]])


@lru_cache(maxsize=KEPT)
def matrices_step(
    statement: Statement, positions: tuple[int, ...], step: StepKind, solver: str = LINEAR_SOLVER
) -> ca.Function:
    """Some matrices over one step along a nominal that is known at both ends of it, in either direction.

    Returns:
        (their half-vectors stacked, x at the start, x at the end, *interval) -> their half-vectors at the end.
    """
    xa, xb = ca.MX.sym("xa", statement.nx), ca.MX.sym("xb", statement.nx)
    interval = Interval.symbols(statement, ca.MX)
    e = ca.MX.sym("e", len(statement.entries(positions)))
    if step == "rk4":
        end = runge_kutta_step(statement, positions)(e, xa, *interval)
    else:
        end = moving_step(statement, positions, step, solver)(e, xa, xb, *interval)
        if read_by(statement, positions):
            whole = ca.MX.zeros(statement.ne)
            whole[statement.entries(positions)] = end
            end = read_at(statement, interval, xa, whole)[0][statement.entries(positions)]
    return ca.Function("matrices_step", [e, xa, xb, *interval], [end])
