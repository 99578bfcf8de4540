"""Names for what CasADi's type stubs cannot say, and what expressions are recognised by."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

# SX, MX or DM, and where a function is evaluated with numbers an array: the stubs know no type that all of them share,
# and no operators between them.
Expr: TypeAlias = Any
# What a user gave: of any type until it is checked, and then refused or read.
Given: TypeAlias = Any

# Functions of tables begin so: what reads an expression finds them by it, and their limits in the last argument.
TABLE = "covocp_table_"

# Sequences of steps that are kept.
SEQUENCES = 64


# Types of expressions whose operations are asked for by name below.
_SYMBOLIC = (ca.SX, ca.MX)


def _operation(code: int, plain: Callable[[Any, Any], Any]) -> Callable[[Expr, Expr], Any]:
    """An operation of two expressions or numbers, entry by entry: what the operator gives.

    CasADi's operators first ask of each operand whether it is a number, an array, a sparse matrix and so on, which
    takes ten times as long as the operation. Where steps are written out there are hundreds of them.
    """

    def combined(a: Expr, b: Expr) -> Any:
        kind: Any = type(a) if type(a) in _SYMBOLIC else type(b)
        if kind in _SYMBOLIC and all(type(v) is kind or isinstance(v, (float, int)) for v in (a, b)):
            return kind.binary(code, a, b)
        return plain(a, b)

    return combined


def densified(value: Expr) -> Any:
    """An expression without structural zeros; to densify one that has none takes as long as many operations."""
    return value if value.is_dense() else ca.densify(value)


plus = _operation(ca.OP_ADD, operator.add)
minus = _operation(ca.OP_SUB, operator.sub)
times = _operation(ca.OP_MUL, operator.mul)
over = _operation(ca.OP_DIV, operator.truediv)


def above(values: Sequence[Expr]) -> Any:
    """Columns one above the other, an empty one of none; to join one alone takes as long as many operations."""
    if len(values) == 1:
        return values[0]
    return ca.vertcat(*values) if values else ca.MX(0, 1)


def beside(values: Sequence[Expr]) -> Any:
    """One or more side by side."""
    return values[0] if len(values) == 1 else ca.horzcat(*values)


def trial_values(count: int, after: int = 0) -> Any:
    """Numbers (count,) between 0.5 and 1.5 at which expressions are compared: no formula of a model relates them.

    The squares grow too unevenly for sums and multiples of what is here to meet again. They are not drawn: random
    numbers would be the one thing for which a solve loads their library.

    Args:
        count: how many.
        after: so many of them are passed over.
    """
    return 1.0 + 0.5 * np.sin(np.arange(after + 1.0, after + count + 1.0) ** 2)


def symbol_of(key: Given) -> Any:
    """The symbol of what stands for a state that is no vector, such as an attitude; anything else as it is."""
    return getattr(key, "quaternion", key)


def slopes_by(value: Expr, symbols: Sequence[Expr]) -> list[Any]:
    """Slopes of a number by several symbols, dense and of their shapes, in one reverse sweep for all of them."""
    if isinstance(value, ca.SX):
        sizes = [symbol.numel() for symbol in symbols]
        whole = ca.densify(ca.gradient(value, ca.veccat(*symbols)))
        parts = ca.vertsplit(whole, np.cumsum([0, *sizes]).tolist())
        return [ca.reshape(part, *symbol.shape) for part, symbol in zip(parts, symbols, strict=True)]
    slopes = ca.reverse([value], list(symbols), [[ca.MX(1)]])[0]  # what the value is made of stands there once
    return [densified(slope) for slope in slopes]


@lru_cache(maxsize=SEQUENCES)
def sequence_of(function: ca.Function, count: int) -> ca.Function:
    """A function of a value and others, so many times in turn; to make it takes longer than to run it.

    Returns:
        (first value, columns of each of the others) -> columns of what the function gives; the function itself for one.
    """
    return function if count == 1 else function.mapaccum(f"{function.name()}_sequence", count)
