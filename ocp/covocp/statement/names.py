"""Which of its names a symbol, a name or a matrix stands for."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.checks import as_number, bound_columns, column, shape_error
from covocp.base.errors import ProblemError, spelling
from covocp.base.expressions import Given, symbol_of
from covocp.base.matrices import Array, half_length, unpack_indices
from covocp.statement.statement import Block, Statement

Limits = tuple[Array, Array]
# Name of the covariance of the closed loop, a symbol that is no matrix of the statement.
CLOSED_LOOP = "X"
ENTRY = re.compile(r"(?P<vector>.+)\[(?P<entry>\d+)\]")


def name_of(
    key: Given,
    symbols: Mapping[str, Any],
    names: tuple[str, ...],
    *,
    missing_ok: bool = False,
    sizes: Mapping[str, int] | None = None,
    others: tuple[str, ...] = (),
) -> str:
    """Name of a symbol, a name, or an entry of a vector; "" where it is none of them and that is allowed.

    Args:
        key: a symbol, the full matrix of one, an entry `p[0]` of one, or a name.
        symbols: by name.
        names: that may be meant.
        missing_ok: whether it may be none of them.
        sizes: number of entries of the vectors whose entries may be meant too; the name of an entry is "p[0]".
        others: names of constraints that could be given in the same place, for the error.

    Raises:
        ProblemError: where it is unknown.
    """
    if isinstance(key, str) and key in names:
        return key
    key = symbol_of(key)
    if isinstance(key, ca.MX):
        for name, symbol in symbols.items():
            if key.is_symbolic() and ca.is_equal(key, symbol) and name in names and key.shape == symbol.shape:
                return name
            if name in names and _is_matrix_of(key, symbol):
                return name
    if (covariance := getattr(key, "_stands_for", "")) in names:
        return str(covariance)
    vectors = {name: size for name, size in (sizes or {}).items() if name in names}
    if found := _entry_name(key, symbols, vectors):
        return found
    if missing_ok:
        return ""
    raise _no_such_entry(key, vectors) or unknown_name(key, names, symbols, others)


def sizes_of(blocks: Iterable[Block]) -> dict[str, int]:
    """Number of entries of each symbol that has entries of its own: of all but matrices."""
    return {b.name: b.size for b in blocks if b.kind != "matrix"}


def split_entry(name: str) -> tuple[str, int] | None:
    """Vector and number of the name of an entry, "p[0]"; None for other names."""
    found = ENTRY.fullmatch(name)
    return (found["vector"], int(found["entry"])) if found else None


def block_of(name: str, blocks: Iterable[Block]) -> Block | None:
    """Where a name, or the name of an entry of a vector, lies; the block of an entry has one row. None: nowhere."""
    every = {b.name: b for b in blocks}
    entry = split_entry(name)
    if name in every or entry is None or entry[0] not in every:
        return every.get(name)
    owner, k = every[entry[0]], entry[1]
    if owner.kind == "matrix" or k >= owner.size:
        return None
    return owner if owner.size == 1 else replace(owner, name=name, size=1, offset=owner.offset + k)


def entry_values(values: Mapping[str, Array], name: str) -> Array:
    """What values by name hold for a name, or for that of an entry of a vector, which is the last axis."""
    entry = split_entry(name)
    if name in values or entry is None:
        return values[name]
    return np.asarray(values[entry[0]][..., entry[1]])


def _entry_name(key: Given, symbols: Mapping[str, Any], sizes: Mapping[str, int]) -> str:
    """Name of an entry of a vector, given as such or as the expression `p[0]`; "" where it is none."""
    vector, k = "", -1
    if isinstance(key, str) and (entry := split_entry(key)) is not None:
        vector, k = entry
    elif isinstance(key, ca.MX) and key.shape == (1, 1) and not key.is_symbolic():
        owners = ca.symvar(key)
        if len(owners) == 1:
            vector = next((n for n in sizes if n in symbols and ca.is_equal(owners[0], symbols[n])), "")
            k = chosen_entry(key, owners[0]) if vector else -1
    if not 0 <= k < sizes.get(vector, 0):
        return ""
    return vector if sizes[vector] == 1 else f"{vector}[{k}]"


def chosen_entry(key: Given, vector: Given) -> int:
    """Which entry of a vector an expression is, -1 where it is something else."""
    if [s.__hash__() for s in ca.symvar(key)] != [vector.__hash__()]:
        return -1
    slope = ca.jacobian(key, vector)
    if vector.shape[1] != 1 or ca.symvar(slope):
        return -1
    weights = np.asarray(ca.evalf(ca.densify(slope)).full()).ravel()
    rows = np.flatnonzero(weights)
    if rows.size != 1 or weights[rows[0]] != 1.0:
        return -1
    offset = float(ca.Function("offset", [vector], [key])(np.zeros(vector.shape)))
    return int(rows[0]) if offset == 0.0 else -1


def _no_such_entry(key: Given, sizes: Mapping[str, int]) -> ProblemError | None:
    """The error for an entry that a vector does not have; None where no such vector is named."""
    entry = split_entry(key) if isinstance(key, str) else None
    if entry is None or entry[0] not in sizes:
        return None
    vector, size = entry[0], sizes[entry[0]]
    return ProblemError(
        f"'{vector}' has no entry {entry[1]}.",
        expected=f"'{vector}'" + (f", or an entry '{vector}[0]' to '{vector}[{size - 1}]'" if size > 1 else ""),
        received=f"'{key}'",
        remedy="entries are counted from 0",
    )


def stacked_parameters(statement: Statement, given: Mapping[str, Any], base: Array | None = None) -> Array:
    """The stacked parameters (and means of unknowns) of a statement with some of them replaced by name.

    Args:
        statement: the problem.
        given: values by name or symbol.
        base: the others; None: as they were declared.

    Raises:
        ProblemError: no dict, an unknown name, a value of the wrong size.
    """
    values = (statement.values if base is None else base).copy()
    blocks = {b.name: b for b in (*statement.of_kind("parameter"), *statement.of_kind("unknown"))}
    if not isinstance(given, Mapping):
        raise ProblemError(
            "The parameters are not given by name.",
            expected="a dict of name or symbol to value",
            received=repr(given)[:100],
            remedy="write parameters={'name': value}",
        )
    for key, value in given.items():
        name = name_of(key, statement.symbols, tuple(blocks), missing_ok=True)
        if not name:
            raise ProblemError(
                f"There is no parameter '{key}'.",
                expected="one of " + (", ".join(blocks) or "none: the problem has no parameters"),
                received=repr(key)[:100],
                remedy=spelling(key, blocks, _not_given(str(key), statement, bool(blocks))),
            )
        shape = statement.matrix_parameters.get(name)
        if shape is not None:
            matrix = as_number(name, "value", value)
            if matrix.shape != shape:
                raise shape_error(name, "value", f"shape {shape}", f"shape {matrix.shape}")
            value = matrix.ravel(order="F")
        values[blocks[name].span] = column(name, "value", value, blocks[name].size)
    return values


def _not_given(name: str, statement: Statement, some: bool) -> str:
    """What to do about a name that is no parameter, nor nearly one."""
    declared = "what is to change from solve to solve is declared by Problem.parameter"
    block = next((block for block in statement.blocks if block.name == name), None)
    if block is not None:
        kind = block.kind if block.role == "moving" else block.role
        return f"'{name}' is {'an' if kind[0] in 'aeiou' else 'a'} {kind}, no parameter: {declared}"
    return f"give one of these; {declared}" if some else declared


def _is_matrix_of(key: Given, half: Given) -> bool:
    """Whether an expression is the full matrix of a half-vector's symbol."""
    size = int(key.shape[0])
    if size != key.shape[1] or half.shape[0] != half_length(size) or key.is_symbolic():
        return False
    symbols = ca.symvar(key)
    if len(symbols) != 1 or not ca.is_equal(symbols[0], half):
        return False
    probe = np.sqrt(2.0 + np.arange(half.shape[0]))
    return np.array_equal(np.asarray(ca.Function("probe", [half], [key])(probe).full()), probe[unpack_indices(size)])


def unknown_name(
    key: Given, names: tuple[str, ...], symbols: Mapping[str, Any] | None = None, others: tuple[str, ...] = ()
) -> ProblemError:
    """The error for something that is not in the solution.

    Args:
        key: what was asked for.
        names: that could be meant.
        symbols: of the solution by name, where they are at hand.
        others: names of constraints that could be meant too.
    """
    if _of_closed_loop(key) and CLOSED_LOOP not in names:
        return ProblemError(
            f"The covariance {CLOSED_LOOP} of the closed loop is no value at this place.",
            expected="a symbol or name of " + ", ".join(names),
            received=str(key)[:100],
            remedy="use solution.loop, which has X = E + Xhat of states and unknowns at the nodes, Xhat and the gain C "
            "(that of the controls is C Xhat C'); covariance(x) and deviation(x) are entries of loop.X",
        )
    constraints = ", or a constraint by its name: " + ", ".join(others) if others else ""
    expected = "a symbol or name of " + ", ".join(names) + constraints
    if foreign := _foreign_name(key, names, symbols or {}):
        known = symbols is None or bool(symbols)
        return ProblemError(
            f"'{foreign}' is not in this solution: it is a symbol of another problem, and has the same name."
            if known
            else f"'{foreign}' is a symbol, and only names are known here: of several phases, or read from a file, or "
            "sent to another process.",
            expected=expected if known else expected.replace("symbol or name", "name", 1),
            received=str(key)[:100],
            remedy=("take the symbol of the problem that was solved, or " if known else "give ")
            + f"the name as a string: '{foreign}'",
        )
    return ProblemError(
        f"'{key}' is not in this solution.",
        expected=expected,
        received=str(key),
        remedy=spelling(
            key, (*names, *others), "check the spelling, or use the symbols of the problem that was solved"
        ),
    )


def _foreign_name(key: Given, names: tuple[str, ...], symbols: Mapping[str, Any]) -> str:
    """Name of a symbol in an expression that has a name of this solution without being its symbol; "" if none."""
    if not isinstance(symbol_of(key), ca.MX):
        return ""
    own = {symbol.__hash__() for symbol in symbols.values() if isinstance(symbol, ca.MX)}
    found = (symbol for symbol in ca.symvar(symbol_of(key)) if symbol.__hash__() not in own)
    return next((symbol.name() for symbol in found if symbol.name() in names), "")


def _of_closed_loop(key: Given) -> bool:
    """Whether a key is the covariance of the closed loop, or an expression of it."""
    if isinstance(key, ca.MX):
        return any(symbol.name() == CLOSED_LOOP for symbol in ca.symvar(key))
    return getattr(key, "_stands_for", "") == CLOSED_LOOP


def control_limits(statement: Statement, count: int, given: Given) -> Limits:
    """What the actual control can do, lower and upper limits, (count,) each; infinite where nothing limits it.

    Args:
        statement: of the problem.
        count: number of controls that are fed back, the first ones.
        given: None (no limits: the bounds of the problem are those of the nominal), "bounds" (those of the problem), or
            a dict of control to (lower, upper), the others without limits.

    Raises:
        ProblemError: it means nothing.
    """
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    if given is None:
        return lower, upper
    if isinstance(given, str) and given == "bounds":
        return statement.control_bounds[0][:count].copy(), statement.control_bounds[1][:count].copy()
    if not isinstance(given, Mapping):
        raise ProblemError(
            "The limits of the control are of an unknown kind.",
            expected="limits=None, 'bounds', or a dict of control to (lower, upper)",
            received=repr(given)[:100],
            remedy="give limits={'name': (lower, upper)}",
        )
    controls = tuple(b for b in statement.controls if b.span.stop <= count)
    names, sizes = tuple(b.name for b in controls), sizes_of(controls)
    for key, pair in given.items():
        block = block_of(name_of(key, statement.symbols, names, sizes=sizes), controls)
        assert block is not None
        if not isinstance(pair, (tuple, list)) or len(pair) != 2:
            raise ProblemError(
                f"The limits of '{block.name}' are no pair.",
                expected="(lower, upper)",
                received=repr(pair)[:100],
                remedy=f"give limits={{'{block.name}': (lower, upper)}}",
            )
        lower[block.span], upper[block.span] = bound_columns(block.name, pair[0], pair[1], block.size)
    return lower, upper
