"""Operations of a function of CasADi's scalars, one by one, as the compiled library takes them."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.matrices import Array, distinct
from covocp.passage.library import functions

# CasADi's operations in the order of those in columns.h.
KINDS = (
    "ASSIGN", "ADD", "SUB", "MUL", "DIV", "NEG", "EXP", "LOG", "POW", "SQRT", "SQ", "TWICE", "SIN", "COS", "TAN",
    "ASIN", "ACOS", "ATAN", "LT", "LE", "EQ", "NE", "NOT", "AND", "OR", "FLOOR", "CEIL", "FMOD", "FABS", "SIGN",
    "COPYSIGN", "IF_ELSE_ZERO", "ERF", "FMIN", "FMAX", "INV", "SINH", "COSH", "TANH", "ASINH", "ACOSH", "ATANH",
    "ATAN2", "CONST", "INPUT", "OUTPUT", "LOG1P", "EXPM1", "HYPOT",
)  # fmt: skip
NUMBERS = {int(getattr(ca, f"OP_{name}")): k for k, name in enumerate(KINDS)} | {
    int(ca.OP_CONSTPOW): KINDS.index("POW")
}
CONSTANT, INPUT, OUTPUT = (KINDS.index(name) for name in ("CONST", "INPUT", "OUTPUT"))
UNKNOWN = -1

# Of which there are two arguments; inputs and outputs have two numbers too.
_PAIRS = frozenset(
    {"ADD", "SUB", "MUL", "DIV", "POW", "LT", "LE", "EQ", "NE", "AND", "OR", "FMOD", "COPYSIGN", "IF_ELSE_ZERO"}
    | {"FMIN", "FMAX", "ATAN2", "HYPOT", "INPUT", "OUTPUT"}
)
OF_TWO = np.array([name in _PAIRS for name in KINDS], np.intc)

# Of each operation its kind and three numbers, as in columns.h, and its constant.
Program = tuple[NDArray[np.intc], Array]

# What CasADi's numbers of operations become.
_TABLE = np.full(256, UNKNOWN, np.intc)
_TABLE[list(NUMBERS)] = list(NUMBERS.values())
# Operations that are compared with what CasADi tells of each, of those read at once; from so many on it pays; of the
# first so many one must be an input.
COMPARED, MANY, LOOKED_AT = 8, 60, 200


def program(function: ca.Function) -> Program | None:
    """The operations of a function of scalars.

    To ask CasADi for one after the other takes six times as long as to read all of them at once.

    Args:
        function: any of CasADi's.

    Returns:
        For each of K operations its kind and three numbers as in columns.h, (K, 4), and its constant, (K,); None where
        one of them is not known, or CasADi lists none.
    """
    if not function.is_a("SXFunction") or not function.n_instructions():
        return None
    found = read_at_once(function) if function.n_instructions() >= MANY else None
    return asked_one_by_one(function) if found is None else found


def asked_one_by_one(function: ca.Function, places: range | list[int] | None = None) -> Program | None:
    """The same as CasADi tells of each; `places`: of the operations that are asked for, None: of all."""
    places = range(function.n_instructions()) if places is None else places
    kinds = [NUMBERS.get(kind, UNKNOWN) for kind in map(function.instruction_id, places)]
    if UNKNOWN in kinds:
        return None
    given, found = map(function.instruction_input, places), map(function.instruction_output, places)
    rows = [
        (kind, *before, *after) if len(before) + len(after) == 3 else (kind, *(before or (0,)), 0, *after)
        for kind, before, after in zip(kinds, given, found, strict=True)
    ]
    constants = np.zeros(len(kinds))
    for k in np.flatnonzero(np.array(kinds) == CONSTANT).tolist():
        constants[k] = function.instruction_constant(places[k])
    return np.array(rows, np.intc).reshape(-1, 4), constants


def read_at_once(function: ca.Function) -> Program | None:
    """The same from the text in which CasADi keeps a function, by the library; None where it is not found there.

    How CasADi writes it is no promise of CasADi's (listing.h): what is found is compared with what it tells of some.
    """
    library, count = functions(), function.n_instructions()
    first = range(min(count, LOOKED_AT))
    place = next((k for k in first if function.instruction_id(k) == ca.OP_INPUT), None)
    if library is None or place is None:
        return None
    (register,) = function.instruction_output(place)
    known = np.array([ca.OP_INPUT, register, *function.instruction_input(place)], np.intc)
    sizes = function.n_in(), function.n_out()
    heights = [*map(function.nnz_in, range(sizes[0])), *map(function.nnz_out, range(sizes[1]))]
    own, rows, constants = np.array(heights, np.intc), np.empty((count, 4), np.intc), np.empty(count)
    given = (place, known.ctypes.data, count, max(function.sz_w(), 1), *sizes, own.ctypes.data)
    tables = _TABLE.ctypes.data, _TABLE.size, OF_TWO.ctypes.data
    text, found = function.serialize().encode(), -1
    while (found := library["operations"](text, len(text), found + 1, *given, *tables, *_places(rows, constants))) >= 0:
        if _agrees(rows, constants, function):
            return rows, constants
    return None


def _places(rows: NDArray[np.intc], constants: Array) -> tuple[int, int]:
    """Where they lie."""
    return rows.ctypes.data, constants.ctypes.data


def _agrees(rows: NDArray[np.intc], constants: Array, function: ca.Function) -> bool:
    """Whether the operations at some places, and some constants, are those that CasADi tells of."""
    places = distinct(np.linspace(0, len(rows) - 1, COMPARED).astype(int)).tolist()
    places += np.flatnonzero(rows[:, 0] == CONSTANT)[:COMPARED].tolist()
    told = asked_one_by_one(function, places)
    return told is not None and np.array_equal(told[0], rows[places]) and np.array_equal(told[1], constants[places])
