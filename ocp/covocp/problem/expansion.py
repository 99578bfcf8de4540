"""The actual system to second order about the nominal [Schmidt 6.2, 6.3]: slopes, second derivatives and weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.checks import density_matrix
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.problem.checks import check_dynamics
from covocp.problem.declarations import Declarations, Expansion, Expected
from covocp.problem.rates import process_noise
from covocp.problem.tangents import Moved, drift, moved, tangent_rate
from covocp.statement.entries import entry_names, error_size


def expand(problem: Declarations, expected: Expected, later: Expr = None) -> Expansion:
    """Slopes of the rates and second derivatives of the cost [Schmidt 6.2, 6.3]; the gain is not known yet.

    `later` is what deviations at the end cost in phases that follow; None: nothing.
    """
    rates = _rates(problem)
    at = moved(problem.augmented)
    controls = [entry.symbol for entry in problem.controls]
    running, terminal = at.write(expected.running), at.write(expected.terminal)
    by_state = slope_by(running, at.by).T
    at_end = slope_by(terminal, at.by).T
    weight = _weight_matrix(expected.terminal_weight, problem.augmented, "terminal weight")
    end = at.at_rest(slope_by(at_end, at.by))
    end = end if weight is None else end + weight  # a zero that is added to an empty matrix of one row fills it
    _check_terminal_weights(problem, end if later is None else end + later)
    return Expansion(
        F=_drift(problem, at, rates),
        G=slope_by(rates, controls),
        A=at.at_rest(slope_by(by_state, at.by)),
        B=_control_weights(problem, expected, slope_by(slope_by(expected.running, controls).T, controls)),
        N=at.at_rest(slope_by(by_state, controls)),
        Q=process_noise(problem),
        end=end,
        running=expected.running,
        terminal=expected.terminal,
        gain=ca.MX(),
    )


def _drift(problem: Declarations, at: Moved, rates: Expr) -> Any:
    """F: slope of the rates, and what two states differ by that move along each other."""
    slope = at.at_rest(slope_by(at.write(rates), at.by))
    return slope + drift(problem) if at.states else slope


def augmented_drift(problem: Declarations) -> Any:
    """F of the augmented state, shape (n, n)."""
    return _drift(problem, moved(problem.augmented), _rates(problem))


def _rates(problem: Declarations) -> Any:
    """Velocity of the augmented state."""
    check_dynamics(problem.states, problem.rates)
    moving = [state for state in problem.states if state.role == "moving"]
    count = sum(entry.size for entry in problem.unknowns)
    return ca.vertcat(*(tangent_rate(problem, state) for state in moving), ca.MX(count, 1))


def augmented_slope(problem: Declarations, expression: Expr) -> Any:
    """Slope of an expression by the augmented state."""
    at = moved(problem.augmented)
    return at.at_rest(slope_by(at.write(expression), at.by))


def measurement_slope(problem: Declarations, size: int) -> tuple[Any, Any]:
    """M and U of the continuous measurements."""
    if not problem.continuous:
        return ca.MX(0, size), ca.MX(0, 0)
    value = ca.vertcat(*(m.expression for m in problem.continuous))
    return augmented_slope(problem, value), ca.diagcat(*(m.noise for m in problem.continuous))


def slope_by(expression: Expr, symbols: list[Any]) -> Any:
    """Jacobian by several symbols, side by side.

    An interpolation table expands to scalar operations and its derivative does not, so that of its expansion is taken.
    """
    slope = ca.horzcat(*(ca.jacobian(expression, symbol) for symbol in symbols))
    own = ca.symvar(expression)
    try:
        ca.Function("slope", own, [slope]).expand()
    except RuntimeError:
        try:
            expression = ca.Function("expression", own, [expression]).expand()(*own)
        except RuntimeError:  # nor does the expression: the statement is in matrix operations
            return slope
        slope = ca.horzcat(*(ca.jacobian(expression, symbol) for symbol in symbols))
    return slope


def _weight_matrix(weights: Expr, entries: Sequence[Any], what: str) -> Any:
    """One matrix over some entries from weights by name, a number or a matrix; None without weights."""
    if weights is None:
        return None
    if isinstance(weights, Mapping):
        return ca.diagcat(*(weights.get(e.name, ca.MX(error_size(e), error_size(e))) for e in entries))
    return density_matrix("minimize_expected", what, weights, sum(error_size(e) for e in entries))


def _control_weights(problem: Declarations, expected: Expected, curvature: Expr) -> Any:
    """B: the given weights, L_uu where none is given [Schmidt 6.6]; every control needs one."""
    given = expected.control_weight
    if given is None:
        weights = curvature
    elif not isinstance(given, Mapping):
        weights = _weight_matrix(given, problem.controls, "control weight")
    else:
        rows = []
        for a in problem.controls:
            blocks = []
            for b in problem.controls:
                block = ca.jacobian(ca.gradient(expected.running, a.symbol), b.symbol)
                replaced = a.name in given or b.name in given
                blocks.append((given[a.name] if a is b else ca.MX(a.size, b.size)) if replaced else block)
            rows.append(ca.horzcat(*blocks))
        weights = ca.vertcat(*rows)
    names = entry_names(problem.controls)
    constant = not ca.symvar(weights)  # constants that CasADi has not folded among them
    numbers = ca.evalf(weights).full() if constant else None
    for i, name in enumerate(names):
        if not weights.sparsity().has_nz(i, i) or (numbers is not None and numbers[i, i] == 0):
            raise ProblemError(
                f"The control '{name}' has no weight: the second derivative of the running cost by it is zero.",
                expected="a positive weight of its deviations, or the feedback gain would be infinite",
                received=f"running = {expected.running}",
                remedy=f"give control_weight={{{name.split('[')[0]}: ...}} to minimize_expected()",
            )
    if numbers is not None and np.linalg.eigvalsh(numbers)[0] <= 0:
        raise ProblemError(
            f"The weight of the controls {', '.join(names)} is not positive definite.",
            expected="a minimum of the running cost by the controls, or control_weight= in its place",
            received=f"second derivatives {numbers.tolist()}",
            remedy="give control_weight={...} to minimize_expected(), or correct the running cost",
        )
    return ca.sparsify(ca.evalf(weights)) if constant else weights


def _check_terminal_weights(problem: Declarations, end: Expr) -> None:
    """A prescribed final value needs a weight: the nominal meets it, the actual system will miss it (case 2)."""
    offset = 0
    for state in (entry for entry in problem.states if entry.role == "moving"):
        free = [state.target is None] * error_size(state)
        if state.chart is None and state.final.is_constant():
            free = np.isnan(ca.evalf(state.final).full()).ravel().tolist()
        for i in range(error_size(state)):
            if not free[i] and not end.sparsity().has_nz(offset + i, offset + i):
                raise ProblemError(
                    f"The final value of '{state.name}' is prescribed, but nothing says what missing it costs.",
                    expected="a weight of its deviation at the end: only the nominal meets a terminal condition "
                    "exactly, the actual system scatters around it",
                    received=f"final value of {state.name}, no terminal cost or weight of it",
                    remedy=f"give terminal_weight={{{state.name}: ...}} to minimize_expected(); 0 if it is free "
                    "to scatter",
                )
        offset += error_size(state)
