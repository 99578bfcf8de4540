"""Other excitations of bounded controls, compared on a coarse mesh: what they make known has many minima.

A control that makes unknowns known switches between its bounds, and each number of switches leads to a minimum of its
own: no solver adds one or takes one away. That of the problem's own start is one of them, and may leave a determinant
two thirds larger than that of another. On a coarse mesh a run takes little time, and minima lie as they do on a fine
one: so the found one is compared there with what is found from controls that switch evenly, and left for a better one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from covocp.base.errors import CovocpError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Guess, Merit, Outcome, Prepared
from covocp.solving.attempts import alike, cost_of, counted, merit_of, with_stats
from covocp.solving.coarse_start import thinned
from covocp.solving.other_minima import CHEAPER, OF_STARTS
from covocp.statement.names import name_of
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import is_plain
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.mirrored import learns
from covocp.transcription.starts import completed
from covocp.transcription.steering import resampled
from covocp.transcription.trajectory import Trajectory

# Intervals of the coarse mesh, iterations of a run on it, and of that from the found controls.
COARSE, MOST_ITERATIONS, PATIENT = 34, 100, 300
# Parts of equal length between which the controls switch, and the first value: of both signs where few parts are long.
SWINGS = ((2, 1.0), (2, -1.0), (3, 1.0), (3, -1.0), (4, 1.0), (5, 1.0), (5, -1.0), (8, 1.0))
# Share of the size of the found controls with which those begin: solvers begin within the bounds.
WITHIN = 0.95
# Share of the cost by which another minimum must be cheaper on the coarse mesh, whose own error is no smaller.
WORTH = 1e-3
# So many of those are run on the mesh itself.
MOST_TRIED = 2


def otherwise_excited(
    found: tuple[Outcome, Guess],
    prepared: Prepared,
    statement: Statement,
    options: Options,
    ready: Callable[..., Prepared],
    guess: Given,
    reporter: Progress,
    slow: bool = False,
) -> tuple[Outcome, Guess]:
    """The cheaper minimum of another number of switches, where a problem of unknowns and bounded controls has one.

    Not where iterations or time are limited, nor where a guess says how the controls move.

    Args:
        found: the outcome, and the start from which it came.
        prepared: what ran.
        statement: of the problem.
        options: of its mesh.
        ready: makes the problem ready on the mesh of other `options`, by Ipopt.
        guess: what was given as such.
        reporter: of iterations.
        slow: whether the method that ran takes much longer than Ipopt, which then compares on a fine mesh too.

    Returns:
        The outcome of the cheaper minimum with the iterations of both runs, and its start; else what was given.
    """
    outcome = found[0]
    if not may_be_left(found, statement, guess, reporter) or not has_many_minima(statement):
        return found
    coarse = made_coarse(outcome, prepared, statement, options, ready, slow)
    if coarse is None:
        return found
    values = outcome.extremal.parameters
    for controls in _cheaper(statement, coarse, values, outcome, reporter):
        u = resampled(controls, coarse.mesh, prepared.mesh)
        again = run_from(prepared, values, excited(statement, prepared.mesh, outcome, u), reporter)
        if again is None:
            continue
        other, at = again
        if other.converged and cost_of(other) < cost_of(outcome) - CHEAPER * abs(cost_of(outcome)):
            told = {name: outcome.stats[name] for name in OF_STARTS if name in outcome.stats} | {"excited": True}
            return with_stats(other, **counted(outcome, other), **told), at
    return found


def has_many_minima(statement: Statement) -> bool:
    """Whether the cost asks to know unknowns, and the controls that make them known are all bounded on both sides."""
    unknown = any(block.kind == "unknown" for block in statement.blocks)
    free = statement.loop is None and not statement.behind and not statement.coupled and not statement.decisions
    bounded = statement.nu > 0 and bool(np.isfinite(statement.control_bounds).all())
    return unknown and free and bounded and learns(statement, linked=False)


def may_be_left(found: tuple[Outcome, Guess], statement: Statement, guess: Given, reporter: Progress) -> bool:
    """Whether others may be compared with what was found: without limits, and no guess says how a control moves."""
    outcome, start = found
    if start.warm or not outcome.converged or reporter.limited or reporter.stop:
        return False
    given: Mapping[Any, Any] = guess if isinstance(guess, Mapping) else {}
    if guess is not None and not isinstance(guess, Mapping):
        return False
    named = {name_of(key, statement.symbols, tuple(statement.guesses), missing_ok=True) for key in given}
    plain = all(is_plain(statement.guesses[block.name]) for block in statement.controls)
    return plain and not any(block.name in named for block in statement.controls)


def made_coarse(
    outcome: Outcome,
    prepared: Prepared,
    statement: Statement,
    options: Options,
    ready: Callable[..., Prepared],
    slow: bool,
) -> Prepared | None:
    """The problem made ready on a coarse mesh, by Ipopt; None where that fails.

    Args:
        outcome: found on the mesh itself.
        prepared: what found it: it compares too, where its mesh is hardly finer.
        statement: of the problem.
        options: of its mesh.
        ready: makes the problem ready on the mesh of other `options`.
        slow: whether the method that ran takes much longer than Ipopt, which then compares on a fine mesh too.
    """
    fewer = thinned(statement, options, prepared.mesh, outcome.extremal.parameters, COARSE)
    if fewer is None and not slow:
        return prepared
    try:
        return ready(options=fewer or options)
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved: the found one counts
        return None


def _cheaper(
    statement: Statement, coarse: Prepared, values: Array, outcome: Outcome, reporter: Progress
) -> Iterator[Array]:
    """Controls on the coarse mesh of minima that are cheaper there than the found one, the cheapest first; a few."""
    mesh = coarse.mesh
    own = resampled(outcome.extremal.trajectory.u, outcome.extremal.mesh, mesh)
    base = run_from(coarse, values, excited(statement, mesh, outcome, own), part(reporter, PATIENT))
    if base is None or not base[0].converged:
        return
    seen: list[Merit] = []
    found: list[Outcome] = []
    for controls in _swings(statement, mesh, outcome):
        if reporter.stop:
            return
        trajectory = excited(statement, mesh, outcome, controls)
        merit = merit_of(coarse, values, trajectory)
        if np.isfinite(merit).all() and not any(alike(merit, other, abs(merit.cost)) for other in seen):
            seen.append(merit)
            run = run_from(coarse, values, trajectory, part(reporter, MOST_ITERATIONS))
            found += [] if run is None or not run[0].converged else [run[0]]
    least = cost_of(base[0]) - WORTH * abs(cost_of(base[0]))
    better = sorted((one for one in found if cost_of(one) < least), key=cost_of)
    kept: list[float] = []
    for one in better:
        if all(abs(cost_of(one) - cost) > WORTH * abs(cost) for cost in kept) and len(kept) < MOST_TRIED:
            kept.append(cost_of(one))
            yield one.extremal.trajectory.u


def _swings(statement: Statement, mesh: Mesh, outcome: Outcome) -> Iterator[Array]:
    """Controls that switch evenly, each as often as another one, between what the found ones reach."""
    u = outcome.extremal.trajectory.u
    middle = u.mean(axis=0)
    size = WITHIN * np.abs(u - middle).max(axis=0)
    places = mesh.nodes[: mesh.control_nodes]
    counts = sorted({count for count, _ in SWINGS})
    for count, sign in SWINGS:
        own = [counts[(counts.index(count) + i) % len(counts)] for i in range(statement.nu)]
        waves = [sign * (1.0 - 2.0 * (np.floor(places * one) % 2)) for one in own]
        yield np.clip(middle + size * np.stack(waves, axis=1), *statement.control_bounds)


def excited(statement: Statement, mesh: Mesh, outcome: Outcome, u: Array) -> Trajectory:
    """The trajectory of some controls from where the found one begins."""
    extremal = outcome.extremal
    begin, duration = extremal.trajectory.x[0], extremal.trajectory.duration
    return completed(statement, mesh, extremal.parameters, u, start=begin, duration=duration)


def run_from(
    prepared: Prepared, values: Array, trajectory: Trajectory, reporter: Progress
) -> tuple[Outcome, Guess] | None:
    """What is found from a trajectory, and the start; None where the model has no values there."""
    start = Guess(trajectory=trajectory)
    try:
        return prepared.solve(values, start, reporter), start
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved: others may be
        return None


def part(reporter: Progress, iterations: int) -> Progress:
    """A part of what is reported, of so many iterations."""
    return Progress("", show=False, iterations=iterations, within=reporter)
