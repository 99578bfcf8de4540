"""Values of a solution at some times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any

import numpy as np

from covocp.base.checks import as_number
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.pickling import pickled_without
from covocp.statement.names import entry_values, name_of


@pickled_without(symbols=dict)
@dataclass(frozen=True, kw_only=True)
class Sample:
    """Values at some times, indexed like a solution (time first where several times were asked for)."""

    t: Any
    values: Mapping[str, Array] = field(repr=False)
    symbols: Mapping[str, Any] = field(repr=False)

    def __getitem__(self, key: Given) -> Array:
        """The value of a symbol, a name, or an entry of a vector."""
        given = np.ndim(self.t)
        sizes = {n: v.shape[-1] if v.ndim > given else 1 for n, v in self.values.items() if v.ndim <= given + 1}
        return entry_values(self.values, name_of(key, self.symbols, tuple(self.values), sizes=sizes))

    def __repr__(self) -> str:
        """The values by name, on one line."""
        shown = {"t": self.t, **{name: v for name, v in self.values.items() if name not in ("time", "duration")}}
        return f"Sample({', '.join(f'{name} = {_in_line(value)}' for name, value in shown.items())})"


def asked_times(called: str, t: Given, duration: float, whole: str) -> Array:
    """What a user gives as a time or a row of times, as a row.

    Args:
        called: the method that takes them.
        t: what was given.
        duration: the last of the times that there are [s].
        whole: that has this duration, in words.

    Raises:
        ProblemError: one lies outside, or is not a number.
    """
    times = np.atleast_1d(as_number(called, "times", t))
    margin = 1e-9 * duration
    if times.ndim != 1 or not ((times >= -margin) & (times <= duration + margin)).all():
        raise ProblemError(
            "A solution has no values there.",
            expected=f"a time or a row of times within [0, {duration:g}] s",
            received=str(t)[:100],
            remedy=f"stay within the duration of {whole}",
        )
    return times


def _in_line(value: Given) -> str:
    """Numbers on one line, six digits; of large arrays the corners."""
    text = np.array2string(
        np.asarray(value, dtype=float),
        formatter={"float_kind": lambda number: f"{number:.6g}"},
        threshold=20,
        edgeitems=2,
        separator=", ",
    )
    return " ".join(text.split())
