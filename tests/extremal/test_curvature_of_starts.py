"""The sign of the curvature by decisions and free initial values that are best at about zero, in any unit."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.extremal.curvature import smallest_curvature


def decided(sign, unit, *, guess=0.5, bound=2.0):
    """A decision beside a regulator, with the cost 1 - cos r in some unit, or its opposite; best at 0, or at a saddle.

    guess: None: zero, as is the middle of the bounds.
    """
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    r = ocp.decision("r", guess=0.0 if guess is None else guess * unit, lower=-bound * unit, upper=bound * unit)
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2 + x**2, terminal=sign * (1.0 - ca.cos(r / unit)))
    return ocp


def begun(sign, unit, *, guess=0.5, bound=3.0):
    """A free initial value of a state that decays, beside a regulator."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    y = ocp.state("y", initial=None, guess=guess and guess * unit, lower=-bound * unit, upper=bound * unit)
    ocp.dynamics(x, u)
    ocp.dynamics(y, -y)
    ocp.minimize(running=u**2 + x**2 + sign * (y / unit) ** 2 + 0.1 * (y / unit) ** 4)
    return ocp


def near_zero(made, sign, unit, left, **statement):
    """The extremal with what is best at zero there, up to what a solver leaves of it."""
    convex = co.solve(made(1.0, unit, **statement), progress=False).extremal
    x = convex.trajectory.x.copy()
    x[:, 1] = left * unit * (1.0 if made is decided else np.exp(-convex.time))
    moved = replace(convex.trajectory, x=x)
    return replace(convex, stated=made(sign, unit, **statement).statement(), trajectory=moved)


@pytest.mark.parametrize("left", [0.0, 1e-13, -1e-8])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("made", [decided, begun])
@pytest.mark.parametrize(("sign", "verdict"), [(1.0, "minimum"), (-1.0, "saddle")])
def test_what_a_solver_leaves_of_zero_is_no_unit(made, sign, verdict, unit, left):
    assert smallest_curvature(near_zero(made, sign, unit, left)).verdict == verdict


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e5])
@pytest.mark.parametrize("made", [decided, begun])
@pytest.mark.parametrize(("sign", "verdict"), [(1.0, "minimum"), (-1.0, "saddle")])
def test_bounds_tell_the_unit_where_no_guess_does(made, sign, verdict, unit):
    assert smallest_curvature(near_zero(made, sign, unit, 1e-13, guess=None)).verdict == verdict


@pytest.mark.parametrize("bound", [np.inf, 1e9])
@pytest.mark.parametrize("made", [decided, begun])
@pytest.mark.parametrize(("sign", "verdict"), [(1.0, "minimum"), (-1.0, "saddle")])
def test_bounds_that_are_far_away_hide_no_control(made, sign, verdict, bound):
    """In the unit of the bounds the curvature by the decision is 1e18 times that by the controls."""
    found = smallest_curvature(near_zero(made, sign, 1.0, 1e-13, guess=None, bound=bound))
    assert found.verdict == verdict
    assert abs(found.value) > 1e-6 * found.largest


def test_the_place_of_a_sensor_is_a_saddle_where_the_covariance_says_so():
    """Two sensors in one: the second difference of the trace of the covariance by its place, integrated apart."""

    def placed(guess):
        ocp = co.Problem(2.0)
        x, u = ocp.state("x", 2, initial=[1.0, 1.0], variance=[1.0, 1.0]), ocp.control("u")
        r = ocp.decision("r", guess=guess, lower=-1.0, upper=1.0)
        ocp.dynamics(x, ca.vertcat(u, -u), noise=0.1 * np.eye(2))
        ocp.measurement("y", (1 + r) * x[0] + (1 - r) * x[1], noise=0.1)
        ocp.minimize(running=u**2, terminal=ca.trace(ocp.estimation_covariance().matrix))
        return ocp

    def trace(r):
        H = np.array([[1 + r, 1 - r]])

        def rate(_, e):
            E = e.reshape(2, 2)
            return (0.1 * np.eye(2) - E @ H.T @ H @ E / 0.1).ravel()

        end = solve_ivp(rate, (0.0, 2.0), np.eye(2).ravel(), rtol=1e-11, atol=1e-13).y[:, -1]
        return np.trace(end.reshape(2, 2))

    h = 1e-2
    second = (trace(h) - 2 * trace(0.0) + trace(-h)) / h**2
    extremal = co.solve(placed(0.5), progress=False).extremal
    x = extremal.trajectory.x.copy()
    x[:, 2] = 1e-13
    u = np.zeros_like(extremal.trajectory.u)
    x[:, :2] = 1.0
    there = replace(extremal, trajectory=replace(extremal.trajectory, x=x, u=u))
    there = replace(there, multipliers=replace(there.multipliers, states=0.0 * there.multipliers.states))
    found = smallest_curvature(there)
    assert second < -0.07
    assert found.verdict == "saddle"
    # d' H d = value in the metric, in which this direction is of unit length and moves nothing but the place
    assert found.start[:2] == pytest.approx(0.0, abs=1e-12)
    assert found.value / found.start[2] ** 2 == pytest.approx(second, rel=1e-3)
