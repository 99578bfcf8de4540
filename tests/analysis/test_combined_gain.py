"""The figure of merit: what a combined design can gain, before it is computed, against what it does gain."""

from __future__ import annotations

import dataclasses
from functools import cache

import casadi as ca
import nonlinear_loop as loop
import numpy as np
import pytest
from problems import graded, lag, solve, unassessed
from refusals import refused

import covocp as co
from covocp.models import mars_entry, unknown_lag

GRID = graded(60)


@cache
def estimated(variance):
    """6.12 for a variance of its time constant: the estimate, and the true relative gain."""
    problem = unknown_lag.steering(parameter_variance=variance)
    options = {"grid": GRID, "substeps": 4}  # both nominals by the same steps: the smallest gain is 3e-6
    found = co.worth(problem, **options)
    best = solve(problem, guess=found.classical, tolerance=1e-10, **options)
    return found, 1 - best.cost / found.classical.cost


@pytest.mark.parametrize(("variance", "size"), [(5.0, 0.19), (1.0, 0.02), (0.1, 2.9e-4), (0.01, 3.03e-6)])
def test_estimated_gain_of_6_12(variance, size):
    """Over five orders of magnitude: a lower estimate, and at least nine tenths of the truth."""
    found, true = estimated(variance)
    assert true == pytest.approx(size, rel=0.05)
    assert 0.9 * true < found.gain < 1.0001 * true
    assert found.classical.cost == pytest.approx(solve_classical(variance).cost, rel=1e-5)


@cache
def solve_classical(variance):
    return solve(unknown_lag.steering(parameter_variance=variance), grid=GRID, nominal="deterministic")


def test_small_gains_are_half_the_first_order_change():
    """Where the cost is quadratic along the gradient, with the curvature of L, at the full step."""
    found, true = estimated(0.1)
    assert found.step == 1.0
    assert found.gain == pytest.approx(found.first_order / 2, rel=0.05)
    assert true == pytest.approx(found.first_order / 2, rel=0.05)


@pytest.mark.parametrize(
    ("variance", "verdict"), [(5.0, "worth solving: at least 1"), (0.1, "little to gain"), (0.01, "nothing to gain")]
)
def test_verdict(variance, verdict):
    found, _ = estimated(variance)
    assert found.verdict.startswith(verdict)
    text = str(found)
    assert found.verdict in " ".join(text.split())
    assert f"{found.classical.cost:.8g}" in text


def linear_quadratic(size=1):
    ocp = co.Problem(3.0, name="linear quadratic")
    x, u = ocp.state("x", 2, initial=[1.0, 0.0], variance=1.0), ocp.control("u", size)
    ocp.dynamics(x, ca.vertcat(x[1], ca.sum1(u)), noise=[0.0, 1.0])
    ocp.measurement("m", x[0], noise=1.0)
    ocp.minimize_expected(running=0.5 * ca.dot(u, u) + ca.dot(x, x) + 0.3 * x[0] * u[0], terminal=ca.dot(x, x))
    return ocp


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_nothing_where_nominal_and_statistics_separate(control):
    """Case 4; what is left is the tolerance of the deterministic solution, squared."""
    found = co.worth(linear_quadratic(), intervals=40, control=control)
    assert found.first_order < 1e-8
    assert found.gain < 1e-8
    assert "separate" in found.verdict


# --- first order ------------------------------------------------------------------------------------------------------


def along(problem, found, step):
    nominal, offset = {}, 0
    for block in found.classical.statement.controls:
        values = found.classical[block.name].reshape(-1, block.size)
        nominal[block.name] = values + step * found.direction[:, offset : offset + block.size]
        offset += block.size
    mesh = found.classical.mesh
    return co.evaluate(problem, nominal=nominal, grid=mesh.nodes, substeps=mesh.substeps).cost


@pytest.mark.parametrize(
    "problem", [loop.problem(), loop.problem(curved=False, terminal_weight={"r": 0.5}), linear_quadratic(2)]
)
@pytest.mark.parametrize("nominal", [None, lambda s: 0.3 * np.cos(4 * s)])
def test_first_order_change_is_the_slope_along_the_direction(problem, nominal):
    """By differences of the evaluated cost; along a given nominal its deterministic slope is part of it."""
    given = None
    if nominal is not None:
        given = {c.name: lambda s, n=c.size: np.tile(nominal(s)[:, None], (1, n)) for c in problem.controls}
    found = co.worth(problem, nominal=given, intervals=20, substeps=2)
    h = 1e-3 if found.first_order > 1e-6 else 1.0
    slope = (along(problem, found, -h) - along(problem, found, h)) / (2 * h) / found.classical.cost
    assert found.first_order == pytest.approx(slope, rel=1e-4, abs=1e-9)
    taken = 1 - along(problem, found, found.step) / found.classical.cost
    assert found.gain == pytest.approx(taken, rel=1e-6, abs=1e-10)


def pendulum():
    """Its terminal condition is not linear in the control."""
    ocp = co.Problem(2.0, name="pendulum")
    x = ocp.state("x", 2, initial=[0.0, 0.0], final=[2.5, None], variance=0.1)
    k = ocp.unknown("k", mean=2.0, variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], -k * ca.sin(x[0]) + u), noise=[0.0, 0.2])
    ocp.measurement("m", x[0], noise=0.1)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: [4.0, 0.0]})
    return ocp


def test_the_step_keeps_terminal_conditions_to_first_order():
    """Half the step misses a quarter of what the whole one does; what it misses is counted with its multiplier."""
    ocp, options = pendulum(), {"intervals": 30, "substeps": 4}
    found = co.worth(ocp, **options)
    missed = []
    for step in (0.0, 0.1, 0.05):
        nominal = {"u": found.classical["u"] + step * found.direction[:, 0]}
        moved = co.evaluate(ocp, nominal=nominal, **options)
        missed.append(moved["x"][-1, 0] - found.classical["x"][-1, 0])
    assert missed[0] == 0
    assert missed[1] / missed[2] == pytest.approx(4.0, rel=0.05)
    assert abs(missed[1]) > 1e-6
    true = 1 - unassessed(ocp, guess=found.classical, **options).cost / found.classical.cost
    assert true > 0.05
    assert 0.9 * true < found.gain < true  # three quarters without the multiplier


def test_the_step_stays_within_bounds():
    """Where the classical control is at a bound, the direction does not lead out."""
    ocp = co.Problem(3.0, name="bounded")
    x = ocp.state("x", initial=0.0, variance=1.0)
    b = ocp.unknown("b", mean=0.5, variance=0.5)
    u = ocp.control("u", lower=-0.1, upper=0.8)
    ocp.dynamics(x, -b * x + u, noise=0.5)
    ocp.measurement("m", x, noise=0.5)
    ocp.minimize_expected(running=0.5 * u**2 + 2 * (x - 1) ** 2)
    found = co.worth(ocp, intervals=30)
    at_upper = found.classical["u"] > 0.8 - 1e-6
    assert at_upper.any()
    assert (found.direction[at_upper] <= 1e-12).all()
    assert found.gain <= 1 - unassessed(ocp, intervals=30).cost / found.classical.cost + 1e-8


def test_without_curvature_the_step_is_as_long_as_the_scale_of_the_control():
    """Mars: L has no curvature by the control without regularization; with it, its weight is small."""
    for regularization in (1e-5, None):
        problem = mars_entry.problem(regularization=regularization)
        found = co.worth(problem, nominal=mars_entry.reference(), intervals=61)
        assert 0.05 < found.gain < 0.47  # what is gained: 12 % and 47 %
        assert found.verdict.startswith("worth solving")
    assert np.abs(found.direction).max() == pytest.approx(0.5, rel=1e-9)  # half the range of the bounds


@pytest.mark.parametrize("bound", [1.3, 1.6])
def test_what_is_promised_can_be_had_within_the_bounds(bound):
    """A step cut at the bounds misses the end by a quarter: to first order 14 % were promised, where 5 % can be had."""
    ocp = co.Problem(duration=10.0)
    x, b = ocp.state("x", initial=0.0, final=1.0), ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u", lower=-bound, upper=bound)
    ocp.dynamics(x, u - b * x)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 2.0})
    found = co.worth(ocp)
    best = co.solve(ocp, guess=found.classical, progress=False)
    saved = 1.0 - best.cost / found.classical.cost
    assert 0.25 * saved <= found.gain <= saved * (1 + 1e-6)


# --- bad input --------------------------------------------------------------------------------------------------------


def without_deterministic_cost():
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize_expected(control_weight={u: 1.0}, terminal_weight={x: 1.0})
    return ocp


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (lambda: co.worth(3.0), ["3.0", "worth(problem)"]),
        (lambda: co.worth(co.evaluate(linear_quadratic(), nominal={"u": 0.0})), ["worth(problem)"]),
        (lambda: co.worth(lag().problem), ["minimize_expected()", "minimize()"]),
        (lambda: co.worth(loop.problem(gain=co.Gain())), ["best gain", "a constrained gain"]),
        (lambda: co.worth(without_deterministic_cost()), ["depends on nothing", "nominal="]),
        (lambda: co.worth(linear_quadratic(), subtseps=3), ["subtseps"]),
        (lambda: co.worth(linear_quadratic(), nominal={"w": 0.0}), ["w"]),
    ],
)
def test_bad_input(call, parts):
    refused(call, *parts)


def test_without_a_deterministic_cost_a_nominal_is_given():
    found = co.worth(without_deterministic_cost(), nominal={"u": 0.2}, intervals=5)
    assert found.gain == 0.0  # a linear system: no nominal is better than another
    assert found.verdict.startswith("nothing to gain")


def test_along_a_solution_its_mesh_is_kept_where_no_other_is_asked_for():
    problem = linear_quadratic(2)
    best = co.solve(problem, intervals=14, progress=False)
    assert co.worth(problem, nominal=best).classical.mesh.intervals == best.mesh.intervals
    assert co.worth(problem, nominal=best, intervals=21).classical.mesh.intervals != best.mesh.intervals


# --- no classical design ----------------------------------------------------------------------------------------------


def blowing_up():
    """x' = x^2 + u from 1: without control x = 1 / (1 - t), which has no value at t = 1."""
    ocp = co.Problem(2.0, name="blow")
    x, u = ocp.state("x", initial=1.0, variance=0.01), ocp.control("u", guess=-1.5)
    ocp.dynamics(x, x**2 + u, noise=0.01)
    ocp.measurement("m", x, noise=0.01)
    ocp.minimize_expected(running=u**2 + x**2, terminal=x**2)
    return ocp


@pytest.mark.filterwarnings("error")
def test_along_a_nominal_that_blows_up_there_is_nothing_to_compare_with():
    evaluated = co.evaluate(blowing_up(), nominal={"u": 0.0})
    assert np.isnan(evaluated.cost)
    for nominal in ({"u": 0.0}, evaluated):
        with pytest.raises(co.SolveError, match=r"classical design of 'blow'.*none.*becomes NaN or inf") as caught:
            co.worth(blowing_up(), nominal=nominal)
        assert not caught.value.solution.converged
    assert co.worth(blowing_up(), nominal={"u": -1.5}, intervals=20).gain > 0  # finite: x stays below sqrt(1.5)


def test_no_verdict_where_a_figure_is_no_number():
    found = co.worth(without_deterministic_cost(), nominal={"u": 0.2}, intervals=5)
    for changed in ({"gain": np.nan}, {"first_order": np.nan}, {"first_order": np.inf}):
        assert dataclasses.replace(found, **changed).verdict == "not known: the figures are no numbers"
