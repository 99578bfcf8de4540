"""Where a combined design that no run finds is had from the classical one.

A Hessian of limited memory does not see that a long nominal drifts far away where it is steered a little, and creeps;
the deterministic problem has exact second derivatives. Where nominal and statistics separate its optimum is that of the
expected cost, with its multipliers; elsewhere it is another place to start from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from covocp.base.errors import CovocpError
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.residuals import LIMIT
from covocp.extremal.extremal import Guess, Outcome, Prepared
from covocp.extremal.given_controls import evaluate_controls
from covocp.extremal.mesh_error import COARSE_MESH
from covocp.solution.solution import Solution
from covocp.solving.attempts import counted, from_starts, with_stats
from covocp.solving.warm_start import make_guesses
from covocp.statement.separation import quadratic, separates
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.trajectory import Multipliers

# Iterations after which a run that creeps is given up where the classical design is the optimum, and soon had.
SOON = 100
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
    t, mesh = found.extremal.trajectory, prepared.mesh
    if not np.array_equal(found.extremal.mesh.nodes, mesh.nodes) or t.u.shape[0] != mesh.control_nodes:
        return failed, prepared
    around = evaluate_controls(statement, replace(mesh, eliminated=True), t.u, t.duration, values, t.x[0], held=t.x)
    if not around.converged:
        return failed, prepared
    counts = counted(failed, found)
    if separates(statement) and (own := _multipliers(statement, mesh, found)) is not None:
        extremal = replace(around.extremal, multipliers=own)
        told = replace(around, extremal=extremal, message=found.message, violations=found.violations)
        if _is_stationary(told):
            return with_stats(told, **{**failed.stats, **found.stats, **counts}), prepared
    try:
        again = ready()
        outcome = again.solve(values, Guess(trajectory=around.extremal.trajectory, warm=True), reporter)
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved
        return failed, prepared
    counts = counted(failed, outcome)
    return (with_stats(outcome, **counts), again) if outcome.converged else (with_stats(failed, **counts), prepared)


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


def _is_stationary(outcome: Outcome) -> bool:
    """Whether the expected cost is stationary there, too, up to what its steps leave: it is summed up otherwise."""
    optimality = Solution.of(outcome, "ipopt").optimality
    left = max(LIMIT, min(optimality.mesh_error, COARSE_MESH))
    return bool(optimality.stationarity is not None and optimality.stationarity <= left)


def _multipliers(statement: Statement, mesh: Mesh, found: Outcome) -> Multipliers | None:
    """The multipliers of the deterministic problem as those of the expected cost; None where they are of others.

    Those of each interval are the costates, and so are those of segments of several.
    """
    own, other = Multipliers.zero(statement, mesh), found.extremal.multipliers
    shared = {name: getattr(other, name) for name in SHARED}
    alike = all(np.shape(value) == np.shape(getattr(own, name)) for name, value in shared.items())
    if not alike or not mesh.eliminated or other.gaps.shape != (mesh.intervals, statement.nx):
        return None
    return replace(own, **shared, gaps=other.gaps[np.array(mesh.starts[1:]) - 1])
