"""Starts that are steered to where a cost prefers states to end.

A start that stays where it is sees only how a soft target looks from there: a pendulum that hangs may be left hanging,
a vehicle with its back to its place may not move at all. Which it is hangs on the units of the states, too, of which
nothing tells the magnitude where they start at zero. So runs are steered to the target as to final values, and what
they cost decides: the target need not be met.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from covocp.base.matrices import Array
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import controls_guess, is_plain
from covocp.transcription.led import bends
from covocp.transcription.mesh import Mesh
from covocp.transcription.preferred import wanted_end
from covocp.transcription.ranking import FINE_STEPS, ROUGH_STEPS, distinct, judged, merit, shapes, unsymmetric
from covocp.transcription.starts import (
    PLAIN_MISS,
    First,
    bend_units,
    beside_guesses,
    coarse_mesh,
    completed,
    followed_states,
    told_run,
)
from covocp.transcription.steering import Run, resampled, steer

# Share of its scale by which a state ends beside where the cost prefers it, left to itself, for it to be steered there.
LEFT = 0.3
# Starts of which what comes of them is compared; none that costs so many times what the problem's own start does, or
# goes so many times farther.
COMPARED, DEAR, FARTHER = 2, 10.0, 1e4


def towards_soft_ends(statement: Statement, mesh: Mesh, parameters: Array, own: First) -> Iterator[First]:
    """Starts on the cheapest ways to where the cost prefers states to end; none where one step of steering leads there.

    Args:
        statement: the problem.
        mesh: of it.
        parameters: values (np,).
        own: the problem's own start.

    Yields:
        Rivals of it, the cheapest first. None where a feedback holds it, guesses say how something moves, or of a loop,
        which is led there (`led`).
    """
    plain = all(is_plain(statement.guesses[b.name]) for b in statement.controls) and not followed_states(statement)
    if not plain or own.held or own.unbent is None or statement.loop is not None or not bends(statement):
        return
    coarse = coarse_mesh(statement, mesh, tuple(parameters))
    flat = controls_guess(statement, coarse.nodes, mesh.control, sign=0.0)
    start, e0 = beside_guesses(statement, mesh, parameters)
    run = told_run(statement, coarse, parameters, start)
    end = wanted_end(run, flat[0], e0)
    final = statement.boundary_values(parameters)[1]
    rows = np.flatnonzero(~np.isnan(end))
    fixed, target, soft = tuple(rows.tolist()), end[rows], tuple(rows[np.isnan(final[rows])].tolist())
    run = replace(run, scale=np.maximum(run.scale, np.abs(np.nan_to_num(end))))
    if not _misses(run, flat, list(soft), end):
        return
    if own.plain and steer(run, fixed, target, flat)[1] <= PLAIN_MISS:
        return
    run = replace(run, units=bend_units(run, flat, np.where(np.isnan(end), start, end)[None, :]))
    each = shapes(run, flat, resampled(own.trajectory.u, mesh, coarse))
    best = distinct([judged(run, fixed, target, shape, flat, ROUGH_STEPS, soft) for shape in each])
    best = distinct([*best, *(judged(run, fixed, target, entry.u, flat, FINE_STEPS, soft) for entry in best)])
    bent = (run.clip(unsymmetric(run, entry.u, flat)) for entry in best)
    first = run.clip(resampled(own.trajectory.u, mesh, coarse))
    for u in islice((u for u in bent if _is_no_worse(run, u, first)), COMPARED):
        u = run.clip(resampled(u, coarse, mesh))
        yield First(trajectory=completed(statement, mesh, parameters, u), plain=own.plain, rival=True)


def _is_no_worse(run: Run, u: Array, own: Array) -> bool:
    """Whether a start neither costs far more than the problem's own one nor goes far beyond it and the targets."""
    x, beside = run.states(u), np.abs(run.states(own)).max(axis=0)
    known = np.maximum(run.divisors, np.where(np.isfinite(beside), beside, 0.0))
    if not (np.abs(x).max(axis=0) <= FARTHER * known).all():
        return False
    return merit(run, u)[0] <= DEAR * abs(merit(run, own)[0])


def _misses(run: Run, flat: Array, soft: list[int], end: Array) -> bool:
    """Whether some states, left to themselves, end beside where the cost prefers them."""
    if not soft:
        return False
    left = run.states(flat)[-1]
    return bool(np.isfinite(left).all() and (np.abs(end - left) > LEFT * run.divisors)[soft].any())
