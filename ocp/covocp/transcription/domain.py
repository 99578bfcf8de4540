"""Whether a model holds beyond its bounds, as far as an interior-point solver widens them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from covocp.base.matrices import Array
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import control_scale, controls_guess
from covocp.transcription.mesh import Mesh

# By how much Ipopt widens bounds, of their size or of the scale of the variable.
WIDENED = 1e-8
# Points at which the model was asked that are remembered.
REMEMBERED = 256


def needs_exact_bounds(statement: Statement, mesh: Mesh, start: Array, e0: Array, parameters: Array) -> bool:
    """Whether a density is none, or a rate no number, where bounds are widened by Ipopt's share.

    The bounds of each control and state are passed one at a time, and all together.

    Args:
        statement: the problem.
        mesh: its nodes and kind of control count.
        start: initial state, (nx,).
        e0: initial half-vectors, (ne,).
        parameters: of the statement.
    """
    u = controls_guess(statement, mesh.nodes, mesh.control)
    scales = np.concatenate(
        [np.zeros(0), *(control_scale(statement, b, u[:, b.span]) for b in statement.controls), np.ones(statement.nx)]
    )
    point = np.concatenate([u.mean(axis=0), start])
    for side, bounds in ((-1.0, 0), (1.0, 1)):
        limit = np.concatenate([statement.control_bounds[bounds], statement.state_bounds[bounds]])
        passed = limit + side * WIDENED * np.maximum(np.abs(limit), scales)
        bounded = np.flatnonzero(np.isfinite(limit))
        for entries in (*bounded[:, None], bounded):
            beyond = point.copy()
            beyond[entries] = passed[entries]
            numbers = (beyond[statement.nu :], beyond[: statement.nu], e0, parameters)
            if entries.size and not _holds(statement, *(values.tobytes() for values in numbers)):
                return True
    return False


@lru_cache(maxsize=REMEMBERED)
def _holds(statement: Statement, *numbers: bytes) -> bool:
    """`holds` at a point given by its bytes: all meshes of a problem ask at the same ones."""
    return holds(statement, *(np.frombuffer(values) for values in numbers))


def holds(statement: Statement, x: Array, u: Array, e: Array, parameters: Array) -> bool:
    """Whether rates, costs and conditions are numbers at a point, and the noises densities."""
    duration = statement.duration.guess
    nominal, whole = (x, u, 0.0, duration, parameters), (x, u, e, 0.0, duration, parameters)
    values = [*statement.rates(*whole), statement.path.function(*whole)]
    if not all(np.isfinite(value.full()).all() for value in values):
        return False
    if statement.information is not None and statement.information(*nominal).full().min() < 0.0:
        return False
    densities = []
    if statement.measurement is not None:
        U = np.asarray(statement.measurement(*nominal)[2].full())
        if not np.isfinite(U).all() or np.linalg.eigvalsh(U)[0] <= 0.0:
            return False
    for block, form in zip(statement.matrices, statement.riccati, strict=True):
        if block.estimation and form is not None:
            densities.append(np.asarray(form(*nominal)[1].full()))
    return all(np.linalg.eigvalsh(Q)[0] >= -(WIDENED**2) * np.abs(Q).max() for Q in densities if Q.size)
