"""Slopes through shooting segments of Runge-Kutta steps, in compiled code, as nodes of expressions."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.nodes import Buffers, Node
from covocp.passage.library import needed

STAGES = 4


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Steps of shooting segments, and what their slopes are told by.

    rows: states. pattern: rows and columns of the nonzeros of a stage's slopes, column by column: those of the states'
    rates and last of the cost's, by the state and by the rest. steps: of an interval. lengths: intervals of each
    segment. places: of the rest of each interval, the columns of the slopes of its segment, which begin with those by
    the state at its start. active: columns that an interval and those before it in its segment reach.
    """

    rows: int
    pattern: tuple[tuple[int, ...], tuple[int, ...]]
    steps: int
    lengths: tuple[int, ...]
    places: tuple[tuple[int, ...], ...]
    active: tuple[int, ...]

    @property
    def widths(self) -> list[int]:
        """Columns of the slopes of each segment."""
        return [self.active[end - 1] for end in np.cumsum(self.lengths)]


def transitions(steps: Steps, slopes: Any) -> Any:
    """Slopes of the ends of all segments, side by side, (rows, sum of their widths); without derivatives.

    Args:
        steps: of the segments.
        slopes: nonzeros of the stages' slopes, a column for each stage of each step.
    """
    return _node(steps, "transitions")(slopes)


def passed_back(steps: Steps, slopes: Any, by_states: Any, by_costs: Any) -> Any:
    """Slopes of a number by what each segment starts from and takes, one below the other; without derivatives.

    Args:
        steps: of the segments.
        slopes: nonzeros of the stages' slopes, a column for each stage of each step.
        by_states: its slopes by the states after each step, (rows, steps).
        by_costs: its slopes by the running cost of each interval, (1, intervals).
    """
    return _node(steps, "passed_back")(slopes, by_states, by_costs)


@cache
def _node(steps: Steps, name: str) -> _Passed:
    """CasADi's expressions do not keep what Python makes, so all of them stay. They are small."""
    return _Passed(steps, name)


class _Passed(Node):
    """One of the functions of the library on some steps."""

    def __init__(self, steps: Steps, name: str) -> None:
        self._run = needed()[name]
        entries, intervals = len(steps.pattern[0]), sum(steps.lengths)
        slopes = ca.Sparsity.dense(entries, STAGES * steps.steps * intervals)
        if name == "transitions":
            inputs, output = [slopes], ca.Sparsity.dense(steps.rows, sum(steps.widths))
        else:
            states = ca.Sparsity.dense(steps.rows, steps.steps * intervals)
            inputs = [slopes, states, ca.Sparsity.dense(1, intervals)]
            output = ca.Sparsity.dense(sum(steps.widths), 1)
        parts = (*steps.pattern, steps.lengths, steps.places, steps.active)
        self._kept = [np.array(part, dtype=np.intc) for part in parts]
        row, column, *others = (array.ctypes.data for array in self._kept)
        numbers = (steps.rows, entries, row, column, len(steps.places[0]), steps.steps, len(steps.lengths))
        self._arguments = (*numbers, *others)
        super().__init__(name, inputs, [output])

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        if results[0] is None:
            return 0
        places = needed()["addresses"]((*self.filled(arguments), *results))
        return int(self._run(*self._arguments, *places))
