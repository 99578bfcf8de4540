"""Checks of what a user gives, each with the message that says what is wrong and what to do."""

from __future__ import annotations

import math
import sys
from itertools import accumulate
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.arguments import is_whole as is_whole
from covocp.base.errors import ProblemError, kind_and_name, shown
from covocp.base.expressions import Given, trial_values
from covocp.base.matrices import Array, over_units, own_units, pack_symbolic, real_numbers, without_rounding

# Share of its largest entry by which a matrix may differ from its transpose; of a covariance entry [i, j] by this share
# of the root of the variances i and j, whatever their units.
SYMMETRIC = 1e-9
UNEVEN = "is not symmetric"


def caller() -> str:
    """File and line of the user's code that called into covocp."""
    frame = sys._getframe(1)
    while frame.f_back is not None and str(frame.f_globals.get("__name__", "")).split(".")[0] == "covocp":
        if str(frame.f_globals["__name__"]).startswith("covocp.models"):
            break
        frame = frame.f_back
    return f"{frame.f_code.co_filename}:{frame.f_lineno}"


def is_symbolic(value: Given) -> bool:
    """Whether the value is a CasADi expression (also one that happens to be constant)."""
    return isinstance(value, ca.MX)


def gathered(value: Given) -> Any:
    """A list of numbers and scalar expressions as a column, rows of them as a matrix; anything else as it is."""
    if not isinstance(value, (list, tuple)) or not value:
        return value
    rows = [entry if isinstance(entry, (list, tuple)) else [entry] for entry in value]
    nested = {isinstance(entry, (list, tuple)) for entry in value}
    entries = [entry for row in rows for entry in row]
    numbers = [entry for entry in entries if not is_symbolic(entry)]
    plain = all(isinstance(n, (int, float, np.number)) and not isinstance(n, bool) and np.isfinite(n) for n in numbers)
    scalar = all(entry.shape == (1, 1) for entry in entries if is_symbolic(entry))
    even = len({len(row) for row in rows}) == 1 and len(nested) == 1
    if len(numbers) == len(entries) or not (plain and scalar and even):
        return value
    return ca.vertcat(*(ca.horzcat(*row) for row in rows))


def is_scalar(value: Given) -> bool:
    """Whether a number, an array or an expression has one entry."""
    return bool(value.numel() == 1 if isinstance(value, (ca.MX, ca.DM)) else np.size(value) == 1)


def check_kind(value: Given, kind: type, remedy: str) -> None:
    """A value must be of a kind, such as a Problem or a Solution.

    Raises:
        ProblemError: it is of another.
    """
    if not isinstance(value, kind):
        raise ProblemError(
            f"This is not a {kind.__name__.lower()}.",
            expected=f"a {kind.__name__}",
            received=kind_and_name(value),
            remedy=getattr(value, "instead", remedy),
        )


def as_number(name: str, what: str, value: Given) -> Array:
    """The value as an array of floats, or an error that names the symbol."""
    if isinstance(value, (ca.SX, ca.MX)):
        raise ProblemError(
            f"The {what} of '{name}' is a symbol.",
            expected="numbers",
            received=str(value),
            remedy="give numbers here" + ("; a bound that varies is a subject_to()" if "bound" in what else ""),
        )
    try:
        return real_numbers(value)
    except (TypeError, ValueError, OverflowError) as error:
        listed = isinstance(value, (list, tuple)) and any(is_symbolic(entry) for entry in value)
        raise ProblemError(
            f"The {what} of '{name}' is not a number.",
            expected="a number or an array of numbers",
            received=shown(value, 200),
            remedy="put expressions into a column by casadi.vertcat(...), not into a list"
            if listed
            else f"check the {what} of '{name}'",
        ) from error


def column(name: str, what: str, value: Given, size: int, *, nan: bool = False, inf: bool = False) -> Array:
    """The value as a vector of `size` numbers; a scalar is repeated.

    Raises:
        ProblemError: where the number of entries does not fit, or NaN or inf appears where it means nothing.
    """
    numbers = as_number(name, what, value)
    if numbers.size == 1:
        numbers = np.full(size, float(numbers.reshape(())))
    if numbers.size != size or numbers.ndim > 2 or (numbers.ndim == 2 and 1 not in numbers.shape):
        entries = numbers.size if numbers.ndim == 1 else 0
        raise shape_error(name, what, _numbers(size), f"shape {numbers.shape}", entries)
    numbers = numbers.reshape(size)
    if (not nan and np.isnan(numbers).any()) or (not inf and np.isinf(numbers).any()):
        raise ProblemError(
            f"The {what} of '{name}' contains NaN or inf.",
            expected="finite numbers" + (" (None: free)" if nan else ""),
            received=str(numbers),
            remedy=f"correct the {what} of '{name}'",
        )
    return numbers


def one_number(name: str, what: str, value: Given) -> float:
    """The value as one number, which may be NaN or infinite."""
    return float(column(name, what, value, 1, nan=True, inf=True)[0])


def bound_columns(name: str, lower: Given, upper: Given, size: int) -> tuple[Array, Array]:
    """Lower and upper bounds as vectors of `size` numbers that do not cross; infinite ones do not bind."""
    low, high = (column(name, f"{side} bound", v, size, inf=True) for side, v in (("lower", lower), ("upper", upper)))
    check_bounds(name, low, high)
    return low, high


def data_column(name: str, what: str, value: Given, size: int, *, nan: bool = False) -> Any:
    """Like `column`, but an expression in the parameters of the problem, or a list with some, is accepted too."""
    value = gathered(value)
    if is_symbolic(value):
        if value.shape == (size, 1):
            return value
        if value.shape == (1, 1):
            return ca.repmat(value, size, 1)
        raise shape_error(name, what, f"shape ({size}, 1)", f"shape {value.shape}")
    return ca.MX(ca.DM(column(name, what, value, size, nan=nan)))


def density_matrix(name: str, what: str, value: Given, size: int) -> Any:
    """A size x size matrix from a scalar (times identity), a vector (the diagonal) or a matrix, or lists of entries.

    Constant data are checked here: finite, symmetric, positive semidefinite.
    """
    known = [entry for entry in value if isinstance(entry, (int, float))] if isinstance(value, (list, tuple)) else []
    value = gathered(value)
    if is_symbolic(value) and known:
        check_density(name, what, np.diag(known), definite=False)
    expected = f"a number, {size} numbers (the diagonal) or a {size} x {size} matrix" if size > 1 else "a number"
    if is_symbolic(value):
        if value.shape == (size, size):
            check_symmetric(name, what, value)
            return value
        if value.shape == (1, 1):
            return value * ca.MX.eye(size)
        if value.shape == (size, 1):
            return ca.diag(value)
        raise shape_error(name, what, expected, f"shape {value.shape}")
    numbers = as_number(name, what, value)
    if numbers.size == 1:
        numbers = np.diag(np.full(size, float(numbers.reshape(()))))
    elif numbers.size == size and (numbers.ndim == 1 or 1 in numbers.shape):
        numbers = np.diag(numbers.ravel())
    if numbers.shape != (size, size):
        raise shape_error(name, what, expected, f"shape {numbers.shape}")
    check_density(name, what, numbers, definite=False)
    full = ca.DM(0.5 * (numbers + numbers.T))
    return ca.MX(ca.project(full, ca.Sparsity.diag(size) + ca.sparsify(full).sparsity()))


def symmetric_data(name: str, what: str, value: Given, size: int, *, semidefinite: bool) -> Any:
    """Half-vector of a symmetric matrix given as numbers (NaN: free) or as an expression in the parameters."""
    value = gathered(value)
    matrix: Any = value if is_symbolic(value) else as_number(name, what, value)
    if not is_symbolic(value):
        if matrix.ndim > 2:
            raise shape_error(name, what, f"a symmetric {size} x {size} matrix", f"shape {matrix.shape}")
        matrix = matrix.reshape(1, 1) if matrix.size == 1 else matrix
        known = np.nan_to_num(matrix, nan=0.0, posinf=np.inf, neginf=-np.inf)
        if matrix.shape == (size, size):
            if semidefinite and not np.isnan(matrix).any():
                matrix = known = without_rounding(known)
                check_density(name, what, known, definite=False)
            else:
                check_symmetric_numbers(name, what, known)
        matrix = ca.MX(ca.DM(matrix))
    if matrix.shape != (size, size):
        raise shape_error(name, what, f"a symmetric {size} x {size} matrix", f"shape {matrix.shape}")
    return pack_symbolic(matrix)


def is_symmetric(numbers: Array) -> bool:
    """Whether a square matrix is finite, and symmetric to roundoff of its own size."""
    if not np.isfinite(numbers).all():
        return False
    return bool((np.abs(numbers - numbers.T) <= SYMMETRIC * np.abs(numbers).max(initial=0.0)).all())


def check_symmetric_numbers(name: str, what: str, numbers: Array) -> None:
    """A matrix of numbers must be finite, and symmetric to roundoff of its own size; it may be indefinite.

    Raises:
        ProblemError: it is not.
    """
    if is_symmetric(numbers):
        return
    finite = np.isfinite(numbers).all()
    raise ProblemError(
        f"The {what} of '{name}' is not symmetric." if finite else f"The {what} of '{name}' contains NaN or inf.",
        expected="a number" if numbers.size == 1 else "a symmetric matrix",
        received=_with_difference(numbers),
        remedy=_made_even(name, what) if finite else f"check the {what} given for '{name}'",
    )


def _with_difference(numbers: Array) -> str:
    """A matrix as it is printed, and by how much it differs most from its transpose, which its digits may not show."""
    text = np.array2string(numbers, max_line_width=100, threshold=25, prefix=" " * 12)
    if not np.isfinite(numbers).all() or np.array_equal(numbers, numbers.T):
        return text
    difference = np.triu(np.abs(numbers - numbers.T))
    relative = over_units(difference, own_units(numbers, negative=True))
    i, j = (int(k) for k in np.unravel_index(int(np.argmax(relative)), relative.shape))
    return f"{text}, entries [{i}, {j}] and [{j}, {i}] differ by {difference[i, j]:.3g}"


def _made_even(name: str, what: str) -> str:
    return f"give (P + P.T) / 2 where the difference is rounding; else correct the {what} given for '{name}'"


def check_symmetric(name: str, what: str, expression: ca.MX) -> None:
    """A matrix expression must be symmetric: seen at some values of its symbols."""
    symbols = ca.symvar(expression)
    before = accumulate((symbol.numel() for symbol in symbols), initial=0)
    values = [trial_values(s.numel(), k).reshape(s.shape) for s, k in zip(symbols, before, strict=False)]
    numbers = np.asarray(ca.Function("matrix", symbols, [ca.densify(expression)]).call(values)[0].full())
    difference = np.abs(numbers - numbers.T)
    if np.isfinite(numbers).all() and (difference > SYMMETRIC * np.abs(numbers).max(initial=0.0)).any():
        _check_parameters(name, what, expression, values)
        i, j = (int(k) for k in np.unravel_index(int(np.argmax(difference)), difference.shape))
        raise ProblemError(
            f"The {what} of '{name}' is not symmetric.",
            expected="a symmetric matrix",
            received=f"entries [{i}, {j}] and [{j}, {i}] that differ: {str(expression)[:120]}",
            remedy="write A @ P + P @ A.T, not 2 * A @ P; give both off-diagonal entries of a density",
        )


def _check_parameters(name: str, what: str, expression: ca.MX, values: list[Array]) -> None:
    """A matrix that is symmetric where square parameters in it are does not say that they are.

    Raises:
        ProblemError: names the first of them.
    """
    symbols, even, square = ca.symvar(expression), [], []
    for symbol, value in zip(symbols, values, strict=True):
        size = math.isqrt(value.size)
        if size > 1 and size**2 == value.size:
            square.append(f"{symbol.name()} ({size} x {size})")
            value = (value.reshape(size, size) + value.reshape(size, size).T).reshape(value.shape)
        even.append(value)
    numbers = np.asarray(ca.Function("matrix", symbols, [ca.densify(expression)]).call(even)[0].full())
    if not square or (np.abs(numbers - numbers.T) > SYMMETRIC * np.abs(numbers).max(initial=0.0)).any():
        return
    first = square[0].split(" ")[0]
    raise ProblemError(
        f"The {what} of '{name}' is symmetric only where '{first}' is, and nothing says that it is.",
        expected="an expression that is symmetric for all values of what is in it",
        received=f"{', '.join(square)}, all of whose entries are free",
        remedy=f"write ({first} + {first}.T) / 2 for {first}",
    )


def check_density(name: str, what: str, numbers: Array, *, definite: bool) -> None:
    """A numeric density or variance must be finite, symmetric and positive (semi)definite, in units of its own."""
    problem = "contains NaN or inf" if not np.isfinite(numbers).all() else _indefinite(numbers, definite)
    scalar = numbers.size == 1
    if problem:
        number = f"a {'positive' if definite else 'nonnegative'} number"
        matrix = f"a symmetric positive {'definite' if definite else 'semidefinite'} matrix"
        uneven = problem == UNEVEN
        raise ProblemError(
            f"The {what} of '{name}' {problem}.",
            expected=number if scalar else matrix,
            received=f"{float(numbers.item()):g}" if scalar else _with_difference(numbers),
            remedy=_made_even(name, what)
            if uneven
            else f"check the {what} given for '{name}'"
            + (": every measurement needs some noise" if definite and "noise" in what else ""),
        )


def _indefinite(numbers: Array, definite: bool) -> str:
    """What keeps a finite density or variance from being symmetric and positive (semi)definite; "" where nothing."""
    if not numbers.size:
        return ""
    diagonal = np.diagonal(numbers)
    alone = np.count_nonzero(numbers) == np.count_nonzero(diagonal)
    if alone and (diagonal > 0 if definite else diagonal >= 0).all():
        return ""
    scaled = over_units(numbers, own_units(numbers, negative=True))  # entries 10^18 apart say nothing of each other
    if (np.abs(scaled - scaled.T) > SYMMETRIC * np.maximum(1.0, np.abs(scaled))).any():
        return UNEVEN
    scaled = 0.5 * (scaled + scaled.T)
    values, scalar = np.linalg.eigvalsh(scaled), numbers.size == 1
    largest = float(np.abs(values).max())
    plain = float(np.linalg.eigvalsh(numbers)[0])
    told = f"(smallest eigenvalue {plain:.6g})"
    if np.sign(plain) != np.sign(values[0]):  # rounding of the largest one
        told = f"(smallest eigenvalue {values[0]:.6g} where the diagonal is scaled to 1)"
    if values[0] < -1e-12 * largest:
        return "is negative" if scalar else f"is not positive semidefinite {told}"
    if definite and values[0] <= (0.0 if alone else 1e-14 * largest):
        return "is zero" if scalar else f"is singular {told}"
    return ""


def check_bounds(name: str, lower: Array, upper: Array) -> None:
    """Bounds must not cross, nor leave nothing but infinity."""
    for i in np.flatnonzero((lower > upper) | (lower == np.inf) | (upper == -np.inf)):
        entry = f"component {i} of '{name}'" if lower.size > 1 else f"'{name}'"
        raise ProblemError(
            f"The bounds of {entry} cross." if lower[i] > upper[i] else f"The bounds of {entry} leave no number.",
            expected="lower <= upper, lower < inf, upper > -inf",
            received=f"lower = {lower[i]:g}, upper = {upper[i]:g}",
            remedy="exchange or correct them",
        )


def check_inside(name: str, what: str, values: Array, lower: Array, upper: Array) -> None:
    """Given (not NaN) values must lie within the bounds."""
    margin = 1e-12 * np.maximum(1.0, np.abs(np.nan_to_num(values)))
    for i in np.flatnonzero((values < lower - margin) | (values > upper + margin)):
        entry = f"component {i} of '{name}'" if lower.size > 1 else f"'{name}'"
        raise ProblemError(
            f"The {what} value of {entry} lies outside its bounds.",
            expected=f"a value in [{digits(lower[i])}, {digits(upper[i])}]",
            received=digits(values[i]),
            remedy=f"move the {what} value or widen the bounds",
        )


def digits(value: Any) -> str:
    """A number with as many digits as tell it from every other."""
    return repr(float(value)).removesuffix(".0")


def check_positive(name: str, value: Given, unit: str = "") -> float:
    """A positive finite number."""
    number = np.full(1, np.nan) if value is None else as_number(name, "value", value)
    if number.size != 1 or not math.isfinite(float(number.reshape(()))) or float(number.reshape(())) <= 0:
        raise ProblemError(
            f"'{name}' must be positive.",
            expected=f"a finite number > 0{' ' + unit if unit else ''}",
            received=repr(value),
            remedy=f"give a positive {name}" + (", or Free(guess) to leave it free" if name == "duration" else ""),
        )
    return float(number.reshape(()))


def check_times(guess: float, lower: float, upper: float) -> None:
    """The three numbers of a free terminal time must be in order."""
    if not 0 < lower <= guess <= upper:
        raise ProblemError(
            "The free duration is not ordered.",
            expected="0 < lower <= guess <= upper [s]",
            received=f"lower = {lower:g}, guess = {guess:g}, upper = {upper:g}",
            remedy="correct the three numbers of Free(guess, lower, upper)",
        )


def _numbers(size: int) -> str:
    return f"a number or {size} numbers" if size > 1 else "a number"


def shape_error(name: str, what: str, expected: str, received: str, entries: int = 0) -> ProblemError:
    """The error for a shape that does not fit; `entries`: of a vector that was received, which may be meant."""
    meant = f", or declare '{name}' with {entries} entries (shape={entries})" if entries > 1 else ""
    return ProblemError(
        f"The {what} of '{name}' has the wrong size.",
        expected=expected,
        received=received,
        remedy=f"give the {what} of '{name}' in that shape{meant}",
    )
