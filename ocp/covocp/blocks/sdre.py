"""State-dependent Riccati equation: at every x the linear-quadratic law of A0 + A(x), solved when it is called.

Section 5; what θ-D approximates. These laws are Python functions of numbers, for comparison, without a symbolic form.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.gains import weighted
from covocp.blocks import values
from covocp.blocks.algebraic import continuous
from covocp.blocks.factorisation import as_rows, dependence
from covocp.blocks.scaling import diagonal_scales, over

Array = NDArray[np.float64]
StateLaw = Callable[[ArrayLike, float], Array]

# Largest relative residual of a start whose one Newton step squares it to rounding, and of what that step leaves.
CLOSE = 1e-6
SOLVED = 1e-12
# Modes of a closed loop this share of the fastest one from the imaginary axis are left to the checked solver.
MARGINAL = 1e-12


def solution(x: Expr, A0: Expr, A: Expr, B: Expr, Q: Expr, R: Expr) -> Callable[[ArrayLike], Array]:
    """Stabilising solution P(x) of the Riccati equation of A0 + A(x).

    Args:
        x: CasADi symbol of the state, shape (n,), that A is written in.
        A0: numbers, (n, n) [1/s].
        A: an expression in x, (n, n) [1/s].
        B: input matrix, numbers, (n, m).
        Q: weight of the state, positive semidefinite, (n, n).
        R: weight of the input, positive definite, (m, m).

    Returns:
        Function of a state, shape (n,), that returns P, (n, n); it raises ProblemError where there is no solution.

    Raises:
        ProblemError: an argument does not fit.
    """
    return _regulator(x, A0, A, B, Q, R)[0]


def regulator(x: Expr, A0: Expr, A: Expr, B: Expr, Q: Expr, R: Expr) -> StateLaw:
    """Feedback u = -R^-1 B' P(x) x.

    Args:
        x: CasADi symbol of the state, shape (n,), that A is written in.
        A0: numbers, (n, n) [1/s].
        A: an expression in x, (n, n) [1/s].
        B: input matrix, numbers, (n, m).
        Q: weight of the state, positive semidefinite, (n, n).
        R: weight of the input, positive definite, (m, m).

    Returns:
        Function of a state, shape (n,), and a time, which does not matter, that returns u, shape (m,).

    Raises:
        ProblemError: an argument does not fit.
    """
    riccati, feedback = _regulator(x, A0, A, B, Q, R)

    def law(state: ArrayLike, time: float = 0.0) -> Array:
        given = _state("state", state, feedback.shape[1])
        return np.asarray(-feedback @ riccati(given) @ given)

    return law


def filter_gain(x: Expr, A0: Expr, A: Expr, H: Expr, W: Expr, V: Expr) -> StateLaw:
    """Gain P(x) H' V^-1 of the filter, P(x) from the dual Riccati equation.

    Args:
        x: CasADi symbol of the estimate, shape (n,), that A is written in.
        A0: numbers, (n, n) [1/s].
        A: an expression in x, (n, n) [1/s].
        H: measurement matrix, numbers, (p, n) or, of one measurement, (n,).
        W: power spectral density of the process noise, or a weight, positive semidefinite, (n, n).
        V: power spectral density of the measurement noise, or a weight, positive definite, (p, p).

    Returns:
        Function of an estimate, shape (n,), and a time, which does not matter, that returns the gain, (n, p).

    Raises:
        ProblemError: an argument does not fit.
    """
    constant = values.numeric("A0", values.square("A0", A0))
    size = constant.shape[0]
    rows = values.numeric("H", values.matrix("H", as_rows(H), (None, size)))
    w = values.numeric("W", values.weight("W", W, size))
    v = values.numeric("V", values.weight("V", V, rows.shape[0], definite=True))
    state, rest = dependence(x, A, size)
    riccati = _solution((state, rest.T), constant.T, rows.T, w, v)

    seen = weighted(rows, v)

    def gain(estimate: ArrayLike, time: float = 0.0) -> Array:
        return np.asarray(riccati(_state("estimate", estimate, size)) @ seen)

    return gain


def _regulator(x: Expr, A0: Expr, A: Expr, B: Expr, Q: Expr, R: Expr) -> tuple[Callable[[ArrayLike], Array], Array]:
    """P(x) and R^-1 B' of checked arguments."""
    constant = values.numeric("A0", values.square("A0", A0))
    size = constant.shape[0]
    column = values.numeric("B", values.matrix("B", B, (size, None)))
    q = values.numeric("Q", values.weight("Q", Q, size))
    r = values.numeric("R", values.weight("R", R, column.shape[1], definite=True))
    return _solution(dependence(x, A, size), constant, column, q, r), np.asarray(np.linalg.solve(r, column.T))


def _solution(rest: tuple[Any, Any], A0: Array, B: Array, Q: Array, R: Array) -> Callable[[ArrayLike], Array]:
    """P(x) of the matrices of a regulator, or of the dual of a filter."""
    inputs: Any = ([rest[0]], [rest[1]])
    evaluate = ca.Function("A", *inputs)
    weight = B @ np.linalg.solve(R, B.T)

    def riccati(state: ArrayLike) -> Array:
        given = _state("state", state, len(A0))
        factor = A0 + evaluate(given).full()
        found = _quickly(factor, B, Q, R, weight)
        if found is not None:
            return found
        try:
            return np.asarray(continuous(factor, B, Q, R))
        except (ValueError, np.linalg.LinAlgError) as error:
            raise _unsolved(given, str(error).splitlines()[0]) from error

    return riccati


def _quickly(A: Array, B: Array, Q: Array, R: Array, weight: Array) -> Array | None:
    """Scipy's solution and one step of Newton's method; None where that is not the stabilising one to rounding.

    A law is called at every step of a simulation, where the checked solver would take ten times as long. All is judged
    with the diagonal of the solution scaled to one: in mixed units scipy's may have no correct digit in a row.

    Args:
        A: of this state, (n, n).
        B: (n, m).
        Q: (n, n).
        R: (m, m).
        weight: B R^-1 B', (n, n).
    """
    from scipy.linalg import solve_continuous_are, solve_continuous_lyapunov

    try:
        first = np.asarray(solve_continuous_are(A, B, Q, R), dtype=float)
        units = diagonal_scales(first)
        A, weight = A * units[:, None] / units, weight * units[:, None] * units
        Q, first = over(Q, units), over(first, units)
        closed, residual = A - weight @ first, _residual(A, Q, weight, first)
        if not (_is_stable(closed) and residual[1] <= CLOSE):
            return None
        # the correction, not the solution anew: its rounding is as much smaller as it is itself
        found = values.symmetrised(first + np.asarray(solve_continuous_lyapunov(closed.T, -residual[0]), dtype=float))
    except (ValueError, np.linalg.LinAlgError):
        return None
    if not (_is_stable(A - weight @ found) and _residual(A, Q, weight, found)[1] <= SOLVED):
        return None
    return np.asarray(found * units[:, None] * units)


def _residual(A: Array, Q: Array, weight: Array, P: Array) -> tuple[Array, float]:
    """Of the Riccati equation, and its largest entry relative to that of the terms."""
    moved, spent = P @ A, P @ weight @ P
    residual = values.symmetrised(moved + moved.T + Q - spent)
    terms = max(np.abs(moved).max(initial=0.0), np.abs(spent).max(initial=0.0), np.abs(Q).max(initial=0.0))
    return residual, float(np.abs(residual).max(initial=0.0) / max(terms, np.finfo(float).tiny))


def _is_stable(closed: Array) -> bool:
    """Whether all modes decay, by more than the share of the fastest that makes a Lyapunov equation singular."""
    modes = np.linalg.eigvals(closed)
    return bool(modes.real.max(initial=-np.inf) < -MARGINAL * np.abs(modes).max(initial=0.0))


def _state(name: str, value: Expr, size: int) -> Array:
    """A state as numbers, (n,): another size would be repeated for all the components.

    Raises:
        ProblemError: an expression, another size, NaN or inf.
    """
    numbers = value if values.is_symbolic(value) else values.array(name, value).ravel()
    return values.numeric(name, values.matrix(name, numbers, (size, 1))).ravel()


def _unsolved(state: Array, received: str) -> ProblemError:
    at = "(" + ", ".join(f"{value:.6g}" for value in state) + ")"
    return ProblemError(
        f"The state-dependent Riccati equation has no solution at x = {at}.",
        expected="A0 + A(x) that the input can stabilise and the weights see",
        received=received,
        remedy="keep away from this state, change the factorisation, or use covocp.blocks.theta_d",
    )
