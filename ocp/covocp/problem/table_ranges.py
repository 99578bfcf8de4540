"""Where the tables of a problem are looked up: they know nothing beyond their knots.

The expressions that a user gives contain calls of the tables' functions, whose last argument are the outermost knots.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import TABLE, Expr
from covocp.problem.declarations import Declarations
from covocp.problem.stacked import Stacked
from covocp.statement.conditions import Conditions

# A share of the width of a table by which its outermost knots are passed without a word: rounding.
ROUNDING = 1e-9


def table_ranges(problem: Declarations, stacked: Stacked) -> Conditions | None:
    """The arguments of all tables along the path, with the outermost knots of each as limits.

    Args:
        problem: what is declared.
        stacked: its symbols.

    Returns:
        A row for each argument of each table; None where the path reads no table.
    """
    if not stacked.tables:
        return None
    found: dict[tuple[str, int], tuple[str, Any, float, float]] = {}
    for call in _calls(_along_the_path(problem)):
        limits = np.asarray(call.dep(call.n_dep() - 1).to_DM())
        name = call.which_function().name().removeprefix(TABLE)
        for i, (first, last) in enumerate(limits):
            argument = call.dep(i)
            which = f"table '{name}'" + (f", argument {i + 1}" if len(limits) > 1 else "")
            found[which, argument.__hash__()] = (which, argument, float(first), float(last))
    rows = [row for row in found.values() if ca.symvar(row[1])]
    if not rows:
        return None
    lower, upper = np.array([row[2] for row in rows]), np.array([row[3] for row in rows])
    (arguments,) = stacked.substitute(ca.vertcat(*(row[1] for row in rows)))
    return Conditions(
        function=stacked.function("looked_up", [ca.densify(arguments)]),
        names=tuple(row[0] for row in rows),
        lower=lower - ROUNDING * (upper - lower),
        upper=upper + ROUNDING * (upper - lower),
        uses_matrices=bool(ca.depends_on(arguments, stacked.inputs[2])),
    )


def _along_the_path(problem: Declarations) -> Any:
    """Everything that is evaluated along the whole path, one below the other."""
    used = [value for rate in problem.rates.values() for value in (rate.rate, rate.noise)]
    used += [value for m in problem.continuous for value in (m.expression, m.noise, m.information)]
    used += [entry.expression for entry in problem.constraints if entry.at == "path"]
    used += list((problem.cost or ())[:1])
    return ca.veccat(*(value for value in used if value is not None))


def _calls(expression: Expr) -> Iterator[Any]:
    """The calls of tables in an expression, also those inside of functions that it calls."""
    whole = ca.Function("whole", ca.symvar(expression), [expression])
    if not any(function.name().startswith(TABLE) for function in whole.find_functions()):
        return
    for k in range(whole.n_instructions()):
        if whole.instruction_id(k) != ca.OP_CALL:
            continue
        call = whole.instruction_MX(k)
        function = call.which_function()
        if function.name().startswith(TABLE):
            yield call
        elif function.is_a("MXFunction"):
            arguments = [call.dep(i) for i in range(call.n_dep())]
            yield from _calls(ca.veccat(*function.call(arguments, True, False)))
