"""A start with multipliers for a gain that is optimised, from the solution with the best gain.

Conditions on X that the best gain keeps do not act: it is the optimum with them, too, with its multipliers, and none of
theirs. From a start without multipliers a solver finds that point within a few steps and leaves it again: where the
estimate scatters little, as at the start and along what is known exactly, gains count for less than its tolerance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from covocp.base.errors import CovocpError
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.costates import discrete_costates
from covocp.extremal.extremal import Extremal, Guess, Outcome, Prepared
from covocp.extremal.fine_mesh import refined
from covocp.extremal.given_controls import missed
from covocp.solution.solution import Solution
from covocp.solving.gain_start import free_gain_block
from covocp.solving.warm_start import make_guess
from covocp.statement.conditions import Conditions
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.trajectory import Multipliers

# Iterations within which a run from the best gain with its multipliers finds its way, mostly in fewer than 30.
PATIENCE = 60
# The cost with conditions on X is no less than that without, but for other minima: so far below, as a share of it.
BELOW = 0.5
# Share by which costs differ where a best gain, which acts at every step, becomes one that is straight between nodes;
# and share of the range of a state within which the nominal is the same then.
SAME_COST, SAME_STATE = 1e-3, 1e-4


def from_best(
    statement: Statement,
    prepared: Prepared,
    parameters: Array,
    best: Solution,
    reporter: Progress,
    *,
    further: bool,
    own: bool,
) -> tuple[Outcome, Guess, bool] | None:
    """The outcome from a solution with the best gain and its multipliers; None where they lead nowhere.

    Args:
        statement: the problem, whose gain is optimised.
        prepared: made ready.
        parameters: of the statement.
        best: solution with the best gain, perhaps with more or fewer conditions.
        reporter: of iterations.
        further: whether it is a start, too, where it does not keep the conditions.
        own: whether it is one of this problem; one that was given may be of another that has its names.

    Returns:
        The outcome, where it began, and whether it is the optimum that `best` is.
    """
    start = start_with_multipliers(statement, prepared.mesh, parameters, best)
    if start is None or reporter.stop:
        return None
    kept = not missed(refined(_extremal(statement, prepared.mesh, parameters, start)))
    if not (kept or further):
        return None
    try:
        outcome = prepared.solve(parameters, start, part(reporter, PATIENCE, best))
    except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved; other starts may do
        return None
    if reporter.stop and not outcome.converged:
        return outcome, start, kept
    lower = best.cost - BELOW * abs(best.cost)
    if not outcome.converged or sum(outcome.cost_terms.values()) < lower:
        return None
    same = _is_whole(statement, best) and (own or _where(outcome, best))
    return outcome, start, kept and same


def _is_whole(statement: Statement, best: Solution) -> bool:
    """Whether all entries of the best gain are optimised: of a structure another one is the optimum."""
    gain = free_gain_block(statement)
    return gain is not None and best.loop is not None and gain.size == best.loop.gain[0].size


def _where(outcome: Outcome, best: Solution) -> bool:
    """Whether an outcome is where a solution was: that of a problem of other dynamics, noises or cost is elsewhere."""
    cost, x, known = sum(outcome.cost_terms.values()), outcome.extremal.trajectory.x, best.trajectory.x
    sizes = np.maximum(np.ptp(known, axis=0), np.abs(known[0]))
    near = bool((np.abs(x - known).max(axis=0, initial=0.0) <= SAME_STATE * sizes).all())
    return near and abs(cost - best.cost) <= SAME_COST * abs(best.cost)


def part(reporter: Progress, iterations: int | None, best: Solution, *, floor: bool = True) -> Progress:
    """A part of what is reported, with so many iterations; `floor`: the cost cannot be far below that of `best`.

    It cannot where no cost is taken of X that `best` does not have.
    """
    least = best.cost - BELOW * abs(best.cost) if floor else -np.inf
    return Progress("", show=False, iterations=iterations, within=reporter, floor=least)


def bounded_below(statement: Statement) -> bool:
    """Whether the cost is no less than with the best gain: X is in it as a weight only."""
    return statement.loop is not None and statement.loop.spread is None


def start_with_multipliers(statement: Statement, mesh: Mesh, parameters: Array, best: Solution) -> Guess | None:
    """The start along a solution with the best gain with its multipliers; None where they are not those of a start.

    That is so where another gain would be the best one: where it is bounded, or X in the cost otherwise than linearly.
    Arguments as of `from_best`, `mesh` of the run.
    """
    if not _is_best(statement, mesh, parameters, best):
        return None
    guess = make_guess(statement, mesh, parameters, best)
    guess = replace(guess, multipliers=_carried(statement, mesh, best), warm=True)
    costates = discrete_costates(_extremal(statement, mesh, parameters, guess))[0]
    found = (costates.state, costates.matrices)
    return replace(guess, costates=found) if all(np.isfinite(own).all() for own in found) else None


def _is_best(statement: Statement, mesh: Mesh, parameters: Array, best: Solution) -> bool:
    """Whether a solution is one of this problem and mesh but for conditions, with the best gain in place of a free one.

    It need not be the optimum for these values of the parameters: then its multipliers are of no use.
    """
    gain, other = free_gain_block(statement), best.statement
    if gain is None or gain.kind == "state" or other is None or not other.behind or best.loop is None:
        return False
    assert statement.loop is not None
    linear = statement.loop.spread is None
    free = all(np.isinf(bound[gain.span]).all() for bound in statement.control_bounds)
    own = best.mesh
    alike = np.array_equal(own.nodes, mesh.nodes) and (own.control, own.instants) == (mesh.control, mesh.instants)
    alike = alike and (statement.state_names, statement.np) == (other.state_names, other.np)
    same = alike and np.array_equal(best.parameters, parameters)
    return bool(best.converged and best.optimised and linear and free and same)


def _extremal(statement: Statement, mesh: Mesh, parameters: Array, guess: Guess) -> Extremal:
    """A start as data."""
    assert guess.multipliers is not None
    return Extremal(
        stated=statement,
        mesh=mesh,
        trajectory=guess.trajectory,
        parameters=parameters,
        multipliers=guess.multipliers,
    )


def _carried(statement: Statement, mesh: Mesh, best: Solution) -> Multipliers:
    """The multipliers of a solution, those of conditions by their names; zero of what it does not have."""
    own, other, m = Multipliers.zero(statement, mesh), best.extremal.statement, best.multipliers
    controls = own.controls.copy()
    known = {block.name: block for block in other.controls}
    for block in statement.controls:
        if block.name in known:
            controls[:, block.span] = m.controls[:, known[block.name].span]
    return replace(
        own,
        final=m.final,
        states=m.states_at_nodes,
        controls=controls,
        path=_by_name(statement.path, other.path, m.path_at_nodes),
        start=_by_name(statement.start, other.start, m.start),
        end=_by_name(statement.end, other.end, m.end),
        instants=m.instants if own.instants.size == m.instants.size else own.instants,
    )


def _by_name(own: Conditions, other: Conditions, multipliers: Array) -> Array:
    """Multipliers of some conditions from those of others, rows along the last axis."""
    known = {name: k for k, name in enumerate(other.names)}
    result = np.zeros((*multipliers.shape[:-1], len(own.names)))
    for k, name in enumerate(own.names):
        if name in known:
            result[..., k] = multipliers[..., known[name]]
    return result
