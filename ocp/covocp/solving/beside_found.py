"""What was found beside what other starts lead to: other durations, other excitations."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.extremal.extremal import Prepared
from covocp.solving.coarse_search import Found, Search
from covocp.solving.exact_rows import made_ready
from covocp.solving.excitations import otherwise_excited
from covocp.solving.other_durations import of_other_duration
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Options


def beside_found(
    found: Found,
    prepared: Prepared,
    problem: tuple[Statement, Options, Array],
    guess: Given,
    reporter: Progress,
    *,
    slow: bool,
    own: Mapping[str, Any],
) -> Found:
    """The cheapest of what was found and of what is met on a coarse mesh from other starts.

    Args:
        found: the outcome, and the start from which it came.
        prepared: what found it.
        problem: its statement, options of its mesh, and the values that this is made for.
        guess: what was given as such.
        reporter: of iterations.
        slow: as of `Search`.
        own: options of Ipopt.
    """
    statement, options, values = problem
    coarse = partial(made_ready, "ipopt", statement, parameters=values, **own)
    reduced = partial(made_ready, "reduced", statement, parameters=values)
    search = Search(
        prepared=prepared,
        statement=statement,
        options=options,
        ready=coarse,
        reduced=reduced,
        guess=guess,
        reporter=reporter,
        slow=slow,
    )
    for looked in (of_other_duration, otherwise_excited):
        found = looked(search, found)
    return found
