"""Filter and feedback around a nominal that the deterministic cost gives: the classical design.

One run along its controls is the nominal by whatever steps. An unstable plant leaves it on the way by what roundoff or
shorter steps change: then each interval is run from where the nominal has it, and where filter and feedback need
shorter steps the nominal is solved for again by these.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.extremal.extremal import Outcome
from covocp.extremal.given_controls import (
    DRIFTED,
    drift,
    each_interval,
    evaluate_controls,
    evaluation_mesh,
    gaps_left,
    with_costates,
)
from covocp.extremal.mesh_error import finer_steps, unstable
from covocp.solution.origin import Origin
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Options

UNSTABLE = (
    "the nominal is so unstable that roundoff of its controls moves a run along them by {:.1e} of the magnitude of a "
    "state; nominal='combined' needs no such run"
)

# The nominal by other steps, from where it was found; None where that fails.
Again = Callable[[Options], Outcome | None]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Nominal:
    """A nominal and how filter and feedback are had around it.

    Attributes:
        outcome: of the deterministic problem.
        statement: the problem with its expected cost.
        held: whether its states are held at the nodes.
    """

    outcome: Outcome
    statement: Statement
    held: bool

    __repr__ = short_repr

    def closed(self, options: Options) -> Outcome:
        """Filter and feedback around it, on the mesh of some options."""
        found = self.outcome.extremal
        t, mesh = found.trajectory, evaluation_mesh(self.statement, options, found.parameters)
        given = (t.u, t.duration, found.parameters, t.x[0])
        if not self.held:
            return evaluate_controls(self.statement, mesh, *given)
        closed = evaluate_controls(self.statement, each_interval(mesh), *given, held=t.x)
        gaps = found.multipliers.gaps
        if gaps.shape[0] != t.x.shape[0] - 1:
            return closed
        return with_costates(closed, np.vstack([gaps[:1], gaps])[:, : self.statement.nx])

    def left_by(self, closed: Outcome) -> float:
        """By how much what was run, or the intervals that were run, leave it, in magnitudes of the states."""
        if self.held:
            return gaps_left(closed.extremal)
        return drift(self.outcome.extremal.trajectory.x, closed.extremal)


def closed_around(
    outcome: Outcome, statement: Statement, options: Options, *, own_steps: bool, again: Again
) -> Outcome:
    """Filter and feedback around the nominal of the deterministic cost.

    Args:
        outcome: of the deterministic problem.
        statement: the problem with its expected cost.
        options: of the mesh.
        own_steps: whether the steps may be shorter than these.
        again: solves for the nominal by other steps.
    """
    amplified = not statement.coupled and outcome.converged and unstable(outcome.extremal) is not None
    nominal = _Nominal(outcome=outcome, statement=statement, held=amplified)
    closed = nominal.closed(options)
    if not nominal.held and not statement.coupled and not nominal.left_by(closed) <= DRIFTED:
        nominal = replace(nominal, held=outcome.converged)
        closed = nominal.closed(options)
    while own_steps and closed.converged and (finer := finer_steps(closed.extremal, options)):
        following = _by_finer(nominal, finer, again)
        if following is None:
            break
        shorter = following.closed(finer)
        if not following.held and not following.left_by(shorter) <= DRIFTED:
            nominal = replace(nominal, held=True)  # it is left by shorter steps alone
            closed = nominal.closed(options)
            continue
        if not shorter.converged:
            break
        nominal, closed, options = following, shorter, finer
    return _told(nominal, closed)


def _by_finer(nominal: _Nominal, finer: Options, again: Again) -> _Nominal | None:
    """The nominal that is closed by finer steps: where it is held, solved for by these; None where that fails."""
    if not nominal.held:
        return nominal
    found = again(finer)
    return None if found is None else replace(nominal, outcome=found)


def _told(nominal: _Nominal, closed: Outcome) -> Outcome:
    """Filter and feedback around a nominal with what is to be told of it."""
    outcome, moved = nominal.outcome, nominal.left_by(closed)
    if closed.converged and outcome.converged and not moved <= DRIFTED:
        message = UNSTABLE.format(moved)
        return replace(closed, converged=False, message=message, violations=outcome.violations)
    return replace(
        closed,
        converged=outcome.converged and closed.converged,
        message=f"{outcome.message}: nominal of the deterministic cost, filter and feedback around it",
        violations=outcome.violations,
        stats={**outcome.stats, "origin": Origin.CLASSICAL.value},
    )
