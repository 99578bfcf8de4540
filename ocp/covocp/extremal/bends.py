"""What costs make of a nominal that drifts off its nodes along the controls, beyond the first order.

At an optimum costs are level: a penalty of 1e6 that is met to six digits has no slope left. Flown with the errors of
the steps it costs what its second derivative makes of them, which no multiplier tells.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal
from covocp.extremal.nodes import mapped
from covocp.extremal.open_loop import is_fed_back, nominal_along
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import KEPT
from covocp.transcription.halved_steps import Refined
from covocp.transcription.nlp import terminal_bends

# To these sides of the nodes costs are looked at, and there.
SIDES = (1.0, 0.0, -1.0)


def change_by_bends(extremal: Extremal, finer: Refined, parts: int) -> float:
    """By how much one run along the controls with shorter steps costs more than to first order, half to both sides.

    Zero where nothing bends, where a feedback holds the nominal, and where the run diverges: that is told otherwise.

    Args:
        extremal: the trajectory.
        finer: its segments run with steps in so many parts.
        parts: of the steps.
    """
    st, t, p = extremal.statement, extremal.trajectory, extremal.parameters
    terminal, running = _which(st)
    running = running and len(extremal.mesh.segments) > 1  # of one segment the run itself has what it costs on the way
    if not (terminal or running) or is_fed_back(st):
        return 0.0
    drift = _drift(extremal, finer, parts)
    if not np.isfinite(drift).all():
        return 0.0
    found = 0.0
    if terminal:
        above, here, below = (float(st.terminal(t.x[-1] + side * drift[-1], t.e[-1], t.duration, p)) for side in SIDES)
        found += 0.5 * (above + below) - here
    if running:
        _, u, _, *others = extremal.columns()
        function = mapped(st, "nominal", extremal.mesh.intervals + 1)
        costs = np.array([function.evaluated((t.x + side * drift).T, u, *others)[1].ravel() for side in SIDES])
        found += float(np.trapezoid(0.5 * (costs[0] + costs[2]) - costs[1], extremal.time))
    return found if np.isfinite(found) else 0.0


def _drift(extremal: Extremal, finer: Refined, parts: int) -> Array:
    """How far the run along the controls is from the nodes, (N + 1, nx)."""
    t = extremal.trajectory
    if len(extremal.mesh.segments) > 1:
        return nominal_along(extremal, parts) - t.x
    drift = finer.states - t.x
    drift[-1] += finer.jumps[-1, : t.x.shape[1]]
    return drift


@lru_cache(maxsize=KEPT)
def _which(statement: Statement) -> tuple[bool, bool]:
    """Whether, by form, the terminal cost bends by the states, and whether the running cost depends on them alone."""
    st = statement
    if st.coupled or st.nominal is None or not st.nx:
        return False, False
    running = not st.running_uses_matrices and st.nominal.jac_sparsity(1, 0).nnz() > 0
    return terminal_bends(st).states, bool(running)
