"""Constraints: where they hold, and what they may contain there."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.arguments import is_number
from covocp.base.checks import caller, column
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.problem.checks import (
    check_constrains,
    check_known_limits,
    check_name,
    check_size,
    column_expression,
    limit_columns,
)
from covocp.problem.decisions import decisions_of
from covocp.problem.declarations import Constraint, Declarations, Where
from covocp.problem.integrals import integrals_of

# Share of the terminal time within which an instant is one of its ends.
SAME_INSTANT = 1e-9
PLACES = ("path", "initial", "final")
SIDES = ("before", "after")


def with_constraint(
    own: Declarations,
    expression: Given,
    limits: tuple[Given, Given, Given],
    at: Given,
    name: str | None,
    between: Given = None,
    relative: Given = False,
    side: Given = None,
) -> Declarations:
    """The declarations with one more constraint; arguments and errors as of `Problem.subject_to`.

    limits: lower, upper and what it equals.
    """
    label = name if name is not None else f"constraint {len(own.constraints) + 1}"
    instant = instant_of(own, label, at, relative, side)
    if at is not None and instant is None:
        check_place(label, at, instants=True)
    value = column_expression(label, "constraint", expression)
    fixed: list[Any] = [*own.parameters, *own.unknowns]
    constants = [*(q.symbol for q in fixed), own.time]
    check_constrains(label, value, constants)
    place = _place(own, label, value, at, instant)
    check_name(label, list(own.named))
    size = check_size(label, value.shape[0])
    check_known_limits("subject_to", label, value, dict(zip(("lower", "upper", "equals"), limits, strict=True)))
    low, high = limit_columns(label, *_both_limits(label, *limits, size), size)
    if not (between is None or (isinstance(between, str) and between == "auto")) or (between and place != "path"):
        raise ProblemError(
            f"'{label}' has a wrong between=.",
            expected="None, or 'auto' for a constraint along the path",
            received=f"between={between!r}, at={at!r}",
            remedy="correct between=, or leave it out",
        )
    if between is not None and bool((np.asarray(low) == np.asarray(high)).any()):
        raise ProblemError(
            f"'{label}' is an equation, which cannot hold between the nodes.",
            expected="an inequality with between='auto'",
            received="the same value above and below",
            remedy="leave between= out; or state what it fixes as rates or controls: an angle for a direction",
        )
    own_place: dict[str, Any] = {"at": place, "where": caller(), "between": between is not None}
    if place == "inside" and instant is not None:
        own_place |= {"instant": instant[0], "late": instant[1], "relative": relative}
    entry = Constraint(name=label, expression=value, lower=low, upper=high, **own_place)
    return own.adding(constraints=entry)


def _both_limits(label: str, lower: Given, upper: Given, equals: Given, size: int) -> tuple[Given, Given]:
    """Lower and upper limit; both are what the expression equals, where that is given.

    Raises:
        ProblemError: it is given beside a limit, or is no finite number.
    """
    if equals is None:
        return lower, upper
    if lower is not None or upper is not None:
        raise ProblemError(
            f"'{label}' has equals= beside a limit.",
            expected="equals=, or lower= and upper=",
            received=f"equals={equals}, lower={lower}, upper={upper}",
            remedy="leave one of them out",
        )
    both = column(label, "value of equals=", equals, size)
    return both, both


def check_place(label: str, at: Given, *, instants: bool) -> None:
    """A place that is no instant is one of three.

    Args:
        label: of the condition.
        at: its place.
        instants: whether it might have been an instant.

    Raises:
        ProblemError: it is none.
    """
    if not isinstance(at, str) or at not in PLACES:
        raise ProblemError(
            f"'{label}' has an unknown place.",
            expected="at='path', 'initial' or 'final'" + (", or an instant: a number of seconds" if instants else ""),
            received=repr(at),
            remedy="correct at=",
        )


def instant_of(own: Declarations, label: str, at: Given, relative: Given, side: Given) -> tuple[float, bool] | None:
    """The instant at which a constraint holds, a share of T, and whether it holds after what happens there.

    None where `at` is no number.

    Raises:
        ProblemError: several instants, one outside of the horizon or at an end of it, in seconds where T is free; what
            belongs to instants where none is given.
    """
    given = at.ravel().tolist() if isinstance(at, np.ndarray) else at if isinstance(at, (list, tuple)) else [at]
    number = len(given) == 1 and is_number(given[0])
    if side is not None and not (isinstance(side, str) and side in SIDES):
        raise _wrong_instant(label, "side='before' or 'after'", f"side={side!r}", "correct side=, or leave it out")
    if len(given) > 1 and all(is_number(instant) for instant in given):
        raise _wrong_instant(label, "one instant", f"at={at}", "write one subject_to for each of them")
    if not number:
        if relative or side is not None:
            words = ", ".join([*(["relative=True"] if relative else []), *([f"side={side!r}"] if side else [])])
            remedy = "give at= a number, or leave the others out"
            raise _wrong_instant(label, "a number at= beside relative= or side=", f"at={at!r}, {words}", remedy)
        return None
    instant = float(given[0])
    if own.free_duration is not None and not relative:
        remedy = "write subject_to(..., at=0.5, relative=True) for the middle of it"
        raise _wrong_instant(label, "a share of the duration, which is free", f"at={at} in seconds", remedy)
    share = instant if relative else instant / float(own.duration)
    if not SAME_INSTANT < share < 1.0 - SAME_INSTANT:
        what = "a share of T in (0, 1)" if relative else f"an instant in (0, {float(own.duration):g}) s"
        raise _wrong_instant(label, what, f"at={at}", "at the start and at the end say 'initial' and 'final'")
    return share, side != "before"


def _wrong_instant(label: str, expected: str, received: str, remedy: str) -> ProblemError:
    return ProblemError(
        f"'{label}' is to hold at an instant that it cannot hold at.",
        expected=expected,
        received=received,
        remedy=remedy,
    )


def _place(own: Declarations, label: str, value: ca.MX, at: Any, instant: tuple[float, bool] | None) -> Where:
    """Where a constraint holds: integrals have their value at the end, decisions need one row."""
    symbols = {symbol.__hash__() for symbol in ca.symvar(value)}
    inside = [entry.name for entry in integrals_of(own) if entry.symbol.__hash__() in symbols]
    if inside and (instant is not None or at not in (None, "final")):
        raise ProblemError(
            f"'{label}' contains the integral '{inside[0]}' elsewhere than at the end.",
            expected="at='final', or no at=: an integral is one number, taken over the whole time",
            received=f"at={at!r}",
            remedy="for what has been gathered so far declare a state with this rate: state(..., initial=0)",
        )
    fixed: list[Any] = [*decisions_of(own), *own.parameters, *own.unknowns]
    constant = {q.symbol.__hash__() for q in fixed}
    if inside or (at in (None, "path") and symbols <= constant):
        return "final"
    if instant is not None:
        return "final" if symbols <= constant else "inside"
    place: Where = "path" if at is None else at
    return place
