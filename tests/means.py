"""Linear systems of which the mean over a time is measured: by exponentials of matrices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm


class Told(NamedTuple):
    """Of (state at the end, mean of what is measured): slopes by the state at the start and the control, covariance."""

    state: np.ndarray
    held: np.ndarray
    noise: np.ndarray


def told(F, G, M, H, Q, U, h):
    """x' = F x + G u + w of density Q, M x + H u + v of density U, over a time h with the control held."""
    n, m, r = len(F), G.shape[1], len(M)
    joint = np.block([[F, np.zeros((n, r))], [M, np.zeros((r, r))]])
    drift = np.zeros((n + r + m, n + r + m))
    drift[: n + r] = np.hstack([joint, np.vstack([G, H])])
    density = np.block([[Q, np.zeros((n, r))], [np.zeros((r, n)), U]])
    loan = expm(h * np.block([[-joint, density], [np.zeros((n + r, n + r)), joint.T]]))
    move, size = expm(h * drift)[: n + r], n + r
    noise = loan[size:, size:].T @ loan[:size, size:]
    mean = np.diag(np.concatenate([np.ones(n), np.full(r, 1.0 / h)]))
    return Told(mean @ move[:, :n], mean @ move[:, size:], mean @ noise @ mean)


def filtered(P, own, there):
    """Gain of the rows that are there, all gains, covariance after all of them."""
    n = len(P)
    joint = own.state @ P @ own.state.T + own.noise
    some, every = np.zeros((n, len(joint) - n)), joint[:n, n:] @ np.linalg.inv(joint[n:, n:])
    rows = n + np.flatnonzero(there)
    some[:, there] = joint[:n, rows] @ np.linalg.inv(joint[np.ix_(rows, rows)])
    return some, every, joint[:n, :n] - every @ joint[n:, :n]
