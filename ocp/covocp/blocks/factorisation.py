"""Dynamics in factored form, f(x) = (A0 + A(x)) x: A(x) as the laws need it, its check, and integral states."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.arguments import checked, whole
from covocp.base.errors import ProblemError, remedy_for_symbols
from covocp.base.expressions import Expr
from covocp.blocks import values

Array = NDArray[np.float64]

# Sizes of random states.
SCALES = (0.03, 0.3, 1.0, 3.0)
# A factorisation may differ from the function by this much, relative to the larger of |F(x)| |x| and |f(x)|.
TOLERANCE = 1e-9


def in_state(name: str, x: Expr, expression: Expr, state: Expr) -> Any:
    """An expression in the user's symbol, SX or MX, as SX in another symbol.

    Args:
        name: of the expression, for messages.
        x: the user's symbol, shape (n,).
        expression: in x alone, or numbers.
        state: SX symbol, shape (n,).

    Raises:
        ProblemError: x is no symbol of that shape, or the expression has other symbols or cannot be expanded.
    """
    if not isinstance(x, values.SYMBOLIC) or not x.is_valid_input() or x.shape != state.shape:
        raise ProblemError(
            "The argument 'x' is not the state.",
            expected=f"the CasADi symbol that {name} is written in, shape {state.shape[0]} x 1",
            received=f"{type(x).__name__}: {x!r}"[:100],
            remedy='make it with casadi.SX.sym("x", n)',
        )
    if isinstance(expression, ca.DM):
        return ca.SX(expression)
    received = f"an expression of type {type(expression).__name__}"
    if isinstance(expression, type(x)):
        inputs: Any = ([x], [expression])
        known = {str(symbol) for symbol in ca.symvar(x)}
        others = [str(symbol) for symbol in ca.symvar(expression) if str(symbol) not in known]
        try:
            return ca.Function("expression", *inputs).expand()(state)
        except (RuntimeError, NotImplementedError) as error:
            received = "the symbols " + ", ".join(others) if others else " ".join(str(error).split())[-200:]
    raise ProblemError(
        f"The argument '{name}' is no function of x alone.",
        expected=f"an expression in x, {type(x).__name__} like x, of operations that CasADi can write as SX",
        received=received,
        remedy=f"write {name} with x and numbers only",
    )


def dependence(x: Expr, A: Expr, size: int) -> tuple[Any, Any]:
    """The state as a new SX symbol, shape (n,), and A(x) in it, (n, n); see `in_state`."""
    state = ca.SX.sym("x", size)
    return state, in_state("A", x, values.square("A", A, size), state)


def random_states(size: int, count: int, seed: int, scales: tuple[float, ...] = SCALES) -> Array:
    """Random states, (count, size): normal numbers, each times one of the scales."""
    generator = np.random.default_rng(seed)
    return np.asarray(generator.standard_normal((count, size)) * generator.choice(np.array(scales), (count, size)))


def as_states(states: Expr, size: int) -> Array:
    """States given by the user, one in each row, (samples, size).

    Raises:
        ProblemError: another shape, NaN or inf.
    """
    given = values.array("states", states)
    if given.ndim == 1:
        given = given.reshape((-1, size) if size == 1 else (1, -1))
    return values.numeric("states", values.matrix("states", given, (None, size)))


@checked(seed=whole(0, None))
def check_factorisation(x: Expr, A0: Expr, A: Expr, f: Expr, *, states: Expr = None, seed: int = 0) -> None:
    """Whether (A0 + A(x)) x = f(x), checked at some states.

    Args:
        x: CasADi symbol of the state, shape (n,), that A is written in.
        A0: numbers, (n, n) [1/s].
        A: an expression in x, (n, n) [1/s].
        f: dx/dt without input: an expression in x, shape (n,), or a function of x that returns one.
        states: where to check, (samples, n); None: random states of size 0.03 to 3.
        seed: of the random states.

    Raises:
        ProblemError: an argument does not fit, the factorisation is wrong (names row and state), or f is finite at none
            of the states.
    """
    constant = values.numeric("A0", values.square("A0", A0))
    size = constant.shape[0]
    state, rest = dependence(x, A, size)
    given = values.matrix("f", _at_state(f, x) if callable(f) else f, (size, 1))
    factor = ca.DM(constant) + rest
    sides: Any = [factor @ state, in_state("f", x, given, state), ca.fabs(factor) @ ca.fabs(state)]
    inputs: Any = [state]
    tried = random_states(size, 64, seed) if states is None else as_states(states, size)
    if not len(tried):
        raise _wrong("a state where both sides are finite", "no states")
    found = ca.Function("sides", inputs, sides).map(len(tried))(tried.T)
    left, right, terms = (np.asarray(value.full()).T for value in found)
    finite = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    bound = TOLERANCE * np.maximum(terms, np.abs(right)).max(axis=1, keepdims=True)
    wrong = np.argwhere(~(np.abs(left - right) <= bound) & finite[:, None])
    if not finite.any():
        raise _wrong("a state where both sides are finite", f"none of {len(tried)}")
    if wrong.size:
        sample, row = wrong[0]
        at = "(" + ", ".join(f"{value:.6g}" for value in tried[sample]) + ")"
        raise _wrong(f"component {row} of f, {right[sample, row]:.8g}, at x = {at}", f"{left[sample, row]:.8g}")


def _at_state(f: Callable[[Any], Any], x: Expr) -> Any:
    """What a function returns for the symbol.

    Raises:
        ProblemError: it fails, or makes NaN of it.
    """
    try:
        value = f(x)
    except Exception as error:  # whatever the user's function raises
        raise ProblemError(
            "The function f fails for the symbol of the state.",
            expected="a function of x, by CasADi's functions",
            received=f"{type(error).__name__}: {error}"[:200],
            remedy=remedy_for_symbols(error, "call it by itself with that symbol"),
        ) from error
    if values.holds_nan(value):
        raise ProblemError(
            "The function f makes NaN of the symbol of the state.",
            expected="a function of x, by CasADi's functions",
            received="NaN, which math.sin and its like make of a symbol",
            remedy="take casadi.sin and its like in place of math.sin",
        )
    return value


class WithIntegrals(NamedTuple):
    """The state with its integrals, and the dynamics of both."""

    state: Any
    A0: Array
    A: Any
    B: Array


def integral_states(x: Expr, A0: Expr, A: Expr, B: Expr, output: Expr) -> WithIntegrals:
    """Dynamics of (x, z) with dz/dt = output @ x, section 4.

    Args:
        x: CasADi symbol of the state, shape (n,), that A is written in.
        A0: numbers, (n, n) [1/s].
        A: an expression in x, (n, n) [1/s].
        B: input matrix, numbers, (n, m).
        output: its rows times x are integrated, numbers, (p, n) or, for one, (n,).

    Returns:
        SX symbol of (x, z), shape (n + p,), and A0, A and B of the system with integral states, by name or unpacked.

    Raises:
        ProblemError: an argument does not fit.
    """
    constant = values.numeric("A0", values.square("A0", A0))
    size = constant.shape[0]
    column = values.numeric("B", values.matrix("B", B, (size, None)))
    rows = values.numeric("output", values.matrix("output", as_rows(output), (None, size)))
    count = rows.shape[0]
    state, rest = dependence(x, A, size)
    whole = ca.SX.sym("x_and_integrals", size + count)
    return WithIntegrals(
        whole,
        np.block([[constant, np.zeros((size, count))], [rows, np.zeros((count, count))]]),
        ca.diagcat(ca.substitute(rest, state, whole[:size]), ca.SX(count, count)),
        np.vstack([column, np.zeros((count, column.shape[1]))]),
    )


def as_rows(value: Expr) -> Any:
    """A matrix; one of one dimension as a row."""
    if isinstance(value, (ca.DM, *values.SYMBOLIC)):
        return value
    numbers = values.array("output", value)
    return numbers[None, :] if numbers.ndim == 1 else value


def _wrong(expected: str, received: str) -> ProblemError:
    return ProblemError(
        "The factorisation (A0 + A(x)) x does not equal f(x).",
        expected=expected,
        received=received,
        remedy="correct A0 and A(x), or give states in the domain of f",
    )
