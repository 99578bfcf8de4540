"""How fast modes are along the nominal, and by how much a step of the Gauss method is divided for them.

The two-stage Gauss method is stable at any length z of a step in time constants of a mode, but forgets it by the factor
R(z) = (1 - z/2 + z^2/12)/(1 + z/2 + z^2/12), which is small around z = sqrt(12) and tends to 1 for long steps: a mode
that is over at once would seem to go on. Pieces each of which leaves an eighth of what is to come have one of the right
length for every mode, and their number grows as the logarithm of the ratio. A mode that turns wants equal pieces.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array, stacked
from covocp.base.quadrature import GAUSS_NODES
from covocp.base.short_repr import short_repr
from covocp.export.laws.design import Design
from covocp.export.laws.history import History

# Time constants in a piece, at most: |R(6)| = 1/7. What a piece leaves where there are more.
FORGETS, LEFT = 6.0, 0.125
# By which angle a mode may turn in a piece [rad]: an error of the phase of z^5/720, and in how many pieces at most.
TURNS, MOST = 2.0, 16
# A mode damped by less than this turns before it is over.
DAMPED = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Paces:
    """Of each interval of the mesh: rate of the fastest mode that dies away, and of the one that turns or grows [1/s].

    matter: whether they divide any interval.
    """

    decay: Array
    turn: Array
    matter: bool

    __repr__ = short_repr

    def at(self, interval: Expr) -> tuple[Any, Any]:
        """Both rates in an interval, MX expressions."""
        return ca.MX(ca.DM(self.decay))[interval], ca.MX(ca.DM(self.turn))[interval]


def paces(design: Design, tables: History) -> Paces:
    """From the eigenvalues of F at the Gauss points of each interval."""
    h, units = np.diff(tables.nodes), design.units
    rates = []
    for c in GAUSS_NODES:
        t = tables.nodes[:-1] + c * h
        x, u, _ = tables.rows(t)
        F = stacked(design.linear.map(t.size)(x.T, u.T, t[None, :])[0], t.size) * units / units[:, None]
        F[~np.isfinite(F).all(axis=(1, 2))] = 0.0
        rates.append(np.linalg.eigvals(F))
    modes = np.hstack(rates)
    size = np.abs(modes)
    dies = -modes.real > DAMPED * size
    decay = np.where(dies, size, 0.0).max(axis=1, initial=0.0)
    turn = np.minimum(np.where(dies, 0.0, size).max(axis=1, initial=0.0), MOST * TURNS / h)
    return Paces(decay=decay, turn=turn, matter=bool((decay * h > FORGETS).any() or (turn * h > TURNS).any()))


def first_share(rates: tuple[Any, Any], length: Expr, least: float) -> Any:
    """The share of a part of an interval that its first piece takes, 1 where it is not divided; an expression.

    Args:
        rates: of the interval.
        length: of the part [s].
        least: a piece is longer than that [s].
    """
    decay, turn = rates
    equal = 1.0 / ca.fmax(ca.ceil(turn * length / TURNS - 1e-3), 1.0)
    share = ca.fmin(equal, ca.if_else(decay * length > FORGETS, 1.0 - LEFT, 1.0))
    return ca.if_else(ca.fmin(share, 1.0 - share) * length > least, share, 1.0)


def divided(own: Paces, tables: History, grid: Array, least: float) -> Array:
    """Times, among them all nodes of the mesh between their ends, with those at which a step between two is divided.

    Args:
        own: of the mesh of the tables.
        tables: the nominal.
        grid: rising times [s].
        least: a piece is longer than that [s].
    """
    if not own.matter:
        return grid
    times = []
    middle = 0.5 * (grid[1:] + grid[:-1])
    intervals = np.clip(np.searchsorted(tables.nodes, middle, side="right") - 1, 0, own.decay.size - 1)
    for begin, end, k in zip(grid[:-1], grid[1:], intervals, strict=True):
        now, share = float(begin), 0.0
        while share < 1.0:
            times.append(now)
            share = float(first_share((own.decay[k], own.turn[k]), end - now, least))
            now += share * (end - now)
    return np.array([*times, grid[-1]])
