"""Soft targets at a distance: what is found costs no more than controls made by hand, in any unit of the states."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co

UNITS = [1.0, 57.29578, 1e3, 1e-2]
# A vehicle at the origin looks along x; its place is behind it.
PLACE, TURN, FASTEST = (-4.0, 1.0), 1.5, 2.0
# A pendulum that hangs, with a torque far below its weight; the target stands.
TORQUE, TARGET = 4.0, np.pi


def vehicle(unit: float, *, free: bool) -> co.Problem:
    ocp = co.Problem(co.Free(4.0, lower=0.3, upper=30.0) if free else 6.0)
    x, y, h = ocp.state("x", initial=0.0), ocp.state("y", initial=0.0), ocp.state("h", initial=0.0)
    w, s = ocp.control("w", lower=-TURN, upper=TURN), ocp.control("s", lower=0.0, upper=FASTEST * unit)
    ocp.dynamics(x, s * ca.cos(h))
    ocp.dynamics(y, s * ca.sin(h))
    ocp.dynamics(h, w)
    miss = (x / unit - PLACE[0]) ** 2 + (y / unit - PLACE[1]) ** 2
    ocp.minimize(running=0.1 * w**2 + 0.1 * (s / unit) ** 2 + float(free), terminal=20.0 * miss)
    return ocp


def by_hand(*, free: bool) -> float:
    """Cost of a turn on the spot and a straight way, in closed form."""
    turn, way = np.arctan2(PLACE[1], PLACE[0]), np.hypot(*PLACE)
    first, second = (1.5, 2.3) if free else (2.5, 3.5)
    return 0.1 * turn**2 / first + 0.1 * way**2 / second + float(free) * (first + second)


@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("unit", UNITS)
def test_a_vehicle_turns_round_to_its_place(unit, free):
    assert co.solve(vehicle(unit, free=free), progress=False).cost < by_hand(free=free)


def pendulum(unit: float) -> co.Problem:
    ocp = co.Problem(co.Free(4.0, lower=0.3, upper=30.0))
    x, v = ocp.state("x", initial=0.0), ocp.state("v", initial=0.0)
    u = ocp.control("u", lower=-TORQUE * unit, upper=TORQUE * unit)
    ocp.dynamics(x, v)
    ocp.dynamics(v, (-9.81 * ca.sin(x / unit) - 0.1 * v / unit + u / unit) * unit)
    miss = 10.0 * (x / unit - TARGET) ** 2 + 10.0 * (v / unit) ** 2
    ocp.minimize(running=0.5 * (u / unit) ** 2 + 10.0, terminal=miss)
    return ocp


def pumped() -> float:
    """The least cost of a full torque that is turned over with the speed until a time, by scipy."""

    def slope(t: float, z: np.ndarray) -> list[float]:
        u = TORQUE if t < 0.7 or z[1] > 0.0 else -TORQUE
        return [z[1], -9.81 * np.sin(z[0]) - 0.1 * z[1] + u, 0.5 * u**2 + 10.0]

    run = solve_ivp(slope, (0.0, 8.0), [0.0, 0.0, 0.0], max_step=0.01)
    return float((run.y[2] + 10.0 * (run.y[0] - TARGET) ** 2 + 10.0 * run.y[1] ** 2).min())


def test_a_pendulum_is_swung_up_in_any_unit():
    costs = [co.solve(pendulum(unit), progress=False).cost for unit in UNITS]
    assert max(costs) < pumped()
    assert costs == pytest.approx([min(costs)] * len(costs), rel=0.01)
