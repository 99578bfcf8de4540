"""What the mesh costs: the change of the cost by halving the integration steps."""

from __future__ import annotations

import numpy as np

from covocp.extremal import Extremal
from covocp.hamiltonian import discrete_costates
from covocp.matrices import Array
from covocp.shooting import refined_run

# Costs below this count as zero: a tracking cost whose optimum is zero is known to roundoff only, and no share of it.
NO_COST = 1e-12


def mesh_error(extremal: Extremal, running: float) -> float:
    """Relative change of the cost by halving the integration steps, to first order.

    Each shooting segment is run again from its start. The jumps at the ends of the segments count with the multipliers
    of the continuity, which are the costates there.

    Args:
        extremal: trajectory and multipliers.
        running: its running cost.

    Returns:
        |change| / max(|cost|, NO_COST); nan where the run is not finite.
    """
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    jumps, refined, last = refined_run(st, mesh, t, extremal.parameters)
    weights = extremal.multipliers.gaps
    if weights.shape != jumps.shape:  # a method without segments
        costates, _, _ = discrete_costates(extremal)
        weights = np.hstack([costates.state, costates.matrices])[list(mesh.starts[1:]), : jumps.shape[1]]
    change = float(np.sum(weights * jumps)) + refined - running
    change += _at_the_end(extremal, last) - _at_the_end(extremal, t.e[-1])
    cost = running + float(st.terminal(t.x[-1], t.e[-1], t.duration, extremal.parameters))
    return abs(change) / max(abs(cost), NO_COST)


def _at_the_end(extremal: Extremal, matrices: Array) -> float:
    """Terminal cost and conditions, with their multipliers, for other half-vectors at the end."""
    st, t, multipliers = extremal.statement, extremal.trajectory, extremal.multipliers
    value = float(st.terminal(t.x[-1], matrices, t.duration, extremal.parameters))
    value += float(multipliers.final_matrices @ matrices)
    if st.end.size:
        arguments = (t.x[-1], extremal.controls[-1], matrices, t.duration, t.duration, extremal.parameters)
        value += float(multipliers.end @ np.asarray(st.end.function(*arguments).full()).ravel())
    return value
