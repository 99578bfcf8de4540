"""Conditions on the spread that a run does not find its way to: loosened first, then tightened step by step.

A gain that is a control meets limits of X only together with the nominal, and from a start that is far from them the
method may wander. Where the limits are as wide as the start needs, it converges; each solution starts the next.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from covocp.base.errors import CovocpError
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Outcome, Prepared
from covocp.extremal.fine_mesh import refined
from covocp.extremal.given_controls import missed
from covocp.solution.solution import Solution
from covocp.solving.attempts import counted, rank, with_stats
from covocp.solving.from_best_gain import bounded_below, part, start_with_multipliers
from covocp.solving.warm_start import make_guess
from covocp.statement.conditions import Conditions
from covocp.statement.interval import repeated
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.trajectory import Trajectory

# Iterations after which a run gives up where there is this other way; of each step of it, and of the last.
PATIENCE, PATIENCE_OF_STEPS = 400, 150
# Of all steps of it together: where it leads somewhere, it mostly takes fewer than 250.
MOST_ITERATIONS = 400
# First step of the share by which limits are loosened, the smallest one, and the most steps.
FIRST, SMALLEST, MOST = 0.5, 0.02, 20
# What the start misses of a limit is allowed with so much more.
ROOM = 1.1

STOPPED = "stopped while its conditions were loosened"

# Makes a statement ready, with so many iterations at most.
Ready = Callable[[Statement, int], Prepared]


def can_be_loosened(statement: Statement) -> bool:
    """Whether there are limits along the path or at the end that contain the covariance of the closed loop."""
    return statement.loop is not None and any(
        own.realised is not None and not own.equations.all() for own in (statement.path, statement.end)
    )


def tightened(
    statement: Statement, failed: Outcome, best: Solution, ready: Ready, reporter: Progress, mesh: Mesh | None = None
) -> Outcome:
    """The outcome by way of problems whose limits are loosened less and less, the last one not at all; else as before.

    Where a limit ends the way, or the user does, the best point until then counts, by what it violates of the problem.

    Args:
        statement: the problem.
        failed: its outcome before.
        best: with the best gain, where to start; what the limits are loosened for.
        ready: makes a problem like it ready on the same mesh.
        reporter: of iterations.
        mesh: of these runs; None: that of the run before.
    """
    mesh = failed.extremal.mesh if mesh is None else mesh
    most = part(reporter, MOST_ITERATIONS, best, floor=mesh.step == "rk4" and bounded_below(statement))
    found = _sequence(statement, failed, best, mesh, ready, most) if can_be_loosened(statement) else None
    if found is None:
        return failed
    if not (found.converged or reporter.stop):  # its own limit
        return with_stats(failed, **counted(failed, found))
    chosen = found if found.converged else min(failed, found, key=rank)
    return with_stats(chosen, **counted(failed, found))


def _sequence(
    statement: Statement, failed: Outcome, best: Solution, mesh: Mesh, ready: Ready, reporter: Progress
) -> Outcome | None:
    """The outcome of the problem itself, or the best until a limit is reached; None where steps became too small."""
    parameters = failed.extremal.parameters
    start = None if mesh.step == "rk4" else start_with_multipliers(statement, mesh, parameters, best)
    start = make_guess(statement, mesh, parameters, best) if start is None else start
    room = {
        name: _missed(getattr(statement, name), name, start.trajectory, mesh, parameters) for name in ("path", "end")
    }
    if not any(np.any(own > 0) for own in room.values()):
        return None
    share, step, last = 1.0, 0.0, None
    for _ in range(MOST):
        wanted = share - step if share - step > SMALLEST / 2 else 0.0
        problem = statement if wanted == 0.0 else _loosened(statement, room, wanted)
        try:
            if last is not None:
                start = make_guess(problem, mesh, parameters, Solution.of(last, best.method, assess=False))
            prepared = ready(problem, PATIENCE if wanted == 0.0 else PATIENCE_OF_STEPS)
            found = prepared.solve(parameters, start, reporter)
        except (CovocpError, RuntimeError):  # CasADi's, of a step that cannot be solved: the run before it counts
            return None
        found = found if last is None else with_stats(found, **counted(last, found))
        if found.converged and wanted == 0.0:
            return found
        if reporter.stop:
            reached = [_of_problem(statement, one) for one in (last, found) if one is not None]
            return replace(min(reached, key=rank), stats=found.stats)
        if found.converged:
            step = FIRST if last is None else min(1.5 * step, FIRST)
            share, last = wanted, found
        elif last is None or step <= SMALLEST:
            return None
        else:
            step = 0.5 * step
    return None


def _of_problem(statement: Statement, outcome: Outcome) -> Outcome:
    """What was reached under wider limits, with what it violates of the problem: no solution of that."""
    extremal = replace(outcome.extremal, stated=statement)
    violations = {**outcome.violations, **missed(refined(extremal))}  # limits act at all its nodes
    return replace(outcome, extremal=extremal, violations=violations, converged=False, message=STOPPED)


def _missed(rows: Conditions, name: str, start: Trajectory, mesh: Mesh, parameters: Array) -> Array:
    """By how much the start passes the limits of each row that contains X, (rows,); 0 of the others."""
    if rows.realised is None:
        return np.zeros(rows.size)
    count = start.x.shape[0]
    controls = start.u if start.u.shape[0] == count else np.vstack([start.u, start.u[-1:]])
    columns = [start.x.T, controls.T, start.e.T, start.duration * mesh.nodes[None, :]]
    columns += [np.asarray(column) for column in repeated(start.duration, parameters, count)]
    columns = [column[:, -1:] for column in columns] if name == "end" else columns
    values = np.asarray(rows.function.map(columns[0].shape[1])(*columns))
    over = np.maximum(values - rows.upper[:, None], rows.lower[:, None] - values).max(axis=1)
    return np.where(np.isfinite(over) & ~rows.equations, ROOM * np.maximum(over, 0.0), 0.0)


def _loosened(statement: Statement, room: dict[str, Array], share: float) -> Statement:
    """The statement with limits that are wider by a share of what the start missed of them."""
    wider: dict[str, Any] = {}
    for name, by in room.items():
        rows: Conditions = getattr(statement, name)
        wider[name] = replace(rows, lower=rows.lower - share * by, upper=rows.upper + share * by)
    return replace(statement, **wider)
