"""Random linear systems with measurements at instants, stated as problems and integrated by scipy."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import covocp as co

DURATION = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """dx = (F x + G u) dt + noise of density Q (1 + u^2); (1 + direct u) H x at instants, variance R (1 + t)."""

    F: np.ndarray
    G: np.ndarray
    Q: np.ndarray
    E0: np.ndarray
    readings: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]  # H, R, instants
    density: float
    weights: np.ndarray

    @property
    def size(self):
        return self.F.shape[0]

    def problem(self, *, cost="terminal", direct=0.0):
        """The problem: estimation error at the end and energy, or an expected cost.

        direct: share of what is read that the control adds; an optimal control would have a spike at each instant.
        """
        ocp = co.Problem(DURATION, "sampled")
        n = self.size
        x = ocp.state("x", n, initial=np.zeros(n), variance=self.E0)
        u = ocp.control("u", guess=0.3)
        uncertain = 1.0 if cost == "expected" else 1 + u**2
        ocp.dynamics(x, ca.DM(self.F) @ x + ca.DM(self.G) @ u, noise=ca.DM(self.Q) * uncertain)
        if self.density:
            ocp.measurement("all the time", x[0], self.density)
        for k, (H, R, at) in enumerate(self.readings):
            ocp.measurement(f"m{k}", (1 + direct * u) * (ca.DM(H) @ x), ca.DM(R) * (1 + ocp.time), at=at)
        if cost == "expected":
            ocp.minimize_expected((x[0] - 1) ** 2 + 0.2 * u**2, ca.sumsqr(x))
        else:
            E = ocp.estimation_covariance()
            ocp.minimize(0.1 * (u - 1) ** 2, ca.trace(ca.DM(self.weights) @ E.matrix))
        return ocp

    def update(self, E, t, u, direct):
        """E after all that is read at a time."""
        for H, R, at in self.readings:
            if np.abs(at - t).min() < 1e-12:
                H, R = (1 + direct * u) * H, R * (1 + t)
                K = E @ H.T @ np.linalg.inv(H @ E @ H.T + R)
                E = E - K @ H @ E
        return E

    def covariances(self, u, times, direct=0.0):
        """E before and after each of some times, by scipy; u: a function of the time."""
        n = self.size
        first = np.zeros((1, n))
        first[0, 0] = 1.0
        instants = np.unique(np.concatenate([at for _, _, at in self.readings]))
        stops = np.unique(np.concatenate([[0.0], instants, times]))
        stops = stops[np.append(True, np.diff(stops) > 1e-9)]

        def rate(t, y):
            E = y.reshape(n, n)
            moved = self.F @ E
            seen = E @ first.T @ first @ E / self.density if self.density else 0.0
            return (moved + moved.T + self.Q * (1 + u(t) ** 2) - seen).ravel()

        before, after = {0.0: self.E0}, {0.0: self.update(self.E0, 0.0, u(0.0), direct)}
        y = after[0.0].ravel()
        for begin, end in pairwise(stops):
            y = solve_ivp(rate, (begin, end), y, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
            before[end] = y.reshape(n, n)
            after[end] = self.update(before[end], end, u(end), direct)
            y = after[end].ravel()
        return before, after


def random_system(seed):
    """1 to 3 states, stable or not; 1 or 2 instruments, one of them correlated; sometimes a continuous one too."""
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 4))

    def definite(size, scale):
        root = random.normal(size=(size, size))
        return scale * (root @ root.T + 0.1 * np.eye(size))

    readings = []
    for _ in range(int(random.integers(1, 3))):
        m = int(random.integers(1, min(n, 2) + 1))
        at = np.sort(random.choice(np.arange(1, 17), int(random.integers(1, 5)), replace=False)) / 16 * DURATION
        if random.uniform() < 0.3:
            at = np.append(0.0, at)
        R = definite(m, 10.0 ** random.uniform(-3, 0.5))
        readings.append((random.normal(size=(m, n)), R, at))
    return Sampled(
        F=random.normal(size=(n, n)) - 0.5 * np.eye(n),
        G=random.normal(size=(n, 1)),
        Q=definite(n, 0.2),
        E0=definite(n, 10.0 ** random.uniform(-1, 2)),
        readings=tuple(readings),
        density=float(random.choice([0.0, 0.5])),
        weights=definite(n, 1.0),
    )
