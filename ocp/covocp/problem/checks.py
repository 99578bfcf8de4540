"""Checks of what is declared: names, sizes, expressions, limits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.arguments import is_number
from covocp.base.arguments import is_whole as is_whole
from covocp.base.checks import bound_columns, column, gathered, is_symbolic, shape_error
from covocp.base.errors import ProblemError, kind_and_name, shown, spelling
from covocp.base.expressions import Given, symbol_of
from covocp.base.matrices import Array, real_numbers

# Components of a symbol that still make a matrix that fits into a memory.
LARGEST_SIZE = 10**4
# Letters of an expression that a remedy repeats.
LONGEST = 40


def check_size(name: str, size: Given) -> int:
    """The shape of a symbol must be a positive whole number."""
    if not is_whole(size, 1, LARGEST_SIZE):
        raise ProblemError(
            f"The shape of '{name}' is not a number of components.",
            expected=f"a positive whole number, at most {LARGEST_SIZE}",
            received=repr(size),
            remedy="give 1 for a scalar, n for a column of n",
        )
    return int(size)


def scale_column(name: str, scale: Given, size: int) -> Array | None:
    """Typical magnitudes, positive; None stays None."""
    if scale is None:
        return None
    values = column(name, "scale", scale, size)
    if (values <= 0).any():
        raise ProblemError(
            f"The scale of '{name}' must be positive.",
            expected="typical magnitudes > 0",
            received=str(values),
            remedy="give magnitudes, or None for automatic scaling",
        )
    return values


def check_name(name: Given, declared: list[Any]) -> None:
    """A name must be a text that no declaration has yet."""
    if not isinstance(name, str) or not name:
        raise ProblemError(
            "A symbol needs a name.", expected="a text", received=repr(name), remedy="give a short unique name"
        )
    if name in ("time", "duration"):
        raise ProblemError(
            f"The name '{name}' is taken.",
            expected="any other name",
            received=name,
            remedy=f"use Problem.{name} for that symbol",
        )
    for entry in declared:
        if name in (entry.name, *(f"{entry.name}[{i}]" for i in range(getattr(entry, "size", 0)))):
            raise ProblemError(
                f"The name '{name}' is used twice.",
                expected="a unique name for each symbol, measurement and constraint",
                received=f"'{name}', declared before at {entry.where}",
                remedy="choose another name",
            )


def check_dynamics(entries: Iterable[Any], rates: Mapping[str, Any]) -> None:
    """Everything that moves needs a rate."""
    for entry in entries:
        if entry.name not in rates:
            raise ProblemError(
                f"'{entry.name}' has no dynamics (declared at {entry.where}).",
                expected=f"dynamics({entry.name}, rate)",
                received="none",
                remedy="give its rate; 0 for a constant",
            )


def find_name(symbol: Given, what: str, declared: list[Any], allowed: tuple[Any, ...]) -> str:
    """Name of what was declared, from its symbol or name."""
    symbol = symbol_of(symbol)
    for entry in declared:
        own = getattr(entry, "symbol", None)
        if own is None:
            continue
        if (
            symbol is own
            or symbol is getattr(entry, "matrix", own)
            or (isinstance(symbol, str) and symbol == entry.name)
        ):
            return str(entry.name)
        if is_symbolic(symbol) and symbol.is_symbolic() and ca.is_equal(symbol, own):
            return str(entry.name)
    names = [str(entry.name) for entry in allowed]
    raise ProblemError(
        f"{what} was given something that is not a symbol of this problem.",
        expected="one of " + (", ".join(names) or "none: the problem has nothing of that kind"),
        received=str(symbol),
        remedy=spelling(symbol, names, "check the spelling; or pass the symbol that its declaration returned"),
    )


def as_expression(name: str, what: str, value: Given, shape: tuple[int, int]) -> ca.MX:
    """The value as an expression of the given shape (a scalar zero fits every shape)."""
    try:
        expression = value if isinstance(value, ca.MX) else ca.MX(ca.DM(real_numbers(value)))
    except (TypeError, ValueError, OverflowError, NotImplementedError) as error:
        raise ProblemError(
            f"The {what} of '{name}' is not an expression.",
            expected="an expression of the symbols of this problem",
            received=shown(value, 200),
            remedy="use casadi functions on the symbols (casadi.vertcat, casadi.sin, @, *), not lists, arrays "
            "of symbols or symbols made by casadi.SX.sym",
        ) from error
    if expression.shape == (1, 1) and shape != (1, 1) and expression.is_zero():
        return ca.MX.zeros(*shape)
    if expression.shape != shape:
        raise shape_error(name, what, f"shape {shape}", f"shape {expression.shape}")
    if expression.is_constant() and not np.isfinite(ca.evalf(expression).full()).all():
        raise ProblemError(
            f"The {what} of '{name}' is NaN or inf.",
            expected="a finite expression",
            received=str(expression),
            remedy=f"correct the {what}",
        )
    return expression


COMPARISONS = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE)


def column_expression(name: str, what: str, value: Given) -> ca.MX:
    """The value as a column of expressions; comparisons, lists and symbols of another kind are refused."""
    if not isinstance(value, (ca.MX, ca.DM)) and not is_number(value):
        raise ProblemError(
            f"The {what} '{name}' is not an expression of this problem's symbols.",
            expected="one expression; several go into one column by casadi.vertcat",
            received=kind_and_name(value),
            remedy="use the symbols that state(), control() and symmetric() return",
        )
    expression = ca.MX(value)
    if not expression.is_constant() and expression.is_binary() and expression.op() in COMPARISONS:
        raise ProblemError(
            f"The {what} '{name}' is a comparison, whose value is true or false.",
            expected="an expression, and its bounds apart: subject_to(x, upper=1)",
            received=str(value),
            remedy="give what is bounded, and its bounds by lower= and upper=",
        )
    if expression.shape[1] != 1:
        raise shape_error(name, what, "a scalar or a column", f"shape {expression.shape}")
    return expression


def check_constrains(name: str, expression: ca.MX, constants: list[Any]) -> None:
    """A constraint must contain something that can be chosen."""
    fixed = {symbol.__hash__() for symbol in constants}
    if all(symbol.__hash__() in fixed for symbol in ca.symvar(expression)):
        raise ProblemError(
            f"'{name}' contains no variable.",
            expected="an expression of states, controls, matrix states or the free duration",
            received=str(expression),
            remedy="remove it, or use the symbols that state(), control() and symmetric() return",
        )


def check_known_limits(call: str, name: str, expression: ca.MX, limits: Mapping[str, Given]) -> None:
    """Limits of an expression are numbers: what varies belongs to the expression.

    Args:
        call: "subject_to" or "chance".
        name: of the condition.
        expression: that is limited.
        limits: by the argument that gives them, "lower", "upper" or "equals".

    Raises:
        ProblemError: a limit contains a symbol.
    """
    for side, limit in limits.items():
        if is_symbolic(gathered(limit)):
            raise ProblemError(
                f"The limit {side}= of '{name}' contains a symbol.",
                expected="numbers",
                received=str(limit)[:200],
                remedy="what varies belongs to the expression: "
                f"{call}({_in_words(expression, 'expression')} - {_in_words(limit, 'limit')}, {side}=0)",
            )


def _in_words(value: Given, otherwise: str) -> str:
    """An expression as a user would write it, where that is short."""
    text = str(value)
    return text if len(text) <= LONGEST and "@" not in text and isinstance(value, ca.MX) else otherwise


def limit_columns(name: str, lower: Given, upper: Given, size: int) -> tuple[Array, Array]:
    """Bounds of a constraint, which must not cross, and one of them must bind; None: see `Problem.subject_to`."""
    upper = (0.0 if lower is None else np.inf) if upper is None else upper
    lower = -np.inf if lower is None else lower
    low, high = bound_columns(name, lower, upper, size)
    for i in np.flatnonzero(np.isneginf(low) & np.isposinf(high)):
        entry = f"component {i} of '{name}'" if size > 1 else f"'{name}'"
        raise ProblemError(
            f"{entry} has no bound.",
            expected="a finite lower or upper bound",
            received="lower = -inf, upper = inf",
            remedy="give lower= or upper=, or remove the constraint",
        )
    return low, high
