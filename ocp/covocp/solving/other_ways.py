"""Other ways to a gain that is chosen freely, where steps of Runge and Kutta with exact second derivatives lead astray.

Where the estimate scatters little, as at the start, a gain counts for next to nothing, and a run may creep along it.
Far out classical Runge-Kutta steps take Xhat below zero, and the cost falls without end: of an optimum that the start
all but is, a run finds none, however many iterations it has. Gauss steps keep Xhat semidefinite, and an approximate
Hessian is positive definite, so that nothing looks as if it led there. Both have the optimum that is meant; Gauss steps
find it in the fewest iterations.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh, Options


class Way(NamedTuple):
    """How else a problem is made ready: what to write for it, the options of the mesh, those of the method."""

    words: str
    options: Options
    own: dict[str, Any]


def other_ways(statement: Statement, options: Options, mesh: Mesh, own: Mapping[str, Any]) -> Iterator[Way]:
    """Ways that the user left open, the most robust one first.

    Args:
        statement: the problem.
        options: of the run that failed.
        mesh: likewise.
        own: options of the method that were given.
    """
    if options.covariance_step == "auto" and mesh.step == "rk4" and statement.riccati_forms:
        yield Way("covariance_step='gauss'", replace(options, covariance_step="gauss"), {})
    if own.get("hessian", "auto") == "auto" and not mesh.eliminated:
        yield Way("hessian='limited-memory'", options, {"hessian": "limited-memory"})


def told_ways(tried: str, left: Iterable[Way]) -> str:
    """A line for a run that failed: what was tried in vain, or what may find a way; "" where there is nothing.

    Args:
        tried: in words; "": nothing.
        left: what there is to try.
    """
    if tried:
        return f"\n  From the same start {tried} found nothing either."
    listed = " or ".join(way.words for way in left)
    if not listed:
        return ""
    return f"\n  {listed} may find a way: the gain is free, and counts for next to nothing in places."
