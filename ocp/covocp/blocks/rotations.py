"""Rotations, their vectors and their Jacobians: a public part of `covocp.blocks.so3`, equations of docs/blocks/so3.md.

Everywhere C = e^{-phi^x}: C is C_ba, which takes components in frame a to those in frame b, and phi is the rotation
vector of b relative to a. For matrices that turn vectors, R = e^{phi^x} = C', take the transpose.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from covocp.base.arguments import is_number
from covocp.base.expressions import Expr
from covocp.blocks.rotation_entries import (
    ROTATION_TOLERANCE,
    antisymmetric_vector,
    evaluated,
    inner_product,
    library,
    orthogonality,
    polynomial_of_cross,
    read_matrix,
    read_rotation,
    read_scalar,
    read_vector,
    select,
)
from covocp.blocks.rotation_series import (
    HALF_TURN,
    angle_over_sine,
    cotangent_remainder,
    sine,
    sine_remainder,
    versine,
)
from covocp.blocks.scaling import ROUNDOFF
from covocp.blocks.values import is_symbolic, wrong_argument

# Largest entry of a rotation vector that is taken as it is: its square, and derivatives by it, are numbers, of single
# precision too.
LONGEST = 1e18


def cross(vector: Expr) -> Any:
    """The cross-product matrix v^x, with v^x w = v x w.

    Args:
        vector: v, shape (3,), as expression (3, 1), or numbers (..., 3).

    Returns:
        Shape (3, 3), or numbers (..., 3, 3); section 1.

    Raises:
        ProblemError: another shape, NaN.
    """
    return evaluated(_cross, read_vector("vector", vector))


def vee(matrix: Expr) -> Any:
    """The vector of a cross-product matrix, (v^x)^vee = v.

    Args:
        matrix: antisymmetric, shape (3, 3), or numbers (..., 3, 3); of an expression the antisymmetric part is taken.

    Returns:
        v, shape (3,), as expression (3, 1), or numbers (..., 3); section 1.

    Raises:
        ProblemError: another shape, NaN, numbers that are not antisymmetric.
    """
    M = read_matrix("matrix", matrix)
    if not is_symbolic(M.value):
        off = np.abs(M.value + np.swapaxes(M.value, -1, -2)).max(initial=0.0)
        if off > ROUNDOFF * np.abs(M.value).max(initial=0.0):
            remedy = "take vee(antisymmetric_part(matrix))"
            raise wrong_argument("matrix", "an antisymmetric matrix", f"a symmetric part of {0.5 * off:.3g}", remedy)
    return evaluated(antisymmetric_vector, M)


def antisymmetric_part(matrix: Expr) -> Any:
    """P_a(M) = (M - M') / 2.

    Args:
        matrix: M, shape (3, 3), or numbers (..., 3, 3).

    Returns:
        Shape (3, 3), or numbers (..., 3, 3); section 1.

    Raises:
        ProblemError: another shape, NaN.
    """
    return evaluated(_antisymmetric_part, read_matrix("matrix", matrix))


def exp(vector: Expr) -> Any:
    """The attitude C = e^{-phi^x} = 1 - A phi^x + B phi^x phi^x of a rotation vector.

    From 1e16 rad on the rounding of the vector is more than a turn: what is left of C is its axis.

    Args:
        vector: phi^ba, shape (3,), as expression (3, 1), or numbers (..., 3) [rad].

    Returns:
        C_ba, shape (3, 3), or numbers (..., 3, 3); equation (1), section 2.

    Raises:
        ProblemError: another shape, NaN.
    """
    return evaluated(lambda phi: exponential(shortened(phi)), read_vector("vector", vector))


def log(matrix: Expr) -> Any:
    """The rotation vector phi = -(ln C)^vee of an attitude, |phi| <= pi, the inverse of `exp`.

    At half a turn phi and -phi are the same attitude: there the largest component of phi (the first of equals) is
    positive, up to rounding, and phi has no derivative.

    Args:
        matrix: C_ba, a rotation, shape (3, 3), or numbers (..., 3, 3).

    Returns:
        phi^ba, shape (3,), as expression (3, 1), or numbers (..., 3) [rad]; equation (2), section 2.

    Raises:
        ProblemError: another shape, NaN, numbers that are no rotation.
    """
    return evaluated(logarithm, read_rotation("matrix", matrix))


def left_jacobian(vector: Expr) -> Any:
    """J(phi) = 1 - B phi^x + D phi^x phi^x, with omega = J(phi) dphi/dt where dC/dt = -omega^x C, C = e^{-phi^x}.

    Args:
        vector: phi, shape (3,), as expression (3, 1), or numbers (..., 3) [rad].

    Returns:
        Shape (3, 3), or numbers (..., 3, 3); equation (3). In texts where R = e^{theta^x}, it is their left Jacobian at
        theta = -phi, and their right Jacobian at phi.

    Raises:
        ProblemError: another shape, NaN.
    """
    return evaluated(_left_jacobian, read_vector("vector", vector))


def inverse_left_jacobian(vector: Expr) -> Any:
    """J(phi)^-1 = 1 + phi^x / 2 + E phi^x phi^x: dphi/dt = omega + phi x omega / 2 + E phi x (phi x omega).

    Args:
        vector: phi, shape (3,), as expression (3, 1), or numbers (..., 3), shorter than a full turn [rad].

    Returns:
        Shape (3, 3), or numbers (..., 3, 3); equation (3), section 2.

    Raises:
        ProblemError: another shape, NaN.
    """
    return evaluated(_inverse_left_jacobian, read_vector("vector", vector))


def principal(axis: int, angle: Expr) -> Any:
    """The principal rotation C_1, C_2 or C_3 by an angle, e^{-angle e_axis^x}.

    Args:
        axis: 1, 2 or 3.
        angle: a number, an array of them, or an expression [rad].

    Returns:
        Shape (3, 3), or numbers (*shape of the angles, 3, 3); section 1.

    Raises:
        ProblemError: another axis, NaN.
    """
    if not is_number(axis) or axis not in (1, 2, 3):
        raise wrong_argument("axis", "1, 2 or 3", f"{axis!r}"[:60])
    first = int(axis) % 3

    def principal_rotation(angle: Expr) -> list[Any]:
        c, s = library(angle).cos(angle), library(angle).sin(angle)
        rows: list[list[Any]] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
        second = (first + 1) % 3
        rows[first][first] = rows[second][second] = c
        rows[first][second], rows[second][first] = s, -s
        return rows

    return evaluated(principal_rotation, read_scalar("angle", angle))


def is_rotation(matrix: Expr, *, tolerance: float = ROTATION_TOLERANCE) -> Any:
    """Whether C C' = 1 and det C = 1.

    Args:
        matrix: numbers (..., 3, 3).
        tolerance: for each entry of C C' - 1.

    Returns:
        True or False, of a stack an array of them.

    Raises:
        ProblemError: an expression, another shape, NaN, a tolerance that is not positive.
    """
    numbers = _numbers(matrix)
    if not is_number(tolerance) or tolerance <= 0:
        raise wrong_argument("tolerance", "a finite number > 0", f"{tolerance!r}"[:60])
    fits = (orthogonality(numbers) <= tolerance) & (np.linalg.det(numbers) > 0.0)
    return bool(fits) if numbers.ndim == 2 else fits


def project(matrix: Expr) -> Any:
    """The nearest rotation in the Frobenius norm: U diag(1, 1, det U V') V' of the singular vectors.

    Args:
        matrix: numbers (..., 3, 3).

    Returns:
        As many rotations.

    Raises:
        ProblemError: an expression, another shape, NaN, a matrix whose nearest rotation is not unique.
    """
    numbers = _numbers(matrix)
    left, values, right = np.linalg.svd(numbers)
    sign = np.where(np.linalg.det(left) * np.linalg.det(right) < 0.0, -1.0, 1.0)
    if (values[..., 1] + sign * values[..., 2] <= ROUNDOFF * values[..., 0]).any():
        received = f"the singular values {values.reshape(-1, 3)[0].round(6).tolist()}"
        raise wrong_argument("matrix", "a matrix near a rotation, of positive determinant", received)
    left = left.copy()
    left[..., :, 2] *= sign[..., None]
    return left @ right


def _numbers(value: Expr) -> Any:
    found = read_matrix("matrix", value)
    if is_symbolic(found.value):
        raise wrong_argument("matrix", "numbers", f"an expression, {str(value)[:60]}")
    return found.value


def _cross(v: list[Any]) -> list[Any]:
    return [[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]]


def _antisymmetric_part(M: list[Any]) -> list[Any]:
    return [[0.5 * (M[i][j] - M[j][i]) for j in range(3)] for i in range(3)]


def exponential(phi: list[Any]) -> list[Any]:
    """C = e^{-phi^x} by rows, of the entries of phi."""
    x = inner_product(phi, phi)
    return polynomial_of_cross(phi, -sine(x), versine(x))


def logarithm(C: list[Any]) -> list[Any]:
    """The entries of phi, of the rows of C.

    phi = -g P_a(C)^vee up to HALF_TURN. Beyond, P_a(C) is too small for its direction: the axis a is the largest column
    of (C + C')/2 - c 1 = (1 - c) a a', and of both its signs the one of -P_a(C)^vee = sin(t) a.
    """
    c = 0.5 * (C[0][0] + C[1][1] + C[2][2] - 1)
    minus = antisymmetric_vector(C)
    far, g = c < HALF_TURN, angle_over_sine(c)
    axis = _axis(C, c, far)
    sine_of_angle, minus_cosine = select(far, -inner_product(minus, axis), 0), select(far, -c, 1)
    supplement = library(sine_of_angle).arctan2(sine_of_angle, minus_cosine)
    angle = select(sine_of_angle < 0, -np.pi, np.pi) - supplement
    return [select(far, angle * axis[i], -g * minus[i]) for i in range(3)]


def _axis(C: list[Any], c: Expr, far: Expr) -> list[Any]:
    """The unit vector of the largest column of (C + C')/2 - c 1 where that is asked for, elsewhere the first one."""
    outer = [[0.5 * (C[i][j] + C[j][i]) - (c if i == j else 0) for j in range(3)] for i in range(3)]
    second = outer[1][1] > outer[0][0]
    third = outer[2][2] > select(second, outer[1][1], outer[0][0])
    column = [select(third, outer[i][2], select(second, outer[i][1], outer[i][0])) for i in range(3)]
    column = [select(far, column[i], 1 if i == 0 else 0) for i in range(3)]
    length = library(column[0]).sqrt(inner_product(column, column))
    return [entry / length for entry in column]


def shortened(phi: list[Any]) -> list[Any]:
    """A rotation vector whose square is a number, of the same axis: itself up to LONGEST in its largest entry."""
    functions = library(phi[0])
    largest = functions.fabs(phi[0])
    for entry in phi[1:]:
        largest = functions.fmax(largest, functions.fabs(entry))
    share = LONGEST / functions.fmax(largest, LONGEST)  # exactly 1 for all but these
    return [share * entry for entry in phi]


def _left_jacobian(phi: list[Any]) -> list[Any]:
    phi = shortened(phi)
    x = inner_product(phi, phi)
    return polynomial_of_cross(phi, -versine(x), sine_remainder(x))


def _inverse_left_jacobian(phi: list[Any]) -> list[Any]:
    phi = shortened(phi)
    return polynomial_of_cross(phi, 0.5, cotangent_remainder(inner_product(phi, phi)))
