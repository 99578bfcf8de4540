"""Before anything is measured nothing is fed back: the gain as a control has no effect there, the estimate no spread.

Xhat is zero until the first reading and singular until enough was read, whatever the gain is. The limit Xhat >= 0 has
no inside there: its multipliers grow without limit, and where a variance z^2 could pass through z = 0 the barrier keeps
it off. Its dynamics keep Xhat semidefinite by themselves: the limit is left out, and the gain held until it acts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.statement.statement import Statement

if TYPE_CHECKING:
    from covocp.transcription.mesh import Mesh

# The gain among the controls of a loop whose gain is free, and the covariance of the estimate.
GAIN, ESTIMATE = "C", "Xhat"


@dataclass(frozen=True, kw_only=True)
class Unfed:
    """What stands for nothing before the first reading.

    nodes: number of nodes of the mesh until then, that before the reading among them. controls: rows of the control
    that are entries of the gain. matrices: half-vectors of the covariance of the estimate.
    """

    nodes: int
    controls: slice
    matrices: slice


def waits(statement: Statement) -> bool:
    """Whether the gain of a feedback is a control, and all that is measured is read at instants."""
    gain = any(block.name == GAIN for block in statement.controls)
    return gain and statement.loop is not None and not statement.behind and statement.measurement is None


def unfed(statement: Statement, mesh: Mesh, start: Array) -> Unfed | None:
    """The stretch before the first reading where a gain that is a control waits for it; None where there is none.

    Args:
        statement: the problem.
        mesh: with its instants.
        start: half-vectors at time zero, (ne,); NaN where they are free.
    """
    if not waits(statement):
        return None
    gain = next(block.span for block in statement.controls if block.name == GAIN)
    estimate = next(block.span for block in statement.matrices if block.name == ESTIMATE)
    if not (start[estimate] == 0.0).all():
        return None
    read = np.flatnonzero(
        mesh.readings.any(axis=0)
    )  # nowhere where nothing is measured at all, as before a sensor is on
    return Unfed(nodes=int(read[0]) + 1 if read.size else mesh.nodes.size, controls=gain, matrices=estimate)


def hold(own: Unfed, lower: Array, upper: Array) -> None:
    """Hold the gains (in place) at zero, or at what is nearest to it within their bounds.

    Args:
        own: the stretch.
        lower: bounds of the control values, (control values, nu).
        upper: of the same shape.
    """
    early = (slice(0, own.nodes), own.controls)
    lower[early] = upper[early] = np.clip(0.0, lower[early], upper[early])
