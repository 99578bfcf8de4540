"""Inequalities of a problem: along the path, at its ends, and at instants of the horizon."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.base.threads import cached


def beyond(values: Array, lower: Array, upper: Array) -> Array:
    """How far values lie beyond their limits, negative within them; inf where they are NaN or inf.

    What has no value meets no limit, and NaN would pass every comparison with one.
    """
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(values), np.maximum(lower - values, values - upper), np.inf)


class Columns(NamedTuple):
    """States, controls, half-vectors and times of several points, a column each."""

    x: Expr
    u: Expr
    matrices: Expr
    time: Expr


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Inequalities lower <= value(...) <= upper of one kind: along the path, at the start or at the end.

    `function` takes (state, control, matrices, time, duration, parameters); `names` has one entry for each row.
    `realised` is the same of one run, whose spread is none: the covariance X of the closed loop is zero in it; None
    where no row contains X. `scattered` is the same of any X, whose half-vector it takes as a last argument; None where
    `realised` is. `between` tells the rows that must hold at all times, whatever it takes.
    """

    function: ca.Function
    names: tuple[str, ...]
    lower: Array
    upper: Array
    uses_matrices: bool
    realised: ca.Function | None = None
    scattered: ca.Function | None = None
    between: tuple[bool, ...] = ()

    __repr__ = short_repr

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.names)

    @property
    def equations(self) -> NDArray[np.bool_]:
        """Which rows have both limits equal."""
        return np.asarray(self.lower == self.upper)

    @property
    def of_zero(self) -> NDArray[np.bool_]:
        """Which rows have a limit of zero."""
        return np.asarray((self.lower == 0.0) | (self.upper == 0.0))

    def columns(self, at: Columns, duration: Expr, parameters: Expr) -> Any:
        """The values for columns of points; matrices that no row reads are no part of the expression.

        Else every slope of these values would carry the propagation of the covariances along.
        """
        count = at.x.shape[1]
        seen = at.matrices if self.uses_matrices else ca.DM(*at.matrices.shape)
        rest = (ca.repmat(duration, 1, count), ca.repmat(parameters, 1, count))
        return self.function.map(count)(at.x, at.u, seen, at.time, *rest)


@dataclass(frozen=True, kw_only=True, eq=False)
class Instant:
    """Conditions that hold at one instant of the horizon.

    place: share of the terminal time, inside (0, 1).
    late: whether they hold after what is read there and with the control that goes on; else before it, with the one
        that ends.
    apart: whether that makes a difference: they contain the control, or something is read there. Meshes then have a
        node of their own for late ones, between the node before and the node after the instant.
    """

    place: float
    late: bool
    apart: bool
    conditions: Conditions

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Inside:
    """All conditions at instants of the horizon, one instant after the other; their rows in this order."""

    parts: tuple[Instant, ...] = ()

    __repr__ = short_repr

    @cached
    def places(self) -> tuple[float, ...]:
        """The instants, rising, each once."""
        return tuple(sorted({part.place for part in self.parts}))

    @cached
    def thrice(self) -> tuple[float, ...]:
        """The instants that need a node between those before and after them."""
        return tuple(sorted({part.place for part in self.parts if part.late and part.apart}))

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.names)

    @cached
    def names(self) -> tuple[str, ...]:
        """Of the rows."""
        return tuple(name for part in self.parts for name in part.conditions.names)

    @cached
    def lower(self) -> Array:
        """Of the rows."""
        return np.concatenate([np.zeros(0), *(part.conditions.lower for part in self.parts)])

    @cached
    def upper(self) -> Array:
        """Of the rows."""
        return np.concatenate([np.zeros(0), *(part.conditions.upper for part in self.parts)])

    @property
    def uses_matrices(self) -> bool:
        """Whether some row reads a matrix."""
        return any(part.conditions.uses_matrices for part in self.parts)

    def split(self, values: Any) -> list[Any]:
        """Values of all rows, an array or a column, shared out among the instants."""
        ends = np.cumsum([0, *(part.conditions.size for part in self.parts)]).tolist()
        return [values[i:j] for i, j in pairwise(ends)]

    def nodes_among(self, nodes: Array) -> list[int]:
        """Which of the nodes of a mesh is that of each instant: the first one there, or the one before the last.

        Raises:
            ValueError: an instant is not there twice.
        """
        found = []
        for part in self.parts:
            at = np.flatnonzero(nodes == part.place)
            if at.size < (3 if part.late and part.apart else 2):
                raise ValueError("the nodes of the mesh are not those of the conditions at instants")
            found.append(int(at[-2] if part.late else at[0]))
        return found
