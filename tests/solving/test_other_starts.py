"""A solution given as a guess that leads nowhere is left for other starts, from which a fresh solve leads on."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import pytest
from problems import unassessed

import covocp as co
from covocp.base.progress import Progress
from covocp.solution.report import OTHER_START
from covocp.solving import solver as solving
from covocp.solving.other_starts import LOST, Falling

QUIET = {"progress": False}


def wall(price: float = 0.1) -> co.Problem:
    """A cart before a wall that it keeps away from with a probability: its gain is free."""
    ocp = co.Problem(4.0, "wall")
    x = ocp.state("x", initial=0.0, variance=0.01)
    v = ocp.state("v", initial=0.0, variance=0.01)
    u, p = ocp.control("u"), ocp.parameter("p", price)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.3 * v, noise=0.02)
    ocp.measurement("y", x, noise=0.01)
    ocp.minimize_expected(running=p * u**2 + 0.5 * (x - 1) ** 2 + 0.1 * v**2, terminal_weight={x: 2.0})
    ocp.chance(x, upper=1.3, probability=0.95, name="wall")
    return ocp


@cache
def least(price: float) -> float:
    return unassessed(wall(price)).cost


@pytest.mark.parametrize(("before", "after"), [(1.0, 0.1), (0.03, 0.1)])
def test_a_plan_whose_free_gain_leads_astray_is_left_for_the_best_gain(before, after):
    solver = co.Solver(wall())
    plan = solver.solve({"p": before}, progress=False, assess=False)
    found = solver.solve({"p": after}, guess=plan, progress=False)
    assert found.cost == pytest.approx(least(after), rel=1e-6)
    assert found.stats["other_start"] == "the best gain along it"
    assert 30 < found.stats["iterations"] < 200  # those of all runs; the first is given up before its 400
    assert "the guess led nowhere" in str(found)
    again = solver.solve({"p": before}, progress=False, assess=False)
    assert again.cost == pytest.approx(plan.cost, rel=1e-6)


def test_what_the_user_limits_is_kept_to():
    solver = co.Solver(wall())
    plan = solver.solve({"p": 1.0}, progress=False, assess=False)
    found = solver.solve({"p": 0.5}, guess=plan, iteration_limit=31, allow_failure=True, progress=False)
    assert not found.converged
    assert found.stats["iterations"] <= 32
    with pytest.raises(co.SolveError) as caught:
        co.Solver(wall(), max_iterations=20).solve({"p": 0.5}, guess=plan, progress=False)
    assert caught.value.solution.stats["iterations"] <= 20


def vehicle() -> co.Problem:
    """Past an obstacle to a place ahead."""
    ocp = co.Problem(6.0, "vehicle")
    ahead, place = ocp.parameter("ahead", 8.0), ocp.state("place", 2, initial=[0.0, 0.0])
    course, speed = ocp.state("course", initial=0.0), ocp.state("speed", initial=1.0, lower=0.0, upper=3.0)
    a, w = ocp.control("a", lower=-1.0, upper=1.0), ocp.control("w", lower=-1.0, upper=1.0)
    ocp.dynamics(place, speed * ca.vertcat(ca.cos(course), ca.sin(course)))
    ocp.dynamics(course, w)
    ocp.dynamics(speed, a)
    ocp.subject_to((place[0] - 4.0) ** 2 + (place[1] - 0.2) ** 2, lower=1.0, name="obstacle")
    ocp.subject_to(ca.vertcat(place[0] - ahead, place[1]), equals=0.0, at="final", name="there")
    ocp.minimize(running=w**2 + a**2)
    return ocp


def test_a_plan_round_an_obstacle_is_left_where_the_goal_is_before_it():
    solver = co.Solver(vehicle(), intervals=40)
    plan = solver.solve(progress=False)
    found = solver.solve({"ahead": 3.0}, guess=plan, progress=False)
    assert found.cost == pytest.approx(solver.solve({"ahead": 3.0}, progress=False).cost, rel=1e-6)
    assert found.stats["other_start"] == "the own start"
    with pytest.raises(co.SolveError, match="local infeasibility"):  # a limit leaves what is left of it to the user
        solver.solve({"ahead": 3.0}, guess=plan, iteration_limit=1000, progress=False)


def test_where_all_starts_fail_the_first_run_counts():
    solver = co.Solver(vehicle(), intervals=40)
    plan = solver.solve(progress=False)
    alone = solver.solve({"ahead": 25.0}, guess=plan, iteration_limit=1000, allow_failure=True, progress=False)
    found = solver.solve({"ahead": 25.0}, guess=plan, allow_failure=True, progress=False)
    assert not found.converged
    assert found.cost == alone.cost
    assert found.message == alone.message
    assert found.stats["iterations"] > alone.stats["iterations"]


def test_a_cost_is_given_up_where_it_has_fallen_for_long():
    reporter = Falling(Progress("", show=False))
    for k, cost in enumerate([1.0, *[-9.5] * (LOST - 1), -8.0, *[-9.5] * (LOST - 1)]):
        reporter.update(k, cost, 1e-3)
        assert not reporter.stop
    reporter.update(2 * LOST, -9.5, 1e-3)
    assert "far below the 1 of the start" in reporter.spent


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
    assert "the guess led nowhere, solved from the own start" in " ".join(str(found).split())


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
