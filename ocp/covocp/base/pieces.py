"""Functions in pieces (`if_else`, `fmax`, |x|, `floor`): what they compare, round or choose between."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca

from covocp.base.expressions import TABLE

TWO_SIDED = ("OP_LT", "OP_LE", "OP_EQ", "OP_NE", "OP_FMAX", "OP_FMIN")
ONE_SIDED = {
    "OP_FABS": (0,), "OP_FLOOR": (0,), "OP_CEIL": (0,), "OP_SIGN": (0,), "OP_IF_ELSE_ZERO": (1,), "OP_COPYSIGN": (1,),
    "OP_FMOD": (0, 1), "OP_REMAINDER": (0, 1),
}  # fmt: skip
# Operations with pieces that end where something is a whole number.
WHOLE = ("OP_FLOOR", "OP_CEIL", "OP_FMOD", "OP_REMAINDER")
# What a choice is made by: where its pieces end is known from these.
LOGICAL = ("OP_LT", "OP_LE", "OP_EQ", "OP_NE", "OP_AND", "OP_OR", "OP_NOT")
# Operations by which a value may jump where a piece ends; what it is at a single point (==) is no piece.
JUMPING = ("OP_LT", "OP_LE", "OP_SIGN", "OP_IF_ELSE_ZERO", "OP_COPYSIGN", "OP_ATAN2", *WHOLE)
# How what is compared is written; with its operands.
WRITTEN = {
    "OP_LT": "{} < {}", "OP_LE": "{} <= {}", "OP_SIGN": "sign({})", "OP_FLOOR": "floor({})", "OP_CEIL": "ceil({})",
    "OP_FMOD": "fmod({}, {})", "OP_REMAINDER": "remainder({}, {})", "OP_COPYSIGN": "copysign({}, {})",
    "OP_IF_ELSE_ZERO": "if_else({}, ...)", "OP_ATAN2": "atan2({}, {})",
}  # fmt: skip
# Letters from which on what is compared is not written out.
LONG = 60


def operands_of(function: ca.Function) -> ca.Function | None:
    """What a function compares, rounds or chooses, as a function; None where it does nothing of the kind."""
    operands = []
    for name, node in _pieces(function):
        if name in TWO_SIDED:
            operands.append(node.dep(0) - node.dep(1))
        else:
            operands += [node.dep(i) for i in ONE_SIDED[name]]
    if not operands:
        return None
    arguments: Any = function.sx_in()
    names = [function.name_in(i) for i in range(function.n_in())]
    return ca.Function("operands", arguments, [ca.vertcat(*operands)], names, ["operands"])


def sides_of(function: ca.Function, allowed: Sequence[int], moving: int) -> ca.Function | None:
    """Where pieces end that depend on some arguments alone.

    Args:
        function: with scalar operations.
        allowed: numbers of the arguments that pieces may depend on.
        moving: number of that one of them, a scalar, which they must depend on.

    Returns:
        (the allowed arguments) -> for each piece that which is zero where it ends, or a whole number, and what changes
        there: a sign, or the whole number below. None where no piece is so.
    """
    ends, sides = [], []
    for name, node in _pieces(function):
        if name != "OP_IF_ELSE_ZERO" or not any(node.dep(0).is_op(code) for code in _codes(LOGICAL)):
            ends.append(_end(name, node))
            sides.append(ca.floor(ends[-1]) if name in WHOLE else ca.sign(ends[-1]))
    if not ends:
        return None
    arguments: Any = function.sx_in()
    every = ca.Function("every", arguments, [ca.vertcat(*ends)])
    by = [set(every.jac_sparsity(0, i).row()) if arguments[i].numel() else set() for i in range(len(arguments))]
    chosen = sorted(by[moving].difference(*(rows for i, rows in enumerate(by) if i not in allowed)))
    if not chosen:
        return None
    outputs = [ca.vertcat(*(values[k] for k in chosen)) for values in (ends, sides)]
    return ca.Function("sides", [arguments[i] for i in allowed], outputs)


class Borders(NamedTuple):
    """Where pieces end at which a function may jump.

    ends: (its arguments) -> for each border that which is zero there, or a whole number.
    whole: which of them are borders at all whole numbers.
    operations: by which it may jump, for each border.
    operands: (its arguments) -> both operands of each, or the one twice.
    """

    ends: ca.Function
    whole: tuple[bool, ...]
    operations: tuple[str, ...]
    operands: ca.Function

    def words(self, arguments: Sequence[Any], k: int) -> str:
        """What is compared, in symbols of one's own (SX), such as 'x > 0'; empty where it is long."""
        first, second = (ca.cse(value[k]) for value in self.operands(*arguments))
        operation, pair = self.operations[k], (_bare(first), _bare(second))
        form = WRITTEN[operation]
        if operation in ("OP_LT", "OP_LE") and first.is_constant():
            form, pair = form.replace("<", ">"), pair[::-1]
        said = form.format(*pair)
        return "" if "@" in said or len(said) > LONG else said


def borders_of(function: ca.Function, moving: Sequence[int]) -> Borders | None:
    """Where pieces end at which a function may jump while some of its arguments move; None where there are none.

    Args:
        function: with scalar operations.
        moving: numbers of these arguments.
    """
    found, seen = [], set()
    for name, node in _pieces(function, "OP_ATAN2"):  # which jumps where its first operand is zero, the second below
        chosen = name == "OP_IF_ELSE_ZERO" and any(node.dep(0).is_op(code) for code in _codes(LOGICAL))
        if name in JUMPING and not chosen and node.element_hash() not in seen:
            seen.add(node.element_hash())
            found.append((name, node))
    if not found:
        return None
    arguments: Any = function.sx_in()
    ends = ca.vertcat(*(node.dep(0) if name == "OP_IF_ELSE_ZERO" else _end(name, node) for name, node in found))
    every = ca.Function("every", arguments, [ends])
    rows = sorted({row for i in moving if arguments[i].numel() for row in every.jac_sparsity(0, i).row()})
    if not rows:
        return None
    kept = [found[row] for row in rows]
    pairs = [(node.dep(0), node.dep(node.n_dep() - 1)) for _, node in kept]
    return Borders(
        ends=ca.Function("ends", arguments, [ends[rows]]),
        whole=tuple(name in WHOLE for name, _ in kept),
        operations=tuple(name for name, _ in kept),
        operands=ca.Function("operands", arguments, [ca.vertcat(*side) for side in zip(*pairs, strict=True)]),
    )


def may_jump(function: ca.Function) -> bool:
    """Whether a function compares or rounds in a way that may make it jump, or calls one of which that is not known.

    Tables do not jump.
    """
    if function.name().startswith(TABLE):
        return False
    if not (function.is_a("SXFunction") or function.is_a("MXFunction")):
        return True
    codes = {function.instruction_id(k) for k in range(function.n_instructions())}
    if not codes.isdisjoint(_codes(JUMPING)):
        return True
    if ca.OP_CALL not in codes:
        return False
    if function.is_a("SXFunction"):  # it does not say which function that is
        return True
    places = [k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_CALL]
    return any(may_jump(function.instruction_MX(k).which_function()) for k in places)


def calls(function: ca.Function) -> bool:
    """Whether a function consists of more than scalar operations."""
    if not function.is_a("SXFunction"):
        return True
    return any(function.instruction_id(k) == ca.OP_CALL for k in range(function.n_instructions()))


def _bare(expression: Any) -> str:
    """An expression as text without the brackets around all of it."""
    said = str(expression)
    inside = said[1:-1]
    depth = 0
    for letter in inside:
        depth += (letter == "(") - (letter == ")")
        if depth < 0:
            return said
    return inside if said.startswith("(") and said.endswith(")") else said


def has_pieces(function: ca.Function) -> bool:
    """Whether a function compares, rounds or chooses; one that calls others counts as one that does not."""
    return bool(_pieces(function))


def _end(name: str, node: Any) -> Any:
    """What is zero where a piece ends, or a whole number."""
    if name in TWO_SIDED:
        return node.dep(0) - node.dep(1)
    if name in ("OP_FMOD", "OP_REMAINDER"):
        return node.dep(0) / node.dep(1) + (0.5 if name == "OP_REMAINDER" else 0.0)
    return node.dep(1 if name == "OP_COPYSIGN" else 0)


def _pieces(function: ca.Function, *others: str) -> list[tuple[str, Any]]:
    """The operations that have pieces, and some others, by name; none where not all are scalar operations."""
    if not function.is_a("SXFunction"):
        return []
    names = _codes((*TWO_SIDED, *ONE_SIDED, *others))
    found = [(k, names.get(function.instruction_id(k), "")) for k in range(function.n_instructions())]
    found = [(k, name) for k, name in found if name]
    expressions: Any = function.instructions_sx() if found else []
    return [(name, expressions[k]) for k, name in found]


def _codes(names: Sequence[str]) -> dict[int, str]:
    """Operations by their number: versions of CasADi differ in what they have."""
    return {getattr(ca, name): name for name in names if hasattr(ca, name)}


def expanded(function: ca.Function) -> ca.Function:
    """The function as scalar expressions where it consists of such, else as it is."""
    try:
        return function.expand()
    except RuntimeError:  # it calls a table, a linear solver or an external function
        return function
