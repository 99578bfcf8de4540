"""What the form of a control costs where it meets its bounds, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co

STRONGEST = 5.0


def saturated() -> tuple[co.Problem, float]:
    """Least energy from rest to rest within bounds of the force, and its optimum: a saturated straight line."""
    ocp = co.Problem(1.0)
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u", lower=-STRONGEST, upper=STRONGEST)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=u**2)
    rest = float(np.sqrt(3.0 * (0.25 - 1.0 / STRONGEST)))  # distance = a/4 - a rest^2/3
    return ocp, 2 * STRONGEST**2 * (0.5 - rest + rest / 3.0)


@pytest.mark.parametrize("intervals", [7, 8, 10, 13, 17, 25, 40])
def test_intervals_that_touch_a_bound_count(intervals):
    """Without them a tenth of the error was told."""
    ocp, optimum = saturated()
    solution = co.solve(ocp, intervals=intervals, progress=False)
    excess = solution.cost / optimum - 1.0
    assert 0.5 * excess < solution.optimality.control_error < 2.5 * excess


def test_a_control_that_is_always_at_its_bound_costs_nothing():
    ocp = co.Problem(1.0)
    x = ocp.state("x", initial=0.0)
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, u)
    ocp.minimize(running=0.1 * u**2, terminal=-x)  # u = 1 for any weight below 1/2
    solution = co.solve(ocp, intervals=10, progress=False)
    assert solution.cost == pytest.approx(-0.9, rel=1e-6)
    assert solution.optimality.control_error < 1e-9
