"""Whether a problem meets the conditions under which the information of its parameters is quadratic in the control.

The conditions of `reduction` and of the lower bound in `certify`. Expressions are examined by their structure: a
Jacobian is constant where it contains no state and no control, and the expression has no kinks or jumps in them. So an
expression that is affine only after cancellation, or only in a range, is refused.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.analysis.reduction import Parts, parts
from covocp.base.expressions import Given
from covocp.base.kinks import kinked
from covocp.base.matrices import Array, is_semidefinite, standard_deviations, unpack, unpack_costate
from covocp.statement.statement import Conditions, Statement

# A correlation at the start counts as none below this, a weight outside E_bb below this share of the largest entry.
NEGLIGIBLE = 1e-12
# Times at which the running cost must be strictly convex in the control, a prime number of intervals so that few waves
# fall between them all, and the least values between which lower ones are looked for.
CONVEXITY_TIMES = 2004
CONVEXITY_MINIMA = 10


def why_not(statement: Statement, parameters: Array) -> str:
    """The first condition that a statement does not meet, a sentence; "" where it meets all.

    Args:
        statement: the problem.
        parameters: values of known parameters and means of unknowns, shape (np,).
    """
    reason = _kind(statement) or _start(statement, parameters)
    if reason:
        return reason
    given = parts(statement, parameters)
    return _models(statement, given) or _costs(statement, given, parameters) or _constraints(statement, parameters)


def _kind(statement: Statement) -> str:
    """What the problem must consist of."""
    if not any(block.estimation for block in statement.matrices):
        return "the problem has no estimation covariance"
    for block in statement.states:
        if block.tangent:
            return f"the state '{block.name}' is an attitude, no vector"
    if not statement.of_kind("unknown"):
        return "the problem has no unknown parameters"
    if len(statement.matrices) > 1:
        names = ", ".join(block.name for block in statement.matrices if not block.estimation)
        return f"the problem has matrix states beside the estimation covariance: {names}"
    if len(statement.moving) < statement.nx:
        others = ", ".join(f"{block.role} {block.name}" for block in statement.states if block.role != "moving")
        return f"the problem has decisions or integrals: {others}"
    if statement.coupled:
        return "the nominal depends on the estimation covariance"
    if statement.samples is not None:
        names = ", ".join(block.name for block in statement.samples.blocks)
        return f"measurements are taken at instants, where information is no density along the way: {names}"
    if statement.inside.size:
        return "conditions hold at instants inside the horizon: " + ", ".join(statement.inside.names)
    if statement.measurement is None:
        return "nothing is measured"
    if not statement.nu:
        return "the problem has no control"
    return "the duration is free" if statement.duration.free else ""


def _start(statement: Statement, parameters: Array) -> str:
    """The initial state is given; state and parameters are not correlated."""
    x0, _, e0, _ = statement.boundary_values(parameters)
    if np.isnan(x0).any():
        return "the initial state is free"
    if np.isnan(e0).any():
        return "the initial covariance is free"
    nx, E0 = statement.nx, unpack(e0, statement.matrices[0].size)
    # Of correlations: covariances of a state in metres and a parameter in radians have no size in common.
    spreads = standard_deviations(E0)
    if (np.abs(E0[:nx, nx:]) > NEGLIGIBLE * np.outer(spreads[:nx], spreads[nx:])).any():
        return "state and parameters are correlated at the start"
    units = np.where(spreads[nx:] > 0.0, spreads[nx:], 1.0)
    values = np.linalg.eigvalsh(E0[nx:, nx:] / units[:, None] / units)
    if values[0] <= NEGLIGIBLE * values[-1]:
        return "the initial covariance of the parameters is singular (a parameter, or a combination, is known)"
    return ""


def _varying(rows: Given, z: Given) -> list[int]:
    """Rows of a matrix that depend on state or control."""
    return [i for i in range(rows.shape[0]) if ca.depends_on(rows[i, :], z) or kinked(rows[i, :], z)]


def _slopes_vary(rows: Given, z: Given) -> list[int]:
    """Rows of a matrix that are not affine in state and control."""
    return [
        i for i in range(rows.shape[0]) if ca.depends_on(ca.jacobian(ca.vec(rows[i, :]), z), z) or kinked(rows[i, :], z)
    ]


def _models(statement: Statement, given: Parts) -> str:
    """Dynamics, noise and measurements."""
    z, nx = given.z, statement.nx
    size = given.density.shape[0]
    names = statement.measurement_names
    measurements = names if len(names) == size else (", ".join(names),) * size
    checks = (
        (_slopes_vary(given.rate, z), statement.state_names, "the rate of {} is not affine in state and control"),
        (
            _slopes_vary(given.drift, z),
            statement.state_names,
            "the slope of the rate of {} by the parameters is not affine in state and control",
        ),
        (_varying(given.noise, z), statement.state_names, "the noise of {} depends on state or control"),
        (
            _varying(given.measured[:, :nx], z),
            measurements,
            "the slope of measurement {} by the state depends on state or control",
        ),
        (
            _slopes_vary(given.measured[:, nx:], z),
            measurements,
            "the slope of measurement {} by the parameters is not affine in state and control",
        ),
        (_varying(given.density, z), measurements, "the noise of measurement {} depends on state or control"),
    )
    for rows, labels, text in checks:
        if rows:
            return text.format(", ".join(dict.fromkeys(f"'{labels[i]}'" for i in rows)))
    return ""


def _costs(statement: Statement, given: Parts, parameters: Array) -> str:
    """Quadratic in state and control, linear in E_bb(T)."""
    if statement.running_uses_matrices:
        return "the running cost depends on the covariance"
    nx, symbolic = statement.nx, statement.symbolic
    hessian = ca.hessian(given.running, given.z)[0]
    if kinked(given.running, given.z):
        return "the running cost has kinks or jumps in state or control"
    if ca.depends_on(hessian, given.z):
        return "the running cost is not quadratic in state and control"
    energy = ca.Function("energy", [given.z, given.time], [ca.densify(hessian[nx:, nx:])])
    at = _not_convex(energy, statement.duration.guess, ca.depends_on(hessian, given.time))
    if at is not None:
        return f"the running cost is not strictly convex in the control (at t = {at:.6g} s)"
    x, e = symbolic.sym("x", nx), symbolic.sym("e", statement.ne)  # type: ignore[attr-defined]
    arguments = [x, e, symbolic(statement.duration.guess), symbolic(ca.DM(parameters))]
    value = statement.terminal.call(arguments, True, False)[0]
    if kinked(value, ca.vertcat(x, e)):
        return "the terminal cost has kinks or jumps"
    if ca.depends_on(ca.gradient(value, e), ca.vertcat(x, e)):
        return "the terminal cost is not linear in the covariance"
    if ca.depends_on(ca.hessian(value, x)[0], x):
        return "the terminal cost is not quadratic in the state"
    C = terminal_weight(statement, parameters)
    outside = max(np.abs(C[:nx]).max(), np.abs(C[:, :nx]).max())
    if outside > NEGLIGIBLE * np.abs(C).max():
        return "the terminal cost weighs entries of the covariance other than those of the parameters"
    return "" if is_semidefinite(C) else "the weight of the parameters' covariance is not positive semidefinite"


def _not_convex(energy: ca.Function, duration: float, varies: bool) -> float | None:
    """A time at which L_uu is not positive definite; None where there is none.

    Where it varies, many times are looked at, and between those where its smallest eigenvalue is least.
    """

    def smallest(t: float) -> float:
        return float(np.linalg.eigvalsh(np.asarray(energy(0, t).full()))[0])

    if not varies:
        return None if smallest(0.0) > 0 else 0.0
    from scipy.optimize import minimize_scalar  # here: importing scipy takes longer than all of covocp

    times = np.linspace(0.0, duration, CONVEXITY_TIMES)
    columns = np.asarray(energy.map(times.size)(np.zeros((energy.size1_in(0), times.size)), times[None, :]).full())
    nu = columns.shape[0]
    values = np.linalg.eigvalsh(columns.reshape(nu, times.size, nu).transpose(1, 0, 2))[:, 0]
    inner = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:])) + 1
    for k in inner[np.argsort(values[inner])][:CONVEXITY_MINIMA]:
        found = minimize_scalar(smallest, bounds=(times[k - 1], times[k + 1]), method="bounded")
        if found.fun < values[k]:
            times[k], values[k] = found.x, found.fun
    least = int(np.argmin(values))
    return float(times[least]) if values[least] <= 0 else None


def _constraints(statement: Statement, parameters: Array) -> str:
    """Affine in state and control, none on the covariance."""
    if not np.isnan(statement.boundary_values(parameters)[3]).all():
        return "the covariance has a given final value"
    for conditions in (statement.path, statement.start, statement.end):
        if not conditions.size:
            continue
        names = ", ".join(f"'{name}'" for name in conditions.names)
        if conditions.uses_matrices:
            return f"constraints depend on the covariance (among {names})"
        z, _, expression = condition(statement, conditions, parameters)
        rows = _slopes_vary(expression, z)
        if rows:
            names = ", ".join(f"'{conditions.names[i]}'" for i in rows)
            return f"constraints are not affine in state and control: {names}"
    return ""


def terminal_weight(statement: Statement, parameters: Array) -> Array:
    """C of the terminal cost tr(C E(T)) in the estimation covariance, of which it must be a linear function; (n, n)."""
    e = np.zeros(statement.ne)
    x = ca.DM.zeros(statement.nx)
    symbol = ca.MX.sym("e", statement.ne)
    value = statement.terminal(x, symbol, statement.duration.guess, parameters)
    slope = ca.Function("slope", [symbol], [ca.densify(ca.gradient(value, symbol))])(e)
    return np.asarray(unpack_costate(np.asarray(slope.full()).ravel(), statement.matrices[0].size))


def end_slopes(statement: Statement, parameters: Array, x: Array) -> tuple[Array, Array]:
    """Gradient (nx,) and Hessian (nx, nx) of the terminal cost by the state, without the matrices."""
    symbol = ca.MX.sym("x", statement.nx)
    value = statement.terminal(symbol, ca.DM.zeros(statement.ne), statement.duration.guess, parameters)
    hessian, gradient = ca.hessian(value, symbol)
    outputs = ca.Function("slopes", [symbol], [ca.densify(gradient), ca.densify(hessian)])(x)
    return np.asarray(outputs[0].full()).ravel(), np.asarray(outputs[1].full())


def terminal_cost(statement: Statement, parameters: Array, x: Array) -> float:
    """The terminal cost of a state, without the matrices."""
    return float(statement.terminal(x, np.zeros(statement.ne), statement.duration.guess, parameters))


def condition(statement: Statement, conditions: Conditions, parameters: Array) -> tuple[Any, Any, Any]:
    """z = (state, control), time, and conditions without matrices as an expression of them."""
    symbolic: Any = statement.symbolic
    z, time = symbolic.sym("z", statement.nx + statement.nu), symbolic.sym("t")
    e, duration = symbolic.zeros(statement.ne), symbolic(statement.duration.guess)
    arguments = [z[: statement.nx], z[statement.nx :], e, time, duration, symbolic(ca.DM(parameters))]
    return z, time, conditions.function.call(arguments, True, False)[0]
