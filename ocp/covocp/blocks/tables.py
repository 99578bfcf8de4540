"""Tables of one to three variables as expressions: piecewise linear or cubic, with exact derivatives.

A table is a polynomial on each cell of its grid. A small one chooses the cell by comparisons, written out in scalars.
For a large one every cell would be computed each time, so that it looks its cell up in the grid, by a function that
stays a call where an expression of MX is written out. Seconds of 1000 values with both derivatives, by comparisons and
looked up: 65 knots 8e-3 and 7e-4, 10 001 knots 1.2 and 2e-2.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import field
from typing import Any, Literal

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline

from covocp.base.arguments import checked
from covocp.base.checks import as_number
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, spelling
from covocp.base.expressions import TABLE, Expr, Given
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr

KINDS = ("linear", "cubic")
# Cells up to which a table in MX chooses by comparisons and is written out.
SMALL_CELLS = 64
# Knots of each variable that the not-a-knot spline needs: its first two and its last two pieces are one.
FEWEST = {"linear": 2, "cubic": 4}


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """A table, called with one argument for each of its variables; outside its grid the outermost pieces go on.

    Attributes:
        name: appears in errors.
        grid: knots of each variable.
        kind: "linear" or "cubic".
    """

    name: str
    grid: tuple[Array, ...]
    kind: str
    coefficients: Array = field(repr=False)

    __repr__ = short_repr

    def __call__(self, *arguments: Given) -> Any:
        """The value at a point.

        Args:
            arguments: a scalar for each variable, in the order of the grid: numbers, or CasADi expressions.

        Returns:
            A number where all of them are numbers, else an expression, scalar.

        Raises:
            ProblemError: another number of arguments, or one that is no scalar.
        """
        if len(arguments) != len(self.grid):
            raise _wrong(self.name, "has another number of variables", str(len(self.grid)), str(len(arguments)))
        for value in arguments:
            symbolic = isinstance(value, (ca.SX, ca.MX))
            size = value.numel() if symbolic else as_number(self.name, "argument", value).size
            if size != 1:
                raise _wrong(self.name, "takes scalars", "a scalar for each variable", repr(value)[:200])
        if any(isinstance(value, ca.SX) for value in arguments):
            if any(isinstance(value, ca.MX) for value in arguments):
                raise _wrong(self.name, "takes no expressions of two kinds", "SX or MX", "SX and MX")
            return self._compared(*(ca.SX(value) for value in arguments))
        if not any(isinstance(value, ca.MX) for value in arguments):
            point = [ca.MX.sym("x") for _ in arguments]
            return float(ca.Function("value", point, [self._looked_up(*point)])(*arguments))
        small = math.prod(knots.size - 1 for knots in self.grid) <= SMALL_CELLS
        kind: Any = ca.SX if small else ca.MX
        symbols = [kind.sym("x") for _ in arguments]
        value = self._compared(*symbols) if small else self._looked_up(*symbols)
        limits = ca.DM([[float(knots[0]), float(knots[-1])] for knots in self.grid])
        unused = kind.sym("limits", *limits.shape)
        name = TABLE + re.sub("_+", "_", re.sub("[^0-9A-Za-z]", "_", self.name)).strip("_")
        options: dict[str, Any] = {"never_inline": not small, "is_diff_in": [True] * len(symbols) + [False]}
        function = ca.Function(name.rstrip("_"), [*symbols, unused], [value], options)
        return function(*(ca.MX(value) for value in arguments), ca.MX(limits))

    def _compared(self, *point: Expr) -> Expr:
        """The value where every cell is compared: halves of the cells are chosen between, an axis after the other."""
        values, offsets = self.coefficients, []
        cells = [knots.size - 1 for knots in self.grid]
        rows = [ca.SX(ca.DM(row)) for row in values.reshape(-1, values.shape[-1])]
        for i in reversed(range(len(cells))):
            rows = [_chosen(point[i], self.grid[i], rows[k : k + cells[i]]) for k in range(0, len(rows), cells[i])]
        for x, knots in zip(point, self.grid, strict=True):
            offsets.append(x - _chosen(x, knots, [ca.SX(float(knot)) for knot in knots[:-1]]))
        return _polynomial(rows[0], offsets)

    def _looked_up(self, *point: Expr) -> Expr:
        """The value where the cell is looked up."""
        cell, offsets = ca.MX(0), []
        for x, knots in zip(point, self.grid, strict=True):
            column = ca.MX(ca.DM(knots))
            k = ca.low(column, x)
            cell = cell * (knots.size - 1) + k
            offsets.append(x - column[k])
        values = self.coefficients.reshape(-1, self.coefficients.shape[-1])
        return _polynomial(ca.MX(ca.DM(values.T))[:, cell], offsets)


@checked()
def table(name: str, grid: Given, values: Given, *, kind: Literal["linear", "cubic"] = "linear") -> Table:
    """A table of one to three variables, usable wherever an expression is.

    Linear: as RegularGridInterpolator of scipy. Cubic: the not-a-knot spline, as CubicSpline of scipy; of several
    variables their tensor product. Outside the grid the outermost pieces go on.

    Args:
        name: appears in errors.
        grid: rising knots of the variable, shape (K,); of several variables a tuple of such.
        values: at the knots, shape (K,), (K, L) or (K, L, M).
        kind: "linear" or "cubic".

    Returns:
        The table, to be called with its variables.

    Raises:
        ProblemError: knots that do not rise, too few of them, values that are not finite or of another shape, unknown
            kind.
    """
    if not isinstance(name, str) or not name:
        raise ProblemError(
            "A table needs a name.", expected="a text", received=repr(name), remedy="give a short name for errors"
        )
    if not isinstance(kind, str) or kind not in KINDS:
        remedy = spelling(kind, KINDS, "choose one of the two")
        raise ProblemError(
            f"Table '{name}' has an unknown kind.", expected="'linear' or 'cubic'", received=repr(kind), remedy=remedy
        )
    axes = tuple(_knots(name, axis, kind) for axis in (grid if isinstance(grid, tuple) else (grid,)))
    if not 1 <= len(axes) <= 3:
        raise _wrong(name, "has no one to three variables", "one, two or three arrays of knots", str(len(axes)))
    numbers = as_number(name, "values", values)
    shape = tuple(knots.size for knots in axes)
    if numbers.shape != shape:
        raise _wrong(name, "has values of another shape", str(shape), str(numbers.shape))
    if not np.isfinite(numbers).all():
        raise _wrong(name, "has values that are not finite", "finite numbers", "NaN or inf")
    return Table(name=name, grid=axes, kind=kind, coefficients=_coefficients(axes, numbers, kind))


def _knots(name: str, given: Given, kind: str) -> Array:
    """Knots of one variable, checked."""
    expected = "shape (K,); of several variables a tuple of such, not a list or an array"
    axes = given if isinstance(given, list) else []
    several = all(isinstance(axis, (list, tuple, np.ndarray)) and np.iterable(axis) for axis in axes)
    if several and len({len(axis) for axis in axes}) > 1:
        raise _wrong(name, "has knots of another shape", expected, f"a list of {len(given)} arrays of knots")
    knots = np.array(as_number(name, "knots", given), dtype=float)
    if knots.ndim != 1:
        raise _wrong(name, "has knots of another shape", expected, f"shape {knots.shape}")
    if not np.isfinite(knots).all():
        raise _wrong(name, "has knots that are not finite", "finite numbers", "NaN or inf")
    if knots.size < FEWEST[kind]:
        raise _wrong(name, "has too few knots", f"at least {FEWEST[kind]} for kind='{kind}'", str(knots.size))
    if not (np.diff(knots) > 0).all():
        k = int(np.flatnonzero(~(np.diff(knots) > 0))[0])
        raise _wrong(name, "has knots that do not rise", "rising knots", f"{knots[k]:g}, then {knots[k + 1]:g}")
    return knots


def _coefficients(axes: Sequence[Array], values: Array, kind: str) -> Array:
    """Coefficients of the powers, highest first, on each cell; shape (*cells, product of the numbers of powers)."""
    result, count = values, len(axes)
    for i, knots in enumerate(axes):
        if kind == "cubic":
            pieces = CubicSpline(knots, result, axis=i, bc_type="not-a-knot").c
        else:
            first = np.moveaxis(result, i, 0)
            widths = np.diff(knots).reshape(-1, *(1,) * (first.ndim - 1))
            pieces = np.stack([np.diff(first, axis=0) / widths, first[:-1]])
        # pieces: (powers, cells, the other axes): powers go last, the cells where the knots were
        result = np.moveaxis(np.moveaxis(pieces, 0, -1), 0, i)
    return np.ascontiguousarray(result.reshape(*result.shape[:count], -1))


def _chosen(x: Expr, knots: Array, entries: list[Expr]) -> Expr:
    """The entry of the cell in which x lies, one for each cell; a knot belongs to the cell after it."""
    if len(entries) == 1:
        return entries[0]
    half = len(entries) // 2
    left, right = _chosen(x, knots[: half + 1], entries[:half]), _chosen(x, knots[half:], entries[half:])
    return ca.if_else(x < float(knots[half]), left, right)


def _polynomial(coefficients: Expr, offsets: list[Expr]) -> Expr:
    """Sum of the powers of the offsets with these coefficients, by Horner's rule in one variable after the other."""
    powers = round(coefficients.numel() ** (1 / len(offsets)))
    rest = coefficients
    for offset in offsets:
        length = rest.numel() // powers
        value = rest[:length]
        for k in range(1, powers):
            value = value * offset + rest[k * length : (k + 1) * length]
        rest = value
    return rest


def _wrong(name: str, what: str, expected: str, received: str) -> ProblemError:
    """What is wrong with a table."""
    return ProblemError(
        f"Table '{name}' {what}.", expected=expected, received=received, remedy="correct what the table is given"
    )
