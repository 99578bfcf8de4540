"""What a nominal that was evaluated misses: at the nodes, between them, and by the loop along it.

Conditions that are NaN or inf somewhere are missed by inf; what was evaluated has then not converged.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from covocp.base.errors import ProblemError
from covocp.extremal.given_controls import without_value
from covocp.extremal.path_limits import NOTED, Passed
from covocp.extremal.spread_limits import passed_by_spread, spread_names
from covocp.solution.doubts import mention_doubts
from covocp.solution.solution import Solution

# Conditions without a value that a message names.
LISTED = 3


def told(solution: Solution) -> Solution:
    """A solution with what it misses; what the user must know about it is said."""
    result = with_missed(solution)
    if result.converged:  # else its message says why nothing of it counts
        mention_doubts(result)
    return result


def with_missed(solution: Solution) -> Solution:
    """A solution with the limits that it passes between the nodes among what it misses."""
    passed = solution.passed_limits()
    return _marked(replace(solution, violations=_with_passed(solution, passed)), passed)


def _with_passed(solution: Solution, passed: Iterable[Passed]) -> dict[str, float]:
    """What a nominal misses, and the limits that it passes between the nodes."""
    result = dict(solution.violations)
    for entry in passed:
        name = f"bounds of {entry.name}" if entry.name in solution.state_names else entry.name
        if entry.share > NOTED:
            result[name] = max(result.get(name, 0.0), entry.by)
    return result


def missed_by_loop(solution: Solution) -> Solution:
    """A solution with what it misses by its loop: of conditions on X what that does, of others what it missed."""
    extremal, loop = solution.extremal, solution.loop
    assert loop is not None
    believed, passed = spread_names(extremal.statement), passed_by_spread(extremal, loop)
    kept = {name: value for name, value in solution.violations.items() if name not in believed}
    return _marked(replace(solution, violations=kept | {entry.name: entry.by for entry in passed}), passed)


def _marked(solution: Solution, passed: Iterable[Passed]) -> Solution:
    """A solution as one that did not converge where conditions have no value along it; it says which, and when first.

    Args:
        solution: with all that it misses.
        passed: limits that it passes, between the nodes too.
    """
    times = without_value(solution.extremal)
    for entry in passed:
        if not entry.defined:
            times[entry.name] = min(entry.time, times.get(entry.name, entry.time))
    first = sorted((time, name) for name, time in times.items() if solution.violations.get(name) == np.inf)
    if not first:
        return solution
    shown = ", ".join(f"'{name}' (first at t = {time:.4g} s)" for time, name in first[:LISTED])
    more = f" and {len(first) - LISTED} more" if len(first) > LISTED else ""
    message = f"{solution.message}; conditions are NaN or inf: {shown}{more}"
    return replace(solution, converged=False, message=message)


def check_has_loop(solution: Solution, what: str = "the solution") -> None:
    """Where an expected cost was stated, a loop is missing because its numbers are none, not because of the cost.

    Args:
        solution: one without a loop.
        what: is lacking it, a word before the name.

    Raises:
        ProblemError: its problem has an expected cost.
    """
    stated = solution.statement
    if stated is None or stated.loop is None:
        return
    raise ProblemError(
        f"truth= needs a closed loop, and the covariances of that of {what} '{solution.name}' are NaN or inf.",
        expected="a solution whose states, covariances and cost are finite",
        received=f"cost {solution.cost:g}, {solution.status}",
        remedy="use another nominal, more intervals, or bounds that keep the model in its domain",
    )
