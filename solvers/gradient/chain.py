"""The gradient method on several phases: forward from the first to the last, backward through the links.

At a link z+(0) = J(z(T), T). The costates of the cost, and the influence functions of the conditions of all phases that
follow, go on as J_z' p+; by T the slope J_T' p+ is added. So each phase has, beside those of its own conditions, an
influence function for every condition behind it. In a closed loop S runs backward through all phases once x and E are
known, and its costate Y forward from the first to the last, before p and P. A step moves the controls, free durations
and free initial values of all phases at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from scipy import sparse

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.solvers.gradient.descent import Step
from covocp.solvers.gradient.influence import Later, Run, given_at_end
from covocp.solvers.gradient.iterate import Space
from covocp.solvers.gradient.penalty import Group, Indices, Penalty, Weights
from covocp.solvers.gradient.records import Iterate, Linear, Measures
from covocp.solvers.gradient.unknowns import Unknowns, of_part
from covocp.statement.chain import Link
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.trajectory import Multipliers


@dataclass(frozen=True, kw_only=True)
class ChainIterate(Iterate):
    """A point of all phases; spaces: of each, with the parameters and initial values that the one before gives."""

    parts: tuple[Iterate, ...]
    spaces: tuple[Space, ...]

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class ChainLinear(Linear):
    """First-order changes of all phases; later: what those that follow say of the end of each, None of the last."""

    parts: tuple[Linear, ...]
    later: tuple[Later | None, ...]

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class ChainSpace(Unknowns):
    """The unknowns of several phases, one after the other.

    parts: of each phase, at the guess. links: between them. The others: as of `Unknowns`, of all phases.
    """

    parts: tuple[Space, ...]
    links: tuple[Link, ...]
    groups: tuple[Group, ...]
    weights: Weights
    unit: Array
    lower: Array
    upper: Array
    fixed_metric: Array
    miss_scale: Array
    extra: Array

    __repr__ = short_repr

    @property
    def names(self) -> tuple[str, ...]:
        """Of the terminal conditions, with that of the phase."""
        return tuple(f"{part.sweeps.statement.name}: {name}" for part in self.parts for name in part.names)

    @property
    def others(self) -> Indices:
        """Entries of a point that are durations and free initial values."""
        pairs = zip(self.parts, self.spans, strict=True)
        return np.concatenate([span.start + part.others for part, span in pairs])

    @property
    def durations(self) -> Indices:
        """Entries of a point that are durations."""
        pairs = zip(self.parts, self.spans, strict=True)
        return np.concatenate([span.start + part.durations for part, span in pairs])

    @property
    def spans(self) -> list[slice]:
        """The entries of a point that belong to each phase."""
        return _consecutive([part.unit.size for part in self.parts])

    @property
    def ells(self) -> list[slice]:
        """The conditions that each phase has an influence on: its own, and those behind it."""
        return [slice(own.start, self.conditions) for own in _consecutive([part.conditions for part in self.parts])]

    def with_weights(self, weights: Weights) -> ChainSpace:
        """The same with other penalties."""
        parts, offset = [], 0
        for part in self.parts:
            own = slice(offset, offset + len(part.groups))
            offset = own.stop
            chosen = {name: getattr(weights, name)[own] for name in ("weights", "shifts", "scales")}
            parts.append(part.with_weights(Weights(**chosen)))
        return chain_space(tuple(parts), self.links)

    def judged_at(self, iterate: Iterate) -> ChainSpace:
        """The same with the magnitudes of the inequalities there, where those are smaller."""
        assert isinstance(iterate, ChainIterate)
        each = zip(self.parts, iterate.spaces, iterate.parts, strict=True)
        parts = [replace(space, weights=part.weights).judged_at(own) for part, space, own in each]
        scales = tuple(value for part in parts for value in part.weights.scales)
        return self.with_weights(replace(self.weights, scales=scales))

    def with_extra(self, extra: Array) -> ChainSpace:
        """The same with other weights of what is no control value."""
        spans = _consecutive([part.extra.size for part in self.parts])
        parts = tuple(part.with_extra(extra[span]) for part, span in zip(self.parts, spans, strict=True))
        return chain_space(parts, self.links)

    def at(self, point: Array) -> ChainIterate:
        """Forward sweeps from the first phase to the last."""
        found: list[Iterate] = []
        spaces: list[Space] = []
        for i, (part, span) in enumerate(zip(self.parts, self.spans, strict=True)):
            if i:
                part = started(part, self.links[i - 1], spaces[-1], found[-1].run)
            spaces.append(part)
            found.append(part.at(point[span]))
        for i in range(len(self.links) - 1, -1, -1):  # S runs backward along what was found
            link = self.links[i]
            if link.weights:
                nx = spaces[i + 1].sweeps.statement.nx
                weight = found[i + 1].run.z[0, [nx + k for k in link.behind]]
                spaces[i] = replace(spaces[i], parameters=link.weighed(spaces[i].parameters, weight))
                found[i] = spaces[i].at(point[self.spans[i]])
        runs = [entry.run for entry in found]
        joined = Run(
            u=np.zeros((0, 0)),
            duration=sum(run.duration for run in runs),
            z=np.concatenate([run.z.ravel() for run in runs])[:, None],
            running=sum(run.running for run in runs),
            terminal=sum(run.terminal for run in runs),
            miss=np.concatenate([run.miss for run in runs]),
        )
        penalty = _together([entry.penalty for entry in found])
        return ChainIterate(point=point, run=joined, penalty=penalty, parts=tuple(found), spaces=tuple(spaces))

    def linearise(self, iterate: Iterate) -> ChainLinear:
        """Backward sweeps from the last phase to the first."""
        assert isinstance(iterate, ChainIterate)
        parts: list[Linear] = []
        later: list[Later | None] = [None]
        firsts = self._firsts(iterate)
        for i in range(len(self.parts) - 1, -1, -1):
            space, own = iterate.spaces[i], iterate.parts[i]
            parts.insert(0, space.linearise(own, later[0], firsts[i]))
            if i:
                link, before = self.links[i - 1], iterate.parts[i - 1].run
                weights = _by_given(space, link, own.run, parts[0])
                later.insert(0, _through(link, iterate.spaces[i - 1], space, before, weights))
        rows = np.zeros((self.conditions, iterate.point.size))
        for part, span, own_rows in zip(parts, self.spans, self.ells, strict=True):
            rows[own_rows, span] = part.rows
        slope, sizes = (np.concatenate([getattr(part, name) for part in parts]) for name in ("slope", "sizes"))
        return ChainLinear(
            slope=slope, rows=rows, sizes=sizes, slopes=parts[0].slopes, parts=tuple(parts), later=tuple(later)
        )

    def _firsts(self, iterate: ChainIterate) -> list[Array | None]:
        """What the costates Y of S begin with in each phase: slopes of Y' S(T) before the link by S behind it."""
        result: list[Array | None] = [None]
        for i, link in enumerate(self.links):
            space, run = iterate.spaces[i], iterate.parts[i].run
            if not link.weights:
                result.append(None)
                continue
            ended = given_at_end(space.sweeps, run, space.parameters, result[-1])
            x = run.z[-1, : space.sweeps.statement.nx]
            slopes = _weight_slopes(link, space.sweeps.statement)(x, run.duration, space.parameters, ended)
            result.append(np.asarray(slopes.full()).ravel())
        return result

    def cost_size(self, iterate: Iterate) -> float:
        """Sum of the absolute terms of the cost of all phases."""
        assert isinstance(iterate, ChainIterate)
        pairs = zip(iterate.spaces, iterate.parts, strict=True)
        return float(sum(space.cost_size(part) for space, part in pairs))

    def sizes_along(self, iterate: Iterate, linear: Linear, ell: Array) -> Array:
        """Sizes of the slopes by the control values from those of H_u at the nodes."""
        each = self._each(iterate, linear)
        return np.concatenate([space.sizes_along(own, part, ell[rows]) for space, own, part, rows in each])

    def reach(self, iterate: Iterate, linear: Linear) -> Array:
        """What changes of z at the ends make of each terminal condition."""
        return np.concatenate([space.reach(own, part) for space, own, part, _ in self._each(iterate, linear)])

    def reached_units(self, iterate: Iterate, linear: Linear, measures: Measures) -> tuple[Array, float]:
        """Magnitudes of the entries of a point there, and the change of the cost by those of the controls."""
        each = zip(self._each(iterate, linear), self.spans, strict=True)
        found = [
            space.reached_units(own, part, of_part(measures, rows, span)) for (space, own, part, rows), span in each
        ]
        return np.concatenate([unit for unit, _ in found]), float(sum(change for _, change in found))

    def metric(self, iterate: Iterate, linear: Linear, ell: Array, weight: Expr) -> Any:
        """The metrics of all phases side by side, for a cost of the size of that of all."""
        each = list(self._each(iterate, linear))
        size = sum(space.size_of(own, part) for space, own, part, _ in each)
        blocks = [space.metric_along(own, own.run.u, part, ell[rows], weight, size) for space, own, part, rows in each]
        return sparse.block_diag(blocks, format="csc")

    def room(self, iterate: Iterate) -> tuple[Array, Array]:
        """Bounds of a step of all phases."""
        assert isinstance(iterate, ChainIterate)
        found = [space.room(own) for space, own in zip(iterate.spaces, iterate.parts, strict=True)]
        return np.concatenate([low for low, _ in found]), np.concatenate([high for _, high in found])

    def chord(self, iterate: Iterate, linear: Linear, active: Array | None) -> Step:
        """No phases are solved by the chord variant; `prepare_chain` refuses it."""
        raise NotImplementedError

    def multipliers(
        self, iterate: ChainIterate, linear: ChainLinear, measures: Measures
    ) -> tuple[tuple[Multipliers, ...], tuple[Array, ...]]:
        """Those of each phase, and of the bounds on its states at its end, (nx,).

        The multipliers of the final states contain what bounds do there, and what the later phases cost by them.
        """
        result, bounds = [], []
        each = zip(self._each(iterate, linear), self.spans, linear.later, strict=True)
        for (space, own, _, rows), span, later in each:
            found = space.multipliers(own, of_part(measures, rows, span))
            fixed = np.isin(np.arange(found.final.size), space.sweeps.terminal.fixed)
            bounds.append(np.where(fixed, 0.0, found.final))
            if later is not None:
                behind = measures.ell[rows][space.conditions :]
                by_end = later.columns[: space.sweeps.statement.nx]
                found = replace(found, final=found.final + by_end[:, 0] + by_end[:, 1:] @ behind)
            result.append(found)
        return tuple(result), tuple(bounds)

    def link_multipliers(self, iterate: ChainIterate, linear: ChainLinear, measures: Measures) -> tuple[Array, ...]:
        """Minus the slopes of the Lagrangian by the states that each link gives."""
        result = []
        each = list(zip(self._each(iterate, linear), strict=True))[1:]
        for link, ((space, own, part, rows),) in zip(self.links, each, strict=True):
            slopes = _by_given(space, link, own.run, part)[:, : len(link.states)]
            result.append(-(slopes[0] + measures.ell[rows] @ slopes[1:]))
        return tuple(result)

    def violations(self, iterate: ChainIterate, tolerance: float) -> dict[str, float]:
        """Largest violation of each violated constraint, in its own unit, by name with that of the phase."""
        found: dict[str, float] = {}
        for part, space, own in zip(self.parts, iterate.spaces, iterate.parts, strict=True):
            space = replace(space, weights=part.weights)
            prefix = f"{space.sweeps.statement.name}: "
            found |= {prefix + name: value for name, value in space.violations(own, tolerance).items()}
        return dict(sorted(found.items(), key=lambda entry: -entry[1]))

    def _each(self, iterate: Iterate, linear: Linear) -> Any:
        """Space, iterate, slopes and conditions of each phase."""
        assert isinstance(iterate, ChainIterate)
        assert isinstance(linear, ChainLinear)
        return zip(iterate.spaces, iterate.parts, linear.parts, self.ells, strict=True)


def chain_space(parts: tuple[Space, ...], links: tuple[Link, ...]) -> ChainSpace:
    """The unknowns of several phases from those of each."""

    def joined(name: str) -> Array:
        return np.concatenate([getattr(part, name) for part in parts])

    fields = ("weights", "shifts", "scales")
    weights = {name: tuple(value for part in parts for value in getattr(part.weights, name)) for name in fields}
    return ChainSpace(
        parts=parts,
        links=links,
        groups=tuple(group for part in parts for group in part.groups),
        weights=Weights(**weights),
        unit=joined("unit"),
        lower=joined("lower"),
        upper=joined("upper"),
        fixed_metric=joined("fixed_metric"),
        miss_scale=joined("miss_scale"),
        extra=joined("extra"),
    )


def given_entries(link: Link, nx: int) -> tuple[int, ...]:
    """Entries of z(0) that a link gives: states, then half-vectors."""
    return (*link.states, *(nx + k for k in link.matrices))


def started(space: Space, link: Link, before: Space, run: Run) -> Space:
    """A later phase with what a run of the phase before it gives."""
    st, nx = space.sweeps.statement, before.sweeps.statement.nx
    last = run.z[-1]
    states, matrices = link.values(last[:nx], last[nx:], run.duration, before.parameters, space.parameters)
    start = space.start.copy()
    start[list(given_entries(link, st.nx))] = np.concatenate([states, matrices])
    return replace(space, start=start, parameters=link.filled(space.parameters, matrices))


def _by_given(space: Space, link: Link, run: Run, linear: Linear) -> Array:
    """Slopes of cost and conditions by what a link gives, (1 + q, given)."""
    nx = space.sweeps.statement.nx
    given = np.array(given_entries(link, nx), dtype=np.intp)
    return np.asarray(linear.slopes.start @ space.tied_slopes(run.z[0, :nx], given))


def _through(link: Link, before: Space, after: Space, run: Run, weights: Array) -> Later:
    """Slopes by what a link gives (1 + q, given) as those by the end before it and by its duration."""
    nx, last = before.sweeps.statement.nx, run.z[-1]
    values = _jacobians(link)(last[:nx], last[nx:], run.duration, before.parameters, after.parameters)
    by_z, by_duration = (np.asarray(value.full()) for value in values)
    return Later(columns=(weights @ by_z).T, duration=(weights @ by_duration).ravel())


@lru_cache(maxsize=KEPT)
def _jacobians(link: Link) -> ca.Function:
    """(arguments of the link) -> slopes of states and half-vectors that it gives by z(T) and by T."""
    names = [link.function.name_in(i) for i in range(link.function.n_in())]
    inputs = [ca.MX.sym(name, link.function.size1_in(i)) for i, name in enumerate(names)]
    given = ca.vertcat(*link.function.call(inputs, True, False))
    by_z = ca.horzcat(ca.jacobian(given, inputs[0]), ca.jacobian(given, inputs[1]))
    return ca.Function("jacobians", inputs, [ca.densify(by_z), ca.densify(ca.jacobian(given, inputs[2]))])


@lru_cache(maxsize=KEPT)
def _weight_slopes(link: Link, before: Statement) -> ca.Function:
    """(x(T), T, parameters, Y(T)) -> slopes of Y' S(T) by S where the next phase begins."""
    assert before.matrix_end is not None
    x, duration, p = ca.MX.sym("x", before.nx), ca.MX.sym("T"), ca.MX.sym("p", before.np)
    y = ca.MX.sym("y", len(before.entries(before.behind)))
    slope = ca.gradient(ca.dot(y, before.matrix_end(x, duration, p)), p)
    return ca.Function("weight_slopes", [x, duration, p, y], [ca.densify(slope[list(link.weights)])])


def _together(penalties: list[Penalty]) -> Penalty:
    """Values of the penalties of all phases; their slopes stay with the phases."""
    tuples: Mapping[str, Any] = {
        name: tuple(value for penalty in penalties for value in getattr(penalty, name))
        for name in ("multipliers", "excess", "room")
    }
    value, nothing = sum(penalty.value for penalty in penalties), np.zeros((0, 0))
    return Penalty(value=value, jumps=nothing, control=nothing, duration=0.0, curvature=nothing, **tuples)


def _consecutive(lengths: list[int]) -> list[slice]:
    """Slices of these lengths one behind the other."""
    return [slice(i, j) for i, j in pairwise(np.cumsum([0, *lengths]).tolist())]
