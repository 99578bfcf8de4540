"""What every block does with its arguments: numbers and expressions go in, of the same kind they come back.

A block computes with CasADi matrices (`matrix`), numeric ones (DM) where all its arguments are numbers, and hands its
results to `restored`, which makes numpy arrays of numeric ones, in the shape of the argument that they replace.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.errors import ProblemError, shown
from covocp.base.expressions import Expr, Given
from covocp.base.matrices import real_numbers

SYMBOLIC = (ca.SX, ca.MX)
# Relative asymmetry, and relative size of a negative eigenvalue, that count as roundoff.
ROUNDOFF = 1e-9
SINGLE_ROUNDOFF = 1e-5  # in arrays of float32


def is_symbolic(*values: Any) -> bool:
    """Whether any of the values is a CasADi expression."""
    return any(isinstance(value, SYMBOLIC) for value in values)


def matrix(name: str, value: Given, shape: tuple[int | None, int | None] = (None, None)) -> Any:
    """A value as a CasADi matrix: SX or MX as it is, numbers as DM; one-dimensional arrays become columns.

    Args:
        name: of the argument, for messages.
        value: number, array or expression.
        shape: what is expected, None: any number.

    Raises:
        ProblemError: no numbers, NaN or inf, or another shape.
    """
    if isinstance(value, SYMBOLIC):
        result: Any = value
    else:
        numbers = array(name, value)
        if numbers.ndim > 2:
            raise wrong_argument(name, "a matrix", f"an array of {numbers.ndim} dimensions")
        if not np.isfinite(numbers).all():
            raise wrong_argument(name, "finite numbers", "NaN or inf")
        result = ca.DM(numbers)
    if any(wanted is not None and wanted != have for wanted, have in zip(shape, result.shape, strict=True)):
        wanted = " x ".join("n" if size is None else str(size) for size in shape)
        raise wrong_argument(name, f"shape {wanted}", " x ".join(str(size) for size in result.shape))
    return result


def array(name: str, value: Given) -> NDArray[np.float64]:
    """Numbers as an array of floats, NaN and inf among them.

    Raises:
        ProblemError: they are none.
    """
    try:
        return real_numbers(value)
    except (TypeError, ValueError, OverflowError) as error:
        received = f"{type(value).__name__}: {shown(value)}"[:100]
        raise wrong_argument(name, "numbers or a CasADi expression", received) from error


def square(name: str, value: Given, size: int | None = None) -> Any:
    """A square matrix of a size; see `matrix`.

    Raises:
        ProblemError: it is not square or not of that size.
    """
    result = matrix(name, value, (size, size))
    if result.shape[0] != result.shape[1]:
        raise wrong_argument(name, "a square matrix", " x ".join(str(size) for size in result.shape))
    return result


def weight(name: str, value: Given, size: int | None = None, *, definite: bool = False) -> Any:
    """A symmetric matrix, numeric ones checked to be positive semidefinite (or definite).

    Raises:
        ProblemError: not symmetric, or with a negative (or zero) eigenvalue.
    """
    result = square(name, value, size)
    if not isinstance(result, ca.DM):
        return result
    numbers = result.full()
    single = getattr(value, "dtype", None) == np.float32
    tolerance = (SINGLE_ROUNDOFF if single else ROUNDOFF) * float(np.abs(numbers).max(initial=0.0))
    if np.abs(numbers - numbers.T).max(initial=0.0) > tolerance:
        raise wrong_argument(name, "a symmetric matrix", f"an asymmetry of {np.abs(numbers - numbers.T).max():.3g}")
    if numbers.size:
        smallest = float(np.linalg.eigvalsh(numbers)[0])
        if smallest < -tolerance or (definite and smallest <= 0.0):
            kind = "positive definite" if definite else "positive semidefinite"
            raise wrong_argument(name, f"a {kind} matrix", f"a smallest eigenvalue of {smallest:.3g}")
    return result


def numeric(name: str, value: Given) -> NDArray[np.float64]:
    """A matrix as an array of two dimensions, for what has no symbolic form.

    Raises:
        ProblemError: it is an expression.
    """
    if is_symbolic(value):
        raise wrong_argument(name, "numbers: this is solved by iteration", f"an expression, {str(value)[:60]}")
    return np.asarray(value.full())


def restored(value: Given, like: Expr) -> Any:
    """A result in the kind and shape of an argument: numpy where it is numeric, flat where that was, else as it is."""
    if isinstance(value, SYMBOLIC):
        return value
    numbers: NDArray[Any] = np.asarray(value.full() if isinstance(value, ca.DM) else value)
    dimensions = np.ndim(like) if not isinstance(like, (ca.DM, *SYMBOLIC)) else 2
    if dimensions == 0 and numbers.size == 1:
        return float(numbers.item())
    return numbers.ravel() if dimensions == 1 else numbers


def symmetrised(value: Given) -> Any:
    """The symmetric part."""
    return 0.5 * (value + value.T)


def wrong_argument(name: str, expected: str, received: str, remedy: str = "") -> ProblemError:
    """The error of an argument that does not fit."""
    return ProblemError(
        f"The argument '{name}' does not fit.", expected=expected, received=received, remedy=remedy or f"correct {name}"
    )
