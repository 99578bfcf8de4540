"""A vehicle of constant speed that turns to a point, with or without a beacon whose distance it measures."""

from __future__ import annotations

import casadi as ca
import numpy as np

import covocp as co

DURATION, SPEED = 120.0, 1.5
BEACON = (60.0, 40.0)


def vehicle(distance, angle, bound, *, beacon=False, guess=0.0):
    """Least turning to a point; with the beacon also for a small variance of the position at the end."""
    ocp = co.Problem(DURATION, "vehicle")
    final = [distance * np.cos(angle), distance * np.sin(angle)]
    p = ocp.state("p", 2, initial=0.0, final=final, variance=25.0 if beacon else None)
    psi = ocp.state("psi", initial=0.0, variance=0.01 if beacon else None)
    r = ocp.control("r", lower=-bound, upper=bound, guess=guess)
    noises = ([0.01, 0.01], 1e-5) if beacon else (None, None)
    ocp.dynamics(p, SPEED * ca.vertcat(ca.cos(psi), ca.sin(psi)), noise=noises[0])
    ocp.dynamics(psi, r, noise=noises[1])
    terminal = 0.0
    if beacon:
        ocp.measurement("range", ca.norm_2(p - ca.DM(BEACON)), noise=4.0)
        E = ocp.estimation_covariance()
        terminal = 0.02 * (E[p[0], p[0]] + E[p[1], p[1]])
    ocp.minimize(running=r**2, terminal=terminal)
    return ocp
