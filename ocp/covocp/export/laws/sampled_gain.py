"""Gains for samples of a fixed period, and the deviations of the loop that flies with them: spread and mean.

The control is held between two samples: the best gain of that is not C(t) of the continuous loop, which overcorrects
where it is large against 1/period, and may destabilise what it was made to hold.
"""

from __future__ import annotations

import numpy as np

from covocp.base.matrices import Array
from covocp.export.laws.moves import Moves, Period


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
    periods: list[Period], start: Array, gains: Array, filters: Array, rows: Array, variances: Array
) -> Array:
    """Covariances of the deviation from the nominal at the samples, as the sampled law flies.

    The law is told the mean of the measurement over the period before, its noise included, and compares it with the
    mean that it expects. With y its estimate, y- = Phi y + Gamma v, y = y- + L (told - M y - H v), v = -C y: the
    control is the same on both sides. What is read at an instant it is told as it is.

    Args:
        periods: what happens in each of them, and what is told of it; the first entry counts for time zero.
        start: covariance at time zero, (n, n).
        gains: C_k, (K + 1, m, n). filters: L_k, (K + 1, n, r). rows: M_0, of what is read at time zero, (r, n).
        variances: of its noise, (r, r).

    Returns:
        (K + 1, n, n).
    """
    n, first = start.shape[0], filters[0]
    told = first @ rows @ start
    known = told @ rows.T @ first.T + first @ variances @ first.T
    joint = np.block([[start, told.T], [told, known]])  # of (deviation, estimate)
    result = [start]
    for k in range(1, gains.shape[0]):
        period, L = periods[k], filters[k]
        Phi, fed, seen = period.state[:n], -period.held[:n] @ gains[k - 1], L @ period.state[n:]
        move = np.block([[Phi, fed], [seen, Phi + fed - seen]])
        enters = np.block([[np.eye(n), np.zeros((n, L.shape[1]))], [np.zeros((n, n)), L]])
        joint = move @ joint @ move.T + enters @ period.noise @ enters.T
        joint = 0.5 * (joint + joint.T)
        result.append(joint[:n, :n])
    return np.array(result)


def flown_means(periods: list[Period], gains: Array, controls: Array, limits: tuple[Array, Array]) -> Array:
    """Means of the deviation from the nominal at the samples: a control that is held is not the nominal one.

    The estimate has the same mean: it knows what is held.

    Args:
        periods: what happens in each of them; the first entry counts for time zero.
        gains: C_k, (K + 1, m, n). controls: what is handed out without feedback, (K + 1, m).
        limits: lower and upper ones of the control, (m,) each.

    Returns:
        (K + 1, n).
    """
    n = gains.shape[2]
    result = [np.zeros(n)]
    for period, gain, control in zip(periods[1:], gains[:-1], controls[:-1], strict=True):
        held = np.clip(control - gain @ result[-1], *limits)
        result.append(period.state[:n] @ result[-1] + period.held[:n] @ held + period.offset[:n, 0])
    return np.array(result)
