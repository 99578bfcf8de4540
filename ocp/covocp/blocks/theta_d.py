"""θ-D: nearly optimal feedback and a nonlinear filter in closed form, from one Riccati equation.

M. Xin, S. N. Balakrishnan, "A new state observer and flight control of highly maneuverable aircraft", ACC 2009 (numbers
in brackets), and OCAM 26(2), 2005, 55-83. For dx/dt = (A0 + A(x)) x + B u and J = 1/2 int x'Q x + u'R u dt the law is

    u = -R^-1 B' P(x, t) x,   P = T_0 + ... + T_N,   epsilon_n(t) = 1 - k_n exp(-l_n t)

with the terms of `covocp.blocks.theta_d_series`. k = 0 gives the Taylor series of the solution of the Riccati equation
of A0 + A(x), which converges within a finite radius only; k_n = 1 removes correction n at t = 0.

Errata: the filter's equations (17b), (17c), (18), (20), (24), (28), (30), (35) have T A + A' T for T A' + A T, which
leaves a residual of first order in A for every N; `printed=True` keeps it for comparison. (19) has exp(-k_1 t) for
exp(-l_1 t); the gain after (17) lacks a power of θ; (61) has a transposition too many.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.arguments import checked, truth
from covocp.base.checks import is_whole
from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.short_repr import short_repr
from covocp.blocks import theta_d_series as series
from covocp.blocks import values
from covocp.blocks.factorisation import as_rows, dependence, integral_states
from covocp.blocks.factorisation import check_factorisation as check_factorisation
from covocp.blocks.theta_d_tuning import Choice as Choice
from covocp.blocks.theta_d_tuning import Convergence as Convergence
from covocp.blocks.theta_d_tuning import choose as choose
from covocp.blocks.theta_d_tuning import convergence as convergence
from covocp.blocks.theta_d_tuning import radius as radius

Array = NDArray[np.float64]

# Terms of the series beyond which its expressions fit into no memory.
MOST_TERMS = 50
FORMS = ("auto", "polynomial", "operator")


@dataclass(frozen=True, kw_only=True)
class Expansion:
    """The terms of the series as functions of x, shape (n,), and t [s]; N = number of terms - 1.

    Attributes:
        form: "polynomial" or "operator".
        riccati: T_0, (n, n).
        closed_loop: A0 - B R^-1 B' T_0 of a regulator, (n, n); the transpose of A_f = A0 - T_0 H' V^-1 H of a filter.
        terms: (x, t) -> T_0, ..., T_N, each (n, n).
        sum: (x, t) -> P, (n, n).
        gain: (x, t) -> R^-1 B' P of a regulator, (m, n); P H' V^-1 of a filter, (n, p).
        perturbations: (x, t) -> D_1, ..., D_N, each (n, n): what epsilon adds to the weight Q.
    """

    form: str
    riccati: Array
    closed_loop: Array
    terms: ca.Function
    sum: ca.Function
    gain: ca.Function
    perturbations: ca.Function

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class _Options:
    terms: Any
    k: Any
    l: Any
    form: Any

    __repr__ = short_repr


def regulator(
    x: Expr,
    A0: Expr,
    A: Expr,
    B: Expr,
    Q: Expr,
    R: Expr,
    *,
    terms: int = 3,
    k: Expr = 0.0,
    l: Expr = 0.0,
    form: str = "auto",
) -> ca.Function:
    """θ-D feedback for dx/dt = (A0 + A(x)) x + B u, section 2.

    Args:
        x: CasADi symbol of the state, shape (n,), that A is written in.
        A0: constant part of the dynamics, numbers, (n, n) [1/s].
        A: the rest, an expression in x, (n, n) [1/s].
        B: input matrix, numbers, (n, m).
        Q: weight of the state, positive semidefinite, (n, n).
        R: weight of the input, positive definite, (m, m).
        terms: number of terms T_0, T_1, ..., at least 1 (1: the linear-quadratic regulator of A0).
        k: of epsilon_n = 1 - k_n exp(-l_n t), a number or one for each of the terms - 1 corrections.
        l: as k, not negative [1/s].
        form: "polynomial": A(x) as a sum of functions times constant matrices; "operator": any A(x); "auto": the one
            with fewer multiplications. They agree to rounding.

    Returns:
        Function (x, t) -> u, of SX, without linear solvers; t in seconds.

    Raises:
        ProblemError: an argument does not fit, or a pair is not stabilisable or not detectable (names the mode).
    """
    built = expansion(x, A0, A, B, Q, R, terms=terms, k=k, l=l, form=form)
    inputs: Any = built.gain.sx_in()
    return ca.Function("theta_d_regulator", inputs, [-built.gain(*inputs) @ inputs[0]], ["x", "t"], ["u"])


@checked(printed=truth)
def filter_gain(
    x: Expr,
    A0: Expr,
    A: Expr,
    H: Expr,
    W: Expr,
    V: Expr,
    *,
    terms: int = 3,
    k: Expr = 0.0,
    l: Expr = 0.0,
    form: str = "auto",
    printed: bool = False,
) -> ca.Function:
    """Gain K of the θ-D filter de/dt = (A0 + A(e)) e + B u + K (y - H e) of the estimate e, section 3, corrected.

    Args:
        x: CasADi symbol of the estimate, shape (n,), that A is written in.
        A0: constant part of the dynamics, numbers, (n, n) [1/s].
        A: the rest, an expression in x, (n, n) [1/s].
        H: measurement matrix, numbers, (p, n) or, of one measurement, (n,).
        W: power spectral density of the process noise, or a weight, positive semidefinite, (n, n).
        V: power spectral density of the measurement noise, or a weight, positive definite, (p, p).
        terms: number of terms, at least 1 (1: the Kalman-Bucy filter of A0).
        k: as for `regulator`.
        l: as for `regulator` [1/s].
        form: as for `regulator`.
        printed: the equations as printed, T A + A' T for T A' + A T, for comparison only: their Riccati residual is of
            first order in A whatever the number of terms.

    Returns:
        Function (x, t) -> K, (n, p), of SX, without linear solvers; t in seconds.

    Raises:
        ProblemError: an argument does not fit, or a pair is not stabilisable or not detectable (names the mode).
    """
    built = filter_expansion(x, A0, A, H, W, V, terms=terms, k=k, l=l, form=form, printed=printed)
    inputs: Any = built.gain.sx_in()
    return ca.Function("theta_d_filter_gain", inputs, [built.gain(*inputs)], ["x", "t"], ["gain"])


def servo(
    x: Expr,
    A0: Expr,
    A: Expr,
    B: Expr,
    output: Expr,
    Q: Expr,
    R: Expr,
    *,
    terms: int = 3,
    k: Expr = 0.0,
    l: Expr = 0.0,
    form: str = "auto",
) -> ca.Function:
    """θ-D feedback that follows a reference, with integral states, section 4 and (61) corrected.

    With one input and one output the gain on the integral is sqrt(its weight / R) up to the sign, for every x: no
    correction changes it.

    Args:
        x: CasADi symbol of the state, shape (n,), that A is written in.
        A0: as for `regulator`.
        A: as for `regulator`.
        B: as for `regulator`.
        output: its rows times x follow the reference, numbers, (p, n) or, for one, (n,).
        Q: weight of x and of the integrals of the outputs, positive semidefinite, (n + p, n + p).
        R: as for `regulator`.
        terms: as for `regulator`.
        k: as for `regulator`.
        l: as for `regulator` [1/s].
        form: as for `regulator`.

    Returns:
        Function (x, t, reference) -> u; x: state, or its estimate, and the integrals of the outputs, shape (n + p,);
        reference: what they are to be, shape (n + p,).

    Raises:
        ProblemError: an argument does not fit, or a pair is not stabilisable or not detectable (names the mode).
    """
    whole, constant, rest, column = integral_states(x, A0, A, B, output)
    built = expansion(whole, constant, rest, column, Q, R, terms=terms, k=k, l=l, form=form)
    state, t = built.gain.sx_in()
    reference = ca.SX.sym("reference", state.shape[0])
    inputs: Any = [state, t, reference]
    u = -built.gain(state, t) @ (state - reference)
    return ca.Function("theta_d_servo", inputs, [u], ["x", "t", "reference"], ["u"])


def expansion(
    x: Expr,
    A0: Expr,
    A: Expr,
    B: Expr,
    Q: Expr,
    R: Expr,
    *,
    terms: int = 3,
    k: Expr = 0.0,
    l: Expr = 0.0,
    form: str = "auto",
) -> Expansion:
    """The terms of `regulator`, for whoever looks inside; same arguments and errors."""
    return _expansion(x, (A0, A, B, Q, R), _Options(terms=terms, k=k, l=l, form=form), series.REGULATOR)


@checked(printed=truth)
def filter_expansion(
    x: Expr,
    A0: Expr,
    A: Expr,
    H: Expr,
    W: Expr,
    V: Expr,
    *,
    terms: int = 3,
    k: Expr = 0.0,
    l: Expr = 0.0,
    form: str = "auto",
    printed: bool = False,
) -> Expansion:
    """The terms of `filter_gain`, for whoever looks inside; same arguments and errors."""
    kind = series.PRINTED_FILTER if printed else series.FILTER
    return _expansion(x, (A0, A, as_rows(H), W, V), _Options(terms=terms, k=k, l=l, form=form), kind)


def _expansion(x: Expr, matrices: tuple[Any, ...], options: _Options, kind: series.Kind) -> Expansion:
    """Terms, their sum, its gain and the perturbations, in the form that is asked for."""
    A0, A, B, Q, R = matrices
    count = _corrections(options)
    begin = series.start(A0, B, Q, R, kind)
    state, rest = dependence(x, A, begin.riccati.shape[0])
    rest = rest.T if kind.dual and not kind.printed else rest
    t = ca.SX.sym("t")
    epsilon, indices, variables = series.epsilons(t, _each("k", options, count), _each("l", options, count))
    parts = _polynomials(begin, state, rest, indices, len(variables), options.form)
    if parts is None:
        terms = series.corrections(begin, rest, epsilon)
        total = sum(terms[1:], terms[0])
        gain = ca.DM(begin.feedback) @ total
    else:
        functions, polynomials = parts
        arguments, whole = [*functions, *variables], series.added(polynomials)
        terms = [series.evaluated(polynomial, arguments) for polynomial in polynomials]
        total = series.evaluated(whole, arguments)
        gain = series.evaluated(whole, arguments, begin.feedback)
    roots = [term @ ca.DM(begin.root) for term in terms]
    perturbations = [
        (1.0 - factor) * series.right_side(terms[n], roots[1 : n + 1], rest) for n, factor in enumerate(epsilon)
    ]

    def function(name: str, outputs: list[Any], names: list[str]) -> ca.Function:
        inputs: Any = [state, t]
        return ca.Function(name, inputs, outputs, ["x", "t"], names)

    return Expansion(
        form="operator" if parts is None else "polynomial",
        riccati=begin.riccati,
        closed_loop=begin.closed_loop,
        terms=function("terms", terms, [f"T{n}" for n in range(count + 1)]),
        sum=function("sum", [total], ["P"]),
        gain=function("gain", [gain.T if kind.dual else gain], ["gain"]),
        perturbations=function("perturbations", perturbations, [f"D{n + 1}" for n in range(count)]),
    )


def _polynomials(
    begin: series.Start, state: Expr, rest: Expr, indices: list[int | float], variables: int, form: str
) -> tuple[list[Any], list[series.Polynomial]] | None:
    """Functions phi_k and the terms as polynomials; None where the operator form is meant."""
    if form == "operator":
        return None
    functions, matrices = series.separated(state, rest)
    multiplications = len(indices) * begin.inverse.shape[0]  # of the operator form, for each entry of the half-vector
    if form == "auto" and series.monomials(len(functions), indices, multiplications + 1) > multiplications:
        return None
    return functions, series.polynomials(begin, matrices, indices, variables)


def _corrections(options: _Options) -> int:
    """Number of corrections, N."""
    terms = options.terms
    if not is_whole(terms, 1, MOST_TERMS):
        raise values.wrong_argument(
            "terms",
            f"a positive whole number, at most {MOST_TERMS}",
            repr(terms),
            "give 1 for the linear law, 3 for the paper's",
        )
    if not isinstance(options.form, str) or options.form not in FORMS:
        raise values.wrong_argument("form", "one of " + ", ".join(FORMS), repr(options.form), "correct the name")
    return int(terms) - 1


def _each(name: str, options: _Options, count: int) -> Array:
    """k or l of each correction."""
    given = values.numeric(name, values.matrix(name, getattr(options, name))).ravel()
    if given.size not in (1, count):
        raise values.wrong_argument(
            name, f"a number or {count}, one for each correction", f"{given.size} numbers", f"correct {name}"
        )
    if name == "l" and np.any(given < 0.0):
        raise values.wrong_argument(
            name, "numbers that are not negative", f"{given.min():g}", "with l < 0 the factors grow for ever"
        )
    return np.array(np.broadcast_to(given, (count,)))
