"""Integrals over the whole time: states that drive nothing, or, of covariances, numbers that follow from these."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.checks import caller, shape_error
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.problem.checks import check_name, column_expression
from covocp.problem.declarations import Declarations, Dynamics, State
from covocp.problem.matrices import Matrix, declare_matrix


def integrals_of(problem: Declarations) -> list[State | Matrix]:
    """The integrals that were declared."""
    every: list[State | Matrix] = [*problem.states, *problem.matrices]
    return [entry for entry in every if entry.role == "integral"]


def with_integral(own: Declarations, given: str | None, expression: Given, unit: str) -> tuple[Declarations, ca.MX]:
    """The declarations with one more integral, and its symbol; arguments and errors as of `Problem.integral`.

    Of a covariance it is a matrix of one row that follows from the others, else a state; nothing depends on it.
    """
    name = f"integral {1 + len(integrals_of(own))}" if given is None else given
    check_name(name, list(own.named))
    value = column_expression(name, "integrand of", expression)
    if value.shape != (1, 1):
        raise shape_error(name, "integrand", "a scalar", f"shape {value.shape}")
    symbols = {symbol.__hash__() for symbol in ca.symvar(value)}
    inner = [entry.name for entry in integrals_of(own) if entry.symbol.__hash__() in symbols]
    if inner:
        raise ProblemError(
            f"The integrand of '{name}' contains the integral '{inner[0]}'.",
            expected="an expression of states, controls, matrices, decisions and time",
            received=str(value)[:200],
            remedy=f"an integral is one number: use '{inner[0]}' in a cost or a constraint; for what has been gathered "
            "so far declare a state with that rate",
        )
    fixed: list[Any] = [*own.parameters, *own.unknowns]
    constants = {entry.symbol.__hash__() for entry in fixed}
    constants |= {state.symbol.__hash__() for state in own.states if state.role == "decision"}
    if isinstance(own.duration, ca.MX):
        constants.add(own.duration.__hash__())
    if symbols <= constants:
        raise ProblemError(
            f"The integrand of '{name}' does not change with time.",
            expected="an expression of states, controls, matrices or time",
            received=str(value)[:200],
            remedy="multiply it by the duration in place of integrating it",
        )
    still = Dynamics(rate=value, noise=None, where=caller())
    if any(ca.depends_on(value, matrix.symbol) for matrix in own.matrices):
        zero = np.zeros((1, 1))
        matrix = declare_matrix(name, labels=("0",), where=caller(), unit=unit, initial=zero, role="integral")
        return own.adding(matrices=matrix, rates={name: still}), matrix.symbol
    infinite = np.full(1, np.inf)
    state = State(
        name=name,
        symbol=ca.MX.sym(name),
        size=1,
        where=caller(),
        unit=unit,
        initial=ca.MX(ca.DM.zeros(1, 1)),
        final=ca.MX(ca.DM.nan(1, 1)),
        lower=-infinite,
        upper=infinite,
        guess=None,
        scale=None,
        variance=ca.MX(1, 1),
        role="integral",
    )
    return own.adding(states=state, rates={name: still}), state.symbol


def check_integrals(problem: Declarations) -> None:
    """Integrals are used in the terminal cost and at the end only.

    Raises:
        ProblemError: one is used elsewhere.
    """
    places: list[tuple[str, Any]] = [(f"the rate of '{name}'", entry.rate) for name, entry in problem.rates.items()]
    places += [(f"the noise of '{k}'", entry.noise) for k, entry in problem.rates.items() if entry.noise is not None]
    places += [(f"measurement '{m.name}'", ca.veccat(m.expression, m.noise)) for m in problem.measurements]
    places += [(f"'{c.name}', at='{c.at}'", c.expression) for c in problem.constraints if c.at != "final"]
    if problem.cost is not None:
        places.append(("the running cost", problem.cost[0]))
    _refuse(problem, places, "add its integrand instead, or declare a state with this rate: state(..., initial=0)")


def check_expected(problem: Declarations, costs: list[Any]) -> None:
    """The expected cost of the actual system contains no integrals of the nominal.

    Raises:
        ProblemError: it does.
    """
    places = list(zip(("the expected running cost", "the expected terminal cost"), costs, strict=True))
    _refuse(problem, places, "write its integrand into running= of minimize_expected(), where it is expanded too")


def _refuse(problem: Declarations, places: list[tuple[str, Any]], remedy: str) -> None:
    """No integral in any of these expressions."""
    for entry in integrals_of(problem):
        for what, expression in places:
            if isinstance(expression, ca.MX) and ca.depends_on(expression, entry.symbol):
                raise ProblemError(
                    f"There is the integral '{entry.name}' in {what}.",
                    expected="integrals in terminal costs and in constraints at the end: each is one number, taken "
                    "over the whole time",
                    received=str(expression)[:200],
                    remedy=remedy,
                )
