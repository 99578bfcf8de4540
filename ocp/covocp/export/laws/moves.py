"""What happens between the samples of a period: transitions, covariances and costs, by the two-stage Gauss method."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.matrices import Array, stacked
from covocp.base.quadrature import GAUSS_NODES, gauss_transition, lyapunov_after
from covocp.base.short_repr import short_repr
from covocp.export.laws.design import Design
from covocp.export.laws.history import History
from covocp.export.laws.paces import divided, paces

# Times that differ by less than this share of a period are the same.
WHOLE = 1e-9
# No period is divided into pieces that are a smaller share of it.
LEAST = 1e-6


class Period(NamedTuple):
    """Of a period: deviation d at its end, and what is told of it: means over the period, then what is read at its end.

    state: slopes by d at its start, (n + r, n); held: by the control that is held, (n + r, m); offset: what they are
    without both, (n + r, 1); noise: their covariance from noise alone, (n + r, n + r).
    """

    state: Array
    held: Array
    offset: Array
    noise: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Moves:
    """Gauss steps between nodes and samples; n deviations, m controls, r values that are measured all the time.

    measured: transitions of (deviation, integral of what is measured, control held, 1), (steps, n + r + m + 1,
        n + r + m + 1).
    measured_noise, weight: step matrices of the Lyapunov equations of the covariance of (deviation, integral), and, run
        backward, of the cost of (deviation, control held).
    sizes: n, m, r. first: the step that begins at each of the times.
    """

    measured: Array
    measured_noise: Array
    weight: Array
    sizes: tuple[int, int, int]
    first: Any

    __repr__ = short_repr

    @staticmethod
    def of(design: Design, tables: History, t: Array) -> Moves:
        """All steps between the first and the last of some times: the samples, and the end."""
        inside = tables.nodes[(tables.nodes > t[0]) & (tables.nodes < t[-1])]
        grid = np.unique(np.concatenate([t, inside]))
        near = np.diff(grid, prepend=-np.inf) <= WHOLE * np.median(np.diff(t))
        grid = divided(paces(design, tables), tables, grid[~near], LEAST * float(np.median(np.diff(t))))
        h = np.diff(grid)
        points = [_Point.at(design, tables, grid[:-1] + c * h, h[:, None, None]) for c in GAUSS_NODES]
        n, m, _ = design.sizes
        r = design.always
        measured = [
            _blocks([[p.F, p.zero(n, r), p.G, -p.G @ p.u], [p.M, p.zero(r, r), p.H, p.h - p.H @ p.u]], n + r + m + 1)
            for p in points
        ]
        joint = [matrix[:, : n + r, : n + r] for matrix in measured]
        spread = [_blocks([[p.Q, p.zero(n, r)], [p.zero(r, n), p.U]], n + r) for p in points]
        held = [_blocks([[p.F, p.G]], n + m).transpose(0, 2, 1) for p in points[::-1]]
        cost = [_blocks([[p.A, p.N], [p.N.transpose(0, 2, 1), p.B]], n + m) for p in points[::-1]]
        return Moves(
            measured=_transitions(measured),
            measured_noise=_lyapunov(joint, spread),
            weight=_lyapunov(held, cost),
            sizes=(n, m, r),
            first=np.searchsorted(grid, t - 0.5 * h.min()),
        )

    def steps(self, k: int) -> range:
        """The steps of period k."""
        return range(int(self.first[k]), int(self.first[k + 1]))

    def measuring(self, k: int) -> Period:
        """Over period k: the deviation at its end, and the integral of what is measured, noise included."""
        n, m, r = self.sizes
        z, P = np.eye(n + r + m + 1), np.zeros((n + r, n + r))
        for i in self.steps(k):
            z, P = self.measured[i] @ z, lyapunov_after(self.measured_noise[i], P)
        z = z[: n + r]
        return Period(state=z[:, :n], held=z[:, n + r : -1], offset=z[:, -1:], noise=P)

    def weighed(self, k: int, S: Array) -> Array:
        """Weight of (d at the start of period k, deviation of the control held) in twice the cost, from S at its end.

        With v' = 0 beside d this is a Lyapunov equation, run backward.
        """
        n, m, _ = self.sizes
        P = np.zeros((n + m, n + m))
        P[:n, :n] = S
        for i in reversed(self.steps(k)):
            P = lyapunov_after(self.weight[i], P)
        return P


@dataclass(frozen=True, kw_only=True, eq=False)
class _Point:
    """The linear model at one Gauss point of all steps, each value times the length of the step but the control u."""

    F: Array
    G: Array
    h: Array
    M: Array
    H: Array
    U: Array
    Q: Array
    A: Array
    N: Array
    B: Array
    u: Array

    __repr__ = short_repr

    @staticmethod
    def at(design: Design, tables: History, t: Array, h: Array) -> _Point:
        """At some times, for steps of some lengths."""
        x, u, _ = tables.rows(t)
        columns = x.T, u.T, t[None, :]
        F, G, seen, M, H, U = (h * stacked(v, t.size) for v in design.linear.map(t.size)(*columns))
        r = design.always
        seen, M, H, U = seen[:, :r], M[:, :r], H[:, :r], U[:, :r, :r]
        Q = h * stacked(design.noise.map(t.size)(*columns), t.size)
        A, N, B = (h * stacked(v, t.size) for v in design.weights.map(t.size)(*columns))
        nominal = u[:, : design.sizes[1], None]
        return _Point(F=F, G=G, h=seen, M=M, H=H, U=U, Q=Q, A=A, N=N, B=B, u=nominal)

    def zero(self, rows: int, columns: int) -> Array:
        """A block of zeros."""
        return np.zeros((self.F.shape[0], rows, columns))


def _blocks(rows: list[list[Array]], size: int) -> Array:
    """Square matrices of a size from the blocks of their first rows."""
    top = np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1)
    result = np.zeros((top.shape[0], size, size))
    result[:, : top.shape[1], :] = top
    return result


def _lyapunov(drifts: list[Array], noises: list[Array]) -> Array:
    """Step matrices of P' = F P + P F' + Q, positive semidefinite at any length."""
    n = drifts[0].shape[1]
    zero = np.zeros_like(drifts[0])
    pairs = zip(drifts, noises, strict=True)
    return _transitions([_blocks([[-F.transpose(0, 2, 1), zero], [Q, F]], 2 * n) for F, Q in pairs])


def _transitions(H: list[Array]) -> Array:
    """Step matrices from h H at the two Gauss points."""
    return np.asarray(gauss_transition(H, np.eye(H[0].shape[1]), np.linalg.solve))
