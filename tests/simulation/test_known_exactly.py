"""What is known exactly at the end is not compared: what is left of it is roundoff and the error of steps."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co
from covocp.simulation.verdict import Component


@pytest.mark.parametrize("lag", [0.02, 0.05])
def test_an_error_that_has_died_out_is_no_failure_of_the_filter(lag):
    """A fast state without noise: its error falls by e^(-10 / lag); "f nan" was told of what Heun's steps leave."""
    ocp = co.Problem(10.0, name="fast actuator")
    x, f = ocp.state("x", initial=1.0, final=0.0, variance=0.1), ocp.state("f", initial=0.0, variance=1e-2)
    u = ocp.control("u")
    ocp.dynamics(x, f, noise=0.01)
    ocp.dynamics(f, (u - f) / lag)
    ocp.measurement("position", x, noise=1e-2)
    ocp.minimize_expected(running=u**2 + x**2, terminal_weight={x: 5.0})
    runs = co.simulate(co.solve(ocp, progress=False), runs=500, seed=1, progress=False)
    text = str(runs)
    assert "nan" not in text
    assert "OUTSIDE" not in text
    assert "errors of the filter are not" not in text
    known = runs.verdict.errors[1]
    assert known.name == "f"
    assert known.sample < 1e-6 * np.sqrt(1e-2)


@pytest.mark.parametrize(("predicted", "sample", "inside"), [(0.0, 1e-3, False), (1e-3, 0.0, False), (0.0, 1e-9, True)])
def test_more_than_the_error_of_steps_is_compared(predicted, sample, inside):
    component = Component(
        name="x", predicted=predicted, sample=sample, low=0.9 * sample, high=1.1 * sample, bias=0, robust=0, exact=1e-7
    )
    assert component.inside == inside


@pytest.mark.parametrize("start", [2.0, 2e7])
def test_a_state_that_nothing_makes_uncertain_is_the_same_in_all_runs(start):
    """Mass that the control burns: runs differ from the nominal by the steps of both, 3e-6 of it on a coarse mesh."""
    ocp = co.Problem(4.0, name="ascent")
    x, m = ocp.state("x", initial=0.0, final=2.0, variance=0.05), ocp.state("m", initial=start)
    u = ocp.control("u", lower=0, upper=3)
    ocp.dynamics(x, u, noise=0.01)
    ocp.dynamics(m, -0.3 * u * m)
    ocp.measurement("position", x, noise=0.02)
    ocp.estimation_covariance()
    ocp.minimize(running=u**2 * (1 + ocp.time))
    runs = co.simulate(co.solve(ocp, intervals=8, progress=False), runs=300, seed=1, progress=False)
    known = runs.verdict.deviations[1]
    assert known.name == "m"
    assert known.predicted == 0.0
    assert 1e-8 * start < known.sample < 1e-5 * start
    assert runs.verdict.holds, runs.verdict
    assert "OUTSIDE" not in str(runs)


def test_what_varies_by_second_order_alone_is_no_rounding():
    """The integral of 1e-7 x^2 is 0 in the nominal; linear theory predicts no spread, runs have one."""
    ocp = co.Problem(4.0, name="quadratic")
    x, m = ocp.state("x", initial=0.0, final=0.0, variance=0.05), ocp.state("m", initial=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=0.01)
    ocp.dynamics(m, -1e-7 * x**2)
    ocp.measurement("position", x, noise=0.02)
    ocp.estimation_covariance()
    ocp.minimize(running=u**2)
    runs = co.simulate(co.solve(ocp, intervals=8, progress=False), runs=300, seed=1, progress=False)
    assert runs.verdict.outside[-1] == "m"
