"""Step control of the gradient method: W by predicted against actual changes, and the passes of the penalties.

G. T. Schmidt, Sc.D. thesis, M.I.T. 1971, [4.3]: W is raised where cost and terminal conditions do not change as
predicted; see `covocp.solvers.gradient` for what is beyond the source.
"""

from __future__ import annotations

from dataclasses import field, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.residuals import LIMIT, Residuals
from covocp.base.short_repr import short_repr
from covocp.solvers.gradient.descent import Step, solve_gram, solve_step, solve_tangent, unreachable
from covocp.solvers.gradient.memory import Metric, Pair, damped, learnt
from covocp.solvers.gradient.penalty import next_weights
from covocp.solvers.gradient.records import Iterate, Linear, Measures
from covocp.solvers.gradient.statuses import Status
from covocp.solvers.gradient.unknowns import ZERO, Unknowns

# On the slopes, unless the user gives another.
TOLERANCE = 1e-6
Variant = Literal["gradient", "chord"]
# The share of the predicted decrease that must come true (Armijo), the number of past values that count as the largest.
SUFFICIENT = 1e-4
MEMORY = 8
RAISE = 4.0
TRIALS = 15
# Changes of the cost below this share of it are lost in the integration errors: there the merit is not asked.
COST_ACCURACY = 1e-7
SMALLEST_WEIGHT, LARGEST_WEIGHT = 1e-4, 1e8
# Past steps whose change of slope the metric remembers.
PAIRS = 20
# The multiplier's weight in the merit.
MERIT_FACTOR = 2.0
# What the bounds may leave of the change of the miss that a step owes: a share of the miss, or this in its scale.
UNREACHED, UNREACHED_ANYWAY = 0.5, 1e-3
REACHING_RAISE, REACHING_TRIALS = 16.0, 6
# Terminal conditions are met better than inequalities: every step corrects them.
TERMINAL_SHARE = 1e-2
LARGEST_PASSES = 30
# Iterations in which the miss must fall by a tenth while it is above its tolerance.
PATIENCE = 100
# A fixed W that is too small lets the cost grow; above this multiple of the first cost there is no way back.
DIVERGED = 1e8
FIRST_PASS_TOLERANCE = 1e-2
PASS_FACTOR = 0.1


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Options of the method; see `prepare`."""

    variant: Variant
    weight: Any
    weight_factor: float
    fraction: float
    tolerance: float
    violation_tolerance: float
    max_iterations: int

    __repr__ = short_repr

    @property
    def adaptive(self) -> bool:
        """Whether w follows predicted and actual changes."""
        return isinstance(self.weight, str) and self.weight == "adaptive"


@dataclass(kw_only=True)
class _Control:
    """What the step control remembers: w, its increase, d, past steps, merit weights, past costs and misses."""

    weight: float
    fraction: float
    merit: Array
    raised: float = 1.0
    pairs: list[Pair] = field(default_factory=list)
    past: list[tuple[float, Array]] = field(default_factory=list)
    iterations: int = 0
    nearest: tuple[float, int] = (np.inf, 0)
    history: list[dict[str, float]] = field(default_factory=list)

    __repr__ = short_repr


class End(NamedTuple):
    """The last iterate, its measures, how the run ended."""

    iterate: Iterate
    measures: Measures
    status: Status


class Search:
    """The iterations: passes of the penalties outside, gradient steps inside."""

    def __init__(self, space: Unknowns, settings: Settings, progress: Progress) -> None:
        self.space, self.settings, self.progress = space, settings, progress
        self.control = _Control(weight=1.0, fraction=settings.fraction, merit=np.zeros(space.conditions))
        self.passes = 0
        self.reached: Residuals | None = None

    def run(self, current: Iterate) -> End:
        """All passes."""
        space, settings = self.space, self.settings
        tolerance = settings.tolerance if not space.groups else max(settings.tolerance, FIRST_PASS_TOLERANCE)
        before = np.full(len(space.groups), np.inf)
        limit = LIMIT * max(1.0, settings.tolerance / TOLERANCE)
        while True:
            end = self._pass(current, tolerance)
            current = end.iterate
            self.passes += 1
            space = self.space = space.judged_at(current)
            worst = space.violation(current)
            if end.status is not Status.SOLVED or not space.groups:
                return end
            tight = tolerance <= settings.tolerance and worst.max(initial=0.0) <= settings.violation_tolerance
            if tight and self.reached is not None and self.reached.hold(limit):
                return end
            if self.passes >= LARGEST_PASSES:
                return end._replace(status=Status.VIOLATED)
            factor = PASS_FACTOR if worst.any() else 0.0
            tolerance = max(settings.tolerance, factor * tolerance)
            space = self.space = space.with_weights(next_weights(current.penalty, space.weights, before, worst))
            before = worst
            current = space.at(current.point)
            self.control.past.clear()
            self.control.pairs.clear()

    def _pass(self, current: Iterate, tolerance: float) -> End:
        """Gradient steps for the present penalties."""
        space, settings, control = self.space, self.settings, self.control
        linear = space.linearise(current)
        if not linear.finite:
            return End(current, Measures.unknown(linear), Status.NO_NUMBER)
        measures = space.measure(current, linear)
        ell = measures.ell
        self._check_reachable(current, linear)
        if not control.past and not control.iterations:
            space = self.space = space.with_extra_weights(linear, current, ell)
            self._probe(current, linear, ell)
            control.merit = space.cost_size(current) / space.miss_scale
        active: Array | None = None
        while True:
            self._record(current, measures)
            if self._arrived(current, linear, measures, tolerance):
                return End(current, measures, Status.SOLVED)
            if self.progress.stop:
                return End(current, measures, Status.STOPPED)
            hopeless = self._hopeless(measures)
            if hopeless:
                return End(current, measures, hopeless)
            base = space.metric(current, linear, ell, settings.weight)
            metric = learnt(control.weight * base, control.pairs)
            trial = self._try(current, linear, metric, active)
            if isinstance(trial, Status):
                return End(current, measures, trial)
            following, step = self._cleared(trial[0]), trial[1]
            after = space.linearise(following)
            if not after.finite:
                return End(current, measures, Status.NO_NUMBER)
            self._learn(following.point - current.point, linear, after, step, metric, base)
            current, linear, ell, active = following, after, step.ell, step.active
            measures = space.measure(current, linear)
            control.iterations += 1

    def _cleared(self, iterate: Iterate) -> Iterate:
        """The iterate with controls of zero where all of them are roundoff of their scales, if that costs no more.

        Where the best control is none all terms of H_u fall with it, and none becomes small beside the others.
        """
        space, point = self.space, iterate.point
        own = space.is_control
        roundoff = np.abs(point[own]) <= ZERO * space.unit[own]
        possible = (space.lower[own] <= 0) & (space.upper[own] >= 0)
        if not point[own].any() or not (roundoff & possible).all():
            return iterate
        without = space.at(np.where(own, 0.0, point))
        merits = [each.cost + self.control.merit @ np.abs(each.run.miss) for each in (without, iterate)]
        return without if without.run.finite and merits[0] <= merits[1] else iterate

    def _arrived(self, current: Iterate, linear: Linear, measures: Measures, tolerance: float) -> bool:
        """The stop test of a pass: in the scales of the start, and in those of the point that was reached.

        What inequalities still leave is for the passes.
        """
        if measures.slope > tolerance or measures.miss > TERMINAL_SHARE * self.settings.violation_tolerance:
            return False
        self.reached = self.space.reached(current, linear, measures)
        left = replace(self.reached, complementarity=0.0, infeasibility=0.0) if self.space.groups else self.reached
        return left.hold(LIMIT * max(1.0, tolerance / TOLERANCE))

    def _hopeless(self, measures: Measures) -> Status | None:
        """Why to give up, if so."""
        control, settings = self.control, self.settings
        if control.iterations >= settings.max_iterations:
            return Status.ITERATIONS
        if measures.miss <= TERMINAL_SHARE * settings.violation_tolerance or measures.miss < 0.9 * control.nearest[0]:
            control.nearest = (measures.miss, control.iterations)
        if control.iterations - control.nearest[1] > PATIENCE:
            return Status.UNMET if settings.adaptive else Status.UNMET_BY_FIXED_WEIGHT
        return None

    def _check_reachable(self, current: Iterate, linear: Linear) -> None:
        """Terminal conditions that nothing changes (D is singular) and that are not met.

        Raises:
            ProblemError: names them.
        """
        space = self.space
        gram = (linear.rows / space.fixed_metric) @ linear.rows.T
        hopeless = np.abs(unreachable(gram, current.run.miss)) / space.miss_scale
        names = [n for n, v in zip(space.names, hopeless, strict=True) if v > 1e-6]
        if names:
            raise ProblemError(
                "Terminal conditions cannot be met: the controls have no influence on " + ", ".join(names) + ".",
                expected="D = int H_u H_u' dt invertible: influence functions of the terminal conditions that are "
                "linearly independent",
                received="a miss of "
                + ", ".join(f"{m:.4g} ({n})" for n, m in zip(space.names, current.run.miss, strict=True)),
                remedy="free one of these final values, or start where the controls act on them",
            )

    def _probe(self, current: Iterate, linear: Linear, ell: Array) -> None:
        """The first w: the curvature along the step that w = 1 would take."""
        control, settings = self.control, self.settings
        control.weight = settings.weight_factor
        if not settings.adaptive:
            return
        metric = self.space.metric(current, linear, ell, settings.weight)
        value = self.space.probe(current, linear, metric)
        control.weight = float(np.clip(settings.weight_factor * value, SMALLEST_WEIGHT, LARGEST_WEIGHT))

    def _try(
        self, current: Iterate, linear: Linear, metric: Metric, active: Array | None
    ) -> tuple[Iterate, Step] | Status:
        """A step that changes cost and miss about as predicted; raises w and lowers d until there is one."""
        space, control, miss = self.space, self.control, current.run.miss
        adaptive = self.settings.adaptive
        control.past = [*control.past[1 - MEMORY :], (current.cost, miss)]
        for _ in range(TRIALS if adaptive else 1):
            step = self._reaching_step(current, linear, metric, active)
            following = space.at(current.point + step.change)
            if not adaptive:
                kept = following.run.finite and abs(following.cost) <= DIVERGED * (
                    1.0 + abs(self.control.history[0]["cost"])
                )
                return (following, step) if kept else Status.DIVERGING
            if following.run.finite:
                control.merit = np.maximum(control.merit, MERIT_FACTOR * np.abs(step.ell))
                expected = miss + linear.rows @ step.change
                gain = linear.slope @ step.change + control.merit @ (np.abs(expected) - np.abs(miss))
                largest = max(cost + control.merit @ np.abs(z) for cost, z in control.past)
                now = following.cost + control.merit @ np.abs(following.run.miss)
                small = COST_ACCURACY * space.cost_size(current)
                limit = largest + SUFFICIENT * min(gain, 0.0) + (small if abs(gain) <= 10 * small else 0.0)
                off = np.abs(following.run.miss - expected) / space.miss_scale
                agrees = not off.size or off.max() <= max(0.5 * (np.abs(miss) / space.miss_scale).max(), 1e-3)
                if now <= limit:
                    control.fraction = min(self.settings.fraction, 2 * control.fraction) if agrees else control.fraction
                    return following, step
                if not agrees:
                    control.fraction /= 2
            else:
                control.fraction /= 2
            control.raised = min(RAISE * control.raised, LARGEST_WEIGHT)
        return Status.NO_DECREASE

    def _reaching_step(self, current: Iterate, linear: Linear, metric: Metric, active: Array | None) -> Step:
        """A step that the bounds leave most of what it owes the terminal conditions, with w raised as needed.

        Where the cost pulls the controls and T onto their bounds nothing is left for the conditions, and the merit
        would pay for the miss by the cost; the larger w, the less the cost pulls. Where no w helps, the bounds forbid
        it.
        """
        control, settings = self.control, self.settings
        step = self._step(current, linear, metric, active)
        if not settings.adaptive or settings.variant == "chord":
            return step
        first, raised = step, control.raised
        for _ in range(REACHING_TRIALS):
            if self._reaches(current, linear, step):
                return step
            control.raised = min(REACHING_RAISE * control.raised, LARGEST_WEIGHT)
            step = self._step(current, linear, metric, active)
        control.raised = raised
        return first

    def _reaches(self, current: Iterate, linear: Linear, step: Step) -> bool:
        """Whether a step changes the miss, to first order, about as it should."""
        scale, miss = self.space.miss_scale, current.run.miss
        left = np.abs(linear.rows @ step.change + self.control.fraction * miss) / scale
        return not left.size or bool(left.max() <= max(UNREACHED * (np.abs(miss) / scale).max(), UNREACHED_ANYWAY))

    def _step(self, current: Iterate, linear: Linear, metric: Metric, active: Array | None) -> Step:
        """Steps 5 and 6 of 4.2, or the chord step."""
        control, space = self.control, self.space
        lower, upper = space.room(current)
        if self.settings.variant == "chord":
            share = min(1.0, 1.0 / (control.weight * control.raised))
            step = space.chord(current, linear, active)
            return replace(step, change=share * step.change)
        target = -control.fraction * current.run.miss
        return solve_step(control.raised * metric, linear.slope, linear.rows, target, lower, upper, active)

    def _learn(self, change: Array, before: Linear, after: Linear, step: Step, metric: Metric, base: Expr) -> None:
        """The curvature of the Lagrangian seen along this step: for w, and remembered with the step.

        Only what keeps the terminal conditions is remembered: across them, an unstable plant is stiffer by the square
        of its growth, and the conditions say where to go.
        """
        control = self.control
        if not self.settings.adaptive:
            return
        plain = learnt(base, ())
        turned = after.lagrangian(step.ell) - before.lagrangian(step.ell)
        solved = plain.inverse(np.arange(change.size))(np.column_stack([turned, after.rows.T]))
        gram = after.rows @ solved[:, 1:]
        change = change - solved[:, 1:] @ solve_gram(gram, after.rows @ change)
        turned = turned - after.rows.T @ solve_gram(gram, after.rows @ solved[:, 0])
        free = step.active == 0
        moved, seen = np.where(free, change, 0.0), np.where(free, turned, 0.0)
        along, size = float(moved @ seen), float(moved @ (base @ moved))
        if size <= 0 or not np.isfinite(along):
            return
        control.raised = max(1.0, control.raised / RAISE)
        with np.errstate(over="ignore", invalid="ignore"):
            if along > 0:
                value = max(float(seen @ solve_tangent(plain, seen, after.rows, step.active)) / along, along / size)
                control.weight = float(np.clip(np.nan_to_num(value), SMALLEST_WEIGHT, LARGEST_WEIGHT))
            learned = damped(change, turned, metric @ change)
            known = np.isfinite(float(learned @ learned))
        if known:  # slopes of a cost that has run away have squares that are no numbers
            control.pairs = [*control.pairs[1 - PAIRS :], (change, learned)]

    def _record(self, current: Iterate, measures: Measures) -> None:
        worst = float(self.space.violation(current).max(initial=0.0))
        self.control.history.append(
            {
                "cost": current.run.cost,
                "penalty": current.penalty.value,
                "slope": measures.slope,
                "miss": measures.miss,
                "transversality": measures.transversality,
                "violation": worst,
                "weight": self.control.weight * self.control.raised,
                "fraction": self.control.fraction,
            }
        )
        self.progress.update(self.control.iterations, current.run.cost, max(worst, measures.miss))
