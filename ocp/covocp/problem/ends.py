"""Initial and final values in a statement: functions of the parameters, and what decisions give of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr, above
from covocp.problem.decisions import check_matrix, decisions_of
from covocp.problem.declarations import Constraint, Declarations, Place
from covocp.statement.entries import entry_names, half_names
from covocp.statement.statement import Tied

OUTPUTS = ("initial_state", "final_state", "initial_matrices", "final_matrices")


def with_end_conditions(problem: Declarations) -> Declarations:
    """The problem with a condition for each initial state, and each final value, that a decision gives.

    Initial matrices have none: they are inserted where the matrices start, see `tied_values`.
    """
    decisions = decisions_of(problem)
    if not decisions:
        return problem
    symbols = ca.vertcat(*(entry.symbol for entry in decisions))
    for matrix in problem.matrices:
        check_matrix(matrix.name, matrix, decisions)
    conditions: list[Constraint] = []
    places: tuple[tuple[Place, Iterable[Any]], ...] = (
        ("initial", problem.states),
        ("final", problem.states),
        ("final", [m for m in problem.matrices if m.final is not None]),
    )
    for place, entries in places:
        for entry in entries:
            value = getattr(entry, place)
            rows = _dependent(value, symbols)
            names = half_names(entry.name, entry.labels) if hasattr(entry, "labels") else entry_names((entry,))
            for k in rows:
                zero = np.zeros(1)
                conditions.append(
                    Constraint(
                        name=f"{place} value of {names[k]}",
                        expression=entry.symbol[k] - value[k],
                        lower=zero,
                        upper=zero,
                        at=place,
                        where=entry.where,
                    )
                )
    return replace(problem, constraints=(*problem.constraints, *conditions))


def boundary(problem: Declarations) -> ca.Function:
    """Initial and final values of states and matrices as functions of the parameters; NaN: free, or a decision's."""
    decisions, outputs = decisions_of(problem), _outputs(problem)
    chosen = {symbol.__hash__() for entry in decisions for symbol in ca.symvar(entry.symbol)}
    own = [q.symbol for q in _fixed(problem)]
    known = {symbol.__hash__() for symbol in own}
    for symbol in ca.symvar(ca.veccat(*outputs)):
        if symbol.__hash__() not in known | chosen:
            raise ProblemError(
                f"An initial or final value contains '{symbol.name()}'.",
                expected="numbers, or expressions of parameters and decisions of this problem",
                received=f"'{symbol.name()}'",
                remedy="use subject_to(..., at='initial' or 'final') for conditions between variables",
            )
    function = ca.Function("boundary", [*own, *(entry.symbol for entry in decisions)], outputs)
    p, arguments = _split("parameters", own)
    guesses: list[Any] = [entry.guess for entry in decisions]
    values: list[Any] = list(function.call([*arguments, *(ca.DM(guess) for guess in guesses)], True, False))
    for i, value in enumerate(outputs if decisions else ()):
        rows = list(_dependent(value, _decision_symbols(problem)))
        if rows:
            kept = [ca.MX(ca.DM.nan(1)) if k in rows else values[i][k] for k in range(value.shape[0])]
            values[i] = ca.vertcat(*kept)
    return ca.Function("boundary", [p], values, ["parameters"], list(OUTPUTS))


def tied_values(problem: Declarations) -> Tied | None:
    """Initial values that decisions give; None where they give none."""
    if not decisions_of(problem):
        return None
    symbols, outputs = _decision_symbols(problem), _outputs(problem)
    states, matrices = (_dependent(outputs[i], symbols) for i in (0, 2))
    if not states and not matrices:
        return None
    groups = [[q.symbol for q in problem.states], [q.symbol for q in _fixed(problem)]]
    x, of_state = _split("state", groups[0])
    p, of_parameters = _split("parameters", groups[1])
    # of a column of one entry CasADi's empty part is a row
    chosen = [outputs[i][list(rows)] if rows else ca.MX(0, 1) for i, rows in ((0, states), (2, matrices))]
    function = ca.Function("tied", [*groups[0], *groups[1]], chosen)
    values = function.call([*of_state, *of_parameters], True, False)
    return Tied(
        states=states,
        matrices=matrices,
        function=ca.Function("tied", [x, p], values, ["state", "parameters"], ["initial_state", "initial_matrices"]),
        slopes=ca.Function("tied_slopes", [x, p], [ca.densify(ca.jacobian(ca.vertcat(*values), x))]),
    )


def _outputs(problem: Declarations) -> list[Any]:
    """Initial and final states and half-vectors, as columns."""
    free = [ca.MX(ca.DM.nan(entry.symbol.shape)) for entry in problem.matrices]
    pairs = list(zip(problem.matrices, free, strict=True))
    groups = (
        [entry.initial for entry in problem.states],
        [entry.final for entry in problem.states],
        [nan if m.initial is None else m.initial for m, nan in pairs],
        [nan if m.final is None else m.final for m, nan in pairs],
    )
    return [above(group) for group in groups]


def _fixed(problem: Declarations) -> list[Any]:
    """What the parameters of a statement stack."""
    return [*problem.parameters, *problem.unknowns]


def _decision_symbols(problem: Declarations) -> Any:
    return ca.vertcat(ca.MX(0, 1), *(entry.symbol for entry in decisions_of(problem)))


def _dependent(value: Expr, symbols: Expr) -> tuple[int, ...]:
    """Rows of a column that depend on some symbols."""
    own = ca.symvar(symbols)
    if not own:
        return ()
    others = [s for s in ca.symvar(value) if s.__hash__() not in {o.__hash__() for o in own}]
    function = ca.Function("value", [*own, *others], [ca.densify(value)])
    rows: set[int] = set()
    for i in range(len(own)):
        rows |= set(function.jac_sparsity(0, i).row())
    return tuple(sorted(rows))


def _split(name: str, symbols: list[Any]) -> tuple[Any, list[Any]]:
    """One column for several symbols, and its parts in their place."""
    offsets: list[int] = np.cumsum([0, *(symbol.shape[0] for symbol in symbols)]).tolist()
    column = ca.MX.sym(name, offsets[-1])
    return column, [column[i:j] for i, j in pairwise(offsets)]
