"""A start from a coarser mesh, for gains that act along few directions only.

Where all is read at instants and the gain is a control, the estimate scatters along one direction for each reading, and
on a fine mesh a solver that starts far away follows gains that hardly matter: a wall of a double integrator is not
found on 100 intervals, from its solution on 25 in 25 iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from covocp.base.errors import CovocpError
from covocp.base.expressions import Given
from covocp.base.matrices import Array, distinct
from covocp.base.progress import Progress
from covocp.extremal.extremal import Outcome, Prepared
from covocp.solving.attempts import from_starts
from covocp.solving.warm_start import make_guesses
from covocp.statement.statement import Statement
from covocp.transcription.before_reading import waits
from covocp.transcription.instants import with_instants
from covocp.transcription.mesh import Mesh, Options

# Intervals of the coarse mesh: so many, and so many between two instants; it is worth while from so many times them on.
INTERVALS, BETWEEN, TIMES = 24, 3, 1.5


def coarser(statement: Statement, options: Options, mesh: Mesh, parameters: Array) -> Options | None:
    """The options with a coarser mesh to start from; None where none is needed, or it would hardly be coarser.

    Args:
        statement: the problem.
        options: those of the mesh.
        mesh: with its instants.
        parameters: of the statement.
    """
    return thinned(statement, options, mesh, parameters, INTERVALS) if waits(statement) else None


def thinned(statement: Statement, options: Options, mesh: Mesh, parameters: Array, least: int) -> Options | None:
    """The options with about so many intervals of a mesh, and some between any two instants; None: it has few more.

    Args:
        statement: the problem.
        options: those of the mesh.
        mesh: with its instants.
        parameters: of the statement.
        least: so many intervals.
    """
    nodes = distinct(mesh.nodes)
    places = distinct([0.0, *statement.instants, 1.0])
    enough = max(least, BETWEEN * (places.size - 1))
    if nodes.size - 1 < TIMES * enough:
        return None
    step = int(np.ceil((nodes.size - 1) / enough))
    kept = [nodes[(nodes >= a) & (nodes < b)] for a, b in pairwise(places)]
    chosen = [part[:: min(step, max(1, part.size // BETWEEN))] for part in kept]
    return with_instants(statement, replace(options, grid=distinct(*chosen, [1.0])), parameters)


def from_coarser(
    statement: Statement,
    options: Options,
    mesh: Mesh,
    run: Callable[[Options], Prepared],
    given: tuple[Array, Given, Progress],
) -> Outcome | None:
    """The solution on a coarser mesh; None where none is needed, or none was found.

    Args:
        statement: the problem.
        options: those of the mesh.
        mesh: with its instants.
        run: makes a solver for some options.
        given: values of the parameters, where to start, and who is told.
    """
    values, guess, reporter = given
    fewer = coarser(statement, options, mesh, given[0])
    if fewer is None:
        return None
    try:
        prepared = run(fewer)
        outcome, _ = from_starts(prepared, values, make_guesses(statement, prepared.mesh, values, guess), reporter)
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved: it is a start like others
        return None
    return outcome if outcome.converged else None
