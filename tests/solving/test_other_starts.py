"""A run from a solution that fails by itself is left for other starts."""

from __future__ import annotations

from dataclasses import replace

import pytest

import covocp as co
from covocp.solution.report import OTHER_START
from covocp.solving import solver as solving

QUIET = {"progress": False}


def braking() -> co.Problem:
    """A double integrator to rest with least energy from 1 m in 2 s: the integral of u^2 is 12 / 2^3."""
    problem = co.Problem(2.0)
    x, v = problem.state("x", initial=1.0, final=0.0), problem.state("v", initial=0.0, final=0.0)
    u = problem.control("u")
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    problem.minimize(running=u**2)
    return problem


@pytest.fixture
def lost(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Every run from a solution fails; the iterations of each of them."""
    counted, real = [], solving.from_starts

    def run(*arguments):
        outcome, start = real(*arguments)
        if not start.warm:
            return outcome, start
        counted.append(outcome.stats["iterations"])
        return replace(outcome, converged=False, message="lost"), start

    monkeypatch.setattr(solving, "from_starts", run)
    return counted


def test_a_plain_problem_is_solved_from_its_own_start(lost):
    solver = co.Solver(braking())
    plan = solver.solve(**QUIET)
    found = solver.solve(guess=plan, **QUIET)
    assert found.converged
    assert found.cost == pytest.approx(12.0 / 2.0**3, rel=1e-6)
    assert found.stats["iterations"] == plan.stats["iterations"] + lost[0]
    assert found.stats[OTHER_START] == "the own start"
    assert "the guess led nowhere, the own start to this" in " ".join(str(found).split())


@pytest.mark.parametrize("given", [{"iteration_limit": 900}, {"time_limit": 900.0}])
def test_limits_of_the_user_end_it_there(lost, given):
    solver = co.Solver(braking())
    plan = solver.solve(**QUIET)
    found = solver.solve(guess=plan, allow_failure=True, **given, **QUIET)
    assert not found.converged
    assert found.stats["iterations"] == lost[0]


def test_iterations_that_the_user_gave_are_those_of_one_run(lost):
    solver = co.Solver(braking(), max_iterations=900)
    plan = solver.solve(**QUIET)
    with pytest.raises(co.SolveError, match="lost"):
        solver.solve(guess=plan, **QUIET)
