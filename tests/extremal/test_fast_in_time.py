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
        knots = np.linspace(0.0, DURATION, round(10 * frequency * DURATION) + 1)
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


def test_what_steps_see_is_not_told():
    """Smooth, too small to matter, or met as often as it needs: no warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for frequency, amplitude, substeps in ((0.1, 1.0, 1), (20.0, 1e-5, 1), (5.0, 1.0, 7)):
            problem = shaken(frequency, amplitude)
            found = co.solve(problem, intervals=INTERVALS, substeps=substeps, progress=False)
            off = abs(found["x"][-1] - flown(found, frequency, amplitude))
            assert off < 1e-2 * np.ptp(found["x"])
