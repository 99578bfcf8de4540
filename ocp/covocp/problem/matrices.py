"""Symmetric matrices as they are declared: matrix states, what makes one run backward, the covariance of the loop."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.checks import as_number, caller, check_inside, column, is_symbolic, symmetric_data
from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.matrices import half_length, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.problem.boundary_values import check_free
from covocp.statement.statement import Role


@dataclass(frozen=True, kw_only=True, eq=False)
class Backward:
    """What makes a matrix run backward in time: its value at the end, and the Riccati form of its rate.

    end: the matrix at T, an expression of states, parameters, unknowns and the duration.
    form: F, Q, W of V = F E + E F' + Q - E W E, the rate in forward time; expressions of nominal, time, parameters.
    """

    end: ca.MX
    form: tuple[ca.MX, ca.MX, ca.MX]

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Matrix:
    """A symmetric matrix state; `symbol` is its half-vector, `matrix` the full matrix that the user sees.

    role: "integral" of one number that depends on matrices and on which nothing depends; these come last.
    unmeasured: whether it is the covariance of the augmented state that nobody measures.
    """

    name: str
    symbol: ca.MX
    matrix: ca.MX
    size: int
    where: str
    unit: str
    initial: ca.MX | None
    final: ca.MX | None
    lower: float | None
    guess: Any
    covariance: bool
    estimation: bool
    labels: tuple[str, ...]
    backward: Backward | None = None
    role: Role = "moving"
    unmeasured: bool = False

    __repr__ = short_repr

    @property
    def of_deviations(self) -> bool:
        """Whether it is a covariance of the augmented state, which grows and passes as deviations do."""
        return self.estimation or self.unmeasured


@dataclass(frozen=True, kw_only=True, eq=False)
class Spread:
    """The covariance of the deviations of augmented state and controls of the closed loop, as a symbol.

    symbol: its half-vector; matrix: of states, unknowns and controls; states: rows of the augmented state.
    value: the half-vector in terms of the other symbols, once the problem with the feedback is derived.
    """

    name: str
    symbol: ca.MX
    matrix: ca.MX
    size: int
    states: int
    where: str
    labels: tuple[str, ...]
    value: ca.MX | None = None

    __repr__ = short_repr


def declare_matrix(
    name: str,
    *,
    labels: tuple[str, ...],
    where: str,
    unit: str = "",
    initial: Given = None,
    final: Given = None,
    lower: float | None = None,
    guess: Given = None,
    covariance: bool = False,
    estimation: bool = False,
    backward: Backward | None = None,
    role: Role = "moving",
) -> Matrix:
    """A symmetric matrix state with a symbol of its own, a row for each label.

    Raises:
        ProblemError: end values of another shape or not symmetric; those of a covariance indefinite.
    """
    size = len(labels)
    half = ca.MX.sym(name, half_length(size))
    ends = [
        None if value is None else symmetric_data(name, what, value, size, semidefinite=covariance)
        for what, value in (("initial value", initial), ("final value", final))
    ]
    return Matrix(
        name=name,
        symbol=half,
        matrix=unpack_symbolic(half, size),
        size=size,
        where=where,
        unit=unit,
        initial=ends[0],
        final=ends[1],
        lower=lower,
        guess=guess,
        covariance=covariance,
        estimation=estimation,
        labels=labels,
        backward=backward,
        role=role,
    )


def plain_matrix(
    name: str, size: int, unit: str, initial: Given, final: Given, lower: float | None, guess: Given
) -> Matrix:
    """A symmetric matrix state of the user's own; arguments and errors as of `Problem.symmetric`."""
    for what, value in (("initial value", initial), ("final value", final)):
        check_free(name, what, value)
    lower = None if lower is None else float(column(name, "lower bound", lower, 1, inf=True)[0])
    if lower is not None and initial is not None and not is_symbolic(initial):
        diagonal = np.diagonal(np.atleast_2d(as_number(name, "initial value", initial)))
        check_inside(name, "initial", diagonal, np.full(diagonal.size, lower), np.full(diagonal.size, np.inf))
    return declare_matrix(
        name,
        labels=tuple(str(i) for i in range(size)),
        where=caller(),
        unit=unit,
        initial=initial,
        final=final,
        lower=lower,
        guess=guess,
        covariance=lower is not None and lower >= 0,
    )
