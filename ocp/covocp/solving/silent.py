"""Measurements that tell nothing: of no state and no unknown."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import warn_user
from covocp.base.expressions import Expr
from covocp.problem.declarations import Declarations


def mention_silent(problem: Declarations) -> None:
    """Warn of measurements that a filter takes and that depend on nothing that it estimates."""
    if problem.expected is None and not any(matrix.estimation for matrix in problem.matrices):
        return  # nothing uses them, which is told elsewhere
    estimated = ca.vertcat(ca.MX(0, 1), *(entry.symbol for entry in problem.augmented))
    silent = [f"'{entry.name}'" for entry in problem.measurements if not _moves(entry.expression, estimated)]
    if silent:
        one = len(silent) == 1
        warn_user(
            f"The measurement{'' if one else 's'} {', '.join(silent)} "
            f"depend{'s' if one else ''} on no state that is estimated and on no unknown: a filter learns nothing from "
            f"{'it' if one else 'them'}. Write what is measured as an expression of these: "
            "measurement(name, expression, noise)."
        )


def _moves(expression: Expr, estimated: Any) -> bool:
    """Whether an expression has a slope by what is estimated that is not zero everywhere."""
    slope = ca.jacobian(expression, estimated)
    if not slope.nnz():
        return False
    return bool(ca.symvar(slope)) or bool(np.any(ca.evalf(slope).full()))
