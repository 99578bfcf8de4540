"""Costates where one statement of a chain ends and the next begins, and what must hold there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from functools import lru_cache
from typing import Annotated, Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import slopes_by
from covocp.base.matrices import Array
from covocp.base.residuals import VANISHING
from covocp.base.short_repr import short_repr
from covocp.extremal.cost_sizes import ZERO_COST, variable_cost
from covocp.extremal.costates import discrete_costates, passage_end, terminal_costates, without_passage
from covocp.extremal.decisions import start_slopes
from covocp.extremal.extremal import Extremal
from covocp.extremal.hamiltonian import Costates
from covocp.statement.chain import Link
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.nlp import terminal_slopes
from covocp.transcription.scales import magnitudes
from covocp.transcription.trajectory import Multipliers


@dataclass(frozen=True, kw_only=True)
class ChainOutcome:
    """What a method returns for a chain: an extremal and the cost terms of each statement, and how the run ended.

    The multipliers of an extremal that is not the last lack what its half-vectors at the end mean for the later ones,
    where matrices are eliminated; see `completed`.

    Attributes:
        extremals: the last iterate.
        link_multipliers: of the states that each link gives.
        bounds_at_ends: multipliers of the bounds on the states where each statement begins and ends, (nx,) each.
        cost_terms: terminal and running cost of each.
        converged: whether the method's own test was met.
        message: how it ended, a sentence.
        violations: largest violation of each violated constraint by its name.
        stats: iterations, times, what the method counts.
        given: whether the controls were given, and nothing was chosen: then nothing is prescribed where statements end,
            and the multipliers contain nothing of what the later ones cost.
        with_passages: whether the multipliers of final states contain the slope through matrices that start there, as
            those of a transcription that eliminates these do.
    """

    extremals: tuple[Extremal, ...]
    link_multipliers: tuple[Array, ...]
    bounds_at_ends: tuple[tuple[Array, Array], ...]
    cost_terms: tuple[Mapping[str, float], ...]
    converged: bool
    message: str
    violations: Mapping[str, float]
    stats: Mapping[str, Any]
    given: bool = False
    with_passages: bool = False

    __repr__ = short_repr

    @property
    def cost(self) -> float:
        """All terms together."""
        return float(sum(value for terms in self.cost_terms for value in terms.values()))


@dataclass(frozen=True, kw_only=True)
class Within:
    """What the rest of a chain says of one of its statements.

    Attributes:
        others: cost of the others.
        size: sum of the sizes of the cost terms of the others.
        variable: what of it is variable (`variable_cost`).
        start: multipliers of the initial states that the statement before gives, (nx,), zero elsewhere.
        by_duration: slope of what the later statements cost by the duration, through the link.
        end: slopes of what the later ones cost by the state at the end, (nx,).
        end_matrices: by the half-vectors there, (ne,).
        deviations: [E Z; Z' Xhat] of the closed loop at the start, (2n, 2n); empty without one.
        handed: 1/2 tr S Xhat there, less that where the next one starts: what the statement's form of the cost lacks.
        flown: slopes as `end` where the later ones keep their controls, and miss what is prescribed, (nx,).
        flown_matrices: as `end_matrices`, (ne,). Both are empty in files that were written before.
    """

    others: float
    size: float
    variable: float
    start: Annotated[Array, "x"]
    by_duration: float
    end: Annotated[Array, "x"]
    end_matrices: Annotated[Array, "e"]
    deviations: Array = field(default_factory=lambda: np.zeros((0, 0)))
    handed: float = 0.0
    flown: Annotated[Array, "x or none"] = field(default_factory=lambda: np.zeros(0))
    flown_matrices: Annotated[Array, "e or none"] = field(default_factory=lambda: np.zeros(0))

    __repr__ = short_repr

    @property
    def along_controls(self) -> tuple[Array, Array]:
        """`flown` and `flown_matrices`, in place of which, where these are not known, stand those with what is held."""
        known = self.flown.size == self.end.size and self.flown_matrices.size == self.end_matrices.size
        return (self.flown, self.flown_matrices) if known else (self.end, self.end_matrices)


@dataclass(frozen=True, kw_only=True)
class Passed:
    """An extremal of a chain with its costates, what the rest of the chain says of it, what bounds do at its ends."""

    extremal: Extremal
    costates: Costates
    within: Within
    bounds: tuple[Array, Array]

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class LinkSlopes:
    """Slopes of what the later statements cost by state, half-vectors and duration at the end before a link."""

    state: Array
    matrices: Array
    duration: float

    __repr__ = short_repr


def completed(outcome: ChainOutcome, links: tuple[Link, ...]) -> tuple[Passed, ...]:
    """The extremals with their costates, from the last to the first: the costates at the end of one follow the next.

    Args:
        outcome: of a method.
        links: of the chain.
    """
    sizes = [sum(abs(value) for value in terms.values()) for terms in outcome.cost_terms]
    variable = [variable_cost(extremal) for extremal in outcome.extremals]
    extremals = _with_weights(outcome, links)
    result: list[Passed] = []
    flown: Passed | None = None
    for i in range(len(extremals) - 1, -1, -1):
        extremal = extremals[i]
        st = extremal.statement
        slopes = LinkSlopes(state=np.zeros(st.nx), matrices=np.zeros(st.ne), duration=0.0)
        along = slopes
        if result and flown:
            later = result[-1]
            slopes = link_slopes(links[i], extremal, later)
            along = link_slopes(links[i], extremal, flown)
            m = extremal.multipliers
            if extremal.mesh.eliminated and st.matrices:
                m = replace(m, final_matrices=m.final_matrices + slopes.matrices)
            if outcome.given:
                m = replace(m, final=m.final + slopes.state)
            extremal = replace(extremal, multipliers=m)
        costates = discrete_costates(extremal)[0]
        start = np.zeros(st.nx)
        if i:
            states = list(links[i - 1].states)
            by_x = slopes_at_start(extremal, costates)[0] if outcome.given else start
            start[states] = -by_x[states] if outcome.given else outcome.link_multipliers[i - 1]
        others = outcome.cost - sum(outcome.cost_terms[i].values())
        within = Within(
            others=others,
            size=float(sum(sizes) - sizes[i]),
            variable=float(sum(variable[:i]) + sum(variable[i + 1 :])),
            start=start,
            by_duration=slopes.duration,
            end=slopes.state,
            end_matrices=slopes.matrices,
            flown=along.state,
            flown_matrices=along.matrices,
        )
        result.append(Passed(extremal=extremal, costates=costates, within=within, bounds=outcome.bounds_at_ends[i]))
        flown = _along_controls(result[-1]) if i else None
    return tuple(result[::-1])


def _along_controls(passed: Passed) -> Passed:
    """What a later statement costs by its start along its controls: nothing holds what is prescribed or limited."""
    extremal, within, none = passed.extremal, passed.within, np.zeros(passed.extremal.statement.nx)
    st = extremal.statement
    free = Multipliers.zero(st, extremal.mesh)
    backward = free.matrices.copy()
    behind = st.entries(st.behind)
    backward[0, behind] = extremal.multipliers.matrices[0, behind] if behind else 0.0
    free = replace(free, final=within.flown, final_matrices=within.flown_matrices, matrices=backward)
    alone = replace(extremal, multipliers=free)
    with np.errstate(over="ignore", invalid="ignore"):
        costates = discrete_costates(alone)[0]
    return Passed(extremal=alone, costates=costates, within=within, bounds=(none, none))


def _with_weights(outcome: ChainOutcome, links: tuple[Link, ...]) -> list[Extremal]:
    """The extremals with the slopes of what earlier ones cost by what runs backward, from the first to the last."""
    result: list[Extremal] = []
    for i, extremal in enumerate(outcome.extremals):
        if i and links[i - 1].weights:
            before, link = result[-1], links[i - 1]
            ended = discrete_costates(before)[0].matrices[-1, before.statement.entries(before.statement.behind)]
            matrices = extremal.multipliers.matrices.copy()
            matrices[0, list(link.behind)] = passage_end(before, ended)[2][list(link.weights)]
            extremal = replace(extremal, multipliers=replace(extremal.multipliers, matrices=matrices))
        result.append(without_passage(extremal) if outcome.with_passages else extremal)
    return result


def link_slopes(link: Link, before: Extremal, after: Passed) -> LinkSlopes:
    """Slopes of what the later statements cost by what the statement before a link ends with.

    For a jump x+ = J(x) these are J_x' (p+ + mu+), mu+ the multipliers of bounds that x+ is at, and for its covariance
    E+ = J_x E J_x' + N the slopes of tr(P+ E+).

    Args:
        link: between both.
        before: the extremal that ends there.
        after: what begins there.
    """
    by_x, by_e = slopes_at_start(after.extremal, after.costates)
    by_x = by_x + after.bounds[0]
    t = before.trajectory
    ends = (t.x[-1], t.e[-1], t.duration, before.parameters, after.extremal.parameters)
    values = _slopes(link)(*ends, by_x[list(link.states)], by_e[list(link.matrices)])
    state, matrices, duration = (np.asarray(v.full()).ravel() for v in values)
    return LinkSlopes(state=state, matrices=matrices, duration=float(duration[0]))


def slopes_at_start(extremal: Extremal, costates: Costates) -> tuple[Array, Array]:
    """Slopes of the Lagrangian by the initial state and half-vectors: costates, and conditions at the start."""
    st, t = extremal.statement, extremal.trajectory
    by_e = costates.matrices[0].copy()
    if st.start.size and st.ne:
        e = ca.MX.sym("e", st.ne)
        at = (t.x[0], extremal.controls[0], e, 0.0, t.duration, extremal.parameters)
        value = ca.dot(ca.DM(extremal.multipliers.start), st.start.function(*at))
        by_e += np.asarray(ca.Function("by_e", [e], [ca.densify(ca.gradient(value, e))])(t.e[0]).full()).ravel()
    return start_slopes(extremal, costates), by_e


@lru_cache(maxsize=KEPT)
def _slopes(link: Link) -> ca.Function:
    """(*arguments of the link, weights of its states and matrices) -> slopes by x, e and T."""
    names = [link.function.name_in(i) for i in range(link.function.n_in())]
    inputs = [ca.MX.sym(name, link.function.size1_in(i)) for i, name in enumerate(names)]
    weights = [ca.MX.sym("px", len(link.states)), ca.MX.sym("pe", len(link.matrices))]
    states, matrices = link.function(*inputs)
    value = ca.dot(weights[0], states) + ca.dot(weights[1], matrices)
    return ca.Function("link_slopes", [*inputs, *weights], slopes_by(value, inputs[:3]))


def link_residual(before: Passed, after: Passed, link: Link) -> float:
    """Largest difference of p(T) and k_x + mu + J_x' (p+ + mu+) at a link, of p+ + mu+ and zero where a state is free.

    mu and mu+ are the multipliers of bounds that act there, which may hold a state on either side of the link. Of
    states that are not prescribed; relative to the largest costate on both sides or, where that is less, as a change of
    the cost if all of these states moved by their magnitudes, relative to a tenth of what of it is variable: costates
    that vanish are roundoff, and so is what they differ by.

    Args:
        before: what ends there.
        after: what begins there.
        link: between both.
    """
    first, second = before.extremal, after.extremal
    end = terminal_costates(first)[0]
    own = terminal_slopes(
        first.statement, first.trajectory, first.parameters, first.multipliers.end, first.multipliers.path[-1]
    )[0]
    loose = _loose(first, -1)
    missed = (end - own - before.within.end - before.bounds[1])[loose]
    start = slopes_at_start(second, after.costates)[0] + after.bounds[0]
    given = np.isin(np.arange(start.size), link.states)
    free, passing = _loose(second, 0) & ~given, _loose(second, 0) & given
    missed = np.abs(np.concatenate([missed, start[free], (start + after.within.start)[passing]]))
    units, later = (magnitudes(e.statement, e.trajectory, e.parameters).x for e in (first, second))
    changed = float((missed * np.concatenate([units[loose], later[free], later[passing]])).sum())
    size = max(float(np.abs(passed.costates.state).max(initial=0.0)) for passed in (before, after))
    tiny = float(np.finfo(float).tiny)
    cost = VANISHING * (variable_cost(first) + before.within.variable)
    return min(float(missed.max(initial=0.0)) / max(size, tiny), changed / max(cost, ZERO_COST))


def _loose(extremal: Extremal, node: int) -> Any:
    """Entries of the state at the first or last node that are not prescribed, there or by equal bounds."""
    st = extremal.statement
    lower, upper = st.state_bounds
    known = st.boundary_values(extremal.parameters)[0 if node == 0 else 1]
    return np.isnan(known) & (lower < upper)
