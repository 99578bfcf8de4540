"""How one law serves numbers and expressions: what numpy and CasADi spell differently, and how a law is applied.

A law is a function of matrices, written with `@`, `.T`, slices and the functions of this module. Numbers go through
it as numpy arrays, in their precision; expressions as SX. An MX goes through a function of SX that is called with it:
so every law expands to SX, and its C code holds no linear solver.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.blocks.scaling import diagonal_scales, over, semidefinite_part
from covocp.blocks.values import is_symbolic

Array = NDArray[Any]

# A reading beyond this, an infinite one or NaN counts as missing: a comparison that holds in C code too, where numbers
# may be of single precision.
LARGEST_READING = 1e30
# What is divided by is at least this: a number of single precision, too.
TINY = 1e-37


def precision(*arguments: Any) -> Any:
    """float32 where the arrays among the arguments are all of that type, otherwise float64."""
    kinds = [argument.dtype for argument in arguments if isinstance(argument, np.ndarray)]
    return np.float32 if kinds and all(kind == np.float32 for kind in kinds) else np.float64


def apply(law: Callable[..., Sequence[Any]], *values: Any, precision: Expr = np.float64) -> list[Any]:
    """The results of a law.

    Args:
        law: of as many matrices as there are values; returns a sequence of matrices.
        values: as `values.matrix` returns them: SX, MX or DM.
        precision: of the arrays where all the values are numbers.

    Returns:
        Arrays where all the values are numbers; otherwise dense SX or MX.

    Raises:
        ProblemError: SX and MX together.
    """
    if not is_symbolic(*values):
        return [np.asarray(entry) for entry in law(*(value.full().astype(precision) for value in values))]
    kinds = {type(value) for value in values if is_symbolic(value) and not value.is_constant()}
    if len(kinds) > 1:
        raise ProblemError(
            "The arguments mix SX and MX.",
            expected="expressions of one kind",
            received="both",
            remedy="make a casadi.Function of the SX part and call it with the MX",
        )
    symbols, given, inputs = [], [], []
    for k, value in enumerate(values):
        if isinstance(value, ca.MX) and not value.is_constant():
            symbols.append(ca.SX.sym(f"argument_{k}", value.sparsity()))
            given.append(value)
            inputs.append(symbols[-1])
        else:
            constant = ca.evalf(value) if isinstance(value, ca.MX) else value
            inputs.append(constant if isinstance(constant, ca.SX) else ca.SX(ca.sparsify(constant)))
    results = [ca.densify(entry) for entry in law(*inputs)]
    if not symbols:
        return results if kinds == {ca.SX} else [ca.evalf(entry) for entry in results]
    return list(ca.Function(getattr(law, "__name__", "law").strip("_<>"), symbols, results).call(given, False, False))


def unit(like: Expr, size: int) -> Any:
    """The unit matrix of the kind of another matrix."""
    return np.eye(size, dtype=like.dtype) if isinstance(like, np.ndarray) else ca.SX.eye(size)


def zeros(like: Expr, rows: int, columns: int) -> Any:
    """Zeros of the kind of another matrix."""
    return np.zeros((rows, columns), dtype=like.dtype) if isinstance(like, np.ndarray) else ca.SX(rows, columns)


def symmetric(value: Expr) -> Any:
    """The symmetric part, in the precision of the value."""
    return (value + value.T) / 2


def diagonal(value: Expr) -> Any:
    """A column as a diagonal matrix."""
    return np.diag(value.ravel()) if isinstance(value, np.ndarray) else ca.diag(value)


def below(upper: Expr, lower: Expr) -> Any:
    """One matrix below another."""
    return np.vstack([upper, lower]) if isinstance(upper, np.ndarray) else ca.vertcat(upper, lower)


def beside(left: Expr, right: Expr) -> Any:
    """One matrix beside another."""
    return np.hstack([left, right]) if isinstance(left, np.ndarray) else ca.horzcat(left, right)


# What to do where a matrix is singular, unless the caller knows better.
SOME_NOISE = "give every measurement some noise; where rounding hides it, take the square-root form"


def definite_solve(matrix: Expr, right: Expr, what: str, remedy: str = SOME_NOISE) -> Any:
    """matrix^-1 right for a positive definite matrix, by L D L' without pivots.

    Args:
        matrix: shape (n, n).
        right: shape (n, k).
        what: the matrix is, for the message.
        remedy: what to do about it, for the message.

    Raises:
        ProblemError: numbers that are not positive definite.
    """
    if isinstance(matrix, np.ndarray):
        units = diagonal_scales(matrix)
        scaled = over(matrix, units)
        try:
            np.linalg.cholesky(scaled)
            # With unit diagonal the order of the pivots, and so the rounding, does not depend on units.
            return np.linalg.solve(scaled, right / units[:, None]) / units[:, None]
        except np.linalg.LinAlgError as error:
            raise _indefinite(what, matrix, remedy) from error
    entries, upper, order = ca.ldl(matrix)
    return ca.ldl_solve(ca.densify(right), entries, upper, order)


def definite_root(matrix: Array, what: str, remedy: str = SOME_NOISE) -> Array:
    """Lower triangular L with L L' = matrix, of positive definite numbers; the words are for the message.

    Raises:
        ProblemError: not positive definite.
    """
    units = diagonal_scales(matrix)
    try:
        return np.asarray(units[:, None] * np.linalg.cholesky(over(matrix, units)))
    except np.linalg.LinAlgError as error:
        raise _indefinite(what, matrix, remedy) from error


def unit_triangular(matrix: Expr, what: str, remedy: str = SOME_NOISE) -> tuple[Any, Any]:
    """L and the column D of matrix = L diag(D) L', L unit lower triangular; the words are for the message.

    Raises:
        ProblemError: numbers, not diagonal, that are not positive definite.
    """
    if isinstance(matrix, np.ndarray):
        diagonal = np.diag(matrix)
        if not np.any(matrix - np.diag(diagonal)):
            return unit(matrix, matrix.shape[0]), diagonal[:, None]
        try:
            factor = np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError as error:
            raise _indefinite(what, matrix, remedy) from error
        return factor / np.diag(factor), (np.diag(factor) ** 2)[:, None]
    entries, upper, _ = ca.ldl(matrix, False)
    return ca.SX.eye(matrix.shape[0]) + upper.T, entries


def triangular_solve(lower: Expr, right: Expr) -> Any:
    """lower^-1 right for a unit lower triangular matrix, by substitution."""
    if isinstance(lower, np.ndarray):
        return substituted(lower, right)
    rows = [right[i, :] for i in range(lower.shape[0])]
    for i in range(lower.shape[0]):
        for j in range(i):
            if lower.sparsity().has_nz(i, j):
                rows[i] = rows[i] - lower[i, j] * rows[j]
    return ca.vertcat(*rows)


def substituted(lower: Array, right: Array) -> Array:
    """lower^-1 right of numbers; no pivots, which would depend on the units of the rows."""
    solved = np.zeros_like(right)
    for i in range(len(lower)):
        solved[i] = (right[i] - lower[i, :i] @ solved[:i]) / lower[i, i]
    return solved


def is_there(reading: Expr) -> Any:
    """1 where a reading is a number, 0 where it is missing (NaN or beyond what counts)."""
    if isinstance(reading, np.ndarray):
        return (np.abs(reading) <= LARGEST_READING).astype(reading.dtype)
    return ca.fabs(reading) <= LARGEST_READING


def where(condition: Expr, value: Expr) -> Any:
    """The value where the condition is 1, zero elsewhere, also where the value is NaN."""
    if isinstance(value, np.ndarray):
        return np.where(condition > 0, value, 0).astype(value.dtype)
    return ca.if_else(condition, value, 0)


def semidefinite(value: Expr, before: Expr = None) -> Any:
    """A covariance without the negative eigenvalues that rounding can leave; expressions as they are.

    Args:
        value: shape (n, n).
        before: the covariance that it was computed from, shape (n, n); see `scaling.semidefinite_part`.
    """
    return value if not isinstance(value, np.ndarray) or not value.size else semidefinite_part(value, before)


def _indefinite(what: str, matrix: Array, remedy: str) -> ProblemError:
    smallest = float(np.linalg.eigvalsh(matrix)[0]) if np.isfinite(matrix).all() else np.nan
    return ProblemError(
        f"The {what} is singular.",
        expected="a positive definite matrix",
        received=f"a smallest eigenvalue of {smallest:.3g}",
        remedy=remedy,
    )
