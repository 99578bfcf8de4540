"""A double integrator of limited speed whose place is measured the less, the further it is; its cost by scipy."""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import covocp as co

NOISE = 0.01


def limited_speed(noise: float | ca.MX = NOISE, *, running: bool = True, ocp: co.Problem | None = None) -> co.Problem:
    """The problem, E[x, x] in its running cost or at its end; `noise` may be a parameter of a problem that is given."""
    ocp = co.Problem(4.0, "limited speed") if ocp is None else ocp
    x = ocp.state("x", initial=0.0, final=3.0, variance=0.01)
    v = ocp.state("v", initial=0.0, final=0.0, upper=1.0, variance=0.01)
    u = ocp.control("u", lower=-2.0, upper=2.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=0.01)
    ocp.measurement("m", x, noise=noise * (1 + x**2))
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + (E[x, x] if running else 0.0), terminal=0.0 if running else E[x, x])
    return ocp


def cost_along(t: np.ndarray, u: np.ndarray, prior: np.ndarray, noise: float = NOISE) -> float:
    """The running cost along controls (N + 1,) at times t, from a prior (2, 2), by scipy's LSODA."""

    def slope(s: float, y: np.ndarray) -> np.ndarray:
        E, F = y[2:6].reshape(2, 2), np.array([[0.0, 1.0], [0.0, 0.0]])
        rate = F @ E + E @ F.T + np.diag([0.0, 0.01]) - np.outer(E[:, 0], E[0]) / (noise * (1 + y[0] ** 2))
        now = np.interp(s, t, u)
        return np.r_[y[1], now, rate.ravel(), 0.5 * now**2 + E[0, 0]]

    y = np.r_[0.0, 0.0, prior.ravel(), 0.0]
    for begin, end in pairwise(t):  # the control has corners there
        y = solve_ivp(slope, (begin, end), y, method="LSODA", rtol=1e-9, atol=1e-12).y[:, -1]
    return float(y[-1])
