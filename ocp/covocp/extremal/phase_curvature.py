"""The smallest curvature of one phase of a chain while what passes to and from the others stays as it is.

Such directions are some of those of the whole: where one of them has a negative curvature, the whole has. That none has
says nothing of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.curvature import Curvature, smallest_curvature
from covocp.extremal.extremal import Extremal
from covocp.statement.chain import Link
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import BESIDE, starts
from covocp.transcription.scales import unvanishing

# A decision or an initial state that ended within so many times what it started beside its guess did not go anywhere.
NEAR = 3.0


def curvature_between_links(
    extremals: Sequence[Extremal], links: Sequence[Link], i: int, seconds: float = np.inf
) -> Curvature | None:
    """The smallest curvature of a phase with its ends held; None where nothing can move, or it is not known.

    It is not where covariances pass on to a later phase, whose cost is curved in them, and where deviations do.

    Args:
        extremals: of all phases, within the whole.
        links: between them.
        i: which phase.
        seconds: about as long as it may take.
    """
    extremal = extremals[i]
    before, after = (links[i - 1] if i else None), (links[i] if i < len(links) else None)
    if extremal.statement.loop is not None or (after is not None and (after.matrices or after.weights)):
        return None
    given = () if before is None else before.states
    left = () if after is None else _used(after)
    held = _held(extremal.statement, extremal.trajectory.x, tuple(given), left)
    return smallest_curvature(replace(extremal, stated=held), seconds)


def stayed(extremal: Extremal, link: Link | None) -> bool:
    """Whether a decision of a phase, or an initial state that nothing gives, is about where its guess is."""
    st, mesh, t = extremal.statement, extremal.mesh, extremal.trajectory
    free = np.isnan(st.boundary_values(extremal.parameters)[0])
    if link is not None:
        free[list(link.states)] = False
    if not free.any():
        return False
    guessed = starts(st, mesh, extremal.parameters)[0]
    units = unvanishing(st, mesh, t, extremal.parameters)
    return bool((np.abs(t.x[0] - guessed) <= NEAR * BESIDE * units)[free].any())


def _used(link: Link) -> tuple[int, ...]:
    """States at the end before a link that what it gives is made of."""
    _, columns = link.function.jac_sparsity(0, 0).get_triplet()
    return tuple(sorted(set(columns)))


def _held(statement: Statement, x: Array, first: tuple[int, ...], last: tuple[int, ...]) -> Statement:
    """The statement with some initial and final states prescribed as they are along a trajectory."""
    p = ca.MX.sym("parameters", statement.np)
    initial, final, *others = statement.boundary(p)
    ends = []
    for values, entries, own in ((initial, first, x[0]), (final, last, x[-1])):
        rows = ca.vertsplit(values)
        for k in entries:
            rows[k] = ca.MX(float(own[k]))
        ends.append(ca.vertcat(*rows))
    names = (statement.boundary.name_in(), statement.boundary.name_out())
    return replace(statement, boundary=ca.Function("boundary", [p], [*ends, *others], *names))
