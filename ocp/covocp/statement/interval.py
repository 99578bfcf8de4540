"""What functions of a trajectory take: a control interval, and a point of a trajectory, by the names of their parts."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr, minus, plus, times
from covocp.base.matrices import Array
from covocp.statement.statement import Statement

# Share of an interval by which its ends are moved inside where the model is told the time, see `one_sided`.
SIDE = 1e-10


def one_sided(c: float) -> float:
    """A share of a step as the model is told it: the ends as their limits from inside.

    A rate that jumps where two steps meet (a change of phase at a node) has its left limit on the left and its right
    limit on the right, whichever comparison says it and however the time of the node is rounded.
    """
    return min(max(c, SIDE), 1.0 - SIDE)


class Interval(NamedTuple):
    """A control interval [s, s + ds] of the normalised time, or a part of one; of many, a column for each.

    Attributes:
        start, end: control at its ends, linear between them.
        s, ds: where it begins, and its length.
        duration: T [s].
        parameters: of the statement.
        reading: what it takes of the measurements at instants (`Samples`); zero where its length is not.
    """

    start: Expr
    end: Expr
    s: Expr
    ds: Expr
    duration: Expr
    parameters: Expr
    reading: Expr

    @classmethod
    def symbols(cls, statement: Statement, kind: Any = None) -> Interval:
        """Symbols of all of them, of the kind of the statement's own unless another is given."""
        kind = statement.symbolic if kind is None else kind
        sizes = {"ua": statement.nu, "ub": statement.nu, "s": 1, "ds": 1, "T": 1, "p": statement.np}
        sizes["reading"] = statement.readings
        return cls(*(kind.sym(name, size) for name, size in sizes.items()))

    @property
    def h(self) -> Expr:
        """Its length [s]."""
        return times(self.duration, self.ds)

    def control(self, c: Expr) -> Expr:
        """The control at a share of it."""
        if isinstance(c, (int, float)) and c in (0, 1):
            return self.end if c else self.start
        return plus(self.start, times(c, minus(self.end, self.start)))

    def place(self, c: float) -> Expr:
        """The normalised time at a share of it, its ends as limits from inside."""
        return plus(self.s, times(one_sided(c), self.ds))

    def time(self, c: float) -> Expr:
        """The time [s] at a share of it."""
        return times(self.duration, self.place(c))

    def at(self, c: float, x: Expr, e: Expr | None = None) -> tuple[Expr, ...]:
        """The arguments of the model at a share of it: (x, u, t, T, p), or with half-vectors (x, u, e, t, T, p)."""
        middle = () if e is None else (e,)
        return (x, self.control(c), *middle, self.time(c), self.duration, self.parameters)

    def part(self, c: float, d: float) -> Interval:
        """Its part [c, d], 0 <= c <= d <= 1."""
        if (c, d) == (0, 1):
            return self
        s = plus(self.s, times(c, self.ds)) if c else self.s
        own = {"start": self.control(c), "end": self.control(d), "reading": times(d - c, self.reading)}
        return self._replace(s=s, ds=times(d - c, self.ds), **own)

    def turned(self) -> Interval:
        """The same, passed backward."""
        return self._replace(start=self.end, end=self.start, s=self.s + self.ds, ds=-self.ds)

    def columns(self, chosen: Expr) -> Interval:
        """Some of its columns."""
        return Interval(*(entry[:, chosen] for entry in self))

    def substeps(self, count: int) -> Interval:
        """Each of its columns cut into equal parts, a column for each part."""
        if count == 1:
            return self
        n = self.s.shape[1]
        entries = zip(*(self.part(j / count, (j + 1) / count) for j in range(count)), strict=True)
        return Interval(*(ca.reshape(ca.vertcat(*each), each[0].shape[0], n * count) for each in entries))


def repeated(duration: float, parameters: Array, count: int) -> tuple[Array, Array]:
    """Terminal time and parameters, a column for each of several points."""
    return np.full((1, count), duration), np.tile(parameters[:, None], (1, count))


def model_symbols(statement: Statement) -> list[Expr]:
    """Symbols of the arguments of the model: state, control, half-vectors, time, duration, parameters."""
    kind: Any = statement.symbolic
    sizes = (statement.nx, statement.nu, statement.ne, 1, 1, statement.np)
    return [kind.sym(f"a{i}", size) for i, size in enumerate(sizes)]
