"""What a statement knows of its conditions on probabilities."""

from __future__ import annotations

from typing import Literal

import casadi as ca

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.pickling import pickled_without
from covocp.base.short_repr import short_repr


@pickled_without(function=ca.Function)
@dataclass(frozen=True, kw_only=True, eq=False)
class ChanceLimits:
    """lower <= value <= upper of the actual system with a probability, by the linearised spread of the value.

    names: of its rows, as among the conditions of its place. probability: of each row, or of all rows together where
    they are joint; each: of each row then.
    function: (state, control, matrices, time, duration, parameters) -> values (k,), their slopes by the augmented state
        (k, n), and by the controls that are fed back (k, m).
    matrix: name of the covariance of the augmented state; None: that of the closed loop.
    """

    name: str
    names: tuple[str, ...]
    place: Literal["path", "initial", "final"]
    lower: Array
    upper: Array
    probability: float
    each: float
    joint: bool
    function: ca.Function
    matrix: str | None

    __repr__ = short_repr
