"""Curves that are constant up to a solver's tolerance are drawn as constants."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co
from covocp.models import unknown_gain


def limits(solution, name):
    (axes,) = solution.plot(name).axes
    return axes.get_ylim()


def test_what_a_tolerance_leaves_is_not_drawn():
    """The best control of an unknown gain is constant: x(T)/(b T) = 1 [specification, 6.2]."""
    solution = co.solve(unknown_gain.problem(), intervals=50, progress=False)
    assert 0 < np.ptp(solution["u"]) < 1e-5
    low, high = limits(solution, "u")
    assert low == pytest.approx(0.95, rel=1e-4)
    assert high == pytest.approx(1.05, rel=1e-4)


@pytest.mark.parametrize("change", [1e-4, 1.0])
def test_small_changes_of_large_values_are_drawn(change):
    """An integrator from 1 to 1 + change."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=1.0, final=1.0 + change), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(u**2)
    low, high = limits(co.solve(ocp, intervals=10, progress=False), "x")
    assert low == pytest.approx(1.0, abs=0.1 * change)
    assert high == pytest.approx(1.0 + change, abs=0.1 * change)
