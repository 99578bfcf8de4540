"""Expected costs of several phases: one feedback through all of them, whose weight S runs backward over the links.

Where x+ = J(x) with the tangent J_x, deviations and their estimates go on as dx+ = J_x dx + noise, dx'+ = J_x dx'. So
E+ = J_x E J_x' + N, Xhat+ = J_x Xhat J_x', and what deviations before the jump cost afterwards is 1/2 tr J_x' S+ J_x X:

    S(T) = k_xx + weights + J_x' S+(0) J_x.

The noise of a jump costs 1/2 tr S+ N, which E+ already contains. In the form of the cost that is optimised (the third
one of `expected_cost`) each phase has 1/2 tr (k_xx + weights) E at its end, its own integral, and nothing of the jump.

Where one phase asks for a gain that is no best one (`gain=`, or a condition or a nonlinear cost of the covariance of
the closed loop), that of every phase is optimised: what feedback before it and after it is worth depends on what the
condition costs, which no S knows. Then E and Xhat run forward through all phases, and the cost is the sum of (E-1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NoReturn

import casadi as ca
import numpy as np

from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.matrices import half_length, unpack_symbolic
from covocp.problem.closed_loop_covariance import check_no_feedback, free_gain, reasons
from covocp.problem.declarations import Declarations, Gain, Parameter
from covocp.problem.expansion import slope_by
from covocp.problem.expected_cost import FEEDBACK, check_random, derive
from covocp.statement.entries import error_size
from covocp.statement.statement import Statement

# Name of the parameter of a phase that stands for S where the next one begins.
WEIGHT = f"{FEEDBACK}(T)"
Jumps = Mapping[str, Any]


def with_feedback(phases: Sequence[Declarations], jumps: Sequence[Jumps]) -> list[Declarations]:
    """The phases with the problems that are derived from their expected costs; as they are where there are none.

    Args:
        phases: what is declared in each.
        jumps: by name of the state, those into each phase.

    Raises:
        ProblemError: some phases have an expected cost and others not, or what `derive` says of a phase.
    """
    expected = [phase.expected is not None for phase in phases]
    if not any(expected):
        for phase in phases:
            check_no_feedback(phase)
        return list(phases)
    for phase in phases:
        _check_feedback(phase)
    check_random(phases)
    gains, shared = gains_of(phases), shares_gains(phases)
    result = []
    for k, phase in enumerate(phases):
        later = None
        if k + 1 < len(phases) and gains is None:
            phase, later = _followed(phase, phases[k + 1], jumps[k + 1])
        elif k + 1 < len(phases):
            J = tangent(phase, phases[k + 1], jumps[k + 1])[1]
            later = J.T @ J  # what goes on: its pattern alone counts
        try:
            own = derive(phase, part=True, later=later, gain=None if gains is None else gains[k])
        except ProblemError as error:
            raise in_phase(phase, error) from error
        assert own.expansion is not None
        result.append(replace(own, expansion=replace(own.expansion, shared=shared)))
    return result


def shares_gains(phases: Sequence[Declarations]) -> bool:
    """Whether some gain is optimised that no `Gain` of its phase describes: then all of them start from the best."""
    if any(phase.expected is None for phase in phases) or gains_of(phases) is None:
        return False
    return any(phase.expected is not None and (phase.expected.gain is None or reasons(phase)) for phase in phases)


def gains_of(phases: Sequence[Declarations]) -> tuple[Gain, ...] | None:
    """The gain of each phase, all of them optimised where one phase asks for it; None for the best one in all."""
    gains = [free_gain(phase) for phase in phases]
    if all(gain is None for gain in gains):
        return None
    return tuple(Gain() if gain is None else gain for gain in gains)


def in_phase(phase: Declarations | Statement, error: ProblemError) -> ProblemError:
    """What is wrong with a phase, said with its name."""
    own = {name: getattr(error, name) for name in ("expected", "received", "remedy")}
    return ProblemError(f"In the phase '{phase.name}': {error.problem}", **own)


def _check_feedback(phase: Declarations) -> None:
    """One kind of cost in all phases."""
    if phase.expected is None:
        stated = "minimize()" if phase.cost is not None else "no cost"
        _refuse(
            f"The phase '{phase.name}' has no expected cost, and others have one: one feedback goes through all.",
            "minimize_expected() in every phase, or minimize() in all of them",
            stated,
            f"state what control and deviations cost in '{phase.name}' by minimize_expected()",
        )


def _refuse(what: str, expected: str, received: str, remedy: str) -> NoReturn:
    raise ProblemError(what, expected=expected, received=received, remedy=remedy)


def _followed(before: Declarations, after: Declarations, jumps: Jumps) -> tuple[Declarations, Any]:
    """A phase with S of the next one as a parameter, and J' S J of it: what deviations at its end cost later."""
    size = sum(error_size(entry) for entry in after.augmented)
    count = half_length(size)
    symbol = ca.MX.sym(WEIGHT, count)
    J = tangent(before, after, jumps)[1]
    where, value = "minimize_expected()", np.zeros(count)
    weight = Parameter(name=WEIGHT, symbol=symbol, size=count, where=where, unit="", value=value)
    return before.adding(parameters=weight), J.T @ unpack_symbolic(symbol, size) @ J


def tangent(before: Declarations, after: Declarations, jumps: Jumps) -> tuple[Any, Any, Any]:
    """What the later augmented state is by the one before, at the end of that: J(x), its tangent J_x, added variances.

    The identity where something goes on, the tangent of a jump, zero where a state appears; the added variances are the
    noise of the jumps and the variances of what appears.
    """
    columns = before.augmented
    own = {entry.name: entry for entry in columns}
    values: list[Any] = []
    added: list[Any] = []
    for entry in after.augmented:
        value, noise = ca.MX.zeros(entry.size, 1), ca.MX(entry.size, entry.size)
        if entry.name in jumps:
            value, noise = jumps[entry.name].expression, jumps[entry.name].noise
        elif entry.name in own:
            value = own[entry.name].symbol
        else:
            noise = entry.variance
        values.append(value)
        added.append(noise)
    everything = ca.vertcat(*values)
    return everything, ca.horzcat(*(ca.jacobian(everything, column.symbol) for column in columns)), ca.diagcat(*added)


def deviations(before: Declarations, after: Declarations, jumps: Jumps, covariance: Expr) -> list[Any]:
    """J_x, added variances, and half the trace of the second derivatives of J with a covariance of what was before."""
    value, J, added = tangent(before, after, jumps)
    symbols = [entry.symbol for entry in before.augmented]
    bent = [ca.dot(ca.densify(slope_by(J[i, :].T, symbols)), covariance) / 2 for i in range(value.shape[0])]
    return [J, added, ca.vertcat(*bent)]
