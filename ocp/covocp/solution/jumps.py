"""What a user must know of a solution that meets a jump of the model with the state."""

from __future__ import annotations

import numpy as np

from covocp.base.errors import warn_user
from covocp.extremal.jumps import Jump, met_jumps
from covocp.extremal.local_errors import errors_of_steps
from covocp.extremal.mesh_error import COARSE_MESH, NO_COST
from covocp.solution.origin import Origin
from covocp.solution.solution import Solution

# Moments that a warning names.
LISTED = 3
# Entries that a warning names where what is compared is long.
NAMED = 4


def mention_jumps(solution: Solution) -> tuple[Jump, ...]:
    """Warn of jumps of the model with state, control or matrices that a solution meets, and return them.

    A running cost that jumps with what scatters was warned of when the problem was made ready.
    """
    found = jumps_of(solution)
    untold = [jump for jump in found if jump.what or not _scatters(solution, jump)]
    if untold:
        warn_user(_words(solution, untold))
    return found


def jumps_of(solution: Solution) -> tuple[Jump, ...]:
    """Jumps of the model that a solution meets which some method found."""
    if solution.statement is None or solution.origin not in (Origin.OPTIMISED, Origin.CLASSICAL):
        return ()
    return met_jumps(solution.extremal, solution.within is not None, solution.optimised)


def coarse_elsewhere(solution: Solution, jumps: tuple[Jump, ...]) -> bool:
    """Whether integration steps are too long also where no jump is met."""
    changes = np.abs(errors_of_steps(solution.extremal)[1])
    changes[[k for jump in jumps for k in jump.intervals]] = 0.0
    return bool(changes.sum() > COARSE_MESH * max(abs(solution.cost), NO_COST))


def _scatters(solution: Solution, jump: Jump) -> bool:
    """Whether what is compared has a standard deviation in a closed loop."""
    if solution.loop is None:
        return False
    rows = [i for i, name in enumerate(solution.augmented) if name in jump.names]
    return bool(np.diagonal(solution.loop.X, axis1=1, axis2=2)[:, rows].any())


def _words(solution: Solution, jumps: list[Jump]) -> str:
    """What jumps, where and by how much, what that means and what to do."""
    first, many = jumps[0], len(jumps) - 1
    what = f"the rate of '{first.what}'" if first.what else "the running cost"
    times = [f"{time:.4g}" for time in first.times[:LISTED]]
    more = f" and {len(first.times) - LISTED} times more" if len(first.times) > LISTED else ""
    place = f"at t = {', '.join(times)} s{more}"
    met = "crosses" if first.crossed else "reaches"
    others = f" {many} other comparison{'s' if many > 1 else ''} too." if many else ""
    return (
        f"'{solution.name or 'The problem'}' jumps with the state: {place} the solution {met} the border of "
        f"{_compared(first)}, where {what} jumps by {100 * first.share:.3g} % of the larger value.{others} Slopes do "
        "not see the moment of crossing, so the point is no solution of the conditions of an optimum and may be far "
        "from a minimum, by any method; more intervals do not help. State it as Phases, one for each side, each with "
        "its own formulas, a free duration and the border as the final condition; or make the transition smooth: "
        "kind='cubic' of a table, else (1 + tanh(d/w))/2 with the distance d from the border and a width w that the "
        "mesh resolves."
    )


def _compared(jump: Jump) -> str:
    """What is compared, in the user's symbols, or of what."""
    if jump.words:
        return f"{jump.words!r}"
    if not jump.names:
        return "a comparison, or a knot of a table"
    listed = " and ".join(f"'{name}'" for name in jump.names[:NAMED])
    return f"a comparison of {listed}" + (" and others" if len(jump.names) > NAMED else "")
