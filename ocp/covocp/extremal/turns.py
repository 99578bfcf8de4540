"""How often a function may rise and fall along a straight line, read from its operations: waves, tables, many pieces.

A polynomial of degree d turns d - 1 times at most and a monotone function of it no more often; each comparison, |x| or
hump adds some, and what is composed of itself (|1 - 2 |1 - 2 x||, a logistic map) twice as many each time. What is
counted are so an upper bound of simple models and the size of others: sums of exponentials could turn where they nearly
cancel, and only there.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

import casadi as ca

from covocp.passage.operations import CONSTANT, INPUT, KINDS, OF_TWO, OUTPUT, program

# From so many operations on to read them takes longer than to look at what a function does.
MOST_READ = 5000

# Of a value along a line: its degree, and turns that are no polynomial's; a constant has neither.
Shape = tuple[int, int]
_STRAIGHT: Shape = (1, 0)
_STILL: Shape = (0, 0)


def may_turn_often(function: ca.Function, few: int, constant: Collection[int] = ()) -> bool:
    """Whether a function may pass some value more than a few times along a straight line.

    So may one of which that is not known, as what calls others, and one of so many operations that reading takes long.

    Args:
        function: any of CasADi's.
        few: times.
        constant: numbers of those of its arguments that do not move.
    """
    listed = program(function) if function.is_a("SXFunction") and function.n_instructions() <= MOST_READ else None
    if listed is None:
        return bool(function.nnz_out())
    registers = [_STILL] * max(function.sz_w(), 1)
    for kind, one, two, to in listed[0].tolist():
        if kind == OUTPUT:
            if sum(registers[one]) > few:
                return True
            continue
        if kind in (CONSTANT, INPUT):
            registers[to] = _STRAIGHT if kind == INPUT and one not in constant else _STILL
            continue
        first, second = registers[one], registers[two] if _PAIRED[kind] else _STILL
        if first == second == _STILL:
            registers[to] = _STILL
            continue
        rule = _RULES[kind]
        if rule is None:
            return True
        registers[to] = rule(*first, *second)
    return False


# What the operations make of two values of degree m and n, and of c and d other turns; of one value, n and d are zero.


def _linear(m: int, c: int, n: int, d: int) -> Shape:
    return max(m, n), c + d


def _product(m: int, c: int, n: int, d: int) -> Shape:
    return m + n, c + d


def _square(m: int, c: int, _n: int, _d: int) -> Shape:
    return 2 * m, 2 * c


def _quotient(m: int, c: int, n: int, d: int) -> Shape:
    return m, c + d + n


def _monotone(m: int, c: int, n: int, d: int) -> Shape:
    """Neither rises nor falls more often than its operands pass a value."""
    return 0, m + c + n + d


def _bend(m: int, c: int, n: int, d: int) -> Shape:
    """Ends where the difference of both changes its sign, and goes on with the other."""
    return max(m, n), c + d + max(m, n)


def _fold(m: int, c: int, _n: int, _d: int) -> Shape:
    """|x| passes each value twice as often."""
    return m, 2 * c + m


def _step(m: int, c: int, n: int, d: int) -> Shape:
    """Constant beside where the difference of both changes its sign."""
    return 0, c + d + max(m, n)


def _switched(m: int, c: int, n: int, d: int) -> Shape:
    return n, c + d + m


# None: it may repeat itself for ever.
_NAMED: dict[str, Callable[[int, int, int, int], Shape]] = {
    **dict.fromkeys(("ADD", "SUB", "NEG", "TWICE", "ASSIGN"), _linear),
    **{"MUL": _product, "SQ": _square, "DIV": _quotient, "FABS": _fold, "IF_ELSE_ZERO": _switched},
    **dict.fromkeys(("FMIN", "FMAX"), _bend),
    **dict.fromkeys(("LT", "LE", "EQ", "NE", "SIGN", "COPYSIGN"), _step),
    **dict.fromkeys(
        (
            *("EXP", "LOG", "SQRT", "POW", "ASIN", "ACOS", "ATAN", "ERF", "SINH", "COSH", "TANH", "ASINH", "ACOSH"),
            *("ATANH", "LOG1P", "EXPM1", "HYPOT", "ATAN2", "INV", "AND", "OR", "NOT"),
        ),
        _monotone,
    ),
}
_PAIRED: list[bool] = OF_TWO.tolist()
_RULES = [_NAMED.get(name) for name in KINDS]
