"""The residuals of a point of the NLP, in the scale of that point."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.buffered import Buffered, Matrices
from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.residuals import LIMIT, NO_SIZE, ROUNDED, VIOLATION, Residuals, complementary
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Merit
from covocp.solvers.at_point import AtPoint, Weighed
from covocp.statement.conditions import beyond
from covocp.transcription.nlp import NLP, Scales
from covocp.transcription.program import Arrays, Program, Trajectories
from covocp.transcription.scales import choose_scales, magnitudes, with_given
from covocp.transcription.trajectory import Trajectory, at_nodes

# Scales fall by no more than this factor at a time: a state that is zero but for roundoff has no magnitude.
SMALLEST_SHARE = 1e-6
# Share of its scale below which a state that was reached is at rest: nothing else is measured in that.
NO_SHARE = 1e-5
# Powers of ten by which scales may differ from those of the point that was reached.
SIMILAR = 1.5
# Relative displacement by which the curvature of the cost is measured.
DISPLACEMENT = 1e-4


# The trajectories of a point, its cost terms and constraint values (`Program.unpack`).
Evaluated = tuple[Trajectories, dict[str, Any]]
# Magnitudes of each part of a program.
Magnitudes = tuple[Scales, ...]

# Ipopt's word for a point that does not meet its tolerance.
ACCEPTABLE = "Solved_To_Acceptable_Level"


@dataclass(frozen=True, kw_only=True)
class Point:
    """Where a run of the NLP solver ended: variables, multipliers for a cost scale of 1, and how it ended.

    evaluable: whether the model has values there; else this is where the run began. concave: whether its steps showed a
    negative curvature at last, so that it need not be a minimum.
    """

    w: Array
    lam_x: Array
    lam_g: Array
    where: Evaluated
    success: bool
    status: str
    iterations: int
    evaluable: bool
    concave: bool = False

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where a run starts: variables, and multipliers for a cost scale of 1 or None."""

    w: Array
    lam_x: Array | None = None
    lam_g: Array | None = None

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Round:
    """A run, with its residuals where it ended at a point that may be stationary.

    converged: whether these hold, relative to the cost or to what the variables change of it. settled: relative to the
    cost, so that no further run is worth it.
    """

    nlp: Program
    point: Point
    where: Evaluated
    residuals: Residuals | None
    converged: bool
    settled: bool

    __repr__ = short_repr


def within_bounds(nlp: Program, point: Point, parameters: Arrays) -> Point:
    """A point within its bounds, which Ipopt passes by a share of the scales: that may cost more than is left."""
    bounds = nlp.bounds(parameters)
    w = np.clip(point.w, bounds["lbx"], bounds["ubx"])
    return replace(point, w=w, where=nlp.unpack(w, parameters))


class FirstOrder:
    """Gradient of the cost and of the Lagrangian of an NLP, from the solver's own functions where they are known."""

    def __init__(self, nlp: Program, solver: Any, together: AtPoint | None = None) -> None:
        """Take the functions that are had together, those of a solver that tells them, or, without both, make some."""
        self.nlp, self._together, self._solver = nlp, together, solver

    @cached_property
    def _gradient(self) -> Matrices:
        """(w, p) -> cost, its slopes."""
        if self._solver is not None:
            return Matrices(self._solver.get_function("nlp_grad_f"))
        w, p = self.nlp.w, self.nlp.p
        return Matrices(ca.Function("gradient", [w, p], [self.nlp.f, ca.gradient(self.nlp.f, w)]))

    @cached_property
    def _rows(self) -> tuple[Buffered, Weighed]:
        """(w, p) -> constraints, entries of their Jacobian, by the function of the solver; and what weighs these."""
        function = self._solver.get_function("nlp_jac_g")
        return Buffered(function), Weighed(function.sparsity_out(1))

    @cached_property
    def _sum(self) -> Matrices:
        """(w, p, weights) -> constraints, slopes of their sum with these weights."""
        w, p, g = self.nlp.w, self.nlp.p, self.nlp.g
        weights = ca.MX.sym("weights", g.shape[0])
        return Matrices(ca.Function("weighed", [w, p, weights], [g, ca.jtimes(g, w, weights, True)]))

    def cost(self, w: Array, parameters: Arrays) -> tuple[float, Array]:
        """The cost and its gradient by the variables; NaN where the model fails."""
        p = self.nlp.p_of(parameters, 1.0)
        if self._together is None:
            value, slope = self._gradient.evaluated(w, p)
            return float(value.item()), slope.ravel()
        outputs = self._together.full(w, p)
        return (np.nan, np.full(w.size, np.nan)) if outputs is None else (float(outputs[0][0]), outputs[2])

    def constraints(self, w: Array, parameters: Arrays, weights: Array) -> tuple[Array, Array]:
        """The constraints, and the slope by the variables of their sum with these weights."""
        p = self.nlp.p_of(parameters, 1.0)
        if self._together is not None:
            outputs = self._together.full(w, p)
            if outputs is None:
                return np.full(weights.size, np.nan), np.full(w.size, np.nan)
            return outputs[1], self._together.weighed(outputs[3], weights)
        if self._solver is None:
            values, slope = self._sum.evaluated(w, p, weights)
            return values.ravel(), slope.ravel()
        rows, weighed = self._rows
        outputs = rows(w, p)
        if outputs is None:
            raise RuntimeError("the constraints have no slopes there")
        return outputs[0], weighed(outputs[1], weights)

    def merit(self, w: Array, parameters: Arrays) -> Merit:
        """Cost, largest violation, and what the inequalities have left together, as their mirror images have."""
        limits = self.nlp.bounds(parameters)
        with np.errstate(all="ignore"):
            cost = self.cost(w, parameters)[0]
            rows = self.constraints(w, parameters, np.zeros(limits["lbg"].size))[0]
        beside = beyond(rows, limits["lbg"], limits["ubg"])
        worst = max(float(own.max(initial=0.0)) for own in (beside, beyond(w, limits["lbx"], limits["ubx"])))
        return Merit(cost, worst, float(beside[limits["lbg"] < limits["ubg"]].sum()))


def reached_scales(nlp: Program, trajectories: Trajectories, parameters: Arrays, *, again: bool) -> Magnitudes:
    """The magnitudes at a point that was reached.

    Args:
        nlp: in which the point was found.
        trajectories: the point.
        parameters: of the statements.
        again: whether the program itself is in the scales of such a point: controls that are then far smaller are zero.
    """
    result = []
    for part, trajectory, own in nlp.each(trajectories, parameters):
        found = choose_scales(part.statement, part.mesh, trajectory, own, reached=True)
        least = SMALLEST_SHARE * part.scales.u.reshape(-1, found.u.size).max(axis=0, initial=0.0) if again else 0.0
        result.append(replace(found, u=np.maximum(found.u, least), duration=trajectory.duration))
    return tuple(result)


def as_given(nlp: Program, scales: Magnitudes) -> Magnitudes:
    """Magnitudes in which the user wants a program to work: the scales that were given in place of what was found."""
    return tuple(with_given(part.statement, own) for part, own in zip(nlp.parts, scales, strict=True))


def not_zero(nlp: Program, scales: Magnitudes) -> Magnitudes:
    """Magnitudes in which a program can work: states and matrices that are zero but for roundoff have none."""
    least = [(SMALLEST_SHARE * own.x, SMALLEST_SHARE * own.e) for own in nlp.scales]
    return tuple(
        replace(own, x=np.maximum(own.x, x), e=np.maximum(own.e, e)) for own, (x, e) in zip(scales, least, strict=True)
    )


def similar(nlp: Program, scales: Magnitudes) -> bool:
    """Whether other magnitudes are about those that a program works in."""
    ratios: list[Array] = []
    for new, own in zip(scales, nlp.scales, strict=True):
        time = np.array([new.duration / own.duration])
        ratios += [new.x / own.x, new.e / own.e, np.ravel(new.u / own.u), time]
    return bool(np.abs(np.log10(np.concatenate(ratios))).max(initial=0.0) <= SIMILAR)


def vanished(before: Program, after: Program) -> bool:
    """Whether some states or matrices are measured by what is left of them at rest, which before they were not."""
    falls = [
        np.concatenate([new.x / own.x, new.e / own.e]) for new, own in zip(after.scales, before.scales, strict=True)
    ]
    return bool(np.concatenate(falls).min(initial=1.0) < NO_SHARE)


def carried(point: Point, old: Program, new: Program, *, dual: bool) -> Start:
    """A point in the units of another program of the same problem, with its multipliers or without."""
    unit = old.units(new.scales)
    ones = np.ones(0)
    rows = np.concatenate([ones, *(b.scale / a.scale for a, b in zip(old.rows, new.rows, strict=True))])
    if not dual:
        return Start(w=point.w / unit)
    return Start(w=point.w / unit, lam_x=point.lam_x * unit, lam_g=point.lam_g * rows)


def residuals(
    first: FirstOrder, point: Point, parameters: Arrays, where: Evaluated, scales: Magnitudes | None
) -> Residuals:
    """The residuals of a point.

    Args:
        first: of the program.
        point: variables and multipliers.
        parameters: of the statements.
        where: trajectory and values there.
        scales: magnitudes of the variables there; None: what the trajectory shows, where a control counts with no less
            than the scale of the program (an upper bound, and cheaper).
    """
    nlp, (trajectories, values) = first.nlp, where
    bounds = nlp.bounds(parameters)
    bound = scales is None
    if scales is None:
        own = [
            (magnitudes(part.statement, t, p, reached=True), part) for part, t, p in nlp.each(trajectories, parameters)
        ]
        scales = tuple(replace(entry, u=np.maximum(entry.u, part.scales.u)) for entry, part in own)
    able = not_zero(nlp, scales)
    unit, row = nlp.units(able), nlp.row_units(able)
    lam_x, room_x = complementary(point.lam_x, point.w, bounds["lbx"], bounds["ubx"])
    lam_g, room_g = complementary(point.lam_g, values["g"], bounds["lbg"], bounds["ubg"])
    _, by_w = first.cost(point.w, parameters)
    g, by_g = first.constraints(point.w, parameters, lam_g)
    free, unequal = bounds["ubx"] > bounds["lbx"], bounds["ubg"] > bounds["lbg"]
    slope = float(np.sum(np.abs(by_w + by_g + lam_x)[free] * unit[free]))
    lower, upper = bounds["lbg"], bounds["ubg"]
    excess = np.maximum(np.maximum(lower - g, g - upper), 0.0)
    apart = np.maximum(np.maximum(bounds["lbx"] - point.w, point.w - bounds["ubx"]), 0.0)
    rest = float(np.sum(np.abs(lam_x * room_x)[free]) + np.sum(np.abs(lam_g * room_g)[unequal]))
    missed = float(np.sum(np.abs(lam_g) * excess))
    passed = np.where(g > upper, upper, lower)  # its size is one of what it limits, that of the other one need not be
    row = np.maximum(row, np.where(np.isfinite(passed), np.abs(passed), 0.0))
    worst = float(np.concatenate([excess / row, apart / unit]).max(initial=0.0))
    size = sum(abs(costs["running"]) + abs(costs["terminal"]) for costs in values["parts"])
    if not np.isfinite([slope, rest, missed, worst, size]).all():
        return Residuals(slope=np.inf, complementarity=np.inf, infeasibility=np.inf, violation=np.inf)
    met = (
        point.status != ACCEPTABLE
    )  # where not even its own tolerance is, an unstable plant makes any change look large
    varied = 0.0
    if met and not bound and max(slope, rest, missed) > LIMIT * size:
        moved = _change(first, point.w, by_w, nlp.units(scales), parameters)
        each = zip(nlp.each(trajectories, parameters), scales, strict=True)
        own = np.sum([_change_at_nodes(*entry, units) for entry, units in each])
        varied = min(moved, float(own))
    if size <= NO_SIZE * varied:  # what is left of magnitudes at rest is roundoff of those of the program
        at_rest = np.concatenate([excess / np.maximum(1.0, row), apart]).max(initial=0.0)
        worst = min(worst, float(at_rest) * VIOLATION / ROUNDED)
    size = max(size, NO_SIZE * varied, float(np.finfo(float).tiny))
    changes = {"slope": slope / size, "complementarity": rest / size, "infeasibility": missed / size}
    return Residuals(**changes, violation=worst, size=size, varied=varied)


def _change(first: FirstOrder, w: Array, slope: Array, unit: Array, parameters: Arrays) -> float:
    """Second-order change of the cost where all variables change by their magnitudes, away from zero."""
    step = np.where(w < 0, -unit, unit)
    _, moved = first.cost(w + DISPLACEMENT * step, parameters)
    change = abs(float((moved - slope) @ step)) / DISPLACEMENT
    return change if np.isfinite(change) else 0.0


def _change_at_nodes(part: NLP, t: Trajectory, parameters: Array, scales: Scales) -> float:
    """The same of the costs at the nodes, where nothing is integrated; inf where no nominal enters the cost.

    Along an unstable nominal all variables together change the cost by what they grow to, which says nothing of it.
    """
    st, count = part.statement, part.mesh.intervals + 1
    if not st.nx or t.x.shape[0] != count:
        return np.inf
    u = at_nodes(t.u, count)
    steps = [np.where(v < 0, -unit, unit) for v, unit in ((t.x, scales.x), (u, at_nodes(_rows(scales.u, t.u), count)))]
    time, running = t.duration * part.mesh.nodes, st.rates.map(count)
    costs = []
    for share in (DISPLACEMENT, 0.0, -DISPLACEMENT):
        x, v = t.x + share * steps[0], u + share * steps[1]
        arguments = (x.T, v.T, t.e.T, time[None, :], t.duration, parameters)
        rate = np.asarray(running(*arguments)[2].full()).ravel()
        terminal = float(st.terminal(x[-1], t.e[-1], t.duration, parameters))
        costs.append(float(np.trapezoid(rate, time)) + terminal)
    change = abs(costs[0] - 2.0 * costs[1] + costs[2]) / DISPLACEMENT**2
    roundoff = np.finfo(float).eps * max(map(abs, costs)) / DISPLACEMENT**2
    return change if np.isfinite(change) and change > roundoff else np.inf


def _rows(scales: Array, controls: Array) -> Array:
    """Units of the controls, a row for each of their values."""
    return np.broadcast_to(scales, controls.shape)
