"""Meshes that refine themselves: solved, compared with a finer one, and made anew until the error is small enough.

The error of a mesh is measured, not forecast: the problem is solved again, from there, on a mesh with one or two nodes
more in each interval, and the difference of the costs counts. What each interval has to do with it (`local_errors`)
decides where the nodes of the next mesh go.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from covocp.base.errors import CovocpError, ProblemError, warn_user
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal, Guess, Outcome, Prepared
from covocp.extremal.local_errors import local_errors
from covocp.extremal.mesh_error import NO_COST
from covocp.extremal.path_limits import limited_along
from covocp.extremal.readings import stretches
from covocp.solution.solution import Solution
from covocp.solving.attempts import cost_of, from_starts
from covocp.solving.between_nodes import mention_between, more_points, worst_between
from covocp.solving.warm_start import make_guess, make_guesses
from covocp.statement.statement import Statement
from covocp.transcription.grading import graded
from covocp.transcription.instants import completed
from covocp.transcription.mesh import Graded, Mesh, Options
from covocp.transcription.remeshing import HIDING, divided, jumps_of, remeshed
from covocp.transcription.starts import own_start
from covocp.transcription.stiffness import nominal_along, stiffness

# Intervals of the first mesh where none are given, and how often they are doubled where it is not solved.
FIRST, DOUBLED = 16, 2
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
# Tolerance of the method beside that of the mesh, where none is given, and its limits; times its tolerance the error
# that no comparison of meshes shows. The gradient method has one of its own for conditions, which costs are linear in.
SOLVED, LOOSEST, STRICTEST, UNSEEN = 1e-2, 1e-7, 1e-11, 10.0
VIOLATION = "violation_tolerance"
# Length of an interval in times of the nominal above which the first mesh is graded at its ends, and in which ratio.
LONG, LAYER_RATIO = 30.0, 1.7
# Points of an interval at which limits along the path are imposed: with one a control may swing from node to node.
POINTS = 2
# Power of the length with which the error of an interval falls: of controls that are linear, or constant over it.
ORDERS = {"linear": 5, "constant": 3}

INTERRUPTED = "interrupted"


@dataclass(frozen=True, eq=False)
class Runs:
    """How a problem is solved on any mesh.

    Args:
        statement: the problem.
        parameters: of the statement.
        method: its name.
        prepare: makes the method ready for the options of a mesh.
        progress: of the iterations; a Ctrl-C stops it.
    """

    statement: Statement
    parameters: Array
    method: str
    prepare: Callable[[Options], Any]
    progress: Progress

    __repr__ = short_repr

    def cold(self, options: Options, least: float) -> Measured:
        """From the problem's own start."""
        prepared: Prepared = self.prepare(options)
        guesses = first_guesses(options, self.statement, prepared.mesh, self.parameters, None)
        outcome, _ = from_starts(prepared, self.parameters, guesses, self.progress)
        return Measured(options, prepared, outcome, least)

    def warm(self, options: Options, start: Measured) -> Measured:
        """From a solution on another mesh."""
        prepared: Prepared = self.prepare(options)
        solution = Solution.of(start.outcome, self.method)
        guess = make_guess(self.statement, prepared.mesh, self.parameters, solution)
        return Measured(options, prepared, prepared.solve(self.parameters, guess, self.progress), start.least)


@dataclass(frozen=True, eq=False)
class Measured:
    """A mesh with its solution, the estimated relative error of its cost, and what of it no comparison shows."""

    options: Options
    prepared: Prepared
    outcome: Outcome
    least: float
    error: float = np.nan

    __repr__ = short_repr

    @property
    def intervals(self) -> int:
        """Of positive length."""
        return int(np.unique(self.prepared.mesh.nodes).size - 1)


def first_options(statement: Statement, options: Options, nominal: str, points: bool) -> Options:
    """The options of the first mesh: limits are imposed at the middles of the intervals too, where that is possible.

    Raises:
        ProblemError: the nominal is another problem's, whose cost is not the one that would be measured.
    """
    if nominal != "combined":
        raise ProblemError(
            "The option 'refine' does not go with nominal='deterministic'.",
            expected="one of both: the error is that of the cost that is minimised",
            received=f"refine={options.refine!r}, nominal={nominal!r}",
            remedy="leave one of them out, or give a grid=",
        )
    if points and options.points == "auto" and options.substeps == "auto" and limited_along(statement):
        return replace(options, points=POINTS)
    return options


def with_layers(statement: Statement, options: Options, parameters: Array) -> Options:
    """The options with nodes closer and closer to both ends, where the nominal is fast beside an interval.

    What it does over a long time it does at the ends, and begins there within its own time.

    Args:
        statement: the problem.
        options: of the first mesh; a grid that was given stays as it is.
        parameters: of the statement.
    """
    if not (options.grid is None or isinstance(options.grid, Graded)):
        return options
    fast = stiffness(statement, options, parameters).nominal
    if fast <= LONG:
        return options
    nodes = options.nodes()
    longest = float(np.diff(nodes).max())
    layer = longest / fast * LAYER_RATIO ** np.arange(np.ceil(np.log(fast) / np.log(LAYER_RATIO)))
    whole = completed(statement, np.union1d(np.unique(nodes), np.concatenate([layer, 1.0 - layer])))
    known = options.grid.stiffness if isinstance(options.grid, Graded) else None
    return replace(options, grid=Graded(nodes=whole, asked=whole.size - 1, stiffness=known, layered=True))


def first_guesses(
    options: Options, statement: Statement, mesh: Mesh, parameters: Array, guess: Given
) -> Iterator[Guess]:
    """Guesses on the mesh of some options, as `make_guesses`.

    On one with layers the problem's own start comes first, as it is: the others are ranked by runs over the whole time,
    which tell little of a nominal that is fast beside it, and take long.
    """
    if guess is None and isinstance(options.grid, Graded) and options.grid.layered:
        yield Guess(trajectory=own_start(statement, mesh, parameters).trajectory)
    yield from make_guesses(statement, mesh, parameters, guess)


def adapted(known: dict[str, Any], own: dict[str, Any], refine: float) -> dict[str, Any]:
    """The method's own options with tolerances that go with that of the mesh, where none are given.

    Args:
        known: options of the method, with their defaults.
        own: those that are given.
        refine: relative error of the cost that is allowed.
    """
    share = float(np.clip(SOLVED * refine, STRICTEST, LOOSEST))
    if VIOLATION in known:
        return {VIOLATION: share, **own}
    if "plugin" not in known or own.get("plugin", "ipopt") != "ipopt":
        return own
    result = dict(own) if own.get("tolerance") is not None else {**own, "tolerance": share}
    given = dict(own.get("plugin_options") or {})
    # bounds that are passed by a share of themselves make the cost less on every mesh
    inner = {"bound_relax_factor": min(1e-8, SOLVED * refine), **given.get("ipopt", {})}
    return {**result, "plugin_options": {**given, "ipopt": inner}}


def unseen(own: dict[str, Any]) -> float:
    """What the tolerances of the method leave of the cost on every mesh alike, relative."""
    return UNSEEN * float(own.get(VIOLATION) or own.get("tolerance") or LOOSEST)


def remade(first: Measured, runs: Runs) -> Measured:
    """The mesh whose error is small enough, where that is asked for, and whose limits hold between the nodes.

    Args:
        first: the first mesh and what came of it.
        runs: how the problem is solved on others.

    Returns:
        As `refined` and `held_between`; what was not reached is warned of.
    """
    found = held_between(first, runs) if first.options.refine is None else refined(first, runs)
    if found.outcome.converged and not runs.progress.stop:
        passed = worst_between(found.outcome.extremal, found.options.refine)
        if passed is not None:
            more = more_points(found.options, found.prepared.mesh)
            reason = "there can be no more of them" if more is None else "with more of them it was not solved"
            mention_between(passed, found.prepared.mesh.points, reason)
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
    given = not (first.options.grid is None or isinstance(first.options.grid, Graded))
    for doubled in range(DOUBLED + 1):
        if doubled:
            if runs.progress.stop or given:
                break
            options = replace(first.options, intervals=2**doubled * first.options.intervals, grid=None)
            options = graded(runs.statement, options, runs.parameters)
            try:
                tried = runs.cold(with_layers(runs.statement, options, runs.parameters), first.least)
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
    allowed = float(first.options.refine or 0.0)
    done: list[Measured] = []
    made = [first.outcome]
    current, reason = first, ""
    while not runs.progress.stop:
        finer, why = _solved(_finer_nodes(current), current, runs, made)
        if finer is None:
            reason = f"the finer mesh that tells the error of {current.intervals} intervals was not solved ({why})"
            break
        errors = local_errors(current.outcome.extremal, finer.outcome.extremal)
        current = replace(current, error=max(current.least, _error(current.outcome, finer.outcome, errors)))
        done.append(current)
        if current.error <= allowed:
            following = _with_more_points(current, runs, made)
            if following is None:
                break
            current = following
            continue
        reason = _given_up(done)
        if reason:
            break
        nodes = _next_nodes(runs.statement, current, finer, errors, allowed)
        if nodes.size > MOST_INTERVALS + 1:
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


def _with_more_points(current: Measured, runs: Runs, made: list[Outcome]) -> Measured | None:
    """A solution whose limits are imposed at more points; None where they hold, or there are no more."""
    if worst_between(current.outcome.extremal, current.options.refine) is None:
        return None
    options = more_points(current.options, current.prepared.mesh)
    if options is None:
        return None
    return _solved(np.unique(current.prepared.mesh.nodes), replace(current, options=options), runs, made)[0]


def _solved(nodes: Array, start: Measured, runs: Runs, made: list[Outcome]) -> tuple[Measured | None, str]:
    """A solution on other nodes, not measured; None and the reason where there is none."""
    whole = completed(runs.statement, nodes)
    known = start.outcome.extremal
    stiff = nominal_along(runs.statement, whole, known.columns(), known.mesh.nodes, known.trajectory.duration)
    options = replace(start.options, grid=Graded(nodes=whole, asked=whole.size - 1, nominal=stiff))
    try:
        found = runs.warm(options, start)
    except CovocpError as error:
        return None, str(error).partition("\n")[0]
    made.append(found.outcome)
    return (found, "") if found.outcome.converged else (None, found.outcome.message)


def _finer_nodes(measured: Measured) -> Array:
    extremal = measured.outcome.extremal
    mesh = extremal.mesh
    return divided(mesh.nodes, extremal.trajectory.u, mesh.control == "constant")


def _error(coarse: Outcome, fine: Outcome, errors: Array) -> float:
    """Estimated relative error of the cost of the coarser mesh."""
    change = max(abs(cost_of(coarse) - cost_of(fine)), CANCELLED * float(errors.sum()))
    return LEFT * change / max(abs(cost_of(fine)), NO_COST)


def _next_nodes(statement: Statement, coarse: Measured, fine: Measured, errors: Array, allowed: float) -> Array:
    """Nodes of a mesh whose error should be small enough."""
    found = fine.outcome.extremal
    mesh = found.mesh
    cost = max(abs(cost_of(fine.outcome)), NO_COST)
    return remeshed(
        np.unique(coarse.prepared.mesh.nodes),
        np.unique(mesh.nodes),
        errors,
        ORDERS[mesh.control],
        max(AIMED * allowed, BOLD * coarse.error) * cost,
        _jumps(found),
        np.array(statement.instants),
    )


def _jumps(extremal: Extremal) -> list[Any]:
    """Jumps of the controls between the instants, at which they may jump; few intervals have nothing beside them."""
    mesh, u, found = extremal.mesh, extremal.trajectory.u, []
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
        return f"{PATIENCE} further meshes were no better: this is what the tolerance of the method and roundoff leave"
    return ""


def _counts(outcome: Outcome, made: list[Outcome]) -> dict[str, Any]:
    """What is told of an outcome, with the iterations and times of all runs."""
    counts: dict[str, Any] = dict(outcome.stats)
    for name in ("iterations", "build_seconds", "solve_seconds"):
        if all(name in run.stats for run in made):
            counts[name] = sum(run.stats[name] for run in made)
    return counts


def _best(done: list[Measured], first: Measured, made: list[Outcome], reason: str) -> Measured:
    """The mesh to return, with the counts of all runs."""
    allowed = float(first.options.refine or 0.0)
    best = min(done, key=lambda entry: entry.error) if done else first
    if done and done[-1].error <= allowed:  # the earlier ones may pass limits between the nodes
        best = done[-1]
    if best.error <= allowed:
        reason = ""
    counts = _counts(best.outcome, made) | {
        "refine": allowed,
        "mesh_intervals": tuple(entry.intervals for entry in done),
        "mesh_errors": tuple(float(entry.error) for entry in done),
    }
    outcome = replace(best.outcome, stats=counts)
    if not done:
        return replace(
            best, outcome=replace(outcome, converged=False, message=f"the error of no mesh is known: {reason}")
        )
    if reason and reason != INTERRUPTED:
        warn_user(
            f"The error asked for was not reached: refine={allowed:.3g} was asked, the cost on {best.intervals} "
            f"intervals is off by about {best.error:.2g} (relative), measured on the best of {len(done)} meshes; "
            f"{reason}."
        )
    return replace(best, outcome=outcome)
