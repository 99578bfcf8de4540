"""Where the model changes with the time within the integration steps faster than these see.

Steps meet the time at regular places, those of half the length at others as regular: whatever has so many periods in
a step that all of them meet it at one place of its period is a constant to both. Here it is met at irregular places.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.dense_output import mapped
from covocp.extremal.extremal import Extremal
from covocp.statement.interval import one_sided, repeated

# Places in a step: multiples of the golden section, whose fractions no period has in common; and where steps look.
PLACES = 8
IRREGULAR = (np.arange(1, PLACES + 1) * (np.sqrt(5.0) - 1) / 2) % 1.0
REGULAR = np.array([one_sided(0.0), 0.5, one_sided(1.0)])
# How far the parabola through where steps look may be off elsewhere, in what changes within the step: 1.4 rad of an
# oscillation are that much. What is less than the second share of the largest change in any step does not count, nor
# roundoff.
PARABOLA, COUNTS, ROUNDOFF = 0.02, 1e-3, 1e-11


def changes_within_steps(extremal: Extremal) -> bool:
    """Whether rates or running cost change with the time alone, within a step, in a way that steps do not see.

    State, control and matrices are held as they are where the interval of a step begins: what is said is nothing of
    how these move, so of stiff plants as well, and needs no more than values of the model.

    Args:
        extremal: a trajectory.
    """
    return not extremal.statement.autonomous and _changes(extremal)


@lru_cache(maxsize=4)
def _changes(extremal: Extremal) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        values = _held(extremal)
        values = values[np.isfinite(values).all(axis=(1, 2))]  # a model without a value there: the steps tell
        if not values.size:
            return False
        change = np.ptp(values, axis=1)
        places = np.append(REGULAR, IRREGULAR)
        seen = np.stack([np.prod([(places - b) / (a - b) for b in REGULAR if b != a], axis=0) for a in REGULAR])
        off = np.abs(values - np.einsum("jp,kjr->kpr", seen, values[:, : REGULAR.size])).max(axis=1)
    least = np.maximum(COUNTS * change.max(axis=0), ROUNDOFF * np.abs(values).max(axis=(0, 1)))
    return bool(((off > PARABOLA * change) & (off > least)).any())


def _held(extremal: Extremal) -> Array:
    """Rates and running cost at the places in each step, all but the time held, (steps, places, rows)."""
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    nodes, places = mesh.nodes, np.append(REGULAR, IRREGULAR)
    k = np.flatnonzero(np.diff(nodes) > 0.0)
    shares = (np.arange(mesh.substeps)[:, None] + places) / mesh.substeps
    times = t.duration * (nodes[k, None, None] + np.diff(nodes)[k, None, None] * shares)
    each = times[0].size
    at = np.repeat(k, each)
    held = (t.x[at].T, extremal.controls[at].T, t.e[at].T, times.reshape(1, -1))
    values = np.vstack(mapped(st.rates, *held, *repeated(t.duration, extremal.parameters, at.size)))
    return values.T.reshape(k.size * mesh.substeps, places.size, -1)
