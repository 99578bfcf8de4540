"""Unit quaternions of attitudes, scalar first: a public part of `covocp.blocks.so3`.

q = (w, v) stands for C(q) = (w^2 - v'v) 1 + 2 v v' - 2 w v^x = e^{-phi^x}, with v = sin(t/2) phi/t, w = cos(t/2).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from covocp.base.expressions import Expr
from covocp.blocks.rotation_entries import (
    ROTATION_TOLERANCE,
    Entries,
    antisymmetric_vector,
    cross_product,
    evaluated,
    inner_product,
    library,
    read_rotation,
    read_vector,
    select,
)
from covocp.blocks.rotation_series import sine, versine
from covocp.blocks.values import is_symbolic, wrong_argument


def to_quaternion(matrix: Expr) -> Any:
    """The unit quaternion of an attitude, of both the one with w >= 0.

    Args:
        matrix: C, a rotation, shape (3, 3), or numbers (..., 3, 3).

    Returns:
        (w, v), shape (4,), as expression (4, 1), or numbers (..., 4); accurate at all angles.

    Raises:
        ProblemError: another shape, NaN, numbers that are no rotation.
    """
    return evaluated(_to_quaternion, read_rotation("matrix", matrix))


def from_quaternion(quaternion: Expr) -> Any:
    """The attitude C = (w^2 - v'v) 1 + 2 v v' - 2 w v^x of a unit quaternion.

    Args:
        quaternion: (w, v), shape (4,), as expression (4, 1), or numbers (..., 4).

    Returns:
        C, shape (3, 3), or numbers (..., 3, 3); equation (4), section 2.

    Raises:
        ProblemError: another shape, NaN, numbers whose norm is not one.
    """
    return evaluated(_from_quaternion, _unit("quaternion", quaternion))


def quaternion_product(first: Expr, second: Expr) -> Any:
    """Hamilton's product p (x) q, with C(p (x) q) = C(q) C(p).

    Args:
        first: p, shape (4,), as expression (4, 1), or numbers (..., 4).
        second: q, the same.

    Returns:
        Shape (4,), as expression (4, 1), or numbers (..., 4).

    Raises:
        ProblemError: another shape, NaN.
    """
    return evaluated(_product, read_vector("first", first, 4), read_vector("second", second, 4))


def quaternion_step(quaternion: Expr, vector: Expr) -> Any:
    """The quaternion of e^{-sigma^x} C(q): q (x) (cos(|sigma|/2), A(|sigma|^2/4) sigma / 2).

    Args:
        quaternion: q of the attitude before, shape (4,), as expression (4, 1), or numbers (..., 4).
        vector: sigma, rotation vector of the attitude after the step relative to that before it, shape (3,), as
            expression (3, 1), or numbers (..., 3) [rad].

    Returns:
        q of the attitude after the step, in the shape of q; equation (5), section 2.

    Raises:
        ProblemError: another shape, NaN, numbers whose norm is not one.
    """
    return evaluated(_step, _unit("quaternion", quaternion), read_vector("vector", vector))


def _unit(name: str, value: Expr) -> Entries:
    """A unit quaternion.

    Raises:
        ProblemError: numbers whose norm is not one.
    """
    found = read_vector(name, value, 4)
    if not is_symbolic(found.value):
        norm = np.linalg.norm(found.value, axis=-1)
        if (np.abs(norm - 1.0) > ROTATION_TOLERANCE).any():
            worst = norm.flat[np.abs(norm - 1.0).argmax()]
            raise wrong_argument(name, "a unit quaternion", f"a norm of {worst:.9g}", "divide it by its norm")
    return found


def _product(p: list[Any], q: list[Any]) -> list[Any]:
    turned = cross_product(p[1:], q[1:])
    scalar = p[0] * q[0] - inner_product(p[1:], q[1:])
    return [scalar, *(p[0] * q[i + 1] + q[0] * p[i + 1] + turned[i] for i in range(3))]


def _step(q: list[Any], sigma: list[Any]) -> list[Any]:
    x = 0.25 * inner_product(sigma, sigma)
    half = 0.5 * sine(x)
    return _product(q, [1 - x * versine(x), *(half * entry for entry in sigma)])


def _from_quaternion(q: list[Any]) -> list[Any]:
    w, x, y, z = q
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, xz, yz = 2 * x * y, 2 * x * z, 2 * y * z
    wx, wy, wz = 2 * w * x, 2 * w * y, 2 * w * z
    return [
        [ww + xx - yy - zz, xy + wz, xz - wy],
        [xy - wz, ww - xx + yy - zz, yz + wx],
        [xz + wy, yz - wx, ww - xx - yy + zz],
    ]


def _to_quaternion(C: list[Any]) -> list[Any]:
    """The row of 4 q q' with the largest diagonal entry, of unit length."""
    trace = C[0][0] + C[1][1] + C[2][2]
    s = antisymmetric_vector(C)
    rows = [[1 + trace, *(-2 * entry for entry in s)]]
    for i in range(3):
        symmetric = [1 + 2 * C[i][i] - trace if i == j else C[i][j] + C[j][i] for j in range(3)]
        rows.append([-2 * s[i], *symmetric])
    row, largest = rows[0], rows[0][0]
    for i in (1, 2, 3):
        larger = rows[i][i] > largest
        row = [select(larger, new, old) for new, old in zip(rows[i], row, strict=True)]
        largest = select(larger, rows[i][i], largest)
    length = library(row[0]).sqrt(inner_product(row, row))
    signed = select(row[0] < 0, -length, length)
    return [entry / signed for entry in row]
