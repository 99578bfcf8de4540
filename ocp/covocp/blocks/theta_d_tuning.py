"""How far the θ-D series converges, and the choice of k_n and l_n by least squares.

Everything here is about a regulator (A0, A, B, Q, R); for a filter give the dual (A0', A(x)', H', W, V).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.arguments import checked, truth
from covocp.base.checks import is_whole
from covocp.base.dataclass import dataclass
from covocp.base.errors import warn_user
from covocp.base.expressions import Expr
from covocp.base.short_repr import short_repr
from covocp.blocks import sdre, values
from covocp.blocks import theta_d_series as series
from covocp.blocks.algebraic import lyapunov
from covocp.blocks.factorisation import as_states, dependence
from covocp.blocks.scaling import diagonal_scales, over
from covocp.blocks.theta_d_radius import nearest_singularity

Array = NDArray[np.float64]

# k below this leaves its correction as it is, and l has no meaning.
NEGLIGIBLE = 1e-6


@dataclass(frozen=True, kw_only=True)
class Convergence:
    """Where the series with epsilon = 1 (k = 0, or t -> infinity) converges, at J states.

    Theorem 3.1 in a reading that holds: with Pi from A_c' Pi + Pi A_c = -I and z = Pi^1/2 x, the condition
    lambda_max(A_c + A_c') < 0 can always be met, and a bound on |A(x)| (`guaranteed`) suffices for every epsilon_n in
    [0, 1], that is for every k_n in [0, 1], l_n >= 0 and t.

    Attributes:
        radius: R of each state, (J,): the series of A0 + s A(x) converges for |s| < R.
        guaranteed: what a majorant of the series guarantees, (J,): at most R.
        decay: largest real part of the eigenvalues of A_c [1/s], negative.
        largest: lambda_max(A_c + A_c') in the given coordinates [1/s], which the printed theorem wants negative.
        largest_transformed: the same after z = Pi^1/2 x [1/s], negative.
    """

    radius: Array
    guaranteed: Array
    decay: float
    largest: float
    largest_transformed: float

    __repr__ = short_repr

    @property
    def converges(self) -> bool:
        """Whether it converges at all the states."""
        return bool(np.all(self.radius > 1.0))


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Factors k_n and rates l_n of `choose`, (N,), for the corrections 1, ..., N.

    Attributes:
        k: between 0 and 1.
        l: not negative [1/s]; 0 where k is 0.
        misfit: root mean square of (largest singular value of P / that of the Riccati solution - 1).
    """

    k: Array
    l: Array
    misfit: float

    __repr__ = short_repr


def radius(A0: Expr, direction: Expr, B: Expr, Q: Expr, R: Expr) -> float:
    """Radius of convergence of the series in s of A0 + s direction.

    Args:
        A0: numbers, (n, n) [1/s].
        direction: A(x) at a state, or the matrix that a scalar function multiplies, numbers, (n, n).
        B: input matrix, numbers, (n, m).
        Q: weight of the state, positive semidefinite, (n, n).
        R: weight of the input, positive definite, (m, m).

    Returns:
        The distance of the nearest singularity of the Riccati solution in the complex plane of s, to six digits or
        more. Where none is found, what a recurrence that the terms of order 50 to 160 obey tells, less its uncertainty
        (at most 0.3 percent); where there is none of these either, ten percent less than how these terms grow; inf
        where the series ends.

    Raises:
        ProblemError: an argument does not fit, or a pair is not stabilisable or not detectable (names the mode).
    """
    begin = series.start(A0, B, Q, R)
    matrix = values.numeric("direction", values.square("direction", direction, begin.riccati.shape[0]))
    return nearest_singularity(begin, *_weighed(A0, Q), matrix, _bounds(begin)(matrix))


@checked(warn=truth)
def convergence(
    x: Expr, A0: Expr, A: Expr, B: Expr, Q: Expr, R: Expr, states: Expr, *, warn: bool = True
) -> Convergence:
    """Whether the series converges at some states, for epsilon = 1.

    Args:
        x: CasADi symbol of the state, shape (n,), that A is written in.
        A0: numbers, (n, n) [1/s].
        A: an expression in x, (n, n) [1/s].
        B: input matrix, numbers, (n, m).
        Q: weight of the state, positive semidefinite, (n, n).
        R: weight of the input, positive definite, (m, m).
        states: where the law is to work, (J, n).
        warn: whether to warn of states where it does not converge.

    Returns:
        Radii and the conditions of theorem 3.1.

    Raises:
        ProblemError: an argument does not fit, A is not finite at a state, or a pair is not stabilisable or not
            detectable (names the mode).
    """
    begin = series.start(A0, B, Q, R)
    size = begin.riccati.shape[0]
    tried = as_states(states, size)
    matrices = _matrices(*dependence(x, A, size), tried)
    guaranteed = _bounds(begin)
    bounds = np.array([guaranteed(matrix) for matrix in matrices])
    radii = _radii(begin, *_weighed(A0, Q), matrices, bounds)
    root, _ = _coordinates(begin.closed_loop)
    result = Convergence(
        radius=radii,
        guaranteed=bounds,
        decay=float(np.linalg.eigvals(begin.closed_loop).real.max()),
        largest=_largest_symmetric(begin.closed_loop),
        largest_transformed=-1.0 / float(np.linalg.norm(root, 2)) ** 2,  # X A_c X^-1 + (...)' = -(X X')^-1
    )
    if warn and not result.converges:
        worst = int(np.argmin(radii))
        at = "(" + ", ".join(f"{value:.6g}" for value in tried[worst]) + ")"
        warn_user(
            f"The θ-D series does not converge at {np.sum(radii <= 1.0)} of {len(radii)} states; at x = {at} it does "
            f"up to {radii[worst]:.3g} A(x). With k = 0 more terms make the law worse there: take k_n > 0 (choose), or "
            "put more of f into A0."
        )
    return result


def choose(
    x: Expr,
    A0: Expr,
    A: Expr,
    B: Expr,
    Q: Expr,
    R: Expr,
    states: Expr,
    times: Expr,
    *,
    terms: int = 3,
    starts: int = 8,
    seed: int = 0,
) -> Choice:
    """k_n and l_n by least squares against the state-dependent Riccati solution, section 8.

    The sum over samples of (s(P(x_j, t_j))/s(P_SDRE(x_j)) - 1)^2 is made as small as possible, s the largest singular
    value, 0 <= k_n <= 1, l_n >= 0, from several starts.

    Args:
        x: CasADi symbol of the state, shape (n,), that A is written in.
        A0: numbers, (n, n) [1/s].
        A: an expression in x, (n, n) [1/s].
        B: input matrix, numbers, (n, m).
        Q: weight of the state, positive semidefinite, (n, n).
        R: weight of the input, positive definite, (m, m).
        states: of a trajectory, usually one under the law of `covocp.blocks.sdre`, (J, n).
        times: when they are reached, (J,) [s].
        terms: number of terms, at least 2.
        starts: number of starts, the first with k = 0.
        seed: of the random ones.

    Returns:
        The best of what the starts found.

    Raises:
        ProblemError: an argument does not fit, no Riccati solution at a state, or a pair is not stabilisable or not
            detectable (names the mode).
    """
    begin = series.start(A0, B, Q, R)
    size, count = begin.riccati.shape[0], _count(terms, starts)
    samples = as_states(states, size)
    instants = values.numeric("times", values.matrix("times", times)).ravel()
    if instants.size != len(samples):
        raise values.wrong_argument("times", f"{len(samples)} numbers, one for each state", f"{instants.size} numbers")
    riccati = sdre.solution(x, A0, A, B, Q, R)
    wanted = np.array([_largest(riccati(sample)) for sample in samples])
    state, rest = dependence(x, A, size)
    epsilon = ca.SX.sym("epsilon", count)
    inputs: Any = [state, epsilon]
    total = sum(series.corrections(begin, rest, ca.vertsplit(epsilon)), ca.SX(size, size))
    sums = ca.Function("P", inputs, [total]).map(len(samples))

    def misfits(unknown: Array) -> Array:
        factors = 1.0 - unknown[:count, None] * np.exp(-unknown[count:, None] * instants)
        found = sums(samples.T, factors).full().T.reshape(len(samples), size, size)
        return np.asarray(_largest(found) / wanted - 1.0)

    best, misfit = _fitted(misfits, count, _guesses(count, starts, float(np.ptp(instants)), seed))
    k = np.where(best[:count] < NEGLIGIBLE, 0.0, best[:count])
    return Choice(k=k, l=np.where(k == 0.0, 0.0, best[count:]), misfit=misfit)


def _fitted(misfits: Callable[[Array], Array], count: int, guesses: Array) -> tuple[Array, float]:
    """The best k and l of all the starts, and their misfit (root mean square)."""
    from scipy.optimize import least_squares

    bounds = (np.zeros(2 * count), np.repeat([1.0, np.inf], count))
    fits = [least_squares(misfits, guess, bounds=bounds, xtol=1e-12, ftol=1e-12, gtol=1e-12) for guess in guesses]
    best = min(fits, key=lambda fit: float(fit.cost))
    return np.asarray(best.x), float(np.sqrt(np.mean(np.square(best.fun))))


def _guesses(count: int, starts: int, span: float, seed: int) -> Array:
    """Starts of the fit: k = 0, k = 1 with slow rates, then random ones with rates around the length of the samples."""
    generator = np.random.default_rng(seed)
    scale = 1.0 / span if span > 0.0 else 1.0
    factors = np.vstack([np.zeros(count), np.ones(count), generator.uniform(0.0, 1.0, (starts, count))])
    rates = np.vstack([np.full((2, count), scale), scale * 10.0 ** generator.uniform(-1.0, 2.0, (starts, count))])
    return np.asarray(np.hstack([factors, rates])[:starts])


def _count(terms: int, starts: int) -> int:
    """Number of corrections of a fit."""
    for name, value, least in (("terms", terms, 2), ("starts", starts, 1)):
        if not is_whole(value, least):
            raise values.wrong_argument(name, f"a whole number, {least} or more", repr(value))
    return int(terms) - 1


def _largest(matrices: Array) -> Any:
    """Largest singular values."""
    return np.linalg.norm(matrices, 2, axis=(-2, -1))


def _matrices(state: Expr, rest: Expr, samples: Array) -> list[Array]:
    """A(x) at the samples."""
    inputs: Any = ([state], [rest])
    evaluate = ca.Function("A", *inputs)
    matrices = [np.asarray(evaluate(sample).full()) for sample in samples]
    for sample, matrix in zip(samples, matrices, strict=True):
        if not np.isfinite(matrix).all():
            raise values.wrong_argument(
                "A", "finite entries at every state", f"NaN or inf at x = {np.array2string(sample)}"
            )
    return matrices


def _weighed(A0: Expr, Q: Expr) -> tuple[Array, Array]:
    """A0 and Q as numbers, after `series.start` has looked at them."""
    return values.numeric("A0", values.matrix("A0", A0)), values.symmetrised(values.numeric("Q", values.matrix("Q", Q)))


def _radii(begin: series.Start, A0: Array, Q: Array, matrices: Sequence[Array], bounds: Array) -> Array:
    """The radius for each A(x); those that are multiples of one another share one search."""
    known: dict[tuple[float, ...], float] = {}
    radii = []
    for matrix, bound in zip(matrices, bounds, strict=True):
        size = float(matrix.flat[np.argmax(np.abs(matrix))])
        if size == 0.0:
            radii.append(np.inf)
            continue
        key = tuple(np.round(matrix / size, 13).ravel().tolist())
        if key not in known:
            known[key] = abs(size) * nearest_singularity(begin, A0, Q, matrix, bound)
        radii.append(known[key] / abs(size))
    return np.array(radii)


def _coordinates(closed_loop: Array) -> tuple[Array, Array]:
    """X with X' X = Pi, which is Pi^1/2 but for a rotation, and its inverse, A_c' Pi + Pi A_c = -I."""
    squares = np.asarray(lyapunov(closed_loop.T, np.eye(len(closed_loop))))
    units = diagonal_scales(squares)  # states in other units leave small eigenvalues no digit, and some a minus
    values, vectors = np.linalg.eigh(over(squares, units))
    roots = np.sqrt(values)
    return (vectors * roots) @ vectors.T * units, ((vectors / roots) @ vectors.T) / units[:, None]


def _largest_symmetric(matrix: Array) -> float:
    return float(np.linalg.eigvalsh(matrix + matrix.T)[-1])


def _bounds(begin: series.Start) -> Any:
    """A function from A(x) to the radius that a majorant guarantees.

    In the coordinates z = Pi^1/2 x let kappa be the norm of the inverse Lyapunov operator (which is that of its value
    at the identity) and a, s, p those of A(x), S, T_0. Then |T_n| <= kappa (2 a |T_(n-1)| + s sum |T_j| |T_(n-j)|), and
    the sum of these bounds solves a quadratic equation, whose root is real up to the radius returned.
    """
    root, inverse_root = _coordinates(begin.closed_loop)
    transformed = root @ begin.closed_loop @ inverse_root
    kappa = np.linalg.norm(np.asarray(lyapunov(transformed.T, np.eye(len(root)))), 2)
    spread = (
        kappa
        * np.linalg.norm(root @ begin.root, 2) ** 2
        * np.linalg.norm(inverse_root.T @ begin.riccati @ inverse_root, 2)
    )
    limit = 1.0 / (1.0 + 2.0 * spread + np.sqrt((1.0 + 2.0 * spread) ** 2 - 1.0))

    def guaranteed(A: Array) -> float:
        size = float(np.linalg.norm(root @ A @ inverse_root, 2))
        return float(limit / (2.0 * kappa * size)) if size > 0.0 else np.inf

    return guaranteed
