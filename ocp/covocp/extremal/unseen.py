"""Where the model changes with the time within the integration steps faster than these see.

Steps meet the time at regular places, those of half the length at others as regular: whatever has so many periods in
a step that all of them meet it at one place of its period is a constant to both. Here it is met at irregular places.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from covocp.base.matrices import Array
from covocp.extremal.dense_output import mapped
from covocp.extremal.extremal import Extremal
from covocp.statement.interval import repeated
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.trajectory import Trajectory, at_nodes

# Places in a step that no period has in common, fractions of square roots of primes: from one of them to the next what
# has up to 3000 periods in a step turns at least twice, but for a few numbers and phases.
PLACES = np.sort(np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0, 23.0, 29.0, 31.0, 37.0]) % 1.0)
# Turns from which on a step is said to be passed too fast: a kink of a table is one, a jump none, and halves see these.
# Less than the second share of what changes in the step, of the third in any step, and roundoff are no turns.
TURNS, TURN, COUNTS, ROUNDOFF = 2, 0.02, 1e-3, 1e-9


def changes_within_steps(extremal: Extremal) -> bool:
    """Whether rates or running cost, with the time alone, rise and fall and rise again within a step, or the reverse.

    State, control and matrices are held as they are where the interval of a step begins: what is said is nothing of
    how these move, so of stiff plants as well, and needs no more than values of the model.

    Args:
        extremal: a trajectory.
    """
    st, parameters = extremal.statement, tuple(extremal.parameters.tolist())
    return not st.autonomous and _changes(st, extremal.mesh, extremal.trajectory, parameters)


@lru_cache(maxsize=4)
def _changes(statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: tuple[float, ...]) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(turning(_held(statement, mesh, trajectory, np.array(parameters))).any())


def turning(values: Array, least: Array | float = 0.0) -> NDArray[np.bool_]:
    """Which rows of a model rise and fall and rise again in which steps, or the reverse, (steps, rows).

    Args:
        values: at the places in each step, (steps, places, rows); a step without a value there turns nothing.
        least: change of each row in a step below which it is no turn, (rows,), beside what is little anyway.
    """
    turned = np.zeros((values.shape[0], values.shape[2]), dtype=bool)
    with np.errstate(over="ignore", invalid="ignore"):
        known = np.isfinite(values).all(axis=(1, 2))  # a model without a value there: the steps tell
        values = values[known]
        if not values.size:
            return turned
        change = np.ptp(values, axis=1)
        little = np.maximum(COUNTS * change.max(axis=0), ROUNDOFF * np.abs(values).max(axis=(0, 1)))
        steps = np.diff(values, axis=1)
        moves = np.sign(np.where(np.abs(steps) > TURN * change[:, None], steps, 0.0))
    turns, last = np.zeros(change.shape), np.zeros(change.shape)
    for move in moves.swapaxes(0, 1):
        turns += move * last < 0
        last = np.where(move != 0, move, last)
    turned[known] = (turns >= TURNS) & (change > np.maximum(little, least))
    return turned


def _held(statement: Statement, mesh: Mesh, t: Trajectory, parameters: Array) -> Array:
    """Rates and running cost at the places in each step, all but the time held, (steps, places, rows)."""
    nodes = mesh.nodes
    k = np.flatnonzero(np.diff(nodes) > 0.0)
    shares = (np.arange(mesh.substeps)[:, None] + PLACES) / mesh.substeps
    times = t.duration * (nodes[k, None, None] + np.diff(nodes)[k, None, None] * shares)
    each = times[0].size
    at = np.repeat(k, each)
    held = (t.x[at].T, at_nodes(t.u, nodes.size)[at].T, t.e[at].T, times.reshape(1, -1))
    values = np.vstack(mapped(statement.rates, *held, *repeated(t.duration, parameters, at.size)))
    return values.T.reshape(k.size * mesh.substeps, PLACES.size, -1)
