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
from covocp.transcription.scales import magnitudes

# So many times what the segments by themselves are off, at most, counts as an error of the steps: of a pendulum that
# swings up a run along the controls makes ten to two hundred times as much.
AMPLIFIED = 300.0
# Share of what costs bend by over the magnitudes of the states below which a cost is nothing, flown or not.
NOTHING = 1e-9
# To these sides of the nodes costs are looked at, and there.
SIDES = (1.0, 0.0, -1.0)


def change_by_bends(extremal: Extremal, finer: Refined, parts: int, cost: float) -> float:
    """By how much one run along the controls with shorter steps costs more than to first order, half to both sides.

    Zero where nothing bends, where a feedback holds the nominal, and where the run diverges: that is told otherwise. Of
    an unstable plant what its segments by themselves are off counts, `AMPLIFIED` times.

    Args:
        extremal: the trajectory.
        finer: its segments run with steps in so many parts.
        parts: of the steps.
        cost: of it.
    """
    st = extremal.statement
    terminal, running = _which(st)
    running = running and len(extremal.mesh.segments) > 1  # of one segment the run itself has what it costs on the way
    if not (terminal or running) or is_fed_back(st):
        return 0.0
    drift = _drift(extremal, finer, parts)
    own = np.cumsum(np.abs(finer.jumps[:, : st.nx]), axis=0)[-1]
    largest = np.abs(drift).max(axis=0)
    if not (np.isfinite(drift).all() and np.isfinite(own).all()):
        return 0.0
    # what an unstable plant makes of the errors of its steps is none of these: `unstable` tells it
    drift = drift * np.minimum(1.0, AMPLIFIED * own / np.where(largest > 0.0, largest, 1.0))
    found = _bends(extremal, drift, terminal=terminal, running=running)
    scales = np.broadcast_to(magnitudes(st, extremal.trajectory, extremal.parameters).x, drift.shape)
    nothing = max(abs(found), abs(cost)) <= NOTHING * _bends(extremal, scales, terminal=terminal, running=running)
    return found if np.isfinite(found) and not nothing else 0.0


def _bends(extremal: Extremal, drift: Array, *, terminal: bool, running: bool) -> float:
    """Half of what moves by the drift to both sides cost more than none."""
    st, t, found = extremal.statement, extremal.trajectory, 0.0
    if terminal:
        others = t.e[-1], t.duration, extremal.parameters
        above, here, below = (float(st.terminal(t.x[-1] + side * drift[-1], *others)) for side in SIDES)
        found += 0.5 * (above + below) - here
    if running:
        _, u, _, *rest = extremal.columns()
        function = mapped(st, "nominal", extremal.mesh.intervals + 1)
        costs = np.array([function.evaluated((t.x + side * drift).T, u, *rest)[1].ravel() for side in SIDES])
        found += float(np.trapezoid(0.5 * (costs[0] + costs[2]) - costs[1], extremal.time))
    return found


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
