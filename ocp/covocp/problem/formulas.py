"""Expressions of CasADi as readable formulas: few brackets, and what is used several times named once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import Any

import casadi as ca

from covocp.base.dataclass import dataclass

# Operations of an expression that is written out, at most; of a longer one only its size is told.
MOST_OPERATIONS = 150
# Characters from which on an expression that is used several times has a name, and any expression has.
REPEATED, LONG = 12, 240

# The word of what a function that is called returns.
OUTPUT = "(returned)"

# How tightly an operation binds: its operands need brackets where they bind less tightly.
LOOSE, SUM, PRODUCT, SIGN, POWER, ATOM = range(6)
INFIX: dict[int, tuple[str, int]] = {
    ca.OP_ADD: (" + ", SUM),
    ca.OP_SUB: (" - ", SUM),
    ca.OP_MUL: ("*", PRODUCT),
    ca.OP_DIV: ("/", PRODUCT),
    ca.OP_POW: ("**", POWER),
    ca.OP_CONSTPOW: ("**", POWER),
    ca.OP_LT: (" < ", LOOSE),
    ca.OP_LE: (" <= ", LOOSE),
    ca.OP_EQ: (" == ", LOOSE),
    ca.OP_NE: (" != ", LOOSE),
    ca.OP_AND: (" and ", LOOSE),
    ca.OP_OR: (" or ", LOOSE),
}
# Operations of which the right operand needs brackets where it binds as tightly.
NOT_ASSOCIATIVE = (ca.OP_SUB, ca.OP_DIV, ca.OP_POW, ca.OP_CONSTPOW)
NAMES = {ca.OP_FABS: "abs", ca.OP_FMIN: "min", ca.OP_FMAX: "max", ca.OP_IF_ELSE_ZERO: "if_else_zero"}
FUNCTIONS = {
    getattr(ca, name): name.removeprefix("OP_").lower()
    for name in dir(ca)
    if name.startswith("OP_") and isinstance(getattr(ca, name), int)
} | NAMES


@dataclass(frozen=True, kw_only=True)
class Formulas:
    """Formulas of some expressions.

    Attributes:
        entries: of each expression its entries, column by column.
        definitions: what the names @1, @2, ... in them stand for, in an order in which each uses earlier ones only.
    """

    entries: tuple[tuple[str, ...], ...]
    definitions: tuple[tuple[str, str], ...]


def formulas(expressions: Sequence[Any], symbols: Sequence[Any], names: Sequence[Sequence[str]]) -> Formulas:
    """Write expressions out.

    Args:
        expressions: of the symbols.
        symbols: columns.
        names: of the entries of each symbol.

    Returns:
        The formulas. An expression that has no scalar form (a table, an external function) is what CasADi prints.
    """
    whole = _expanded(expressions, symbols, names)
    if whole is not None:
        return _written(expressions, whole)
    parts = [_expanded([expression], symbols, names) for expression in expressions]
    scalar = [e for e, part in zip(expressions, parts, strict=True) if part is not None]
    joint = _expanded(scalar, symbols, names) if scalar else None
    known = _written(scalar, joint) if joint is not None else Formulas(entries=(), definitions=())
    rest = iter(known.entries)
    entries = [
        next(rest) if part is not None else (_as_printed(e),) * e.numel()
        for e, part in zip(expressions, parts, strict=True)
    ]
    return Formulas(entries=tuple(entries), definitions=known.definitions)


def _as_printed(expression: Any) -> str:
    """What CasADi prints, or the size where that is long."""
    text = " ".join(str(expression).split())
    return text if len(text) <= LONG else _size(ca.n_nodes(expression), [s.name() for s in ca.symvar(expression)])


def _size(count: int, names: Sequence[str]) -> str:
    return f"({count} operations on {', '.join(names) or 'numbers'})"


def _expanded(expressions: Sequence[Any], symbols: Sequence[Any], names: Sequence[Sequence[str]]) -> Any:
    """The entries of all expressions as a column of scalar expressions; None where there is no such form."""
    try:
        function = ca.Function("formulas", list(symbols), [ca.densify(e) for e in expressions])
        columns = [ca.vertcat(ca.SX(0, 1), *(ca.SX.sym(name) for name in own)) for own in names]
        values = function.call(columns, True, False)
    except RuntimeError:
        return None
    return ca.vertcat(ca.SX(0, 1), *(ca.vec(ca.densify(value)) for value in values))


def _written(expressions: Sequence[Any], column: Any) -> Formulas:
    """The formulas of a column of scalar expressions, the entries of all expressions."""
    texts, definitions = _Graph.of(column).formulas()
    rest = iter(texts)
    return Formulas(
        entries=tuple(tuple(next(rest) for _ in range(e.numel())) for e in expressions), definitions=tuple(definitions)
    )


@dataclass
class _Graph:
    """Operations in an order in which each uses earlier ones only: operation, operands, and the word of some."""

    nodes: list[tuple[int, tuple[int, ...], str]] = field(default_factory=list)
    outputs: list[int] = field(default_factory=list)

    @staticmethod
    def of(column: Any) -> _Graph:
        """The graph of the entries of a column; what they share is in it once."""
        graph, known = _Graph(), dict[int, int]()
        for i in range(column.numel()):
            waiting = [column[i]]
            while waiting:
                node = waiting[-1]
                operands = [] if node.is_leaf() else [node.dep(k) for k in range(node.n_dep())]
                if missing := [operand for operand in operands if operand.element_hash() not in known]:
                    waiting += reversed(missing)
                    continue
                waiting.pop()
                if node.element_hash() not in known:
                    known[node.element_hash()] = len(graph.nodes)
                    graph.nodes.append((node.op(), tuple(known[q.element_hash()] for q in operands), _word(node)))
            graph.outputs.append(known[column[i].element_hash()])
        return graph

    def formulas(self) -> tuple[list[str], list[tuple[str, str]]]:
        """The formulas of the outputs, and the definitions of the names in them."""
        own = {output: self._below(output) for output in set(self.outputs)}
        sizes = {output: sum(bool(self.nodes[k][1]) for k in below) for output, below in own.items()}
        shown = {k for output, below in own.items() if sizes[output] <= MOST_OPERATIONS for k in below}
        uses = [0] * len(self.nodes)
        for k in shown:
            for operand in self.nodes[k][1]:
                uses[operand] += 1
        texts: dict[int, tuple[str, int]] = {}
        definitions: list[tuple[str, str]] = []
        for k in sorted(shown):
            text, binding = self._formula(k, texts)
            if self.nodes[k][1] and ((uses[k] > 1 and len(text) >= REPEATED) or (uses[k] and len(text) > LONG)):
                definitions.append((f"@{len(definitions) + 1}", text))
                text, binding = definitions[-1][0], ATOM
            texts[k] = text, binding
        return [
            texts[k][0] if k in texts and sizes[k] <= MOST_OPERATIONS else _size(sizes[k], self._symbols(own[k]))
            for k in self.outputs
        ], definitions

    def _below(self, output: int) -> set[int]:
        """All that a node uses, itself too."""
        found, waiting = {output}, [output]
        while waiting:
            for operand in self.nodes[waiting.pop()][1]:
                if operand not in found:
                    found.add(operand)
                    waiting.append(operand)
        return found

    def _symbols(self, nodes: set[int]) -> list[str]:
        return [self.nodes[k][2] for k in sorted(nodes) if self.nodes[k][0] == ca.OP_PARAMETER]

    def _formula(self, k: int, texts: dict[int, tuple[str, int]]) -> tuple[str, int]:
        """A node in terms of the texts of its operands, and how tightly it binds."""
        operation, operands, word = self.nodes[k]
        if word == OUTPUT:
            return texts[operands[0]]
        if not operands:
            return word, SIGN if word.startswith("-") else ATOM
        if operation in INFIX:
            return _infix(operation, texts[operands[0]], texts[operands[1]])
        first = texts[operands[0]]
        if operation == ca.OP_NEG:
            return f"-{_bracketed(first, PRODUCT)}", SIGN
        if operation == ca.OP_SQ:
            return f"{_bracketed(first, ATOM)}**2", POWER
        if operation == ca.OP_TWICE:
            return f"2*{_bracketed(first, PRODUCT)}", PRODUCT
        if operation == ca.OP_INV:
            return f"1/{_bracketed(first, POWER)}", PRODUCT
        if operation == ca.OP_NOT:
            return f"not {_bracketed(first, ATOM)}", LOOSE
        name = word or FUNCTIONS.get(operation, f"operation_{operation}")
        return f"{name}({', '.join(texts[operand][0] for operand in operands)})", ATOM


def _word(node: Any) -> str:
    """The name of a symbol, the digits of a number, the name of a function that is called; else nothing."""
    if node.is_symbolic():
        return str(node.name())
    if node.is_constant():
        return f"{float(node):.8g}"
    if node.is_call():
        return str(node.which_function().name())
    return OUTPUT if node.is_output() else ""


def _infix(operation: int, left: tuple[str, int], right: tuple[str, int]) -> tuple[str, int]:
    """Two operands and what stands between them."""
    sign, binding = INFIX[operation]
    first = _bracketed(left, ATOM if binding == POWER else LOOSE + 1 if binding == LOOSE else binding)
    second = _bracketed(right, binding + 1 if operation in NOT_ASSOCIATIVE or binding == LOOSE else binding)
    if second.startswith("-") and binding == SUM:  # a + -b
        sign, second = (" + ", " - ")[operation == ca.OP_ADD], second[1:]
    elif second.startswith("-"):
        second = f"({second})"
    return first + sign + second, binding


def _bracketed(operand: tuple[str, int], least: int) -> str:
    """An operand, in brackets where it binds less tightly than it must."""
    return operand[0] if operand[1] >= least else f"({operand[0]})"
