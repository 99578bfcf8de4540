"""Solves from elsewhere where the start, the data or the duration are more than numbers, against fresh declarations."""

from __future__ import annotations

import time

import numpy as np
import pytest

import covocp as co


def lag(scale: float = 1.0, mean: float = 1.0) -> co.Problem:
    """A lag whose initial value and variances follow a parameter."""
    ocp = co.Problem(5.0)
    q = ocp.parameter("q", scale)
    x = ocp.state("x", initial=q, variance=0.5 * q)
    b = ocp.unknown("b", mean, 0.2 * q)
    u = ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(x, -b * x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.2)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + x**2, terminal=10 * E[b, b])
    return ocp


def test_a_declared_start_follows_the_parameters_it_depends_on():
    solver = co.Solver(lag(), intervals=30)
    found = solver.solve({"q": 2.0}, means={"b": 1.3})
    fresh = co.solve(lag(2.0, 1.3), intervals=30)
    assert found.cost == pytest.approx(fresh.cost, rel=1e-9)
    assert found["x"][0] == pytest.approx(2.0)
    assert found["E"][0] == pytest.approx(np.diag([1.0, 0.4]))
    given = solver.solve({"q": 2.0}, initial={"x": -1.0})  # what is given does not follow
    assert given["x"][0] == pytest.approx(-1.0)
    assert given["E"][0] == pytest.approx(np.diag([1.0, 0.4]))
    with pytest.raises(co.ProblemError, match="no parameter 'initial_x'"):
        solver.solve({"initial_x": 2.0}, initial={"x": 1.0})


def chance(start: float = 0.0, variance: float = 0.1, *, estimated: bool = True) -> co.Problem:
    """An integrator that is to stay below a limit with a probability, measured but not fed back."""
    ocp = co.Problem(2.0)
    x = ocp.state("x", initial=start, variance=variance)
    u = ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(x, u, noise=0.05)
    ocp.measurement("m", x, noise=0.05)
    if estimated:
        ocp.estimation_covariance()
    ocp.chance(x, upper=1.2, at="final", probability=0.95)
    ocp.minimize(running=(x - 2.0) ** 2 + 0.1 * u**2)
    return ocp


@pytest.mark.parametrize("estimated", [True, False])
def test_the_spread_of_a_chance_starts_with_the_covariance(estimated):
    covariance = [[0.5]] if estimated else {"X": [[0.5]]}
    found = co.Solver(chance(estimated=estimated), intervals=30).solve(initial={"x": 0.3}, covariance=covariance)
    fresh = co.solve(chance(0.3, 0.5, estimated=estimated), intervals=30)
    assert found.cost == pytest.approx(fresh.cost, rel=1e-9)
    # the variance that nobody measures grows from 0.5 by 0.05 a second, for 2 s
    assert found["X"][-1, 0, 0] == pytest.approx(0.6, rel=1e-9)
    assert found["x"][-1] + 1.6448536269514722 * np.sqrt(0.6) == pytest.approx(1.2, abs=1e-6)


def tracking(duration: float = 2.0, *, last: float = 4.0, read: bool = False) -> co.Problem:
    """An integrator that follows data with kinks."""
    ocp = co.Problem(duration)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    w = ocp.data("w", [0.0, 0.7, 2.0, last], [0.0, 1.0, 0.0, 2.0])
    ocp.dynamics(x, u)
    ocp.minimize(running=(x - (ocp.time / ocp.duration if read else w)) ** 2 + 0.1 * u**2)
    return ocp


def test_another_duration_has_its_own_kinks_and_what_it_cannot_have_is_refused():
    found = co.Solver(tracking(), intervals=40).solve(duration=3.5)
    assert found.cost == pytest.approx(co.solve(tracking(3.5), intervals=40).cost, rel=1e-9)
    with pytest.raises(co.ProblemError, match="'w' do not cover"):
        co.Solver(tracking(last=3.0), intervals=40).solve(duration=3.5)
    read = tracking(read=True)
    with pytest.raises(co.ProblemError, match=r"Problem.duration was read"):
        co.Solver(read, intervals=40).solve(duration=3.5)
    assert co.Solver(read, intervals=40).solve(duration=2.0, initial={"x": 0.0}).duration == 2.0  # that of the problem
    printed = tracking()
    str(printed)
    solver = co.Solver(printed, intervals=40)
    assert solver.solve(duration=3.5).cost == pytest.approx(found.cost, rel=1e-9)


def test_what_is_declared_later_is_not_in_what_was_built():
    ocp = tracking()
    solver = co.Solver(ocp, intervals=20)
    ocp.subject_to(ocp.states[0].symbol, upper=0.1)
    assert solver.solve(initial={"x": 0.0}).cost == pytest.approx(solver.solve().cost, rel=1e-9)


def limited() -> co.Problem:
    """An unstable plant whose covariance of the closed loop has a limit: the best gain is searched for first."""
    ocp = co.Problem(2.0)
    x = ocp.state("x", initial=1.0, variance=0.5)
    u = ocp.control("u", lower=-5.0, upper=5.0)
    ocp.dynamics(x, u + 0.5 * x, noise=0.2)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=u**2 + x**2)
    ocp.subject_to(ocp.closed_loop_covariance()[x, x], upper=0.4, at="final")
    return ocp


def test_limits_are_meant_for_the_search_before_the_run_too():
    solver = co.Solver(limited(), intervals=20)
    begin = time.perf_counter()
    whole = solver.solve(assess=False)
    unlimited = time.perf_counter() - begin
    begin = time.perf_counter()
    stopped = solver.solve(assess=False, time_limit=1e-6)
    assert time.perf_counter() - begin < 0.5 * unlimited
    assert not stopped.converged
    assert stopped.violations
    few = solver.solve(assess=False, iteration_limit=2)
    assert few.message == "stopped at the limit of 2 iterations"
    assert few.stats["iterations"] == 0
    ample = solver.solve(assess=False, iteration_limit=500, time_limit=100.0)
    assert ample.cost == pytest.approx(whole.cost, rel=1e-8)


def double_integrator(x0: float = 0.0, v0: float = 1.0, duration: float = 1.0) -> co.Problem:
    """Bryson-Denham's problem with a weight at the end: the bound on x is met along the way."""
    ocp = co.Problem(duration)
    x, v = ocp.state("x", initial=x0, upper=0.12), ocp.state("v", initial=v0)
    u = ocp.control("u", lower=-6.0, upper=6.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=0.5 * u**2, terminal=10 * x**2 + 10 * (v + 1.0) ** 2)
    return ocp


def test_multipliers_of_bounds_are_shifted_with_the_plan():
    """Principle of optimality: what is left of a plan is optimal, with the same densities of its multipliers."""
    solver = co.Solver(double_integrator(), intervals=50, tolerance=1e-9)
    plan = solver.solve()
    then = plan.at(0.2)
    start = {"initial": {"x": float(np.squeeze(then["x"])), "v": float(np.squeeze(then["v"]))}, "duration": 0.8}
    left, cold, stretched = (
        solver.solve(**start, guess=guess, elapsed=elapsed, assess=False)
        for guess, elapsed in ((plan, 0.2), (None, None), (plan, None))
    )
    assert left.cost == pytest.approx(cold.cost, rel=1e-7)
    assert 2 * left.stats["iterations"] <= min(cold.stats["iterations"], stretched.stats["iterations"])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"means": [1.0]}, "means= are not given by name"),
        ({"parameters": [1.0], "means": {"b": 1.0}}, "parameters= are not given by name"),
        ({"initial": {"x": 1.0, "symbol": 2.0}}, "two values of 'x'"),
    ],
)
def test_what_is_not_given_by_name_or_twice_is_refused(given, said):
    ocp = lag()
    if "initial" in given:
        given = {"initial": {"x": 1.0, ocp.states[0].symbol: given["initial"]["symbol"]}}
    with pytest.raises(co.ProblemError, match=said):
        co.Solver(ocp, intervals=10).solve(**given)


def test_a_truth_value_is_no_time():
    solver = co.Solver(lag(), intervals=30)
    with pytest.raises(co.ProblemError, match="not within the plan"):
        solver.solve(guess=solver.solve(), elapsed=True)
