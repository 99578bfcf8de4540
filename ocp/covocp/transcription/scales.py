"""Magnitudes of states, controls, matrices and time: the units in which a nonlinear program works."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from covocp.base.matrices import Array, half_indices, unpack
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import control_scale, simulate_states
from covocp.transcription.mesh import Mesh
from covocp.transcription.nlp import Scales
from covocp.transcription.steering import quadrature_weights
from covocp.transcription.trajectory import Trajectory

RESPONSE_STEP = 1e-3
# Shooting states are scaled by more than their magnitude where the Hessian is of limited memory: it then learns the
# curvature along the controls first (chain of 9 masses: 15 iterations instead of 21).
STRETCH = 10.0
# Limits below the first and above the second are the units of their rows: solvers meet rows to an absolute tolerance.
SMALL, LARGE = 0.1, 1e3


def limit_units(lower: Array, upper: Array) -> Array:
    """Units of rows between limits: the larger one where it is small or large, else 1."""
    limits = np.abs(np.stack([lower, upper]))
    largest = np.where(np.isfinite(limits), limits, 0.0).max(axis=0)
    return np.where((largest > 0) & ((largest < SMALL) | (largest > LARGE)), largest, 1.0)


def magnitudes(statement: Statement, guess: Trajectory, parameters: Array) -> Scales:
    """Magnitudes from the given scales, bounds, boundary values, standard deviations and the trajectory itself."""
    x0, xf, e0, _ = statement.boundary_values(parameters)
    lower, upper = statement.state_bounds
    candidates = [np.abs(guess.x).max(axis=0, initial=0.0), np.abs(np.nan_to_num(x0)), np.abs(np.nan_to_num(xf))]
    for block in statement.matrices:
        if block.estimation:
            diagonal = np.diagonal(unpack(np.nan_to_num(e0[block.span]), block.size))
            known = min(statement.nx, block.size)  # constants to be chosen are states that nothing estimates
            deviations = np.zeros(statement.nx)
            deviations[:known] = np.sqrt(np.maximum(diagonal[:known], 0.0))
            candidates.append(deviations)
    span = upper - lower
    x = np.max(candidates, axis=0)
    bounded = np.isfinite(span) & (span > 0)
    x = np.where(bounded, np.clip(x, 1e-3 * span, np.where(x > 0, span, np.inf)), x)
    limits = np.where(np.isfinite([lower, upper]), np.abs([lower, upper]), 0.0).max(axis=0)
    alone = np.where(limits > 0, np.minimum(limits, 1.0), 1.0)  # a bound far away says nothing of the state
    x = np.where(x > 0, x, np.where(bounded, span, alone))
    for block in statement.states:
        if block.name in statement.scales:
            x[block.span] = statement.scales[block.name]
    u = np.ones(statement.nu)
    for block in statement.controls:
        u[block.span] = control_scale(statement, block, guess.u[:, block.span])
    return Scales(x=x, u=u, e=_matrix_scales(statement, guess.e), duration=statement.duration.guess)


def choose_scales(statement: Statement, mesh: Mesh, guess: Trajectory, parameters: Array) -> Scales:
    """The magnitudes along a guess; controls without bounds on both sides by what they move as well."""
    scales = magnitudes(statement, guess, parameters)
    u, response = scales.u.copy(), None
    for block in statement.controls:
        bounds = np.concatenate([bound[block.span] for bound in statement.control_bounds])
        if block.name not in statement.scales and not np.isfinite(bounds).all() and not statement.coupled:
            if response is None:
                response = _needed_controls(statement, mesh, guess, scales.x, parameters)
            magnitude = np.abs(guess.u[:, block.span]).max(axis=0, initial=0.0)
            u[block.span] = np.maximum(magnitude, np.where(response[block.span] > 0, response[block.span], 1.0))
    return replace(scales, u=u)


def evened(scales: Scales, mesh: Mesh) -> Scales:
    """For a limited-memory Hessian: equal changes of two control values cost the same, however long the intervals."""
    weights = quadrature_weights(mesh)
    return replace(scales, x=STRETCH * scales.x, u=scales.u * np.sqrt(weights.mean() / weights)[:, None])


def _needed_controls(statement: Statement, mesh: Mesh, guess: Trajectory, scale: Array, parameters: Array) -> Array:
    """Constant changes of each control that move some state by its scale, to first order; 0 where none does."""
    needed = np.zeros(statement.nu)
    base = simulate_states(statement, mesh, guess.x[0], guess.e[0], guess.u, guess.duration, parameters)
    for i in range(statement.nu):
        changed = guess.u.copy()
        step = RESPONSE_STEP * max(1.0, float(np.abs(guess.u[:, i]).max(initial=0.0)))
        changed[:, i] += step
        moved = simulate_states(statement, mesh, guess.x[0], guess.e[0], changed, guess.duration, parameters)
        response = float((np.abs(moved - base).max(axis=0, initial=0.0) / scale).max(initial=0.0)) / step
        needed[i] = 1.0 / response if np.isfinite(response) and response > 0 else 0.0
    return needed


def _matrix_scales(statement: Statement, e: Array) -> Array:
    """sqrt(E_ii E_jj) from the largest diagonal entries along the guess; 1 where these are zero."""
    scales = np.ones(statement.ne)
    for block in statement.matrices:
        rows, columns = half_indices(block.size)
        diagonal = np.abs(e[:, block.span][:, rows == columns]).max(axis=0, initial=0.0)
        diagonal = np.where(diagonal > 0, diagonal, 1.0)
        scales[block.span] = np.sqrt(diagonal[rows]) * np.sqrt(diagonal[columns])
    return scales
