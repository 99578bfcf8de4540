"""
Slews of a rigid body past the Sun
==================================

A spacecraft turns from rest to rest; its telescope must stay away from the Sun. Once with the least torque, once in the
least time, and once so that a star tracker, which sees little of the roll about its own axis, and gyros with unknown
biases know attitude and biases best at the end.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

import covocp as co
from covocp.blocks import so3
from covocp.problem.attitude import Attitude

INERTIA = np.diag([12.0, 15.0, 9.0])  # kg m^2
TORQUE = 0.4  # N m, of each axis
TELESCOPE = [0.0, 0.0, 1.0]  # in body axes
SUN = [0.2, 0.9, 0.4]  # direction, in inertial axes
AWAY = np.deg2rad(40.0)
TURN = [-2.2, 0.3, 0.4]  # rad, rotation vector of the attitude to reach


class Body(NamedTuple):
    """A slew without its cost, and its symbols."""

    ocp: co.Problem
    omega: ca.MX
    torque: ca.MX
    attitude: Attitude


def slew(duration: float | co.Free, name: str, *, uncertain: bool = False) -> Body:
    """The rigid body between two attitudes at rest, away from the Sun."""
    ocp = co.Problem(duration, name)
    omega = ocp.state("omega", 3, initial=0.0, final=0.0, unit="rad/s")
    torque = ocp.control("torque", 3, lower=-TORQUE, upper=TORQUE, unit="N m")
    known = {"variance": np.deg2rad(2.0) ** 2, "noise": 1e-9} if uncertain else {}
    attitude = ocp.attitude("attitude", initial=np.eye(3), final=so3.exp(TURN), rate=omega, **known)
    moment = torque - ca.cross(omega, INERTIA @ omega)
    ocp.dynamics(omega, moment / np.diag(INERTIA), noise=1e-10 if uncertain else None)
    ocp.subject_to(attitude.cosine(TELESCOPE, SUN), upper=np.cos(AWAY), name="Sun")
    return Body(ocp, omega, torque, attitude)


def angle_to_the_sun(solution: co.Solution) -> np.ndarray:
    """Angle between telescope and Sun at fine times [deg]."""
    times = np.linspace(0.0, solution.duration, 2001)
    axes = so3.from_quaternion(solution.at(times)["attitude"]) @ (np.array(SUN) / np.linalg.norm(SUN))
    return np.rad2deg(np.arccos(axes @ TELESCOPE))


def main() -> None:
    """Solve the slews."""
    ocp, _, torque, attitude = slew(40.0, "least torque")
    ocp.minimize(running=ca.sumsqr(torque))
    gentle = co.solve(ocp, points=2)
    to_the_sun = 180.0 / np.pi * ca.acos(attitude.cosine(TELESCOPE, SUN))
    gentle.plot("attitude", {"telescope to Sun [°]": to_the_sun}, "torque").savefig("attitude_slew.png", dpi=120)
    print(gentle)
    print(f"closest to the Sun: {angle_to_the_sun(gentle).min():.2f} deg\n")

    ocp, *_ = slew(co.Free(30.0, 10.0, 60.0), "least time")
    ocp.minimize(terminal=ocp.duration)
    fast = co.solve(ocp, control="constant", points=2)
    print(f"least time: {fast.duration:.3f} s, closest to the Sun {angle_to_the_sun(fast).min():.2f} deg\n")

    for name, weight in (("least torque", 0.0), ("most information", 1.0)):
        ocp, omega, torque, attitude = slew(40.0, name, uncertain=True)
        bias = ocp.unknown("bias", np.zeros(3), (1e-4) ** 2, unit="rad/s")
        ocp.measurement("gyro", omega + bias, 1e-8)
        # a star tracker along the first axis of the body: where it points is seen well, how it is rolled is not
        ocp.measurement("boresight", attitude.matrix[0, :].T, 1e-8)
        ocp.measurement("roll", attitude.matrix[1, :].T, 1e-4)
        E = ocp.estimation_covariance()
        knowledge = 1e6 * ca.trace(E[attitude, attitude]) + 1e10 * ca.trace(E[bias, bias])
        ocp.minimize(running=ca.sumsqr(torque), terminal=weight * knowledge)
        solution = co.solve(ocp, points=2)
        roll = np.rad2deg(solution.deviation("attitude")[-1, 0]) * 60.0
        drift = np.rad2deg(solution.deviation("bias")[-1]) * 3600.0
        print(f"{name:17s} roll known to {roll:.2f} arc minutes, bias to {drift.round(2)} arc seconds a second")
    solution.plot("attitude", "torque", ("rms", "bias")).savefig("attitude_knowledge.png", dpi=120)


if __name__ == "__main__":
    main()
