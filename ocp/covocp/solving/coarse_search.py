"""Other minima, looked for on a coarse mesh: there a run takes little time, and minima lie as they do on a fine one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from covocp.base.dataclass import dataclass
from covocp.base.errors import CovocpError
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Guess, Outcome, Prepared
from covocp.solving.attempts import cost_of, counted, with_stats
from covocp.solving.coarse_start import thinned
from covocp.solving.other_minima import CHEAPER, OF_STARTS
from covocp.statement.names import name_of
from covocp.statement.statement import Statement
from covocp.transcription.first_guess import is_plain
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.starts import completed
from covocp.transcription.steering import resampled
from covocp.transcription.trajectory import Trajectory

# Intervals of the coarse mesh, and iterations of the run on it from the found controls.
COARSE, PATIENT = 34, 300
# Share of the cost by which another minimum must be cheaper on the coarse mesh, whose own error is no smaller.
WORTH = 1e-3

# An outcome, and the start from which it came.
Found = tuple[Outcome, Guess]


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """What a search for other minima has at hand.

    Attributes:
        prepared: what found the one that there is.
        statement: of the problem.
        options: of its mesh.
        ready: makes the problem ready on the mesh of other `options`, by Ipopt.
        reduced: the same by the reduced method, which gets on where Ipopt stalls beside controls that grow what they
            move.
        guess: what was given as such.
        reporter: of iterations.
        slow: whether the method that ran takes much longer than Ipopt, which then compares on a fine mesh too.
    """

    prepared: Prepared
    statement: Statement
    options: Options
    ready: Callable[..., Prepared]
    reduced: Callable[..., Prepared]
    guess: Given
    reporter: Progress
    slow: bool

    __repr__ = short_repr


def may_be_left(search: Search, found: Found) -> bool:
    """Whether others may be compared with what was found: without limits, and no guess says how a control moves."""
    (outcome, start), guess, statement = found, search.guess, search.statement
    if start.warm or not outcome.converged or search.reporter.limited or search.reporter.stop:
        return False
    given: Mapping[Any, Any] = guess if isinstance(guess, Mapping) else {}
    if guess is not None and not isinstance(guess, Mapping):
        return False
    named = {name_of(key, statement.symbols, tuple(statement.guesses), missing_ok=True) for key in given}
    plain = all(is_plain(statement.guesses[block.name]) for block in statement.controls)
    return plain and not any(block.name in named for block in statement.controls)


def made_coarse(search: Search, outcome: Outcome) -> tuple[Prepared, Outcome] | None:
    """The problem made ready on a coarse mesh, and what the found controls lead to there; None where that fails."""
    fewer = thinned(search.statement, search.options, search.prepared.mesh, outcome.extremal.parameters, COARSE)
    try:
        own = fewer is None and not search.slow
        coarse = search.prepared if own else search.ready(options=fewer or search.options)
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved: the found one counts
        return None
    start = resampled_on(search.statement, coarse.mesh, outcome)
    base = run_from(coarse, outcome.extremal.parameters, start, part(search.reporter, PATIENT))
    return (coarse, base[0]) if base is not None and base[0].converged else None


def made_reduced(search: Search, outcome: Outcome, *, fine: bool = False) -> Prepared | None:
    """The problem made ready for the reduced method on the coarse or fine mesh; None where that cannot take it."""
    options = search.options
    if not fine:
        values = outcome.extremal.parameters
        options = thinned(search.statement, options, search.prepared.mesh, values, COARSE) or options
    try:
        return search.reduced(options=options)
    except (CovocpError, RuntimeError):  # CasADi's
        return None


def solved_finely(search: Search, found: Found, near: Trajectory, mesh: Mesh, told: Mapping[str, Any]) -> Found | None:
    """What a trajectory of the coarse mesh leads to on the mesh itself; None where that is no cheaper than the found.

    Args:
        search: what is at hand.
        found: what is to be left.
        near: the trajectory.
        mesh: that it is on.
        told: of the search, beside the counts of both runs.
    """
    outcome, values = found[0], found[0].extremal.parameters
    u = resampled(near.u, mesh, search.prepared.mesh)
    start = along(search.statement, search.prepared.mesh, values, near, u)
    again = run_from(search.prepared, values, start, search.reporter)
    if again is not None and not again[0].converged and (reduced := made_reduced(search, outcome, fine=True)):
        nearer = run_from(reduced, values, start, search.reporter)
        if nearer is not None and nearer[0].converged:
            again = run_from(search.prepared, values, nearer[0].extremal.trajectory, search.reporter)
    if again is None or not again[0].converged:
        return None
    if cost_of(again[0]) >= cost_of(outcome) - CHEAPER * abs(cost_of(outcome)):
        return None
    before = {name: outcome.stats[name] for name in OF_STARTS if name in outcome.stats}
    return with_stats(again[0], **{**counted(outcome, again[0]), **before, **told}), again[1]


def resampled_on(statement: Statement, mesh: Mesh, outcome: Outcome) -> Trajectory:
    """The trajectory of the found controls on another mesh."""
    extremal = outcome.extremal
    u = resampled(extremal.trajectory.u, extremal.mesh, mesh)
    return along(statement, mesh, extremal.parameters, extremal.trajectory, u)


def along(statement: Statement, mesh: Mesh, values: Array, near: Trajectory, u: Array) -> Trajectory:
    """The trajectory of some controls from where another one begins, in its duration."""
    return completed(statement, mesh, values, u, start=near.x[0], duration=near.duration)


def run_from(prepared: Prepared, values: Array, trajectory: Trajectory, reporter: Progress) -> Found | None:
    """What is found from a trajectory, and the start; None where the model has no values there."""
    start = Guess(trajectory=trajectory)
    try:
        return prepared.solve(values, start, reporter), start
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved: others may be
        return None


def part(reporter: Progress, iterations: int) -> Progress:
    """A part of what is reported, of so many iterations."""
    return Progress("", show=False, iterations=iterations, within=reporter)
