"""The covariance X of the closed loop as a symbol of costs and conditions.

x is the augmented state, C the gain of the feedback du = -C x', Xhat the covariance of the estimate x' of its
deviation: what scatters is (x, u), with the covariance

    [E + Xhat, -Xhat C'; -C Xhat, C Xhat C'].

Terms of the cost that are linear in it are weights A, B, N, S(T) of the deviations, with which the best gain follows
from a Riccati equation as ever. Other terms, and conditions, are met by a gain whose entries are controls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.checks import caller, one_number
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr, Given
from covocp.base.matrices import half_indices, half_length, pack_symbolic, unpack_symbolic
from covocp.base.threads import methods_one_at_a_time
from covocp.problem.checks import check_name
from covocp.problem.declarations import Control, Declarations, Expansion, Expected, Gain, State, Unknown
from covocp.problem.estimation_covariance import block_between, with_estimation
from covocp.problem.matrices import Spread
from covocp.statement.entries import entry_names, error_names, error_size

SPREAD = "X"
# Variances are not smaller than this in expressions: a root has a slope where nothing scatters, as at the start.
SMALLEST_VARIANCE = 1e-100
LARGEST_ROUNDING = 1e100  # its square is a number


def with_closed_loop(declarations: Declarations) -> Declarations:
    """The declarations with the symbol of the covariance of the closed loop.

    Raises:
        ProblemError: called twice, nothing that scatters, no control, the name X is taken.
    """
    entries: list[Any] = [*declarations.augmented, *declarations.controls]
    check_name(SPREAD, list(declarations.taken))
    for what, calls, group in (
        ("state", "state() and unknown()", declarations.augmented),
        ("control", "control()", declarations.controls),
    ):
        if not group:
            raise ProblemError(
                f"There is no {what} whose covariance could be asked for.",
                expected=f"{calls} before closed_loop_covariance()",
                received="none",
                remedy="call closed_loop_covariance() after the last state(), unknown() and control()",
            )
    labels = error_names(entries)
    half = ca.MX.sym(SPREAD, half_length(len(labels)))
    spread = Spread(
        name=SPREAD,
        symbol=half,
        matrix=unpack_symbolic(half, len(labels)),
        size=len(labels),
        states=sum(error_size(entry) for entry in declarations.augmented),
        where=caller(),
        labels=labels,
    )
    return replace(declarations, spread=spread)


@methods_one_at_a_time
class ClosedLoopCovariance:
    """The covariance of the deviations of the actual system under feedback: of states, unknowns and controls.

    `X[a, b]` is the block between two symbols, names (also of components, "x[0]"), or expressions of them (to first
    order, by their Jacobians): X[x, x] = E + Xhat, X[u, u] = C Xhat C', X[x, u] = -Xhat C'.
    """

    _stands_for = SPREAD  # as a key of solutions

    def __init__(self, entries: tuple[State | Unknown | Control, ...], spread: Spread) -> None:
        """Keep the entries of states, unknowns and controls and the declared symbol."""
        self._entries, self._spread = entries, spread

    @classmethod
    def of(cls, declarations: Declarations) -> ClosedLoopCovariance:
        """That of declarations that have one."""
        assert declarations.spread is not None
        return cls((*declarations.augmented, *declarations.controls), declarations.spread)

    @property
    def matrix(self) -> ca.MX:
        """The covariance E + Xhat of the augmented state, shape (n, n)."""
        n = self._spread.states
        return self._spread.matrix[:n, :n]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the rows: states, unknowns, controls."""
        return self._spread.labels

    def __getitem__(self, key: Given) -> ca.MX:
        """Covariance between two symbols or names, shape (size of a, size of b).

        Raises:
            ProblemError: where a name is unknown, or an expression contains no state, unknown or control.
        """
        return block_between(SPREAD, self._spread.matrix, self._entries, self.labels, key)

    def deviation(self, symbol: Given, smallest: float = 0.0) -> ca.MX:
        """Standard deviation of a symbol, a name or an expression, as a column of its size.

        The root has no slope where nothing scatters: there, deviation and slope are zero.

        Args:
            symbol: a state, an unknown, a control, an entry or an expression of them.
            smallest: deviations are rounded to sqrt(variance + smallest^2), in the unit of the symbol; give one where
                the best gain may be zero, so that the root has a slope there.

        Raises:
            ProblemError: as for an entry; `smallest` negative.
        """
        rounding = one_number("deviation", "smallest", smallest)
        if not 0.0 <= rounding < LARGEST_ROUNDING:
            raise ProblemError(
                "The smallest deviation is not one.",
                expected=f"a number >= 0, less than {LARGEST_ROUNDING:g}, in the unit of the symbol",
                received=repr(smallest),
                remedy="correct smallest=",
            )
        variances = ca.diag(self[symbol, symbol])
        return ca.sqrt(ca.fmax(variances, SMALLEST_VARIANCE) + rounding**2)


def used_in(problem: Declarations, expression: Any) -> bool:
    """Whether an expression contains the covariance of the closed loop."""
    return problem.spread is not None and ca.depends_on(expression, problem.spread.symbol)


class CostParts(NamedTuple):
    """A cost without the covariance X, its weights of X (tr(W X)/2), and what is not linear in X; None: nothing."""

    plain: Any
    weights: Any
    rest: Any


def cost_parts(problem: Declarations, what: str, cost: Expr) -> CostParts:
    """Parts of a cost; terms that contain X are taken along the nominal.

    Raises:
        ProblemError: a terminal cost contains the deviations of a control.
    """
    spread = problem.spread
    if spread is None or not used_in(problem, cost):
        return CostParts(cost, None, None)
    half, n = spread.symbol, spread.size
    slope = ca.jacobian(cost, half)
    if what == "terminal cost":
        rows, columns = half_indices(n)
        for k in sorted(set(slope.sparsity().get_triplet()[1])):
            if max(rows[k], columns[k]) >= spread.states:
                raise ProblemError(
                    f"The terminal cost contains the deviation of the control '{spread.labels[rows[k]]}'.",
                    expected=f"{SPREAD} of states and unknowns: a control at one instant costs nothing",
                    received=str(cost)[:200],
                    remedy="put it into the running cost, or limit it by subject_to(..., at='final')",
                )
    if not ca.depends_on(slope, half):
        W = unpack_symbolic(slope.T, n)
        (plain,) = ca.substitute([cost], [half], [ca.MX.zeros(half.shape)])
        return CostParts(plain, W + ca.diag(ca.diag(W)), None)
    plain = _without(cost, half, n)
    return CostParts(plain, None, cost - plain)


def _without(cost: Expr, half: Any, n: int) -> Any:
    """A cost where nothing scatters; where that is no number, as of a logarithm, with the identity for X."""
    values = ca.MX.zeros(half.shape)
    (plain,) = ca.substitute([cost], [half], [values])
    symbols = ca.symvar(plain)
    some = [np.linspace(0.61, 0.83, symbol.numel()).reshape(symbol.shape) for symbol in symbols]
    try:
        there = ca.Function("plain", symbols, [plain])(*some) if symbols else ca.evalf(plain)
        if np.isfinite(there.full()).all():
            return plain
    except RuntimeError:  # CasADi's, of a factorisation: an inverse or a determinant of what is singular there
        pass
    (plain,) = ca.substitute([cost], [half], [pack_symbolic(ca.MX(ca.DM.eye(n)))])
    return plain


def split_cost(problem: Declarations) -> tuple[Declarations, CostParts, CostParts]:
    """The declarations with the expected cost of the actual system alone, and the parts of running and terminal."""
    expected = problem.expected
    assert expected is not None
    running = cost_parts(problem, "running cost", expected.running)
    terminal = cost_parts(problem, "terminal cost", expected.terminal)
    plain = replace(expected, running=running.plain, terminal=terminal.plain)
    return replace(problem, expected=plain), running, terminal


def reasons(problem: Declarations) -> tuple[str, ...]:
    """What asks for a gain that is chosen freely: conditions on X by name, and costs that are not linear in it."""
    if problem.spread is None or problem.expected is None:
        return ()
    names = [f"'{c.name}'" for c in problem.constraints if used_in(problem, c.expression)]
    own: Expected = problem.expected
    for what, cost in (("running cost", own.running), ("terminal cost", own.terminal)):
        if used_in(problem, cost) and cost_parts(problem, what, cost).rest is not None:
            names.append(f"the {what}")
    return tuple(names)


def free_gain(problem: Declarations) -> Gain | None:
    """The gain that is optimised: as it was given; without constraints where X asks for one; None for the best one."""
    expected = problem.expected
    if expected is None or expected.gain is not None:
        return None if expected is None else expected.gain
    return Gain() if reasons(problem) else None


def with_best_gain(problem: Declarations, *, conditions: bool) -> Declarations | None:
    """The problem with the best gain, without the terms of its cost that are not linear in X; None where it is that.

    Args:
        problem: with an expected cost.
        conditions: whether E, the least that X can be, stands for X in its conditions; else they are left out, and
            None is returned where there are none.
    """
    if problem.expected is None or (problem.expected.gain is None and not reasons(problem)):
        return None
    if not reasons(problem):
        return replace(problem, expected=replace(problem.expected, gain=None)) if conditions else None
    plain, running, terminal = split_cost(problem)
    assert problem.expected is not None
    assert plain.expected is not None
    expected = replace(
        plain.expected,
        running=problem.expected.running if running.rest is None else running.plain,
        terminal=problem.expected.terminal if terminal.rest is None else terminal.plain,
        gain=None,
    )
    if not conditions:
        kept = tuple(c for c in problem.constraints if not used_in(problem, c.expression))
        return replace(problem, expected=expected, constraints=kept)
    if not any(matrix.estimation for matrix in problem.matrices):
        problem = with_estimation(problem)
    assert problem.spread is not None
    E = next(matrix.matrix for matrix in problem.matrices if matrix.estimation)
    size, half = problem.spread.size, problem.spread.symbol
    rest = size - problem.spread.states
    least = floored(pack_symbolic(ca.densify(ca.diagcat(E, ca.MX(rest, rest)))), size)
    changed = tuple(
        replace(c, expression=ca.substitute([c.expression], [half], [least])[0]) for c in problem.constraints
    )
    constants: list[Any] = [*problem.parameters, *problem.unknowns]
    own = {symbol.__hash__() for symbol in (problem.time, *(entry.symbol for entry in constants))}
    kept = tuple(c for c in changed if any(s.__hash__() not in own for s in ca.symvar(c.expression)))
    return replace(problem, expected=expected, constraints=kept)


def with_weights(problem: Declarations, expansion: Expansion, running: CostParts, terminal: CostParts) -> Expansion:
    """The expansion with the weights of X, and with the terms that are not linear in it."""
    spread = problem.spread
    if spread is None:
        return expansion
    n = spread.states
    if running.weights is not None:
        W = running.weights
        expansion = replace(
            expansion,
            A=_folded(expansion.A + W[:n, :n]),
            B=_control_weight(problem, expansion.B, W[n:, n:]),
            N=_folded(expansion.N + W[:n, n:]),
            weighed=(W[:n, :n], W[:n, n:]),
        )
    if terminal.weights is not None:
        expansion = replace(expansion, end=_folded(expansion.end + terminal.weights[:n, :n]))
    if running.rest is None and terminal.rest is None:
        return expansion
    added = tuple(ca.MX(0) if part.rest is None else part.rest for part in (running, terminal))
    return replace(expansion, spread=(added[0], added[1]))


def _control_weight(problem: Declarations, own: Expr, added: Expr) -> Any:
    """The weight of the deviations of the controls with what X in the running cost adds to it.

    Raises:
        ProblemError: a number that is not positive definite: the more is fed back the less it costs.
    """
    weight = _folded(own + added)
    if ca.symvar(weight):
        return weight
    numbers = ca.evalf(weight).full()
    if np.linalg.eigvalsh(numbers)[0] > 0:
        return weight
    names = entry_names(problem.controls)
    first = np.flatnonzero(np.diag(numbers) <= 0)
    which = f"control '{names[first[0]]}'" if first.size else f"controls {', '.join(names)}"
    assert problem.expected is not None
    raise ProblemError(
        f"{SPREAD} in the running cost makes the weight of the deviations of the {which} no positive one.",
        expected="positive second derivatives by the controls, or control_weight=, that exceed what the terms of "
        f"{SPREAD} take away: the more is fed back the less it would cost",
        received=f"{ca.evalf(own).full().tolist()} of the rest and {ca.evalf(added).full().tolist()} of {SPREAD}"
        if not ca.symvar(ca.veccat(own, added))
        else f"weights {numbers.tolist()}",
        remedy=f"take less of {SPREAD} of the controls away from the running cost, or give control_weight={{...}}",
    )


def _folded(value: Expr) -> Any:
    """A matrix of numbers where nothing in it varies, without the entries that are zero."""
    return value if ca.symvar(value) else ca.MX(ca.sparsify(ca.evalf(value)))


def with_value(problem: Declarations, E: Expr, Xhat: Expr, gain: Expr) -> Declarations:
    """The declarations with the covariance of the closed loop in terms of E, Xhat and the gain."""
    if problem.spread is None:
        return problem
    fed = gain @ Xhat
    joint = ca.densify(ca.blockcat([[E + Xhat, -fed.T], [-fed, fed @ gain.T]]))
    value = pack_symbolic(joint)
    return replace(problem, spread=replace(problem.spread, value=floored(value, problem.spread.size)))


def floored(half: Any, size: int) -> Any:
    """A half-vector whose variances are positive, by next to nothing."""
    least = np.full(half_length(size), -np.inf)
    rows, columns = half_indices(size)
    least[rows == columns] = SMALLEST_VARIANCE
    return ca.vertcat(*(half[k] if np.isinf(least[k]) else ca.fmax(half[k], least[k]) for k in range(least.size)))


def check_order(problem: Declarations) -> None:
    """Everything that scatters is declared before X.

    Raises:
        ProblemError: a state, an unknown or a control was declared after it.
    """
    spread = problem.spread
    if spread is None:
        return
    labels = error_names([*problem.augmented, *problem.controls])
    if labels != spread.labels:
        raise ProblemError(
            "States, unknowns or controls were declared after closed_loop_covariance().",
            expected="closed_loop_covariance() after the last state(), unknown() and control()",
            received=f"rows {', '.join(spread.labels)} for {', '.join(labels)}",
            remedy="move the call down",
        )


def check_no_feedback(problem: Declarations) -> None:
    """A problem without an expected cost has no feedback whose covariance could be asked for.

    Raises:
        ProblemError: X is in a cost, a rate or a condition.
    """
    contents: list[tuple[str, Any]] = [(f"'{c.name}'", c.expression) for c in problem.constraints]
    contents += [("the cost", ca.veccat(*(problem.cost or ())))]
    for what, expression in contents:
        if used_in(problem, expression):
            raise ProblemError(
                f"The covariance {SPREAD} of the closed loop is in {what}, but nothing is fed back.",
                expected="minimize_expected(), which says what the feedback is for",
                received="minimize()" if problem.cost is not None else "no cost",
                remedy="state the cost by minimize_expected(); without feedback E = estimation_covariance() is the "
                "covariance of the deviations",
            )


def check_contents(contents: Mapping[str, Any], problem: Declarations) -> None:
    """X is in costs and conditions only: the actual system has no covariance.

    Raises:
        ProblemError: a rate, a noise, a measurement or a weight contains it.
    """
    for what, expression in contents.items():
        if used_in(problem, expression):
            raise ProblemError(
                f"The {what} contains the covariance {SPREAD} of the closed loop.",
                expected="states, unknowns, controls, parameters, time: the actual system has no covariance",
                received=str(expression)[:200],
                remedy=f"use {SPREAD} in running=, terminal= and subject_to()",
            )
