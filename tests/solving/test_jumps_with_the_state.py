"""Jumps of the model with the state: a solution that meets one is told, and its curvature is not known.

Closed forms: with constant speeds on both sides, times t and T - t, x' = 2u below and u above costs 1/(4t) + 1/(T - t),
least at t = 2/3 for T = 2: 9/8. The toll costs 1/t + 1/(2 - t) + 5 (2 - t).
"""

from __future__ import annotations

import re
import warnings

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import covocp as co

JUMPS = r"jumps with the state"
KNOTS = np.linspace(-2.0, 2.0, 9)


def moved(rate, cost=lambda x, u: 0.0, **ends):
    """x' = rate with the least energy and another cost."""
    ocp = co.Problem(2.0, name="moved")
    x = ocp.state("x", **{"initial": -1.0, "final": 1.0, **ends})
    u = ocp.control("u")
    ocp.dynamics(x, rate(x, u))
    ocp.minimize(running=u**2 + cost(x, u))
    return ocp


def two_speeds(x, u):
    return ca.if_else(x > 0, u, 2 * u)


def toll_zone():
    return moved(lambda x, u: u, lambda x, u: ca.if_else(x > 1, 5.0, 0.0), initial=0.0, final=2.0)


def sensor_zone():
    ocp = co.Problem(4.0, name="zone")
    x = ocp.state("x", initial=-1.0, final=1.0, variance=1.0)
    u = ocp.control("u", lower=-3, upper=3)
    ocp.dynamics(x, u, noise=0.2)
    ocp.measurement("y", x, noise=ca.if_else(ca.fabs(x) < 0.3, 0.02, 0.5))
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.1 * u**2 + E[x, x])
    return ocp


def two_media():
    ocp = co.Problem(3.0, name="two media")
    x, v = ocp.state("x", initial=0.0, final=2.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - ca.if_else(x > 1, 3.0 * v, 0.1 * v))
    ocp.minimize(running=u**2)
    return ocp


def told(make, **options):
    """The solution, and what is said of it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solution = co.solve(make() if callable(make) else make, progress=False, **options)
    return solution, [str(entry.message) for entry in caught]


@pytest.mark.parametrize("method", ["auto", "gradient"])
@pytest.mark.parametrize(
    ("make", "what"),
    [
        (
            lambda: moved(two_speeds),
            r"0.40\d* s the solution crosses the border of 'x > 0', where the rate of 'x' jumps by 50 %",
        ),
        (toll_zone, r"1 s the .* of 'x > 1', where the running cost jumps by 83.3 %"),
        (sensor_zone, r"1.4, 2.6 s the .*'fabs\(x\) < 0.3', where the rate of 'E\[x, x\]' jumps by 9\d\.?\d* %"),
        (two_media, r"0.929\d* s the .*'x > 1', where the rate of 'v' jumps"),
    ],
)
def test_a_jump_that_is_crossed_is_told_alone(make, what, method):
    solution, said = told(make, method=method)
    (only,) = said
    assert "Phases" in only
    assert "tanh" in only
    assert re.search(f"{JUMPS}: at t = {what}", only)
    assert np.isnan(solution.optimality.curvature)
    assert "minimum" not in str(solution).replace("\n", " ").partition("necessary conditions")[2]
    assert "NOT KNOWN" in str(solution)


def test_more_intervals_do_not_silence_it():
    for intervals in (100, 400):
        assert [JUMPS in text for text in told(sensor_zone, intervals=intervals)[1]] == [True]


def test_it_is_told_in_every_solve_that_looks():
    solver = co.Solver(moved(two_speeds), intervals=30)
    for _ in range(2):
        with pytest.warns(co.CovocpWarning, match=JUMPS):
            solver.solve(progress=False)


@pytest.mark.parametrize(
    "rate",
    [
        lambda x, u: u * (1.5 - 0.5 * ca.sign(x)),
        lambda x, u: u * (1 - ca.floor(x)) + u * ca.floor(x / 2),
        lambda x, u: ca.if_else(x > 0, u, 2 * u, True),
        lambda x, u: u * (2 - ca.logic_and(x > 0, x < 3)),
    ],
)
def test_all_kinds_of_jumps_are_seen(rate):
    assert any(JUMPS in text for text in told(lambda: moved(rate), intervals=40)[1])


def solved_for(value):
    """A value by way of a linear system that is no scalar operation."""
    matrix = ca.blockcat([[2.0, 1.0], [1.0, 3.0 + 0.1 * value**2]])
    return ca.solve(matrix, matrix @ ca.vertcat(value, 0.0), "lapacklu")[0]


def test_a_jump_in_what_cannot_be_read_is_seen_by_numbers():
    _, said = told(lambda: moved(lambda x, u: solved_for(two_speeds(x, u))), intervals=40)
    assert any(f"{JUMPS}: at t = 0.4" in text and "the border of a comparison" in text for text in said)
    _, said = told(lambda: moved(lambda x, u: solved_for(u + ca.if_else(x > 0, x, -2 * x))), intervals=40)
    assert not any(JUMPS in text for text in said)


@pytest.mark.parametrize(("knots", "named"), [(9, r"'x < -?[\d.]+'"), (101, "a knot of a table")])
def test_slopes_of_linear_tables_jump_in_the_rates_of_covariances(knots, named):
    """With 101 knots such a point costs 1.3 % more than the controls for the cubic table do."""
    places = np.linspace(-2.0, 2.0, knots)

    def made(kind):
        ocp = co.Problem(2.0, name="table")
        x = ocp.state("x", initial=-1.0, final=1.0, variance=0.3)
        u = ocp.control("u")
        values = np.sin(2 * places) + 0.2 * places**2
        ocp.dynamics(x, u + co.table("t", places, values, kind=kind)(x), noise=0.1)
        ocp.measurement("m", x, noise=0.2)
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2 + E[x, x])
        return ocp

    assert any(re.search(f"{JUMPS}: .*{named}.* 'E\\[x, x\\]' jumps", text) for text in told(made("linear"))[1])
    assert not any(JUMPS in text for text in told(made("cubic"))[1])


def test_a_jump_beside_a_spline_is_seen():
    spline = ca.interpolant("spline", "bspline", [list(KNOTS)], list(np.sin(KNOTS)))
    _, said = told(lambda: moved(lambda x, u: two_speeds(x, u) + 0.1 * spline(x)), intervals=40)
    assert any("'x > 0'" in text for text in said)
    _, said = told(lambda: moved(lambda x, u: u + 0.1 * spline(x)), intervals=40)
    assert not any(JUMPS in text for text in said)


@pytest.mark.parametrize(
    ("rate", "cost"),
    [
        (lambda x, u: u + ca.fabs(x) - ca.fmax(x, 0), lambda x, u: 0.0),
        (lambda x, u: u + ca.if_else(x > 0, x, -2 * x), lambda x, u: ca.if_else(x > 0.5, (x - 0.5) ** 2, 0.0)),
        (lambda x, u: u + co.table("bent", KNOTS, KNOTS**2)(x), lambda x, u: 0.0),
        (lambda x, u: u + co.table("curved", KNOTS, KNOTS**2, kind="cubic")(x), lambda x, u: ca.fabs(u)),
        (lambda x, u: u, lambda x, u: ca.if_else(x > 1.5, 5.0, 0.0)),
        (lambda x, u: ca.if_else(x > 1.5, 3 * u, u), lambda x, u: 0.0),
    ],
)
def test_kinks_and_what_is_not_crossed_are_no_jumps(rate, cost):
    solution, said = told(lambda: moved(rate, cost))
    assert not any(JUMPS in text for text in said)
    assert solution.optimality.curvature is not None
    assert solution.optimality.curvature > 0


def test_a_given_end_on_the_border_is_not_crossed():
    """Rest to rest with dry friction: u = 1/2 + (3/2)(1 - t) in mean square, 3/2 + 1/2."""
    ocp = co.Problem(2.0, name="friction")
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.5 * ca.sign(v))
    ocp.minimize(running=u**2)
    solution, said = told(ocp)
    assert not any(JUMPS in text for text in said)
    assert solution.cost == pytest.approx(2.0, rel=1e-4)


def test_a_border_that_is_touched_is_told():
    """The least energy from 1 to 1 by way of 0, where it turns, on the border of x < 0."""
    ocp = moved(lambda x, u: ca.if_else(x < 0, u - 1, u), initial=1.0, final=1.0)
    ocp.subject_to(ocp.declarations.states[0].symbol, lower=0.0, upper=0.0, at=1.0)
    _, said = told(ocp)
    assert any("reaches the border of 'x < 0'" in text for text in said)


def test_what_nothing_chosen_moves_jumps_at_a_given_time():
    """x' = g u with g = 1 until c = 1, then 2: the energy is 1/int g^2 = 1/5."""
    ocp = co.Problem(2.0, name="clock")
    x, c = ocp.state("x", initial=0.0, final=1.0), ocp.state("c", initial=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, u * ca.if_else(c > 1.0, 2.0, 1.0))
    ocp.dynamics(c, 1.0)
    ocp.minimize(running=u**2)
    solution, said = told(ocp, intervals=400)
    assert not any(JUMPS in text for text in said)
    assert solution.cost == pytest.approx(0.2, rel=5e-3)


def test_what_costs_nothing_may_jump():
    ocp = moved(lambda x, u: u)
    counter = ocp.state("counter", initial=0.0)
    ocp.dynamics(counter, ca.if_else(ocp.declarations.states[0].symbol > 0, 1.0, 0.0))
    solution, said = told(ocp)
    assert not said
    assert solution.optimality.curvature > 0


def expected(running):
    ocp = co.Problem(2.0, name="expected")
    x = ocp.state("x", initial=-1.0, variance=0.1)
    u = ocp.control("u")
    ocp.dynamics(x, two_speeds(x, u), noise=0.05) if running is None else ocp.dynamics(x, u, noise=0.05)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=u**2 + (0.0 if running is None else running(x)), terminal=3 * (x - 1) ** 2)
    return ocp


def test_expected_costs_are_told_once():
    for nominal in ("combined", "deterministic"):
        _, said = told(lambda: expected(None), intervals=40, nominal=nominal)
        assert sum(JUMPS in text for text in said) == 1
    solution, said = told(lambda: expected(lambda x: ca.if_else(x > 0, 1.0, 0.0)), intervals=40)
    assert sum("kinks or jumps in 'x'" in text for text in said) == 1
    assert not any(JUMPS in text for text in said)
    assert np.isnan(solution.optimality.curvature)


def side(name, start, end, gain, toll, clock):
    """One side of a border, on which nothing jumps; a clock keeps the whole time."""
    ocp = co.Problem(co.Free(1.0, 0.1, 2.0), name=name)
    x, t = ocp.state("x", initial=start, final=end), ocp.state("clock", initial=clock[0], final=clock[1])
    u = ocp.control("u", guess=0.5)
    ocp.dynamics(x, gain * u)
    ocp.dynamics(t, 1.0)
    ocp.minimize(running=u**2 + toll)
    return ocp


def test_phases_find_the_optimum_without_a_word():
    toll = minimize_scalar(lambda t: 1 / t + 1 / (2 - t) + 5 * (2 - t), bounds=(0.5, 1.9), method="bounded").fun
    for costs, gains, places, exact in (
        ((0.0, 0.0), (2.0, 1.0), (-1.0, 0.0, 1.0), 1.125),
        ((0.0, 5.0), (1.0, 1.0), (0.0, 1.0, 2.0), toll),
    ):
        first = side("first", places[0], places[1], gains[0], costs[0], (0.0, None))
        second = side("second", None, places[2], gains[1], costs[1], (None, 2.0))
        solution, said = told(co.Phases([first, second], name="both sides"), intervals=20)
        assert said == []
        assert solution.cost == pytest.approx(exact, rel=1e-7)


def test_a_jump_within_a_phase_is_told_of_the_phase():
    first, second = (co.Problem(1.0, name=name) for name in ("first", "second"))
    for ocp, ends in ((first, (-1.0, None)), (second, (None, 1.0))):
        x = ocp.state("x", initial=ends[0], final=ends[1])
        u = ocp.control("u")
        ocp.dynamics(x, two_speeds(x, u))
        ocp.minimize(running=u**2)
    _, said = told(co.Phases([first, second], name="whole"), intervals=40)
    assert any(text.startswith("'first' jumps with the state") for text in said)


@pytest.mark.parametrize(("width", "within"), [(0.1, 0.03), (0.03, 0.01)])
def test_a_smooth_transition_comes_near(width, within):
    solution, said = told(lambda: moved(lambda x, u: (2 - (1 + ca.tanh(x / width)) / 2) * u))
    assert said == []
    assert solution.cost == pytest.approx(1.125, rel=within)
    assert solution.optimality.curvature > 0


def bang_bang():
    ocp = co.Problem(4.0, name="bang")
    x, v = ocp.state("x", initial=0.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u", lower=-1, upper=1)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=ca.if_else(u > 0, 0.1, 0.0) + 1e-3 * u**2, terminal=-x)
    return ocp


def test_a_control_that_jumps_over_a_border_is_no_crossing():
    """Half the time at each bound: -4 + 0.1 2 + 1e-3 4."""
    solution, said = told(bang_bang, intervals=50)
    assert not any(JUMPS in text for text in said)
    assert solution.cost == pytest.approx(-3.796, abs=1e-3)


def test_a_control_that_passes_a_border_smoothly_is_told():
    ocp = co.Problem(4.0, name="slow")
    x, v = ocp.state("x", initial=-1.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=u**2 + ca.if_else(u > 0, 0.1, 0.0))
    assert any("crosses the border of 'u > 0'" in text for text in told(ocp, intervals=50)[1])


def limited_speed(fine, *, bound):
    """The way of 3 in 4 s with a speed of at most 1 takes (16/9) of int u^2: v = 1 in the middle of 1.5, 1, 1.5 s."""
    ocp = co.Problem(4.0, name="limited")
    x = ocp.state("x", initial=0.0, final=3.0)
    v = ocp.state("v", initial=0.0, final=0.0, **({"upper": 1.0} if bound else {}))
    u = ocp.control("u", lower=-2, upper=2)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    if not bound:
        ocp.subject_to(v, upper=1.0)
    ocp.minimize(running=u**2 + ca.if_else(v > fine, 10.0, 0.0))
    return ocp


@pytest.mark.parametrize("bound", [True, False])
def test_a_side_that_is_forbidden_is_not_reached(bound):
    solution, said = told(limited_speed(1.0, bound=bound), intervals=50)
    assert not any(JUMPS in text for text in said)
    assert solution.cost == pytest.approx(16 / 9, rel=1e-4)
    assert solution.optimality.curvature > 0


@pytest.mark.parametrize("bound", [True, False])
def test_a_border_inside_a_limit_is_told(bound):
    assert any(JUMPS in text for text in told(limited_speed(0.9, bound=bound), intervals=50)[1])


@pytest.mark.parametrize("order", [5, 6])
def test_a_given_start_on_the_border_may_be_left_slowly(order):
    ocp = co.Problem(4.0, name="chain")
    x = ocp.state("x", order, initial=[0.0] * order, final=[1.0, *[0.0] * (order - 1)])
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1:], ca.if_else(x[0] > 0, 1.0, 1.2) * u))
    ocp.minimize(running=u**2)
    assert not any(JUMPS in text for text in told(ocp, intervals=50)[1])


def test_branch_cuts_of_angles_are_told():
    def angle(x):
        return ca.atan2(ca.sin(x), ca.cos(x))

    _, said = told(lambda: moved(lambda x, u: u + 0.3 * angle(x), initial=2.0, final=4.0), intervals=50)
    assert any("the border of 'atan2(sin(x), cos(x))'" in text for text in said)
    _, said = told(lambda: moved(lambda x, u: u + 0.3 * ca.sin(angle(x)), initial=2.0, final=4.0), intervals=50)
    assert not any(JUMPS in text for text in said)


def test_a_border_that_moves_with_the_time_is_no_bound():
    """x <= 1 and a fine while x > t: the path lies on both at t = 1 and crosses one of them."""
    ocp = co.Problem(2.0, name="stick")
    x, u = ocp.state("x", initial=0.0, upper=1.0), ocp.control("u", lower=-5, upper=5)
    ocp.dynamics(x, u)
    ocp.minimize(running=0.01 * u**2 - 0.1 * x + 0.5 * ca.if_else(x > ocp.time, 1.0, 0.0))
    with pytest.warns(co.CovocpWarning, match="jumps with the state"):
        co.solve(ocp, "ipopt", progress=False)
