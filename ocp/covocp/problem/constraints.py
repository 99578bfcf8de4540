"""Constraints: where they hold, and what they may contain there."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.arguments import is_number
from covocp.base.checks import caller
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.problem.checks import check_constrains, check_name, check_size, column_expression, limit_columns
from covocp.problem.decisions import decisions_of
from covocp.problem.declarations import Constraint, Declarations
from covocp.problem.integrals import integrals_of

PLACES = ("path", "initial", "final")


def with_constraint(
    own: Declarations,
    expression: Given,
    lower: Given,
    upper: Given,
    at: Given,
    name: str | None,
    between: Given = None,
) -> Declarations:
    """The declarations with one more constraint; arguments and errors as of `Problem.subject_to`."""
    label = name if name is not None else f"constraint {len(own.constraints) + 1}"
    if at is not None:
        _refuse_instants(label, at)
        check_place(label, at)
    value = column_expression(label, "constraint", expression)
    fixed: list[Any] = [*own.parameters, *own.unknowns]
    constants = [*(q.symbol for q in fixed), own.time]
    check_constrains(label, value, constants)
    place = _place(own, label, value, at)
    check_name(label, list(own.named))
    low, high = limit_columns(label, lower, upper, check_size(label, value.shape[0]))
    if not (between is None or (isinstance(between, str) and between == "auto")) or (between and place != "path"):
        raise ProblemError(
            f"'{label}' has a wrong between=.",
            expected="None, or 'auto' for a constraint along the path",
            received=f"between={between!r}, at='{place}'",
            remedy="correct between=, or leave it out",
        )
    own_place: dict[str, Any] = {"at": place, "where": caller(), "between": between is not None}
    entry = Constraint(name=label, expression=value, lower=low, upper=high, **own_place)
    return own.adding(constraints=entry)


def check_place(label: str, at: Given) -> None:
    """A place is one of three.

    Raises:
        ProblemError: it is none.
    """
    if not isinstance(at, str) or at not in PLACES:
        raise ProblemError(
            f"'{label}' has an unknown place.",
            expected="at='path', 'initial' or 'final'",
            received=repr(at),
            remedy="choose one of the three",
        )


def _refuse_instants(label: str, at: Given) -> None:
    """Instants inside the horizon are ends of phases; whoever gives one is told so.

    Raises:
        ProblemError: a number, or several.
    """
    given = at.ravel().tolist() if isinstance(at, np.ndarray) else at if isinstance(at, (list, tuple)) else [at]
    if len(given) and all(is_number(instant) for instant in given):
        raise ProblemError(
            f"'{label}' is to hold at an instant of the horizon.",
            expected="at='path', 'initial' or 'final'",
            received=f"at={at}",
            remedy="at the start and at the end say 'initial' and 'final'; in between end a phase there, with this "
            "condition at='final', and go on in the next one: solve(Phases([before, after]))",
        )


def _place(own: Declarations, label: str, value: ca.MX, at: Any) -> Any:
    """Where a constraint holds: integrals have their value at the end, decisions need one row."""
    symbols = {symbol.__hash__() for symbol in ca.symvar(value)}
    inside = [entry.name for entry in integrals_of(own) if entry.symbol.__hash__() in symbols]
    if inside and at not in (None, "final"):
        raise ProblemError(
            f"'{label}' contains the integral '{inside[0]}' elsewhere than at the end.",
            expected="at='final', or no at=: an integral is one number, taken over the whole time",
            received=f"at='{at}'",
            remedy="for what has been gathered so far declare a state with this rate: state(..., initial=0)",
        )
    fixed: list[Any] = [*decisions_of(own), *own.parameters, *own.unknowns]
    constant = {q.symbol.__hash__() for q in fixed}
    if inside or (at in (None, "path") and symbols <= constant):
        return "final"
    return "path" if at is None else at
