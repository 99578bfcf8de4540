"""Models that oscillate with the time as often as the steps meet them, or a multiple of it, against closed forms."""

from __future__ import annotations

import warnings

import casadi as ca
import numpy as np
import pytest

import covocp as co

DURATION, INTERVALS = 10.0, 50


def shaken(frequency, amplitude=1.0, table=False):
    """A lag that is held near one while it is shaken, at some frequency [Hz]."""
    ocp = co.Problem(DURATION)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    if table:
        knots = np.linspace(0.0, DURATION, round(6 * frequency * DURATION) + 1)
        shake = ocp.data("shake", knots, np.cos(2 * np.pi * frequency * knots), kind="cubic")
    else:
        shake = ca.cos(2 * np.pi * frequency * ocp.time)
    ocp.dynamics(x, u - 0.1 * x + amplitude * shake)
    ocp.minimize(running=u**2 + 0.1 * (x - 1) ** 2)
    return ocp


def flown(solution, frequency, amplitude=1.0):
    """x(T) along the controls of a solution, each linear piece of u - x/10 in closed form, the shaking added to it."""
    t, u, a, w = solution.t, solution["u"], 0.1, 2 * np.pi * frequency
    x = 0.0
    for h, u0, slope in zip(np.diff(t), u[:-1], np.diff(u) / np.diff(t), strict=True):
        fade = np.exp(-a * h)
        x = fade * x + (u0 - slope / a) * (1 - fade) / a + slope * h / a
    T = t[-1]
    return x + amplitude * (a * np.cos(w * T) + w * np.sin(w * T) - a * np.exp(-a * T)) / (a**2 + w**2)


@pytest.mark.parametrize("frequency", [20.0, 40.0])
def test_given_steps_that_meet_one_place_of_a_period_are_told(frequency):
    with pytest.warns(co.CovocpWarning, match=r"changes with the time faster than the integration steps see.*'x'"):
        found = co.solve(shaken(frequency), intervals=INTERVALS, substeps=1, progress=False)
    off = abs(found["x"][-1] - flown(found, frequency)) / np.ptp(found["x"])
    assert off > 1.0  # the steps take the shaking for a constant
    assert 0.5 * off < found.optimality.node_error < 2.0 * off
    assert found.mesh_error > 0.5


def test_a_nominal_along_such_steps_is_told():
    with pytest.warns(co.CovocpWarning, match="faster than the integration steps see"):
        found = co.evaluate(shaken(20.0), nominal={"u": 0.0}, intervals=INTERVALS, substeps=1)
    assert abs(found["x"][-1] - flown(found, 20.0)) > 1.0


@pytest.mark.parametrize(("frequency", "table"), [(20.0, False), (40.0, True), (100.0, False)])
def test_default_steps_see_what_oscillates_at_a_round_frequency(frequency, table):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The mesh is too coarse")
        found = co.solve(shaken(frequency, table=table), intervals=INTERVALS, progress=False)
    still = co.solve(shaken(frequency, amplitude=0.0), intervals=INTERVALS, progress=False)
    assert found.cost == pytest.approx(still.cost, rel=3e-3)  # what is so fast moves x by 1 / (2 pi frequency) or less
    assert abs(found["x"][-1] - flown(found, frequency)) < 1e-3 * np.ptp(found["x"])


def test_default_steps_along_a_nominal_see_it():
    found = co.evaluate(shaken(20.0), nominal={"u": 0.0}, intervals=INTERVALS)
    assert found["x"][-1] == pytest.approx(flown(found, 20.0), abs=1e-4)


def test_a_cost_that_oscillates_alone_is_seen():
    """The mean of a cosine over whole periods is nothing."""
    ocp = co.Problem(DURATION)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=x**2 * (1 + ca.cos(2 * np.pi * 40.0 * ocp.time)))
    found = co.evaluate(ocp, nominal={"u": 0.0}, intervals=INTERVALS)
    assert found.cost == pytest.approx(DURATION, rel=1e-6)


def test_a_density_that_oscillates_counts_with_its_mean():
    """E' = Q - E^2 / U of a Wiener process from zero, in closed form with the mean of Q."""
    ocp = co.Problem(DURATION)
    x, u = ocp.state("x", initial=0.0, variance=0.0), ocp.control("u")
    ocp.dynamics(x, u, noise=0.05 * (1 + ca.cos(2 * np.pi * 40.0 * ocp.time)))
    ocp.measurement("position", x, noise=2.0)
    ocp.minimize_expected(running=u**2 + x**2)
    found = co.evaluate(ocp, nominal={"u": 0.0}, intervals=INTERVALS)
    settled = np.sqrt(0.05 * 2.0)
    E = settled * np.tanh(DURATION * settled / 2.0)
    assert found.trajectory.e[-1, 0] == pytest.approx(E, rel=5e-3)


def test_what_steps_see_is_not_told():
    """Smooth, too small to matter, or met as often as it needs: no warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for frequency, amplitude, substeps in ((0.1, 1.0, 1), (20.0, 1e-5, 1), (5.0, 1.0, 7)):
            problem = shaken(frequency, amplitude)
            found = co.solve(problem, intervals=INTERVALS, substeps=substeps, progress=False)
            off = abs(found["x"][-1] - flown(found, frequency, amplitude))
            assert off < 1e-2 * np.ptp(found["x"])
