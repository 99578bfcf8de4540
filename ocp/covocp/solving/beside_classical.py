"""What a combined design is compared with: the classical one, where that can be run along its controls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal
from covocp.extremal.given_controls import evaluate_controls, evaluation_mesh
from covocp.solution.solution import Solution
from covocp.solving.warm_start import make_guess
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Options
from covocp.transcription.scales import magnitudes
from covocp.transcription.stiffness import stiffness

# A run along the controls of a nominal that leaves it by more than this, in magnitudes of the states, is another one.
DRIFTED = 1e-3
UNSTABLE = (
    "the nominal is so unstable that roundoff of its controls moves a run along them by {:.1e} of the magnitude of a "
    "state; nominal='combined' needs no such run"
)
# Share of the cost of the problem's own guess below which costs differ by the solver's tolerance only: one of slopes,
# so that costs have its square. Nothing else tells the size of a cost whose optimum is zero.
ROUNDOFF = 1e-10
# Relative excess of the cost over the classical design's above which a solution is a spurious stationary point.
WORSE = 1e-6
# Multiple of the error of the mesh up to which an excess may be that of unequal steps: around a given nominal they are
# shorter, and the error is an estimate of the combined design's own.
STEPS = 10.0


def drift(x: Array, run: Extremal) -> float:
    """By how much a run along the controls leaves the states that were found, in their magnitudes."""
    scale = magnitudes(run.statement, replace(run.trajectory, x=x), run.parameters).x
    with np.errstate(over="ignore", invalid="ignore"):
        return float((np.abs(run.trajectory.x - x) / scale).max(initial=0.0))


def is_worse(solution: Solution, classical: float) -> bool:
    """Whether a combined design costs more than the classical one, by more than the mesh leaves open."""
    return bool(solution.cost - classical > (WORSE + solution.mesh_error) * abs(classical))


def left_open(solution: Solution, classical: float) -> bool:
    """Whether a combined design costs more than the classical one on shorter steps, by what these may explain."""
    excess = solution.cost - classical
    return bool(WORSE * abs(classical) < excess <= (WORSE + STEPS * solution.mesh_error) * abs(classical))


def is_roundoff(cost: float, statement: Statement, options: Options, parameters: Array) -> bool:
    """Whether a cost, or a difference of costs, is nothing beside the cost of the problem's own guess.

    Without what that grows by where the nominal is unstable: beside e^(2 a T) everything would be nothing.
    """
    mesh = evaluation_mesh(statement, options, parameters)
    start = make_guess(statement, mesh, parameters, None).trajectory
    outcome = evaluate_controls(statement, mesh, start.u, start.duration, parameters, start.x[0])
    grown = stiffness(statement, options, parameters).growing / float(np.diff(options.nodes()).max())
    return bool(abs(cost) <= ROUNDOFF * np.exp(-2.0 * grown) * abs(sum(outcome.cost_terms.values())))
