"""States that are no vectors: how a state moves by a small vector, its tangent, and how two states differ by one.

An attitude is four numbers on a sphere, and three say how it changes. What holds for it holds for every such state: it
is moved by a *tangent* vector (a retraction), two of them differ by one, and its rate is a tangent velocity. Steps,
covariances, feedback, filters and simulations work with tangents and know no attitudes; where all states are vectors
the tangent is the state itself and nothing is added to any expression.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.quadrature import classical_step
from covocp.base.short_repr import short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart:
    """How one kind of state moves; z is the state, d a tangent at it.

    Attributes:
        kind: what it is, for descriptions and files.
        size: entries of z.
        tangent: entries of d.
        move: (z, d) -> z moved by d, which `difference` undoes.
        difference: (z, base) -> the d that moves the base to z.
        basis: z -> slope of `move` by d at d = 0, (size, tangent).
        velocity: (z, dz/dt) -> tangent velocity v.
        course: (d, v) -> dd/dt along move(z, d) with z fixed, to the fourth order in d.
        drift: v -> D of dd/dt = D d + dv, by which two states that move along each other differ, (tangent, tangent).
        like: (z, base) -> z with the invariant of the base (its length), for steps that keep it up to their error.
    """

    kind: str
    size: int
    tangent: int
    move: ca.Function
    difference: ca.Function
    basis: ca.Function
    velocity: ca.Function
    course: ca.Function
    drift: ca.Function
    like: ca.Function

    __repr__ = short_repr


@dataclass(frozen=True)
class Part:
    """Where one symbol lies: its rows of the state, its rows of the tangent, and its chart where it has one."""

    rows: slice
    tangent: slice
    chart: Chart | None


@dataclass(frozen=True, eq=False)
class Geometry:
    """How a stacked state moves: the parts it consists of, vectors and others."""

    parts: tuple[Part, ...]

    __repr__ = short_repr

    @staticmethod
    def of(entries: Iterable[Any]) -> Geometry:
        """Of declarations or blocks, one below the other: what has a `size`, and a `chart` or none."""
        parts, row, error = [], 0, 0
        for entry in entries:
            chart = getattr(entry, "chart", None)
            count = entry.size if chart is None else chart.tangent
            parts.append(Part(slice(row, row + entry.size), slice(error, error + count), chart))
            row, error = row + entry.size, error + count
        return Geometry(tuple(parts))

    @staticmethod
    def stacked(*groups: Geometry | int) -> Geometry:
        """Several, one below the other; a number stands for a vector of that many entries."""
        parts: list[Part] = []
        row = error = 0
        for group in groups:
            own = Geometry.vector(group) if isinstance(group, int) else group
            for part in own.parts:
                rows, tangent = (slice(s.start + k, s.stop + k) for s, k in ((part.rows, row), (part.tangent, error)))
                parts.append(Part(rows, tangent, part.chart))
            row, error = row + own.size, error + own.tangent
        return Geometry(tuple(parts))

    @staticmethod
    def vector(size: int) -> Geometry:
        """Of a vector."""
        return Geometry((Part(slice(0, size), slice(0, size), None),) if size else ())

    def first(self, entries: int) -> Geometry:
        """Of the first entries of the state."""
        return Geometry(tuple(part for part in self.parts if part.rows.stop <= entries))

    @property
    def plain(self) -> bool:
        """Whether the whole state is a vector."""
        return all(part.chart is None for part in self.parts)

    @property
    def size(self) -> int:
        """Entries of the state."""
        return self.parts[-1].rows.stop if self.parts else 0

    @property
    def tangent(self) -> int:
        """Entries of a tangent."""
        return self.parts[-1].tangent.stop if self.parts else 0

    def move(self, x: Expr, d: Expr) -> Any:
        """The state moved by a tangent."""
        if self.plain:
            return x + d
        return self._stacked(lambda p: x[p.rows] + d[p.tangent], lambda c, p: c.move(x[p.rows], d[p.tangent]))

    def difference(self, x: Expr, base: Expr) -> Any:
        """The tangent that moves the base to x."""
        if self.plain:
            return x - base
        return self._stacked(lambda p: x[p.rows] - base[p.rows], lambda c, p: c.difference(x[p.rows], base[p.rows]))

    def velocity(self, x: Expr, rate: Expr) -> Any:
        """The tangent velocity of a rate of the state."""
        if self.plain:
            return rate
        return self._stacked(lambda p: rate[p.rows], lambda c, p: c.velocity(x[p.rows], rate[p.rows]))

    def course(self, d: Expr, velocity: Expr) -> Any:
        """The rate of d along move(x, d), with x fixed."""
        if self.plain:
            return velocity
        return self._stacked(lambda p: velocity[p.tangent], lambda c, p: c.course(d[p.tangent], velocity[p.tangent]))

    def like(self, x: Expr, base: Expr) -> Any:
        """The state with the invariants of the base."""
        if self.plain:
            return x
        return self._stacked(lambda p: x[p.rows], lambda c, p: c.like(x[p.rows], base[p.rows]))

    def basis(self, x: Expr) -> Any:
        """Slope of the moved state by the tangent, (size, tangent)."""
        return ca.diagcat(*(ca.DM.eye(_count(p)) if p.chart is None else p.chart.basis(x[p.rows]) for p in self.parts))

    def drift(self, velocity: Expr) -> Any:
        """What two states that move along each other differ by, see `Chart.drift`; (tangent, tangent)."""
        blocks = (
            ca.DM(_count(p), _count(p)) if p.chart is None else p.chart.drift(velocity[p.tangent]) for p in self.parts
        )
        return ca.diagcat(*blocks)

    def tangent_slope(self, x: Expr, slope: Expr) -> Any:
        """A slope by the state as one by the tangent."""
        return slope if self.plain else slope @ self.basis(x)

    def slope(self, x: Expr, rate: Expr) -> Any:
        """F of dd/dt = F d, for the error d of a state that moves by a rate, an expression in x; (tangent, tangent)."""
        if self.plain:
            return ca.jacobian(rate, x)
        velocity = self.velocity(x, rate)
        return ca.jacobian(velocity, x) @ self.basis(x) + self.drift(velocity)

    def carried(self, start: Expr, end: Expr, slope: Expr) -> Any:
        """The slope of a state after a step by that before it, as one from tangent to tangent."""
        if self.plain:
            return slope
        moved = slope @ self.basis(start)
        return ca.horzcat(*(self.velocity(end, moved[:, j]) for j in range(self.tangent)))

    def step(self, rate: Callable[[Expr, float], Expr], value: Expr, h: Expr) -> Any:
        """A classical Runge-Kutta step of a state, and of what is stacked below it, in the tangent at its start.

        Args:
            rate: (value, share of the step) -> slope, of the state as of what is below it.
            value: at the start.
            h: length of the step.
        """
        if self.plain:
            return classical_step(rate, value, h)
        x, rest = value[: self.size], value[self.size :]

        def local(moved: Expr, c: float) -> Expr:
            d = moved[: self.tangent]
            at = self.move(x, d)
            slope = rate(ca.vertcat(at, moved[self.tangent :]), c)
            return ca.vertcat(self.course(d, self.velocity(at, slope[: self.size])), slope[self.size :])

        end = classical_step(local, ca.vertcat(type(value).zeros(self.tangent), rest), h)
        return ca.vertcat(self.move(x, end[: self.tangent]), end[self.tangent :])

    def moved(self, x: Array, d: Array) -> Array:
        """`move` of numbers: states (K, size), tangents (K, tangent)."""
        return x + d if self.plain else self._mapped(self.move, x, d)

    def differences(self, x: Array, base: Array) -> Array:
        """`difference` of numbers: states (K, size), bases (K, size)."""
        return x - base if self.plain else self._mapped(self.difference, x, base)

    def _mapped(self, function: Callable[[Expr, Expr], Expr], x: Array, other: Array) -> Array:
        symbols = [ca.SX.sym(name, values.shape[1]) for name, values in (("x", x), ("other", other))]
        mapped = ca.Function("mapped", symbols, [ca.densify(function(*symbols))]).map(x.shape[0])
        return np.asarray(mapped(x.T, other.T).full()).T if x.shape[0] else np.zeros((0, symbols[0].shape[0]))

    def _stacked(self, plain: Callable[[Part], Expr], curved: Callable[[Chart, Part], Expr]) -> Any:
        return ca.vertcat(*(plain(p) if p.chart is None else curved(p.chart, p) for p in self.parts))


def _count(part: Part) -> int:
    return int(part.rows.stop - part.rows.start)
