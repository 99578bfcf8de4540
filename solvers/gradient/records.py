"""What is known of an iterate of the gradient method: its run, its slopes, its measures."""

from __future__ import annotations

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.solvers.gradient.influence import (
    Run,
    Slopes,
)
from covocp.solvers.gradient.penalty import Penalty


@dataclass(frozen=True, kw_only=True)
class Iterate:
    """A point with its forward sweep and its penalties."""

    point: Array
    run: Run
    penalty: Penalty

    __repr__ = short_repr

    @property
    def cost(self) -> float:
        """J with the penalties."""
        return self.run.cost + self.penalty.value


@dataclass(frozen=True, kw_only=True)
class Linear:
    """First-order change at an iterate: slopes of cost with penalties (n,), of the terminal conditions (q, n).

    sizes: sum of the absolute parts of the slopes by the controls, without the terminal conditions, (n,).
    """

    slope: Array
    rows: Array
    sizes: Array
    slopes: Slopes

    __repr__ = short_repr

    @property
    def finite(self) -> bool:
        """Whether all slopes are numbers."""
        return bool(np.isfinite(self.slope).all() and np.isfinite(self.rows).all())

    def lagrangian(self, ell: Array) -> Array:
        """h_u + H_u' l."""
        return np.asarray(self.slope + self.rows.T @ ell)


@dataclass(frozen=True, kw_only=True)
class Measures:
    """What the stop test reads; none of it depends on the weighting of the step.

    ell: least-squares multipliers; residual: slopes of the Lagrangian with them, (n,); active: entries at a bound that
    the residual pushes outward; slope, miss: relative; transversality: dJ/dT of the Lagrangian.
    """

    ell: Array
    residual: Array
    active: Array
    slope: float
    miss: float
    transversality: float

    __repr__ = short_repr

    @staticmethod
    def unknown(linear: Linear) -> Measures:
        """Of a point whose slopes are no numbers."""
        count, conditions = linear.slope.size, linear.rows.shape[0]
        return Measures(
            ell=np.zeros(conditions),
            residual=np.zeros(count),
            active=np.zeros(count, dtype=bool),
            slope=np.inf,
            miss=np.inf,
            transversality=np.nan,
        )
