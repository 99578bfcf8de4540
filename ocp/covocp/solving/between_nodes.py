"""Limits that must hold between the nodes too: imposed at more and more points of each interval until they do."""

from __future__ import annotations

from dataclasses import replace

from covocp.base.errors import ProblemError, warn_user
from covocp.extremal.dense_output import dense_output
from covocp.extremal.extremal import Extremal
from covocp.extremal.path_limits import Passed, passed_limits
from covocp.statement.statement import Statement
from covocp.transcription.mesh import LARGEST_SUBSTEPS, Mesh, Options

# Share of a limit by which it may be passed between the points where it is imposed; the least one that can be seen
# along the path, which is known to 1e-5 of the range of each state.
ALLOWED, SEEN = 1e-4, 2e-5
# Parts of an interval at whose ends it is looked at, beside those between all points.
LOOKED = 12


def watched(statement: Statement) -> tuple[str, ...]:
    """Names of the rows of path constraints that must hold between the nodes."""
    path = statement.path
    return tuple(name for name, between in zip(path.names, path.between, strict=False) if between)


# The method whose penalties act at the nodes.
AT_NODES = "gradient"


def check_between(statement: Statement, method: str) -> None:
    """Refuse a method that imposes limits at the nodes alone.

    Raises:
        ProblemError: some constraint must hold between them.
    """
    names = watched(statement)
    if names and method == AT_NODES:
        raise ProblemError(
            f"The method '{method}' cannot keep '{names[0]}' between the nodes.",
            expected="method='ipopt' or 'reduced', which impose limits at points inside the intervals",
            received=f"method='{method}', and between='auto' for {', '.join(names)}",
            remedy="use one of these, or leave between= out and take more intervals",
        )


def worst_between(extremal: Extremal, allowed: float | None) -> Passed | None:
    """What is passed most of the limits that must hold between the nodes; None where all hold.

    Args:
        extremal: a solution.
        allowed: relative error of the cost that was asked for, where there is one.
    """
    names = watched(extremal.statement)
    if not names:
        return None
    points = max(LOOKED, 2 * extremal.mesh.points)
    dense = dense_output(extremal, matrices=extremal.statement.path.uses_matrices)
    share = ALLOWED if allowed is None else min(max(allowed, SEEN), ALLOWED)
    found = [entry for entry in passed_limits(extremal, dense, points) if entry.name in names and entry.share > share]
    return found[0] if found else None


def more_points(options: Options, mesh: Mesh) -> Options | None:
    """The options with limits at twice as many points of each interval; None where there can be no more."""
    points = 2 * mesh.points
    if points > LARGEST_SUBSTEPS:
        return None
    fixed = options.substeps == "auto"
    return replace(options, points=points, substeps="auto" if fixed else max(int(options.substeps), points))


def mention_between(passed: Passed, points: int, reason: str, where: str = "") -> None:
    """Warn of a limit that does not hold as it was asked for; `where`: " of the phase ..." where there are several."""
    if not passed.defined:
        warn_user(
            f"'{passed.name}'{where} is NaN or inf between the nodes at t = {passed.time:.4g} s: its limit does not "
            f"hold there as between='auto' asks; {reason}. Bound what it is made of, or use more intervals."
        )
        return
    warn_user(
        f"The limit of '{passed.name}'{where} does not hold between the nodes as between='auto' asks: with {points} "
        f"points of each interval it is passed by {passed.by:.3g} ({100 * passed.share:.2g} % of it) at "
        f"t = {passed.time:.4g} s; {reason}. Use more intervals, or keep a margin."
    )
