"""Starts that are led where the nominal of a loop shall be: left to itself it runs past, and there is another minimum.

Filter and feedback around a nominal cost more where it is unstable, so the expected cost has minima that the cost of
the nominal alone has not. From a run that swings by itself a solver finds one that swings; a Van der Pol oscillator
which shall come to rest costs up to 45 % less where it is led straight there and waits on one side.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array
from covocp.statement.interval import model_symbols
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import controls_guess
from covocp.transcription.mesh import Mesh
from covocp.transcription.preferred import wanted_end
from covocp.transcription.starts import First, beside_guesses, completed, controls_along, told_run
from covocp.transcription.trajectory import Trajectory

# A run goes past where a state shall be by more than this share of the way there, or of its size at the ends if more.
PAST = 0.25
# Statements that are kept.
KEPT = 16


def led(statement: Statement, mesh: Mesh, parameters: Array, own: First) -> Trajectory | None:
    """A start along straight lines to where states shall be, of a loop whose own start runs past that.

    Args:
        statement: the problem.
        mesh: of it.
        parameters: values (np,).
        own: the problem's own start.

    Returns:
        None where the start is not left to itself, the nominal is affine, nothing says where it shall be, or it goes
        there by itself.
    """
    if statement.loop is None or own.unbent is None or own.held or not bends(statement):
        return None
    flat = controls_guess(statement, mesh.nodes, mesh.control, sign=0.0)
    start, e0 = beside_guesses(statement, mesh, parameters)
    run = told_run(statement, mesh, parameters, start)
    end = wanted_end(run, flat[0], e0)
    rows = tuple(k for k in statement.moving if np.isfinite(end[k]))
    if not rows or not _runs_past(own.trajectory.x[:, rows], start[list(rows)], end[list(rows)]):
        return None
    path = np.where(np.isfinite(end), start + mesh.nodes[:, None] * (end - start), 0.0)
    u = controls_along(statement, mesh, parameters, rows, path)
    x = completed(statement, mesh, parameters, u).x.copy()
    x[:, rows] = path[:, rows]
    return completed(statement, mesh, parameters, u, x=x) if np.isfinite(x).all() else None


def _runs_past(x: Array, start: Array, end: Array) -> bool:
    """Whether some of the states (nodes, n) leave what lies between both ends (n,); those at zero there have no way."""
    past = np.maximum(np.minimum(start, end) - x, x - np.maximum(start, end)).max(axis=0)
    size = np.maximum(np.abs(end - start), np.maximum(np.abs(start), np.abs(end)))
    return bool(((past > PAST * size) & (size > 0.0)).any())


@lru_cache(maxsize=KEPT)
def bends(statement: Statement) -> bool:
    """Whether the rates of the nominal are not affine in states and controls."""
    if statement.nominal is None:
        return False
    _, _, _, time, duration, p = model_symbols(statement)
    kind: Any = statement.symbolic
    z = kind.sym("z", statement.nx + statement.nu)
    rate = statement.nominal(z[: statement.nx], z[statement.nx :], time, duration, p)[0]
    return any(ca.which_depends(rate, z, 2))
