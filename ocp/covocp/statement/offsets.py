"""What a condition compares with, where that is written beside what is compared: r^2 in r^2 - d^2 <= 0."""

from __future__ import annotations

from typing import Any

import casadi as ca

from covocp.statement.conditions import Conditions

# Terms of a row that are taken apart: of sums that share sums there may be too many.
MOST_TERMS = 10_000


def offset_of(conditions: Conditions) -> ca.Function | None:
    """(time, duration, parameters) -> the sum of the terms of each row in which no state, control or matrix is.

    With a limit of zero it is the limit, however the row was written. None where the rows cannot be taken apart: they
    call tables, or compiled code.
    """
    try:
        function = conditions.function.expand()
    except RuntimeError:
        return None
    inputs = function.sx_in()
    rows, variables = ca.SX(function(*inputs)), ca.vertcat(*(ca.vec(given) for given in inputs[:3]))
    parts = [_free_of(rows[i], variables) for i in range(conditions.size)]
    return ca.Function("offset", inputs[3:], [ca.densify(ca.vertcat(*parts))])


def _free_of(row: ca.SX, variables: ca.SX) -> ca.SX:
    """The terms of a sum that are free of some variables; a product with what is free of them is taken apart, too.

    None of them where there are too many.
    """
    total, left = ca.SX(0.0), [(row, ca.SX(1.0))]
    for _ in range(MOST_TERMS):
        if not left:
            return total
        value, factor = left.pop()
        if not ca.depends_on(value, variables):
            total += factor * value
            continue
        kind = value.op() if not value.is_symbolic() else None
        deps: list[Any] = [value.dep(i) for i in range(value.n_dep())]
        if kind == ca.OP_ADD:
            left += [(deps[0], factor), (deps[1], factor)]
        elif kind == ca.OP_SUB:
            left += [(deps[0], factor), (deps[1], -factor)]
        elif kind in (ca.OP_NEG, ca.OP_TWICE):
            left.append((deps[0], -factor if kind == ca.OP_NEG else 2 * factor))
        elif kind in (ca.OP_MUL, ca.OP_DIV) and not ca.depends_on(deps[1], variables):
            left.append((deps[0], factor * deps[1] if kind == ca.OP_MUL else factor / deps[1]))
        elif kind == ca.OP_MUL and not ca.depends_on(deps[0], variables):
            left.append((deps[1], factor * deps[0]))
    return ca.SX(0.0)
