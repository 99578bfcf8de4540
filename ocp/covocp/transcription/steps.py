"""One control interval: the nominal by Runge-Kutta, the covariances given the nominal by gauss, strang or rk4 steps.

All functions made here take one control interval [s, s + ds] of the normalised time s = t/T, the controls at its two
ends, and cut it into `substeps` equal steps. Their common arguments, after state (and half-vectors), are

    (control at the start, control at the end, s, ds, T, parameters)

Covariance steps for V = F E + E F' + Q - E W E, by *step matrices* that do not depend on E:

- gauss: two-stage Gauss method for X' = -F'X + W Y, Y' = Q X + F Y, E = Y X^-1. Symplectic, order 4, positive
  semidefinite at any step size (Dieci and Eirola, Numer. Math. 67, 1994). A 2n x 2n matrix D with
  E+ = (D21 + D22 E)(D11 + D12 E)^-1.
- strang: half a measurement update, half the noise, transition with the tangent of the Runge-Kutta step, half the
  noise, half a measurement update. Order 2, positive semidefinite at any step size; the update with G = (I + E W)^-1
  in Joseph's form, E+ = G E G' + G (E W E) G'. In roundoff it ends where a step measures 1e10 times better than the
  prior, eps (h E W) near 1e-6: there gauss is the one to use. Its matrices side by side, n x 5n: transition, noise and
  information of the first half, noise and information of the second.

rk4 is the classical Runge-Kutta step of nominal and half-vectors together, for any rate. rodas is the linearly implicit
step of a stiff nominal (`implicit`), with gauss steps of the covariances along its own polynomial.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np

from covocp.base.linear_solve import LINEAR_SOLVER, linear_solve
from covocp.base.matrices import pack_symbolic, unpack_symbolic
from covocp.statement.statement import Statement
from covocp.transcription.rosenbrock import between, implicit_interval, one_sided, part_of

Step = Literal["gauss", "strang", "rk4", "rodas"]

# Functions of the last statements are kept: transcription, costates and checks all ask for the same ones.
KEPT = 16

GAUSS_NODES = (0.5 - np.sqrt(3.0) / 6.0, 0.5 + np.sqrt(3.0) / 6.0)
COMMON = ("start", "end", "s", "ds", "duration", "parameters")


def interval_symbols(statement: Statement, symbolic: Any) -> tuple[Any, ...]:
    """Symbols of the common arguments."""
    nu = statement.nu
    return (
        symbolic.sym("ua", nu),
        symbolic.sym("ub", nu),
        symbolic.sym("s"),
        symbolic.sym("ds"),
        symbolic.sym("T"),
        symbolic.sym("p", statement.np),
    )


def _slopes(statement: Statement, count: int) -> dict[str, Any]:
    """Option of a function of `count` values and the common arguments: what it is never differentiated by.

    The adjoint of a step is the dearest function of all; slopes by the mesh and the parameters would add a third.
    """
    return {"is_diff_in": [True] * (count + 2) + [False, False, statement.duration.free, False]}


@lru_cache(maxsize=KEPT)
def nominal_interval(statement: Statement, substeps: int, step: Step) -> ca.Function:
    """The nominal over one control interval, by classical Runge-Kutta steps or, with "rodas", implicit ones.

    Returns:
        (x, *common) -> state at the end, states at the ends of the substeps (nx, substeps), integral of the running
        cost (0 where that depends on the matrices).
    """
    if step == "rodas":
        return implicit_interval(statement, substeps, GAUSS_NODES)
    symbolic: Any = statement.symbolic
    nominal = statement.nominal
    if nominal is None:
        raise ValueError("a coupled problem has no separate nominal")
    x = symbolic.sym("x", statement.nx)
    common = interval_symbols(statement, symbolic)
    ua, ub, s, ds, duration, p = common

    def rate(value: Any, c: float, at: float) -> Any:
        outputs = nominal(value[:-1], ua + c * (ub - ua), duration * (s + at * ds), duration, p)
        return ca.vertcat(*outputs)

    states, cost = _runge_kutta(rate, ca.vertcat(x, 0), duration * ds, substeps)
    return ca.Function("nominal_interval", [x, *common], [states[:, -1], states, cost], _slopes(statement, 1))


@lru_cache(maxsize=KEPT)
def joint_interval(statement: Statement, substeps: int) -> ca.Function:
    """Nominal and half-vectors together by classical Runge-Kutta steps (covariance step rk4).

    Returns:
        (x and e stacked, *common) -> the stack at the end, at the ends of the substeps (nx + ne, substeps), integral
        of the running cost.
    """
    symbolic: Any = statement.symbolic
    nx = statement.nx
    z = symbolic.sym("z", nx + statement.ne)
    common = interval_symbols(statement, symbolic)
    ua, ub, s, ds, duration, p = common

    first = early(s, ds)

    def rate(value: Any, c: float, at: float) -> Any:
        six = (value[:nx], ua + c * (ub - ua), value[nx:-1], duration * (s + at * ds), duration, p)
        moved, grown, cost = statement.rates(*six)
        if statement.behind:
            cost = ca.if_else(first, _by_parts(statement)(*six)[0], cost)
        return ca.vertcat(moved, grown, cost)

    stacked, cost = _runge_kutta(rate, ca.vertcat(z, 0), duration * ds, substeps)
    if statement.behind:
        ends = ((z, ua, 0.0), (stacked[:, -1], ub, 1.0))
        products = [
            _by_parts(statement)(v[:nx], u, v[nx:], duration * (s + one_sided(c) * ds), duration, p)[1]
            for v, u, c in ends
        ]
        cost = cost + ca.if_else(first, products[0] - products[1], 0)
    return ca.Function("joint_interval", [z, *common], [stacked[:, -1], stacked, cost], _slopes(statement, 1))


def _runge_kutta(rate: Callable[[Any, float, float], Any], start: Any, h: Any, substeps: int) -> tuple[Any, Any]:
    """Classical Runge-Kutta over an interval of length h; the last entry is the cost.

    rate(value, c, at) with c in [0, 1] for the control, and for the time the same with the ends of the step one-sided.
    """
    value, values = start, []
    step = h / substeps
    for j in range(substeps):
        c, d = j / substeps, 1.0 / substeps
        k1 = rate(value, c, c + d * one_sided(0.0))
        k2 = rate(value + step / 2 * k1, c + d / 2, c + d / 2)
        k3 = rate(value + step / 2 * k2, c + d / 2, c + d / 2)
        k4 = rate(value + step * k3, c + d, c + d * one_sided(1.0))
        value = value + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        values.append(value)
    stacked = ca.horzcat(*values)
    return stacked[:-1, :], stacked[-1, -1]


@lru_cache(maxsize=KEPT)
def step_matrix(statement: Statement, index: int, step: Step, solver: str = LINEAR_SOLVER) -> ca.Function:
    """The step matrix of one matrix state over one substep, given the nominal at both ends of it.

    Returns:
        (xa, xb, *common of the substep) -> D (2n, 2n) of gauss, parts of strang (n, 5n); they do not depend on E.
    """
    size = statement.matrices[index].size
    xa, xb = ca.MX.sym("xa", statement.nx), ca.MX.sym("xb", statement.nx)
    common = interval_symbols(statement, ca.MX)
    if step == "strang":
        value = ca.horzcat(*_strang_parts(statement, index)(xa, xb, *common))
    else:
        value = gauss_matrix(_gauss_points(statement, index, step)(xa, xb, *common), size, solver)
    return ca.Function("step_matrix", [xa, xb, *common], [value], _slopes(statement, 2))


@lru_cache(maxsize=KEPT)
def _gauss_points(statement: Statement, index: int, step: Step) -> ca.Function:
    """h H at the two Gauss points, H = [-F' W; Q F], the nominal there by its own polynomial (`between`)."""
    form = _form(statement, index)
    inside = between(statement, GAUSS_NODES) if step == "rodas" else None
    symbolic: Any = statement.symbolic if inside is None or inside.is_a("SXFunction") else ca.MX
    xa, xb = symbolic.sym("xa", statement.nx), symbolic.sym("xb", statement.nx)
    common = interval_symbols(statement, symbolic)
    ua, ub, s, ds, duration, p = common
    h = duration * ds
    known = _hermite_points(statement, xa, xb, common) if inside is None else inside(xa, xb, *common)
    points = []
    for j, c in enumerate(GAUSS_NODES):
        drift, noise, information = form(known[:, j], ua + c * (ub - ua), duration * (s + c * ds), duration, p)
        points.append(h * ca.blockcat([[-drift.T, information], [noise, drift]]))
    return ca.Function("gauss_points", [xa, xb, *common], points, _slopes(statement, 2))


def _hermite_points(statement: Statement, xa: Any, xb: Any, common: tuple[Any, ...]) -> Any:
    """The nominal at the Gauss points of a step, by a cubic Hermite polynomial between its ends."""
    ua, ub, s, ds, duration, p = common
    h = duration * ds
    fa = _slope(statement, xa, ua, s + one_sided(0.0) * ds, duration, p)
    fb = _slope(statement, xb, ub, s + one_sided(1.0) * ds, duration, p)
    return ca.horzcat(*(hermite(xa, xb, h * fa, h * fb, c) for c in GAUSS_NODES))


def gauss_matrix(points: Any, size: int, solver: str) -> Any:
    """D = I + V, V = h/2 (H1 Y1 + H2 Y2), of the two-stage Gauss method with stages Y1, Y2 = Y1 + 2 g V.

    With g = sqrt(3)/6 and a = 1/2 - 2 g the first stage is (I - g h H1) Y1 = I + a V, so V is had from Y1 without a
    solve, and inserting it leaves one system of size 2n instead of 4n:

        [(I - g h H2)(I - g h H1) - a h/2 (H1 + H2)] Y1 = I - g h H2.

    Its matrix is regular where the Gauss method is (for constant H it is I - hH/2 + (hH)^2/12), and its factors keep
    the sparsity of F.
    """
    first, second = points
    g = np.sqrt(3.0) / 6.0
    a = 0.5 - 2.0 * g
    unit = ca.DM.eye(2 * size)
    left, right = unit - g * second, unit - g * first
    stage = linear_solve(left @ right - a / 2 * (first + second), ca.densify(left), solver)
    return unit + (right @ stage - unit) / a


@lru_cache(maxsize=KEPT)
def _strang_parts(statement: Statement, index: int) -> ca.Function:
    """Transition matrix of the Runge-Kutta step, noise and information at both ends (times h/2)."""
    form = _form(statement, index)
    symbolic: Any = statement.symbolic
    size = statement.matrices[index].size
    xa, xb = symbolic.sym("xa", statement.nx), symbolic.sym("xb", statement.nx)
    common = interval_symbols(statement, symbolic)
    ua, ub, s, ds, duration, p = common
    h = duration * ds

    def rates(x: Any, transition: Any, c: float) -> tuple[Any, Any]:
        u, at = ua + c * (ub - ua), s + one_sided(c) * ds
        return _slope(statement, x, u, at, duration, p), form(x, u, duration * at, duration, p)[0] @ transition

    unit = ca.DM.eye(size)
    k1, m1 = rates(xa, unit, 0.0)
    k2, m2 = rates(xa + h / 2 * k1, unit + h / 2 * m1, 0.5)
    k3, m3 = rates(xa + h / 2 * k2, unit + h / 2 * m2, 0.5)
    _, m4 = rates(xa + h * k3, unit + h * m3, 1.0)
    transition = unit + h / 6 * (m1 + 2 * m2 + 2 * m3 + m4)
    _, noise_a, information_a = form(xa, ua, duration * (s + one_sided(0.0) * ds), duration, p)
    _, noise_b, information_b = form(xb, ub, duration * (s + one_sided(1.0) * ds), duration, p)
    outputs = [transition, *(h / 2 * entry for entry in (noise_a, information_a, noise_b, information_b))]
    dense = [ca.densify(entry) for entry in outputs]
    return ca.Function("strang_parts", [xa, xb, *common], dense, _slopes(statement, 2))


def _form(statement: Statement, index: int) -> ca.Function:
    form = statement.riccati[index]
    if form is None:
        raise ValueError("the rate of this matrix has no Riccati form")
    return form


def _slope(statement: Statement, x: Any, u: Any, s: Any, duration: Any, p: Any) -> Any:
    """Rate of the nominal."""
    if statement.nominal is None:
        raise ValueError("a coupled problem has no separate nominal")
    return statement.nominal(x, u, duration * s, duration, p)[0]


def hermite(start: Any, end: Any, slope_start: Any, slope_end: Any, c: Any) -> Any:
    """Cubic Hermite polynomial at c in [0, 1]; slopes per unit of c."""
    return (
        (1 + 2 * c) * (1 - c) ** 2 * start
        + c * (1 - c) ** 2 * slope_start
        + c**2 * (3 - 2 * c) * end
        + c**2 * (c - 1) * slope_end
    )


def _gauss_step(matrix: Any, half: Any, size: int, solver: str) -> Any:
    """Half-vector of E+ = (D21 + D22 E)(D11 + D12 E)^-1, symmetrised."""
    covariance = unpack_symbolic(half, size)
    below = matrix[size:, :size] + matrix[size:, size:] @ covariance
    above = matrix[:size, :size] + matrix[:size, size:] @ covariance
    return pack_symbolic(linear_solve(above.T, below.T, solver))


def _strang_step(parts: Any, half: Any, size: int, solver: str) -> Any:
    """Half-vector after update, noise, transition, noise, update."""
    transition, noise_a, information_a, noise_b, information_b = ca.horzsplit(parts, size)
    covariance = _updated(unpack_symbolic(half, size), information_a, solver) + noise_a
    covariance = transition @ covariance @ transition.T + noise_b
    return pack_symbolic(_updated(covariance, information_b, solver))


def _updated(covariance: Any, information: Any, solver: str) -> Any:
    """(E^-1 + W)^-1 in Joseph's form."""
    size = covariance.shape[0]
    product = covariance @ information
    right = ca.horzcat(covariance + product @ covariance, ca.DM.eye(size))
    solved = linear_solve(ca.DM.eye(size) + product, right, solver)
    return solved[:, :size] @ solved[:, size:].T


@lru_cache(maxsize=KEPT)
def propagate_step(
    statement: Statement, positions: tuple[int, ...], step: Step = "gauss", solver: str = LINEAR_SOLVER
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
def simpson_interval(statement: Statement, substeps: int, by_parts: bool = False) -> ca.Function:
    """Integral of a running cost that depends on the matrices, by Simpson's rule over pairs of substeps.

    Args:
        statement: the problem.
        substeps: an even number.
        by_parts: integrate the cost of a closed loop by parts (`Loop.by_parts`).

    Returns:
        (x, e, states at the ends of the substeps, half-vectors there, *common) -> integral.
    """
    if substeps % 2:
        raise ValueError("Simpson's rule needs an even number of substeps")
    symbolic: Any = statement.symbolic
    nx, ne = statement.nx, statement.ne
    x, e = symbolic.sym("x", nx), symbolic.sym("e", ne)
    states, halves = symbolic.sym("xf", nx, substeps), symbolic.sym("ef", ne, substeps)
    common = interval_symbols(statement, symbolic)
    ua, ub, s, ds, duration, p = common
    rates = _by_parts(statement) if by_parts else _running(statement)
    total, passed = 0, []
    for j in range(substeps + 1):
        c = j / substeps
        weight = (1 if j in (0, substeps) else 4 if j % 2 else 2) / (3 * substeps)
        xj, ej = (x, e) if j == 0 else (states[:, j - 1], halves[:, j - 1])
        cost, product = rates(xj, ua + c * (ub - ua), ej, duration * (s + one_sided(c) * ds), duration, p)
        total = total + weight * cost
        passed.append(product)
    value = duration * ds * total + passed[0] - passed[-1]
    return ca.Function("simpson_interval", [x, e, states, halves, *common], [value], _slopes(statement, 4))


def _running(statement: Statement) -> Callable[..., tuple[Any, Any]]:
    """(all six) -> running cost, and nothing integrated by parts."""
    return lambda *six: (statement.rates(*six)[2], 0.0)


def _by_parts(statement: Statement) -> Callable[..., tuple[Any, Any]]:
    """(all six) -> running cost of a closed loop integrated by parts, and what its growth takes off."""
    if statement.loop is None or statement.loop.by_parts is None:
        raise ValueError("only the cost of a closed loop with the best gain is integrated by parts")
    function = statement.loop.by_parts
    return lambda *six: tuple(function(*six))


def early(s: Any, ds: Any) -> Any:
    """Whether an interval lies in the first half of the time, where the cost of a closed loop is taken by parts."""
    return s + ds / 2 < 0.5


@lru_cache(maxsize=KEPT)
def full_interval(statement: Statement, substeps: int, step: Step, solver: str = LINEAR_SOLVER) -> ca.Function:
    """Nominal and half-vectors over one control interval with the given covariance step.

    Returns:
        (x and e stacked, *common) -> the stack at the end, at the ends of the substeps (nx + ne, substeps), integral
        of the running cost.
    """
    if step == "rk4" or (not statement.matrices and step != "rodas"):
        return joint_interval(statement, substeps)
    if not statement.matrices:
        return nominal_interval(statement, substeps, step)
    z = ca.MX.sym("z", statement.nx + statement.ne)
    x, e = z[: statement.nx], z[statement.nx :]
    common = interval_symbols(statement, ca.MX)
    ua, ub, s, ds, duration, p = common
    _, states, cost = nominal_interval(statement, substeps, step)(x, *common)
    starts = ca.horzcat(x, states[:, : substeps - 1])
    matrices = [step_matrix(statement, i, step, solver) for i in range(len(statement.matrices))]
    propagate = propagate_step(statement, tuple(range(len(matrices))), step, solver)
    columns = []
    half = e
    for j in range(substeps):
        c, d = j / substeps, (j + 1) / substeps
        ends = (ua + c * (ub - ua), ua + d * (ub - ua), s + c * ds, ds / substeps, duration, p)
        half = propagate(half, *(matrix(starts[:, j], states[:, j], *ends) for matrix in matrices))
        columns.append(half)
    halves = ca.horzcat(*columns)
    if statement.running_uses_matrices:
        arguments = (x, e, states, halves, *common)
        cost = simpson_interval(statement, substeps)(*arguments)
        if statement.behind:
            cost = ca.if_else(early(s, ds), simpson_interval(statement, substeps, True)(*arguments), cost)
    fine = ca.vertcat(states, halves)
    return ca.Function("full_interval", [z, *common], [fine[:, -1], fine, cost], _slopes(statement, 1))


@lru_cache(maxsize=KEPT)
def inside_interval(statement: Statement, count: int, step: Step, solver: str = LINEAR_SOLVER) -> ca.Function:
    """The trajectory inside an interval whose ends are known: what runs forward from its start, S from its end.

    Returns:
        (x and e stacked at the start, at the end, *common) -> the stack at the start and at the ends of `count`
        substeps, (nx + ne, count + 1).
    """
    nx, size = statement.nx, statement.nx + statement.ne
    before, after = ca.MX.sym("before", size), ca.MX.sym("after", size)
    common = interval_symbols(statement, ca.MX)
    if not statement.behind:
        _, fine, _ = full_interval(statement, count, step, solver)(before, *common)
        return ca.Function("inside", [before, after, *common], [ca.horzcat(before, fine)])
    x = ca.horzcat(before[:nx], nominal_interval(statement, count, step)(before[:nx], *common)[1])
    ahead, behind = statement.entries(statement.ahead), statement.entries(statement.behind)
    first, last = [before[nx:][ahead]], [after[nx:][behind]]

    forward, backward = (matrices_step(statement, which, step, solver) for which in (statement.ahead, statement.behind))
    for j in range(count):
        part = part_of(common, j / count, (j + 1) / count)
        first.append(forward(first[-1], x[:, j], x[:, j + 1], *part))
    for j in range(count, 0, -1):
        ua, ub, s, ds, *rest = part_of(common, (j - 1) / count, j / count)
        last.append(backward(last[-1], x[:, j], x[:, j - 1], ub, ua, s + ds, -ds, *rest))
    e = ca.vertcat(ca.horzcat(*first), ca.horzcat(*last[::-1]))[np.argsort(ahead + behind).tolist(), :]
    return ca.Function("inside", [before, after, *common], [ca.vertcat(x, e)])


@lru_cache(maxsize=KEPT)
def runge_kutta_step(statement: Statement, positions: tuple[int, ...]) -> ca.Function:
    """(half-vectors of some matrices, state, *common of the substep) -> half-vectors after a classical step."""
    entries = statement.entries(positions)
    symbolic: Any = statement.symbolic
    own, x = symbolic.sym("e", len(entries)), symbolic.sym("x", statement.nx)
    rest = interval_symbols(statement, symbolic)
    e = symbolic.zeros(statement.ne)
    e[entries] = own
    end = joint_interval(statement, 1)(ca.vertcat(x, e), *rest)[0]
    return ca.Function("matrix_step", [own, x, *rest], [end[statement.nx :][entries]])


@lru_cache(maxsize=KEPT)
def matrices_step(
    statement: Statement, positions: tuple[int, ...], step: Step, solver: str = LINEAR_SOLVER
) -> ca.Function:
    """Some matrices over one step along a nominal that is known at both ends of it, in either direction.

    Returns:
        (their half-vectors stacked, x at the start, x at the end, *common) -> their half-vectors at the end.
    """
    xa, xb = ca.MX.sym("xa", statement.nx), ca.MX.sym("xb", statement.nx)
    common = interval_symbols(statement, ca.MX)
    e = ca.MX.sym("e", len(statement.entries(positions)))
    if step == "rk4":
        end = runge_kutta_step(statement, positions)(e, xa, *common)
    else:
        steps = [step_matrix(statement, i, step, solver)(xa, xb, *common) for i in positions]
        end = propagate_step(statement, positions, step, solver)(e, *steps)
    return ca.Function("matrices_step", [e, xa, xb, *common], [end])
