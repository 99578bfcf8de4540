"""Entries of the initial state that are free, decisions among them: which move, and in which units they count."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.extremal import Extremal
from covocp.transcription.scales import choose_scales, unvanishing

# Share of the magnitude of a state within which it is at a bound.
AT_BOUND = 1e-5
# An initial state by itself may be curved so many times more than the controls; else its unit is less.
FAR_APART = 1e3
# Share of the curvature of an initial state below which one of the controls is roundoff.
ROUNDOFF = 1e-14


def largest(values: Array) -> Array:
    """Largest magnitude of each column; 1 where it is always zero."""
    found = np.abs(values).max(axis=0, initial=0.0)
    return np.asarray(np.where(found > 0, found, 1.0))


def free_start(extremal: Extremal) -> tuple[int, ...]:
    """Entries of the initial state that are free and not at a bound."""
    st, t = extremal.statement, extremal.trajectory
    free = np.isnan(st.boundary_values(extremal.parameters)[0])
    if not free.any():
        return ()
    lower, upper = st.state_bounds
    room = np.minimum(t.x[0] - lower, upper - t.x[0])
    room = room > AT_BOUND * unvanishing(st, extremal.mesh, t, extremal.parameters, wide=1.0)
    return tuple(np.flatnonzero(free & room).tolist())


def start_weights(extremal: Extremal, start: tuple[int, ...], curved: Callable[[Array], float], moving: int) -> Array:
    """Weights of initial states in a metric int du' du dt, (number,).

    A change of a state by its magnitude counts as one of the controls by theirs over the whole time. Bounds may be far
    away, and tell a magnitude that is too large: then the curvature along the state is far above that along the
    controls, which would be lost beside it, and the weight is more.

    Args:
        extremal: the solution.
        start: entries that move.
        curved: second slope of the Lagrangian along changes of the controls that move and of these entries.
        moving: number of these controls.
    """
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    controls = choose_scales(st, mesh, t, extremal.parameters).u.mean()
    weights = t.duration * (controls / unvanishing(st, mesh, t, extremal.parameters)[list(start)]) ** 2
    along = np.zeros(moving + len(start))
    along[:moving] = 1.0
    most = FAR_APART * abs(curved(along)) / (t.duration * st.nu) if moving else 0.0
    for k in range(len(start)):
        along = np.zeros(moving + len(start))
        along[moving + k] = 1.0
        own = abs(curved(along))
        if most > ROUNDOFF * FAR_APART * own / weights[k]:
            weights[k] = max(weights[k], own / most)
    return np.asarray(weights)
