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


def raised(unit=1.0, **bounds):
    """As far out from a circular orbit as low thrust reaches in 3.32 (Moyer and Pinkham 1964); it turns through pi."""
    ocp = co.Problem(3.32)
    r = ocp.state("r", initial=1.0)
    out, along = ocp.state("u", initial=0.0, final=0.0), ocp.state("v", initial=1.0)
    phi = ocp.control("phi", **{name: value / unit for name, value in bounds.items()})
    thrust = 0.1405 / (1.0 - 0.07489 * ocp.time)
    ocp.dynamics(r, out)
    ocp.dynamics(out, along**2 / r - 1.0 / r**2 + thrust * ca.sin(unit * phi))
    ocp.dynamics(along, -out * along / r + thrust * ca.cos(unit * phi))
    ocp.subject_to(along - 1.0 / ca.sqrt(r), equals=0.0, at="final")
    ocp.minimize(terminal=-r)
    return ocp


def test_bounds_that_are_a_turn_apart_are_told_where_they_hold_an_angle():
    """A part in two thousand is lost to a turn between two nodes; without the bounds it is not."""
    with pytest.warns(co.CovocpWarning, match="Bounds of 'phi' are one turn apart: leave them out"):
        held = co.solve(raised(lower=-np.pi, upper=np.pi), intervals=50, progress=False)
    free = co.solve(raised(), intervals=50, progress=False)
    assert -free.cost == pytest.approx(1.5253, abs=1e-4)
    assert held.cost > free.cost * (1.0 - 5e-4)


@pytest.mark.filterwarnings("ignore:The mesh is too coarse:covocp.CovocpWarning")  # for a turn between two nodes
def test_they_are_told_of_degrees():
    with pytest.warns(co.CovocpWarning, match="Bounds of 'phi' are one turn apart"):
        co.solve(raised(np.pi / 180.0, lower=-np.pi, upper=np.pi), intervals=50, progress=False)


@pytest.mark.parametrize("bounds", [{"lower": -10.0, "upper": 10.0}, {"lower": 0.0, "upper": 6.0}])
def test_bounds_that_hold_nothing_or_exclude_directions_are_not_told(bounds, recwarn):
    co.solve(raised(**bounds), intervals=50, progress=False)
    assert not [warning for warning in recwarn if "turn apart" in str(warning.message)]


def test_bounds_of_what_is_no_angle_are_not_told(recwarn):
    """The force of the fastest motion is at both of its bounds, which happen to be a turn apart."""
    ocp = co.Problem(co.Free(1.0))
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, ocp.control("u", lower=-np.pi, upper=np.pi))
    ocp.minimize(terminal=ocp.duration)
    co.solve(ocp, intervals=20, progress=False)
    assert not [warning for warning in recwarn if "turn apart" in str(warning.message)]
