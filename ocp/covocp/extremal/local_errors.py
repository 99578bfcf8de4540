"""What each interval of a mesh costs: a solution against the one on the mesh with twice as many intervals.

Along the finer solution the Lagrangian is stationary, so what the coarser one loses comes of three things that are
local: its controls have another form (the slope of the Lagrangian half way between both controls, times their
difference), its steps are long (costates times what half of them change), and it passes limits between the points where
they are imposed (their multipliers times that).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from covocp.base.matrices import Array, distinct
from covocp.extremal.costates import discrete_costates
from covocp.extremal.dense_output import dense_output
from covocp.extremal.extremal import Extremal
from covocp.extremal.path_limits import limited
from covocp.transcription.halved_steps import refined_run
from covocp.transcription.mesh import control_places


def local_errors(coarse: Extremal, fine: Extremal) -> Array:
    """Errors of the cost by the intervals of the finer mesh, in units of the cost.

    Args:
        coarse: a solution.
        fine: that on a mesh with more nodes.

    Returns:
        Not negative, (M,); intervals without length are left out.
    """
    ends = distinct(fine.mesh.nodes)
    result = np.zeros(ends.size - 1)
    for places, values in (_of_controls(coarse, fine), _of_limits(coarse, fine), errors_of_steps(coarse)):
        _spread(result, ends, places, np.nan_to_num(np.abs(values), nan=0.0, posinf=0.0))
    return result


def _spread(result: Array, ends: Array, places: Array, values: Array) -> None:
    """Add values at some places to the intervals where they are; at a node half of it to each side."""
    for side in ("left", "right"):
        k = np.clip(np.searchsorted(ends, places, side=side) - 1, 0, result.size - 1)
        np.add.at(result, k, 0.5 * values)


def _of_controls(coarse: Extremal, fine: Extremal) -> tuple[Array, Array]:
    """Of another form of the controls, at the places of the finer ones."""
    mesh, t = fine.mesh, fine.trajectory
    places = control_places(mesh.nodes, mesh.control)
    own = coarse.mesh.nodes
    early = np.append(places[1:] == places[:-1], False)  # before an instant, where controls may jump
    k = np.where(early, np.searchsorted(own, places), np.searchsorted(own, places, side="right")) - 1
    k = np.clip(k, 0, own.size - 2)
    length = own[k + 1] - own[k]
    share = np.where(length > 0, (places - own[k]) / np.where(length > 0, length, 1.0), 0.0)
    given = coarse.control(k, share)
    middle = replace(fine, trajectory=replace(t, u=0.5 * (given + t.u)))
    slopes = discrete_costates(middle)[1]
    # of all controls together: one that moves along an equation between them costs nothing
    return places, np.abs((slopes * (given - t.u)).sum(axis=1))


def _of_limits(coarse: Extremal, fine: Extremal) -> tuple[Array, Array]:
    """Of limits that are passed between the points where the coarser mesh imposes them, at the finer nodes."""
    nodes, m = fine.mesh.nodes, fine.multipliers
    if not limited(fine):
        return nodes[:0], nodes[:0]
    t = coarse.trajectory
    x = dense_output(coarse, matrices=False).at(nodes)[:, : t.x.shape[1]]
    change = (m.states_at_nodes * (x - fine.trajectory.x)).sum(axis=1) if m.states.size else np.zeros(nodes.size)
    return nodes, change


def errors_of_steps(coarse: Extremal) -> tuple[Array, Array]:
    """Of the integration steps, at the middles of the intervals: the change of the Lagrangian by halving them."""
    mesh, t, st = coarse.mesh, coarse.trajectory, coarse.statement
    single = replace(mesh, segments=(1,) * mesh.intervals, points=1)
    whole, halves = (refined_run(st, single, t, coarse.parameters, parts) for parts in (1, 2))
    costates = discrete_costates(coarse)[0]
    weights = np.hstack([costates.state, costates.matrices])[1:]
    count = halves.jumps.shape[1]
    change = halves.costs - whole.costs + (weights[:, :count] * (halves.jumps - whole.jumps)).sum(axis=1)
    if st.matrices and mesh.eliminated:
        moved = np.diff(halves.matrices - whole.matrices, axis=0)
        change = np.abs(change) + np.abs((weights[:, st.nx :] * moved).sum(axis=1))
    return 0.5 * (mesh.nodes[1:] + mesh.nodes[:-1]), change
