"""Lanczos steps with a symmetric operator: its extreme eigenvalues, and systems with it and a shift."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr

LEAST_STEPS = 8
# A step whose remainder is below this share of the largest Ritz value has found an invariant subspace.
INVARIANT = 1e-10


@dataclass(frozen=True, kw_only=True)
class Krylov:
    """What some Lanczos steps tell of a symmetric operator.

    Attributes:
        values: Ritz values, rising; `vectors`: theirs, in columns.
        residual: of the smallest: an eigenvalue lies within it.
        asymmetry: largest difference of the operator from its transpose on the subspace.
        diagonal, beside: of the tridiagonal form; the last entry of `beside` leads out of the subspace.
    """

    values: Array
    vectors: Array
    residual: float
    asymmetry: float
    diagonal: Array
    beside: Array

    __repr__ = short_repr

    def inverse_form(self, shift: float, length: float, smallest: float) -> float:
        """Upper bound of r' (operator + shift)^-1 r for the start r of this length; `smallest`: below all eigenvalues.

        What the subspace misses of the solution has the residual rho, and adds at most rho^2 / (smallest + shift).
        """
        from scipy.linalg import solveh_banded  # here: importing scipy takes longer than all of covocp

        if length == 0.0:
            return 0.0
        banded = np.vstack([np.append(0.0, self.beside[:-1]), self.diagonal + shift])
        right = np.append(length, np.zeros(self.diagonal.size - 1))
        solution = solveh_banded(banded, right) if right.size > 1 else right / banded[1]
        missed = float(self.beside[-1] * solution[-1])
        return float(length * solution[0] + missed**2 / (smallest + shift))


def krylov(
    apply: Callable[[Array], Array], start: Array, steps: int, known: Callable[[float, float, float], bool]
) -> Krylov:
    """Ritz pairs of a symmetric operator after a few Lanczos steps, fully reorthogonalised.

    An isolated extreme eigenvalue, such as the negative one of a saddle, converges first; inside a cluster the Ritz
    values lie in it.

    Args:
        apply: the operator.
        start: first vector; it is not zero.
        steps: the most of them.
        known: (smallest Ritz value, its residual, largest absolute one) -> whether that is enough.
    """
    steps = min(start.size, steps)
    basis, images = np.zeros((steps, start.size)), np.zeros((steps, start.size))
    diagonal, beside = np.zeros(steps), np.zeros(steps)
    vector = start / np.linalg.norm(start)
    for j in range(steps):
        basis[j] = vector
        images[j] = apply(vector)
        image = images[j].copy()
        diagonal[j] = image @ vector
        for _ in range(2):
            image -= basis[: j + 1].T @ (basis[: j + 1] @ image)
        beside[j] = np.linalg.norm(image)
        values, vectors = np.linalg.eigh(np.diag(diagonal[: j + 1]) + np.diag(beside[:j], -1))
        residual = float(beside[j] * np.abs(vectors[-1, 0]))
        largest = max(float(np.abs(values).max()), float(np.finfo(float).tiny))
        if beside[j] <= INVARIANT * largest or (j >= LEAST_STEPS and known(float(values[0]), residual, largest)):
            break
        vector = image / beside[j]
    count = j + 1
    projected = basis[:count] @ images[:count].T
    return Krylov(
        values=np.asarray(values, dtype=float),
        vectors=np.asarray(basis[:count].T @ vectors, dtype=float),
        residual=residual,
        asymmetry=float(np.abs(projected - projected.T).max()),
        diagonal=diagonal[:count],
        beside=beside[:count],
    )
