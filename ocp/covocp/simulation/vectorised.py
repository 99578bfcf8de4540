"""A CasADi function evaluated for many columns at once, each of its scalar operations over all of them.

CasADi's own `map` works through the whole function for one column after the other. The compiled library does each
operation on some columns at a time; where it was not built, or does not know an operation, one numpy operation does it
on all columns. No operation mixes columns, and the number of columns is a multiple of `LANES`, so that each is treated
by the same vector instructions: a column has the same bits whatever its neighbours are, but for the sign of NaN.
Functions that are not scalar graphs (interpolation tables, linear solvers) go through `map`, with the same property.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy import special

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.passage.columns import OnColumns
from covocp.passage.library import functions
from covocp.passage.operations import program

Mask = npt.NDArray[np.int64]
# An operation and its arguments, the result last.
Call = tuple[Callable[..., Any], tuple[Given, ...]]

# 1.0 has this bit and those below it that are shifted out, 0.0 has none.
HIGH_BIT, ONE = np.array(61), np.array(1.0)
# Widths are multiples of this, so that no column falls into the remainder of a vector loop.
LANES = 64


def _mask(condition: Array, mask: Mask) -> None:
    """All bits where a condition holds, none elsewhere: what a value is cut with, also one that is NaN."""
    np.not_equal(condition, 0.0, mask, casting="unsafe")
    np.negative(mask, mask)


def _mask_of_truth(bits: Mask, mask: Mask) -> None:
    """The same for a condition that is 1.0 or 0.0, from its bits, without a conversion: four times as fast."""
    np.right_shift(bits, HIGH_BIT, mask)
    np.negative(mask, mask)


def _not_of_truth(value: Array, out: Array) -> None:
    np.subtract(ONE, value, out)


def _twice(value: Array, out: Array) -> None:
    np.add(value, value, out)


def _not(value: Array, out: Array) -> None:
    np.equal(value, 0.0, out)


OPERATIONS: dict[int, Callable[..., Any]] = {
    ca.OP_ASSIGN: np.positive,
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_TWICE: _twice,
    ca.OP_SQ: np.square,
    ca.OP_SQRT: np.sqrt,
    ca.OP_INV: np.reciprocal,
    ca.OP_POW: np.power,
    ca.OP_CONSTPOW: np.power,
    ca.OP_EXP: np.exp,
    ca.OP_EXPM1: np.expm1,
    ca.OP_LOG: np.log,
    ca.OP_LOG1P: np.log1p,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN: np.arctan,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_SINH: np.sinh,
    ca.OP_COSH: np.cosh,
    ca.OP_TANH: np.tanh,
    ca.OP_ASINH: np.arcsinh,
    ca.OP_ACOSH: np.arccosh,
    ca.OP_ATANH: np.arctanh,
    ca.OP_ERF: special.erf,
    ca.OP_ERFINV: special.erfinv,
    ca.OP_HYPOT: np.hypot,
    ca.OP_FABS: np.fabs,
    ca.OP_SIGN: np.sign,
    ca.OP_COPYSIGN: np.copysign,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_FMOD: np.fmod,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal,
    ca.OP_EQ: np.equal,
    ca.OP_NE: np.not_equal,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
    ca.OP_NOT: _not,
}


# What gives 1.0 or 0.0.
LOGICAL = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT)


@dataclass(frozen=True, kw_only=True, eq=False)
class Columns:
    """A function made ready for a fixed number of columns: fill `inputs`, call `evaluate`, read `outputs`.

    inputs: arrays (rows, width), (rows,) where all columns share them.
    outputs: arrays (rows, width); they share no memory with the inputs.
    """

    inputs: tuple[Array, ...]
    outputs: tuple[Array, ...]
    evaluate: Callable[[], None]

    __repr__ = short_repr


def padded(count: int) -> int:
    """The smallest admissible width for some columns."""
    return max(1, -(-count // LANES)) * LANES


def vectorise(function: ca.Function, width: int, shared: tuple[int, ...]) -> Columns:
    """Make a function ready for many columns.

    Args:
        function: of dense columns, to dense columns.
        width: number of columns, a multiple of `LANES`.
        shared: positions of the inputs that are the same for all columns.

    Returns:
        Buffers and what evaluates them; every call overwrites the outputs.
    """
    listed = program(function) if functions() is not None else None
    if listed is not None:
        return _compiled(function, width, shared, OnColumns.of(function, listed))
    if function.is_a("SXFunction"):
        known = {*OPERATIONS, ca.OP_IF_ELSE_ZERO, ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT}
        if all(function.instruction_id(k) in known for k in range(function.n_instructions())):
            return _elementwise(function, width, shared)
    return _mapped(function, width, shared)


class _Conditions:
    """What is known of the registers while a program is made: which hold 1.0 or 0.0, and masks of some."""

    def __init__(self) -> None:
        self.logical: set[int] = set()
        self._masks: dict[int, Mask] = {}

    def written(self, register: int, code: int) -> None:
        """A register has another value now, by such an operation."""
        self._masks.pop(register, None)
        (self.logical.add if code in LOGICAL else self.logical.discard)(register)

    def chosen(self, register: int, condition: Array, value: Array, out: Array) -> list[Call]:
        """CasADi's if_else_zero: the value where a register is not zero, else zero (also where the value is NaN)."""
        calls: list[Call] = []
        if register not in self._masks:
            mask = self._masks[register] = np.zeros(condition.shape, dtype=np.int64)
            true = register in self.logical
            calls.append((_mask_of_truth, (condition.view(np.int64), mask)) if true else (_mask, (condition, mask)))
        return [*calls, (np.bitwise_and, (value.view(np.int64), self._masks[register], out.view(np.int64)))]


def _elementwise(function: ca.Function, width: int, shared: tuple[int, ...]) -> Columns:
    """The scalar graph as a list of numpy operations on fixed buffers."""
    inputs = tuple(
        np.zeros(function.size1_in(i)) if i in shared else np.zeros((function.size1_in(i), width))
        for i in range(function.n_in())
    )
    outputs = tuple(np.zeros((function.size1_out(i), width)) for i in range(function.n_out()))
    wide = [np.zeros(width) for _ in range(function.sz_w())]
    # What depends on shared inputs and constants only is one number, kept without a dimension.
    narrow = [np.zeros(()) for _ in range(function.sz_w())]
    bound: list[Array] = list(wide)
    known, program = _Conditions(), list[Call]()
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        source, target = function.instruction_input(k), function.instruction_output(k)
        if code == ca.OP_CONST:
            bound[target[0]] = np.array(function.instruction_constant(k))
        elif code == ca.OP_INPUT:
            bound[target[0]] = inputs[source[0]][source[1], ...]
        elif code == ca.OP_OUTPUT:
            program.append((np.copyto, (outputs[target[0]][target[1]], bound[source[0]])))
        else:
            operands = [bound[i] for i in source]
            out = (wide if any(value.ndim for value in operands) else narrow)[target[0]]
            if code == ca.OP_IF_ELSE_ZERO:
                condition, value = operands
                program += known.chosen(source[0], condition, value, out)
            elif code == ca.OP_NOT and source[0] in known.logical:
                program.append((_not_of_truth, (*operands, out)))
            else:
                program.append((OPERATIONS[code], (*operands, out)))
            bound[target[0]] = out
        if code != ca.OP_OUTPUT:
            known.written(target[0], code)

    def evaluate() -> None:
        for operation, arguments in program:
            operation(*arguments)

    return Columns(inputs=inputs, outputs=outputs, evaluate=evaluate)


def _compiled(function: ca.Function, width: int, shared: tuple[int, ...], on_columns: OnColumns) -> Columns:
    """The scalar graph in the compiled library, on fixed buffers, with what is shared beside each column."""
    memory, results = _columns_apart(function, width)
    own = {i: np.zeros(function.size1_in(i)) for i in shared}
    addresses = [array.ctypes.data for array in (*memory, *results)]

    def evaluate() -> None:
        for i, values in own.items():
            memory[i][:] = values
        if on_columns.run(addresses, width):
            raise MemoryError

    inputs = tuple(own.get(i, array.T) for i, array in enumerate(memory))
    return Columns(inputs=inputs, outputs=tuple(array.T for array in results), evaluate=evaluate)


def _columns_apart(function: ca.Function, width: int) -> tuple[list[Array], list[Array]]:
    """Memory for arguments and results, one column after the other."""
    heights = [function.size1_in(i) for i in range(function.n_in())]
    answers = [function.size1_out(i) for i in range(function.n_out())]
    return [np.zeros((width, height)) for height in heights], [np.zeros((width, height)) for height in answers]


def _mapped(function: ca.Function, width: int, shared: tuple[int, ...]) -> Columns:
    """CasADi's own map over the columns, on fixed buffers."""
    mapped = function.map("columns", "serial", width, list(shared), [])
    memory, results = _columns_apart(function, width)
    for i in shared:
        memory[i] = np.zeros(function.size1_in(i))
    buffer: Any
    buffer, evaluate = mapped.buffer()
    for i, array in enumerate(memory):
        buffer.set_arg(i, memoryview(array))  # type: ignore[arg-type]
    for i, array in enumerate(results):
        buffer.set_res(i, memoryview(array))  # type: ignore[arg-type]

    def run(_keep: Given = (buffer, mapped)) -> None:
        evaluate()

    return Columns(
        inputs=tuple(array if i in shared else array.T for i, array in enumerate(memory)),
        outputs=tuple(array.T for array in results),
        evaluate=run,
    )
