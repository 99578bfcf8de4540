"""Conditions on the covariance X of the closed loop under other statistics than the design's.

The matrices of the trajectory are those of the design, of which its gains are: X by them is what the design believes.
What truly scatters is in the closed loop that was evaluated, at the nodes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from covocp.base.matrices import Array, pack
from covocp.extremal.closed_loop import ClosedLoop
from covocp.extremal.extremal import Extremal
from covocp.extremal.path_limits import NOTED, Passed, finite_sizes, limit_sizes
from covocp.statement.conditions import Conditions, beyond
from covocp.statement.statement import Statement


def scattered(loop: ClosedLoop) -> Array:
    """Half-vectors of the covariance X of states, unknowns and controls at the nodes, (K, entries)."""
    C, Ct = loop.gain, loop.gain.transpose(0, 2, 1)
    crossed = (loop.Xhat - loop.Z) @ Ct  # <d y'> C' of the deviation d = y - e; the control deviates by -C y
    fed = C @ loop.Xhat @ Ct
    return pack(np.concatenate([np.dstack([loop.X, -crossed]), np.dstack([-crossed.transpose(0, 2, 1), fed])], axis=1))


def spread_names(statement: Statement) -> frozenset[str]:
    """Names of the rows that contain X."""
    return frozenset(rows.names[k] for rows in statement.conditions for k in _rows(rows))


def passed_by_spread(extremal: Extremal, loop: ClosedLoop, *, path: bool = False) -> tuple[Passed, ...]:
    """Conditions on X that the covariances of a loop do not meet at the nodes, the worst first.

    Args:
        extremal: the nominal.
        loop: along it.
        path: whether those along the path alone are looked at.

    Returns:
        Those that are passed by more than the steps of two integrators are apart.
    """
    st, joint = extremal.statement, scattered(loop)
    everything = np.arange(extremal.mesh.nodes.size)
    looked: list[tuple[Conditions, Any]] = [(st.path, everything)]
    if not path:
        looked += [(st.start, everything[:1]), (st.end, everything[-1:])]
        places = st.inside.nodes_among(extremal.mesh.nodes) if st.inside.size else []
        looked += [(part.conditions, everything[k : k + 1]) for part, k in zip(st.inside.parts, places, strict=True)]
    found = [entry for rows, nodes in looked for entry in _passed(extremal, joint, rows, nodes)]
    return tuple(sorted(found, key=lambda entry: -entry.share))


def _rows(rows: Conditions) -> list[int]:
    """Which rows contain X."""
    if rows.scattered is None:
        return []
    return sorted(set(rows.scattered.jac_sparsity(0, rows.scattered.n_in() - 1).get_triplet()[0]))


def _passed(extremal: Extremal, joint: Array, rows: Conditions, nodes: Array) -> list[Passed]:
    """The rows of one place that are passed."""
    chosen = _rows(rows)
    if not chosen:
        return []
    assert rows.scattered is not None
    columns = [np.asarray(column)[:, nodes] for column in extremal.columns()]
    values = np.asarray(rows.scattered.map(nodes.size)(*columns, joint[nodes].T).full())[chosen].T
    lower, upper = rows.lower[chosen], rows.upper[chosen]
    sizes = limit_sizes(lower, upper, finite_sizes(values)).min(axis=0)
    excess = beyond(values, lower, upper)
    worst = excess.argmax(axis=0)
    return [
        Passed(
            name=rows.names[row],
            by=float(excess[worst[i], i]),
            share=float(excess[worst[i], i] / sizes[i]),
            time=float(extremal.time[nodes[worst[i]]]),
        )
        for i, row in enumerate(chosen)
        if excess[worst[i], i] > NOTED * sizes[i]
    ]
