"""Gains for samples of a fixed period, and the deviations of the loop that flies with them.

The control is held between two samples: the best gain of that is not C(t) of the continuous loop, which overcorrects
where it is large against 1/period, and may destabilise what it was made to hold.
"""

from __future__ import annotations

import numpy as np

from covocp.base.matrices import Array
from covocp.export.laws.moves import Moves


def sampled_gains(moves: Moves, final_weight: Array, samples: int) -> Array:
    """Gains of the deviation at each sample, of the control that is held from it: discrete Riccati recursion.

    Args:
        moves: between the samples, and from the last one to the end where that is later.
        final_weight: S(T), (n, n).
        samples: number of them, K + 1.

    Returns:
        C_k, (K + 1, m, n). A sample at the end itself holds nothing and has the gain of the one before.
    """
    n, m, _ = moves.sizes
    S, gains = final_weight, np.zeros((samples, m, n))
    periods = len(moves.first) - 1
    for k in range(periods - 1, -1, -1):
        weight = moves.weighed(k, S)
        gains[k] = np.linalg.solve(weight[n:, n:], weight[n:, :n])
        rest = np.vstack([np.eye(n), -gains[k]])
        S = rest.T @ weight @ rest
    gains[periods:] = gains[periods - 1]
    return gains


def flown_covariances(
    moves: Moves,
    period: float,
    start: Array,
    gains: Array,
    filters: Array,
    rows: Array,
    slopes: Array,
    variances: Array,
) -> Array:
    """Covariances of the deviation from the nominal at the samples, as the sampled law flies.

    The law is told the mean of the measurement over the period before, its noise included. With y its estimate,
    y- = Phi y + Gamma v, y = y- + L (mean - M y- - H v), v = -C y. What is read at an instant it is told as it is.

    Args:
        moves: between the samples.
        period: of the samples [s].
        start: covariance at time zero, (n, n).
        gains: C_k, (K + 1, m, n). filters: L_k, (K + 1, n, r). rows: M_k, (K + 1, r, n). slopes: H_k, (K + 1, r, m).
        variances: of the noise of all values, read where they are read at instants, (K + 1, r, r).

    Returns:
        (K + 1, n, n).
    """
    n, always = start.shape[0], moves.sizes[2]
    read = slice(n + always, None)
    first = filters[0]  # of what is read at time zero
    told = first @ rows[0] @ start
    known = told @ rows[0].T @ first.T + first @ variances[0] @ first.T
    joint = np.block([[start, told.T], [told, known]])  # of (deviation, estimate)
    result = [start]
    for k in range(1, gains.shape[0]):
        by_state, by_control, noise = moves.measuring(k - 1)
        size = by_state.shape[0]
        mean = np.vstack([np.eye(n, size), np.eye(size)[n:] / period, rows[k][always:] @ np.eye(n, size)])
        by_state, by_control, noise = mean @ by_state, mean @ by_control, mean @ noise @ mean.T
        by_control[read] += slopes[k][always:]
        noise[read, read] += variances[k][always:, always:]
        v = -gains[k - 1]
        ahead = by_state[:n] + by_control[:n] @ v  # of the estimate alone
        expected = rows[k] @ ahead + slopes[k] @ v
        L = filters[k]
        move = np.block(
            [
                [by_state[:n], by_control[:n] @ v],
                [L @ by_state[n:], ahead + L @ (by_control[n:] @ v - expected)],
            ]
        )
        enters = np.block([[np.eye(n), np.zeros((n, L.shape[1]))], [np.zeros((n, n)), L]])
        joint = move @ joint @ move.T + enters @ noise @ enters.T
        joint = 0.5 * (joint + joint.T)
        result.append(joint[:n, :n])
    return np.array(result)
