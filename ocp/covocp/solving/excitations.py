"""Other excitations of bounded controls, compared on a coarse mesh: what they make known has many minima.

A control that makes unknowns known switches between its bounds, and each number of switches leads to a minimum of its
own: no solver adds one or takes one away. That of the problem's own start is one of them, and may leave a determinant
two thirds larger than that of another. On a coarse mesh a run takes little time, and minima lie as they do on a fine
one: so the found one is compared there with what is found from controls that switch evenly, and left for a better one.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial

import numpy as np

from covocp.base.matrices import Array
from covocp.extremal.extremal import Merit, Outcome, Prepared
from covocp.solving.attempts import alike, cost_of, merit_of
from covocp.solving.coarse_search import (
    WORTH,
    Found,
    Search,
    along,
    made_coarse,
    made_reduced,
    may_be_left,
    part,
    run_from,
    solved_finely,
)
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.mirrored import learns
from covocp.transcription.trajectory import Trajectory

# Iterations of a run on the coarse mesh.
MOST_ITERATIONS = 100
# Parts of equal length between which the controls switch, and the first value: of both signs where few parts are long.
SWINGS = ((2, 1.0), (2, -1.0), (3, 1.0), (3, -1.0), (4, 1.0), (5, 1.0), (5, -1.0), (8, 1.0))
# Share of the size of the found controls with which those begin: solvers begin within the bounds.
WITHIN = 0.95
# Share of the range of a control that the found one reaches at least where swings between its bounds are no others.
FURTHER = 0.25
# So many of those that are cheaper there are run on the mesh itself.
MOST_TRIED = 2


def otherwise_excited(search: Search, found: Found) -> Found:
    """The cheaper minimum of another number of switches, where a problem of unknowns and bounded controls has one.

    Args:
        search: what is at hand.
        found: the outcome, and the start from which it came.

    Returns:
        The outcome of the cheaper minimum with the iterations of both runs, and its start; else what was given.
    """
    if not has_many_minima(search.statement) or not may_be_left(search, found):
        return found
    compared = made_coarse(search, found[0])
    if compared is None:
        return found
    for near in _cheaper(search, found[0], *compared):
        again = solved_finely(search, found, near, compared[0].mesh, {"excited": True})
        if again is not None:
            return again
    return found


def has_many_minima(statement: Statement) -> bool:
    """Whether the cost asks to know unknowns, and the controls that make them known are all bounded on both sides."""
    unknown = any(block.kind == "unknown" for block in statement.blocks)
    free = statement.loop is None and not statement.behind and not statement.coupled and not statement.decisions
    bounded = statement.nu > 0 and bool(np.isfinite(statement.control_bounds).all())
    return unknown and free and bounded and learns(statement, linked=False)


def _cheaper(search: Search, outcome: Outcome, coarse: Prepared, base: Outcome) -> Iterator[Trajectory]:
    """Minima on the coarse mesh that are cheaper than the found one is there (`base`), the cheapest first; a few."""
    statement, mesh, reporter = search.statement, coarse.mesh, search.reporter
    values, begin = outcome.extremal.parameters, outcome.extremal.trajectory
    seen: list[Merit] = []
    found: list[Outcome] = []
    least, reduced = cost_of(base) - WORTH * abs(cost_of(base)), cache(partial(made_reduced, search, outcome))
    for controls, far in _swings(statement, mesh, begin.u):
        if reporter.stop:
            return
        trajectory = along(statement, mesh, values, begin, controls)
        merit = merit_of(coarse, values, trajectory)
        if not np.isfinite(merit).all() or any(alike(merit, other, abs(merit.cost)) for other in seen):
            continue
        seen.append(merit)
        cheap = merit.cost < least
        if far and not cheap:
            continue
        run = run_from(coarse, values, trajectory, part(reporter, MOST_ITERATIONS))
        if cheap and (run is None or not run[0].converged) and (other := reduced()) is not None:
            run = run_from(other, values, trajectory, part(reporter, MOST_ITERATIONS))
        found += [] if run is None or not run[0].converged else [run[0]]
    better = sorted((one for one in found if cost_of(one) < least), key=cost_of)
    kept: list[float] = []
    for one in better:
        if all(abs(cost_of(one) - cost) > WORTH * abs(cost) for cost in kept) and len(kept) < MOST_TRIED:
            kept.append(cost_of(one))
            yield one.extremal.trajectory


def _swings(statement: Statement, mesh: Mesh, u: Array) -> Iterator[tuple[Array, bool]]:
    """Controls that switch evenly, each as often as another one, between what the found ones (rows, nu) reach.

    Then between the bounds, where that is much further: whether it is so comes with each.
    """
    lower, upper = statement.control_bounds
    middle, places = u.mean(axis=0), mesh.nodes[: mesh.control_nodes]
    reached, counts = np.abs(u - middle).max(axis=0), sorted({count for count, _ in SWINGS})
    ways = [(middle, reached, False)]
    if (reached < FURTHER * (upper - lower)).any():
        ways.append((0.5 * (lower + upper), 0.5 * (upper - lower), True))
    for around, most, far in ways:
        for count, sign in SWINGS:
            own = [counts[(counts.index(count) + i) % len(counts)] for i in range(statement.nu)]
            waves = [sign * (1.0 - 2.0 * (np.floor(places * one) % 2)) for one in own]
            yield np.clip(around + WITHIN * most * np.stack(waves, axis=1), lower, upper), far
