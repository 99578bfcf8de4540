"""The duality of linear-quadratic control and linear estimation: one table, used in both directions.

| control | transition | input | state weight | control weight | cross | backward | S | M | K |
|---|---|---|---|---|---|---|---|---|---|
| estimation | transition' | measurement' | noise | measurement noise | cross | forward | prior | posterior | (Phi L)' |

S = Phi' M Phi + Q1 is the cost to go before, M that after the control of a step (item 5).
"""

from __future__ import annotations

from typing import Any, overload

from covocp.base.arguments import a, check_argument
from covocp.base.dataclass import dataclass
from covocp.base.short_repr import short_repr
from covocp.blocks.updates import row_matrix
from covocp.blocks.values import matrix, square


@dataclass(frozen=True, kw_only=True, eq=False)
class Control:
    """A linear-quadratic control problem; numbers or expressions.

    Args:
        transition: Phi (continuous time: A), shape (n, n).
        input: Gamma (B), shape (n, m).
        state_weight: Q1, shape (n, n).
        control_weight: Q2, shape (m, m).
        cross: weight of state times control, shape (n, m); None: zero.
    """

    transition: Any
    input: Any
    state_weight: Any
    control_weight: Any
    cross: Any = None

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimation:
    """A linear estimation problem; numbers or expressions.

    Args:
        transition: Phi (continuous time: F), shape (n, n).
        measurement: H, shape (m, n), or (n,) for one measurement.
        noise: Gamma1 R_w Gamma1' (continuous time: a density), shape (n, n).
        measurement_noise: R_v, shape (m, m).
        cross: covariance of both noises, shape (n, m); None: zero.
    """

    transition: Any
    measurement: Any
    noise: Any
    measurement_noise: Any
    cross: Any = None

    __repr__ = short_repr


# Name in a control problem, name in an estimation problem, whether the matrix is transposed.
TABLE = (
    ("transition", "transition", True),
    ("input", "measurement", True),
    ("state_weight", "noise", False),
    ("control_weight", "measurement_noise", False),
    ("cross", "cross", False),
)


@overload
def dual(problem: Control) -> Estimation: ...
@overload
def dual(problem: Estimation) -> Control: ...
def dual(problem: Control | Estimation) -> Control | Estimation:
    """The estimation problem that has the Riccati equation of a control problem, or the other way round (item 5).

    Args:
        problem: of either kind; discrete or continuous.

    Returns:
        The problem of the other kind, its matrices CasADi matrices; the dual of the dual is the problem itself. Its
        Riccati solution is the same, its gain (of the filter: the predictor gain Phi L) the transposed one, and its
        time runs the other way.

    Raises:
        ProblemError: shapes that do not fit.
    """
    check_argument("dual()", "problem", a(Control, Estimation), problem)
    size = square("transition", problem.transition).shape[0]
    values: dict[str, Any] = {}
    for control, estimation, transposed in TABLE:
        here, there = (control, estimation) if isinstance(problem, Control) else (estimation, control)
        value = getattr(problem, here)
        if value is None and here == "cross":
            continue
        if here == "measurement":
            value = row_matrix(here, value, size)
        value = matrix(here, value)
        values[there] = value.T if transposed else value
    return Estimation(**values) if isinstance(problem, Control) else Control(**values)
