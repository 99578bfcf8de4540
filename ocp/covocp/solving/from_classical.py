"""Combined designs that are had from the classical one: the optimum where both are one, else another start.

A Hessian of limited memory does not see that a long nominal drifts far away where it is steered a little, and creeps;
the deterministic problem has exact second derivatives. Where nominal and statistics separate its optimum is that of the
expected cost, with its multipliers; where it is the one of a quadratic program besides, no other way is tried first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from covocp.base.errors import CovocpError
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.residuals import LIMIT
from covocp.extremal.coarse_controls import are_steep
from covocp.extremal.extremal import Extremal, Guess, Outcome, Prepared
from covocp.extremal.given_controls import evaluate_controls
from covocp.extremal.links import Within
from covocp.extremal.mesh_error import COARSE_MESH, mesh_error
from covocp.solving.attempts import counted, from_starts, with_stats
from covocp.solving.warm_start import make_guesses
from covocp.statement.separation import quadratic, separates
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.trajectory import Multipliers

# Iterations after which a run that creeps is given up where the classical design is the optimum, and soon had.
SOON = 100
# Stationarity up to which slopes of controls that turn between two nodes are those of the sum on so few of them.
UNRESOLVED = 0.5
# Stationarity of a quadratic cost that is above the least one by a share of 1e-6 or less.
LITTLE = 5e-4
# Complementarity, relative to the cost, up to which bounds of controls are met as exactly as by a run.
EXACT = 1e-7
# Multipliers that both problems have; those of the matrices are the problem's own.
SHARED = ("final", "end", "start", "instants", "path", "states", "controls", "inside_path", "inside_states")


def impatient(statement: Statement) -> bool:
    """Whether a run may be given up soon: the optimum is that of a quadratic program."""
    return separates(statement) and quadratic(statement)


def from_classical(
    failed: Outcome,
    prepared: Prepared,
    ready: Callable[[], Prepared],
    classical: Callable[[], Outcome | None],
    values: Array,
    reporter: Progress,
) -> tuple[Outcome, Prepared]:
    """A run that failed, or what the nominal of the deterministic cost leads to, and what ran.

    Args:
        failed: the run.
        prepared: what ran.
        ready: makes a program for another start.
        classical: the outcome of the deterministic problem; None where there is none.
        values: of the parameters.
        reporter: of iterations.
    """
    statement = failed.extremal.statement
    if failed.converged or reporter.stop or not statement.behind or statement.coupled:
        return failed, prepared
    found = classical()
    if found is None or not found.converged or reporter.stop:
        return failed, prepared
    around = run_around(statement, prepared.mesh, found.extremal, values)
    if around is None:
        return failed, prepared
    if (told := _as_optimum(around, found, strict=False)) is not None:
        return with_stats(told, **{**failed.stats, **found.stats, **counted(failed, found)}), prepared
    try:
        again = ready()
        outcome = again.solve(values, Guess(trajectory=around.extremal.trajectory, warm=True), reporter)
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved
        return failed, prepared
    counts = counted(failed, outcome)
    return (with_stats(outcome, **counts), again) if outcome.converged else (with_stats(failed, **counts), prepared)


def at_classical(
    statement: Statement, mesh: Mesh, found: Outcome | None, values: Array, *, strict: bool
) -> Outcome | None:
    """The optimum of the expected cost where that is the one of a quadratic program; None where it is not had so.

    Args:
        statement: the problem, `impatient`.
        mesh: of the combined design.
        found: the outcome of the deterministic problem; None where there is none.
        values: of the parameters.
        strict: by the sums of the expected cost as exactly as a run would have it.
    """
    if found is None or not found.converged or not mesh.eliminated:
        return None
    around = run_around(statement, mesh, found.extremal, values)
    told = None if around is None else _as_optimum(around, found, strict=strict)
    return None if told is None else with_stats(told, **found.stats)


def run_around(statement: Statement, mesh: Mesh, found: Extremal, values: Array) -> Outcome | None:
    """Filter and feedback around the nominal of the deterministic problem, on the mesh of the combined design."""
    t = found.trajectory
    if not np.array_equal(found.mesh.nodes, mesh.nodes) or t.u.shape[0] != mesh.control_nodes:
        return None
    around = evaluate_controls(statement, replace(mesh, eliminated=True), t.u, t.duration, values, t.x[0], held=t.x)
    return around if around.converged else None


def _as_optimum(around: Outcome, found: Outcome, *, strict: bool) -> Outcome | None:
    """What runs around the nominal as the optimum of the expected cost, where it is stationary."""
    statement, mesh = around.extremal.statement, around.extremal.mesh
    own = shared_multipliers(statement, mesh, found.extremal) if separates(statement) else None
    if own is None:
        return None
    extremal = replace(around.extremal, multipliers=own)
    told = replace(around, extremal=extremal, message=found.message, violations=found.violations)
    return told if is_stationary(extremal, told.cost_terms, strict=strict) else None


def patiently(
    failed: Outcome, prepared: Prepared, ready: Callable[[], Prepared], values: Array, reporter: Progress
) -> tuple[Outcome, Prepared]:
    """A run that was given up soon, where nothing else led on, made again with as many iterations as any other."""
    if failed.converged or reporter.stop:
        return failed, prepared
    prepared = ready()
    guesses = make_guesses(failed.extremal.statement, prepared.mesh, values, None)
    outcome, _ = from_starts(prepared, values, guesses, reporter)
    return with_stats(outcome, **counted(failed, outcome)), prepared


def is_stationary(
    extremal: Extremal, terms: Mapping[str, float], *, strict: bool, within: Within | None = None
) -> bool:
    """Whether the expected cost is stationary there, too, up to what its steps leave: it is summed up otherwise.

    Where no run has come to an end the optimum of a quadratic program counts by its own sum. The cost is quadratic in
    what is left of the slope: above the least one by about the error of the mesh, where the slope is below its root.
    Where controls turn between two nodes both sums have little in common. Either is told.

    Args:
        extremal: around the nominal of the deterministic problem, with its multipliers.
        terms: of its cost.
        strict: as exactly as a run would have it.
        within: what the rest of a chain says of it; None: it is alone.
    """
    from covocp.extremal.optimality import complementarity, stationarity_of  # which few solves need

    error = mesh_error(extremal, terms["running"])
    left = max(LIMIT, min(error, COARSE_MESH))
    if strict:
        left = max(LIMIT, min(float(np.sqrt(error)), LITTLE))
        others = 0.0 if within is None else within.size
        return stationarity_of(extremal, within) <= left and complementarity(extremal, others) <= EXACT
    if impatient(extremal.statement):
        left = max(left, float(np.sqrt(error)), UNRESOLVED if are_steep(extremal) else 0.0)
    return stationarity_of(extremal, within) <= left


def shared_multipliers(statement: Statement, mesh: Mesh, found: Extremal) -> Multipliers | None:
    """The multipliers of the deterministic problem as those of the expected cost; None where they are of others.

    Those of each interval are the costates, and so are those of segments of several.
    """
    own, other = Multipliers.zero(statement, mesh), found.multipliers
    shared = {name: getattr(other, name) for name in SHARED}
    alike = all(np.shape(value) == np.shape(getattr(own, name)) for name, value in shared.items())
    if not alike or not mesh.eliminated or other.gaps.shape != (mesh.intervals, statement.nx):
        return None
    return replace(own, **shared, gaps=other.gaps[np.array(mesh.starts[1:]) - 1])
