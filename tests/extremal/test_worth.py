"""What is to be gained along a negative curvature, in closed form: where it is nothing, nobody is sent elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co
from covocp.extremal.curvature import smallest_curvature
from covocp.extremal.worth import gain


def at_a_saddle(weight: float, *, bounded: bool = True) -> co.Solution:
    """u = 0 of y(1) - weight x(1)^2 / 2 with x' = u, y = exp(-t)."""
    ocp = co.Problem(1.0)
    x, y = ocp.state("x", initial=0.0), ocp.state("y", initial=1.0)
    u = ocp.control("u", lower=-3.0, upper=3.0, guess=np.zeros(11)) if bounded else ocp.control("u", guess=np.zeros(11))
    ocp.dynamics(x, u)
    ocp.dynamics(y, -y)
    ocp.minimize(terminal=y - 0.5 * weight * x**2)
    return co.solve(ocp, intervals=10, max_iterations=0, allow_failure=True, progress=False)


@pytest.mark.filterwarnings("ignore:This is no minimum")  # a run of no steps at a saddle
@pytest.mark.parametrize("weight", [1e-8, 1e-2])
def test_the_gain_is_that_as_far_as_the_bounds(weight: float) -> None:
    solution = at_a_saddle(weight)
    found = smallest_curvature(solution.extremal)
    assert found is not None
    assert found.value == pytest.approx(-weight, rel=1e-6)
    assert gain(solution.extremal, found) == pytest.approx(0.5 * weight * 3.0**2, rel=1e-3)


@pytest.mark.filterwarnings("ignore:This is no minimum")  # a run of no steps at a saddle
def test_a_saddle_is_told_where_it_can_be_left_for_something() -> None:
    """Without bounds the cost falls for ever, however slowly."""
    for weight, bounded, told in ((1e-2, True, True), (1e-8, True, False), (1e-8, False, True)):
        solution = at_a_saddle(weight, bounded=bounded)
        assert solution.optimality.curvature == pytest.approx(-1.0 if told else 0.0)


def test_the_best_mixture_of_catalysts_is_a_minimum() -> None:
    """COPS: its singular arc leaves zigzags a curvature of -3e-6, worth less than the last digit that is published."""
    ocp = co.Problem(1.0)
    a, b = ocp.state("a", initial=1.0), ocp.state("b", initial=0.0)
    u = ocp.control("u", lower=0.0, upper=1.0)
    ocp.dynamics(a, u * (10.0 * b - a))
    ocp.dynamics(b, u * (a - 10.0 * b) - (1.0 - u) * b)
    ocp.minimize(terminal=a + b - 1.0)
    solution = co.solve(ocp, intervals=100, progress=False)
    assert solution.cost == pytest.approx(-0.0480556859, rel=1e-6)
    assert solution.optimality.curvature == 0.0  # no warning, which would be an error here
    assert "NOT A MINIMUM" not in str(solution)
