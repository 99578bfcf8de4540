"""The time that is told with a solution is what was waited for it."""

from __future__ import annotations

import time

import pytest

import covocp as co
from covocp.solution.report import solution_seconds


def heading() -> co.Problem:
    """A limit of the actual speed, so that the gain is free: solved first with the best gain."""
    ocp = co.Problem(10.0, name="heading")
    x = ocp.state("x", initial=0.0, final=1.0, variance=0.01)
    v = ocp.state("v", initial=0.0, final=0.0, variance=1e-3)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=1e-3)
    ocp.measurement("position", x, noise=1e-2)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 5.0, v: 5.0})
    ocp.chance(v, upper=0.2, probability=0.9)
    return ocp


def test_runs_that_lead_to_the_start_are_told():
    """A seventh of the time was told: that of the last run."""
    problem = heading()
    begin = time.perf_counter()
    solution = co.solve(problem, intervals=20, progress=False)
    waited = time.perf_counter() - begin
    told = solution_seconds(solution.stats)
    assert told is not None
    assert 0.7 * waited < told <= waited
    assert f"{told:.3g} s" in str(solution)


def test_what_was_built_once_is_told_once():
    solver = co.Solver(heading(), intervals=20)
    first = solver.solve(progress=False)
    begin = time.perf_counter()
    again = solver.solve(guess=first, progress=False)
    assert solution_seconds(again.stats) == pytest.approx(time.perf_counter() - begin, rel=0.3)
