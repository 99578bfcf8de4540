"""Whether the integration steps of a mesh suit other values of the parameters than those that they were chosen for."""

from __future__ import annotations

from dataclasses import replace

from covocp.base.matrices import Array
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.stiffness import fits, resolve_mesh


def suits(statement: Statement, options: Options, mesh: Mesh, parameters: Array) -> bool:
    """Whether the steps of a mesh are as short, and as stable, as those that would be chosen for some parameters.

    Args:
        statement: the problem.
        options: that the mesh was chosen by at first.
        mesh: its present steps may be shorter.
        parameters: their values.

    Raises:
        ProblemError: steps that the user gave diverge for these values.
    """
    if fits(statement, mesh, parameters):
        return True
    if statement.matrices:
        options = replace(options, covariances="eliminated" if mesh.eliminated else "states")
    wanted = resolve_mesh(statement, options, parameters)
    return wanted.substeps <= mesh.substeps and not (wanted.step == "rodas" != mesh.step)
