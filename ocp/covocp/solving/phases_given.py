"""What users give for several phases at once: intervals, guesses or nominals, and values by name, for each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from covocp.base.arguments import is_whole
from covocp.base.errors import ProblemError, spelling
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.solution.phases import PhasesSolution
from covocp.statement.chain import Chain
from covocp.statement.magnitudes import check_magnitudes
from covocp.statement.names import name_of, stacked_parameters
from covocp.statement.statement import Statement
from covocp.transcription.mesh import INTERVALS

Arrays = tuple[Array, ...]
TAKEN_BY = {"guess": "solve", "nominal": "evaluate"}


def intervals_of(chain: Chain, intervals: Given) -> list[int]:
    """Number of control intervals of each phase; one number is that of each."""
    count = len(chain.statements)
    intervals = INTERVALS if intervals is None else intervals
    listed = list(intervals) if isinstance(intervals, (list, tuple, np.ndarray)) else [intervals] * count
    if len(listed) != count or not all(is_whole(n) for n in listed):
        raise ProblemError(
            "The option 'intervals' has a value that does not apply.",
            expected=f"a positive whole number, or one for each of the {count} phases",
            received=repr(intervals)[:100],
            remedy="correct intervals=",
        )
    return [int(n) for n in listed]


def of_each(chain: Chain, guess: Given, what: str = "guess") -> list[Any]:
    """The guess of each phase, or the nominal; None where there is none.

    Raises:
        ProblemError: it does not fit the phases.
    """
    names = [st.name for st in chain.statements]
    if guess is None:
        return [None] * len(names)
    if isinstance(guess, Mapping):
        for name in guess:
            if name not in names:
                raise _no_such("phase", name, names)
        listed = [guess.get(name) for name in names]
    else:
        listed = list(guess) if isinstance(guess, (PhasesSolution, list, tuple)) else []
    if len(listed) != len(names):
        raise ProblemError(
            f"The {what} does not fit the phases.",
            expected=f"None, a PhasesSolution of {len(names)} phases, a list of {len(names)} entries, or a dict by "
            "name of the phase: " + ", ".join(names),
            received=repr(guess)[:100],
            remedy=f"correct {what}=; that of a phase is what {TAKEN_BY[what]}() takes for one problem",
        )
    return listed


def values_of(chain: Chain, parameters: Mapping[str, Any]) -> Arrays:
    """Parameters of each statement; a name counts in all that have it."""
    if not isinstance(parameters, Mapping):
        stacked_parameters(chain.statements[0], parameters)  # says what it should be
    pairs = zip(chain.statements, given_of_each(chain.statements, parameters), strict=True)
    values = tuple(stacked_parameters(st, given) for st, given in pairs)
    for st, own in zip(chain.statements, values, strict=True):
        check_magnitudes(st, own)
    return values


def given_of_each(statements: Sequence[Statement], parameters: Mapping[Any, Any]) -> list[dict[str, Any]]:
    """For each statement the values by name of its parameters and unknowns, from those of all.

    Raises:
        ProblemError: none has a parameter or unknown of that name.
    """
    carried = [{b.name for b in st.matrices} for st in statements]
    own = [
        tuple(b.name for b in st.blocks if b.kind in ("parameter", "unknown") and b.name[:-3] not in names)
        for st, names in zip(statements, carried, strict=True)
    ]
    pairs = list(zip(statements, own, strict=True))
    by_name: dict[str, Any] = {}
    for key, value in parameters.items():
        found = [name for st, names in pairs if (name := name_of(key, st.symbols, names, missing_ok=True))]
        if not found:
            raise _no_such("parameter", key, [n for names in own for n in names])
        by_name[found[0]] = value
    return [{name: value for name, value in by_name.items() if name in names} for names in own]


def _no_such(what: str, name: Given, known: list[str]) -> ProblemError:
    """The error for a name that none of the phases has."""
    listed = list(dict.fromkeys(known))
    return ProblemError(
        f"There is no {what} '{name}'.",
        expected="one of " + ", ".join(listed) if listed else f"none: no phase has a {what}",
        received=repr(name)[:100],
        remedy=spelling(name, listed, "correct or remove it"),
    )
