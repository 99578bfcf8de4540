"""One control interval: the nominal by Runge-Kutta, the covariances given the nominal by gauss, strang or rk4 steps.

All functions made here take one control interval [s, s + ds] of the normalised time s = t/T, the controls at its two
ends, and cut it into `substeps` equal steps. Their common arguments, after state (and half-vectors), are

    (control at the start, control at the end, s, ds, T, parameters)

Covariance steps for V = F E + E F' + Q - E W E, as 2n x 2n *step matrices* D with E+ = (D21 + D22 E)(D11 + D12 E)^-1:

- gauss: two-stage Gauss method for X' = -F'X + W Y, Y' = Q X + F Y, E = Y X^-1. Symplectic, order 4, positive
  semidefinite at any step size (Dieci and Eirola, Numer. Math. 67, 1994).
- strang: half a measurement update, half the noise, transition with the tangent of the Runge-Kutta step, half the
  noise, half a measurement update. Order 2, positive semidefinite at any step size.

rk4 is the classical Runge-Kutta step of nominal and half-vectors together, for any rate.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np

from covocp.matrices import pack_symbolic, unpack_symbolic
from covocp.statement import Statement

Step = Literal["gauss", "strang", "rk4"]

# Fastest for dense systems of this size; COMPILED_SOLVER can be written out as C code.
LINEAR_SOLVER = "lapacklu"
COMPILED_SOLVER = "qr"
# With equilibration LAPACK's interface prints every matrix that has a zero row. By default a pivot of the QR's is zero
# below 1e-12, whatever the units.
SOLVER_OPTIONS: dict[str, dict[str, Any]] = {"lapacklu": {"equilibration": False}, "qr": {"eps": 1e-300}}
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


def linear_solve(matrix: Any, right: Any, solver: str) -> Any:
    """matrix^-1 right; where the matrix is singular the evaluation fails, without a word on the terminal.

    CasADi's QR does not exchange rows, so it loses what rows of different units differ by (Mars entry in feet and
    radians: 11 digits of the cost). So they are divided by their norms, on which the result and its slope do not
    depend, and one step of refinement restores the rest (Higham, BIT 31, 1991).
    """
    options = SOLVER_OPTIONS.get(solver, {})
    if solver != COMPILED_SOLVER:
        return ca.solve(matrix, right, solver, options)
    inverse_norms = ca.diag(ca.stop_diff(1 / ca.sum2(ca.fabs(matrix)), 1))
    matrix, right = inverse_norms @ matrix, inverse_norms @ right
    first = ca.solve(matrix, right, solver, options)
    return first + ca.solve(matrix, right - matrix @ first, solver, options)


def _slopes(statement: Statement, count: int) -> dict[str, Any]:
    """Option of a function of `count` values and the common arguments: what it is never differentiated by.

    The adjoint of a step is the dearest function of all; slopes by the mesh and the parameters would add a third.
    """
    return {"is_diff_in": [True] * (count + 2) + [False, False, statement.duration.free, False]}


@lru_cache(maxsize=KEPT)
def nominal_interval(statement: Statement, substeps: int) -> ca.Function:
    """The nominal over one control interval by classical Runge-Kutta steps.

    Returns:
        (x, *common) -> state at the end, states at the ends of the substeps (nx, substeps), integral of the running
        cost (0 where that depends on the matrices).
    """
    symbolic: Any = statement.symbolic
    nominal = statement.nominal
    if nominal is None:
        raise ValueError("a coupled problem has no separate nominal")
    x = symbolic.sym("x", statement.nx)
    common = interval_symbols(statement, symbolic)
    ua, ub, s, ds, duration, p = common

    def rate(value: Any, c: Any) -> Any:
        outputs = nominal(value[:-1], ua + c * (ub - ua), duration * (s + c * ds), duration, p)
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

    def rate(value: Any, c: Any) -> Any:
        control, time = ua + c * (ub - ua), duration * (s + c * ds)
        return ca.vertcat(*statement.rates(value[:nx], control, value[nx:-1], time, duration, p))

    stacked, cost = _runge_kutta(rate, ca.vertcat(z, 0), duration * ds, substeps)
    return ca.Function("joint_interval", [z, *common], [stacked[:, -1], stacked, cost], _slopes(statement, 1))


def _runge_kutta(rate: Callable[[Any, Any], Any], start: Any, h: Any, substeps: int) -> tuple[Any, Any]:
    """Classical Runge-Kutta over an interval of length h; rate(value, c), c in [0, 1]; the last entry is the cost."""
    value, values = start, []
    step = h / substeps
    for j in range(substeps):
        c, d = j / substeps, 1.0 / substeps
        k1 = rate(value, c)
        k2 = rate(value + step / 2 * k1, c + d / 2)
        k3 = rate(value + step / 2 * k2, c + d / 2)
        k4 = rate(value + step * k3, c + d)
        value = value + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        values.append(value)
    stacked = ca.horzcat(*values)
    return stacked[:-1, :], stacked[-1, -1]


@lru_cache(maxsize=KEPT)
def step_matrix(statement: Statement, index: int, step: Step, solver: str = LINEAR_SOLVER) -> ca.Function:
    """The step matrix D of one matrix state over one substep, given the nominal at both ends of it.

    Returns:
        (xa, xb, *common of the substep) -> D, shape (2n, 2n); it does not depend on E.
    """
    size = statement.matrices[index].size
    inner = _gauss_points(statement, index) if step == "gauss" else _strang_parts(statement, index)
    xa, xb = ca.MX.sym("xa", statement.nx), ca.MX.sym("xb", statement.nx)
    common = interval_symbols(statement, ca.MX)
    compose = gauss_matrix if step == "gauss" else _strang_matrix
    value = compose(inner(xa, xb, *common), size, solver)
    return ca.Function("step_matrix", [xa, xb, *common], [value], _slopes(statement, 2))


@lru_cache(maxsize=KEPT)
def _gauss_points(statement: Statement, index: int) -> ca.Function:
    """h H at the two Gauss points, H = [-F' W; Q F], the nominal between the ends by a cubic Hermite polynomial."""
    form = _form(statement, index)
    symbolic: Any = statement.symbolic
    xa, xb = symbolic.sym("xa", statement.nx), symbolic.sym("xb", statement.nx)
    common = interval_symbols(statement, symbolic)
    ua, ub, s, ds, duration, p = common
    h = duration * ds
    fa = _slope(statement, xa, ua, s, duration, p)
    fb = _slope(statement, xb, ub, s + ds, duration, p)
    points = []
    for c in GAUSS_NODES:
        x = hermite(xa, xb, h * fa, h * fb, c)
        drift, noise, information = form(x, ua + c * (ub - ua), duration * (s + c * ds), duration, p)
        points.append(h * ca.blockcat([[-drift.T, information], [noise, drift]]))
    return ca.Function("gauss_points", [xa, xb, *common], points, _slopes(statement, 2))


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
        u, t = ua + c * (ub - ua), duration * (s + c * ds)
        return _slope(statement, x, u, s + c * ds, duration, p), form(x, u, t, duration, p)[0] @ transition

    unit = ca.DM.eye(size)
    k1, m1 = rates(xa, unit, 0.0)
    k2, m2 = rates(xa + h / 2 * k1, unit + h / 2 * m1, 0.5)
    k3, m3 = rates(xa + h / 2 * k2, unit + h / 2 * m2, 0.5)
    _, m4 = rates(xa + h * k3, unit + h * m3, 1.0)
    transition = unit + h / 6 * (m1 + 2 * m2 + 2 * m3 + m4)
    _, noise_a, information_a = form(xa, ua, duration * s, duration, p)
    _, noise_b, information_b = form(xb, ub, duration * (s + ds), duration, p)
    outputs = [transition, *(h / 2 * entry for entry in (noise_a, information_a, noise_b, information_b))]
    dense = [ca.densify(entry) for entry in outputs]
    return ca.Function("strang_parts", [xa, xb, *common], dense, _slopes(statement, 2))


def _strang_matrix(parts: Any, size: int, solver: str) -> Any:
    """Product of the elementary step matrices; update with W: [I W; 0 I], noise Q: [I 0; Q I]."""
    transition, noise_a, information_a, noise_b, information_b = parts
    unit, zero = ca.DM.eye(size), ca.DM(size, size)
    update_a, update_b = (ca.blockcat([[unit, w], [zero, unit]]) for w in (information_a, information_b))
    diffuse_a, diffuse_b = (ca.blockcat([[unit, zero], [q, unit]]) for q in (noise_a, noise_b))
    move = ca.blockcat([[linear_solve(transition.T, unit, solver), zero], [zero, transition]])
    return update_b @ diffuse_b @ move @ diffuse_a @ update_a


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


def apply_step(matrix: Any, half: Any, size: int, solver: str = LINEAR_SOLVER) -> Any:
    """Half-vector of E+ = (D21 + D22 E)(D11 + D12 E)^-1, symmetrised."""
    covariance = unpack_symbolic(half, size)
    below = matrix[size:, :size] + matrix[size:, size:] @ covariance
    above = matrix[:size, :size] + matrix[:size, size:] @ covariance
    return pack_symbolic(linear_solve(above.T, below.T, solver))


@lru_cache(maxsize=KEPT)
def propagate_step(statement: Statement, positions: tuple[int, ...], solver: str = LINEAR_SOLVER) -> ca.Function:
    """Half-vectors of some matrices over one substep, given their step matrices.

    Returns:
        (their half-vectors stacked, D of the first (2n, 2n), D of the second, ...) -> half-vectors after the substep.
    """
    blocks = [statement.matrices[i] for i in positions]
    e = ca.MX.sym("e", sum(block.length for block in blocks))
    steps = [ca.MX.sym(f"d_{block.name}", 2 * block.size, 2 * block.size) for block in blocks]
    offsets = np.cumsum([0, *(block.length for block in blocks)]).tolist()
    halves = [
        apply_step(step, e[i:j], block.size, solver)
        for step, block, i, j in zip(steps, blocks, offsets, offsets[1:], strict=False)
    ]
    return ca.Function("propagate_step", [e, *steps], [ca.vertcat(*halves)])


@lru_cache(maxsize=KEPT)
def simpson_interval(statement: Statement, substeps: int) -> ca.Function:
    """Integral of a running cost that depends on the matrices, by Simpson's rule over pairs of substeps.

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
    total = 0
    for j in range(substeps + 1):
        c = j / substeps
        weight = (1 if j in (0, substeps) else 4 if j % 2 else 2) / (3 * substeps)
        xj, ej = (x, e) if j == 0 else (states[:, j - 1], halves[:, j - 1])
        cost = statement.rates(xj, ua + c * (ub - ua), ej, duration * (s + c * ds), duration, p)[2]
        total = total + weight * cost
    return ca.Function(
        "simpson_interval", [x, e, states, halves, *common], [duration * ds * total], _slopes(statement, 4)
    )


@lru_cache(maxsize=KEPT)
def full_interval(statement: Statement, substeps: int, step: Step, solver: str = LINEAR_SOLVER) -> ca.Function:
    """Nominal and half-vectors over one control interval with the given covariance step.

    Returns:
        (x and e stacked, *common) -> the stack at the end, at the ends of the substeps (nx + ne, substeps), integral
        of the running cost.
    """
    if step == "rk4" or not statement.matrices:
        return joint_interval(statement, substeps)
    z = ca.MX.sym("z", statement.nx + statement.ne)
    x, e = z[: statement.nx], z[statement.nx :]
    common = interval_symbols(statement, ca.MX)
    ua, ub, s, ds, duration, p = common
    _, states, cost = nominal_interval(statement, substeps)(x, *common)
    starts = ca.horzcat(x, states[:, : substeps - 1])
    matrices = [step_matrix(statement, i, step, solver) for i in range(len(statement.matrices))]
    propagate = propagate_step(statement, tuple(range(len(matrices))), solver)
    columns = []
    half = e
    for j in range(substeps):
        c, d = j / substeps, (j + 1) / substeps
        ends = (ua + c * (ub - ua), ua + d * (ub - ua), s + c * ds, ds / substeps, duration, p)
        half = propagate(half, *(matrix(starts[:, j], states[:, j], *ends) for matrix in matrices))
        columns.append(half)
    halves = ca.horzcat(*columns)
    if statement.running_uses_matrices:
        cost = simpson_interval(statement, substeps)(x, e, states, halves, *common)
    fine = ca.vertcat(states, halves)
    return ca.Function("full_interval", [z, *common], [fine[:, -1], fine, cost], _slopes(statement, 1))
