"""Numbers whose square is none: a solver would be busy with inf and NaN for long, and then blame the model."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.matrices import Array
from covocp.statement.statement import Statement

# Largest number that can be squared.
SQUARED = float(np.sqrt(np.finfo(float).max))
# Statements, with parameters, that have passed and are known.
KEPT = 16


def check_magnitudes(statement: Statement, parameters: Array) -> None:
    """The duration, means of unknowns, and values of states at both ends must be numbers that can be squared.

    Raises:
        ProblemError: names the first that cannot.
    """
    _check(statement, np.asarray(parameters, dtype=float).tobytes())


@lru_cache(maxsize=KEPT)
def _check(statement: Statement, parameters: bytes) -> None:
    """The same; what has passed is not looked at again."""
    for name, what, values in _numbers(statement, np.frombuffer(parameters)):
        large = np.abs(values) > SQUARED  # never of NaN, which stands for a free one
        if large.any():
            raise ProblemError(
                f"The {what} {name} is too large: its square is no number.",
                expected=f"a magnitude below {SQUARED:.3g}",
                received=f"{values[large][0]:g}",
                remedy="correct it, or state the problem in larger units",
            )


def _numbers(statement: Statement, parameters: Array) -> Iterator[tuple[str, str, Array]]:
    """Names, what they are of, and numbers."""
    yield f"of '{statement.name}'" if statement.name else "[s]", "duration", np.array([statement.duration.guess])
    for block in statement.of_kind("unknown"):
        yield f"of '{block.name}'", "mean", parameters[block.span]
    initial, final = statement.boundary_values(parameters)[:2]
    for block in statement.states:
        yield f"of '{block.name}'", "initial value", initial[block.span]
        yield f"of '{block.name}'", "final value", final[block.span]
