"""Several cheap starts of a solver, ranked before it is called.

Where a problem is not plain (a vehicle that turns, an arm that swings), or its own start runs through an obstacle that
can be passed on two sides, there are several ways, which a solver does not leave once it has begun. So controls of
several shapes and sizes are brought to the final values with little energy, on a coarse mesh, and what they cost
decides; and runs are pushed to the sides of what they run through.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from covocp.base.matrices import Array
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import controls_guess, is_plain
from covocp.transcription.led import led
from covocp.transcription.mesh import Mesh
from covocp.transcription.mirrored import other_sides, sides_of
from covocp.transcription.path_rows import bulges, course, curved_rows
from covocp.transcription.ranking import FINE_STEPS, ROUGH_STEPS, distinct, judged, shapes, unsymmetric
from covocp.transcription.soft_ends import towards_soft_ends
from covocp.transcription.starts import (
    First,
    base_run,
    bend_units,
    beside_guesses,
    coarse_mesh,
    completed,
    followed_states,
    own_start,
    targets,
)
from covocp.transcription.steering import Run, resampled
from covocp.transcription.trajectory import Trajectory

# Intervals of the mesh on which ways round obstacles are looked for.
DETOURS = 40
# Shares of the bend at which to look for what lies between the bent and the unbent run, and the largest that a start
# beside the unbent run keeps, so that it is no symmetric point.
SHARES, KEPT_BEND = (1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4), 1 / 16


def ranked(statement: Statement, mesh: Mesh, parameters: Array, *, linked: bool = False) -> Iterator[First]:
    """Starts, the best first; those after the problem's own are made when they are asked for, unless it is not plain.

    Before them come the ways round what they run through and to where the cost prefers states to end, the cheapest
    first, and a start that is led where a loop shall be: rivals of what comes of the others.
    `linked`: one of several phases.

    Raises:
        ProblemError: where a rate is NaN or inf at the start (says which).
    """
    own = own_start(statement, mesh, parameters)
    free = statement.nu > 0 and not statement.coupled
    if own.plain or not free:
        yield from _rivals(statement, mesh, parameters, own, [], linked=linked) if free else []
        yield replace(own, sides=other_sides(statement, mesh, parameters, own, linked=linked)) if free else own
        if own.held:
            yield own_start(statement, mesh, parameters, hold=False)
        if free:
            yield from _others(_neutral(statement), mesh, parameters, own.trajectory)
        return
    found = list(_others(statement, mesh, parameters, own.trajectory))
    yield from _rivals(statement, mesh, parameters, own, [first.trajectory for first in found], linked=linked)
    if found and own.unbent is not None:
        flat = controls_guess(statement, mesh.nodes, mesh.control, sign=0.0)
        found[0] = replace(
            found[0], sides=sides_of(statement, mesh, parameters, replace(found[0], unbent=flat), linked=linked)
        )
    yield from found or [own]


def _neutral(statement: Statement) -> Statement:
    """The statement without the guesses that say how something moves: where they led nowhere."""
    own = [b for b in (*statement.states, *statement.controls) if b.role == "moving"]
    moving = [b.name for b in own if not is_plain(statement.guesses[b.name])]
    return replace(statement, guesses={**statement.guesses, **dict.fromkeys(moving)}) if moving else statement


def _others(statement: Statement, mesh: Mesh, parameters: Array, own: Trajectory) -> Iterator[First]:
    """Starts of several shapes and sizes, brought to the final values with little energy, the cheapest first."""
    coarse = coarse_mesh(statement, mesh, tuple(parameters))
    flat = controls_guess(statement, coarse.nodes, mesh.control, sign=0.0)
    run = base_run(statement, coarse, parameters, beside_guesses(statement, mesh, parameters)[0], flat)
    run = replace(run, units=bend_units(run, flat))
    fixed, target = targets(run)
    each = shapes(run, flat, resampled(own.u, mesh, coarse))
    best = distinct([judged(run, fixed, target, shape, flat, ROUGH_STEPS) for shape in each])
    if fixed:
        best = distinct([judged(run, fixed, target, entry.u, flat, FINE_STEPS) for entry in best])
    for entry in best:
        u = run.clip(resampled(unsymmetric(run, entry.u, flat), coarse, mesh))
        yield First(trajectory=completed(statement, mesh, parameters, u), plain=False)


def _rivals(
    statement: Statement, mesh: Mesh, parameters: Array, own: First, others: list[Trajectory], *, linked: bool
) -> list[First]:
    """Starts of which what comes of them is compared; one of several phases is not led, nor steered to its soft ends.

    None where a number of the search has no value: the other starts are as good without it.
    """
    found: list[First] = []
    with suppress(np.linalg.LinAlgError, RuntimeError):  # what CasADi raises is a RuntimeError
        found += list(_ways_round(statement, mesh, parameters, own, others))
    with suppress(np.linalg.LinAlgError, RuntimeError):
        found += [] if linked else list(towards_soft_ends(statement, mesh, parameters, own))
    with suppress(np.linalg.LinAlgError, RuntimeError):
        straight = None if linked else led(statement, mesh, parameters, own)
        found += [] if straight is None else [First(trajectory=straight, plain=own.plain, rival=True, alike=True)]
    return found


def _ways_round(
    statement: Statement, mesh: Mesh, parameters: Array, own: First, others: list[Trajectory]
) -> Iterator[First]:
    """Starts on the cheapest ways round what the problem's starts run through; none where they run through nothing.

    Where nothing lies on the bent run and on the unbent one, but between them, the unbent one is a way as well. Starts
    that follow a guess, or that a feedback holds, stay as they are.
    """
    plain = all(is_plain(statement.guesses[b.name]) for b in statement.controls) and not followed_states(statement)
    if not plain or own.held or own.unbent is None or not curved_rows(statement):
        return
    start = beside_guesses(statement, mesh, parameters)[0]
    flat = controls_guess(statement, mesh.nodes, mesh.control, sign=0.0)
    run = base_run(statement, mesh, parameters, start, flat)
    tried = [own.unbent, *(t.u for t in others), own.trajectory.u]
    through = [_runs_through(run, u, own.trajectory.e) for u in tried]
    bend = own.trajectory.u - own.unbent
    if not any(through):
        u, met = _beside(run, own.unbent, bend, own.trajectory.e)
        if met:
            yield First(trajectory=completed(statement, mesh, parameters, u), plain=own.plain, rival=True)
        return
    from covocp.transcription.detours import detours

    roots = tried[:-1] if any(through[:-1]) else tried
    coarse = coarse_mesh(statement, mesh, tuple(parameters), DETOURS)
    least = controls_guess(statement, coarse.nodes, mesh.control, sign=0.0)
    rough = base_run(statement, coarse, parameters, start, least)
    for u, about in detours(rough, *targets(rough), least, [run.clip(resampled(u, mesh, coarse)) for u in roots]):
        alone = np.abs(u - least).max(axis=0) <= np.finfo(float).eps * np.abs(least).max(axis=0)
        u = run.clip(resampled(u, coarse, mesh))
        u = _beside(run, u, np.where(alone, bend, 0.0), own.trajectory.e)[0] if alone.any() else u
        yield First(trajectory=completed(statement, mesh, parameters, u), plain=own.plain, rival=True, about=about)


def _beside(run: Run, u: Array, bend: Array, e: Array) -> tuple[Array, bool]:
    """Controls with a little of a bend, before it runs through anything; whether more of it does."""
    met = next((share for share in SHARES if _runs_through(run, u + share * bend, e)), None)
    return run.clip(u + (KEPT_BEND if met is None else min(KEPT_BEND, 0.5 * met)) * bend), met is not None


def _runs_through(run: Run, u: Array, e: Array) -> bool:
    """Whether a run violates a path condition that may have two sides, with about these half-vectors."""
    along = course(run, u, e)
    if along is None:
        return False
    return any(along.violated[:, row].any() and bulges(along, row) for row in curved_rows(run.statement))
