"""A casadi.Function that says by name which of its numeric arguments does not fit."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.blocks.values import array, is_symbolic, wrong_argument

# Deviation from length one of what was measured or stored in single precision.
UNIT = 1e-3


class CheckedFunction(ca.Function):
    """A function of dense columns whose numbers are looked at before it is evaluated.

    Columns must be finite and of the right length, given as numbers, flat arrays or columns; those named in `gaps` may
    hold NaN, which stands for a missing reading, and those named in `units` must have length one. Expressions go
    through as to any casadi.Function. The result is a flat array, or a tuple of them, where all arguments are numbers.
    """

    def __init__(self, function: ca.Function, gaps: tuple[str, ...] = (), units: tuple[str, ...] = ()) -> None:
        """A copy of the function; `gaps`: names of the inputs that may be missing; `units`: of those of length one."""
        super().__init__(function)
        self.gaps, self.units = gaps, units

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """The value of the function.

        Raises:
            ProblemError: another size, NaN, or infinite numbers, by the name of the argument.
        """
        given = dict(zip(self.name_in(), arguments, strict=False)) | named
        if len(given) != self.n_in() or len(arguments) > self.n_in():
            return super().__call__(*arguments, **named)
        if is_symbolic(*given.values()):
            for name, value in given.items():
                if is_symbolic(value) and name in self.name_in() and value.numel() != self.size1_in(name):
                    received = " x ".join(str(count) for count in value.shape)
                    raise wrong_argument(name, f"{self.size1_in(name)} x 1", received)
            return super().__call__(*arguments, **named)
        columns = [self._column(name, given[name]) for name in self.name_in() if name in given]
        results = [value.full().ravel() for value in self.call(columns)]
        return results[0] if len(results) == 1 else tuple(results)

    def _column(self, name: str, value: Expr) -> Any:
        """One argument, checked."""
        numbers, size = array(name, value), self.size1_in(name)
        if numbers.size != size or (numbers.ndim == 2 and size not in numbers.shape) or numbers.ndim > 2:
            received = f"{numbers.size}" if numbers.ndim < 2 else " x ".join(str(count) for count in numbers.shape)
            raise wrong_argument(name, f"{size} number{'s' if size > 1 else ''}", received)
        if np.isinf(numbers).any() or (name not in self.gaps and np.isnan(numbers).any()):
            expected = "finite numbers" + (", or NaN where the reading is missing" if name in self.gaps else "")
            raise wrong_argument(name, expected, f"{numbers.ravel()}"[:100])
        if name in self.units and np.isfinite(numbers).all() and abs(np.linalg.norm(numbers) - 1.0) > UNIT:
            raise wrong_argument(name, "numbers of length one", f"{numbers.ravel()}"[:100])
        return ca.DM(numbers.ravel())

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies keep what may be missing."""
        return _restored, (self.serialize(), self.gaps, self.units)


def _restored(text: str, gaps: tuple[str, ...], units: tuple[str, ...] = ()) -> CheckedFunction:
    return CheckedFunction(ca.Function.deserialize(text), gaps, units)
