"""Slopes by the augmented state: by the entries of vectors, by the tangents of states that are no vectors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca

from covocp.base.expressions import Expr
from covocp.problem.declarations import Declarations
from covocp.statement.entries import error_size


def tangent_slope(expression: Expr, entry: Any) -> Any:
    """Jacobian of an expression by a declared state or unknown, of an attitude by its rotation in body axes."""
    slope = ca.jacobian(expression, entry.symbol)
    chart = getattr(entry, "chart", None)
    return slope if chart is None else slope @ chart.basis(entry.symbol)


def tangent_rate(problem: Declarations, entry: Any) -> Any:
    """Velocity of the tangent of a declared state, that of a vector its rate."""
    rate, chart = problem.rates[entry.name].rate, entry.chart
    return rate if chart is None else chart.velocity(entry.symbol, rate)


class Moved(NamedTuple):
    """Symbols by which expressions are differentiated, and how expressions are written in them.

    by: a symbol for each entry of the augmented state: its own, or the tangent by which it is moved. tangents, states,
    values: those tangents, the states that have one, and these moved.
    """

    by: list[Any]
    tangents: list[Any]
    states: list[Any]
    values: list[Any]

    def write(self, expression: Expr) -> Any:
        """An expression with the states that have a tangent moved by it."""
        return ca.substitute([expression], self.states, self.values)[0] if self.states else expression

    def at_rest(self, expression: Expr) -> Any:
        """The same where the tangents are zero."""
        zeros = [ca.MX.zeros(symbol.shape[0]) for symbol in self.tangents]
        return ca.substitute([expression], self.tangents, zeros)[0] if zeros else expression


def moved(entries: Sequence[Any]) -> Moved:
    """The augmented state, moved by tangents where it is no vector."""
    result = Moved([], [], [], [])
    for entry in entries:
        chart = getattr(entry, "chart", None)
        if chart is None:
            result.by.append(entry.symbol)
            continue
        tangent = ca.MX.sym(f"d {entry.name}", chart.tangent)
        result.by.append(tangent)
        result.tangents.append(tangent)
        result.states.append(entry.symbol)
        result.values.append(chart.move(entry.symbol, tangent))
    return result


def drift(problem: Declarations) -> Any:
    """What two states that move along each other differ by, over the augmented state; zero where all are vectors."""
    blocks = []
    for entry in problem.augmented:
        chart, size = getattr(entry, "chart", None), error_size(entry)
        blocks.append(ca.MX(size, size) if chart is None else chart.drift(tangent_rate(problem, entry)))
    return ca.diagcat(*blocks)
