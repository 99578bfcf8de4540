"""The extended Kalman filter of a nonlinear model, as functions that expand to SX (item 8).

Slopes are taken at the estimate: F at the one after the last measurement, H at the predicted one.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import casadi as ca

from covocp.base.arguments import checked, whole
from covocp.base.expressions import Expr
from covocp.base.gains import kalman_gain
from covocp.base.geometry import Geometry
from covocp.blocks import bucy
from covocp.blocks.arithmetic import apply, definite_solve, symmetric
from covocp.blocks.updates import Form, Missing, updating
from covocp.blocks.values import is_symbolic, weight, wrong_argument


@checked(substeps=whole(1, 10**4))
def extended(
    f: ca.Function,
    h: ca.Function,
    noise: Expr,
    R: Expr,
    *,
    step: Expr = None,
    substeps: int = 1,
    form: Form = "joseph",
    missing: Missing = "raise",
) -> tuple[ca.Function, ca.Function]:
    """Extended Kalman filter of x+ = f(x, u) + w, y = h(x) + v; or of dx/dt = f(x, u) + w, sampled.

    Args:
        f: function x -> x+, or (x, u) -> x+; with a step: to dx/dt.
        h: function x -> y.
        noise: covariance of w, shape (n, n): numbers, or a function of the arguments of f; with a step: its power
            spectral density.
        R: covariance of v, shape (m, m): numbers, or a function of x.
        step: sampling time of a continuous f [s], u is held over it; None: f is discrete. See `propagated`.
        substeps: of a step.
        form: of the update, see `update`.
        missing: "raise": readings are trusted, "skip": a row that is NaN, infinite or beyond 1e30 is no measurement.

    Returns:
        predict: (x, P[, u]) -> x, P before the next measurement; update: (x, P, y) -> x, P after it.

    Raises:
        ProblemError: f or h is no function of such shapes, noise or R does not fit or is not positive semidefinite.
    """
    model = _Model(f, h, noise, R, definite=False)
    x, P, y, u = model.symbols
    if step is None:
        moved = model.f(x, u)
        ahead = [ca.densify(moved), *apply(_covariance_after, P, ca.jacobian(moved, x), model.noise(x, u))]
    elif is_symbolic(step):
        raise wrong_argument("step", "a number [s]", f"an expression, {step}"[:80])
    else:
        rate, density = (_with_time(function, model) for function in (model.f, model.noise))
        ahead = propagated(rate, density, Estimated(x, P, ca.DM(0.0), u), bucy.time_step(step), substeps)
    predict = ca.Function(
        "predict", [x, P, u][: model.arguments + 1], ahead, model.names("x", "P"), ["estimate", "covariance"]
    )
    corrected = corrected_by(x, P, y, (model.h(x), model.R(x)), form, missing)
    return predict, ca.Function("update", [x, P, y], corrected, ["x", "P", "y"], ["estimate", "covariance"])


def extended_rate(f: ca.Function, h: ca.Function, noise: Expr, R: Expr) -> ca.Function:
    """Extended Kalman-Bucy filter of dx/dt = f(x, u) + w with the continuous measurement y = h(x) + v.

    Args:
        f: function x -> dx/dt, or (x, u) -> dx/dt.
        h: function x -> y.
        noise: power spectral density of w, shape (n, n): numbers, or a function of the arguments of f.
        R: power spectral density of v, positive definite, shape (m, m): numbers, or a function of x.

    Returns:
        (x, P, y[, u]) -> dx/dt, dP/dt.

    Raises:
        ProblemError: f or h is no function of such shapes, noise or R does not fit or is not positive semidefinite.
    """
    model = _Model(f, h, noise, R, definite=True)
    x, P, y, u = model.symbols
    slopes = bucy_slopes(x, P, y, (model.f(x, u), model.noise(x, u)), (model.h(x), model.R(x)))
    return ca.Function("rate", [x, P, y, u][: model.arguments + 2], slopes, model.names("x", "P", "y"), ["dx", "dP"])


def bucy_slopes(
    x: Expr,
    P: Expr,
    y: Expr,
    process: tuple[Any, Any],
    measurement: tuple[Any, Any],
    geometry: Geometry | None = None,
) -> list[Any]:
    """Rates f + K (y - h) and F P + P F' + Q - K U K', K = P H' U^-1, of the continuous filter.

    Args:
        x: symbol of the estimate.
        P: its covariance.
        y: measured values; there may be none.
        process: f and Q at x.
        measurement: h and U at x.
        geometry: of x, whose tangent the covariance is of; None: a vector.

    Returns:
        dx/dt and dP/dt.
    """
    f, noise = process
    h, density = measurement
    geometry = Geometry.vector(x.shape[0]) if geometry is None else geometry
    F, H = geometry.slope(x, f), geometry.tangent_slope(x, ca.jacobian(h, x))
    if not y.shape[0]:
        return [ca.densify(f), *apply(lambda P, F, Q: (F @ P + P @ F.T + Q,), P, F, noise)]
    solve = partial(definite_solve, what="measurement noise")
    (gain,) = apply(lambda P, H, U: (kalman_gain(P, H, U, solve),), P, H, density)
    corrected = gain @ (y - h)
    moved = corrected if geometry.plain else geometry.basis(x) @ corrected
    return [ca.densify(f + moved), bucy.rate(P, F, H, noise, density)]


class Estimated(NamedTuple):
    """Estimate x and covariance P, of its tangent, at a time t, and the control u."""

    x: Expr
    P: Expr
    t: Expr
    u: Expr


def propagated(
    rate: ca.Function,
    density: ca.Function,
    start: Estimated,
    step: Expr,
    substeps: int,
    geometry: Geometry | None = None,
) -> list[Any]:
    """Estimate and covariance after a step of a continuous model, positive semidefinite at any length of it.

    Each substep of length h is two Runge-Kutta steps with tangents Phi1, Phi2; the noise is added by Simpson's rule,
    h/6 (Phi Q0 Phi' + 4 Phi2 Q1 Phi2' + Q2), Phi = Phi2 Phi1. Order 4.

    Args:
        rate: (x, t, u) -> dx/dt.
        density: (x, t, u) -> power spectral density of the process noise.
        start: estimate, covariance, time and control at the start; the control is held.
        step: [s], a number or an expression.
        substeps: number of them.
        geometry: of x; None: a vector.

    Returns:
        Estimate and covariance.
    """
    x, P, t, u = start
    half, h = _half_step(rate, Geometry.vector(x.shape[0]) if geometry is None else geometry), step / substeps
    for _ in range(substeps):
        middle, first = half(x, t, u, h / 2)
        end, second = half(middle, t + h / 2, u, h / 2)
        noises = [density(*at) for at in ((x, t, u), (middle, t + h / 2, u), (end, t + h, u))]
        (P,) = apply(_simpson, P, first, second, *noises, h)
        x, t = end, t + h
    return [ca.densify(x), P]


def corrected_by(
    x: Expr,
    P: Expr,
    y: Expr,
    measurement: tuple[Any, Any],
    form: Form,
    missing: Missing,
    geometry: Geometry | None = None,
) -> list[Any]:
    """Estimate and covariance after a reading: the linear update by y - h.

    Args:
        x: symbol of the estimate.
        P: its covariance.
        y: the reading.
        measurement: h and the covariance of its noise at x.
        form: of the update.
        missing: what a row that is NaN means.
        geometry: of x, whose tangent the covariance is of; None: a vector.

    Returns:
        Estimate and covariance.
    """
    h, noise = measurement
    geometry = Geometry.vector(x.shape[0]) if geometry is None else geometry
    H = geometry.tangent_slope(x, ca.jacobian(h, x))
    change, after = apply(updating(form, missing), type(x).zeros(geometry.tangent), P, y - h, H, noise)
    return [ca.densify(geometry.move(x, change)), after]


def expands(function: ca.Function) -> bool:
    """Whether a function has an SX form; tables and external functions have none."""
    try:
        function.expand()
    except RuntimeError:
        return False
    return True


def _covariance_after(P: Expr, F: Expr, Q: Expr) -> tuple[Any]:
    return (symmetric(F @ P @ F.T + Q),)


def _simpson(P: Expr, first: Expr, second: Expr, start: Expr, middle: Expr, end: Expr, h: Expr) -> tuple[Any]:
    before = symmetric(P + h / 6 * start)
    between = first @ before @ first.T + 2 * h / 3 * middle
    return (symmetric(second @ between @ second.T + h / 6 * end),)


def _half_step(rate: ca.Function, geometry: Geometry) -> ca.Function:
    """(x, t, u, h) -> x after a Runge-Kutta step of length h, and the slope of that by x, from tangent to tangent."""
    kind: Any = ca.SX if expands(rate) else ca.MX
    x, t, u = kind.sym("x", rate.size1_in(0)), kind.sym("t"), kind.sym("u", rate.size1_in(2))
    h = kind.sym("h")
    end = geometry.step(lambda value, c: rate(value, t + c * h, u), x, h)
    return ca.Function("half_step", [x, t, u, h], [end, geometry.carried(x, end, ca.jacobian(end, x))])


class _Model:
    """The four functions of a filter, checked: f and noise of (x, u), h and R of x, with symbols that suit them."""

    def __init__(self, f: ca.Function, h: ca.Function, noise: Expr, R: Expr, *, definite: bool) -> None:
        size, controls = _check_function("f", f, (1, 2))
        _check_shape("f", f.size_out(0), (size, 1))
        if _check_function("h", h, (1,))[0] != size:
            raise wrong_argument("h", f"a function of {size} states, as f is", f"{h}")
        count = h.size1_out(0)
        _check_shape("h", h.size_out(0), (count, 1))
        self.arguments = f.n_in()
        self.h, w = h, _density("noise", noise, size, f, definite=False)
        self.R = _density("R", R, count, h, definite=definite)
        kind: Any = ca.SX if all(expands(function) for function in (f, h, w, self.R)) else ca.MX
        x, u = kind.sym("x", size), kind.sym("u", controls)
        self.symbols = x, kind.sym("P", size, size), kind.sym("y", count), u
        given = [x, u][: self.arguments]
        self.f = ca.Function("f", [x, u], [f(*given)])
        self.noise = ca.Function("noise", [x, u], [w(*given)])

    def names(self, *names: str) -> list[str]:
        """Names of inputs, with u where f has it."""
        return [*names, "u"] if self.arguments == 2 else list(names)


def _with_time(function: ca.Function, model: _Model) -> ca.Function:
    """(x, u) -> ... as a function of (x, t, u)."""
    x, _, _, u = model.symbols
    return ca.Function(function.name(), [x, type(x).sym("t"), u], [function(x, u)])


def _density(name: str, value: Expr, size: int, model: ca.Function, *, definite: bool) -> ca.Function:
    """A covariance as a function of the arguments of f or h."""
    if isinstance(value, ca.Function):
        if [value.size_in(i) for i in range(value.n_in())] != [model.size_in(i) for i in range(model.n_in())]:
            raise wrong_argument(name, f"a function of the arguments of {model}", f"{value}")
        _check_shape(name, value.size_out(0), (size, size))
        return value
    numbers = weight(name, value, size, definite=definite)
    if is_symbolic(numbers):
        raise wrong_argument(name, "numbers, or a casadi.Function", f"an expression, {numbers}"[:80])
    inputs = [ca.SX.sym(f"i{i}", *model.size_in(i)) for i in range(model.n_in())]
    return ca.Function(name, inputs, [ca.SX(numbers)])


def _check_function(name: str, function: Expr, counts: tuple[int, ...]) -> tuple[int, int]:
    """Rows of the first and of the second argument (0) of a function of columns.

    Raises:
        ProblemError: it is none.
    """
    wanted = "a casadi.Function of " + " or ".join(("x", "(x, u)")[count - 1] for count in counts)
    if not isinstance(function, ca.Function):
        raise wrong_argument(name, wanted, f"{type(function).__name__}")
    if function.n_in() not in counts or any(function.size2_in(i) != 1 for i in range(function.n_in())):
        raise wrong_argument(name, f"{wanted}, columns", f"{function}")
    return function.size1_in(0), function.size1_in(1) if function.n_in() == 2 else 0


def _check_shape(name: str, received: tuple[int, int], wanted: tuple[int, int]) -> None:
    if tuple(received) != wanted:
        raise wrong_argument(name, "values of shape {} x {}".format(*wanted), "{} x {}".format(*received))
