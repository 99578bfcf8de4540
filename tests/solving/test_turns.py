"""Controls that are angles: no turn between two nodes, whatever the start (Zermelo's problem)."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import covocp as co
from covocp.solving.turns import _without_turns

FROM = (3.66, -1.86)


def crossing(turn=2 * np.pi, **bounds):
    """A boat of speed 1 in a current of y/2 along x, to the origin; the heading in parts of a turn."""
    ocp = co.Problem(co.Free(5.0, 1.0, 20.0), name="crossing")
    x, y = (ocp.state(name, initial=value, final=0.0) for name, value in zip("xy", FROM, strict=True))
    heading = ocp.control("heading", **bounds)
    angle = heading * (2 * np.pi / turn)
    ocp.dynamics(x, ca.cos(angle) + 0.5 * y)
    ocp.dynamics(y, ca.sin(angle))
    ocp.minimize(terminal=ocp.duration)
    return ocp


@pytest.fixture(scope="module")
def least_time():
    """By the minimum principle: the costates of x are constant, those of y fall by half of it."""

    def misses(unknown):
        first, duration = unknown

        def rate(t, z):
            heading = np.arctan2(np.sin(first) + 0.5 * -np.cos(first) * t, np.cos(first))
            return [np.cos(heading) + 0.5 * z[1], np.sin(heading)]

        return solve_ivp(rate, (0.0, duration), FROM, rtol=1e-11, atol=1e-12).y[:, -1]

    (_, duration), _, found, _ = fsolve(misses, [2.9, 2.9], full_output=True, xtol=1e-12)
    assert found == 1
    return float(duration)


@pytest.mark.parametrize(
    ("turn", "options"),
    [
        (2 * np.pi, {"intervals": 50}),
        (2 * np.pi, {"intervals": 100}),
        (2 * np.pi, {"intervals": 200}),
        (360.0, {}),
        (2 * np.pi, {"method": "reduced"}),
        (2 * np.pi, {"refine": 1e-6}),
    ],
)
def test_the_least_time_is_found(turn, options, least_time):
    solution = co.solve(crossing(turn), progress=False, **options)
    assert solution.cost == pytest.approx(least_time, rel=1e-6)
    assert np.abs(np.diff(solution["heading"])).max() < turn / 8


def test_the_least_time_of_two_phases_is_that_of_the_whole(least_time):
    parts = []
    for name, duration in (("begin", 1.0), ("end", co.Free(4.0, 0.5, 20.0))):
        ocp = co.Problem(duration, name=name)
        last = {"final": 0.0} if parts else {}
        x, y = (ocp.state(n, initial=None if parts else v, **last) for n, v in zip("xy", FROM, strict=True))
        heading = ocp.control("heading")
        ocp.dynamics(x, ca.cos(heading) + 0.5 * y)
        ocp.dynamics(y, ca.sin(heading))
        ocp.minimize(terminal=ocp.duration if parts else 0.0)
        parts.append(ocp)
    solution = co.solve(co.Phases(parts), intervals=40, progress=False)
    assert solution.cost + 1.0 == pytest.approx(least_time, rel=1e-6)


def test_bounds_of_the_angle_are_kept(least_time):
    solution = co.solve(crossing(lower=-10.0, upper=10.0), progress=False)
    assert solution.cost == pytest.approx(least_time, rel=1e-6)
    assert np.abs(solution["heading"]).max() <= 10.0


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.0, 0.1, 0.2 + 2 * np.pi, 0.3 + 2 * np.pi], [0.0, 0.1, 0.2, 0.3]),
        ([0.0, -3.0, -6.2, -6.1], [0.0, 0.5 * (2 * np.pi - 6.2), 2 * np.pi - 6.2, 2 * np.pi - 6.1]),
        ([0.0, 6.3, 6.4, 0.2], [0.0, 6.3 - 2 * np.pi, 6.4 - 2 * np.pi, 0.2]),
    ],
)
def test_turns_are_taken_out(values, expected):
    np.testing.assert_allclose(_without_turns(np.array(values), 2 * np.pi), expected, atol=1e-12)


@pytest.mark.parametrize("values", [[0.0, 1.0, 2.0], [0.0, 3.0, 0.0], [1.0, -1.0, 1.0, -1.0]])
def test_where_there_is_none_nothing_is_taken_out(values):
    assert _without_turns(np.array(values), 2 * np.pi) is None
