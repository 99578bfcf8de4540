"""Meshes that refine themselves: solved, compared with a finer one, and made anew until the error is small enough.

The error of a mesh is measured, not forecast: the problem is solved again, from there, on a mesh with one or two nodes
more in each interval, and the difference of the costs counts. What each interval has to do with it (`local_errors`)
decides where the nodes of the next mesh go.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from covocp.base.errors import CovocpError, warn_user
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal, Outcome, Prepared
from covocp.extremal.local_errors import local_errors
from covocp.extremal.mesh_error import NO_COST
from covocp.extremal.path_limits import limited_along
from covocp.solving.attempts import cost_of, counted, with_stats
from covocp.statement.statement import Statement
from covocp.transcription.grading import graded
from covocp.transcription.instants import completed
from covocp.transcription.mesh import Graded, Options
from covocp.transcription.remeshing import divided, jumps_of, remeshed

# Intervals of the first mesh where none are given, and how often they are doubled where it is not solved.
FIRST, DOUBLED = 24, 2
# Most meshes, and most intervals of one.
MOST_MESHES, MOST_INTERVALS = 15, 3000
# What the error that is left is, at most, in the change by a finer mesh: a jump of a control whose ramp is half as
# long costs a quarter. Where errors of both signs cancel, this share of their sum counts.
LEFT, CANCELLED = 4 / 3, 0.25
# The next mesh aims at this share of what is allowed.
AIMED = 0.3
# Meshes without a better one among them, after which a tolerance counts as out of reach, and how much better.
PATIENCE, BETTER = 3, 0.7
# Tolerance of the method beside that of the mesh, where none is given, and its limits.
SOLVED, LOOSEST, STRICTEST = 1e-2, 1e-7, 1e-11
# Points of an interval at which limits along the path are imposed: with one a control may swing from node to node.
POINTS = 2
# Power of the length with which the error of an interval falls: of controls that are linear, or constant over it.
ORDERS = {"linear": 5, "constant": 3}

Run = Callable[[Options, Outcome], tuple[Prepared, Outcome]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """A mesh with its solution and the estimated relative error of its cost."""

    options: Options
    prepared: Prepared
    outcome: Outcome
    error: float

    __repr__ = short_repr

    @property
    def intervals(self) -> int:
        """Of positive length."""
        return int(np.unique(self.prepared.mesh.nodes).size - 1)


def first_options(statement: Statement, options: Options, points: bool) -> Options:
    """The options of the first mesh: limits are imposed at the middles of the intervals too, where that is possible."""
    if points and options.points == "auto" and options.substeps == "auto" and limited_along(statement):
        return replace(options, points=POINTS)
    return options


def method_tolerance(known: dict[str, Any], own: dict[str, Any], refine: float) -> dict[str, Any]:
    """The method's own options with a tolerance that goes with that of the mesh, where none is given.

    Args:
        known: options of the method, with their defaults.
        own: those that are given.
        refine: relative error of the cost that is allowed.
    """
    if "tolerance" not in known or own.get("tolerance") is not None or own.get("plugin", "ipopt") != "ipopt":
        return own
    return {**own, "tolerance": float(np.clip(SOLVED * refine, STRICTEST, LOOSEST))}


def solved_first(
    options: Options,
    prepared: Prepared,
    outcome: Outcome,
    statement: Statement,
    parameters: Array,
    cold: Callable[[Options], tuple[Prepared, Outcome]],
) -> Measured:
    """The first mesh; one with more intervals where it was too coarse to be solved.

    Args:
        options, prepared, outcome: of the mesh that was tried first.
        statement: the problem.
        parameters: of the statement.
        cold: solves on a mesh from the problem's own start.
    """
    tried = Measured(options=options, prepared=prepared, outcome=outcome, error=np.nan)
    for doubled in range(1, DOUBLED + 1):
        if tried.outcome.converged or isinstance(options.grid, np.ndarray):
            break
        more = replace(options, intervals=2**doubled * options.intervals, grid=None)
        more = graded(statement, more, parameters)
        prepared, outcome = cold(more)
        tried = Measured(options=more, prepared=prepared, outcome=outcome, error=np.nan)
    return tried


def refine_mesh(first: Measured, statement: Statement, run: Run, reporter: Progress) -> Measured:
    """Meshes made from the local errors of the one before, until the error of one is measured to be small enough.

    Args:
        first: the first mesh with a solution that converged; its error is not known.
        statement: the problem.
        run: solves on a mesh, from an outcome on another.
        reporter: of the progress.

    Returns:
        The first mesh whose error is allowed; where none is, the best (a warning says what was reached and why). Among
        its counts are all meshes and their errors.
    """
    allowed = first.options.refine
    assert allowed is not None
    done: list[Measured] = []
    runs = [first.outcome]
    current, reason = first, ""
    while not reporter.stop:
        finer, why = _solved(statement, _finer_nodes(current), current, run, runs)
        if finer is None:
            reason = f"the finer mesh that tells the error of {current.intervals} intervals was not solved ({why})"
            break
        errors = local_errors(current.outcome.extremal, finer.outcome.extremal)
        current = replace(current, error=_error(current.outcome, finer.outcome, errors))
        done.append(current)
        if current.error <= allowed:
            break
        reason = _given_up(done)
        if reason:
            break
        nodes = _next_nodes(statement, current, finer, errors, allowed)
        if nodes.size > MOST_INTERVALS + 1:
            reason = f"the next mesh would have more than {MOST_INTERVALS} intervals"
            break
        following, _ = _solved(statement, nodes, finer, run, runs)
        current = finer if following is None else following
    return _best(done, first, runs, reason if not reporter.stop else "interrupted")


def _solved(
    statement: Statement, nodes: Array, start: Measured, run: Run, runs: list[Outcome]
) -> tuple[Measured | None, str]:
    """A solution on other nodes, not measured; None and the reason where there is none."""
    whole = completed(statement, nodes)
    options = replace(start.options, grid=Graded(nodes=whole, asked=whole.size - 1))
    try:
        prepared, outcome = run(options, start.outcome)
    except CovocpError as error:
        return None, str(error).partition("\n")[0]
    runs.append(outcome)
    if not outcome.converged:
        return None, outcome.message
    return Measured(options=options, prepared=prepared, outcome=outcome, error=np.nan), ""


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
        AIMED * allowed * cost,
        _jumps(found),
        np.array(statement.instants),
    )


def _jumps(extremal: Extremal) -> list[Any]:
    """Jumps of the controls, on nodes that are there once."""
    mesh, u = extremal.mesh, extremal.trajectory.u
    nodes, last = np.unique(mesh.nodes[::-1], return_index=True)
    kept = mesh.nodes.size - 1 - last  # the last one of those that are there twice
    if mesh.control == "constant":
        return jumps_of(nodes, u[kept[:-1]], True)
    return jumps_of(nodes, u[kept], False)


def _given_up(done: list[Measured]) -> str:
    """Why no further mesh is tried; empty where one is."""
    if len(done) >= MOST_MESHES:
        return f"{MOST_MESHES} meshes were tried"
    before = [entry.error for entry in done[:-PATIENCE]]
    if before and min(entry.error for entry in done[-PATIENCE:]) > BETTER * min(before):
        return f"{PATIENCE} further meshes were no better: this is what the tolerance of the method and roundoff leave"
    return ""


def _best(done: list[Measured], first: Measured, runs: list[Outcome], reason: str) -> Measured:
    """The mesh to return, with the counts of all runs."""
    allowed = first.options.refine
    assert allowed is not None
    best = min(done, key=lambda entry: entry.error) if done else first
    if best.error <= allowed:
        reason = ""
    counts: dict[str, Any] = dict(best.outcome.stats)
    for name in ("iterations", "build_seconds", "solve_seconds"):
        if all(name in run.stats for run in runs):
            counts[name] = sum(run.stats[name] for run in runs)
    counts |= {
        "refine": allowed,
        "mesh_intervals": tuple(entry.intervals for entry in done),
        "mesh_errors": tuple(float(entry.error) for entry in done),
    }
    outcome = replace(best.outcome, stats=counts)
    if not done:
        return replace(best, outcome=replace(outcome, converged=False, message=f"the error of no mesh is known: {reason}"))
    if reason:
        warn_user(
            f"The error asked for was not reached: refine={allowed:.3g} was asked, the cost on {best.intervals} intervals "
            f"is off by about {best.error:.2g} (relative), measured on the best of {len(done)} meshes; {reason}."
        )
    return replace(best, outcome=outcome)
