"""Ascent of a two-stage launch vehicle with nine boosters: largest mass in a transfer orbit, in four phases.

J. T. Betts, Practical Methods for Optimal Control and Estimation Using Nonlinear Programming, 2nd edition, SIAM, 2010,
example 6.15 (Delta III); D. A. Benson, A Gauss Pseudospectral Transcription for Optimal Control, doctoral thesis,
Massachusetts Institute of Technology, 2005. Six boosters and the first stage burn for 75.2 s, three boosters and the
first stage for as long, the first stage alone until 261 s, then the second stage; what is empty drops off.

    dr/dt = v,   dv/dt = -mu r/|r|^3 + (T u - q)/m,   dm/dt = -sum of the flows,   |u| = 1
    q = 1/2 C S rho0 exp(-(|r| - R)/H) |w| w,   w = v - omega x r

From Cape Canaveral at rest on the ground to the orbit with semi-major axis 24361.14 km, eccentricity 0.7308,
inclination 28.5 deg, ascending node 269.8 deg and argument of perigee 130.5 deg; where on it is free. Published
(Betts): final mass 7529.712412 kg, reached after 924.139 s. There is no covariance. Units: km, km/s, t, kN.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

import covocp as co
from covocp.base.matrices import Array

MU = 398601.2  # of the earth [km^3/s^2]
RADIUS = 6378.145  # [km]
SPIN = 7.29211585e-5  # [rad/s]
LATITUDE = 28.5  # of the launch [deg]
DENSITY, SCALE_HEIGHT = 1.225, 7.2  # of the air on the ground [kg/m^3], of its decay [km]
DRAG_AREA = 0.5 * 4.0 * np.pi  # C S [m^2]
SMOOTH = 1e-6  # [km/s]: the air-speed is zero at the start, where its size has no slope
PAYLOAD = 4.164  # [t]
# Semi-major axis [km], eccentricity, inclination, ascending node, argument of perigee [deg].
ORBIT = (24361.14, 0.7308, 28.5, 269.8, 130.5)


# Directions where each phase begins and ends: up, then more and more to the east.
UP, OVER, EAST, DOWN = [0.8, 0.4, 0.45], [0.4, 0.9, 0.2], [0.2, 0.97, 0.1], [-0.6, 0.7, -0.35]
# Where the first stage is burnt out, about [km], and how fast [km/s]; points of the way from there to the perigee.
BURN_OUT, SLOWEST, POINTS = (5700.0, 600.0, 3090.0), 5.0, 21
GUESSES = {
    "six boosters": [UP, OVER],
    "three boosters": [OVER, OVER],
    "first stage": [OVER, EAST],
    "second stage": [EAST, DOWN],
}


class Engine(NamedTuple):
    """Mass with propellant and mass of the propellant [t], thrust [kN], burning time [s]."""

    mass: float
    propellant: float
    thrust: float
    time: float

    @property
    def dry(self) -> float:
        """Mass without propellant [t]."""
        return self.mass - self.propellant

    @property
    def flow(self) -> float:
        """Propellant a second [t/s]."""
        return self.propellant / self.time


BOOSTER = Engine(19.29, 17.01, 628.5, 75.2)
FIRST = Engine(104.38, 95.55, 1083.1, 261.0)
SECOND = Engine(19.3, 16.82, 110.094, 700.0)


def phases() -> co.Phases:
    """The ascent in four phases: six boosters, three boosters, first stage, second stage.

    Returns:
        The phases, with states "r" and "v" (inertial position and velocity, three components) and "m" (mass), and the
        control "u", the direction of the thrust.
    """
    vehicle = 9.0 * BOOSTER.mass + FIRST.mass + SECOND.mass + PAYLOAD
    third = FIRST.time - 2.0 * BOOSTER.time
    last = co.Free(guess=650.0, lower=1.0, upper=SECOND.time)
    parts: list[tuple[str, float | co.Free, list[Engine], float]] = [
        ("six boosters", BOOSTER.time, [BOOSTER] * 6 + [FIRST], 6.0 * BOOSTER.dry),
        ("three boosters", BOOSTER.time, [BOOSTER] * 3 + [FIRST], 3.0 * BOOSTER.dry),
        ("first stage", third, [FIRST], FIRST.dry),
        ("second stage", last, [SECOND], 0.0),
    ]
    problems: list[co.Problem] = []
    masses: list[ca.MX] = []
    for name, duration, engines, _ in parts:
        problem, m = _stage(name, duration, engines, vehicle if not problems else None)
        problems.append(problem)
        masses.append(m)
    r, v = (state.symbol for state in problems[-1].states[:2])
    _into_orbit(problems[-1], r, v)
    problems[-1].minimize(terminal=-masses[-1])
    result = co.Phases(problems, name="Launch vehicle")
    for before, after, (_, _, _, dropped) in zip(masses[:-1], masses[1:], parts, strict=False):
        result.jump(after, before - dropped)
    return result


def _stage(name: str, duration: float | co.Free, engines: list[Engine], mass: float | None) -> tuple[co.Problem, ca.MX]:
    """One phase, with the initial mass [t] of the first one, and its mass."""
    ocp = co.Problem(duration, name=name)
    latitude = np.deg2rad(LATITUDE)
    start = RADIUS * np.array([np.cos(latitude), 0.0, np.sin(latitude)])
    first = mass is not None
    guesses = _way_to_perigee() if name == "second stage" else (None, None)
    r = ocp.state("r", 3, initial=start if first else None, scale=RADIUS, guess=guesses[0], unit="km")
    at_rest = [0.0, SPIN * start[0], 0.0] if first else None
    v = ocp.state("v", 3, initial=at_rest, scale=5.0, guess=guesses[1], unit="km/s")
    m = ocp.state("m", initial=mass, lower=PAYLOAD, scale=100.0, unit="t")
    u = ocp.control("u", 3, lower=-1.1, upper=1.1, guess=np.array(GUESSES[name]))
    wind = v - ca.cross(ca.DM([0.0, 0.0, SPIN]), r)
    density = DENSITY * ca.exp(-(ca.norm_2(r) - RADIUS) / SCALE_HEIGHT)
    drag = 0.5 * DRAG_AREA * density * 1e3 * ca.sqrt(ca.sumsqr(wind) + SMOOTH**2) * wind  # [kN], the air-speed in km/s
    thrust = sum(engine.thrust for engine in engines)
    ocp.dynamics(r, v)
    ocp.dynamics(v, -MU * r / ca.norm_2(r) ** 3 + 1e-3 * (thrust * u / ca.norm_2(u) - drag) / m)
    ocp.dynamics(m, -sum(engine.flow for engine in engines))
    ocp.subject_to(ca.sumsqr(u), lower=1.0, upper=1.0, name="direction")
    return ocp, m


def _way_to_perigee() -> tuple[Array, Array]:
    """How the second stage may fly: positions [km] and velocities [km/s], a row each, evenly in time.

    Along an arc, at a speed that rises evenly: a straight line between both ends lies 150 km below the ground, where
    the air is e^20 times as dense.
    """
    momentum, eccentricity = target()
    begin, ahead = np.array(BURN_OUT), eccentricity / ORBIT[1]
    last = ORBIT[0] * (1.0 - ORBIT[1])  # distance of the perigee
    fastest = float(np.linalg.norm(momentum)) / last
    first = float(np.linalg.norm(begin))
    east = np.cross(np.cross(begin, ahead), begin)
    up, east = begin / first, east / np.linalg.norm(east)
    s = np.linspace(0.0, 1.0, POINTS)[:, None]
    done = (SLOWEST * s + 0.5 * (fastest - SLOWEST) * s**2) / (0.5 * (SLOWEST + fastest))
    angle = done * np.arccos(float(up @ ahead))
    positions = (first + done * (last - first)) * (np.cos(angle) * up + np.sin(angle) * east)
    return positions, (SLOWEST + (fastest - SLOWEST) * s) * (np.cos(angle) * east - np.sin(angle) * up)


def target() -> tuple[Array, Array]:
    """The orbit: its angular momentum [km^2/s] and its eccentricity vector, towards the perigee."""
    axis, eccentricity = ORBIT[:2]
    inclination, node, perigee = np.deg2rad(ORBIT[2:])
    along = np.array([np.cos(node), np.sin(node), 0.0])
    across = np.array([-np.cos(inclination) * np.sin(node), np.cos(inclination) * np.cos(node), np.sin(inclination)])
    momentum = np.sqrt(MU * axis * (1.0 - eccentricity**2)) * np.cross(along, across)
    return momentum, eccentricity * (np.cos(perigee) * along + np.sin(perigee) * across)


def _into_orbit(ocp: co.Problem, r: ca.MX, v: ca.MX) -> None:
    """At the end the vehicle is in the orbit: five conditions, since the eccentricity vector lies in its plane."""
    momentum, eccentricity = target()
    size, ahead = float(np.linalg.norm(momentum)), eccentricity / np.linalg.norm(eccentricity)
    aside = np.cross(momentum / size, ahead)
    own = ca.cross(r, v)
    towards = ca.cross(v, own) / MU - r / ca.norm_2(r)
    ocp.subject_to((own - ca.DM(momentum)) / size, lower=0.0, upper=0.0, at="final", name="angular momentum")
    missed = ca.vertcat(ca.dot(ca.DM(ahead), towards) - ORBIT[1], ca.dot(ca.DM(aside), towards))
    ocp.subject_to(missed, lower=0.0, upper=0.0, at="final", name="perigee")
