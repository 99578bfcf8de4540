"""Problems with attitudes, for the tests of every room."""

from __future__ import annotations

import casadi as ca
import numpy as np

import covocp as co
from covocp.blocks import so3

INERTIA = np.diag([10.0, 20.0, 30.0])


def slew(first, last, *, duration=10.0, **limits):
    """A rigid body from rest to rest with the least torque; its attitude, its torque."""
    ocp = co.Problem(duration, "slew")
    omega = ocp.state("omega", 3, initial=0.0, final=0.0)
    torque = ocp.control("torque", 3, **limits)
    attitude = ocp.attitude("attitude", initial=first, final=last, rate=omega)
    ocp.dynamics(omega, (torque - ca.cross(omega, INERTIA @ omega)) / np.diag(INERTIA))
    ocp.minimize(running=ca.sumsqr(torque))
    return ocp, attitude, torque


def tracked(weight=10.0):
    """A slew with gyros of unknown biases and a star, and what is known at the end in the cost."""
    ocp = co.Problem(10.0, "tracked")
    omega = ocp.state("omega", 3, initial=0.0, final=0.0)
    torque = ocp.control("torque", 3, lower=-8.0, upper=8.0)
    bias = ocp.unknown("bias", np.zeros(3), 1e-4)
    known = {"variance": [1e-2, 2e-2, 1e-2], "noise": 1e-5}
    attitude = ocp.attitude("attitude", initial=np.eye(3), final=so3.exp([0.3, 1.5, -0.4]), rate=omega, **known)
    ocp.dynamics(omega, (torque - ca.cross(omega, INERTIA @ omega)) / np.diag(INERTIA), noise=1e-4)
    ocp.measurement("gyro", omega + bias, 1e-5)
    ocp.measurement("star", attitude.matrix[:, 0], 1e-4)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.01 * ca.sumsqr(torque), terminal=weight * ca.trace(E[attitude, attitude]))
    return ocp, attitude


def steered(spread=1e-4):
    """Pointing by angular velocities, with two stars: an expected cost of the attitude at the end."""
    ocp = co.Problem(4.0, "steered")
    omega = ocp.control("omega", 3, lower=-2.0, upper=2.0)
    goal = so3.exp([0.3, 1.2, -0.4])
    known = {"variance": spread * np.array([1.0, 2.0, 1.0]), "noise": 1e-2 * spread}
    attitude = ocp.attitude("attitude", initial=np.eye(3), final=goal, rate=omega, **known)
    ocp.measurement("star", attitude.matrix[:, 0], 0.3 * spread)
    ocp.measurement("sun", attitude.matrix[:, 1], 0.3 * spread)
    ocp.minimize_expected(running=ca.sumsqr(omega), terminal=100.0 * ca.sumsqr(attitude.error(goal)))
    return ocp, attitude
