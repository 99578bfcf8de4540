"""Steps of covariances in longer arithmetic than that of the project."""

import numpy as np


def solved(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """A^-1 B in long double arithmetic."""
    A, B = A.copy(), B.copy()
    for k in range(len(A)):
        p = k + int(np.argmax(np.abs(A[k:, k])))
        A[[k, p]], B[[k, p]] = A[[p, k]], B[[p, k]]
        shares = (A[:, k] / A[k, k])[:, None]
        shares[k] = 0.0
        A, B = A - shares * A[k], B - shares * B[k]
    return B / np.diag(A)[:, None]


def in_long_double(E: np.ndarray, h1: np.ndarray, h2: np.ndarray, *, steps: int) -> np.ndarray:
    """The last covariance."""
    return passed_in_long_double(E, h1, h2, steps=steps)[-1]


def passed_in_long_double(E: np.ndarray, h1: np.ndarray, h2: np.ndarray, *, steps: int) -> np.ndarray:
    """The covariance after each step by the stages themselves: Y_i = Z0 + sum_j a_ij h H_j Y_j."""
    n = len(E)
    root = np.sqrt(np.longdouble(3.0))
    a = np.array([[0.25, 0.25 - root / 6], [0.25 + root / 6, 0.25]], dtype=np.longdouble)
    E, passed = E.astype(np.longdouble), []
    for k in range(steps):
        span = slice(2 * n * k, 2 * n * (k + 1))
        H = [h1[:, span].astype(np.longdouble), h2[:, span].astype(np.longdouble)]
        Z = np.vstack([np.eye(n, dtype=np.longdouble), E])
        system = np.block([[(i == j) * np.eye(2 * n) - a[i, j] * H[j] for j in range(2)] for i in range(2)])
        Y = solved(system, np.vstack([Z, Z]))
        Z = Z + (H[0] @ Y[: 2 * n] + H[1] @ Y[2 * n :]) / 2
        E = solved(Z[:n].T, Z[n:].T)
        E = (E + E.T) / 2
        passed.append(E)
    return np.array(passed)
