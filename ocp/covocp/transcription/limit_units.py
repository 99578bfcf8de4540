"""Units of the rows of conditions: solvers meet rows to an absolute tolerance, so a row has the size of its limits.

A limit of zero tells no unit. What stands beside the variables does: E - 0.01 <= 0 is E <= 0.01. It is read where all
variables are zero, at the times at which the row is to hold, and is no more than what the row is, or varies by, where
it is known to be: 4 / (|x|^2 + 1e-9) - 1 is 4e9 at the origin and |x - c|^2 - R^2 is |c|^2 there, which neither is
on its way.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.buffered import Matrices
from covocp.base.matrices import Array
from covocp.statement.interval import model_symbols
from covocp.statement.statement import Conditions, Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.nlp import Scales

# Limits below the first and above the second are the units of their rows: solvers meet rows to an absolute tolerance.
SMALL, LARGE = 0.1, 1e3
# Limits of zero tell no unit: it is one, unless the rows vary by so many times less.
SILENT = 1e3
# Shares of the horizon at which a row along the path is looked at.
ALONG = (0.0, 0.5, 1.0)
# What stands beside the variables at one time is zero by rounding below this share of that at others; two ends of a
# state are the same below this share of its size.
ROUNDOFF, SAME = 1e-12, 1e-9
# A row is met to a tolerance of 1e-8 of its unit at best where that is no less than this share of what its terms are.
ACCURATE = 1e-7


def limit_units(lower: Array, upper: Array) -> Array:
    """Units of rows between limits: the larger one where it is small, the nearer one to zero where it is large, else 1.

    A large limit beside one that is not (-1e9 <= v <= 0.3, 0 <= v <= 1e9) says nothing of what it limits.
    """
    limits = np.abs(np.stack([lower, upper]))
    nearest = np.where(np.isfinite(limits), limits, np.inf).min(axis=0)
    largest = np.where(limits <= LARGE, limits, 0.0).max(axis=0)
    large = np.isfinite(nearest) & (nearest > LARGE)
    return np.where((largest > 0) & (largest < SMALL), largest, np.where(large, nearest, 1.0))


def row_units(statement: Statement, conditions: Conditions, scales: Scales, shares: tuple[float, ...] = ALONG) -> Array:
    """Units of the rows of conditions: those of their limits; where these are zero of what is beside the variables.

    Where that is zero too it is what the row varies by, to first order, if all variables change by their magnitudes,
    where this is below 1 / `SILENT`.

    Args:
        statement: the problem.
        conditions: of it.
        scales: magnitudes of its variables.
        shares: of the horizon at which the conditions are to hold, or some of these.
    """
    lower, upper = conditions.lower, conditions.upper
    units = limit_units(lower, upper)
    silent = ~(np.isfinite(lower) & (lower != 0)) & ~(np.isfinite(upper) & (upper != 0))
    if not silent.any():
        return units
    looks = _Looks(statement, conditions, scales)
    with np.errstate(all="ignore"):
        beside = np.array([looks.beside(share) for share in shares])
        moved = np.array([looks.varied(share) for share in shares])
        least = ACCURATE * moved.max(axis=0)
        capped = np.minimum(beside, np.maximum([looks.known(share) for share in shares], least))
        varied = np.max([looks.varied(share, around=True) for share in shares], axis=0)
    there = beside > ROUNDOFF * beside.max(axis=0)
    largest = np.where(there, capped, 0.0).max(axis=0)
    smallest = np.where(there, capped, np.inf).min(axis=0)
    # it may be met where it is least; there, where that is nothing by chance, the variables tell how small that is
    size = np.maximum(smallest, np.maximum(np.minimum(largest, moved.min(axis=0)), ACCURATE * largest))
    units = np.where(silent & (largest > 0), limit_units(size, size), units)
    return np.where(silent & (largest == 0) & (varied > 0) & (varied < 1.0 / SILENT), varied, units)


class _Looks:
    """Rows of conditions at points of the variables that tell their sizes; what is not finite there tells nothing.

    A state is where it is known to begin and to end, in the middle of both between them, and at its magnitude, to both
    sides, where neither is known; so are controls and matrices.
    """

    def __init__(self, statement: Statement, conditions: Conditions, scales: Scales) -> None:
        self._sizes = scales.x, np.atleast_2d(scales.u).max(axis=0), scales.e
        self._rows, self._variation = Matrices(conditions.function), _variation(statement, conditions.function)
        self._duration, self._parameters = scales.duration, statement.values
        self._start, self._end = statement.boundary_values(statement.values)[:2]
        move = np.abs(self._end - self._start)
        both = np.isfinite(move)
        own = np.where(both & (move > SAME * scales.x), move, np.where(both, 0.0, scales.x))
        self._moves = own if own.any() else scales.x

    def beside(self, share: float) -> Array:
        """What each row is where all variables are zero; 0 where that is no number."""
        return _finite(self._value([0.0 * size for size in self._sizes], share))

    def known(self, share: float) -> Array:
        """What each row is where it is known to be, and varies by on the way; inf where that is no number."""
        sums = []
        for side in (1.0, -1.0):
            at = self._at(share, side)
            moved, whole = self._slopes(at, share, self._moves), self._slopes(at, share, self._sizes[0])
            sums.append(np.abs(self._value(at, share)) + np.where(moved > 0, moved, whole))
        found = np.fmax(*sums)
        return np.where(np.isfinite(found) & (found > 0), found, np.inf)

    def varied(self, share: float, *, around: bool = False) -> Array:
        """What each row varies by if all variables change by their magnitudes; `around`: about zero and these."""
        sides = (1.0, 0.0, -1.0) if around else (1.0, -1.0)
        points = [[side * size for size in self._sizes] if around else self._at(share, side) for side in sides]
        return np.asarray(np.max([_finite(self._slopes(at, share, self._sizes[0])) for at in points], axis=0))

    def _at(self, share: float, side: float) -> list[Array]:
        """States, controls and matrices at a share of the horizon, what is not known to one side."""
        start, end = self._start, self._end
        x = (1.0 - share) * start + share * end
        known = np.where(np.isfinite(start), start, end)  # one of both: it tells a place unless it is zero
        x = np.where(np.isfinite(x), x, np.where(np.isfinite(known) & (known != 0), known, side * self._sizes[0]))
        return [x, side * self._sizes[1], side * self._sizes[2]]

    def _value(self, at: list[Array], share: float) -> Array:
        (found,) = self._rows.evaluated(*at, share * self._duration, self._duration, self._parameters)
        return found.ravel()

    def _slopes(self, at: list[Array], share: float, states: Array) -> Array:
        others = (share * self._duration, self._duration, self._parameters)
        (found,) = self._variation.evaluated(*at, *others, states, *self._sizes[1:])
        return found.ravel()


def _finite(values: Array) -> Array:
    """Sizes of numbers, 0 of what is none."""
    return np.where(np.isfinite(values), np.abs(values), 0.0)


@lru_cache(maxsize=KEPT)
def _variation(statement: Statement, function: ca.Function) -> Matrices:
    """(arguments of conditions, magnitudes of x, u and e) -> what each row varies by if all change by these."""
    symbols = model_symbols(statement)
    kind: Any = statement.symbolic
    sizes = [kind.sym(name, size) for name, size in (("dx", statement.nx), ("du", statement.nu), ("de", statement.ne))]
    varied = ca.fabs(ca.jacobian(function(*symbols), ca.vertcat(*symbols[:3]))) @ ca.vertcat(*sizes)
    return Matrices(ca.Function("variation", [*symbols, *sizes], [ca.densify(varied)]))
