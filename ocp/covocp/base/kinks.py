"""Where an expression has kinks or jumps in some symbols, so that its derivatives say nothing of the whole.

|x|, min, max, sign, floor and comparisons have second derivatives that are zero wherever there are any. An expression
without them is analytic in the symbols, so that a Hessian that does not depend on them shows it to be quadratic.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.expressions import TABLE, Expr, Given

# Operations whose derivatives jump, in the user's words.
WORDS = {
    "OP_FABS": "abs", "OP_SIGN": "sign", "OP_COPYSIGN": "copysign", "OP_FMIN": "fmin", "OP_FMAX": "fmax",
    "OP_MMIN": "mmin", "OP_MMAX": "mmax", "OP_FLOOR": "floor", "OP_CEIL": "ceil", "OP_FMOD": "fmod",
    "OP_REMAINDER": "remainder", "OP_LT": "<", "OP_LE": "<=", "OP_EQ": "==", "OP_NE": "!=", "OP_NOT": "not",
    "OP_AND": "and", "OP_OR": "or", "OP_IF_ELSE_ZERO": "if_else", "OP_NORMINF": "norm_inf", "OP_NORM1": "norm_1",
    "OP_NORM2": "norm_2", "OP_NORMF": "norm_fro", "OP_LOW": "low", "OP_FIND": "find", "OP_ATAN2": "atan2",
    "OP_HYPOT": "hypot", "OP_CONVEXIFY": "convexify", "OP_MONITOR": "monitor",
}  # fmt: skip
# Each is looked up, because versions of CasADi differ in what they have.
KINKED = {getattr(ca, name): word for name, word in WORDS.items() if hasattr(ca, name)}
# A function that cannot be read, or whose pieces join smoothly, as those of a cubic table.
UNREAD = "another function"
# What may be smooth all the same, or is anywhere but at one point: the length of a vector, an angle.
MOSTLY_SMOOTH = {UNREAD, "norm_2", "norm_fro", "atan2", "hypot", "convexify", "monitor"}


def kinked(expression: Given, symbols: Given) -> bool:
    """Whether an expression may have kinks or jumps in some symbols; functions that cannot be read count as such.

    Args:
        expression: SX or MX.
        symbols: a column of symbols of the same kind.
    """
    return bool(kinks(expression, [symbols]))


def kinks(expression: Given, symbols: Sequence[Expr]) -> set[str]:
    """The operations by which an expression may have kinks or jumps in some symbols, in words.

    Args:
        expression: SX or MX.
        symbols: of the same kind.
    """
    others = [s for s in ca.symvar(expression) if not any(ca.depends_on(s, symbol) for symbol in symbols)]
    function = ca.Function("probe", [*symbols, *others], [ca.densify(expression)])
    if function.is_a("MXFunction") and not any(own.name().startswith(TABLE) for own in function.find_functions()):
        with suppress(RuntimeError):  # entry by entry more is known
            function = function.expand()
    return _kinks(function, [True] * len(symbols) + [False] * len(others))[0]


def _kinks(function: ca.Function, varying: list[bool]) -> tuple[set[str], list[bool]]:
    """What has kinks for inputs that vary, and which outputs do."""
    if function.name().startswith(TABLE) or not (function.is_a("SXFunction") or function.is_a("MXFunction")):
        return {_word(function)} if any(varying) else set(), [any(varying)] * function.n_out()
    found: set[str] = set()
    inside: NDArray[np.bool_] = np.zeros(function.sz_w(), dtype=bool)
    outputs = [False] * function.n_out()
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        inputs, results = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_INPUT:
            inside[results[0]] = varying[inputs[0]]
            continue
        given = [i >= 0 and bool(inside[i]) for i in inputs]
        if operation == ca.OP_OUTPUT:
            outputs[results[0]] |= any(given)
            continue
        varies = [any(given)] * len(results)
        if operation == ca.OP_CALL and function.is_a("MXFunction"):
            own, varies = _kinks(function.instruction_MX(k).which_function(), given)
            found |= own
        elif operation == ca.OP_CALL:  # it does not say which function that is
            found |= {UNREAD} if any(given) else set()
        elif operation in KINKED and (given[0] if operation == ca.OP_IF_ELSE_ZERO else any(given)):
            found.add(KINKED[operation])
        for place, value in zip(results, varies, strict=True):
            if place >= 0:
                inside[place] = value
    return found, outputs


def _word(function: ca.Function) -> str:
    """A table that is linear between its knots, and if_else of whole functions, by name; UNREAD for any other."""
    if function.is_a("Switch"):
        return "if_else"
    if not function.name().startswith(TABLE):
        return UNREAD
    inputs = [ca.MX.sym("x", function.sparsity_in(i)) for i in range(function.n_in())]
    slopes = [ca.jacobian(ca.jacobian(function(*inputs), x), x) for x in inputs[:-1]]  # the last are its limits
    linear = not ca.symvar(ca.veccat(*slopes))
    return f"the linear table '{function.name().removeprefix(TABLE)}'" if linear else UNREAD
