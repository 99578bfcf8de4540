"""How often a function may rise and fall along a straight line, read from its operations: waves, tables, many pieces.

A polynomial of degree d turns d - 1 times at most and a monotone function of it no more often; each comparison, |x| or
hump adds some, and what is composed of itself (|1 - 2 |1 - 2 x||, a logistic map) twice as many each time. What is
counted are so an upper bound of simple models and the size of others: sums of exponentials could turn where they nearly
cancel, and only there.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import casadi as ca

# From so many operations on to read them takes longer than to look at what a function does.
MOST_READ = 5000
# What neither rises nor falls more often, with two operands and with one.
_LINEAR = ("ADD", "SUB", "NEG", "TWICE", "ASSIGN")
_MONOTONE = (
    "EXP", "LOG", "SQRT", "POW", "CONSTPOW", "ASIN", "ACOS", "ATAN", "ERF", "ERFINV", "SINH", "COSH", "TANH", "ASINH",
    "ACOSH", "ATANH", "LOG1P", "EXPM1", "HYPOT", "ATAN2", "INV",
)  # fmt: skip
# What ends where its operand, or the difference of both, changes its sign: constant beside that, or not.
_STEPS = ("LT", "LE", "EQ", "NE", "SIGN", "COPYSIGN")
_BENDS = ("FABS", "FMIN", "FMAX")
_LOGIC = ("AND", "OR", "NOT")


class _Shape(NamedTuple):
    """Of a value along a line: its degree, and turns that are no polynomial's; a constant has neither."""

    degree: int
    bends: int

    @property
    def pieces(self) -> int:
        """How often it may pass any value."""
        return self.degree + self.bends


_CONSTANT, _STRAIGHT = _Shape(0, 0), _Shape(1, 0)


def may_turn_often(function: ca.Function, few: int, constant: Collection[int] = ()) -> bool:
    """Whether a function may pass some value more than a few times along a straight line.

    So may one of which that is not known, as what calls others, and one of so many operations that reading takes long.

    Args:
        function: any of CasADi's.
        few: times.
        constant: numbers of those of its arguments that do not move.
    """
    if not function.is_a("SXFunction") or function.n_instructions() > MOST_READ:
        return True
    registers: dict[int, _Shape] = {}
    for k in range(function.n_instructions()):
        code, given = function.instruction_id(k), function.instruction_input(k)
        if code == ca.OP_OUTPUT:
            if registers[given[0]].pieces > few:
                return True
            continue
        if code == ca.OP_CONST:
            shape: _Shape | None = _CONSTANT
        elif code == ca.OP_INPUT:
            shape = _CONSTANT if given[0] in constant else _STRAIGHT
        else:
            shape = _shape(_NAMES.get(code, ""), [registers[i] for i in given])
        if shape is None:
            return True
        registers.update(dict.fromkeys(function.instruction_output(k), shape))
    return False


def _shape(name: str, given: list[_Shape]) -> _Shape | None:
    """What an operation makes of its operands; None: it may repeat itself for ever, or is not known."""
    if not any(own.pieces for own in given):
        return _CONSTANT
    degrees, bends = [own.degree for own in given], sum(own.bends for own in given)
    most, pieces = max(degrees), sum(own.pieces for own in given)
    if name in _LINEAR:
        return _Shape(most, bends)
    if name == "MUL":
        return _Shape(sum(degrees), bends)
    if name == "SQ":
        return _Shape(2 * most, 2 * bends)
    if name == "DIV":
        return _Shape(degrees[0], bends + degrees[1])
    if name in _BENDS:
        return _Shape(most, bends + most + (bends if len(given) == 1 else 0))
    if name in _STEPS:
        return _Shape(0, bends + most)
    if name == "IF_ELSE_ZERO":
        return _Shape(degrees[1], bends + degrees[0])
    if name in _MONOTONE or name in _LOGIC:
        return _Shape(0, pieces)
    return None


_NAMES: dict[int, str] = {
    getattr(ca, f"OP_{name}"): name
    for name in (*_LINEAR, "MUL", "SQ", "DIV", *_BENDS, *_STEPS, "IF_ELSE_ZERO", *_MONOTONE, *_LOGIC)
    if hasattr(ca, f"OP_{name}")
}
