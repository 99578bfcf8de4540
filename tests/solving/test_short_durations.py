"""Free durations whose guess is too short for what the controls can do."""

from functools import cache

import numpy as np
import pytest
from problems import unassessed

import covocp as co
from covocp import SolveError


def to_rest(position, speed, guess, *, spring=0.0, upper=60.0, slowest=None):
    """Least time to rest at zero with |u| <= 1."""
    ocp = co.Problem(co.Free(guess, 0.01, upper))
    x, v = ocp.state("x", initial=position, final=0.0), ocp.state("v", initial=speed, final=0.0)
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - spring * x)
    if slowest is not None:
        ocp.subject_to(v, lower=slowest, name="speed")
    ocp.minimize(terminal=ocp.duration)
    return ocp


def least_time(position, speed):
    """Of the double integrator: full thrust towards the curve that leads to rest, then full thrust back."""
    side = np.sign(position + 0.5 * speed * abs(speed))
    return side * speed + 2.0 * np.sqrt(0.5 * speed**2 + side * position)


@pytest.mark.parametrize("method", ["ipopt", "auto", "gradient"])
@pytest.mark.parametrize(("distance", "excess", "share"), [(2.0, 1.01, 0.8), (10.0, 1.03, 0.5), (50.0, 1.1, 0.8)])
def test_who_brakes_too_late_turns_back(method, distance, excess, share):
    start = distance, -excess * np.sqrt(2.0 * distance)
    exact = least_time(*start)
    solution = co.solve(to_rest(*start, share * exact), method=method, progress=False)
    assert solution.cost == pytest.approx(exact, rel=1e-3)


@cache
def cost_from_far():
    return unassessed(to_rest(4.3, -2.1, 12.0, spring=1.0)).cost


@pytest.mark.parametrize("guess", [1.0, 6.0])
def test_a_swinging_mass_is_stopped_from_any_guess(guess):
    problem = to_rest(4.3, -2.1, guess, spring=1.0)
    assert co.solve(problem, progress=False).cost == pytest.approx(cost_from_far(), rel=1e-6)


def test_a_curvature_that_rounding_has_lost_is_no_error_of_numpy():
    """Of the gradient method from 3 s for 2 pi: its metric was not definite any more, and a step no number."""
    solution = co.Solver(to_rest(4.0, 0.0, 3.0, spring=1.0), "gradient").solve(allow_failure=True, progress=False)
    assert np.isfinite(solution["u"]).all()


def test_a_bound_of_the_duration_is_kept_and_what_is_missing_is_told():
    with pytest.raises(SolveError, match="violated constraints") as caught:
        co.solve(to_rest(2.0, -2.02, 1.5, upper=2.2), progress=False)
    assert caught.value.solution.duration <= 2.2 * (1 + 1e-6)


def test_iterations_count_those_of_all_durations():
    late, early = (co.solve(to_rest(2.0, -2.02, guess), progress=False) for guess in (4.0, 2.0))
    assert early.stats["iterations"] > late.stats["iterations"]


def test_limits_are_those_of_one_run():
    solver = co.Solver(to_rest(2.0, -2.02, 2.0))
    solution = solver.solve(iteration_limit=12, progress=False)
    assert not solution.converged
    assert solution.stats["iterations"] <= 13
    with pytest.raises(SolveError, match="contradict"):  # known before the limit: it is not used up in vain
        solver.solve(iteration_limit=900, progress=False)
    with pytest.raises(SolveError) as caught:
        co.solve(to_rest(2.0, -2.02, 2.0), max_iterations=5, progress=False)
    assert caught.value.solution.stats["iterations"] <= 5


def test_a_limit_that_the_start_passes_is_told_after_one_run():
    ocp = to_rest(2.0, -2.02, 2.0, slowest=-2.0)
    with pytest.raises(SolveError, match=r"speed is -2\.02 at the start") as caught:
        co.solve(ocp, progress=False)
    once = co.Solver(ocp).solve(allow_failure=True, iteration_limit=2000, progress=False)
    assert caught.value.solution.stats["iterations"] == once.stats["iterations"]


@pytest.mark.parametrize("guess", [0.5, 1.0])
def test_phases_whose_durations_are_guessed_too_short_are_longer(guess):
    """Past a gate at 1 on the way to the turn at -0.04, or on a second way, which takes 6.06 s."""
    first, second = (co.Problem(co.Free(guess, 0.01, 60.0), name=name) for name in ("first", "second"))
    for problem, starts, end in ((first, (2.0, -2.02), (1.0, None)), (second, (None, None), (0.0, 0.0))):
        x, v = (
            problem.state(name, initial=begin, final=at)
            for name, begin, at in zip(("x", "v"), starts, end, strict=True)
        )
        u = problem.control("u", lower=-1.0, upper=1.0)
        problem.dynamics(x, v)
        problem.dynamics(v, u)
        problem.minimize(terminal=problem.duration)
    solution = co.solve(co.Phases([first, second]), progress=False)
    assert least_time(2.0, -2.02) * (1 - 1e-3) <= solution.cost <= 6.07
    assert solution.phases[1]["x"][-1] == pytest.approx(0.0, abs=1e-6)
    assert solution.phases[1]["v"][-1] == pytest.approx(0.0, abs=1e-6)
