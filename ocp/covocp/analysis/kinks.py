"""Whether an expression has kinks or jumps in some symbols, where its derivatives say nothing of the whole.

|x|, min, max, sign, floor and comparisons have second derivatives that are zero wherever there are any. An expression
without them is analytic in the symbols, so that a Hessian that does not depend on them shows it to be quadratic.
"""

from __future__ import annotations

from contextlib import suppress

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.expressions import Given

# Operations whose derivatives jump; each is looked up, because versions of CasADi differ in what they have.
KINKED = {
    getattr(ca, name)
    for name in (
        *("OP_FABS", "OP_SIGN", "OP_COPYSIGN", "OP_FMIN", "OP_FMAX", "OP_MMIN", "OP_MMAX", "OP_FLOOR", "OP_CEIL"),
        *("OP_FMOD", "OP_REMAINDER", "OP_LT", "OP_LE", "OP_EQ", "OP_NE", "OP_NOT", "OP_AND", "OP_OR"),
        *("OP_IF_ELSE_ZERO", "OP_NORMINF", "OP_NORM1", "OP_NORM2", "OP_NORMF", "OP_LOW", "OP_FIND", "OP_CONVEXIFY"),
        *("OP_MONITOR", "OP_ATAN2", "OP_HYPOT"),
    )
    if hasattr(ca, name)
}


def kinked(expression: Given, symbols: Given) -> bool:
    """Whether an expression may have kinks or jumps in some symbols; functions that cannot be read count as such.

    Args:
        expression: SX or MX.
        symbols: a column of symbols of the same kind.
    """
    others = [s for s in ca.symvar(expression) if not ca.depends_on(s, symbols)]
    function = ca.Function("probe", [symbols, *others], [ca.densify(expression)])
    if function.is_a("MXFunction"):
        with suppress(RuntimeError):  # entry by entry more is known; but a table has no expression
            function = function.expand()
    return _kinked(function, [True] + [False] * len(others))[0]


def _kinked(function: ca.Function, varying: list[bool]) -> tuple[bool, list[bool]]:
    """Whether there are kinks for inputs that vary, and which outputs do."""
    if not (function.is_a("SXFunction") or function.is_a("MXFunction")):
        return any(varying), [any(varying)] * function.n_out()
    inside: NDArray[np.bool_] = np.zeros(function.sz_w(), dtype=bool)
    outputs = [False] * function.n_out()
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        inputs, results = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_INPUT:
            inside[results[0]] = varying[inputs[0]]
            continue
        varies = any(bool(inside[i]) for i in inputs if i >= 0)
        if operation == ca.OP_OUTPUT:
            outputs[results[0]] |= varies
            continue
        if operation == ca.OP_CALL:
            given = [i >= 0 and bool(inside[i]) for i in inputs]
            if function.is_a("SXFunction"):  # it does not say which function that is
                bad, out = any(given), [any(given)] * len(results)
            else:
                bad, out = _kinked(function.instruction_MX(k).which_function(), given)
            if bad:
                return True, outputs
            for place, value in zip(results, out, strict=True):
                if place >= 0:
                    inside[place] = value
            continue
        decides = bool(inside[inputs[0]]) if operation == ca.OP_IF_ELSE_ZERO else varies
        if decides and operation in KINKED:
            return True, outputs
        for place in results:
            if place >= 0:
                inside[place] = varies
    return False, outputs
