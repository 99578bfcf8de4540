"""Meshes made anew until the error of the cost is small enough, of one problem or of several phases alike.

The error of a mesh is measured, not forecast: the problem is solved again, from there, on a mesh with one or two nodes
more in each interval, and the difference of the costs counts. What each interval has to do with it (`local_errors`)
decides where the nodes of the next mesh go. Phases have a mesh each; what counts is the cost of all of them, so that
their intervals have errors of the same size.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import CovocpError, warn_user
from covocp.base.matrices import Array, distinct
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal
from covocp.extremal.local_errors import local_errors
from covocp.extremal.mesh_error import NO_COST
from covocp.extremal.readings import stretches
from covocp.solving.attempts import AnyOutcome
from covocp.solving.between_nodes import mention_between, more_points, worst_between
from covocp.statement.statement import Statement
from covocp.transcription.instants import completed
from covocp.transcription.mesh import Graded, Mesh, Options
from covocp.transcription.nlp import Scales
from covocp.transcription.remeshing import CHANGING, CLOSEST, HIDING, Jump, demand, divided, jumps_of, remeshed
from covocp.transcription.stiffness import nominal_along

# How often the intervals of a first mesh are doubled where it is not solved.
DOUBLED = 2
# Most meshes, and most intervals of one.
MOST_MESHES, MOST_INTERVALS = 15, 3000
# What the error is, at most, in the change by a finer mesh: a jump of a control whose ramp is half as long costs a
# quarter, but a kink close to the end of an interval costs half with halves of it. Where errors of both signs cancel,
# this share of their sum counts.
LEFT, CANCELLED = 2.0, 0.25
# The next mesh aims at this share of what is allowed, and at no less than this share of the error of the one before.
AIMED, BOLD = 0.3, 1e-4
# Meshes without a better one among them, after which a tolerance counts as out of reach, and how much better.
PATIENCE, BETTER = 3, 0.7
# A mesh that is better than the one before by this may be followed by a coarser one; one that is no better by one with
# so many times the intervals. How often what a mesh aims at is halved for that.
MUCH_BETTER, MORE, SHARPENED = 0.1, 1.25, 20
# Errors above the least one by this are not left by the tolerance of the method.
ABOVE = 10.0
# Ratio of the distances of nodes beside a jump: its place is found to that.
GROWING = 4.0
# Power of the length with which the error of an interval falls: of controls that are linear, or constant over it.
ORDERS = {"linear": 5, "constant": 3}

INTERRUPTED = "interrupted"


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """A mesh with its solution, the estimated relative error of its cost, and what of it no comparison shows.

    Args:
        options: of each phase; one entry where there is one problem.
        meshes: made of them.
        prepared: the method made ready for them.
        outcome: what it found.
        extremals: of each phase; those of a converged outcome have the costates within the whole.
        cost: of all.
        least: relative error of the cost that the tolerance of the method leaves.
        error: estimated relative error of the cost; nan until it is measured.
        scales: units of each phase, the same on all meshes; None until they are known.
    """

    options: tuple[Options, ...]
    meshes: tuple[Mesh, ...]
    prepared: Any
    outcome: AnyOutcome
    extremals: tuple[Extremal, ...]
    cost: float
    least: float
    error: float = np.nan
    scales: tuple[Scales, ...] | None = None

    __repr__ = short_repr

    @property
    def refine(self) -> float | None:
        """Relative error of the cost that is allowed, where one is asked for."""
        return self.options[0].refine

    @property
    def intervals(self) -> tuple[int, ...]:
        """Intervals of positive length of each phase."""
        return tuple(int(distinct(mesh.nodes).size - 1) for mesh in self.meshes)

    @property
    def counted(self) -> str:
        """The number of intervals in words."""
        return " + ".join(map(str, self.intervals)) + " intervals"


class Runs(Protocol):
    """How a problem, or several phases, are solved on any mesh."""

    @property
    def statements(self) -> tuple[Statement, ...]:
        """Of each phase."""

    @property
    def progress(self) -> Progress:
        """Of the iterations; a Ctrl-C stops it."""

    def cold(self, options: tuple[Options, ...], least: float) -> Measured:
        """From the problem's own start."""

    def warm(self, options: tuple[Options, ...], start: Measured) -> Measured:
        """From a solution on another mesh."""


def remade(first: Measured, runs: Runs) -> Measured:
    """The mesh whose error is small enough, where that is asked for, and whose limits hold between the nodes.

    Args:
        first: the first mesh and what came of it.
        runs: how the problem is solved on others.

    Returns:
        As `refined` and `held_between`; what was not reached is warned of.
    """
    found = held_between(first, runs) if first.refine is None else refined(first, runs)
    if found.outcome.converged and not runs.progress.stop:
        for extremal, options, mesh in zip(found.extremals, found.options, found.meshes, strict=True):
            passed = worst_between(extremal, found.refine)
            if passed is not None:
                more = more_points(options, mesh)
                reason = "there can be no more of them" if more is None else "with more of them it was not solved"
                where = f" of the phase '{extremal.statement.name}'" if len(found.meshes) > 1 else ""
                mention_between(passed, mesh.points, reason, where)
    return found


def refined(first: Measured, runs: Runs) -> Measured:
    """The mesh whose error is small enough, from a first one; from one with more intervals where that is too coarse.

    Args:
        first: the first mesh and what came of it.
        runs: how the problem is solved on others.

    Returns:
        As `refine_mesh`; where nothing was solved, or nothing measured, an outcome that did not converge.
    """
    found, tried = first, first
    given = any(not (own.grid is None or isinstance(own.grid, Graded)) for own in first.options)
    for doubled in range(DOUBLED + 1):
        if doubled:
            if runs.progress.stop or given:
                break
            more = tuple(replace(own, intervals=2**doubled * own.intervals, grid=None) for own in first.options)
            try:
                tried = runs.cold(more, first.least)
            except CovocpError:  # what the first one lacked is told
                continue
        if tried.outcome.converged:
            found = refine_mesh(tried, runs)
            if found.outcome.converged:
                break
    return found


def refine_mesh(first: Measured, runs: Runs) -> Measured:
    """Meshes made from the local errors of the one before, until the error of one is measured to be small enough.

    Args:
        first: the first mesh with a solution that converged; its error is not known.
        runs: how the problem is solved on others.

    Returns:
        The first mesh whose error is allowed; where none is, the best (a warning says what was reached and why). Among
        its counts are all meshes and their errors.
    """
    allowed = float(first.refine or 0.0)
    done: list[Measured] = []
    known: list[tuple[float, float]] = []
    made = [first.outcome]
    current, reason = first, ""
    while not runs.progress.stop:
        finer, why = _solved(_finer_nodes(current), current, runs, made)
        if finer is None:
            reason = f"the finer mesh that tells the error of {current.counted} was not solved ({why})"
            break
        pairs = zip(current.extremals, finer.extremals, strict=True)
        errors = tuple(local_errors(coarse, fine) for coarse, fine in pairs)
        error = max(current.least, _error(current, finer, errors))
        known += [(current.cost, error), (finer.cost, error)]
        done = [replace(entry, error=_seen(entry, known)) for entry in [*done, replace(current, error=error)]]
        current = done[-1]
        if current.error <= allowed:
            following = _with_more_points(current, runs, made)
            if following is None:
                break
            current, known = following, []  # limits at more points cost more
            continue
        reason = _given_up(done)
        if reason:
            break
        nodes = _next_nodes(runs.statements, current, finer, errors, allowed, _fewest(done))
        if sum(own.size - 1 for own in nodes) > MOST_INTERVALS:
            reason = f"the next mesh would have more than {MOST_INTERVALS} intervals"
            break
        following, _ = _solved(nodes, finer, runs, made)
        current = finer if following is None else following
    return _best(done, first, made, INTERRUPTED if runs.progress.stop else reason)


def held_between(first: Measured, runs: Runs) -> Measured:
    """Limits imposed at more points of the intervals of a mesh, until those that must hold between the nodes do.

    Args:
        first: the mesh with its solution.
        runs: how the problem is solved on others.

    Returns:
        The last mesh that was solved.
    """
    current, made = first, [first.outcome]
    while current.outcome.converged and not runs.progress.stop:
        following = _with_more_points(current, runs, made)
        if following is None:
            break
        current = following
    return replace(current, outcome=replace(current.outcome, stats=_counts(current.outcome, made)))


def _with_more_points(current: Measured, runs: Runs, made: list[AnyOutcome]) -> Measured | None:
    """A solution whose limits are imposed at more points; None where they hold, or there are no more."""
    options = list(current.options)
    for i, (extremal, mesh) in enumerate(zip(current.extremals, current.meshes, strict=True)):
        if worst_between(extremal, current.refine) is not None:
            options[i] = more_points(options[i], mesh) or options[i]
    if all(new is own for new, own in zip(options, current.options, strict=True)):
        return None
    nodes = tuple(distinct(mesh.nodes) for mesh in current.meshes)
    return _solved(nodes, replace(current, options=tuple(options)), runs, made)[0]


def _solved(
    nodes: tuple[Array, ...], start: Measured, runs: Runs, made: list[AnyOutcome]
) -> tuple[Measured | None, str]:
    """A solution on other nodes, not measured; None and the reason where there is none."""
    options = []
    for st, own, other, known in zip(runs.statements, start.options, nodes, start.extremals, strict=True):
        whole = completed(st, other, known.parameters)
        stiff = nominal_along(st, whole, known.columns(), known.mesh.nodes, known.trajectory.duration)
        options.append(replace(own, grid=Graded(nodes=whole, asked=whole.size - 1, nominal=stiff)))
    try:
        found = runs.warm(tuple(options), start)
    except CovocpError as error:
        return None, str(error).partition("\n")[0]
    made.append(found.outcome)
    return (found, "") if found.outcome.converged else (None, found.outcome.message)


def _finer_nodes(measured: Measured) -> tuple[Array, ...]:
    """Nodes of the meshes that tell the error: others between all of them, closer and closer to where controls jump."""
    result = []
    for extremal in measured.extremals:
        nodes, constant = extremal.mesh.nodes, extremal.mesh.control == "constant"
        finer = divided(nodes, extremal.trajectory.u, constant)
        result.append(distinct(finer, _beside_jumps(distinct(nodes), extremal, finer)))
    return tuple(result)


def _beside_jumps(nodes: Array, extremal: Extremal, others: Array) -> Array:
    """Nodes in the intervals beside those in which a control changes much, at distances that grow from their length.

    A jump that has nodes close on both sides and is not quite where it should be costs, in what is long beside it, less
    than a ramp over half of that would: without a node close to it neither mesh would move it, nor tell of it.
    """
    h, span = np.diff(nodes), np.ptp(extremal.controls, axis=0)
    least = CHANGING * np.where(span > 0, span, np.inf)
    inside = extremal.controls_at(nodes[:-1]), extremal.controls_at(nodes[1:], before=True)
    steep = np.any(np.abs(inside[1] - inside[0]) >= least, axis=1)
    if extremal.mesh.control == "constant":  # which jumps at nodes, between two intervals
        jump = np.any(np.abs(np.diff(inside[0], axis=0)) >= least, axis=1)
        steep[1:], steep[:-1] = steep[1:] | jump, steep[:-1] | jump
    added = []
    for k in np.flatnonzero(steep):
        for side, end in ((-1, nodes[k]), (1, nodes[k + 1])):
            beside = k + side
            if 0 <= beside < h.size and not steep[beside]:
                count = int(np.ceil(np.log(max(h[beside] / (2.0 * h[k]), 1.0)) / np.log(GROWING)))
                added.append(end + side * h[k] * GROWING ** np.arange(count))
    result = np.concatenate([np.zeros(0), *added])
    others = np.append(-1.0, others)
    near = np.searchsorted(others, result).clip(1, others.size - 1)
    distance = np.minimum(np.abs(result - others[near]), np.abs(result - others[near - 1]))
    return np.asarray(result[distance > CLOSEST])


def _error(coarse: Measured, fine: Measured, errors: tuple[Array, ...]) -> float:
    """Estimated relative error of the cost of the coarser mesh."""
    change = max(abs(coarse.cost - fine.cost), CANCELLED * float(sum(own.sum() for own in errors)))
    return LEFT * change / max(abs(fine.cost), NO_COST)


def _seen(measured: Measured, known: list[tuple[float, float]]) -> float:
    """Its error, at least what other meshes show of it: costs that are lower by more than their own errors."""
    lower = [(measured.cost - cost) / max(abs(cost), NO_COST) - error for cost, error in known]
    return max(measured.error, *lower)


def _fewest(done: list[Measured]) -> int:
    """Intervals that the next mesh has at least: a coarser one is tried where the last one was much better.

    Local errors that forecast less than is then measured are not trusted with fewer intervals.
    """
    if len(done) < 2:
        return 0
    counts, error = [sum(entry.intervals) for entry in done], done[-1].error
    if error < MUCH_BETTER * done[-2].error:
        return 0
    better = error <= BETTER * min(entry.error for entry in done[:-1])
    return counts[-1] if better else int(np.ceil(MORE * max(counts[-1], counts[-2])))


def _next_nodes(
    statements: tuple[Statement, ...],
    coarse: Measured,
    fine: Measured,
    errors: tuple[Array, ...],
    allowed: float,
    fewest: int,
) -> tuple[Array, ...]:
    """Nodes of meshes whose error should be small enough, all together, with so many intervals at least."""
    cost = max(abs(fine.cost), NO_COST)
    whole = max(AIMED * allowed, BOLD * coarse.error) * cost
    given = []
    for own, finer, error in zip(coarse.meshes, fine.extremals, errors, strict=True):
        given.append((distinct(own.nodes), distinct(finer.mesh.nodes), error, ORDERS[finer.mesh.control]))
    jumps = [_jumps(extremal) for extremal in fine.extremals]
    demands = [demand(*own, found) for own, found in zip(given, jumps, strict=True)]
    total = max(sum(demands), np.finfo(float).tiny)
    for _ in range(SHARPENED):
        nodes = tuple(
            remeshed(*own, whole * share / total, found, np.array(st.instants))
            for own, share, found, st in zip(given, demands, jumps, statements, strict=True)
        )
        if sum(own.size - 1 for own in nodes) >= fewest:
            break
        whole /= 2.0
    return nodes


def _jumps(extremal: Extremal) -> list[Jump]:
    """Jumps of the controls between the instants, at which they may jump; few intervals have nothing beside them."""
    mesh, u = extremal.mesh, extremal.trajectory.u
    found: list[Jump] = []
    constant = mesh.control == "constant"
    for part in stretches(extremal):
        nodes = mesh.nodes[part]
        if len(stretches(extremal)) == 1 or nodes.size - 1 > HIDING + 2:
            found += jumps_of(nodes, u[part.start : part.stop - constant], constant)
    return found


def _given_up(done: list[Measured]) -> str:
    """Why no further mesh is tried; empty where one is."""
    if len(done) >= MOST_MESHES:
        return f"{MOST_MESHES} meshes were tried"
    if done[-1].error <= done[-1].least:
        return "the rest is what the tolerance of the method leaves on every mesh"
    before = [entry.error for entry in done[:-PATIENCE]]
    if before and min(entry.error for entry in done[-PATIENCE:]) > BETTER * min(before):
        further = f"{PATIENCE} further meshes were no better: "
        if min(entry.error for entry in done) <= ABOVE * done[-1].least:
            return f"{further}this is what the tolerance of the method and roundoff leave"
        return f"{further}what is left is not where it is looked for; give more intervals= to begin with, or a grid="
    return ""


def _counts(outcome: AnyOutcome, made: list[AnyOutcome]) -> dict[str, Any]:
    """What is told of an outcome, with the iterations and times of all runs."""
    counts: dict[str, Any] = dict(outcome.stats)
    for name in ("iterations", "build_seconds", "solve_seconds"):
        if all(name in run.stats for run in made):
            counts[name] = sum(run.stats[name] for run in made)
    return counts


def _best(done: list[Measured], first: Measured, made: list[AnyOutcome], reason: str) -> Measured:
    """The mesh to return, with the counts of all runs."""
    allowed = float(first.refine or 0.0)
    best = min(done, key=lambda entry: entry.error) if done else first
    if done and done[-1].error <= allowed:  # the earlier ones may pass limits between the nodes
        best = done[-1]
    if best.error <= allowed:
        reason = ""
    single = len(first.meshes) == 1
    counts = _counts(best.outcome, made) | {
        "refine": allowed,
        "mesh_intervals": tuple(entry.intervals[0] if single else entry.intervals for entry in done),
        "mesh_errors": tuple(float(entry.error) for entry in done),
    }
    outcome = replace(best.outcome, stats=counts)
    if not done:
        message = f"the error of no mesh is known: {reason}"
        return replace(best, outcome=replace(outcome, converged=False, message=message))
    if reason and reason != INTERRUPTED:
        warn_user(
            f"The error asked for was not reached: refine={allowed:.3g} was asked, the cost on {best.counted} "
            f"is off by about {best.error:.2g} (relative), measured on the best of {len(done)} meshes; "
            f"{reason}."
        )
    return replace(best, outcome=outcome)
