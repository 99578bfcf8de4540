"""Operations of a function of CasADi's scalars, one by one, as the compiled library takes them."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.matrices import Array, distinct

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
OF_TWO = np.array([name in _PAIRS for name in KINDS])

# Of each operation its kind and three numbers, as in columns.h, and its constant.
Program = tuple[NDArray[np.intc], Array]

# What CasADi's numbers of operations become.
_TABLE = np.full(256, UNKNOWN, np.intc)
_TABLE[list(NUMBERS)] = list(NUMBERS.values())
# Operations that are compared with what CasADi tells of each, of those read at once; from so many on it pays.
COMPARED, MANY = 8, 120


def program(function: ca.Function) -> Program | None:
    """The operations of a function of scalars.

    To ask CasADi for one after the other takes four times as long as to read all of them at once.

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
    """The same from the text in which CasADi keeps a function; None where it is not found there as it is known.

    There each operation is four whole numbers: its kind, its register, and what it is made of, or its constant; of an
    input the register, the argument and the place there; of an output the result, the register and the place there.
    That is no promise of CasADi's: what is found is compared with what it tells of some of them (`_agrees`).
    """
    count = function.n_instructions()
    first = asked_one_by_one(function, range(min(count, COMPARED)))
    given = () if first is None else np.flatnonzero(first[0][:, 0] == INPUT).tolist()
    if first is None or not given:
        return None
    digits = np.frombuffer(function.serialize().encode(), np.uint8) - ord("a")
    if digits.size % 2 or digits.max(initial=0) > 15:
        return None
    content = (digits[0::2] | digits[1::2] << 4).tobytes()
    place = given[0]
    _, argument, inside, register = first[0][place].tolist()
    record = np.array([int(ca.OP_INPUT), register, argument, inside], "<i4").tobytes()
    places = distinct(np.linspace(0, count - 1, COMPARED).astype(int)).tolist()
    found = content.find(record)
    while found >= 0:
        start = found - 16 * place
        if start >= 0 and len(content) >= start + 16 * count:
            listed = _listed(np.frombuffer(content, "<i4", 4 * count, start).reshape(count, 4))
            if listed is not None and _agrees(listed, function, places):
                return listed
        found = content.find(record, found + 1)
    return None


def _listed(records: NDArray[np.int32]) -> Program | None:
    """What four whole numbers of each operation tell."""
    given = records[:, 0]
    if ((given < 0) | (given >= _TABLE.size)).any():
        return None
    kinds = _TABLE[given]
    if (kinds == UNKNOWN).any():
        return None
    rows = np.column_stack([kinds, records[:, 2], records[:, 3], records[:, 1]])
    outputs, constants = kinds == OUTPUT, kinds == CONSTANT
    rows[outputs, 1:] = records[outputs][:, [2, 1, 3]]
    rows[~OF_TWO[kinds], 2] = 0
    rows[constants, 1] = 0
    values = np.zeros(kinds.size)
    values[constants] = np.ascontiguousarray(records[constants, 2:]).view("<f8").ravel()
    return np.ascontiguousarray(rows, np.intc), values


def _agrees(listed: Program, function: ca.Function, places: list[int]) -> bool:
    """Whether all numbers are in their ranges, and some of the operations those that CasADi tells of.

    Those of some places, and the constants.
    """
    rows, values = listed
    kinds, registers = rows[:, 0], function.sz_w()
    inputs, outputs = kinds == INPUT, kinds == OUTPUT
    for chosen, columns in ((inputs, (3,)), (outputs, (1,)), (~(inputs | outputs), (1, 2, 3))):
        numbers = rows[chosen][:, columns]
        if ((numbers < 0) | (numbers >= registers)).any():
            return False
    heights = (
        [function.nnz_in(i) for i in range(function.n_in())],
        [function.nnz_out(i) for i in range(function.n_out())],
    )
    for chosen, (which, place), known in ((inputs, (1, 2), heights[0]), (outputs, (2, 3), heights[1])):
        whole, inside = rows[chosen, which], rows[chosen, place]
        if ((whole < 0) | (whole >= len(known))).any() or ((inside < 0) | (inside >= np.array(known)[whole])).any():
            return False
    places = [*places, *np.flatnonzero(kinds == CONSTANT)[:COMPARED].tolist()]
    told = asked_one_by_one(function, places)
    return told is not None and np.array_equal(told[0], rows[places]) and np.array_equal(told[1], values[places])
