"""Which of its names a symbol, a name or a matrix stands for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from covocp.checks import bound_columns, check_bounds, column
from covocp.errors import ProblemError, describe, spelling
from covocp.matrices import Array, half_length, unpack_indices
from covocp.statement import Statement

Limits = tuple[Array, Array]


def name_of(key: Any, symbols: Mapping[str, Any], names: tuple[str, ...], *, missing_ok: bool = False) -> str:
    """Name of a symbol or name; "" where it is not one and that is allowed.

    Raises:
        ProblemError: where it is unknown.
    """
    if isinstance(key, str) and key in names:
        return key
    if isinstance(key, ca.MX):
        for name, symbol in symbols.items():
            if key.is_symbolic() and ca.is_equal(key, symbol) and name in names and key.shape == symbol.shape:
                return name
            if name in names and _is_matrix_of(key, symbol):
                return name
    label = getattr(key, "labels", None)
    if label is not None and "E" in names:
        return "E"
    if missing_ok:
        return ""
    raise unknown_name(key, names)


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
            describe(
                "The parameters are not given by name.",
                expected="a dict of name or symbol to value",
                received=repr(given)[:100],
                remedy="write parameters={'name': value}",
            )
        )
    for key, value in given.items():
        name = name_of(key, statement.symbols, tuple(blocks), missing_ok=True)
        if not name:
            raise ProblemError(
                describe(
                    f"There is no parameter '{key}'.",
                    expected="one of " + (", ".join(blocks) or "none: the problem has no parameters"),
                    received=repr(key)[:100],
                    remedy=spelling(key, blocks, _not_given(str(key), statement, bool(blocks))),
                )
            )
        values[blocks[name].span] = column(name, "value", value, blocks[name].size)
    return values


def _not_given(name: str, statement: Statement, some: bool) -> str:
    """What to do about a name that is no parameter, nor nearly one."""
    declared = "what is to change from solve to solve is declared by Problem.parameter"
    kind = next((block.kind for block in statement.blocks if block.name == name), None)
    if kind is not None:
        return f"'{name}' is a {kind}, no parameter: {declared}"
    return f"give one of these; {declared}" if some else declared


def _is_matrix_of(key: Any, half: Any) -> bool:
    """Whether an expression is the full matrix of a half-vector's symbol."""
    size = int(key.shape[0])
    if size != key.shape[1] or half.shape[0] != half_length(size) or key.is_symbolic():
        return False
    symbols = ca.symvar(key)
    if len(symbols) != 1 or not ca.is_equal(symbols[0], half):
        return False
    probe = np.sqrt(2.0 + np.arange(half.shape[0]))
    return np.array_equal(np.asarray(ca.Function("probe", [half], [key])(probe).full()), probe[unpack_indices(size)])


def unknown_name(key: Any, names: tuple[str, ...]) -> ProblemError:
    """The error for something that is not in the solution."""
    return ProblemError(
        describe(
            f"'{key}' is not in this solution.",
            expected="a symbol or name of " + ", ".join(names),
            received=str(key),
            remedy=spelling(key, names, "check the spelling, or use the symbols of the problem that was solved"),
        )
    )


def control_limits(statement: Statement, count: int, given: Any) -> Limits:
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
            describe(
                "The limits of the control are of an unknown kind.",
                expected="limits=None, 'bounds', or a dict of control to (lower, upper)",
                received=repr(given)[:100],
                remedy="give limits={'name': (lower, upper)}",
            )
        )
    blocks = {b.name: b for b in statement.controls if b.span.stop <= count}
    for key, pair in given.items():
        block = blocks[name_of(key, statement.symbols, tuple(blocks))]
        if not isinstance(pair, (tuple, list)) or len(pair) != 2:
            raise ProblemError(
                describe(
                    f"The limits of '{block.name}' are no pair.",
                    expected="(lower, upper)",
                    received=repr(pair)[:100],
                    remedy=f"give limits={{'{block.name}': (lower, upper)}}",
                )
            )
        low, high = bound_columns(block.name, pair[0], pair[1], block.size)
        check_bounds(block.name, low, high)
        lower[block.span], upper[block.span] = low, high
    return lower, upper
