"""Algebraic Riccati and Lyapunov equations with numbers, and the modes that keep them from having a solution.

Everything here is numeric (scipy); a Lyapunov equation, being linear, may also hold expressions.
"""

from __future__ import annotations

import warnings
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.arguments import checked, truth
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.blocks.arithmetic import apply
from covocp.blocks.doubling import doubled
from covocp.blocks.reachability import balance, lost_modes, nearness, slow_modes, weighted_directions
from covocp.blocks.scaling import diagonal_scales, over, semidefinite_part, semidefinite_root
from covocp.blocks.updates import row_matrix
from covocp.blocks.values import is_symbolic, matrix, numeric, restored, square, symmetrised, weight

Array = NDArray[np.float64]
Modes = NDArray[np.complex128]

# Largest relative residual of a Riccati equation that counts as solved.
RESIDUAL = 1e-7
# A mode that stays on the boundary is blamed on what hardly reaches or weights it where this share of the data decides.
NEAR = 1e-6
# Most Newton steps after scipy's solution: where that is off by a tenth, five reach rounding.
STEPS = 8


def continuous(A: Expr, B: Expr, Q: Expr, R: Expr, *, cross: Expr = None) -> Any:
    """Stabilising solution S of A'S + S A - (S B + N) R^-1 (B'S + N') + Q = 0.

    Args:
        A: shape (n, n) [1/s].
        B: shape (n, m).
        Q: weight of the state, positive semidefinite, shape (n, n).
        R: weight of the control, positive definite, shape (m, m).
        cross: N, weight of state times control, shape (n, m); None: zero.

    Returns:
        S, shape (n, n), positive semidefinite.

    Raises:
        ProblemError: expressions, shapes that do not fit, indefinite weights, (A, B) not stabilisable or a mode on the
            imaginary axis that the weights do not see (names the mode).
    """
    return restored(stabilising(*weights(A, B, Q, R, cross), discrete=False), A)


def discrete(A: Expr, B: Expr, Q: Expr, R: Expr, *, cross: Expr = None) -> Any:
    """Stabilising solution S of S = A'S A - (A'S B + N) (R + B'S B)^-1 (B'S A + N') + Q, of item 5.

    Args:
        A: transition matrix, shape (n, n).
        B: shape (n, m).
        Q: weight of the state, positive semidefinite, shape (n, n).
        R: weight of the control, positive definite, shape (m, m).
        cross: N, weight of state times control, shape (n, m); None: zero.

    Returns:
        S, shape (n, n), positive semidefinite.

    Raises:
        ProblemError: as for `continuous`, with the unit circle in place of the imaginary axis.
    """
    return restored(stabilising(*weights(A, B, Q, R, cross), discrete=True), A)


@checked(discrete=truth)
def lyapunov(A: Expr, Q: Expr, *, discrete: bool = False) -> Any:
    """Solution X of A X + X A' + Q = 0, or of A X A' - X + Q = 0.

    Args:
        A: shape (n, n), numbers or an expression.
        Q: shape (n, n), numbers or an expression, usually symmetric.
        discrete: which of the two equations.

    Returns:
        X, shape (n, n); symmetric where Q is.

    Raises:
        ProblemError: shapes that do not fit; no unique solution, because two modes add up to zero (discrete: have the
            product one).
    """
    a = square("A", A)
    q = square("Q", Q, a.shape[0])
    if is_symbolic(a, q):
        return _linear_lyapunov(a, q, discrete)
    from scipy import linalg

    # The solver rotates the states, after which small entries would be known to rounding of the largest only.
    transition, units = balance(a.full())
    right = q.full() / units[:, None] / units
    values = np.linalg.eigvals(transition)
    pairs = values[:, None] * values[None, :] - 1.0 if discrete else values[:, None] + values[None, :]
    scale = max(1.0, np.abs(values).max(initial=0.0) ** 2) if discrete else np.abs(values).max(initial=0.0)
    if pairs.size and np.abs(pairs).min() <= 1e-14 * scale:
        i, j = np.unravel_index(int(np.argmin(np.abs(pairs))), pairs.shape)
        relation = "have the product one" if discrete else "add up to zero"
        raise ProblemError(
            f"The Lyapunov equation has no unique solution: two modes of A {relation}.",
            expected="modes of A inside the unit circle" if discrete else "modes of A in the left half plane",
            received=f"{mode_text(values[i])} and {mode_text(values[j])}",
            remedy="stabilise A first",
        )
    solve = linalg.solve_discrete_lyapunov if discrete else linalg.solve_continuous_lyapunov
    solution = np.asarray(solve(transition, right if discrete else -right), dtype=float)
    if np.array_equal(right, right.T):
        solution = symmetrised(solution)
    return restored(solution * units[:, None] * units, A)


@checked(discrete=truth)
def unstabilisable(A: Expr, B: Expr, *, discrete: bool = False) -> Modes:
    """Modes of A that are not stable and that B does not reach (Hautus: [A - mode I, B] loses rank).

    Args:
        A: shape (n, n).
        B: shape (n, m).
        discrete: stable means inside the unit circle, not in the left half plane.

    Returns:
        Eigenvalues of A, empty where the pair is stabilisable.

    Raises:
        ProblemError: expressions, shapes that do not fit.
    """
    a = numeric("A", square("A", A))
    return lost_modes(a, numeric("B", matrix("B", B, (a.shape[0], None))), discrete=discrete)


@checked(discrete=truth)
def undetectable(A: Expr, H: Expr, *, discrete: bool = False) -> Modes:
    """Modes of A that are not stable and that H does not see: those of the dual pair (A', H').

    Args:
        A: shape (n, n).
        H: shape (m, n), or (n,) for one measurement.
        discrete: stable means inside the unit circle, not in the left half plane.

    Returns:
        Eigenvalues of A, empty where the pair is detectable.

    Raises:
        ProblemError: expressions, shapes that do not fit.
    """
    a = numeric("A", square("A", A))
    return lost_modes(a.T, numeric("H", row_matrix("H", H, a.shape[0])).T, discrete=discrete)


def mode_text(mode: complex) -> str:
    """An eigenvalue in words: a real one without its imaginary part."""
    value = complex(mode)
    if abs(value.imag) <= 1e-12 * max(1.0, abs(value)):
        return f"{value.real:.6g}"
    return f"{value.real:.6g} {'+' if value.imag >= 0 else '-'} {abs(value.imag):.6g}i"


def root(weights: Array) -> Array:
    """Square root of a positive semidefinite matrix, X with X X' = weights, each row to rounding of itself."""
    return semidefinite_root(weights)


def lost_mode(modes: Modes, pair: str, needed: str, remedy: str, why: str = "") -> ProblemError:
    """The error that names the first of some modes."""
    return ProblemError(
        f"The pair {pair} is not {needed}.",
        expected=f"a {needed} pair",
        received="the mode " + ", ".join(mode_text(mode) for mode in modes[:3]) + (f", which {why}" if why else ""),
        remedy=remedy,
    )


@dataclass(frozen=True, kw_only=True)
class Words:
    """What the user calls the matrices of a Riccati equation, and the two ways in which a mode can be lost.

    Args:
        names: of A, B, Q, R.
        reach: of (A, B): the pair, what it should be, the remedy, why a mode is lost.
        see: of (A, Q^1/2): the same.
    """

    names: tuple[str, str, str, str] = ("A", "B", "Q", "R")
    reach: tuple[str, str, str, str] = (
        "(A, B)",
        "stabilisable",
        "add an input, or take the mode out of the model",
        "B does not reach",
    )
    see: tuple[str, str, str, str] = (
        "(A, Q^1/2)",
        "detectable",
        "give the mode a weight, or take it out of the model",
        "Q gives no weight",
    )


CONTROL = Words()


def weights(A: Expr, B: Expr, Q: Expr, R: Expr, cross: Expr, words: Words = CONTROL) -> tuple[Array, ...]:
    """The five matrices of a linear-quadratic problem as checked numbers.

    Raises:
        ProblemError: expressions, shapes that do not fit, Q or [Q N; N' R] not positive semidefinite, R not definite.
    """
    names = words.names
    a = numeric(names[0], square(names[0], A))
    b = numeric(names[1], matrix(names[1], B, (a.shape[0], None)))
    q = numeric(names[2], weight(names[2], Q, a.shape[0]))
    r = numeric(names[3], weight(names[3], R, b.shape[1], definite=True))
    n = np.zeros(b.shape) if cross is None else numeric("cross", matrix("cross", cross, b.shape))
    if cross is not None:
        weight(f"[{names[2]}, cross; cross', {names[3]}]", np.block([[q, n], [n.T, r]]))
    return a, b, symmetrised(q), symmetrised(r), n


def stabilising(
    A: Array,
    B: Array,
    Q: Array,
    R: Array,
    N: Array,
    *,
    discrete: bool,
    detectable: bool = False,
    words: Words = CONTROL,
) -> Array:
    """The stabilising solution, Newton steps after scipy's; `detectable`: refuse every unstable mode without weight.

    Raises:
        ProblemError: a mode that is not reached, or has no weight and is marginal or must be detectable; no solution.
    """
    reached = lost_modes(A, B, discrete=discrete)
    if reached.size:
        raise lost_mode(reached, *words.reach)
    back = np.linalg.solve(R, N.T)
    rest = symmetrised(Q - N @ back)
    seen = weighted_directions(rest, np.abs(Q) + np.abs(N) @ np.abs(back))
    unseen = lost_modes((A - B @ back).T, seen, discrete=discrete, marginal=not detectable, weights=rest)
    if unseen.size:
        raise lost_mode(unseen, *words.see)
    # In units of R: scipy's pencil, with R beside A and Q, is off by up to a tenth where their sizes are far apart, and
    # takes an R for singular whose entries are. Powers of two change no digit of the numbers.
    unit = 2.0 ** np.round(np.log2(np.linalg.norm(R, 2))) if R.size else 1.0
    inputs = diagonal_scales(R / unit)
    B, Q, R, N = B / inputs, Q / unit, over(R / unit, inputs), N / unit / inputs
    if not len(A):
        return np.zeros((0, 0))
    solution, residual, received = _solved(A, B, Q, R, N, discrete)
    left = _left(A, B, R, N, solution, discrete)
    if left.size:
        # lost within rounding only: named by the mode, and the pair, that is nearest to it
        shares = [
            (nearness(*pair, mode), mode, why)
            for mode in left
            for pair, why in (((A, B), words.reach[3]), (((A - B @ back).T, seen), words.see[3]))
        ]
        share, mode, why = min(shares, key=lambda one: one[0])
        if share <= NEAR:
            raise _unsolved(f"the mode {mode_text(mode)}, which {why} but for a share of {share:.1g} of the entries")
        raise _unsolved(received or "the closed loop is not stable")
    if not residual <= RESIDUAL:
        raise _unsolved(received or f"a relative residual of {residual:.3g}")
    return solution * unit


def _solved(A: Array, B: Array, Q: Array, R: Array, N: Array, discrete: bool) -> tuple[Array, float, str]:
    """The solution, its relative residual (infinite: none), and what the last of the methods said that failed.

    Scipy's solver orders the eigenvalues of a pencil, which fails where some are close to the boundary or rounding
    moves them over it. Doubling knows none of them. Each is judged by what is returned, its semidefinite part.
    """
    from scipy import linalg

    best, least, received = np.zeros(A.shape), np.inf, ""
    with warnings.catch_warnings():
        # of equations that are all but singular: the residual says what became of it
        warnings.simplefilter("ignore", linalg.LinAlgWarning)
        warnings.filterwarnings("ignore", "Input .* has an eigenvalue pair whose sum", RuntimeWarning)
        for start in (_by_pencil, doubled):
            try:
                found = start(A, B, Q, R, N, discrete=discrete)
                solution = semidefinite_part(_corrected(A, B, Q, R, N, found, discrete))
                residual = _relative_residual(A, B, Q, R, N, solution, discrete)
            except (np.linalg.LinAlgError, ValueError) as error:
                received = str(error)
                continue
            if residual < least:
                best, least, received = solution, residual, ""
            if least <= RESIDUAL:
                break
    return best, least, received


def _by_pencil(A: Array, B: Array, Q: Array, R: Array, N: Array, *, discrete: bool) -> Array:
    """Scipy's solution; without inputs that of the linear equation."""
    from scipy import linalg

    if not B.shape[1]:
        return np.asarray(np.atleast_2d(lyapunov(A.T, Q, discrete=discrete)))
    solve = linalg.solve_discrete_are if discrete else linalg.solve_continuous_are
    return np.asarray(symmetrised(np.asarray(solve(A, B, Q, R, s=N), dtype=float)))


def _corrected(A: Array, B: Array, Q: Array, R: Array, N: Array, start: Array, discrete: bool) -> Array:
    """A solution corrected by Newton's method with the diagonal scaled to one."""
    units = diagonal_scales(start)
    solution = _newton(*_in_units(A, B, Q, N, units), R, over(start, units), discrete)
    return np.asarray(solution * units[:, None] * units)


def _in_units(A: Array, B: Array, Q: Array, N: Array, units: Array) -> tuple[Array, Array, Array, Array]:
    """A, B, Q, N of states times these units."""
    return A * units[:, None] / units, B * units[:, None], over(Q, units), N / units[:, None]


def _relative_residual(A: Array, B: Array, Q: Array, R: Array, N: Array, S: Array, discrete: bool) -> float:
    """Residual over the size of the terms, the diagonal of S scaled to one; infinite where the closed loop is unstable.

    Where the closed loop is smaller than A its terms are those of the discrete equation: held against what an unstable
    plant makes of S, anything would be a solution.
    """
    if _left(A, B, R, N, S, discrete).size:
        return np.inf
    units = diagonal_scales(S)
    A, B, Q, N = _in_units(A, B, Q, N, units)
    S = over(S, units)
    residual = float(np.abs(_residual(A, B, Q, R, N, S, discrete)).max(initial=0.0))
    size = float(np.abs(A).max(initial=0.0))
    if discrete:
        closed = A - B @ gain_of(A, B, R, N, S, discrete=True)
        size = max(1.0, min(size, float(np.abs(closed).max(initial=0.0))))
    scale = max(float(np.abs(Q).max(initial=0.0)), size * float(np.abs(S).max(initial=0.0)), np.finfo(float).tiny)
    return 0.0 if residual == 0.0 else residual / float(scale)


def _left(A: Array, B: Array, R: Array, N: Array, S: Array, discrete: bool) -> Modes:
    """Modes of the closed loop of S that are not stable."""
    return slow_modes(A - B @ gain_of(A, B, R, N, S, discrete=discrete), discrete=discrete)


def _unsolved(received: str) -> ProblemError:
    return ProblemError(
        "The Riccati equation could not be solved.",
        expected="a solution that makes the closed loop stable",
        received=received,
        remedy="scale states and inputs to similar sizes; look for modes that are hardly reached or weighted",
    )


def gain_of(A: Array, B: Array, R: Array, cross: Array, S: Array, *, discrete: bool) -> Array:
    """K = R^-1 (B'S + N'), or (R + B'S B)^-1 (B'S A + N') of item 5."""
    if discrete:
        return np.asarray(np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A + cross.T))
    return np.asarray(np.linalg.solve(R, B.T @ S + cross.T))


def frozen(numbers: Expr) -> Any:
    """A copy of an array that cannot be written to."""
    result = np.array(numbers)
    result.setflags(write=False)
    return result


def sorted_modes(A: Array) -> Modes:
    """Eigenvalues, sorted by real part; read-only."""
    result: Modes = frozen(np.sort_complex(np.linalg.eigvals(A)))
    return result


def _newton(A: Array, B: Array, Q: Array, N: Array, R: Array, S: Array, discrete: bool) -> Array:
    """Kleinman's iteration until rounding ends its quadratic convergence.

    From a start that is far off the first step may lead farther away, never a later one.
    """
    left = _residual(A, B, Q, R, N, S, discrete)
    best, least = S, float(np.abs(left).max(initial=0.0))
    for step in range(STEPS):
        closed = A - B @ gain_of(A, B, R, N, S, discrete=discrete)
        if slow_modes(closed, discrete=discrete).size:
            break
        # S and a correction from the residual, not S anew: a closed loop of large norm rounds much coarser than A
        S = S + np.asarray(lyapunov(closed.T, symmetrised(left), discrete=discrete))
        left = _residual(A, B, Q, R, N, S, discrete)
        size = float(np.abs(left).max(initial=0.0))
        if size < least:
            best, least = S, size
        elif step:
            break
    return best


def _residual(A: Array, B: Array, Q: Array, R: Array, N: Array, S: Array, discrete: bool) -> Array:
    """Of the equation; the discrete one also with the closed loop C, S = C'S C + Q + K'R K - N K - K'N'.

    Of an unstable plant A'S A, and what is subtracted from it, may be 10^14 times as large as S. Where inputs cost next
    to nothing it is C that is large. The form whose terms are smaller leaves less rounding.
    """
    K = gain_of(A, B, R, N, S, discrete=discrete)
    if not discrete:
        return A.T @ S + S @ A + Q - (S @ B + N) @ K
    closed, cross, sizes = A - B @ K, N @ K, np.abs(S)
    terms = np.abs(closed).T @ sizes @ (np.abs(A) + np.abs(B) @ np.abs(K))
    if np.max(terms, initial=0.0) < np.max(np.abs(A).T @ sizes @ np.abs(A), initial=0.0):
        return closed.T @ S @ closed - S + Q + K.T @ R @ K - cross - cross.T
    return A.T @ S @ A - S + Q - (A.T @ S @ B + N) @ K


def _linear_lyapunov(A: Expr, Q: Expr, discrete: bool) -> Any:
    """The equation as one linear system of n^2 unknowns, which expands to SX."""

    def lyapunov(a: Expr, q: Expr) -> tuple[Any]:
        unit = ca.SX.eye(a.shape[0])
        operator = ca.kron(a, a) - ca.SX.eye(a.shape[0] ** 2) if discrete else ca.kron(unit, a) + ca.kron(a, unit)
        right: Expr = ca.vec(q)
        return (ca.reshape(ca.solve(operator, -right), a.shape),)

    return apply(lyapunov, A, Q)[0]
