"""The gradient method from elsewhere, with states that are known exactly: their variances are only roundoff.

The reference is Ipopt on the fresh problem, of which the rows are left out.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from problems import unassessed

import covocp as co
from covocp.transcription.scales import magnitudes
from covocp.transcription.trajectory import Trajectory

KNOWN = np.diag([0.0, 0.0, 1.0, 1.0, 0.1, 0.1])


def tracking(start: tuple[float, float] = (0.0, 0.0)) -> co.Problem:
    """A target of unknown velocity, tracked by its bearing from a place that is known exactly."""
    ocp = co.Problem(6.0, name="tracking")
    s = ocp.state("s", 2, initial=start)
    t = ocp.state("t", 2, initial=[3.0, 4.0])
    v = ocp.unknown("v", mean=[0.5, -0.2], variance=0.1)
    u = ocp.control("u", 2, lower=-1.0, upper=1.0)
    ocp.dynamics(s, u)
    ocp.dynamics(t, v, noise=0.01)
    ocp.measurement("bearing", ca.atan2(t[1] - s[1], t[0] - s[0]), noise=0.01)
    E = ocp.estimation_covariance(initial=KNOWN)
    ocp.minimize(running=0.1 * ca.sumsqr(u), terminal=E[t[0], t[0]] + E[t[1], t[1]])
    return ocp


@pytest.mark.parametrize(
    ("moved", "start"),
    [
        ({"covariance": KNOWN}, (0.0, 0.0)),
        ({"initial": {"s": [0.0, 0.0]}}, (0.0, 0.0)),
        ({"initial": {"s": [1.0, 0.5]}}, (1.0, 0.5)),
    ],
)
def test_states_that_are_known_exactly_from_elsewhere(moved: dict[str, Any], start: tuple[float, float]):
    """It had ended with 'the penalties do not remove the violations', of 1e-30, of the variance of s."""
    found = co.Solver(tracking(), "gradient", intervals=40).solve(progress=False, assess=False, **moved)
    fresh = unassessed(tracking(start), intervals=40)
    assert found.cost == pytest.approx(fresh.cost, rel=1e-6)


def test_a_small_variance_counts_unless_it_is_roundoff_of_zero():
    """A star tracker's 1e-18 rad^2 beside 1e12 m^2 is a variance, what steps leave of zero is none."""
    ocp = co.Problem(1.0)
    u = ocp.control("u")
    far, angle, known = (ocp.state(name, initial=1.0, variance=0.0) for name in ("far", "angle", "known"))
    for state in (far, angle, known):
        ocp.dynamics(state, u)
    ocp.measurement("y", far + angle + known, noise=1.0)
    ocp.estimation_covariance(initial=np.diag([1e12, 1e-18, 0.0]))
    ocp.minimize(running=u**2)
    statement = ocp.statement()
    half = np.zeros((3, statement.ne))
    block = statement.estimation
    diagonal = [0, 3, 5]
    half[:, diagonal] = [[1e12, 1e-18, 0.0], [1e12, 1e-18, 1e-32], [1e12, 1e-18, 1e-31]]
    along = Trajectory(x=np.ones((3, 3)), u=np.zeros((3, 1)), e=half, duration=1.0)
    found = magnitudes(statement, along, statement.values).e[block.span]
    assert found[diagonal] == pytest.approx([1e12, 1e-18, 1.0])
