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
from covocp.blocks.scaling import RUBBLE, diagonal_scales, over, roundoff, rubble

SYMBOLIC = (ca.SX, ca.MX)


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


def holds_nan(value: Given) -> bool:
    """Whether an entry of what a function made of symbols is NaN: so math.sin takes an SX, without a word."""
    if isinstance(value, (list, tuple)):
        return any(map(holds_nan, value))
    if isinstance(value, ca.SX):
        entries: list[Any] = value.elements()
        return any(entry.is_constant() and np.isnan(float(entry)) for entry in entries)
    return isinstance(value, (float, ca.DM)) and bool(np.isnan(ca.DM(value).full()).any())


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
    kind = np.float32 if getattr(value, "dtype", None) == np.float32 else np.float64
    problem = _not_semidefinite(result.full(), kind, definite)
    if problem.startswith("an asymmetry"):
        raise wrong_argument(name, "a symmetric matrix", problem)
    if problem:
        raise wrong_argument(name, f"a positive {'definite' if definite else 'semidefinite'} matrix", problem)
    return result


def _not_semidefinite(numbers: NDArray[np.float64], kind: Any, definite: bool) -> str:
    """What a matrix has that a symmetric positive (semi)definite one has not, whatever the units of its rows; or ""."""
    if not numbers.size:
        return ""
    spreads = np.diag(numbers)
    tolerance = roundoff(kind)
    rounding = RUBBLE * len(numbers) * float(np.finfo(kind).eps) * float(np.abs(numbers).max())
    sizes = np.sqrt(np.abs(spreads))
    difference = np.abs(numbers - numbers.T)
    if (difference > np.maximum(tolerance * np.outer(sizes, sizes), rounding)).any():
        return f"an asymmetry of {difference.max():.3g}"
    kept = np.full(len(numbers), True) if definite else ~rubble(numbers, kind)
    smallest = float(np.linalg.eigvalsh(numbers)[0])
    plain = f"a smallest eigenvalue of {smallest:.3g}"
    if smallest < -tolerance * float(np.abs(numbers).max()) or (definite and not spreads.all()):
        return plain
    bare = (spreads < 0.0) | ((spreads == 0.0) & numbers.any(axis=1))
    if (bare & kept).any():
        i = int(np.flatnonzero(bare & kept)[0])
        return f"{spreads[i]:.3g} in place {i} of the diagonal" + ("" if spreads[i] else ", beside other entries")
    positive = kept & (spreads > 0.0)
    part = numbers[np.ix_(positive, positive)]
    least = float(np.linalg.eigvalsh(over(part, diagonal_scales(part)))[0]) if part.size else 1.0
    if least < -tolerance or (definite and least <= 0.0):
        singular = least >= -tolerance and smallest <= 0.0
        return plain if singular else f"a smallest eigenvalue of {least:.3g}, its diagonal scaled to one"
    return ""


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
