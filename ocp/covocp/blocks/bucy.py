"""The continuous-time (Kalman-Bucy) filter, and what a discrete filter needs of a continuous model."""

from __future__ import annotations

from functools import cache, partial
from math import factorial
from typing import Any

import casadi as ca
import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.gains import weighted
from covocp.base.riccati_rates import riccati_rate
from covocp.blocks.arithmetic import apply, definite_solve, precision, semidefinite, symmetric
from covocp.blocks.updates import row_matrix
from covocp.blocks.values import is_symbolic, matrix, restored, square, weight

Array = NDArray[np.float64]

# A term of the series for numbers that is this small beside the sum, entry by entry, is the last.
ROUNDING = 1e-17
# Symbolic discretisation: a series over step / 2^DOUBLINGS, then doublings. For |A| step = 1, 4, 16 its error relative
# to exp is below 1e-15, 2e-10, 1e-4.
DOUBLINGS = 4
ORDER = 8
# Points of the Gauss rule for the noise, as exact as the series.
NOISE_POINTS = 4


def rate(E: Expr, F: Expr, M: Expr, Q: Expr, U: Expr, *, gain: Expr = None, cross: Expr = None) -> Any:
    """Kalman-Bucy rate of the covariance: F E + E F' + Q - K U K', K = (E M' + C) U^-1 [Schmidt 2.5-3].

    With a given gain K it is (F - K M) E + E (F - K M)' + Q + K U K' - K C' - C K' [Schmidt 6.2-31].

    Args:
        E: covariance of the estimation error, shape (n, n).
        F: shape (n, n) [1/s].
        M: measurement matrix, shape (m, n), or (n,) for one measurement.
        Q: power spectral density of the process noise, positive semidefinite, shape (n, n).
        U: power spectral density of the measurement noise, shape (m, m); positive definite where no gain is given.
        gain: K, shape (n, m); None: the best one.
        cross: C, cross density of process and measurement noise <n v'>, shape (n, m); None: zero.

    Returns:
        dE/dt, symmetric, shape (n, n) [1/s].

    Raises:
        ProblemError: shapes that do not fit, Q, U or [Q C; C' U] not positive semidefinite, U singular.
    """
    e = square("E", E)
    size = e.shape[0]
    rows = row_matrix("M", M, size)
    count = rows.shape[0]
    q, u = weight("Q", Q, size), weight("U", U, count, definite=gain is None)
    c = ca.DM.zeros(size, count) if cross is None else matrix("cross", cross, (size, count))
    if cross is not None and not is_symbolic(q, u, c):
        weight("[Q, cross; cross', U]", ca.blockcat([[q, c], [c.T, u]]))
    values = [e, square("F", F, size), rows, q, u, c]
    kind = precision(E, F, M, Q, U)
    if gain is None:
        (slope,) = apply(_best, *values, precision=kind)
    else:
        (slope,) = apply(_given, *values, matrix("gain", gain, (size, count)), precision=kind)
    return restored(slope, E)


def _best(E: Expr, F: Expr, M: Expr, Q: Expr, U: Expr, C: Expr) -> tuple[Any]:
    """The rate with the best gain; correlation moves into drift and noise."""
    solve = partial(definite_solve, what="measurement noise U")
    seen, share = weighted(M, U, solve), weighted(C.T, U, solve)
    return (symmetric(riccati_rate(E, F - share @ M, Q - share @ C.T, seen @ M)),)


def _given(E: Expr, F: Expr, M: Expr, Q: Expr, U: Expr, C: Expr, K: Expr) -> tuple[Any]:
    """The rate with a given gain."""
    moved, common = (F - K @ M) @ E, K @ C.T
    return (symmetric(moved + moved.T + Q + K @ U @ K.T - common - common.T),)


def discretise(A: Expr, Q: Expr, step: Expr) -> tuple[Any, Any]:
    """Transition matrix exp(A h) and noise covariance of a step: the integral of exp(A s) Q exp(A' s) over [0, h].

    Numbers: exact to rounding, each entry of itself where its terms have one sign, in any units: the series of exp(A s)
    until no term counts in any entry, and a Gauss rule of as many points, over a part of the step as short as the
    largest eigenvalue of |A| asks for; then doublings Q_2h = Q_h + Phi_h Q_h Phi_h', which cannot lose definiteness or
    overflow for stiff A.
    Expressions: a series of order 8 and a Gauss rule over h/16, then four doublings; the result is positive
    semidefinite whatever the step, its relative error below 1e-15, 2e-10, 1e-4 for |A| h = 1, 4, 16.

    Args:
        A: of dx/dt = A x + n, shape (n, n) [1/s].
        Q: power spectral density of n, positive semidefinite, shape (n, n).
        step: h > 0 [s].

    Returns:
        Phi and the covariance, shapes (n, n).

    Raises:
        ProblemError: shapes that do not fit, Q not positive semidefinite, a step that is not positive or over which
            the transition overflows.
    """
    a = square("A", A)
    q, h = weight("Q", Q, a.shape[0]), time_step(step)
    if is_symbolic(a, q, h):
        transition, noise = apply(_series, a, q, h)
    else:
        with np.errstate(over="ignore", invalid="ignore"):  # refused below
            transition, noise = _to_rounding(a.full(), q.full(), float(h))
        if not (np.isfinite(transition).all() and np.isfinite(noise).all()):
            raise ProblemError(
                "The transition over the step is larger than any number.",
                expected="a step over which the modes of A grow less",
                received=f"a step of {float(h):g} with |A| step = {np.linalg.norm(a.full(), 1) * float(h):.3g}",
                remedy="take shorter steps",
            )
        noise = semidefinite(noise)
    return restored(transition, A), restored(noise, Q)


def time_step(value: Expr) -> Any:
    """A step as a CasADi scalar.

    Raises:
        ProblemError: a number that is not positive.
    """
    step = matrix("step", value, (1, 1))
    if not is_symbolic(step) and not float(step) > 0.0:
        raise ProblemError(
            "The step is not positive.", expected="a time [s]", received=f"{float(step):g}", remedy="correct it"
        )
    return step


def _to_rounding(A: Array, Q: Array, h: float) -> tuple[Any, Any]:
    """The discretisation of numbers, every entry to rounding of the sum of the sizes of its terms.

    What is taken from A is the largest eigenvalue of its sizes |A|, and terms are compared entry by entry: neither
    depends on the units of the states, and a chain of integrators, whose entries are powers of the step, has them all.
    """
    largest = np.abs(np.linalg.eigvals(np.abs(A))).max(initial=0.0)
    rate = min(float(largest), float(np.finfo(float).max))
    doublings = max(0, int(np.ceil(np.log2(rate) + np.log2(h)))) if rate > 0.0 else 0
    short = float(np.ldexp(h, -doublings))
    terms = _exponential_terms(A * short)
    count = len(terms)
    nodes, weights = _gauss(count)
    moved = np.tensordot(((1.0 + nodes) / 2.0)[:, None] ** np.arange(count), terms, 1)
    noise = np.tensordot(weights / 2.0, moved @ Q @ moved.mT, 1) * short
    return _doubled(terms.sum(axis=0), symmetric(noise), doublings)


def _exponential_terms(B: Array) -> Array:
    """B^k / k!, (terms, n, n), until no further one changes an entry of their sum, by their sizes.

    Where |B|^k / k! <= e S_k entry by entry, S_k the sum so far, the next one is <= e S_k |B| / (k + 1) <= e S_(k + 1).
    """
    terms, sizes = [np.eye(len(B))], np.eye(len(B))
    size, total = np.abs(B), np.eye(len(B))
    while (sizes > ROUNDING * total).any():
        k = len(terms)
        terms.append(terms[-1] @ B / k)
        sizes = sizes @ size / k
        total = total + sizes
    return np.array(terms)


@cache
def _gauss(points: int) -> tuple[Array, Array]:
    """Nodes and weights of the Gauss rule on [-1, 1]."""
    return legendre.leggauss(points)


def _doubled(transition: Expr, noise: Expr, doublings: int) -> tuple[Any, Any]:
    for _ in range(doublings):
        noise = symmetric(noise + transition @ noise @ transition.T)
        transition = transition @ transition
    return transition, noise


def _series(A: Expr, Q: Expr, h: Expr) -> tuple[Any, Any]:
    """The symbolic discretisation; the powers of A serve the transition over all the parts of the short step."""
    short = h / 2**DOUBLINGS
    powers = [ca.SX.eye(A.shape[0])]
    for _ in range(ORDER):
        powers.append(A @ powers[-1])

    def transition(part: float) -> Any:
        return sum(((part * short) ** k / factorial(k)) * power for k, power in enumerate(powers[1:], 1)) + powers[0]

    nodes, weights = legendre.leggauss(NOISE_POINTS)
    noise = 0
    for node, share in zip(nodes, weights, strict=True):
        moved = transition((1 + float(node)) / 2)
        noise = noise + (float(share) / 2) * short * (moved @ Q @ moved.T)
    return _doubled(transition(1.0), symmetric(noise), DOUBLINGS)
