"""What is called converged: residuals in the scale of the point that was reached.

A solver works in scales that the start suggests. Where the start is bad (an unstable plant, a guess in a wrong unit)
its tolerance means nothing there. So every method ends with the same question, asked in the scale of the point it
reached: by how much would the cost J change, to first order, if

- each free variable changed by its own magnitude along the slope of the Lagrangian (`slope`),
- each inequality that has a multiplier were met exactly (`complementarity`),
- each violated constraint were met exactly (`infeasibility`),

all relative to the cost. The gain still to be had is of the order of the square of the first of them, but all of the
second: a convex cost whose slopes are zero is above the least one by no more than that, and often by as much.

A cost that vanishes (tracking) has no size of its own. What the variables change of it by their magnitudes is one, but
no measure of what can still be had: beside a terminal penalty of 1e6 it is 1e6 times the cost. So a point has to meet
it, and runs go on to what is small of the cost itself as long as that helps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array

# Largest residuals of a converged point. To first order it is this share of its cost away from a stationary one, mostly
# the square of it.
LIMIT = 1e-5
# Largest violation of a converged point, in magnitudes of what is constrained.
VIOLATION = 1e-6
# Share of its unit by which a point may pass a limit and have met it: solvers do so by some 1e-8.
PASSED = 1e-7
# Share of its size to which a path is known between the nodes, and may pass a limit there without being said to.
BETWEEN_NODES = 1e-5
# A cost below this share of what the controls change of it (a tracking cost that vanishes) has no size of its own.
VANISHING = 0.1
# Shares of that change which count as no cost: its slopes are rounded to some 1e-16 of it, their sum over all nodes to
# 1e-14, `LIMIT` times the first one. Distances from bounds are not rounded so.
ROUNDED, NO_SIZE = 1e-9, 1e-12
# Slope of a point that meets what it has to from which on another run is worth it: its square is what can be had.
STEEP = 1e-3
# Slope, resolved and as large beside the cost, from which on more than a small share of the cost may be had; costs that
# are none, whose slopes are none either.
TOO_STEEP, NOTHING = 0.1, 1e-24
# Complementarity that a solver could not make less and that is told, and what it is among the counts of a solution.
LEFT, MUCH_LEFT = "complementarity_left", 1e-4


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """First-order changes of the cost that a point leaves, relative to the cost, and its largest violation.

    Attributes:
        slope: by changes of the variables by their own magnitudes along the slope of the Lagrangian.
        complementarity: sum of |multiplier| times distance from the bound over all inequalities.
        infeasibility: sum of |multiplier| times violation over all constraints.
        violation: largest violation, in magnitudes of what is constrained.
        size: of the cost, to which the others are relative.
        varied: what the variables change of the cost by their magnitudes, to second order; 0: not asked for.
    """

    slope: float
    complementarity: float
    infeasibility: float
    violation: float
    size: float = 1.0
    varied: float = 0.0

    @property
    def worst(self) -> float:
        """The largest of them, the violation in multiples of what it may be; inf where one is NaN."""
        return self.beside(self.size)

    def beside(self, size: float) -> float:
        """`worst` relative to this size where it is less: what a point of huge cost leaves is little of that alone."""
        times = max(self.size / size, 1.0)
        parts = [*(times * part for part in self._resolved), LIMIT * self.violation / VIOLATION]
        return float(np.where(np.isnan(parts), np.inf, parts).max())

    def hold(self, limit: float) -> bool:
        """Whether all are small: those of the cost below `limit`, the violation below VIOLATION."""
        return all(part <= limit for part in self._resolved) and self.violation <= VIOLATION

    def hold_of_changes(self, limit: float) -> bool:
        """Whether they are where the variables' changes of the cost are its size, if these are more (`VANISHING`)."""
        found = self.of_changes()
        parts = (found.slope, found.complementarity, found.infeasibility)
        return all(part <= limit for part in parts) and self.violation <= VIOLATION

    def of_changes(self) -> Residuals:
        """The same relative to what the variables change of the cost, where that is its size."""
        size = max(self.size, VANISHING * self.varied)
        slope, apart, missed = (
            part * self.size / size for part in (self.slope, self.complementarity, self.infeasibility)
        )
        return replace(self, slope=slope, complementarity=apart, infeasibility=missed, size=size, varied=0.0)

    def settle(self, limit: float) -> bool:
        """Whether no further run is worth it: all small relative to the cost, slopes so that their square is."""
        slope, *others = self._resolved
        gentle = slope <= max(STEEP, limit) and all(part <= limit for part in others)
        return self.hold(limit) or (gentle and self.hold_of_changes(limit))

    @property
    def left(self) -> float:
        """The complementarity of a point that does not settle; 0 where that is roundoff of what changes the cost."""
        return self.complementarity if self.size > ROUNDED * self.varied else 0.0

    @property
    def too_steep(self) -> bool:
        """Whether much of the cost may still be had along the slopes."""
        return self._resolved[0] > TOO_STEEP and self.size > NOTHING

    @property
    def _resolved(self) -> tuple[float, float, float]:
        """The changes of the cost, those by slopes relative to what these are known to, where that is more."""
        rounded = max(1.0, ROUNDED * self.varied / self.size)
        return self.slope / rounded, self.complementarity, self.infeasibility / rounded

    def __str__(self) -> str:
        """The residuals in words, for a message."""
        return (
            f"slope {self.slope:.1e}, complementarity {self.complementarity:.1e}, infeasibility "
            f"{self.infeasibility:.1e} (changes of the cost to first order, relative to it), largest violation "
            f"{self.violation:.1e}"
        )


def onto_bounds(values: Array, lower: Array, upper: Array, margins: Array) -> Array:
    """Values, at a bound where they pass it by no more than these margins.

    Args:
        values: what is bounded.
        lower: bounds, -inf where there is none.
        upper: bounds, inf where there is none.
        margins: of the lower and of the upper bounds, (2, size).
    """
    held = np.clip(values, lower, upper)
    return np.where((values >= lower - margins[0]) & (values <= upper + margins[1]), held, values)


def passing(lower: Array, upper: Array, told: Array, otherwise: Array) -> Array:
    """By how much values may pass their bounds where a solution that keeps them does: a share of their size.

    That size is the smallest of what tells it: what is told, the width between both bounds, the bound that is passed.
    The bound may be far larger than all that ever changes: a distance from the centre of the Earth, a date.

    Args:
        lower: bounds, -inf where there is none.
        upper: bounds, inf where there is none.
        told: sizes, a row each, for lower and for upper bounds, (2, rows, size); 0: tells nothing.
        otherwise: sizes where all these tell nothing, (size,); 0: 1.

    Returns:
        Margins of the lower and of the upper bounds, (2, size).
    """
    limits = np.abs(np.array([lower, upper]))
    width = np.broadcast_to(upper - lower, limits.shape)
    sizes = np.concatenate([told, limits[:, None], width[:, None]], axis=1)
    smallest = np.where(np.isfinite(sizes) & (sizes > 0), sizes, np.inf).min(axis=1)
    return BETWEEN_NODES * np.where(np.isfinite(smallest), smallest, np.where(otherwise > 0, otherwise, 1.0))


def complementary(multipliers: Array, values: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Multipliers of bounds that exist, and how far from their bound the values are.

    Args:
        multipliers: positive at upper bounds, negative at lower ones.
        values: what is bounded.
        lower: bounds, -inf where there is none.
        upper: bounds, inf where there is none.

    Returns:
        The multipliers, zero where there is no bound of their side; |distance| from that bound, zero without one.
    """
    bound = np.where(multipliers > 0, upper, lower)
    there = np.isfinite(bound) & (multipliers != 0)
    distance = np.abs(values - np.where(there, bound, values))
    return np.where(there, multipliers, 0.0), distance
