"""Functions in pieces (`if_else`, `fmax`, |x|, `floor`): what they compare, round or choose between."""

from __future__ import annotations

from typing import Any

import casadi as ca

TWO_SIDED = ("OP_LT", "OP_LE", "OP_EQ", "OP_NE", "OP_FMAX", "OP_FMIN")
ONE_SIDED = {
    "OP_FABS": (0,), "OP_FLOOR": (0,), "OP_CEIL": (0,), "OP_SIGN": (0,), "OP_IF_ELSE_ZERO": (1,), "OP_COPYSIGN": (1,),
    "OP_FMOD": (0, 1), "OP_REMAINDER": (0, 1),
}  # fmt: skip


def operands_of(function: ca.Function) -> ca.Function | None:
    """What a function compares, rounds or chooses, as a function; None where it does nothing of the kind."""
    if not function.is_a("SXFunction"):
        return None
    two = {getattr(ca, name) for name in TWO_SIDED if hasattr(ca, name)}
    one = {getattr(ca, name): places for name, places in ONE_SIDED.items() if hasattr(ca, name)}
    codes = [function.instruction_id(k) for k in range(function.n_instructions())]
    marked = [k for k, code in enumerate(codes) if code in two or code in one]
    if not marked:
        return None
    expressions: Any = function.instructions_sx()
    operands = []
    for k in marked:
        node = expressions[k]
        if codes[k] in two:
            operands.append(node.dep(0) - node.dep(1))
        else:
            operands += [node.dep(i) for i in one[codes[k]]]
    arguments: Any = function.sx_in()
    names = [function.name_in(i) for i in range(function.n_in())]
    return ca.Function("operands", arguments, [ca.vertcat(*operands)], names, ["operands"])


def expanded(function: ca.Function) -> ca.Function:
    """The function as scalar expressions where it consists of such, else as it is."""
    try:
        return function.expand()
    except RuntimeError:  # it calls a table, a linear solver or an external function
        return function
