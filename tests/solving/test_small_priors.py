"""A small initial variance says that a state is known well, not that it stays: the optimum is nearly that of none.

Less prior knowledge cannot help, and a larger variance of the start costs more along the same controls: so the optimum
lies between that of a start known exactly and that of one known less.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.statement.exact_rows import carried
from covocp.transcription.resolution import resolutions
from covocp.transcription.scales import magnitudes
from covocp.transcription.trajectory import Trajectory

LESS = 1e-2  # variance of a start that is known less


def bearings(variance: float, *, bound: float = np.inf, unit: float = 1.0) -> co.Problem:
    """A target of unknown velocity, tracked by its bearing from a place that the controls move by metres.

    `unit`: how many units of length there are in a metre.
    """
    ocp = co.Problem(6.0, name="bearings only")
    s = ocp.state("s", 2, initial=[0.0, 0.0])
    t = ocp.state("t", 2, initial=[3.0 * unit, 4.0 * unit])
    v = ocp.unknown("v", mean=[0.5 * unit, -0.2 * unit], variance=0.1 * unit**2)
    u = ocp.control("u", 2, lower=-bound * unit, upper=bound * unit)
    ocp.dynamics(s, u)
    ocp.dynamics(t, v, noise=0.01 * unit**2)
    ocp.measurement("bearing", ca.atan2(t[1] - s[1], t[0] - s[0]), noise=0.01)
    E = ocp.estimation_covariance(initial=np.diag([variance, variance, 1.0, 1.0, 0.1, 0.1]) * unit**2)
    ocp.minimize(running=0.1 * ca.sumsqr(u / unit), terminal=(E[t[0], t[0]] + E[t[1], t[1]]) / unit**2)
    return ocp


def lag(variance: float, *, bound: float = np.inf, unit: float = 1.0) -> co.Problem:
    """A lag of unknown time constant that must be excited."""
    ocp = co.Problem(10.0, name="lag")
    x = ocp.state("x", initial=0.0, variance=variance * unit**2)
    b = ocp.unknown("b", mean=1.0, variance=1.0)
    u = ocp.control("u", lower=-bound * unit, upper=bound * unit)
    ocp.dynamics(x, -b * x + u, noise=0.01 * unit**2)
    ocp.measurement("y", x, noise=0.01 * unit**2)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.01 * (u / unit) ** 2, terminal=E[b, b])
    return ocp


def solved(ocp: co.Problem, method: str = "ipopt") -> co.Solution:
    return co.solve(ocp, method, intervals=40, progress=False, max_iterations=100)


@cache
def cost_of(make: Callable[..., co.Problem], variance: float, bound: float) -> float:
    return solved(make(variance, bound=bound), "reduced").cost


@pytest.mark.parametrize("make", [bearings, lag])
@pytest.mark.parametrize("bound", [1.0, 1e3, np.inf])
@pytest.mark.parametrize("variance", [1e-30, 1e-16, 1e-10, 1e-8, 1e-6])
def test_a_start_that_is_known_well(make, bound, variance):
    """It had failed after 1000 iterations, or ended at rest in none: 4.3 instead of 0.71, 1 instead of 0.03."""
    least, most = (cost_of(make, v, bound) for v in (0.0, LESS))
    assert least * (1 - 1e-6) <= solved(make(variance, bound=bound)).cost <= most * (1 + 1e-6)


@pytest.mark.parametrize("make", [bearings, lag])
@pytest.mark.parametrize("bound", [1.0, np.inf])
@pytest.mark.parametrize("unit", [1e6, 1e-9])
def test_units_of_a_start_that_is_known_well(make, bound, unit):
    in_metres = solved(make(1e-10, bound=bound))
    found = solved(make(1e-10, bound=bound, unit=unit))
    assert found.cost == pytest.approx(in_metres.cost, rel=1e-6)


def test_rows_that_are_known_exactly_leave_their_deviations_to_nobody():
    """The own place had the deviation of the target, whose row was the first that was carried."""
    reduced = carried(bearings(0.0, unit=1e3).statement())
    assert reduced is not None
    statement = reduced.statement
    still = Trajectory(x=np.zeros((5, 4)), u=np.zeros((5, 2)), e=np.zeros((5, statement.ne)), duration=6.0)
    found = magnitudes(statement, still, statement.values, reached=True).x
    assert found == pytest.approx([1.0, 1.0, 3e3, 4e3])  # nothing tells more of the own place than the unit


def test_what_the_measurements_resolve_is_the_bound_of_cramer_and_rao():
    """Of an oscillation by closed forms: position, speed and a heading that nothing sees."""
    T, noise, variance = 3.0, 0.02, 0.5
    ocp = co.Problem(T)
    x, v = ocp.state("x", initial=0.0, variance=1e-9), ocp.state("v", initial=0.0, variance=1e-9)
    hidden = ocp.state("hidden", initial=0.0, variance=1e-9)
    u = ocp.control("u")
    for state, rate in ((x, v), (v, u), (hidden, u)):
        ocp.dynamics(state, rate)
    ocp.measurement("all the time", x, noise=noise)
    ocp.measurement("now and then", x, noise=variance, at=[1.5, 3.0])
    ocp.estimation_covariance()
    ocp.minimize(running=u**2)
    statement = ocp.statement()
    still = Trajectory(x=np.zeros((9, 3)), u=np.zeros((9, 1)), e=np.zeros((9, statement.ne)), duration=T)
    position = T / noise + 2 / variance
    speed = T**3 / 3 / noise + (1.5**2 + 3.0**2) / variance
    found = resolutions(statement, still, statement.values)
    # places of the information are summed without weights at the ends: 1/16 of it
    assert found[:2] == pytest.approx([position**-0.5, speed**-0.5], rel=0.06)
    assert np.isinf(found[2])
    assert magnitudes(statement, still, statement.values).x[:2] == pytest.approx(found[:2])
