"""One run along the controls from the start to the end: what an unstable plant makes of small errors of its steps.

Shooting segments begin at nodes of their own. Along the controls alone nothing begins anew: what the steps of a segment
are off grows with the plant through all that follow.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Extremal
from covocp.statement.statement import Statement
from covocp.transcription.halved_steps import Refined, in_one_segment, refined_run, refined_states
from covocp.transcription.mesh import Mesh
from covocp.transcription.trajectory import Trajectory

# A plant amplifies where the nodes are left by so many times what all segments by themselves are off, and by no less
# than a share of the range of an entry: what it amplifies then changes the cost by the square as well.
AMPLIFIES, SEEN = 4.0, 1e-4


@dataclass(frozen=True, kw_only=True)
class Departure:
    """By how much one run along the controls, with half the steps, leaves the nodes.

    Attributes:
        states: largest distance of each state, (nx,); inf where the run diverges.
        matrices: of each half-vector, (ne,); None where the plant amplifies nothing, unless that is asked for.
        end: distance of each half-vector at the end, likewise.
        cost: of the run; None where the plant amplifies nothing.
    """

    states: Array
    matrices: Array | None
    end: Array | None
    cost: float | None

    __repr__ = short_repr


def departure(extremal: Extremal, by_segments: Array, size: Array, *, matrices: bool = False) -> Departure | None:
    """How one run along the controls leaves the nodes; None where that says nothing new.

    It does not with one segment, or where a feedback holds the nominal: then the controls are not flown alone.

    Args:
        extremal: the trajectory.
        by_segments: what the segments by themselves are off, all together, of each state, (nx,).
        size: ranges of the states, (nx,).
        matrices: whether these are asked for where the plant amplifies nothing, too: they pass along a nominal that
            drifts all the way, and at the end they are to be known to what is left of them.
    """
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    if len(mesh.segments) == 1 or not st.nx or is_fed_back(st):
        return None
    parameters = tuple(extremal.parameters.tolist())
    with np.errstate(over="ignore", invalid="ignore"):
        whole = _whole(st, mesh, t, parameters) if st.coupled else None
        x = nominal_along(extremal) if whole is None else whole.states
        states = _largest(x - t.x)
        amplified = bool((states > np.maximum(AMPLIFIES * by_segments, SEEN * size)).any())
        if not amplified and not (matrices and st.ne):
            return Departure(states=states, matrices=None, end=None, cost=None)
        whole = _whole(st, mesh, t, parameters) if whole is None else whole
        end = float(st.terminal(whole.states[-1], whole.matrices[-1], t.duration, extremal.parameters))
    left = whole.matrices - t.e
    cost = whole.running + end if amplified else None
    return Departure(states=states, matrices=_largest(left), end=_largest(left[-1:]), cost=cost)


def is_fed_back(statement: Statement) -> bool:
    """Whether a feedback around the nominal is part of the statement."""
    return statement.loop is not None or bool(statement.behind) or statement.fed


def nominal_along(extremal: Extremal, parts: int = 2) -> Array:
    """States at the nodes of one run along the controls with shorter steps, (N + 1, nx), of an uncoupled problem."""
    return _nominal(extremal.statement, extremal.mesh, extremal.trajectory, tuple(extremal.parameters.tolist()), parts)


@lru_cache(maxsize=2)
def _nominal(
    statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: tuple[float, ...], parts: int
) -> Array:
    return refined_states(statement, mesh, trajectory, np.array(parameters), parts)


def matrices_along_controls(extremal: Extremal) -> Array:
    """Half-vectors at the nodes of one run along the controls with half the steps, (N + 1, ne)."""
    return _whole(extremal.statement, extremal.mesh, extremal.trajectory, tuple(extremal.parameters.tolist())).matrices


@lru_cache(maxsize=2)
def _whole(statement: Statement, mesh: Mesh, trajectory: Trajectory, parameters: tuple[float, ...]) -> Refined:
    run = refined_run(statement, in_one_segment(mesh), trajectory, np.array(parameters))
    # at the end it has what is given there; the run itself ends a gap away from that
    states, matrices, gap = run.states.copy(), run.matrices.copy(), run.jumps[-1]
    states[-1] += gap[: statement.nx]
    if gap.size > statement.nx:
        matrices[-1] += gap[statement.nx :]
    return replace(run, states=states, matrices=matrices)


def forget_runs() -> None:
    """Forget what is remembered of trajectories that are asked for no more."""
    for remembered in (_nominal, _whole):
        remembered.cache_clear()


def _largest(change: Array) -> Array:
    """Largest change of each entry; inf where one is no number."""
    return np.asarray(np.nan_to_num(np.abs(change).max(axis=0, initial=0.0), nan=np.inf, posinf=np.inf))
