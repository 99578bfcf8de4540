"""Vectors and 3 x 3 matrices by their entries: one law for stacks of numbers and for expressions.

A law takes lists of entries (of a matrix: of its rows) and returns such lists, written with operators and the functions
of `library`. Numbers go through it as arrays of all the stack, so the law runs once however many there are; expressions
as SX, an MX through a function of SX (`arithmetic.apply`).
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr, Given
from covocp.blocks.arithmetic import apply, precision
from covocp.blocks.values import SYMBOLIC, array, is_symbolic, wrong_argument

Array = NDArray[np.float64]
Law = Callable[..., list[Any]]

# Entry by entry, how far R R' may be from the identity: what a matrix has that was printed with seven digits, or
# integrated without care for orthogonality; and how far the norm of a quaternion from one.
ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Entries:
    """A checked argument.

    Attributes:
        value: SX or MX of one column or matrix, or numbers (..., *shape).
        shape: of one of them: (), (3,), (4,), (3, 3).
        kind: of the floats that come back.
    """

    value: Expr
    shape: tuple[int, ...]
    kind: Any


def read_scalar(name: str, value: Given) -> Entries:
    """A number, an array of them, or an expression.

    Raises:
        ProblemError: none of these, or NaN.
    """
    return _entries(name, value, ())


def read_vector(name: str, value: Given, size: int = 3) -> Entries:
    """A vector, a stack of them (..., size), or an expression (size, 1).

    Raises:
        ProblemError: another shape, or NaN.
    """
    return _entries(name, value, (size,))


def read_matrix(name: str, value: Given) -> Entries:
    """A 3 x 3 matrix, a stack of them (..., 3, 3), or an expression.

    Raises:
        ProblemError: another shape, or NaN.
    """
    return _entries(name, value, (3, 3))


def read_rotation(name: str, value: Given) -> Entries:
    """A rotation, a stack of them (..., 3, 3), or an expression, which is not checked.

    Raises:
        ProblemError: another shape, NaN, no rotation.
    """
    found = read_matrix(name, value)
    if not is_symbolic(found.value):
        check_rotation(name, found.value)
    return found


def check_rotation(name: str, numbers: Array) -> None:
    """Numbers must be rotations.

    Raises:
        ProblemError: they are not.
    """
    off, improper = orthogonality(numbers), np.linalg.det(numbers) < 0.0
    wrong = (off > ROTATION_TOLERANCE) | improper
    if not wrong.any():
        return
    where = "" if wrong.ndim == 0 else f" at {tuple(np.argwhere(wrong)[0].tolist())}"
    if improper.any() and not (off > ROTATION_TOLERANCE).any():
        received = f"an orthogonal matrix of determinant -1{where}"
    else:
        received = f"R R' that differs from the identity by {off.max():.3g}{where}"
    raise wrong_argument(name, "a rotation: R R' = 1, det R = 1", received, "take so3.project(...), the nearest one")


def orthogonality(numbers: Array) -> Array:
    """The largest entry of |R R' - 1| of each matrix of a stack."""
    off: Array = np.abs(numbers @ np.swapaxes(numbers, -1, -2) - np.eye(3)).max(axis=(-2, -1))
    return off


def _entries(name: str, value: Given, shape: tuple[int, ...]) -> Entries:
    rows, columns = (*shape, 1, 1)[:2]
    if isinstance(value, SYMBOLIC):
        if value.shape != (rows, columns):
            raise wrong_argument(name, f"shape {rows} x {columns}", " x ".join(map(str, value.shape)))
        return Entries(value, shape, np.float64)
    numbers = array(name, value)
    if numbers.shape == (rows, columns):  # a column, such as a DM
        numbers = numbers.reshape(shape)
    if len(shape) > numbers.ndim or numbers.shape[numbers.ndim - len(shape) :] != shape:
        expected = f"shape {shape} or (..., {str(shape)[1:-1].rstrip(',')})"
        raise wrong_argument(name, expected, f"shape {numbers.shape}")
    if not np.isfinite(numbers).all():
        raise wrong_argument(name, "finite numbers", "NaN or inf")
    return Entries(numbers, shape, precision(value))


def evaluated(law: Law, *arguments: Entries) -> Any:
    """What a law makes of its arguments.

    Args:
        law: of as many lists of entries as there are arguments; returns a list, or a list of rows.
        arguments: as the functions above return them; stacks broadcast.

    Returns:
        Numbers (..., *shape of the result) where all the arguments are numbers, otherwise a dense expression.

    Raises:
        ProblemError: SX and MX together, stacks beside expressions, or stacks that do not fit each other.
    """
    if not is_symbolic(*(argument.value for argument in arguments)):
        batch = _batch(arguments)
        result = _assembled(law(*map(_split, arguments)), batch)
        single = all(argument.kind == np.float32 for argument in arguments)
        return result.astype(np.float32) if single else result
    for argument in arguments:
        if not is_symbolic(argument.value) and np.ndim(argument.value) > len(argument.shape):
            raise wrong_argument("stack", "one matrix or vector beside an expression", f"shape {argument.value.shape}")

    def of_matrices(*values: Expr) -> tuple[Any]:
        parts = [_split(Entries(value, given.shape, None)) for value, given in zip(values, arguments, strict=True)]
        return (joined(law(*parts)),)

    of_matrices.__name__ = law.__name__.strip("_")
    values = [
        argument.value if is_symbolic(argument.value) else ca.DM(np.asarray(argument.value)) for argument in arguments
    ]
    return apply(of_matrices, *values)[0]


def joined(entries: list[Any]) -> Any:
    """A list of entries, or of rows, as an expression."""
    rows = [ca.horzcat(*row) if isinstance(row, list) else row for row in entries]
    return ca.vertcat(*rows)


def _split(argument: Entries) -> Any:
    value, shape = argument.value, argument.shape
    stack = isinstance(value, np.ndarray)
    if not shape:
        return value
    if len(shape) == 1:
        return [value[..., i] if stack else value[i] for i in range(shape[0])]
    rows, columns = range(shape[0]), range(shape[1])
    return [[value[..., i, j] if stack else value[i, j] for j in columns] for i in rows]


def _batch(arguments: tuple[Entries, ...]) -> tuple[int, ...]:
    shapes = [a.value.shape[: a.value.ndim - len(a.shape)] for a in arguments]
    try:
        return np.broadcast_shapes(*shapes)
    except ValueError as error:
        received = " and ".join(map(str, shapes))
        raise wrong_argument("stack", "stacks of as many", f"stacks of shapes {received}") from error


def _assembled(entries: list[Any], batch: tuple[int, ...]) -> Array:
    if isinstance(entries[0], list):
        result = np.empty((*batch, len(entries), len(entries[0])))
        for i, row in enumerate(entries):
            for j, entry in enumerate(row):
                result[..., i, j] = entry
        return result
    result = np.empty((*batch, len(entries)))
    for i, entry in enumerate(entries):
        result[..., i] = entry
    return result


def library(entry: Expr) -> ModuleType:
    """Where the functions of an entry are: sin, cos, sqrt, arccos, arcsin are called the same in both."""
    return ca if isinstance(entry, SYMBOLIC) else np


def select(condition: Expr, value: Expr, other: Expr) -> Any:
    """The value where the condition holds, elsewhere the other one; both must be finite, with their derivatives."""
    if is_symbolic(condition):
        return ca.if_else(condition, value, other)
    return np.where(condition, value, other)


def cross_product(a: list[Any], b: list[Any]) -> list[Any]:
    """The cross product of two vectors."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def inner_product(a: list[Any], b: list[Any]) -> Any:
    """The inner product of two vectors of any length."""
    total = a[0] * b[0]
    for left, right in zip(a[1:], b[1:], strict=True):
        total = total + left * right
    return total


def polynomial_of_cross(v: list[Any], linear: Expr, square: Expr) -> list[Any]:
    """1 + linear v^x + square v^x v^x, by rows."""
    x, y, z = v
    lx, ly, lz = linear * x, linear * y, linear * z
    sx, sy, sz = square * x, square * y, square * z
    xy, xz, yz = sx * y, sx * z, sy * z
    xx, yy, zz = sx * x, sy * y, sz * z
    return [
        [1 - (yy + zz), xy - lz, xz + ly],
        [xy + lz, 1 - (xx + zz), yz - lx],
        [xz - ly, yz + lx, 1 - (xx + yy)],
    ]


def product(first: list[Any], second: list[Any]) -> list[Any]:
    """The product of two 3 x 3 matrices, by rows."""
    columns = [[row[j] for row in second] for j in range(3)]
    return [[inner_product(row, column) for column in columns] for row in first]


def antisymmetric_vector(M: list[Any]) -> list[Any]:
    """P_a(M)^vee."""
    return [0.5 * (M[2][1] - M[1][2]), 0.5 * (M[0][2] - M[2][0]), 0.5 * (M[1][0] - M[0][1])]
