"""Small changes of the nominal that follow from changes of the controls, to first order.

Where the plant is unstable, the changes of the controls alone say nothing in double precision: they come back amplified
by the whole horizon. There a feedback around the nominal is part of the parametrisation, du = v - K dz, with the gains
of a linear-quadratic regulator for the same plant. The map from v to du is one to one (u_k depends on v_j, j <= k, with
a unit diagonal), so the signs of a quadratic form on the same subspace are the same in v and in u.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr

# Growth of a change over the horizon, in units of the states, from which on the feedback is part of it.
LARGEST_GROWTH = 1e3


@dataclass(frozen=True, kw_only=True)
class Tangents:
    """The linear map from V free values v to changes of nodes and controls; m columns at once.

    Attributes:
        A: slopes of the state after an interval by that before it, (N, n, n).
        before: by the control at its start (or of the interval, where it is constant), (N, n, nu).
        after: by the control at its end, (N, n, nu); None: controls are constant.
        free: control values that move, (N + 1 or N, nu).
        start: entries of the initial state that move.
        gain: K, (N, nu, n + nu) of (z_k, u_k) for the control at node k + 1, or (N, nu, n) of z_k for that of interval
            k; None: v are the changes of the controls themselves.
    """

    A: Array
    before: Array
    after: Array | None
    free: NDArray[np.bool_]
    start: tuple[int, ...]
    gain: Array | None

    __repr__ = short_repr

    @staticmethod
    def of(
        A: Array,
        before: Array,
        after: Array | None,
        free: NDArray[np.bool_],
        start: tuple[int, ...],
        scales: tuple[Array, Array],
    ) -> Tangents:
        """The map, with a feedback where the plant needs one; scales: of states (n,) and controls (nu,)."""
        scaled = A * scales[0] / scales[0][:, None]
        gain = _regulator(A, before, after, free, scales) if _growth(scaled) > LARGEST_GROWTH else None
        return Tangents(A=A, before=before, after=after, free=free, start=start, gain=gain)

    @property
    def size(self) -> int:
        """V: first the control values that move, node by node, then the initial states."""
        return int(self.free.sum()) + len(self.start)

    def forward(self, v: Array) -> tuple[Array, Array]:
        """Changes of nodes (N + 1, n, m) and controls (N + 1 or N, nu, m) of v (V, m)."""
        count, n, columns = self.A.shape[0], self.A.shape[1], v.shape[1]
        u, z = np.zeros((*self.free.shape, columns)), np.zeros((count + 1, n, columns))
        moving = int(self.free.sum())
        u[self.free] = v[:moving]
        z[0, list(self.start)] = v[moving:]
        for k in range(count):
            if self.after is None:
                if self.gain is not None:
                    u[k] -= self.gain[k] @ z[k]
                z[k + 1] = self.A[k] @ z[k] + self.before[k] @ u[k]
            else:
                if self.gain is not None:
                    u[k + 1] -= self.gain[k][:, :n] @ z[k] + self.gain[k][:, n:] @ u[k]
                z[k + 1] = self.A[k] @ z[k] + self.before[k] @ u[k] + self.after[k] @ u[k + 1]
        return z, u

    def backward(self, by_z: Array, by_u: Array) -> Array:
        """Slopes by v (V, m) of a function with these slopes by nodes (N + 1, n, m) and controls."""
        count, n = self.A.shape[0], self.A.shape[1]
        total = by_u.copy()
        slope = by_z[count]
        for k in range(count - 1, -1, -1):
            if self.after is None:
                total[k] += self.before[k].T @ slope
                slope = by_z[k] + self.A[k].T @ slope
                if self.gain is not None:
                    slope -= self.gain[k].T @ total[k]
            else:
                total[k + 1] += self.after[k].T @ slope
                total[k] += self.before[k].T @ slope
                slope = by_z[k] + self.A[k].T @ slope
                if self.gain is not None:
                    fed = self.gain[k].T @ total[k + 1]
                    slope, total[k] = slope - fed[:n], total[k] - fed[n:]
        return np.concatenate([total[self.free], slope[list(self.start)]])


@dataclass(frozen=True, kw_only=True)
class Between:
    """Changes at equally spread points of each interval, from those of its node and of the controls at its ends.

    Each interval starts from its own node, so that nothing is amplified by more than one interval.

    Attributes:
        A: slopes of the state after a part of an interval by that before it, (N, p, n, n).
        before: by the control at the start of the part, (N, p, n, nu).
        after: by the control at its end, (N, p, n, nu); zero where controls are constant.
        constant: whether the control of an interval is one.
    """

    A: Array
    before: Array
    after: Array
    constant: bool

    __repr__ = short_repr

    def forward(self, z: Array, u: Array) -> tuple[Array, Array]:
        """Changes of the points (N p + 1, n, m) and of the controls there from those of nodes and controls."""
        count, parts = self.A.shape[:2]
        first, last = (u, u) if self.constant else (u[:-1], u[1:])
        w = np.stack([first + j / parts * (last - first) for j in range(parts)], axis=1)
        inside = [z[:-1]]
        for j in range(parts - 1):
            following = w[:, j + 1]
            inside.append(self.A[:, j] @ inside[-1] + self.before[:, j] @ w[:, j] + self.after[:, j] @ following)
        points = np.stack(inside, axis=1).reshape(count * parts, *z.shape[1:])
        controls = w.reshape(count * parts, *u.shape[1:])
        return np.concatenate([points, z[-1:]]), controls if self.constant else np.concatenate([controls, u[-1:]])

    def backward(self, by_points: Array, by_controls: Array) -> tuple[Array, Array]:
        """Slopes by nodes and controls of a function with these slopes by the points and the controls there."""
        count, parts = self.A.shape[:2]
        inside = by_points[: count * parts].reshape(count, parts, *by_points.shape[1:])
        w = by_controls[: count * parts].reshape(count, parts, *by_controls.shape[1:]).copy()
        slope = np.zeros_like(inside[:, 0])
        for j in range(parts - 1, 0, -1):
            slope = slope + inside[:, j]
            w[:, j] += self.after[:, j - 1].swapaxes(1, 2) @ slope
            w[:, j - 1] += self.before[:, j - 1].swapaxes(1, 2) @ slope
            slope = self.A[:, j - 1].swapaxes(1, 2) @ slope
        by_z = np.concatenate([inside[:, 0] + slope, by_points[count * parts :]])
        if self.constant:
            return by_z, w.sum(axis=1)
        share = (np.arange(parts) / parts)[None, :, None, None]
        end = np.zeros((1, *w.shape[2:]))
        first, last = ((1.0 - share) * w).sum(axis=1), (share * w).sum(axis=1)
        return by_z, np.concatenate([first, by_controls[count * parts :]]) + np.concatenate([end, last])


def _growth(A: Array) -> float:
    """Largest growth of a change from the start to a node, or from a node to the end."""
    from_start = to_end = np.eye(A.shape[1])
    largest = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for first, last in zip(A, A[::-1], strict=True):
            from_start, to_end = first @ from_start, to_end @ last
            largest = max(largest, float(np.abs(from_start).max()), float(np.abs(to_end).max()))
    return largest if np.isfinite(largest) else np.inf


@np.errstate(over="ignore", invalid="ignore")  # where what grows has no number
def _regulator(
    A: Array, before: Array, after: Array | None, free: NDArray[np.bool_], scales: tuple[Array, Array]
) -> Array:
    """Gains of the linear-quadratic regulator whose weights are one in the scales; controls at a bound stay there."""
    n, nu = A.shape[1], before.shape[2]
    R, weight = np.diag(scales[1] ** -2.0), np.diag(scales[0] ** -2.0)
    own = weight if after is None else np.block([[weight, np.zeros((n, nu))], [np.zeros((nu, n)), R]])
    P, gains = own, []
    for k in range(A.shape[0] - 1, -1, -1):
        if after is None:
            drift, steered = A[k], before[k] * free[k]
        else:
            drift = np.block([[A[k], before[k]], [np.zeros((nu, n + nu))]])
            steered = np.vstack([after[k], np.eye(nu)]) * free[k + 1]
        product = steered.T @ P
        gain = np.linalg.solve(R + product @ steered, product @ drift)
        P = own + drift.T @ P @ (drift - steered @ gain)
        P = 0.5 * (P + P.T)
        gains.append(gain)
    return np.array(gains[::-1])
