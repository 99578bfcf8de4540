"""Filter and feedback around a nominal that the deterministic cost gives: the classical design."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal, Outcome
from covocp.extremal.given_controls import evaluate_controls, evaluation_mesh
from covocp.extremal.mesh_error import finer_steps
from covocp.solution.origin import Origin
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Options
from covocp.transcription.scales import magnitudes

# A run along the controls of a nominal that leaves it by more than this, in magnitudes of the states, is another one.
DRIFTED = 1e-3
UNSTABLE = (
    "the nominal is so unstable that roundoff of its controls moves a run along them by {:.1e} of the magnitude of a "
    "state; nominal='combined' needs no such run"
)


def closed_around(outcome: Outcome, statement: Statement, options: Options, *, own_steps: bool) -> Outcome:
    """Filter and feedback around the nominal of the deterministic cost.

    Args:
        outcome: of the deterministic problem.
        statement: the problem with its expected cost.
        options: of the mesh.
        own_steps: whether the steps may be shorter than these.
    """
    found = outcome.extremal
    mesh = evaluation_mesh(statement, options, found.parameters)
    t = found.trajectory
    closed = evaluate_controls(statement, mesh, t.u, t.duration, found.parameters, t.x[0])
    moved = drift(found.trajectory.x, closed.extremal)  # by steps of the same length
    while own_steps and closed.converged and (finer := finer_steps(closed.extremal, options)):
        mesh = evaluation_mesh(statement, finer, found.parameters)
        shorter = evaluate_controls(statement, mesh, t.u, t.duration, found.parameters, t.x[0])
        if not shorter.converged:
            break
        closed, options = shorter, finer
    if closed.converged and outcome.converged and not moved <= DRIFTED:
        message = UNSTABLE.format(moved)
        return replace(closed, converged=False, message=message, violations=outcome.violations)
    return replace(
        closed,
        converged=outcome.converged and closed.converged,
        message=f"{outcome.message}: nominal of the deterministic cost, filter and feedback around it",
        violations=outcome.violations,
        stats={**outcome.stats, "origin": Origin.CLASSICAL.value},
    )


def drift(x: Array, run: Extremal) -> float:
    """By how much a run along the controls leaves the states that were found, in their magnitudes."""
    scale = magnitudes(run.statement, replace(run.trajectory, x=x), run.parameters).x
    with np.errstate(over="ignore", invalid="ignore"):
        return float((np.abs(run.trajectory.x - x) / scale).max(initial=0.0))
