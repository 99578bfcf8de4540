"""What a user gives as initial and final values: numbers or expressions, None where something is free."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.checks import check_inside, column, data_column, is_symbolic
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array


def end_value(name: str, what: str, value: Given, lower: Array, upper: Array) -> Any:
    """An initial or final value of a vector as a column; what is free is NaN in it.

    Args:
        name: of the state.
        what: "initial" or "final".
        value: a number, a sequence with None where a component is free, an expression of parameters; None: free.
        lower: bounds, shape (size,), that numbers must keep.
        upper: likewise. Numbers that pass them by rounding are at the bound.

    Raises:
        ProblemError: NaN or inf, a size that does not fit, a value outside the bounds.
    """
    check_free(name, f"{what} value", value)
    if value is None:
        return ca.MX(ca.DM.nan(lower.size, 1))
    if not is_symbolic(value):
        numbers = column(name, f"{what} value", value, lower.size, nan=True)
        check_inside(name, what, numbers, lower, upper)
        value = np.clip(numbers, lower, upper)
    return data_column(name, f"{what} value", value, lower.size, nan=True)


def check_free(name: str, what: str, value: Given) -> None:
    """What is free is None, never NaN: NaN is what a computation that went wrong leaves.

    Raises:
        ProblemError: a value, or one in a sequence, is NaN.
    """
    if any(isinstance(entry, (float, np.floating)) and np.isnan(entry) for entry in _entries(value)):
        raise ProblemError(
            f"The {what} of '{name}' contains NaN.",
            expected="finite numbers; None, by itself or in a sequence, for what is free",
            received=str(value)[:200],
            remedy=f"write None for what is free, such as [1.0, None]; otherwise correct the {what} of '{name}'",
        )


def _entries(value: Given) -> Iterator[Any]:
    """The numbers, and whatever else there is, in a value."""
    if is_symbolic(value):
        value = ca.evalf(value) if value.is_constant() else None
    if isinstance(value, ca.DM):
        value = value.full()
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist()
    if isinstance(value, (list, tuple)):
        for entry in value:
            yield from _entries(entry)
    else:
        yield value
