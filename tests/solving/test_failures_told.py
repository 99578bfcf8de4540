"""What is said of a run that failed: the likely reason, ways that were not tried, and first what the user stated."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy import stats

import covocp as co
from covocp.base.progress import Progress
from covocp.extremal.extremal import Outcome
from covocp.solution.report import stated_first
from covocp.solving.decisions import bent_cost
from covocp.solving.failure import passed_at_the_start

FUEL = 2.0 * (2.0 - 3.0**0.5)  # of a mass moved by 1 within 4 s by at most 1, at rest at both ends


def mass(cost: Any, *, split: bool = False) -> co.Problem:
    ocp = co.Problem(4.0, name="fuel")
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u", 2, lower=0.0, upper=1.0) if split else ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u[0] - u[1] if split else u)
    ocp.minimize(running=cost(u))
    return ocp


def said(ocp: co.Problem, **options: Any) -> str:
    with pytest.raises(co.SolveError) as failed:
        co.solve(ocp, progress=False, **options)
    return str(failed.value)


@pytest.mark.parametrize("options", [{}, {"hessian": "exact"}, {"hessian": "limited-memory"}])
def test_a_kink_in_a_control_is_told_and_no_way_that_was_given(options):
    """method='reduced' or hessian='exact' had been recommended to who had given the latter."""
    words = said(mass(ca.fabs), intervals=10, **options)
    assert "kinks or jumps in 'u' (abs)" in words
    assert "method='reduced'" not in words
    exact = options.get("hessian") != "limited-memory"  # that of plain problems is exact
    assert ("hessian='exact'" in words) is (not exact and "no step from there" in words)


def test_the_remedies_of_a_kink_are_remedies():
    split = co.solve(mass(lambda u: u[0] + u[1], split=True), progress=False)
    assert split.cost == pytest.approx(FUEL, rel=1e-3)
    smooth = co.solve(mass(lambda u: ca.sqrt(u**2 + 1e-4)), progress=False)
    assert FUEL < smooth.cost < FUEL + 4.0 * 1e-2


def test_no_kink_is_told_where_there_is_none_or_a_limit_is_passed():
    assert "kinks" not in said(mass(lambda u: u**2), max_iterations=1)
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=5.0), ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, u)
    ocp.minimize(running=ca.fabs(u))
    assert "kinks" not in said(ocp)


def test_conditions_of_the_user_come_before_gaps():
    """E[b, b] <= 1e-4 was named after the continuity of x, whose gap has another unit."""
    ocp = co.Problem(5.0, name="accurate")
    x = ocp.state("x", initial=0.0, variance=0.1)
    b = ocp.unknown("b", mean=1.0, variance=1.0)
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, -b * x + u, noise=0.01)
    ocp.measurement("m", x, noise=0.01)
    E = ocp.estimation_covariance()
    ocp.subject_to(E[b, b], upper=1e-4, at="final", name="accuracy of b")
    ocp.minimize(running=u**2)
    with pytest.raises(co.SolveError) as failed:
        co.solve(ocp, progress=False)
    assert failed.value.solution is not None
    for words in (str(failed.value), str(failed.value.solution)):
        assert words.index("accuracy of b") < words.index("continuity of x")


@pytest.mark.parametrize("lower", [-0.7, -0.3])
def test_a_limit_that_only_gaps_of_a_covariance_meet_is_named(lower):
    """y(T) = 0 with 2.33 deviations of 0.379: a run left what is missed in the continuity of E, which nobody stated."""
    ocp = co.Problem(10.0, name="corridor")
    y = ocp.state("y", initial=0.0, final=0.0, variance=0.01)
    v = ocp.state("v", initial=0.0, variance=1e-3)
    a = ocp.control("a")
    ocp.dynamics(y, v)
    ocp.dynamics(v, a, noise=1e-4)
    ocp.minimize(running=a**2)
    ocp.chance(y, lower=lower, probability=0.99, name="bump")
    with pytest.raises(co.SolveError) as failed:
        co.solve(ocp, intervals=20, progress=False)
    deviation = (0.01 + 1e-3 * 10.0**2 + 1e-4 * 10.0**3 / 3.0) ** 0.5
    assert failed.value.violations["bump"] == pytest.approx(stats.norm.ppf(0.99) * deviation + lower, rel=1e-3)
    assert str(failed.value).index("bump") < str(failed.value).index("continuity of E")


def test_order_of_violations():
    violations = {"one: continuity of x": 9.0, "two: limit": 1.0, "continuity of y": 8.0, "one: final value of x": 2.0}
    ordered = [name for name, _ in stated_first(violations)]
    assert ordered == ["one: final value of x", "two: limit", "one: continuity of x", "continuity of y"]


def test_a_gain_is_no_kink_of_the_user() -> None:
    """Of log(1 + X[u, u]) kinks in 'C' by fmax were told, which the toolbox had put there."""

    def loop(bent: bool) -> co.Problem:
        ocp = co.Problem(2.0)
        x, u = ocp.state("x", initial=1.0, variance=0.2), ocp.control("u")
        ocp.dynamics(x, 0.5 * x + u, noise=0.05)
        ocp.measurement("m", x, noise=0.01)
        X = ocp.closed_loop_covariance()
        ocp.minimize_expected(running=u**2 + (ca.fabs(u) if bent else 0.0) + x**2 + ca.sqrt(1 + X[u, u]))
        return ocp

    for bent in (False, True):
        along = co.evaluate(loop(bent), nominal={"u": 0.1, "C": 1.0}, intervals=4)
        told = bent_cost(replace(along, violations={}))
        assert ("in 'u' (abs)" in told) is bent
        assert bent or not told


@pytest.mark.parametrize("limit", [0.5, 0.6, 0.7])
def test_what_an_integral_may_be_is_missed_by_what_is_missing(limit):
    """An oscillator is brought to v(T) = 0: int u^2 >= (p0 sin T - v0 cos T)^2 / int cos^2, by Cauchy and Schwarz.

    From 0.7 some runs go to the largest number of iterations: what their last iterates miss in the integral they may
    miss in other rows too; the others converge to a point of local infeasibility.
    """
    T, p0, v0 = 4.5, 1.42607113, 0.01696409
    problem = co.Problem(T, "oscillator")
    p = problem.state("p", initial=p0)
    v = problem.state("v", initial=v0, final=0.0)
    u = problem.control("u", lower=-2.0, upper=2.0)
    problem.dynamics(p, v)
    problem.dynamics(v, u - p)
    problem.subject_to(problem.integral(u**2, name="energy"), upper=limit, name="battery")
    problem.minimize(running=p**2)
    with pytest.raises(co.SolveError, match="the constraints may contradict") as told:
        co.solve(problem, intervals=40, progress=False)
    least = (p0 * np.sin(T) - v0 * np.cos(T)) ** 2 / (T / 2 + np.sin(2 * T) / 4)
    missed = told.value.violations["battery"]
    assert 0.0 < missed < 1.1 * (least - limit)
    if "local infeasibility" in str(told.value):
        assert missed == pytest.approx(least - limit, rel=1e-3)
    assert re.search(r"largest violation:\n +battery: 0", str(told.value))


def test_a_violation_that_has_not_fallen_for_long_is_counted():
    progress = Progress("", show=False)
    for first, violations in ((0, [1.0, 0.5, *[0.5] * 150]), (1, [1.0, 0.0, 1.0]), (0, np.geomspace(1.0, 1e-3, 300))):
        for k, violation in enumerate(violations, first):
            progress.update(k, 0.0, violation)
    assert progress.stalled(151) == 150  # of an earlier run
    assert progress.stalled(3) == 0  # it came to where nothing is violated
    assert progress.stalled(299) < 10
    assert progress.stalled(77) == 0  # there was none


@pytest.mark.parametrize(("asked", "named"), [("auto", "covariances='eliminated' may find a way"), ("states", "")])
def test_the_other_formulation_of_the_covariances_is_named(asked, named):
    """A limit of log E took 28 s in vain as states, and 0.2 s eliminated; 'auto' was all that was told."""
    ocp = co.Problem(2.0, name="learning")
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u", lower=-3, upper=3, guess=0.5)
    b = ocp.unknown("b", mean=1.0, variance=100.0)
    ocp.dynamics(x, u, noise=0.01)
    ocp.measurement("m", b * x, noise=0.01)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.05 * u**2, terminal=E[b, b])
    ocp.subject_to(ca.log(E[b, b]), upper=10.0)
    with pytest.raises(co.SolveError) as failed:
        co.solve(ocp, covariances=asked, max_iterations=1, progress=False)
    assert named in str(failed.value)
    assert ("covariances=" in str(failed.value)) == bool(named)


def test_a_limit_that_the_given_start_passes_is_told_with_what_is_given():
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.2), ocp.control("u")
    y = ocp.state("y", initial=1.0)
    ocp.dynamics(x, u)
    ocp.dynamics(y, -y)
    ocp.subject_to(2.0 * x, upper=0.3, name="doubled")
    ocp.subject_to(x + u, upper=0.1, name="with a control")
    ocp.minimize(running=u**2)
    with pytest.raises(co.SolveError) as caught:
        co.solve(ocp, progress=False)
    assert "\n  doubled is 0.4 at the start, by what is given there, and shall be at most 0.3.\n" in str(caught.value)
    assert "with a control is" not in str(caught.value)


def test_a_covariance_that_begins_above_its_limit_is_told_and_no_other_way():
    ocp = co.Problem(1.0)
    x, w = ocp.state("x", initial=0.0, variance=0.2), ocp.control("w", lower=0.0, upper=5.0)
    ocp.dynamics(x, -x, noise=0.01)
    ocp.measurement("y", x, information=w)
    E = ocp.estimation_covariance()
    ocp.subject_to(E[x, x], upper=0.12, name="knowledge")
    ocp.minimize(running=w**2)
    with pytest.raises(co.SolveError, match=r"knowledge is 0\.2 at the start, .* at most 0\.12") as caught:
        co.solve(ocp, progress=False)
    assert "covariances=" not in str(caught.value)


@pytest.mark.parametrize(("row", "given"), [("lesser", False), ("chosen", False), ("rate", False), ("doubled", True)])
def test_what_controls_or_the_duration_may_still_change_is_not_given(row, given):
    """Where a run says that it violates it: no number in place of the control tells nothing of fmin and if_else."""
    ocp = co.Problem(co.Free(3.0, 0.1, 60.0))
    x, u = ocp.state("x", initial=1.0), ocp.control("u", lower=-2.0, upper=2.0)
    ocp.dynamics(x, u)
    rows = {"lesser": ca.fmin(x, u), "chosen": ca.if_else(u > 0, 0.0 * x, x), "rate": x / ocp.duration}
    ocp.subject_to((rows | {"doubled": 2.0 * x})[row], upper=0.01, name=row)
    ocp.minimize(running=u**2, terminal=ocp.duration)
    solution = co.Solver(ocp).solve(iteration_limit=5, allow_failure=True, progress=False)
    outcome = Outcome(
        extremal=solution.extremal, cost_terms={}, converged=False, message="", violations={row: 1.0}, stats={}
    )
    assert bool(passed_at_the_start(outcome)) is given


def test_intervals_in_which_what_grows_leaves_all_numbers_are_the_reason():
    """x' = x + u for 4000 s: 40 s to an interval, in which x grows by exp(40). With as many as are named it is solved.

    Truth by the Riccati equations in the steady state: E W = p, S = s, of W the information, at the rate S K U K'.
    """
    ocp = co.Problem(4000.0, "long")
    x, u = ocp.state("x", initial=1.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, x + u, noise=0.1)
    ocp.measurement("place", x, noise=0.1)
    ocp.minimize_expected(running=x**2 + u**2)
    with pytest.raises(co.SolveError, match=r"exp\(40\) times larger after an interval.* give intervals=521"):
        co.solve(ocp, progress=False, max_iterations=5)
    E = 0.1 * (1 + np.sqrt(2))  # 2 E + 0.1 = E^2 / 0.1
    S = 1 + np.sqrt(2)  # of x^2 + u^2: 2 S + 1 = S^2
    rate = E + S * E**2 / 0.1  # tr A E + tr S K U K' with weights of one
    found = co.solve(ocp, intervals=521, progress=False)
    assert found.cost == pytest.approx(4000.0 * rate, rel=1e-3)
