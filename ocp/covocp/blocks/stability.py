"""Lyapunov certificates of linear closed loops."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from covocp.base.arguments import checked, truth
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Expr
from covocp.base.short_repr import short_repr
from covocp.blocks.algebraic import frozen, lyapunov, mode_text
from covocp.blocks.reachability import lost_modes, slow_modes
from covocp.blocks.scaling import ROUNDOFF, RUBBLE, diagonal_scales, over
from covocp.blocks.values import numeric, square, symmetrised, weight, wrong_argument

Array = NDArray[np.float64]

# Rounding of an eigenvalue, in units of the machine's precision times size and norm of what it was computed from.
ROUNDING = 10.0


@dataclass(frozen=True, kw_only=True, eq=False)
class LyapunovCertificate:
    """V(x) = x'matrix x along x+ = A x or dx/dt = A x; arrays are read-only.

    Args:
        matrix: of V, shape (n, n).
        decrease: D with V+ - V = -x'D x, or dV/dt = -x'D x, shape (n, n).
        proves: whether V proves that x = 0 is globally asymptotically stable.
        reason: why, or why not, in words.
    """

    matrix: Array
    decrease: Array
    proves: bool
    reason: str

    __repr__ = short_repr


@checked(discrete=truth)
def lyapunov_certificate(
    closed_loop: Expr, matrix: Expr = None, *, decrease: Expr = None, discrete: bool = False
) -> LyapunovCertificate:
    """What a quadratic Lyapunov function says about a linear closed loop (item 7).

    Of a regulator, `matrix` is its cost S: then D = Q + K'R K, and V proves stability where Q is positive definite, or
    semidefinite with (Phi, Q^1/2) detectable (what does not decrease V decays by itself).

    Args:
        closed_loop: A, shape (n, n); of a regulator A - B K.
        matrix: of V, symmetric, shape (n, n); None: the one that has the given decrease.
        decrease: D, positive semidefinite, shape (n, n), where no matrix is given; None: the unit matrix.
        discrete: x+ = A x instead of dx/dt = A x.

    Returns:
        V, its decrease, and whether it proves global asymptotic stability.

    Raises:
        ProblemError: expressions, shapes that do not fit, matrix and decrease both given, a matrix that is not
            symmetric, no V with that decrease (modes on the boundary of stability).
    """
    a = numeric("closed_loop", square("closed_loop", closed_loop))
    size = a.shape[0]
    if matrix is None:
        wanted = np.eye(size) if decrease is None else numeric("decrease", weight("decrease", decrease, size))
        v = np.atleast_2d(lyapunov(a.T, symmetrised(wanted), discrete=discrete))
    elif decrease is None:
        v = _symmetric(numeric("matrix", square("matrix", matrix, size)))
    else:
        raise ProblemError(
            "Both the matrix of V and its decrease are given.",
            expected="one of them: each follows from the other",
            received="both",
            remedy="leave one out",
        )
    d = symmetrised(v - a.T @ v @ a if discrete else -(a.T @ v + v @ a))
    proves, reason = _verdict(a, v, d, discrete)
    return LyapunovCertificate(matrix=frozen(v), decrease=frozen(d), proves=proves, reason=reason)


def _symmetric(numbers: Array) -> Array:
    sizes = np.sqrt(np.abs(np.diag(numbers)))
    difference = np.abs(numbers - numbers.T)
    rounding = RUBBLE * len(numbers) * np.finfo(float).eps * np.abs(numbers).max(initial=0.0)
    if (difference > np.maximum(ROUNDOFF * np.outer(sizes, sizes), rounding)).any():
        given = f"an asymmetry of {difference.max():.3g}"
        raise wrong_argument("matrix", "a symmetric matrix", given, "V = x'matrix x has a symmetric one")
    return np.asarray(symmetrised(numbers))


def _verdict(A: Array, V: Array, D: Array, discrete: bool) -> tuple[bool, str]:
    """Whether V proves stability, and why; positive means by more than the rounding.

    All is judged in units of the states in which V has unit diagonal, for a congruence changes no sign; the modes have
    the last word, since what V proves must hold for them.
    """
    if not len(A):
        return True, "V is positive definite and decreases everywhere but at x = 0"
    units = diagonal_scales(V)
    A, V, D = A * units[:, None] / units, over(V, units), over(D, units)
    growth = np.linalg.norm(A, 2)
    unit = ROUNDING * len(A) * np.finfo(float).eps * np.linalg.norm(V, 2)
    rounding_v, rounding_d = float(unit), float(unit * (1.0 + growth**2 if discrete else 2.0 * growth))
    least_v, least_d = (float(np.linalg.eigvalsh(entry)[0]) for entry in (V, D))
    if least_v < -rounding_v:
        return False, f"V is negative somewhere: its smallest eigenvalue is {least_v:.3g}"
    if least_d < -rounding_d:
        return False, f"V grows somewhere: the smallest eigenvalue of its decrease is {least_d:.3g}"
    slow = slow_modes(A, discrete=discrete)
    if least_v > rounding_v and least_d > rounding_d:
        if slow.size:
            return False, f"V decreases, but not by more than the rounding of the mode {mode_text(slow[0])}"
        return True, "V is positive definite and decreases everywhere but at x = 0"
    values, vectors = np.linalg.eigh(D)
    seen = (vectors * np.sqrt(np.where(values > rounding_d, values, 0.0))) @ vectors.T
    hidden = lost_modes(A.T, np.asarray(seen), discrete=discrete)
    hidden = hidden if hidden.size else slow
    if hidden.size:
        return False, f"V does not decrease along the mode {mode_text(hidden[0])}, which is not stable"
    kind = "definite" if least_v > rounding_v else "semidefinite"
    return True, f"V is positive {kind}, and what does not decrease it decays by itself (invariance)"
