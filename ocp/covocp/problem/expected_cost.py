"""Expected cost -> deterministic vector-matrix problem: the closed loop of G. T. Schmidt, Sc.D. thesis, chapter 6.

The actual system dx = f dt + n, measured as h + v, is controlled by u - C x', x' the estimate of its deviation by the
Kalman filter along the nominal. To second order the expected cost is (6.3-14)

    J = k + int L dt + 1/2 tr S(T) X(T) + 1/2 int tr(A X + B C X' C' - 2 N C X') dt,      X = E + X',

E the covariance of the estimate's error, X' that of the estimate itself (called Xhat). With the best gain,

    C = B^-1 (G' S + N'),    -dS/dt = F' S + S F + A - C' B C,    S(T) = k_xx + weights,          (6.3-19 .. 6.3-24)

tr(S X) may be integrated by parts (E-20), and once more with E in place of X, which leaves

    J = k + int L dt + 1/2 tr S(T) E(T) + 1/2 int tr(A E + S E W E) dt,      W = M' U^-1 M.

On any part of the time the last two are equal but for the ends, d tr(S E) = tr(S Q + C'B C E - A E - S E W E) dt. The
first is smooth where S is steep, near the end, the second where E is steep, at the start and where a sensor comes to
see something: there S E W E is a spike of width U/E. So the integral is taken in the second form but near the end
(`steps.taken_by_parts`).

So the matrices are E, forward from E(0), and S, backward from S(T); Xhat is had afterwards. The costate of S is
-Xhat/2. Where the gain is constrained (`Gain`), or where a condition or a nonlinear cost contains the covariance of the
closed loop (`closed_loop_covariance`), C is a control and the matrices are E and Xhat instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.checks import as_number, caller, density_matrix
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.matrices import pack_symbolic
from covocp.base.riccati_rates import inverse
from covocp.problem.checks import as_expression, find_name
from covocp.problem.closed_loop_covariance import (
    SPREAD,
    check_contents,
    check_no_feedback,
    check_order,
    free_gain,
    reasons,
    split_cost,
    with_value,
    with_weights,
)
from covocp.problem.decisions import with_constant
from covocp.problem.declarations import Control, Declarations, Dynamics, Expansion, Expected, Gain
from covocp.problem.estimation_covariance import with_estimation
from covocp.problem.expansion import expand, measurement_slope
from covocp.problem.freeze import freeze
from covocp.problem.integrals import check_expected
from covocp.problem.matrices import Backward, declare_matrix
from covocp.problem.measurement_information import inverse_density
from covocp.problem.samples import ESTIMATE as ESTIMATE
from covocp.statement.entries import error_names, error_size
from covocp.statement.names import name_of, split_entry
from covocp.statement.statement import Statement

# Names of what the derived problem adds to the user's symbols.
FEEDBACK, GAIN = "S", "C"
# Where all is read at instants the estimate scatters along few directions, and a gain across them would cost nothing:
# many are equally good, and a solver finds none. So what is fed back is priced as if the estimate scattered by so much
# of its error's covariance more: 1e-8 is too little for a solver, 1e-6 changes costs by some 1e-8 of them.
UNREAD = 1e-5


def expected_cost(
    problem: Declarations, running: Expr, terminal: Expr, terminal_weight: Expr, control_weight: Expr, gain: Gain | None
) -> Expected:
    """Check and keep what `Problem.minimize_expected` was given."""
    if gain is not None and not isinstance(gain, Gain):
        raise ProblemError(
            "The gain of minimize_expected() is not a description of a gain.",
            expected="Gain(structure=..., constant=..., lower=..., upper=...), or None for the best gain",
            received=repr(gain)[:100],
            remedy="correct gain=, or leave it out",
        )
    return Expected(
        running=as_expression("minimize_expected", "running cost", running, (1, 1)),
        terminal=as_expression("minimize_expected", "terminal cost", terminal, (1, 1)),
        terminal_weight=_by_name("terminal_weight", terminal_weight, problem.augmented),
        control_weight=_by_name("control_weight", control_weight, problem.controls),
        gain=gain,
        where=caller(),
    )


def check_first_cost(problem: Declarations, call: str) -> None:
    """A problem has one cost, stated by `minimize` or by `minimize_expected`."""
    former = "minimize" if problem.cost is not None else "minimize_expected" if problem.expected is not None else ""
    if former:
        raise ProblemError(
            "The cost is given twice.",
            expected="one call of minimize() or minimize_expected()",
            received=f"{call}() after {former}()",
            remedy="add the terms up in one call"
            if call == former
            else "use one of the two: minimize_expected() stands in place of minimize()",
        )


def _by_name(what: str, weights: Expr, entries: Sequence[Any]) -> Any:
    """Weights given by symbol or name, as matrices by name; a whole matrix, or a number, as it is."""
    if not isinstance(weights, Mapping):
        return weights
    result: dict[str, Any] = {}
    word = what.replace("_", " ")
    symbols, sizes = {e.name: e.symbol for e in entries}, {e.name: error_size(e) for e in entries}
    for key, value in weights.items():
        name = name_of(key, symbols, tuple(sizes), missing_ok=True, sizes=sizes)
        entry = split_entry(name)
        if name in sizes or entry is None:
            name = find_name(key, f"{what}()", list(entries), tuple(entries))
            weight = density_matrix(name, word, value, sizes[name])
        else:
            name, k = entry
            own = density_matrix(f"{name}[{k}]", word, value, 1)
            weight = ca.diagcat(ca.MX(k, k), own, ca.MX(sizes[name] - k - 1, sizes[name] - k - 1))
        result[name] = result[name] + weight if name in result else weight
    return result


def statement_of(problem: Declarations) -> Statement:
    """The frozen statement of what is declared; of an expected cost, that of the problem derived from it."""
    if problem.expected is not None:
        return freeze(derive(problem))
    check_no_feedback(problem)
    return freeze(problem)


def derive(problem: Declarations, *, part: bool = False, later: Expr = None, gain: Gain | None = None) -> Declarations:
    """The deterministic vector-matrix problem of a problem with an expected cost.

    Args:
        problem: with `minimize_expected`.
        part: whether it is one of several phases: what is uncertain may then come from another one.
        later: weight of the deviations at its end, (n, n), that the phases after it ask for; None: nothing follows.
        gain: that is optimised because another phase asks for one; None: what the problem itself asks for.

    Returns:
        Declarations on the same symbols, with E and S (or E, Xhat and the gain) and the deterministic cost.

    Raises:
        ProblemError: the system is deterministic or has no control, it contains matrices, a control has no weight, a
            terminal condition has none.
    """
    expected = problem.expected
    assert expected is not None
    if not part:
        check_random((problem,))
    _check_contents(problem, expected)
    check_expected(problem, [expected.running, expected.terminal])
    check_order(problem)
    gain = free_gain(problem) if gain is None else gain
    problem, *spread = split_cost(problem)
    derived = replace(problem, expected=None)
    if not any(matrix.estimation for matrix in derived.matrices):
        derived = with_estimation(derived)
    _check_free_names(derived)
    assert problem.expected is not None
    expansion = with_weights(problem, expand(derived, problem.expected, later), *spread)
    E = next(matrix.matrix for matrix in derived.matrices if matrix.estimation)
    size = E.shape[0]
    jacobian, density = measurement_slope(derived, size)
    innovation = E @ jacobian.T  # K U
    information = ca.MX(size, size)
    if jacobian.shape[0]:
        blocks = [(entry.noise, entry.information) for entry in derived.continuous]
        information = innovation @ inverse_density(density, blocks, _inverse) @ innovation.T
    if gain is None:
        end = expansion.end if later is None else expansion.end + later
        derived, S, expansion = _with_feedback(derived, expansion, end)
        fed = S @ expansion.G + expansion.N
        regained = _trace(S, expansion.Q) + _trace(fed @ _inverse(expansion.B) @ fed.T, E)
        expansion = replace(expansion, alternative=expansion.running + regained / 2, product=_trace(S, E) / 2)
        running = expansion.running + (_trace(expansion.A, E) + _trace(S, information)) / 2
        terminal = expansion.terminal + _trace(expansion.end, E) / 2
    else:
        derived, X, expansion = _with_free_gain(derived, expansion, gain, information)
        C = expansion.gain
        derived = with_value(derived, E, X, C)
        fed = _trace(expansion.B @ C, X @ C.T) - 2 * _trace(expansion.N, C @ X)
        if not (jacobian.shape[0] or gain.constant):
            fed = fed + UNREAD * _trace(expansion.B @ C, E @ C.T)
        running = expansion.running + (_trace(expansion.A, E + X) + fed) / 2
        terminal = expansion.terminal + _trace(expansion.end, E + X) / 2
        if expansion.spread is not None:
            running, terminal = running + expansion.spread[0], terminal + expansion.spread[1]
    return replace(derived, cost=(running, terminal), expansion=expansion)


def deterministic(problem: Declarations) -> Declarations:
    """The problem without its noise: what quadratic synthesis takes the nominal from [Schmidt 6.3].

    Raises:
        ProblemError: no expected cost, constrained gains, or a deterministic part of the cost that depends on nothing
            that can be chosen.
    """
    expected = problem.expected
    if expected is None:
        raise ProblemError(
            "nominal='deterministic' needs an expected cost.",
            expected="a problem with minimize_expected()",
            received=f"'{problem.name}' with minimize()",
            remedy="leave nominal= out: the cost is deterministic already",
        )
    asked = reasons(problem)
    if expected.gain is not None or asked:
        raise ProblemError(
            "nominal='deterministic' needs the best gain.",
            expected="minimize_expected() without gain=: the gain follows from the nominal",
            received=str(expected.gain) if expected.gain is not None else f"{SPREAD} in {', '.join(asked)}",
            remedy=f"leave {'gain=' if expected.gain is not None else 'these'} out; or solve for nominal and gain "
            "together, nominal='combined'",
        )
    problem = split_cost(problem)[0]
    assert problem.expected is not None
    expected = problem.expected
    used = {s.__hash__() for c in problem.constraints for s in ca.symvar(c.expression)}
    kept = [m for m in problem.matrices if m.symbol.__hash__() in used or (not m.estimation and m.role == "moving")]
    needed = {s.__hash__() for m in kept if m.role == "integral" for s in ca.symvar(problem.rates[m.name].rate)}
    matrices = tuple(m for m in problem.matrices if m in kept or m.symbol.__hash__() in needed)
    dropped = {m.name for m in problem.matrices if m.role == "integral"} - {m.name for m in matrices}
    problem = replace(problem, rates={name: rate for name, rate in problem.rates.items() if name not in dropped})
    cost = (expected.running, expected.terminal)
    entries: list[Any] = [*problem.states, *problem.controls, *matrices]
    chosen = {entry.symbol.__hash__() for entry in entries}
    if problem.free_duration is not None:
        chosen.add(problem.duration.__hash__())
    if not any(symbol.__hash__() in chosen for symbol in ca.symvar(ca.veccat(*cost))):
        raise ProblemError(
            "The deterministic part of the expected cost depends on nothing that can be chosen.",
            expected="a running or terminal cost of states, controls or the free duration",
            received=f"running = {expected.running}, terminal = {expected.terminal}",
            remedy="evaluate(problem, nominal=...) takes any nominal; or add a small deterministic cost",
        )
    return replace(problem, cost=cost, expected=None, matrices=matrices)


def check_random(problems: Sequence[Declarations]) -> None:
    """Something must be uncertain in a problem or in several phases, or the expected cost is the deterministic one."""
    uncertain: list[Any] = []
    for problem in problems:
        started = [m.initial for m in problem.matrices if m.estimation]
        uncertain += started or [entry.variance for entry in problem.augmented]
        uncertain += [entry.noise for entry in problem.rates.values() if entry.noise is not None]
    if all(value.is_constant() and not np.any(ca.evalf(value).full()) for value in uncertain):
        raise ProblemError(
            "The expected cost is deterministic: nothing in the system is uncertain.",
            expected="variance= of a state or an unknown, or noise= in dynamics()",
            received="no initial variance and no process noise",
            remedy="use minimize() for a deterministic problem, or say what is uncertain",
        )


def _check_contents(problem: Declarations, expected: Expected) -> None:
    """There is a control, the actual system contains no matrices, and the weights no symbols of another problem."""
    if not problem.controls:
        raise ProblemError(
            "An expected cost needs a control: without one nothing is fed back.",
            expected="control(...), whose deviations the feedback chooses",
            received="none",
            remedy="declare one; or state a cost of the covariance, by estimation_covariance() and minimize()",
        )
    own: list[Any] = [*problem.states, *problem.unknowns, *problem.parameters, *problem.controls]
    known = {symbol.__hash__() for symbol in (problem.time, problem.duration, *(entry.symbol for entry in own))}
    matrices = {entry.symbol.__hash__(): entry.name for entry in problem.matrices}
    contents: list[tuple[str, Any]] = [("running cost", expected.running), ("terminal cost", expected.terminal)]
    for what, given in (("terminal weight", expected.terminal_weight), ("control weight", expected.control_weight)):
        values = given.values() if isinstance(given, Mapping) else [given]
        contents += [(what, value) for value in values if isinstance(value, ca.MX)]
    rates = [(s.name, problem.rates[s.name]) for s in problem.states if s.name in problem.rates]
    contents += [(f"rate of '{name}'", entry.rate) for name, entry in rates]
    contents += [(f"noise of '{name}'", entry.noise) for name, entry in rates if entry.noise is not None]
    contents += [(f"measurement '{m.name}'", ca.veccat(m.expression, m.noise)) for m in problem.measurements]
    check_contents(dict(contents[2:]), problem)
    if problem.spread is not None:
        known.add(problem.spread.symbol.__hash__())
    for what, expression in contents:
        for symbol in ca.symvar(expression):
            matrix = matrices.get(symbol.__hash__())
            if matrix is not None or (symbol.__hash__() not in known and what.endswith("weight")):
                content = f"the matrix '{matrix}'" if matrix else f"'{symbol.name()}', which is not a symbol of it"
                raise ProblemError(
                    f"The {what} of a problem with an expected cost contains {content}.",
                    expected="states, unknowns, controls, parameters, time: the actual system has no covariance",
                    received=str(expression)[:200],
                    remedy="state a condition of E by subject_to(), or a cost by minimize(); X = "
                    "closed_loop_covariance() may be in the expected cost"
                    if matrix
                    else f"declare '{symbol.name()}' in this problem",
                )


def _check_free_names(problem: Declarations) -> None:
    """The names of the derived matrices must not be taken."""
    for entry in problem.named:
        if entry.name in (FEEDBACK, ESTIMATE, GAIN):
            raise ProblemError(
                f"The name '{entry.name}' is taken by minimize_expected().",
                expected=f"any name but {FEEDBACK}, {ESTIMATE}, {GAIN}: they are the matrices of the feedback",
                received=f"'{entry.name}', declared at {entry.where}",
                remedy="choose another name",
            )


def _trace(a: Expr, b: Expr) -> Any:
    """tr(a b)."""
    return ca.dot(ca.densify(a), ca.densify(b.T)) if a.shape[0] else ca.MX(0)


def _inverse(density: Expr) -> Any:
    """`inverse`, in scalar operations where it is a full matrix of expressions: CasADi solves those numerically."""
    if density.is_constant() or density.sparsity().is_diag():
        return inverse(density)
    entries = ca.SX.sym("entries", *density.shape)
    return ca.Function("inverse", [entries], [ca.inv(entries)])(density)


def _with_feedback(problem: Declarations, expansion: Expansion, end: Expr) -> tuple[Declarations, Any, Expansion]:
    """Add the backward matrix S with S(T) and its Riccati form in forward time; S and the gain C = B^-1 (G' S + N')."""
    labels = error_names(problem.augmented)
    F, G, A, N = expansion.F, expansion.G, expansion.A, expansion.N
    weight = _inverse(expansion.B)
    form = (-(F - G @ weight @ N.T).T, -(A - N @ weight @ N.T), -(G @ weight @ G.T))
    backward = Backward(end=end, form=form)
    feedback = declare_matrix(FEEDBACK, labels=labels, where="minimize_expected()", backward=backward)
    S = feedback.matrix
    return problem.adding(matrices=feedback), S, replace(expansion, gain=weight @ (G.T @ S + N.T))


def _with_free_gain(
    problem: Declarations, expansion: Expansion, gain: Gain, information: Expr
) -> tuple[Declarations, Any, Expansion]:
    """Add Xhat with its rate (A-32) and the entries of the gain, controls or constants that are optimised."""
    labels = error_names(problem.augmented)
    size, rows = len(labels), sum(control.size for control in problem.controls)
    pattern, low, high, guess = _gain_entries(gain, (rows, size))
    where = np.flatnonzero(pattern.ravel(order="F"))
    symbol = ca.MX.sym(GAIN, where.size)
    position = ca.DM.zeros(rows * size, where.size)
    for k, index in enumerate(where.tolist()):
        position[index, k] = 1.0
    C = ca.reshape(ca.sparsify(position) @ symbol, rows, size)
    place = "minimize_expected()"
    own: dict[str, Any] = {"name": GAIN, "symbol": symbol, "size": int(where.size), "where": place, "unit": ""}
    lower, upper, start = (values.ravel(order="F")[where] for values in (low, high, guess))
    if gain.constant:
        problem = with_constant(problem, own, lower, upper, start, sized=False)
    else:
        problem = problem.adding(controls=Control(**own, lower=lower, upper=upper, guess=start, scale=None))
    estimate = declare_matrix(
        ESTIMATE,
        labels=labels,
        where="minimize_expected()",
        initial=np.zeros((size, size)),
        lower=0.0,
        covariance=True,
    )
    X, closed = estimate.matrix, expansion.F - expansion.G @ C
    rate = closed @ X + X @ closed.T + information
    growth = Dynamics(rate=pack_symbolic(rate), noise=None, where="minimize_expected()")
    return problem.adding(matrices=estimate, rates={ESTIMATE: growth}), X, replace(expansion, gain=C)


class _GainEntries(NamedTuple):
    """Pattern, bounds and guess of a gain, all of its shape."""

    pattern: Any
    lower: Any
    upper: Any
    guess: Any


def _gain_entries(gain: Gain, shape: tuple[int, int]) -> _GainEntries:
    """Pattern, bounds and guess of a gain, all of its shape.

    Raises:
        ProblemError: where one does not fit.
    """
    values = []
    for what, value in (
        ("structure", np.ones(shape) if gain.structure is None else gain.structure),
        ("lower", gain.lower),
        ("upper", gain.upper),
        ("guess", 0.0 if gain.guess is None else gain.guess),
    ):
        numbers = as_number(GAIN, what, value)
        if numbers.size == 1:
            numbers = np.full(shape, float(numbers.reshape(())))
        if numbers.shape != shape or np.isnan(numbers).any():
            raise ProblemError(
                f"The {what} of the gain does not fit.",
                expected=f"a number, or an array of shape {shape}: controls by augmented states, without NaN",
                received=f"shape {numbers.shape}",
                remedy=f"correct Gain({what}=...)",
            )
        if what == "structure" and not np.isin(numbers, (0.0, 1.0)).all():
            raise ProblemError(
                "The structure of the gain does not say which entries there are.",
                expected="True where an entry may differ from zero, False where it is zero",
                received=f"structure={gain.structure!r}"[:200],
                remedy="correct Gain(structure=...); bounds of entries are lower= and upper=",
            )
        values.append(numbers)
    pattern, low, high, guess = values
    if not pattern.any() or (low > high).any():
        raise ProblemError(
            "The gain leaves nothing to choose.",
            expected="a structure with at least one entry, and lower <= upper",
            received=str(gain),
            remedy="correct Gain(...)",
        )
    return _GainEntries(pattern != 0, low, high, np.clip(guess, low, high))
