"""What the step control sees of the unknowns, of one problem or of several phases: points, slopes, measures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.residuals import VANISHING, Residuals
from covocp.solvers.gradient.descent import Step, solve_gram, solve_step
from covocp.solvers.gradient.memory import learnt
from covocp.solvers.gradient.penalty import Group, Indices, Weights, violation
from covocp.solvers.gradient.records import Iterate, Linear, Measures

# Relative change of T and of free initial values by which their curvature is measured, and of the controls in a probe.
DIFFERENCE = 1e-4
SMALLEST_EXTRA = 1e-3
# Controls below this share of their scale at the start are zero.
ZERO = 1e-12
# Terms of H_u that change the cost by less than this share where a control moves by its scale are roundoff.
FAINT = 1e-8


class Unknowns(ABC):
    """The unknowns with their scales and bounds.

    groups, weights: inequalities met by penalties, and the weights of these. unit: typical magnitudes of the entries of
    a point. lower, upper: their bounds. fixed_metric: diagonal of the metric of the stop test, int |du/s|^2 dt.
    miss_scale: magnitudes of the terminal conditions. extra: weights of T and of the free initial values in the metric
    of the step, b.
    """

    groups: tuple[Group, ...]
    weights: Weights
    unit: Array
    lower: Array
    upper: Array
    fixed_metric: Array
    miss_scale: Array
    extra: Array

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Of the terminal conditions with influence functions."""

    @property
    @abstractmethod
    def others(self) -> Indices:
        """Entries of a point that are no control values: durations and free initial values."""

    @property
    @abstractmethod
    def durations(self) -> Indices:
        """Entries of a point that are durations."""

    @abstractmethod
    def at(self, point: Array) -> Iterate:
        """Forward sweep and penalties at a point."""

    @abstractmethod
    def linearise(self, iterate: Iterate) -> Linear:
        """Backward sweep at an iterate."""

    @abstractmethod
    def with_weights(self, weights: Weights) -> Unknowns:
        """The same with other penalties."""

    @abstractmethod
    def judged_at(self, iterate: Iterate) -> Unknowns:
        """The same with the magnitudes of the inequalities there, where those are smaller."""

    @abstractmethod
    def with_extra(self, extra: Array) -> Unknowns:
        """The same with other weights of what is no control value."""

    @abstractmethod
    def cost_size(self, iterate: Iterate) -> float:
        """Sum of the absolute terms of the cost."""

    @abstractmethod
    def sizes_along(self, iterate: Iterate, linear: Linear, ell: Array) -> Array:
        """Sizes of the slopes by the control values from those of H_u at the nodes."""

    @abstractmethod
    def reach(self, iterate: Iterate, linear: Linear) -> Array:
        """What changes of z at the end by its largest values along the run make of each terminal condition."""

    @abstractmethod
    def reached_units(self, iterate: Iterate, linear: Linear, measures: Measures) -> tuple[Array, float]:
        """Magnitudes of the entries of a point there, and the change of the cost by those of the controls."""

    @abstractmethod
    def metric(self, iterate: Iterate, linear: Linear, ell: Array, weight: Expr) -> Any:
        """Matrix of int du' W du dt + b dT^2 + ...: W = H_uu made positive definite, or the given one."""

    @abstractmethod
    def room(self, iterate: Iterate) -> tuple[Array, Array]:
        """Bounds of a step: to the bounds of the point; T changes by no more than a share of itself."""

    @abstractmethod
    def chord(self, iterate: Iterate, linear: Linear, active: Array | None) -> Step:
        """The change to the control that minimises the Hamiltonian along the present x, E, p, P [4.2-10]."""

    @property
    def conditions(self) -> int:
        """Number of terminal conditions with influence functions."""
        return len(self.names)

    @property
    def is_control(self) -> NDArray[np.bool_]:
        """Which entries of a point are control values."""
        result = np.ones(self.unit.size, dtype=bool)
        result[self.others] = False
        return result

    def violation(self, iterate: Iterate) -> Array:
        """Largest relative violation of each group of inequalities."""
        return violation(iterate.penalty, self.weights)

    @np.errstate(over="ignore", invalid="ignore")  # what is too large to be squared is not small
    def measure(self, iterate: Iterate, linear: Linear) -> Measures:
        """Norms of the stop test, with the multiplier that makes the first of them least."""
        inverse = 1.0 / self.fixed_metric
        at_lower, at_upper = iterate.point <= self.lower, iterate.point >= self.upper
        active = np.zeros(iterate.point.size, dtype=bool)
        ell = np.zeros(self.conditions)
        for _ in range(10):
            weight = np.where(active, 0.0, inverse)
            ell = solve_gram((linear.rows * weight) @ linear.rows.T, -(linear.rows * weight) @ linear.slope)
            residual = linear.lagrangian(ell)
            new = (at_lower & (residual > 0)) | (at_upper & (residual < 0))
            if (new == active).all():
                break
            active = new
        residual = linear.lagrangian(ell)
        left = np.where(active, 0.0, residual)
        chosen = self.is_control
        sizes = (linear.sizes + np.abs(linear.rows).T @ np.abs(ell))[chosen]
        sizes = np.maximum(sizes, self.sizes_along(iterate, linear, ell))
        norm = np.sqrt(np.sum(inverse[chosen] * left[chosen] ** 2))
        size = np.sqrt(np.sum(inverse[chosen] * sizes**2))
        # a cost that is zero at its best is no size of its slopes
        bent = float(self.extra @ self.unit[self.others] ** 2)
        total = max(self.cost_size(iterate), VANISHING * bent, np.finfo(float).tiny)
        size = max(size, FAINT * total / np.sqrt(iterate.run.duration))  # where the best control is none
        slope = float(norm / size) if size > 0 else 0.0
        extra = np.abs(left[~chosen] * self.unit[~chosen]).max(initial=0.0) / total
        reach = self.reach(iterate, linear)
        scale = np.where(reach > 0, np.minimum(reach, self.miss_scale), self.miss_scale)
        by_time = residual[self.durations]
        return Measures(
            ell=ell,
            residual=residual,
            active=active,
            slope=float(np.maximum(slope, extra)),
            miss=float((np.abs(iterate.run.miss) / scale).max(initial=0.0)),
            transversality=float(by_time[np.argmax(np.abs(by_time))]) if by_time.size else 0.0,
        )

    def reached(self, iterate: Iterate, linear: Linear, measures: Measures) -> Residuals:
        """What is left, by changes of the controls and the other unknowns by their own magnitudes at this point."""
        unit, change = self.reached_units(iterate, linear, measures)
        slope = float(np.abs(np.where(measures.active, 0.0, measures.residual)) @ unit)
        missed, rest = float(np.abs(measures.ell) @ np.abs(iterate.run.miss)), 0.0
        penalty = iterate.penalty
        for multipliers, excess, room in zip(penalty.multipliers, penalty.excess, penalty.room, strict=True):
            missed += float(np.sum(np.abs(multipliers * excess)))
            rest += float(np.sum(np.abs(multipliers * room)))
        size = max(self.cost_size(iterate), VANISHING * change, float(np.finfo(float).tiny))
        return Residuals(
            slope=slope / size,
            complementarity=rest / size,
            infeasibility=missed / size,
            violation=measures.miss,
        )

    def with_extra_weights(self, linear: Linear, iterate: Iterate, ell: Array) -> Unknowns:
        """b of T and of the free initial values from the curvature of the Lagrangian by each of them."""
        extra = self.extra.copy()
        for i, at in enumerate(self.others.tolist()):
            change = DIFFERENCE * self.unit[at] * (1.0 if iterate.point[at] < self.upper[at] else -1.0)
            moved = iterate.point.copy()
            moved[at] += change
            other = self.at(moved)
            if not other.run.finite:
                continue
            turned = (self.linearise(other).lagrangian(ell) - linear.lagrangian(ell))[at] / change
            extra[i] = max(abs(float(turned)), SMALLEST_EXTRA * extra[i]) if np.isfinite(turned) else extra[i]
        return self.with_extra(extra)

    def probe(self, iterate: Iterate, linear: Linear, metric: Expr) -> float:
        """Curvature of the Lagrangian along the step that the metric would take, in units of the metric."""
        lower, upper = self.room(iterate)
        still = np.zeros(self.conditions)
        step = solve_step(learnt(metric, ()), linear.slope, linear.rows, still, lower, upper)
        size = (np.abs(step.change) / self.unit).max(initial=0.0)
        if size == 0:
            return 1.0
        change = min(1.0, DIFFERENCE / size) * step.change
        other = self.at(iterate.point + change)
        if not other.run.finite:
            return 1.0
        turned = self.linearise(other).lagrangian(step.ell) - linear.lagrangian(step.ell)
        along, squared = abs(float(turned @ change)), float(change @ (metric @ change))
        value = along / squared if squared > 0 else 1.0  # a step so small that its square is nothing
        return value if np.isfinite(value) and value > 0 else 1.0


def of_part(measures: Measures, ell: slice, span: slice) -> Measures:
    """What is measured of a part of the unknowns."""
    return replace(measures, ell=measures.ell[ell], residual=measures.residual[span], active=measures.active[span])
