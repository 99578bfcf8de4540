"""The steps that a problem needs, by a guess of its trajectory: looked for before the first run."""

from __future__ import annotations

from dataclasses import replace

from covocp.base.matrices import Array
from covocp.extremal import mesh_error, open_loop
from covocp.extremal.extremal import Extremal
from covocp.extremal.mesh_error import MOST_SUBSTEPS, divided, unlike
from covocp.extremal.unseen import changes_within_steps
from covocp.statement.statement import Statement
from covocp.transcription.halved_steps import refined_run
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.trajectory import Multipliers, Trajectory

# What steps that are far too long say is too much: they are looked at again from so many times as many on.
LOOKED_AGAIN = 3.0
# By how much the change shall be smaller than allowed: along a guess, which hardly moves yet, it is less than it will
# be unless the steps are far too long there.
BEFORE = 2.0


def steps_along(
    statement: Statement,
    mesh: Mesh,
    guess: Trajectory,
    parameters: Array,
    options: Options,
    allowed: float,
    *,
    fast_alone: bool,
) -> Options | None:
    """`finer_steps` along a guess, whose matrices are made first: before a run that would be made again.

    Args:
        statement: a problem.
        mesh: of the options.
        guess: states where the segments start, and controls; all states and matrices where these are no result.
        parameters: of the statement.
        options: of the mesh.
        allowed: largest change, relative to the range of each entry.
        fast_alone: whether only what changes within the steps is looked for: a run that misses it may find no way.

    Returns:
        None where the steps are short enough, or cannot be shorter.
    """
    without = Multipliers.zero(statement, mesh)
    start = Extremal(stated=statement, mesh=mesh, trajectory=guess, parameters=parameters, multipliers=without)
    try:
        return _steps_along(start, options, allowed, fast_alone=fast_alone)
    finally:
        mesh_error.forget_runs()
        open_loop.forget_runs()


def _steps_along(start: Extremal, options: Options, allowed: float, *, fast_alone: bool) -> Options | None:
    """What `steps_along` returns."""
    if fast_alone:
        along, gaps = _by_own_steps(start) if changes_within_steps(start) else (start, None)
        return None if gaps is None else unlike(along, options, allowed, gaps)
    found, margin = None, 1.0
    allowed /= BEFORE
    while True:
        along, gaps = _by_own_steps(start)
        finer = divided(along, options, allowed, most=LOOKED_AGAIN, margin=margin, gaps=gaps)
        if finer is None:
            return found
        found, times = finer, int(finer.substeps) / start.mesh.substeps
        if times < LOOKED_AGAIN or int(finer.substeps) >= MOST_SUBSTEPS // 2:
            return found
        options, margin = finer, 1.0 / BEFORE
        start = replace(start, mesh=replace(start.mesh, substeps=int(finer.substeps)))


def _by_own_steps(start: Extremal) -> tuple[Extremal, Array]:
    """A guess with what its own steps make of its states and matrices, and the gaps at the ends of the segments."""
    own = refined_run(start.statement, start.mesh, start.trajectory, start.parameters, parts=1)
    return replace(start, trajectory=replace(start.trajectory, x=own.states, e=own.matrices)), own.jumps
