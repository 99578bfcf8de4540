"""Rates: what a state or a symmetric matrix moves by, and the white noise that is added."""

from __future__ import annotations

from typing import Any

import casadi as ca

from covocp.base.checks import caller, check_symmetric, density_matrix, is_scalar
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import pack_symbolic
from covocp.problem.checks import as_expression, find_name
from covocp.problem.declarations import Declarations, Dynamics
from covocp.statement.entries import error_size


def with_rate(own: Declarations, symbol: Given, rate: Given, noise: Given) -> Declarations:
    """The declarations with the rate of one of the symbols; arguments and errors as of `Problem.dynamics`."""
    name = find_name(symbol, "dynamics()", list(own.named), (*own.states, *own.matrices))
    for state in own.states:
        if state.name == name:
            value = as_expression(name, "rate", rate, (state.size, 1))
            density = None if noise is None else density_matrix(name, "noise density", noise, state.size)
            break
    else:
        matrix = next((entry for entry in own.matrices if entry.name == name and not entry.estimation), None)
        if matrix is None or noise is not None:
            raise ProblemError(
                f"dynamics() does not apply to '{name}'" + (" with noise." if matrix else "."),
                expected="a state, or a symmetric matrix without noise",
                received=f"'{name}'",
                remedy="unknowns are constant, and the estimation covariance has its rate already",
            )
        full = as_expression(name, "rate", rate, (matrix.size, matrix.size))
        check_symmetric(name, "rate", full)
        value, density = pack_symbolic(full), None
    if name in own.rates:
        raise ProblemError(
            f"The rate of '{name}' is given twice.",
            expected="one call of dynamics() for each state",
            received=f"a first one at {own.rates[name].where}",
            remedy="remove one of them",
        )
    one = density is not None and is_scalar(noise)
    entry = Dynamics(rate=value, noise=density, where=caller(), one_density=one)
    return own.adding(rates={name: entry})


def process_noise(own: Declarations) -> Any:
    """Density of the process noise of the augmented state, in the user's symbols; of the unknowns it is zero."""
    blocks: list[Any] = []
    for entry in own.augmented:
        given = own.rates.get(entry.name)
        size = error_size(entry)
        blocks.append(ca.MX(size, size) if given is None or given.noise is None else given.noise)
    return ca.diagcat(*blocks)
