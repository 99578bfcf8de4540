"""Whether integration steps are short enough for some values of the parameters: those of the costates, and the given.

The costates take explicit steps of their own, as many as the fastest rate at the start needs. The steps of states and
matrices are those of the mesh, which the user may have given: a run that they mislead must not end with another reason.
"""

from __future__ import annotations

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.statement.statement import Statement
from covocp.transcription.choosing import STABILITY_LIMIT
from covocp.transcription.mesh import STIFFNESS_PER_STEP, Mesh, Options
from covocp.transcription.stiffness import stiffness

LARGEST_PAIRS = 64
# Steps per interval of the backward integration: h times the rate of the costates stays below this. The method ends
# where its own slopes vanish: on a graded mesh steps of 1 (limit 2.78) cost 1e-5, steps of 1/4 1e-8 of the cost.
STIFFNESS_PER_PAIR = 0.25
# h times a decaying rate from which on a step of classical Runge-Kutta damps less the faster it decays: the zero of the
# slope of 1 + z + z^2/2 + z^3/6 + z^4/24.
MISLEADING = 1.596


@dataclass(frozen=True, kw_only=True)
class Lengths:
    """The fastest rates at the start times the longest interval, for some values of the parameters.

    forward: of what takes explicit steps of the mesh; backward: of the costates.
    """

    forward: float
    backward: float

    __repr__ = short_repr

    def pairs(self, mesh: Mesh) -> int:
        """Steps of the costates in an interval."""
        wanted = np.ceil(self.backward / STIFFNESS_PER_PAIR)
        return int(np.clip(wanted, mesh.substeps, max(LARGEST_PAIRS, mesh.substeps)))

    def reason(self, mesh: Mesh, pairs: int) -> str:
        """Why no run with these steps can be trusted, and what to do; "" where they are short enough."""
        if self.forward > MISLEADING * mesh.substeps:
            needed = int(np.ceil(round(self.forward / STIFFNESS_PER_STEP, 6)))
            return (
                "the integration steps are too long for these values of the parameters (the fastest rate at the start "
                f"times the longest interval is {self.forward:.3g}, with substeps={mesh.substeps}): give "
                f"substeps={needed} or more intervals, or leave substeps= 'auto' and make the solver for these values"
            )
        if self.backward > STABILITY_LIMIT * pairs:
            return (
                "the costates are too fast for explicit steps at these values of the parameters (the fastest rate at "
                f"the start times the longest interval is {self.backward:.3g}, with {pairs} steps backward): use more "
                "intervals, or method='ipopt'"
            )
        return ""


def lengths(statement: Statement, mesh: Mesh, options: Options, parameters: Array) -> Lengths:
    """The rates of a problem on its mesh.

    Args:
        statement: the problem.
        mesh: that was resolved from the options.
        options: of the mesh.
        parameters: (np,).

    Raises:
        ProblemError: the model has no value at its start.
    """
    found = stiffness(statement, options, parameters)
    # Covariances by "strang" and "gauss", and implicit steps, stay what they are at any length.
    explicit = {"rodas": 0.0, "rk4": max(found.nominal, found.matrices if statement.ne else 0.0)}
    return Lengths(
        forward=explicit.get(mesh.step, found.nominal),
        backward=max(found.nominal, found.matrices),
    )
