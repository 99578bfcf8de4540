"""Meshes that refine themselves, against optima that are known apart from any mesh."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from problems import beside_switches, least_fuel
from scipy.integrate import quad

import covocp as co
from covocp.solving import refined_meshes, refining
from covocp.transcription import domain


def rest_to_rest(**control: Any) -> co.Problem:
    """A mass over a distance of 1 in the least time: T = 2, with a jump at 1."""
    ocp = co.Problem(duration=co.Free(guess=3.0), name="rest to rest")
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0, **control)
    ocp.dynamics(x, v)
    ocp.dynamics(v, ocp.control("u", lower=-1.0, upper=1.0))
    ocp.minimize(terminal=ocp.duration)
    return ocp


def layers(width: float = 0.01) -> co.Problem:
    """x' = u with int (x^2 + width^2 u^2)/2, x = 1 at both ends: width (coth(1/width) - 1/sinh(1/width))."""
    ocp = co.Problem(duration=1.0, name="layers")
    x, u = ocp.state("x", initial=1.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * (x**2 + width**2 * u**2))
    return ocp


def hypersensitive(duration: float) -> co.Problem:
    """Rao and Mease 2000."""
    ocp = co.Problem(duration=duration, name="hypersensitive")
    x, u = ocp.state("x", initial=1.0, final=1.5), ocp.control("u")
    ocp.dynamics(x, -(x**3) + u)
    ocp.minimize(running=0.5 * (x**2 + u**2))
    return ocp


def long_way() -> float:
    """Its cost: H = 0, so the costate is -x^3 + sqrt(x^6 + x^2) towards zero and x^3 + sqrt(...) away from it."""
    first = quad(lambda x: -(x**3) + np.sqrt(x**6 + x**2), 0.0, 1.0, epsabs=1e-13)[0]
    return float(first + quad(lambda x: x**3 + np.sqrt(x**6 + x**2), 0.0, 1.5, epsabs=1e-13)[0])


def lag(**unknown: Any) -> co.Problem:
    """The first-order lag of the first page."""
    ocp = co.Problem(duration=10.0, name="lag")
    x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
    b, u = ocp.unknown("b", mean=1.0, variance=5.0), ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=1.0)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=10.0 * E[b, b])
    return ocp


def closed_loop() -> co.Problem:
    """An unknown rate in a feedback loop."""
    ocp = co.Problem(duration=5.0, name="loop")
    x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
    b, u = ocp.unknown("b", mean=1.0, variance=0.5), ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=0.1)
    ocp.measurement("m", x, noise=1.0)
    ocp.minimize_expected(running=0.5 * (x**2 + u**2), terminal=5.0 * (x - 1) ** 2)
    return ocp


KNOWN = [
    pytest.param(rest_to_rest(), 2.0, {}, id="a jump"),
    pytest.param(rest_to_rest(), 2.0, {"control": "constant"}, id="a jump of a constant control"),
    pytest.param(rest_to_rest(upper=0.6), 0.6 + 1 / 0.6, {}, id="two jumps at a bound of a state"),
    pytest.param(layers(), 0.01 * (1 / np.tanh(100.0) - 1 / np.sinh(100.0)), {}, id="layers"),
]


@pytest.mark.parametrize(("problem", "optimum", "options"), KNOWN)
@pytest.mark.parametrize("asked", [1e-4, 1e-6])
def test_the_error_that_was_measured_bounds_the_true_one(problem, optimum, options, asked):
    solution = co.solve(problem, refine=asked, progress=False, **options)
    true, measured = abs(solution.cost / optimum - 1.0), solution.stats["mesh_errors"]
    assert true <= measured[-1] <= asked < min(measured[:-1], default=1.0)
    assert solution.stats["mesh_intervals"][-1] == solution.mesh.intervals
    assert len(measured) == len(solution.stats["mesh_intervals"])


def test_a_direction_of_unit_length_turns_within_the_intervals():
    """An equation along the path holds at the nodes: at the middles too it would keep the direction as it is."""

    def crossing(*, by_angle):
        ocp = co.Problem(co.Free(3.0, 0.5, 10.0), name="crossing")
        x, y = ocp.state("x", initial=0.0, final=2.0), ocp.state("y", initial=0.0, final=1.0)
        u = ocp.control("u", 1 if by_angle else 2, guess=0.5 if by_angle else [0.8, 0.6])
        along, across = (ca.cos(u), ca.sin(u)) if by_angle else (u[0], u[1])
        ocp.dynamics(x, along - 0.5 * y**2)
        ocp.dynamics(y, across)
        if not by_angle:
            ocp.subject_to(ca.sumsqr(u), equals=1.0, name="direction")
        ocp.minimize(terminal=ocp.duration)
        return ocp

    reference = co.solve(crossing(by_angle=True), intervals=60, progress=False)
    for options in ({"refine": 3e-5}, {"intervals": 50, "points": 2}):
        solution = co.solve(crossing(by_angle=False), progress=False, **options)
        assert abs(solution.cost / reference.cost - 1.0) <= 3e-5
    ocp = crossing(by_angle=True)
    with pytest.raises(co.ProblemError, match="is an equation, which cannot hold between the nodes"):
        ocp.subject_to(ocp.states[0].symbol, equals=1.0, between="auto")


def test_it_takes_a_third_of_the_nodes_of_equal_intervals():
    refined = co.solve(rest_to_rest(), refine=1e-6, progress=False)
    even = co.solve(rest_to_rest(), intervals=3 * refined.mesh.intervals, progress=False)
    assert abs(even.cost / 2.0 - 1.0) > 100 * abs(refined.cost / 2.0 - 1.0)


@pytest.mark.parametrize("duration", [30.0, 1e4])
def test_the_hypersensitive_problem(duration):
    solution = co.solve(hypersensitive(duration), refine=1e-6, progress=False)
    assert abs(solution.cost / long_way() - 1.0) <= solution.stats["mesh_errors"][-1] <= 1e-6
    assert solution.mesh.intervals < 150


def test_a_node_in_the_middle_of_a_jump_hides_nothing():
    """With nodes at 0.5 +- d halving alone changes nothing: a linear control is the same on both."""
    d = 0.01
    grid = [0.0, 0.25, 0.5 - d, 0.5 + d, 0.75, 1.0]
    coarse = co.solve(rest_to_rest(), grid=grid, progress=False)
    solution = co.solve(rest_to_rest(), grid=grid, refine=0.1, progress=False)
    assert np.array_equal(solution.mesh.nodes, grid)
    true = coarse.cost / 2.0 - 1.0
    assert true > 1e-5
    assert true <= solution.stats["mesh_errors"][0] <= 3 * true


@pytest.mark.parametrize("covariances", ["eliminated", "states"])
def test_covariances_in_both_formulations(covariances):
    refined = co.solve(lag(), refine=1e-5, covariances=covariances, progress=False)
    reference = co.solve(lag(), intervals=200, covariances=covariances, progress=False)
    assert abs(refined.cost / reference.cost - 1.0) <= refined.stats["mesh_errors"][-1] <= 1e-5
    assert refined.mesh.intervals < 60


def test_closed_loops_begin_from_their_graded_mesh():
    refined = co.solve(closed_loop(), refine=1e-5, progress=False)
    reference = co.solve(closed_loop(), intervals=200, progress=False)
    assert abs(refined.cost / reference.cost - 1.0) <= refined.stats["mesh_errors"][-1] <= 1e-5
    assert refined.stats["mesh_intervals"][0] > 16
    assert abs(refined.stats["classical_cost"] / reference.stats["classical_cost"] - 1.0) < 1e-4


def test_an_error_out_of_reach_is_told_with_what_was_reached():
    with pytest.warns(co.CovocpWarning, match=r"refine=1e-13 was asked.*is off by about") as told:
        solution = co.solve(rest_to_rest(), refine=1e-13, progress=False)
    best = min(solution.stats["mesh_errors"])
    assert f"{best:.2g}" in str(told[0].message)
    assert abs(solution.cost / 2.0 - 1.0) <= best
    assert "NOT REACHED" in str(solution)


def test_a_loose_tolerance_of_the_method_is_no_error_of_the_mesh_but_counts():
    with pytest.warns(co.CovocpWarning, match="tolerance of the method"):
        solution = co.solve(rest_to_rest(), refine=1e-6, tolerance=1e-5, progress=False)
    assert min(solution.stats["mesh_errors"]) >= 1e-5


def test_a_solver_refines_anew_for_each_parameter():
    ocp = co.Problem(duration=co.Free(guess=3.0), name="distance")
    far = ocp.parameter("far", 1.0)
    x, v = ocp.state("x", initial=0.0), ocp.state("v", initial=0.0, final=0.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, ocp.control("u", lower=-1.0, upper=1.0))
    ocp.subject_to(x - far, lower=0.0, at="final")
    ocp.minimize(terminal=ocp.duration)
    solver = co.Solver(ocp, refine=1e-5)
    costs = [solver.solve({"far": distance}, progress=False).cost for distance in (1.0, 4.0, 1.0)]
    assert costs == pytest.approx([2.0, 4.0, 2.0], rel=1e-5)
    assert costs[0] == costs[2]


def test_from_a_solution_and_by_the_gradient_method():
    plain = co.solve(layers(0.2), progress=False)
    exact = 0.2 * (1 / np.tanh(5.0) - 1 / np.sinh(5.0))
    for method, guess in (("ipopt", plain), ("gradient", None)):
        solution = co.solve(layers(0.2), method, refine=1e-5, guess=guess, progress=False)
        assert abs(solution.cost / exact - 1.0) <= solution.stats["mesh_errors"][-1] <= 1e-5


def test_comparisons_and_files_tell_the_meshes(tmp_path):
    comparison = co.compare(layers(0.2), refine=1e-4, progress=False)
    assert comparison.converged
    solution = comparison["ipopt"]
    for suffix in (".npz", ".json"):
        loaded = co.load(solution.save(tmp_path / f"refined{suffix}"))
        assert loaded.stats["mesh_errors"] == solution.stats["mesh_errors"]
        assert loaded.stats["mesh_intervals"] == solution.stats["mesh_intervals"]
        assert "refined: " in str(loaded)


def test_what_does_not_go_together_is_refused():
    with pytest.raises(co.ProblemError, match="nominal='deterministic'"):
        co.solve(closed_loop(), refine=1e-4, nominal="deterministic", progress=False)
    for wrong in (0, 1, -1e-3, True, "auto", float("nan")):
        with pytest.raises(co.ProblemError, match="'refine'"):
            co.solve(layers(), refine=wrong, progress=False)
    with pytest.raises(co.ProblemError, match="refine"):
        co.evaluate(layers(), nominal={"u": 0.0}, refine=1e-4)


def test_what_is_not_solved_is_not_returned():
    with pytest.raises(co.SolveError):
        co.solve(rest_to_rest(), refine=1e-4, max_iterations=1, progress=False)


def test_all_meshes_have_the_units_of_the_first_solution(monkeypatch):
    """What is asked once for all of them: units, and whether the model holds beyond its bounds."""
    asked = {"units": 0, "bounds": 0}

    def counted(name, function):
        def call(*given, **named):
            asked[name] += 1
            return function(*given, **named)

        return call

    monkeypatch.setattr(refining, "choose_scales", counted("units", refining.choose_scales))
    monkeypatch.setattr(domain, "holds", counted("bounds", domain.holds))
    solution = co.solve(rest_to_rest(), refine=1e-6, progress=False)
    assert len(solution.stats["mesh_intervals"]) > 2
    assert solution.cost == pytest.approx(2.0, rel=1e-6)
    assert asked == {"units": 1, "bounds": 2}  # beyond both bounds of the control


@pytest.mark.parametrize(("off", "ramp"), [(3e-4, 1e-4), (1e-3, 1e-4), (1e-3, 1e-5), (1e-4, 1e-5)])
def test_jumps_that_are_not_where_they_should_be_are_seen(off, ramp):
    """Half of the error was seen: meshes that only divide intervals do not move a jump that has nodes beside it."""
    (ocp, optimum), grid = least_fuel(), beside_switches(off, ramp)
    truth = co.solve(ocp, grid=grid, progress=False).cost / optimum - 1.0
    errors = co.solve(ocp, grid=grid, refine=1e-6, progress=False).stats["mesh_errors"]
    assert truth > 0.8 * off
    assert errors[0] / refined_meshes.LEFT > 0.9 * truth
    assert max(errors[1:]) < 0.1 * errors[0]


def measured(cost: float, error: float, intervals: int) -> Any:
    """A mesh that was measured, as far as the choice of the next one looks at it."""
    return SimpleNamespace(cost=cost, error=error, least=1e-9, intervals=(intervals,))


def test_a_mesh_is_not_made_coarser_while_that_is_not_much_better():
    begun = [measured(1.1, 0.1, 16)]
    assert refined_meshes._fewest(begun) == 0
    assert refined_meshes._fewest([*begun, measured(1.0, 1e-4, 21)]) == 0
    assert refined_meshes._fewest([*begun, measured(1.03, 0.03, 45)]) == 45
    assert refined_meshes._fewest([*begun, measured(1.03, 0.03, 45), measured(1.03, 0.025, 48)]) == 60


def test_the_cost_of_another_mesh_counts_against_an_estimate():
    """What another mesh finds for less, by more than its own error, is missed."""
    known = [(1.0, 1e-4), (1.02, 1e-5), (0.995, 1e-3)]
    assert refined_meshes._seen(measured(1.01, 1e-5, 20), known) == pytest.approx(0.015 / 0.995 - 1e-3)
    assert refined_meshes._seen(measured(0.995, 1e-5, 20), known) == 1e-5


@pytest.mark.parametrize(("error", "reason"), [(5e-9, "tolerance of the method"), (1e-4, "not where it is looked for")])
def test_why_no_further_mesh_is_tried(error, reason):
    """Errors far above what the tolerance leaves were called that all the same."""
    assert reason in refined_meshes._given_up([measured(1.0, error, 20)] * 5)
