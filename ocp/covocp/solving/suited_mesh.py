"""Whether a mesh suits other values of the parameters than those that it was made for."""

from __future__ import annotations

from dataclasses import replace

from covocp.base.matrices import Array
from covocp.statement.statement import Statement
from covocp.transcription.choosing import against_elimination
from covocp.transcription.grading import graded
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.stiffness import fits, resolve_mesh

# Share of its nodes by which a mesh that is graded anew must have more to be taken.
MORE_NODES = 0.1


def regraded(statement: Statement, options: Options, present: Options, parameters: Array) -> Options | None:
    """Options with the nodes that a default mesh has for some parameters, where these are clearly more than at present.

    Args:
        statement: whose covariances and gains the mesh is graded for.
        options: before they were graded.
        present: of the present mesh.
        parameters: their values, (np,).
    """
    if options.grid is not None:
        return None
    wanted = graded(statement, options, parameters)
    return wanted if wanted.nodes().size > (1.0 + MORE_NODES) * present.nodes().size else None


def suits(statement: Statement, options: Options, mesh: Mesh, parameters: Array) -> bool:
    """Whether the steps of a mesh are as short, and as stable, as those that would be chosen for some parameters.

    Args:
        statement: the problem.
        options: that the mesh was chosen by at first.
        mesh: its present steps may be shorter.
        parameters: their values, (np,).

    Raises:
        ProblemError: steps that the user gave diverge for these values.
    """
    if fits(statement, mesh, parameters):
        return True
    if statement.matrices and not (mesh.eliminated and against_elimination(statement)):  # that the method asks for
        options = replace(options, covariances="eliminated" if mesh.eliminated else "states")
    if mesh.step == "rodas":  # as many implicit steps as are needed, not as explicit ones would be
        options = replace(options, step="rodas")
    wanted = resolve_mesh(statement, options, parameters)
    return wanted.substeps <= mesh.substeps and not (wanted.step == "rodas" != mesh.step)
