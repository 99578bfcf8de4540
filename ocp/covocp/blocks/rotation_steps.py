"""Steps that stay rotations, and gradients of functions of a rotation: a public part of `covocp.blocks.so3`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import ProblemError, remedy_for_symbols, shown
from covocp.base.expressions import Expr, Given
from covocp.blocks.rotation_entries import (
    Entries,
    antisymmetric_vector,
    cross_product,
    evaluated,
    inner_product,
    product,
    read_matrix,
    read_rotation,
    read_scalar,
    read_vector,
)
from covocp.blocks.rotations import exponential
from covocp.blocks.values import SYMBOLIC, array, holds_nan, is_symbolic, wrong_argument
from covocp.blocks.values import matrix as casadi_matrix

Dynamics = Callable[[Any, Any], tuple[Any, Any]]

# E at zero: with it in place of E(|sigma|^2) the rate of sigma is wrong by O(h^4) inside a step, the step by O(h^5).
COTANGENT_AT_ZERO = 1 / 12


def runge_kutta_step(dynamics: Dynamics, matrix: Expr, state: Expr, h: Expr) -> tuple[Any, Any]:
    """A step of order 4 of dC/dt = -omega^x C together with other states, whose attitude is a rotation to rounding.

    C = e^{-sigma^x} C_0 and the classical Runge-Kutta method for sigma and the states from sigma = 0. What rounding
    leaves of C C' - 1 is then squared: C <- C (1 + w N / 2), N = 1 - C'C, w = 1 / (1 + |N|^2). On rotations that does
    nothing; it draws an expression that is off them, such as an iterate of a solver, towards them.

    Args:
        dynamics: (C, x) -> (omega in body axes, shape (3,) [rad/s], dx/dt, as x); also a casadi.Function. Of stacks of
            numbers it gets stacks (..., 3, 3) and (..., n). A time that it needs is one of the states.
        matrix: C, a rotation, shape (3, 3), or numbers (..., 3, 3).
        state: x, whatever else moves, such as omega: shape (n,), as expression (n, 1), or numbers (..., n); n may be 0.
        h: length of the step [s].

    Returns:
        C and x after the step; equations (6) and (7), section 2.

    Raises:
        ProblemError: another shape, NaN, numbers that are no rotation, dynamics that do not return the two rates.
    """
    if not callable(dynamics):
        raise wrong_argument("dynamics", "a function (C, x) -> (omega, dx/dt)", shown(dynamics))
    start = read_rotation("matrix", matrix)
    step = _length(h)
    if is_symbolic(matrix, state, h):
        kind: Any = type(next(value for value in (matrix, state, h) if is_symbolic(value)))
        start = start if is_symbolic(start.value) else Entries(kind(ca.DM(start.value)), (3, 3), start.kind)
        x = casadi_matrix("state", state, (None, 1))
    else:
        x = array("state", state.full().ravel() if isinstance(state, ca.DM) else state)
        if not np.isfinite(x).all():
            raise wrong_argument("state", "finite numbers", "NaN or inf")

    def rates(sigma: Expr, x: Expr) -> tuple[Any, Any]:
        C = start.value if sigma is None else evaluated(_turned, start, read_vector("sigma", sigma))
        omega, rate = _rates(_called("dynamics", dynamics, C, x), x)
        return (omega if sigma is None else _vector_rate(sigma, omega)), rate

    first = rates(None, x)
    second = rates(0.5 * step * first[0], x + 0.5 * step * first[1])
    third = rates(0.5 * step * second[0], x + 0.5 * step * second[1])
    fourth = rates(step * third[0], x + step * third[1])
    sigma, change = (
        step / 6 * (a + 2 * b + 2 * c + d) for a, b, c, d in zip(first, second, third, fourth, strict=True)
    )
    return evaluated(_turned_exactly, start, read_vector("sigma", sigma)), x + change


def increment(first: Expr, middle: Expr, last: Expr, h: Expr) -> Any:
    """The rotation vector of a step of order 4 whose rates are known at its start, middle and end.

    Args:
        first: omega at the start of the step, in body axes, shape (3,), as expression (3, 1), or numbers (..., 3)
            [rad/s].
        middle: omega in the middle of the step.
        last: omega at its end.
        h: length of the step [s].

    Returns:
        sigma = h (omega_0 + 4 omega_1/2 + omega_1) / 6 + h^2 omega_0 x omega_1 / 12, as omega, for
        C <- exp(sigma) C or `quaternion_step` [rad]; section 2.

    Raises:
        ProblemError: another shape, NaN.
    """
    rates = [read_vector(*pair) for pair in (("first", first), ("middle", middle), ("last", last))]
    return evaluated(_increment, *rates, read_scalar("h", h))


def body_gradient(function: Expr, matrix: Expr) -> Any:
    """The gradient b in body axes of a function of a rotation: f(e^{-phi^x} C) = f(C) + b'phi + O(phi^2).

    Args:
        function: an expression of one entry in the symbol `matrix`, or a function of C, such as a casadi.Function, that
            returns one.
        matrix: the symbol C, (3, 3); for a function also another expression, a rotation (3, 3), or numbers (..., 3, 3).
            Each call with numbers derives again: for many, make a casadi.Function of the expression once.

    Returns:
        b = 2 P_a(C grad')^vee with grad the matrix of the derivatives of f by the entries of C, shape (3,), as
        expression (3, 1), or numbers (..., 3), in the units of f per radian; equation (8), Proposition 5.

    Raises:
        ProblemError: no function of C with one entry, another shape, numbers that are no rotation.
    """
    at = read_rotation("matrix", matrix)
    if isinstance(function, SYMBOLIC):
        if type(function) is not type(matrix) or not matrix.is_valid_input():
            raise wrong_argument("matrix", "the symbol in which function is an expression", shown(matrix))
        return _gradient(function, matrix)
    if not callable(function):
        raise wrong_argument("function", "an expression, or a function of C", shown(function))
    kind = type(at.value) if is_symbolic(at.value) else ca.MX
    symbol = kind.sym("C", 3, 3)
    value = _called("function", function, symbol)
    value = value if isinstance(value, kind) else kind(casadi_matrix("function", value))
    law = ca.Function("body_gradient", [symbol], [_gradient(value, symbol)])
    if is_symbolic(at.value):
        return law(at.value)
    stack = at.value.reshape(-1, 3, 3)
    if not len(stack):
        return np.empty((*at.value.shape[:-2], 3))
    columns = law.map(len(stack))(np.concatenate(list(stack), axis=1)).full()
    return columns.T.reshape(*at.value.shape[:-2], 3)


def _gradient(value: Expr, symbol: Expr) -> Any:
    if value.shape != (1, 1):
        raise wrong_argument("function", "a function of one entry", "shape " + " x ".join(map(str, value.shape)))
    derivatives = ca.reshape(ca.densify(ca.jacobian(value, symbol)), 3, 3)
    return evaluated(_body_gradient, read_matrix("function", derivatives), read_matrix("matrix", symbol))


def _called(name: str, function: Callable[..., Any], *arguments: Expr) -> Any:
    """What a function of the user returns.

    Raises:
        ProblemError: it fails, or makes NaN of symbols.
    """
    expected = "a function of C" if len(arguments) == 1 else "a function of (C, x)"
    try:
        result = function(*arguments)
    except ProblemError:
        raise
    except Exception as error:  # whatever the user's function raises
        received, remedy = f"{type(error).__name__}: {error}"[:200], remedy_for_symbols(error, f"correct {name}")
        raise wrong_argument(name, expected, received, remedy) from error
    if is_symbolic(*arguments) and holds_nan(result):
        remedy = "take casadi.sin and its like in place of math.sin, and no float() of symbols"
        raise wrong_argument(name, expected, "NaN, which math.sin and its like make of a symbol", remedy)
    return result


def _length(h: Given) -> Any:
    """The length of a step.

    Raises:
        ProblemError: no number and no scalar expression.
    """
    step = read_scalar("h", h).value
    if is_symbolic(step):
        return step
    if step.ndim:
        raise wrong_argument("h", "one number", f"shape {step.shape}")
    return float(step)


def _rates(result: Given, x: Expr) -> tuple[Any, Any]:
    """Angular rate and rate of the state.

    Raises:
        ProblemError: something else.
    """
    if not isinstance(result, (tuple, list)) or len(result) != 2:
        raise wrong_argument("dynamics", "a function that returns (omega, dx/dt)", shown(result))
    omega = read_vector("dynamics, omega", result[0]).value
    if is_symbolic(x, result[1]) or isinstance(x, ca.DM):
        return ca.densify(_column(omega)), casadi_matrix("dynamics, dx/dt", result[1], x.shape)
    rate = array("dynamics, dx/dt", result[1])
    rate = rate.ravel() if isinstance(result[1], ca.DM) else rate
    if rate.shape != x.shape:
        raise wrong_argument("dynamics, dx/dt", f"shape {x.shape}, that of the state", f"shape {rate.shape}")
    return omega, rate


def _column(value: Expr) -> Any:
    return value if is_symbolic(value) else ca.DM(value)


def _vector_rate(sigma: Expr, omega: Expr) -> Any:
    return evaluated(_rate_of_vector, read_vector("sigma", sigma), read_vector("omega", omega))


def _rate_of_vector(sigma: list[Any], omega: list[Any]) -> list[Any]:
    once = cross_product(sigma, omega)
    twice = cross_product(sigma, once)
    return [omega[i] + 0.5 * once[i] + COTANGENT_AT_ZERO * twice[i] for i in range(3)]


def _turned(C: list[Any], sigma: list[Any]) -> list[Any]:
    return product(exponential(sigma), C)


def _turned_exactly(C: list[Any], sigma: list[Any]) -> list[Any]:
    return _orthogonalised(_turned(C, sigma))


def _orthogonalised(C: list[Any]) -> list[Any]:
    """C (1 + w N / 2), N = 1 - C'C, w = 1 / (1 + |N|^2): a Newton step to the nearest rotation, bounded far from it."""
    columns = [[row[j] for row in C] for j in range(3)]
    defect = [[(1 if i == j else 0) - inner_product(columns[i], columns[j]) for j in range(3)] for i in range(3)]
    flat = [entry for row in defect for entry in row]
    half = 0.5 / (1 + inner_product(flat, flat))
    correction = product(C, defect)
    return [[C[i][j] + half * correction[i][j] for j in range(3)] for i in range(3)]


def _increment(first: list[Any], middle: list[Any], last: list[Any], h: Expr) -> list[Any]:
    turned = cross_product(first, last)
    return [h / 6 * (first[i] + 4 * middle[i] + last[i]) + h * h / 12 * turned[i] for i in range(3)]


def _body_gradient(derivatives: list[Any], C: list[Any]) -> list[Any]:
    transposed = [[row[j] for row in derivatives] for j in range(3)]
    return [2 * entry for entry in antisymmetric_vector(product(C, transposed))]
