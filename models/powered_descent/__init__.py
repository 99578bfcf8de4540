"""Powered descent on the moon: inertial only until the landing radar is switched on below an altitude, in two phases.

The gates are those of Apollo 11 as planned before the flight: F. V. Bennett, Apollo experience report: mission planning
for lunar module descent and ascent, NASA TN D-6846, 1972 (high gate at 7515 ft and 506 ft/s, sinking at 145 ft/s). The
radar, the noises and the altitude at which it is switched on are of their order, not published; the moon is flat.

    ds/dt = v,   dh/dt = w,   dv/dt = (1 + k) a,   dw/dt = (1 + k) b - g,   g = 1.622 m/s^2

with range s, altitude h, their speeds v and w, the acceleration (a, b) that the engine is asked for, and k, the error
of its scale, unknown. Above 1000 m nothing is measured: E grows by the noise of the thrust and by what k does. Below,
the radar has the altitude, its noise larger the higher it looks, and both speeds:

    J = int (a^2 + b^2)/2 dt + weight (E_hh + E_ww s^2)(T)

so that the way down is also chosen for what is known of altitude and sinking speed where the last meters begin: 30 m
up, at rest but for 1 m/s. Both durations are free. With the weight 1000 the deviation of h at the end is 0.489 m, with
none 0.516 m; E is that of the linear model: without feedback the altitude scatters by hundreds of meters, the radar's
noise with it, and simulated runs know h less well at the end.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

import covocp as co

GRAVITY = 1.622  # of the moon [m/s^2]
HIGH_GATE = {"s": -7600.0, "h": 2290.0, "v": 148.0, "w": -44.2}  # [m], [m/s]
VARIANCES = {"s": 300.0**2, "h": 150.0**2, "v": 1.0, "w": 1.0}  # [m^2], [m^2/s^2]
LOW_GATE = {"s": 0.0, "h": 30.0, "v": 0.0, "w": -1.0}
SWITCHED_ON = 1000.0  # altitude below which there is a radar [m]
SCALE_VARIANCE = 0.02**2  # of k
THRUST_NOISE = 0.01  # density of the accelerations [m^2/s^3]
LARGEST = 4.5  # acceleration [m/s^2]
ALTIMETER, SHARE = 1.0, 0.02  # density of the altitude's noise on the ground [m^2 s]; share of the altitude [sqrt(s)]
VELOCIMETER = 0.05  # density of the noise of both speeds [m^2/s]


def phases(weight: float = 1000.0, altitude: float = SWITCHED_ON) -> co.Phases:
    """Descent from high gate in two phases, "inertial" and "radar"; s, m.

    Args:
        weight: of the variances at the end [m^2/s^3 for 1 m^2, and for 1 m^2/s^2].
        altitude: at which the radar is switched on [m].

    Returns:
        The phases, with states "s", "h" (range, altitude), "v", "w" (their rates), unknown "k" and controls "a", "b".
    """
    inertial = co.Problem(duration=co.Free(guess=35.0, lower=5.0, upper=150.0), name="inertial")
    x = _states(inertial, {"initial": HIGH_GATE}, {"h": altitude})
    _fly(inertial, x)
    radar = co.Problem(duration=co.Free(guess=60.0, lower=5.0, upper=200.0), name="radar")
    y = _states(radar, {}, LOW_GATE)
    radar.measurement("altitude", y["h"], noise=ALTIMETER + (SHARE * y["h"]) ** 2)
    radar.measurement("speeds", ca.vertcat(y["v"], y["w"]), noise=VELOCIMETER)
    E = _fly(radar, y)
    radar.minimize(running=_effort(y), terminal=weight * (E[y["h"], y["h"]] + E[y["w"], y["w"]]))
    inertial.minimize(running=_effort(x))
    return co.Phases([inertial, radar], name="powered descent")


def _states(ocp: co.Problem, start: dict[str, Any], final: dict[str, float]) -> dict[str, Any]:
    """States, the unknown and the controls of a phase by name."""
    initial = start.get("initial", {})
    units = {"s": "m", "h": "m", "v": "m/s", "w": "m/s"}
    symbols: dict[str, Any] = {}
    for name, unit in units.items():
        options = {"initial": initial[name], "variance": VARIANCES[name]} if initial else {"initial": None}
        symbols[name] = ocp.state(name, **options, final=final.get(name), unit=unit)
    symbols["k"] = ocp.unknown("k", mean=0.0, variance=SCALE_VARIANCE)
    symbols["a"] = ocp.control("a", guess=-1.5, unit="m/s^2")
    symbols["b"] = ocp.control("b", guess=2.0, unit="m/s^2")
    return symbols


def _fly(ocp: co.Problem, x: dict[str, Any]) -> Any:
    """Equations of motion and limit of a phase; its estimation covariance."""
    ocp.dynamics(x["s"], x["v"])
    ocp.dynamics(x["h"], x["w"])
    ocp.dynamics(x["v"], (1 + x["k"]) * x["a"], noise=THRUST_NOISE)
    ocp.dynamics(x["w"], (1 + x["k"]) * x["b"] - GRAVITY, noise=THRUST_NOISE)
    ocp.subject_to(x["a"] ** 2 + x["b"] ** 2, upper=LARGEST**2, name="thrust")
    return ocp.estimation_covariance()


def _effort(x: dict[str, Any]) -> Any:
    """Half the square of the acceleration."""
    return (x["a"] ** 2 + x["b"] ** 2) / 2
