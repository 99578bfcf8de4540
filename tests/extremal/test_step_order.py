"""A node is asked for where a rate may jump, and not where steps are only too long."""

from __future__ import annotations

import re

import casadi as ca
import pytest

import covocp as co
from covocp.extremal.step_order import is_smooth


def driven(rate, **options):
    ocp = co.Problem(3.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, rate(ocp.time) + u)
    ocp.minimize(running=u**2 + 0.1 * x**2)
    with pytest.warns(co.CovocpWarning, match="mesh is too coarse") as caught:
        solution = co.solve(ocp, progress=False, **options)
    return solution, " ".join(str(one.message) for one in caught)


@pytest.mark.parametrize("at", [0.9, 0.91, 0.93, 1.0, 1.07])
@pytest.mark.parametrize("substeps", [1, 2])
def test_a_rate_that_jumps_is_told(at, substeps):
    rate = ca.interpolant("rate", "linear", [[0.0, at - 1e-9, at, 3.0]], [1.0, 1.0, 0.0, 0.0])
    solution, words = driven(rate, intervals=8, substeps=substeps)
    assert not is_smooth(solution.extremal)
    assert "Put a node where a rate jumps" in words


def test_steps_that_are_too_long_for_a_smooth_rate_are_told_alone():
    solution, words = driven(lambda t: 3.0 * ca.sin(4.0 * t), intervals=6, substeps=1)
    assert is_smooth(solution.extremal)
    assert "Put a node" not in words
    assert "use more intervals or substeps" in words


def test_what_shorter_steps_change_of_a_loop_is_its_own_cost():
    """The terms of an expected cost are others than those that the steps add up."""
    ocp = co.Problem(6.0)
    x, v = (ocp.state(name, initial=start, final=0.0, variance=0.1) for name, start in (("x", 1.0), ("v", 0.0)))
    mu, u = ocp.unknown("mu", mean=1.0, variance=0.2), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, mu * (1 - x**2) * v - x + u, noise=0.02)
    ocp.measurement("m", x + 0.3 * x**3, noise=0.05 + 0.005 * ocp.time)
    ocp.minimize_expected(running=0.5 * u**2 + 0.2 * x**4, terminal_weight={x: 4.0, v: 1.0})
    with pytest.warns(co.CovocpWarning, match="mesh is too coarse") as caught:
        solution = co.solve(ocp, intervals=10, progress=False)
    told = float(re.search(r"changes the cost by (\S+)", str(caught[0].message))[1])
    finer = co.solve(ocp, intervals=10, substeps=4 * solution.mesh.substeps, guess=solution, progress=False)
    assert told == pytest.approx(abs(finer.cost / solution.cost - 1.0), rel=0.5)
