"""Conditions on the covariance of the closed loop, solved: steering of covariances, margins, walls, costs, files."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from problems import unassessed
from scipy.stats import norm
from spreads import TIME, double_integrator, ellipse, ellipse_by_duality, margin, wall

import covocp as co

RUNS = 20_000
NOMINAL = 6.0 / TIME**3  # of a double integrator from 1 to 0, at rest at both ends
KEPT = 1.0 - norm.cdf(3.0)


def interval(share: float, runs: int) -> float:
    """Half the width of the interval of 99.73 % about a share."""
    return 3.0 * math.sqrt(share * (1.0 - share) / runs)


@cache
def solved_wall() -> tuple[co.Problem, co.Solution]:
    ocp, _ = wall()
    return ocp, co.solve(ocp, intervals=60, progress=False)


# --- conditions -------------------------------------------------------------------------------------------------------


def test_wall_is_crossed_as_often_as_three_deviations_say():
    _, solution = solved_wall()
    deviation = solution.deviation("x")
    assert np.max(solution["x"] + 3 * deviation) == pytest.approx(2.0, abs=1e-5)
    assert solution.cost == pytest.approx(
        15.0331, abs=2e-4
    )  # of Xhat and gain stated by hand, 15.033116 on 60 intervals
    runs = co.simulate(solution, runs=RUNS, seed=1, progress=False)
    place = [row.name for row in runs.inequalities.rows].index("wall")
    k = int(np.argmax(solution["x"] + 3 * deviation > 2.0 - 1e-5))  # where it first comes close
    j = int(np.argmin(np.abs(runs.t - solution.t[k])))
    assert runs.promised[j, place] == pytest.approx(KEPT, rel=0.05)
    near = runs.promised[:, place] > 0.9 * KEPT
    assert near.sum() >= 5
    shares = runs.violating[near, place]
    assert abs(shares.mean() - KEPT) < interval(KEPT, RUNS)


def test_wall_in_other_meshes():
    costs = [unassessed(wall()[0], intervals=n).cost for n in (33, 45)]
    assert np.ptp(costs) < 1e-3


@pytest.mark.parametrize("limits", [(0.15, 0.05), (0.02, 0.05)])
def test_terminal_ellipse_costs_what_duality_says(limits):
    fed, weights = ellipse_by_duality(limits)
    solution = unassessed(ellipse(limits), intervals=80)
    assert solution.cost == pytest.approx(NOMINAL + fed, rel=2e-4)
    assert solution.cost >= (NOMINAL + fed) * (1 - 1e-5)
    final = np.diagonal(solution.covariance("x")[-1:], axis1=1, axis2=2)[0, 0]
    assert final <= limits[0] * (1 + 1e-5)  # by a step of its own
    active = weights > 1e-3  # the multipliers are half the weights of the end, in units of the limits
    assert 2 * (solution.multipliers.end / limits)[active] == pytest.approx(weights[active], rel=2e-2)


def test_terminal_ellipse_in_other_units():
    costs = [unassessed(ellipse((0.03, 0.05), unit=unit), intervals=40).cost for unit in (1.0, 1e-4)]
    assert costs[1] == pytest.approx(1e-8 * costs[0], rel=1e-5)


def test_margin_of_the_actuator_is_kept_in_simulation():
    solution = co.solve(margin(0.75), intervals=60, progress=False)
    runs = co.simulate(solution, runs=RUNS, seed=2, progress=False)
    u, spread = (
        solution["u"],
        np.sqrt(np.einsum("kui,kij,kuj->k", solution.gains["C"], solution.loop.Xhat, solution.gains["C"])),
    )
    assert np.max(np.abs(u) + 3 * spread) == pytest.approx(0.75, abs=1e-4)
    assert np.max(runs.violating) < KEPT + interval(KEPT, RUNS)
    assert np.max(runs.violating) > 0.3 * KEPT  # the margin is used


def test_margin_that_leaves_the_feedback_nothing():
    tight = [unassessed(margin(0.6, smallest=s), intervals=30).cost for s in (1e-3, 1e-4)]
    assert tight[0] == pytest.approx(tight[1], rel=1e-4)


def test_condition_that_does_not_bind_leaves_the_best_gain():
    ocp, x, _ = double_integrator(miss=2.0)
    best = unassessed(ocp, intervals=30)
    X = ocp.closed_loop_covariance()
    ocp.subject_to(X[x, x], upper=10.0, name="loose")
    free = co.solve(ocp, intervals=30, progress=False)
    assert free.cost == pytest.approx(best.cost, rel=1e-5)
    inner = slice(3, -1)  # at the start nothing is estimated yet: there the gain is of no consequence
    assert free.gains["C"][inner] == pytest.approx(best.gains["C"][inner], abs=0.05 * np.abs(best.gains["C"]).max())
    assert "X is in 'loose'" in str(free)


def test_the_gradient_method_agrees():
    problem = ellipse((0.15, 0.2))
    ipopt, gradient = (unassessed(problem, method, intervals=30).cost for method in ("ipopt", "gradient"))
    assert gradient == pytest.approx(ipopt, rel=1e-6)


def test_condition_with_a_parameter_is_that_with_its_number():
    ocp, x, _ = double_integrator(miss=1.0)
    limit = ocp.parameter("limit", 0.08)
    X = ocp.closed_loop_covariance()
    ocp.subject_to(X[x, x] / limit, upper=1.0, at="final", name="end")
    solver = co.Solver(ocp, intervals=30)
    for value in (0.08, 0.03):
        solution = solver.solve({"limit": value}, progress=False, assess=False)
        assert solution.covariance("x")[-1, 0, 0] == pytest.approx(value, rel=1e-4)


def test_constant_gain_meets_a_condition_and_costs_more_than_a_free_one():
    costs = []
    for gain in (None, co.Gain(constant=True, lower=-5.0, upper=5.0)):
        ocp, x, u = double_integrator(miss=1.0)
        X = ocp.closed_loop_covariance()
        ocp = co.Problem.of(replace(ocp.declarations, expected=replace(ocp.expected, gain=gain)))
        ocp.subject_to(X[x, x] / 0.08, upper=1.0, at="final", name="end")
        solution = unassessed(ocp, intervals=30)
        assert solution.covariance("x")[-1, 0, 0] <= 0.08 * (1 + 1e-4)
        costs.append(solution.cost)
    assert np.ptp(solution.gains["C"], axis=0).max() < 1e-9
    assert costs[1] > costs[0]


def test_nominal_of_the_best_gain_is_evaluated_with_its_gain():
    """The gain is linear between the nodes there: what that changes is of second order in their distance."""
    missed = []
    for intervals in (20, 40):
        best = unassessed(double_integrator(miss=1.0)[0], intervals=intervals)
        ocp, x, _ = double_integrator(miss=1.0)
        X = ocp.closed_loop_covariance()
        ocp.subject_to(X[x, x] / 0.03, upper=1.0, at="final", name="end")
        along = co.evaluate(ocp, nominal=best)
        assert along.cost == pytest.approx(best.cost, rel=1e-4)
        beyond = best.covariance("x")[-1, 0, 0] / 0.03 - 1.0
        missed.append(along.violations["end"] / beyond - 1.0)
    assert missed[0] < 1e-2
    assert missed[0] / missed[1] == pytest.approx(4.0, rel=0.1)


# --- costs ------------------------------------------------------------------------------------------------------------


def test_linear_costs_of_the_spread_are_weights():
    """The same problem, with weights in place of terms of X."""

    def lag(weighted: bool) -> co.Solution:
        ocp = co.Problem(5.0, "lag")
        x, u = ocp.state("x", initial=0.0, final=1.0, variance=1.0), ocp.control("u")
        ocp.dynamics(x, -0.2 * x + u, noise=0.1)
        ocp.measurement("m", x, noise=0.1)
        X = ocp.closed_loop_covariance()
        running, terminal, weights = 0.5 * u**2, 0.0, {"terminal_weight": {x: 3.0}, "control_weight": {u: 2.0}}
        if weighted:
            running, terminal, weights = running + X[u, u] / 2, 1.5 * X[x, x], {"terminal_weight": {x: 0.0}}
        ocp.minimize_expected(running=running, terminal=terminal, **weights)
        assert ("the best one" in str(ocp)) is True
        return unassessed(ocp, intervals=40)

    by_terms, by_weights = lag(True), lag(False)
    assert by_terms.cost == pytest.approx(by_weights.cost, rel=1e-9)
    assert by_terms.gains["C"] == pytest.approx(by_weights.gains["C"], rel=1e-6)


def nonlinear(limit: float | None, power: float) -> co.Problem:
    ocp = co.Problem(5.0, "lag")
    x, u = ocp.state("x", initial=0.0, final=1.0, variance=1.0), ocp.control("u")
    ocp.dynamics(x, -0.2 * x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    X = ocp.closed_loop_covariance()
    terminal = power * ca.log(X[x, x]) if limit is None else 0.0
    ocp.minimize_expected(running=0.5 * u**2, terminal=terminal, terminal_weight={x: 0.0})
    if limit is not None:
        ocp.subject_to(X[x, x], upper=limit, at="final", name="end")
    return ocp


def test_nonlinear_cost_and_condition_are_two_sides_of_one_optimum():
    """With k log X(T) as cost and X(T) = v as its outcome, the least cost under X(T) <= v has the multiplier k / v."""
    power = 0.3
    free = co.solve(nonlinear(None, power), intervals=60, progress=False)
    reached = float(free.covariance("x")[-1, 0, 0])
    bound = unassessed(nonlinear(reached, power), intervals=60)
    assert bound.multipliers.end[0] == pytest.approx(power / reached, rel=1e-3)
    assert free.cost_terms["covariances"] == pytest.approx(power * math.log(reached), rel=1e-6)
    assert free.cost - free.cost_terms["covariances"] == pytest.approx(bound.cost, rel=1e-5)
    assert free.optimality.cost_identity < 1e-4


# --- what is done with it ---------------------------------------------------------------------------------------------


def test_evaluate_simulate_files_and_expressions(tmp_path):
    ocp, solution = solved_wall()
    again = co.evaluate(ocp, nominal=solution)
    assert again.cost == pytest.approx(solution.cost, rel=1e-6)
    assert again.violations.get("wall", 0.0) < 1e-3
    for kind in ("npz", "json"):
        read = co.load(solution.save(tmp_path / f"wall.{kind}"), ocp)
        assert read.cost == solution.cost
        assert "X is in 'wall'" in str(read)
    other = co.evaluate(solution, truth={})
    assert sum(other.cost_terms.values()) == pytest.approx(solution.cost, rel=1e-6)


def test_expressions_of_the_spread_along_a_solution():
    ocp, x, u = double_integrator(miss=2.0)
    X = ocp.closed_loop_covariance()
    ocp.subject_to(X.deviation(u), upper=0.3, name="spread")
    solution = co.solve(ocp, intervals=40, progress=False)
    C, Xhat = solution.gains["C"], solution.loop.Xhat
    assert solution[X[x, x]] == pytest.approx(solution.loop.X[:, 0, 0], rel=1e-4)
    assert solution[X[u, u]][1:] == pytest.approx(np.einsum("kui,kij,kuj->k", C, Xhat, C)[1:], rel=1e-3)
    assert solution[X[x, u]][1:] == pytest.approx(-np.einsum("kij,kuj->ki", Xhat, C)[1:, 0], rel=1e-3, abs=1e-6)


def test_exported_controller_is_the_one_of_python(tmp_path):
    _, solution = solved_wall()
    package = co.export_c(solution, tmp_path / "wall_c")
    package.build()
    assert package.check(samples=100).ok


# --- what is refused, and what is said --------------------------------------------------------------------------------


def test_filter_error_in_a_condition_of_a_closed_loop_is_warned_about():
    ocp, x, _ = double_integrator(miss=2.0)
    E = ocp.estimation_covariance()
    ocp.subject_to(x + 3 * ca.sqrt(E[x, x]), upper=5.0, name="wall")
    with pytest.warns(co.CovocpWarning, match=r"'wall' contains E.*closed_loop_covariance\(\)"):
        co.solve(ocp, intervals=20, progress=False)


def test_classical_design_and_worth_refuse_conditions_on_the_spread():
    ocp, _ = wall()
    for call in (lambda: co.solve(ocp, nominal="deterministic", progress=False), lambda: co.worth(ocp)):
        with pytest.raises(co.ProblemError, match="X in 'wall'"):
            call()
