"""Data given over time: the numbers themselves, and where their interpolation has kinks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr

# Distance of a value from the straight line between its neighbours, relative to the range of all, that is roundoff.
STRAIGHT = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class TimeData:
    """Values over time, interpolated between.

    times: rising, shape (K,) [s]; values: shape (K, m); kind: "linear" or "cubic".
    expression: their value at the running time in the user's expressions, shape (m, 1).
    """

    name: str
    unit: str
    kind: str
    times: Array
    values: Array
    expression: ca.MX

    __repr__ = short_repr

    def at(self, times: Array) -> Array:
        """Values at some times, (K,) of a scalar, (K, m) of a vector."""
        (time,) = ca.symvar(self.expression)
        course = ca.Function("course", [time], [self.expression])
        values = (
            np.asarray(course.map(times.size)(times[None, :]).full().T)
            if times.size
            else np.zeros((0, course.nnz_out()))
        )
        return values[:, 0] if values.shape[1] == 1 else values

    @property
    def kinks(self) -> Array:
        """Times at which the slope jumps; a cubic spline has none.

        Its third derivative jumps at the knots, which the steps of fourth order pass without a loss of order.
        """
        if self.kind != "linear" or self.times.size < 3:
            return np.zeros(0)
        share = (np.diff(self.times)[:-1] / (self.times[2:] - self.times[:-2]))[:, None]
        line = (1 - share) * self.values[:-2] + share * self.values[2:]
        bent = np.abs(self.values[1:-1] - line) > STRAIGHT * np.ptp(self.values, axis=0)
        return np.asarray(self.times[1:-1][bent.any(axis=1)])


def in_words(data: Iterable[TimeData], expressions: Sequence[ca.MX]) -> tuple[list[Any], list[Any]]:
    """Expressions with symbols of their names in place of data, and these symbols."""
    known = list(data)
    symbols = [ca.MX.sym(entry.name, entry.values.shape[1]) for entry in known]
    if not known or not expressions:
        return list(expressions), symbols
    return list(ca.graph_substitute(list(expressions), [entry.expression for entry in known], symbols)), symbols


def kinks(data: TimeData, duration: float) -> tuple[float, ...]:
    """Instants inside (0, T) at which data have kinks, as rising fractions of the terminal time T [s]."""
    found = data.kinks / duration
    return tuple(found[(found > 0.0) & (found < 1.0)].tolist())
