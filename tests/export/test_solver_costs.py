"""The exported solver reaches the cost of the converged optimum: closed forms, and Ipopt with its tolerances tightened.

Ipopt as `solve` asks it widens bounds by 1e-8 and ends at 1e-7: of Bryson-Denham's cost that is 9e-8, more than what is
tested here.
"""

from dataclasses import replace
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER
from problems import unassessed

import covocp as co
from covocp.base.linear_solve import COMPILED_SOLVER, linear_solve
from covocp.export import export_c
from covocp.models import (
    brachistochrone,
    bryson_denham,
    damped_oscillator,
    free_time_integrator,
    goddard_rocket,
    lqg_double_integrator,
    mars_entry,
    mass_chain,
    noisy_integrator,
    unknown_gain,
    unknown_lag,
)

# The meshes are coarse.
pytestmark = pytest.mark.filterwarnings("ignore::covocp.CovocpWarning")

TIGHT = {"ipopt": {"tol": 1e-11, "bound_relax_factor": 0.0}}
SILENT = {"print_iter": False, "print_header": False, "print_info": False}
SAME = 1e-8
CLOSED_FORM = 1e-9

# Problem and mesh, and what a second plan starts from: initial values of states.
CASES = {
    "lag": (unknown_lag.problem, 12, {"initial_x": 0.3}),
    "lag, closed loop": (unknown_lag.steering, 12, {"initial_x": 0.1}),
    "noisy integrator": (noisy_integrator.problem, 12, {"initial_x": 0.2}),
    "unknown gain": (unknown_gain.problem, 12, {"initial_x": -0.1}),
    "oscillator": (damped_oscillator.problem, 20, {"initial_y": 0.1}),
    "chain": (mass_chain.problem, 20, {"initial_y": 0.05}),
    "Bryson-Denham": (bryson_denham.problem, 20, {"initial_x": 0.01, "initial_v": 0.95}),
    "brachistochrone": (brachistochrone.problem, 10, {"initial_y": 0.05}),
    "regulator": (lqg_double_integrator.problem, 8, {"initial_position": 1.2}),
    "free time": (free_time_integrator.problem, 10, {"initial_x": 0.1}),
    "Mars entry": (mars_entry.problem, 8, {"initial_h": 1.02 * 328000.0, "initial_v": 0.98 * 15000.0}),
}


def moved(problem, starts):
    """The problem with other initial values of states."""
    for argument, value in starts.items():
        name = argument.removeprefix("initial_")
        own = problem.declarations
        states = tuple(replace(s, initial=ca.MX(value)) if s.name == name else s for s in own.states)
        problem = co.Problem.of(replace(own, states=states))
    return problem


def optimum(problem, plan, **options):
    """The least cost on the nodes of a plan, from its controls."""
    guess = {control.name: plan[control.name] for control in problem.controls}  # of two mirror images this one
    nodes = plan["time"].ravel() / plan["time"].ravel()[-1]  # a mesh graded for the start of the export stays so
    return unassessed(problem, grid=nodes, guess=guess, plugin_options=TIGHT, **options).cost


@pytest.mark.parametrize("case", CASES)
def test_costs_are_those_of_the_converged_optimum(case):
    make, intervals, changes = CASES[case]
    planner = export_c(make(), FOLDER / f"cost_{list(CASES).index(case)}", intervals=intervals, substeps=2).reference()
    for given in ({}, changes):
        plan = planner(**given)
        assert planner.status == "OK"
        assert plan["cost"] == pytest.approx(optimum(moved(make(), given), plan, substeps=2), rel=SAME, abs=0.0)


def test_plans_along_a_singular_arc_are_right_or_told():
    """From which starts the quadratic subproblems give up there is a matter of rounding; the status says so."""
    short = {"max_iter": 25, "qpsol_options": {"max_iter": 150, "error_on_fail": False, **SILENT}}
    made = export_c(goddard_rocket.problem(), FOLDER / "arc", intervals=8, substeps=2, plugin_options=short)
    planner, found = made.reference(), []
    for start in ({}, *({"initial_h": height} for height in np.linspace(1.0003, 1.0021, 7).tolist())):
        plan = planner(**start)
        found.append(planner.status)
        if planner.status == "OK":
            least = optimum(moved(goddard_rocket.problem(), start), plan, substeps=2)
            assert plan["cost"] == pytest.approx(least, rel=SAME, abs=0.0)
    assert set(found) <= {"OK", "NOT_CONVERGED"}
    assert found[0] == "OK"
    assert found.count("OK") >= 3


@pytest.mark.needs_cc
@pytest.mark.parametrize("method", ["sqpmethod", "ipopt"])
def test_bryson_denham_in_c_reaches_its_closed_form(method):
    """Where the ends of the arc x = l are nodes the optimum is one of the transcription: 4/(9 l), to rounding."""
    made = export_c(bryson_denham.problem(), FOLDER / f"bryson_{method}", intervals=24, substeps=1, method=method)
    made.build(flags=["-Werror", "-O1"])
    planner = made.python()
    for limit in (1 / 9, 1 / 12):
        assert planner(limit=limit)["cost"] == pytest.approx(4 / (9 * limit), rel=CLOSED_FORM)
        assert bryson_denham.exact(limit).cost == pytest.approx(4 / (9 * limit), rel=1e-14)
        assert planner.status == "OK"
    assert made.check().ok


def test_closed_forms_of_straight_optima():
    """Constant optimal controls: the transcription adds nothing to the closed form."""
    for module in (noisy_integrator, unknown_gain):
        made = export_c(module.problem(), FOLDER / module.__name__.rpartition(".")[2], intervals=6)
        assert made.reference()()["cost"] == pytest.approx(module.exact().cost, rel=CLOSED_FORM)


def test_steps_that_have_c_code_are_exact_in_any_units():
    """Rows and columns in units that differ by 24 orders of magnitude, against fractions."""
    random = np.random.default_rng(3)
    plain = random.integers(-8, 9, (6, 6)) + 12 * np.eye(6)
    units = 2.0 ** np.array([40, -40, 13, 0, -27, 31])
    matrix, right = plain * units[:, None] / units, random.integers(-8, 9, 6) * units
    symbol, column = ca.MX.sym("matrix", 6, 6), ca.MX.sym("right", 6)
    solve = ca.Function("solve", [symbol, column], [linear_solve(symbol, column, COMPILED_SOLVER)])
    found = np.asarray(solve(matrix, right)).ravel()
    rows = [[Fraction(v) for v in (*line, value)] for line, value in zip(matrix.tolist(), right.tolist(), strict=True)]
    for i, pivot in enumerate(rows):
        for other in rows[:i] + rows[i + 1 :]:
            factor = other[i] / pivot[i]
            other[:] = [a - factor * b for a, b in zip(other, pivot, strict=True)]
    exact = np.array([float(row[-1] / row[i]) for i, row in enumerate(rows)])
    np.testing.assert_allclose(found, exact, rtol=1e-13)


@pytest.mark.parametrize("method", ["sqpmethod", "ipopt"])
def test_plans_of_a_problem_with_a_large_prior_are_those_of_the_converged_optimum(method):
    """Its cost is two, its curvature in units of the variables two thousand: the first slopes led astray.

    From other starts the approximate Hessian of `sqpmethod` may creep: what it then leaves is not called OK.
    """

    def make():
        ocp = co.Problem(duration=10.0, name="prior")
        x, b = ocp.state("x", initial=0.0, final=1.0, variance=1e3), ocp.unknown("b", mean=1.0, variance=5.0)
        u = ocp.control("u")
        ocp.dynamics(x, -b * x + u, noise=1.0)
        ocp.measurement("m", x, noise=1.0)
        ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0})
        return ocp

    planner = export_c(make(), FOLDER / f"prior_{method}", intervals=12, method=method).reference()
    for start in ({}, {"initial_x": 1.5}, {"initial_x": -1.5}, {"initial_x": 1.0}):
        plan = planner(**start)
        right = float(plan["cost"]) == pytest.approx(optimum(moved(make(), start), plan), rel=SAME)
        assert planner.status == ("OK" if right else "NOT_CONVERGED"), start
        assert right or (start and method == "sqpmethod"), start
