"""Conditions on probabilities: what the actual system meets with a given probability, by its linearised spread.

An expression y of states, unknowns and controls scatters about its value along the nominal by the variance
s^2 = J X J', J its slopes. With a feedback X is the covariance of the closed loop, E + Xhat and that of the controls.
Without one nothing that is measured changes what the system does: X is then the covariance that nobody measures,

    dX/dt = F X + X F' + Q,      X(0) = E(0),

not that of the filter's error. It is a matrix of the problem; where nothing is measured it is E itself.

With one limit the condition is y + q s <= upper, q the quantile; with two it is exact (`base.normal`). Several rows
keep their limits together where each takes an equal share of the risk (Boole's bound: no joint law is needed).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.checks import caller, one_number
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import pack_symbolic
from covocp.base.normal import quantile, two_sided
from covocp.problem.checks import (
    check_constrains,
    check_known_limits,
    check_name,
    check_size,
    column_expression,
    limit_columns,
)
from covocp.problem.closed_loop_covariance import LARGEST_ROUNDING, SMALLEST_VARIANCE, SPREAD, with_closed_loop
from covocp.problem.constraints import check_place
from covocp.problem.declarations import Chance, Constraint, Declarations, Dynamics
from covocp.problem.estimation_covariance import with_estimation
from covocp.problem.expansion import augmented_drift, augmented_slope, slope_by
from covocp.problem.integrals import integrals_of
from covocp.problem.matrices import declare_matrix
from covocp.problem.rates import process_noise

# Probabilities are between these, with two limits not less than the last: numbers next to one have few digits left.
LEAST, MOST, LEAST_TWO_SIDED = 1e-12, 1.0 - 1e-12, 0.1


def with_chance(
    own: Declarations,
    expression: Given,
    lower: Given,
    upper: Given,
    at: Given,
    name: str | None,
    **given: Any,
) -> Declarations:
    """The declarations with one more condition on a probability; arguments and errors as of `Problem.chance`."""
    count = len(own.chances) + sum(c.chance is not None for c in own.constraints)
    label = f"chance {count + 1}" if name is None else name
    check_place(label, at, instants=False)
    value = column_expression(label, "chance", expression)
    check_constrains(label, value, [*(q.symbol for q in own.parameters), own.time])
    check_name(label, list(own.named))
    if lower is None and upper is None:
        raise ProblemError(
            f"'{label}' has no limit.",
            expected="lower=, upper= or both",
            received="neither",
            remedy="say between which limits the expression is to stay",
        )
    check_known_limits("chance", label, value, {"lower": lower, "upper": upper})
    low, high = limit_columns(label, lower, upper, check_size(label, value.shape[0]))
    for i in np.flatnonzero(low == high):
        raise ProblemError(
            f"The limits of '{label}'{f', component {i},' if low.size > 1 else ''} are equal.",
            expected="lower < upper: a number that scatters meets an equality with the probability zero",
            received=f"lower = upper = {low[i]:g}",
            remedy="give the limits that it may keep; for the nominal alone use subject_to()",
        )
    joint, smallest = given["joint"], one_number("chance", "smallest", given["smallest"])
    if not 0.0 <= smallest < LARGEST_ROUNDING:
        raise ProblemError(
            f"The smallest deviation of '{label}' is not one.",
            expected=f"a number >= 0, less than {LARGEST_ROUNDING:g}, in the unit of the expression",
            received=repr(given["smallest"]),
            remedy="correct smallest=",
        )
    entry = Chance(
        name=label,
        expression=value,
        lower=low,
        upper=high,
        probability=_probability(label, given["probability"]),
        joint=bool(joint) and low.size > 1,
        smallest=smallest,
        at=at,
        where=caller(),
    )
    _check_each(entry)
    _check_contents(own, entry)
    return own.adding(chances=entry)


def _probability(label: str, given: Given) -> float:
    """A probability that can be met, and that is not met anyway."""
    value = one_number(label, "probability", given)
    if not LEAST <= value <= MOST:
        raise ProblemError(
            f"The probability of '{label}' is none that can be asked for.",
            expected=f"a number inside (0, 1), from {LEAST:g} to 1 - {1.0 - MOST:.0g}",
            received=repr(given),
            remedy="give the share of the runs that are to meet it, as 0.99; what holds always is for subject_to()",
        )
    return value


def _check_each(entry: Chance) -> None:
    """What a row is asked for has a number."""
    both = bool((np.isfinite(entry.lower) & np.isfinite(entry.upper)).any())
    if both and entry.each < LEAST_TWO_SIDED:
        raise ProblemError(
            f"The probability of '{entry.name}' is too small for two limits.",
            expected=f"at least {LEAST_TWO_SIDED:g} between two limits",
            received=repr(entry.each),
            remedy="leave one limit out, or ask for more",
        )
    if entry.each > MOST:
        raise ProblemError(
            f"The share of the risk of each row of '{entry.name}' is too small.",
            expected=f"(1 - probability) / rows of at least {1.0 - MOST:.0g}",
            received=f"{(1.0 - entry.probability) / entry.lower.size:.2g}",
            remedy="ask for less, or for fewer rows together",
        )


def _check_contents(own: Declarations, entry: Chance) -> None:
    """What scatters is states, unknowns and controls of this problem; an integral along the nominal is neither."""
    for integral in integrals_of(own):
        if ca.depends_on(entry.expression, integral.symbol):
            raise ProblemError(
                f"'{entry.name}' contains the integral '{integral.name}'.",
                expected="states, unknowns, controls, decisions, parameters, time",
                received=str(entry.expression)[:200],
                remedy="an integral is one number along the nominal; for one that scatters declare a state with this "
                "rate, initial=0",
            )
    matrices: list[Any] = [*own.matrices, *(() if own.spread is None else (own.spread,))]
    for matrix in matrices:
        if ca.depends_on(entry.expression, matrix.symbol):
            raise ProblemError(
                f"'{entry.name}' contains the matrix '{matrix.name}'.",
                expected="the expression whose spread is meant, without covariances",
                received=str(entry.expression)[:200],
                remedy="leave the matrix out: chance() adds the spread itself; or state the condition by subject_to()",
            )


def with_chance_conditions(own: Declarations) -> Declarations:
    """The declarations with constraints in place of the conditions on probabilities, and with what scatters in them.

    Where the cost or a rate is missing they stay what they are.

    Raises:
        ProblemError: nothing scatters in one of them, a name is taken.
    """
    missing = any(state.name not in own.rates for state in own.states if state.role == "moving")
    if not own.chances or missing or (own.cost is None and own.expected is None):
        return own
    if own.expected is not None:
        return with_loop_chances(own)
    chances, own = own.chances, replace(own, chances=())
    own, covariance, name = with_open_loop(own, bool(own.measurements))
    return with_conditions(own, chances, covariance, name)


def with_loop_chances(own: Declarations) -> Declarations:
    """The declarations of an expected cost with its conditions on probabilities as those on the closed loop.

    Raises:
        ProblemError: nothing scatters in one of them, a name is taken.
    """
    chances, own = own.chances, replace(own, chances=())
    if not chances:
        return own
    own = with_closed_loop(own) if own.spread is None else own
    assert own.spread is not None
    return with_conditions(own, chances, own.spread.matrix, None)


def with_conditions(own: Declarations, chances: tuple[Chance, ...], covariance: Any, name: str | None) -> Declarations:
    """The declarations with constraints that conditions on probabilities are.

    Args:
        own: the declarations.
        chances: the conditions.
        covariance: of augmented state and, with feedback, controls.
        name: of the matrix that it is; None: it is that of the closed loop.

    Raises:
        ProblemError: nothing scatters in one of them.
    """
    controls = [control.symbol for control in own.controls] if name is None else []
    for entry in chances:
        by_state = augmented_slope(own, entry.expression)
        by_control = slope_by(entry.expression, controls) if controls else ca.MX(entry.lower.size, 0)
        known = replace(entry, slopes=(by_state, by_control), spread=name)
        _check_scatters(known, name is None)
        own = own.adding(constraints=_condition(known, ca.horzcat(by_state, by_control), covariance))
    return own


def with_open_loop(own: Declarations, measured: bool) -> tuple[Declarations, Any, str]:
    """The declarations with the covariance of the actual system without feedback, that matrix and its name.

    Args:
        own: the declarations.
        measured: whether anything is measured, here or in a phase beside; if not it is E.
    """
    error = next((matrix for matrix in own.matrices if matrix.estimation), None)
    if not measured:
        if error is None:
            own = with_estimation(own)
            error = next(matrix for matrix in own.matrices if matrix.estimation)
        return own, error.matrix, error.name
    if error is None:
        with_it = with_estimation(own)  # for its labels and its first value alone
        error = next(matrix for matrix in with_it.matrices if matrix.estimation)
    check_name(SPREAD, list(own.taken))
    matrix = declare_matrix(SPREAD, labels=error.labels, where=caller(), lower=0.0, covariance=True)
    matrix = replace(matrix, initial=error.initial, unmeasured=True)
    moved = augmented_drift(own) @ matrix.matrix
    rate = pack_symbolic(ca.densify(moved + moved.T + process_noise(own)))
    own = own.adding(matrices=matrix, rates={SPREAD: Dynamics(rate=rate, noise=None, where=caller())})
    return own, matrix.matrix, SPREAD


def uncertainties(own: Declarations) -> list[Any]:
    """All variances and densities that say what is uncertain in a problem."""
    started: list[Any] = [q.variance for q in own.augmented] + [m.initial for m in own.matrices if m.estimation]
    return started + [rate.noise for rate in own.rates.values() if rate.noise is not None]


def check_uncertain(chances: Sequence[Chance], uncertain: list[Any]) -> None:
    """Something is uncertain where probabilities are asked for."""
    if chances and all(value.is_constant() and not np.any(ca.evalf(value).full()) for value in uncertain):
        raise ProblemError(
            f"'{chances[0].name}' asks for a probability, but nothing in the system is uncertain.",
            expected="variance= of a state or an unknown, or noise= in dynamics()",
            received="no initial variance and no process noise",
            remedy="say what is uncertain, or use subject_to()",
        )


def _check_scatters(entry: Chance, fed_back: bool) -> None:
    """Every row contains something that scatters."""
    assert entry.slopes is not None
    slopes = ca.horzcat(*entry.slopes)
    rows = set(slopes.sparsity().row())
    for i in range(entry.lower.size):
        if i not in rows:
            raise ProblemError(
                f"Nothing in '{entry.name}'{f', component {i},' if entry.lower.size > 1 else ''} scatters.",
                expected="a state or an unknown"
                + (" or a control" if fed_back else ": without feedback the controls are those of the nominal"),
                received=str(entry.expression[i])[:200],
                remedy="use subject_to() for what does not scatter",
            )


def _condition(entry: Chance, slopes: Any, covariance: Any) -> Constraint:
    """The constraint that a condition on a probability is."""
    rows, lower, upper = [], np.array(entry.lower), np.array(entry.upper)
    variances = ca.sum2((slopes @ covariance) * slopes)
    for i in range(lower.size):
        y, low, high = entry.expression[i], float(lower[i]), float(upper[i])
        s = ca.sqrt(ca.fmax(variances[i], SMALLEST_VARIANCE) + entry.smallest**2)
        if np.isinf(low):
            rows.append(y + quantile(entry.each) * s)
        elif np.isinf(high):
            rows.append(y - quantile(entry.each) * s)
        else:
            rows.append(two_sided(entry.each).room(y, s, low, high))
            lower[i], upper[i] = 0.0, np.inf
    return Constraint(
        name=entry.name,
        expression=ca.vertcat(*rows),
        lower=lower,
        upper=upper,
        at=entry.at,
        where=entry.where,
        chance=entry,
    )
