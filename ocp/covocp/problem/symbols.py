"""The user's symbols with the data that they were given: vector states, unknowns, parameters and controls."""

from __future__ import annotations

from typing import Any

import casadi as ca

from covocp.base.checks import bound_columns, caller, column, density_matrix
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.problem.boundary_values import end_value
from covocp.problem.checks import scale_column
from covocp.problem.declarations import Control, Guess, Parameter, State, Unknown


def new_symbol(name: str, size: int, unit: str) -> dict[str, Any]:
    """What every symbol has."""
    return {"name": name, "symbol": ca.MX.sym(name, size), "size": size, "where": caller(), "unit": unit}


def vector_state(
    own: dict[str, Any],
    ends: tuple[Given, Given],
    bounds: tuple[Given, Given],
    guess: Guess,
    scale: Given,
    variance: Given,
) -> State:
    """A vector state of the nominal; arguments and errors as of `Problem.state`.

    Args:
        own: what every symbol has.
        ends: initial and final values.
        bounds: lower and upper.
        guess: as it was given.
        scale: typical magnitude.
        variance: of the error of the initial estimate.
    """
    name, size = own["name"], own["size"]
    low, high = bound_columns(name, *bounds, size)
    return State(
        **own,
        initial=end_value(name, "initial", ends[0], low, high),
        final=end_value(name, "final", ends[1], low, high),
        lower=low,
        upper=high,
        guess=guess,
        scale=scale_column(name, scale, size),
        variance=density_matrix(name, "variance", 0.0 if variance is None else variance, size),
    )


def control_vector(own: dict[str, Any], bounds: tuple[Given, Given], guess: Guess, scale: Given) -> Control:
    """A control; arguments and errors as of `Problem.control`."""
    name, size = own["name"], own["size"]
    low, high = bound_columns(name, *bounds, size)
    return Control(**own, lower=low, upper=high, guess=guess, scale=scale_column(name, scale, size))


def unknown_constant(own: dict[str, Any], mean: Given, variance: Given) -> Unknown:
    """A constant of the actual system with its statistics; arguments and errors as of `Problem.unknown`."""
    name, size = own["name"], own["size"]
    values = column(name, "mean", mean, size)
    return Unknown(**own, mean=values, variance=density_matrix(name, "variance", variance, size))


def known_parameter(own: dict[str, Any], value: Given, numbers: Array) -> Parameter:
    """Known numbers, those of a matrix stacked by columns; arguments and errors as of `Problem.parameter`.

    Args:
        own: what every symbol has.
        value: as it was given.
        numbers: the same as an array.
    """
    name, size = own["name"], own["size"]
    if numbers.ndim != 2 or 1 in numbers.shape:
        return Parameter(**own, value=column(name, "value", value, size))
    stacked = column(name, "value", numbers.ravel(order="F"), size)
    return Parameter(**own, value=stacked, columns=numbers.shape[1])


def in_its_shape(parameter: Parameter) -> ca.MX:
    """The symbol of a parameter as its value was given: a column, or a matrix."""
    if parameter.columns == 1:
        return parameter.symbol
    matrix: Any = ca.reshape(parameter.symbol, parameter.size // parameter.columns, parameter.columns)
    matrix._stands_for = parameter.name  # as a key of new values
    return matrix  # type: ignore[no-any-return]
