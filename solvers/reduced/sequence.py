"""A sequence of quadratic subproblems in the chosen variables, with a Hessian that is learnt and kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.solvers.reduced.condensed import (
    Bounds,
    Layout,
    Slopes,
    Subproblem,
    all_multipliers,
    condensed,
    moved,
    reduced,
    weighed,
)
from covocp.solvers.reduced.curvature import Curvature, learnt
from covocp.solvers.reduced.statuses import Status
from covocp.solvers.reduced.subproblem import Quadratic, Step, eased, solved

# States at the end, in their units, that grow by more than this with a control or a gap have lost their digits.
LARGEST_GROWTH = 1e8
# Decrease that a step must bring, as a share of what its slope promises.
SUFFICIENT = 1e-4
# Share of the length below which a step is given up.
SHORTEST = 1e-10
# Promised relative gain below which the cost may no longer show it, and the share of a step that is tried then.
AT_ROUNDOFF = 1e-11
NEARLY_WHOLE = 0.05
# Share of what the controls spend that a cost must have to count as one.
SPENT = 0.1
# Share of what the controls change of the cost in their units that is none: where all of them end at zero.
NONE_SPENT = 1e-12
# Weights of violations above their multipliers.
ABOVE = 1.5
# Relative changes of the cost below this are roundoff.
ROUNDOFF = 1e-13
# Largest step of a scaled variable, in multiples of its unit or of itself.
LONGEST = 10.0
# What a step closes of gaps, as a multiple of what it moves, above which it tells nothing of the curvature.
CLOSING = 1.0
# Largest violation at the end, in the units of the rows.
FEASIBLE = 1e-8
# Price of the violations that an eased subproblem leaves, in multiples of what they cost by their multipliers.
PRICE = 10.0
# Share of the violations left by the best step at which constraints contradict, to first order.
STUCK = 1.0 - 1e-6


@dataclass(frozen=True, kw_only=True)
class Place:
    """A point with cost, slope, rows and their Jacobian."""

    w: Array
    cost: float
    slope: Array
    g: Array
    jacobian: Slopes

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Memory:
    """What a run leaves to the next: the Hessian, and what was active."""

    curvature: Curvature
    active_rows: Array
    active_bounds: Array

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Ended:
    """Where a run ended: point, multipliers, why, after how many iterations."""

    place: Place
    lam_x: Array
    lam_g: Array
    status: Status
    iterations: int
    memory: Memory | None

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Functions:
    """Of a program with given parameters: everything at a point, and cost and rows alone; None where not finite."""

    full: Callable[[Array], Place | None]
    value: Callable[[Array], tuple[float, Array] | None]

    __repr__ = short_repr


class Sequence:
    """One run: a quadratic subproblem, a step, what the step tells of the curvature, and so on."""

    def __init__(
        self,
        functions: Functions,
        layout: Layout,
        bounds: Bounds,
        *,
        first: Callable[[Place], Curvature],
        tolerance: float,
        most: int,
        watch: Callable[[float, Array, Array, Array, Array], bool],
    ) -> None:
        """Keep what the run needs.

        Args:
            functions: of the program.
            layout: its variables.
            bounds: of variables and rows.
            first: a first Hessian at a point.
            tolerance: relative, of the root of what can still be gained.
            most: iterations.
            watch: told cost, rows, variables and multipliers of each iteration; whether to stop.
        """
        self._of, self._layout, self._bounds = functions, layout, bounds
        self._first, self._tolerance, self._most, self._watch = first, tolerance, most, watch
        self.concave = False  # whether the last step that told of the curvature showed a negative one

    def run(self, start: Place, kept: Memory | None) -> Ended:
        """From a start, with what a run before left."""
        place, iterations = start, 0
        rows = self._condensed(place)
        if not float(np.abs(rows.follows).max(initial=0.0)) < LARGEST_GROWTH:
            return self._ended(place, rows, None, Status.GROWS, 0, None)
        curvature = self._first(place) if kept is None else kept.curvature
        fresh = kept is None
        active = (np.zeros(rows.places.size), np.zeros(rows.slope.size))
        if kept is not None and kept.active_rows.size == rows.places.size:
            active = (kept.active_rows, kept.active_bounds)
        weights = np.zeros(place.g.size)
        while True:
            found = self._step(rows, curvature, active, weights)
            if found is None:
                if fresh:
                    return self._ended(place, rows, None, Status.NO_PROGRESS, iterations, None)
                curvature, fresh = self._first(place), True
                continue
            step, left = found
            lam_x, lam_g = self._multipliers(place, rows, step)
            active = (step.active_rows, step.active_bounds)
            memory = Memory(curvature=curvature, active_rows=active[0], active_bounds=active[1])
            stop = self._watch(place.cost, place.g, place.w, lam_x, lam_g)
            status = self._met(place, step, curvature, left)
            if status is None and stop:
                status = Status.STOPPED
            if status is None and iterations >= self._most:
                status = Status.ITERATIONS
            if status is not None:
                return self._ended(place, rows, (lam_x, lam_g), status, iterations, memory)
            weights = np.maximum(ABOVE * np.abs(lam_g), 0.5 * (weights + ABOVE * np.abs(lam_g)))
            following = self._searched(place, rows, step, curvature, weights, left)
            if following is None:
                near = self._gain(place, step, curvature) <= AT_ROUNDOFF
                if near and float(self._violations(place.g).max(initial=0.0)) <= FEASIBLE:
                    return self._ended(place, rows, (lam_x, lam_g), Status.SOLVED, iterations, memory)
                if not fresh:
                    curvature, fresh = self._first(place), True
                    continue
                return self._ended(place, rows, (lam_x, lam_g), Status.NO_PROGRESS, iterations, None)
            more = self._learnt(curvature, place, following, rows, lam_g)
            place, iterations = following, iterations + 1
            curvature, fresh = (self._first(place), True) if more is None else (more, False)
            rows = self._condensed(place)

    def _condensed(self, place: Place) -> Subproblem:
        """The problem linearised at a point."""
        return condensed(self._layout, self._bounds, place.w, place.slope, place.g, place.jacobian)

    def _step(
        self, rows: Subproblem, curvature: Curvature, active: tuple[Array, Array], weights: Array
    ) -> tuple[Step, float] | None:
        """The step of a subproblem, and which share of the violations it leaves."""
        problem = Quadratic(
            curvature=curvature.matrix,
            inverse=curvature.inverse,
            slope=rows.slope,
            rows=rows.rows,
            lower=rows.lower,
            upper=rows.upper,
            low=np.minimum(rows.low, 0.0),
            high=np.maximum(rows.high, 0.0),
        )
        step = solved(problem, *active)
        if step is not None:
            return step, 0.0
        size = float(np.abs(rows.slope) @ np.ones(rows.slope.size)) + float(weights.max(initial=0.0))
        return eased(problem, *active, PRICE * max(size, 1e-8))

    def _multipliers(self, place: Place, rows: Subproblem, step: Step) -> tuple[Array, Array]:
        """Multipliers of all bounds and rows from those of a subproblem."""
        return all_multipliers(self._layout, rows, place.slope, place.jacobian, step.of_rows, step.of_bounds)

    def _violations(self, g: Array) -> Array:
        """By how much the rows pass their limits."""
        return np.asarray(np.maximum(np.maximum(self._bounds.lbg - g, g - self._bounds.ubg), 0.0))

    def _met(self, place: Place, step: Step, curvature: Curvature, left: float) -> Status | None:
        """How the run ends here, if it does."""
        violation = float(self._violations(place.g).max(initial=0.0))
        if left > STUCK and violation > FEASIBLE:
            return Status.INFEASIBLE
        if violation <= FEASIBLE and np.sqrt(self._gain(place, step, curvature)) <= self._tolerance:
            return Status.SOLVED
        return None

    def _gain(self, place: Place, step: Step, curvature: Curvature) -> float:
        """What the subproblem promises, relative to the cost or to what controls spend of it."""
        z = place.w[self._layout.chosen]
        whole = NONE_SPENT * float(np.trace(curvature.matrix))
        size = max(abs(place.cost), SPENT * float(z @ curvature.matrix @ z), whole, float(np.finfo(float).tiny))
        return max(float(step.change @ curvature.matrix @ step.change), 0.0) / size

    def _searched(
        self, place: Place, rows: Subproblem, step: Step, curvature: Curvature, weights: Array, left: float
    ) -> Place | None:
        """The next point: the longest share of the step that lowers cost and weighed violations enough."""
        change = moved(self._layout, rows, step.change, place.w.size)
        longest = float((np.abs(change) / np.maximum(1.0, np.abs(place.w))).max(initial=0.0))
        share = min(1.0, LONGEST / longest) if longest > 0 else 1.0
        missed = float(weights @ self._violations(place.g))
        merit, slope = place.cost + missed, float(place.slope @ change) - (1.0 - left) * missed
        slope = min(slope, -0.5 * float(step.change @ curvature.matrix @ step.change))
        room = ROUNDOFF * (abs(place.cost) + missed)
        corrected = False
        shortest = SHORTEST if self._gain(place, step, curvature) > AT_ROUNDOFF else NEARLY_WHOLE
        while share > shortest:
            w = self._inside(place.w + share * change)
            at = self._of.full(w) if share == 1.0 else None
            values = (at.cost, at.g) if at is not None else (self._of.value(w) if share < 1.0 else None)
            if values is not None:
                now = values[0] + float(weights @ self._violations(values[1]))
                if now <= merit + SUFFICIENT * share * slope + room:
                    return at if at is not None else self._of.full(w)
                if share == 1.0 and not corrected:
                    corrected = True
                    second = self._corrected(place, rows, step, change, values[1], curvature)
                    if second is not None:
                        at = self._of.full(second)
                        if at is not None:
                            again = at.cost + float(weights @ self._violations(at.g))
                            if again <= merit + SUFFICIENT * slope + room:
                                return at
                bend = now - merit - slope * share
                best = -slope * share**2 / (2.0 * bend) if bend > 0 else 0.5 * share
                share = min(max(best, 0.1 * share), 0.5 * share)
            else:
                share *= 0.1
        return None

    def _corrected(
        self, place: Place, rows: Subproblem, step: Step, change: Array, g: Array, curvature: Curvature
    ) -> Array | None:
        """The whole step with what the rows bend corrected (second order)."""
        whole = replace(place, g=g - self._rows_along(place, change))
        again = self._condensed(whole)
        found = self._step(again, curvature, (step.active_rows, step.active_bounds), np.zeros(0))
        if found is None or found[1] > 0.0:
            return None
        return self._inside(place.w + moved(self._layout, again, found[0].change, place.w.size))

    def _inside(self, w: Array) -> Array:
        """A point within the bounds: roundoff alone takes it out of them."""
        return np.asarray(np.clip(w, self._bounds.lbx, self._bounds.ubx))

    def _learnt(
        self, curvature: Curvature, place: Place, following: Place, rows: Subproblem, lam_g: Array
    ) -> Curvature | None:
        """What a step tells of the Hessian: nothing where it closes gaps more than it moves what is chosen.

        None where the Hessian is lost.

        The slope then changes by the gaps: a step of 1e-7 beside a start that moved by 1e-4 shows curvatures of 1e6.
        """
        whole = following.w - place.w
        change = whole[self._layout.chosen]
        moved_by = (rows.follows[:, :, :-1] @ change).ravel()
        closed = whole[self._layout.given] - moved_by
        if np.linalg.norm(closed) > CLOSING * np.hypot(np.linalg.norm(change), np.linalg.norm(moved_by)):
            return curvature
        difference = self._difference(place, following, rows, lam_g)
        self.concave = float(change @ difference) < 0.0
        return learnt(curvature, change, difference)

    def _difference(self, place: Place, following: Place, rows: Subproblem, lam_g: Array) -> Array:
        """Change of the slope of the Lagrangian, in the chosen variables."""
        of, size = self._layout, place.w.size
        change = following.slope - place.slope
        change += weighed(of, following.jacobian, lam_g, size) - weighed(of, place.jacobian, lam_g, size)
        return reduced(of, rows, change)

    def _rows_along(self, place: Place, change: Array) -> Array:
        """Change of the rows along a change of all variables, to first order."""
        of, slopes = self._layout, place.jacobian
        z, x = change[of.chosen], change[of.given].reshape(of.segments, -1)
        gaps = slopes.continuity @ z - x
        gaps[1:] += np.einsum("kij,kj->ki", slopes.chain, x[:-1])
        return np.concatenate([gaps.ravel(), slopes.others @ z + slopes.others_by_state @ x.ravel()])

    def _ended(
        self,
        place: Place,
        rows: Subproblem,
        multipliers: tuple[Array, Array] | None,
        status: Status,
        iterations: int,
        memory: Memory | None,
    ) -> Ended:
        """The end of a run; without a subproblem that was solved its multipliers are zero, but for the costates."""
        if multipliers is None:
            zero = np.zeros(rows.places.size)
            multipliers = all_multipliers(
                self._layout, rows, place.slope, place.jacobian, zero, np.zeros(rows.slope.size)
            )
        return Ended(
            place=place,
            lam_x=multipliers[0],
            lam_g=multipliers[1],
            status=status,
            iterations=iterations,
            memory=memory,
        )
