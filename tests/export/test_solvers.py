"""The exported solver: the costs of `solve`, from other starts, for other parameters and durations."""

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, PLANNER, QUICK, package

import covocp as co
from covocp.export import export_c
from covocp.models import brachistochrone, unknown_lag

# The meshes are coarse.
pytestmark = [pytest.mark.needs_cc, pytest.mark.filterwarnings("ignore::covocp.CovocpWarning")]


def lag(start=0.0, duration=10.0, weight=10.0, mean=1.0, covariance=((1.0, 0.0), (0.0, 5.0))):
    """The problem of the planner, with what a re-planning changes written into it."""
    ocp = co.Problem(duration=duration)
    x = ocp.state("x", initial=start, final=0.0, variance=1.0)
    b = ocp.unknown("b", mean=mean, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=1.0)
    E = ocp.estimation_covariance(np.array(covariance))
    ocp.minimize(running=0.5 * u**2, terminal=weight * E[b, b])
    return ocp


def solved(**changes):
    return co.solve(lag(**changes), **PLANNER, progress=False, tolerance=1e-9)


def test_the_planner_agrees_with_python_at_all_points():
    check = package("planner").check()
    assert check.ok, str(check)
    assert check.laws["solve"].points == 12


def test_the_plan_of_the_export_is_the_solution():
    plan = package("planner").python()()
    solution = co.solve(unknown_lag.problem(weight=10.0), **PLANNER, progress=False, tolerance=1e-9)
    assert plan["cost"] == pytest.approx(solution.cost, rel=1e-8)
    np.testing.assert_allclose(plan["u"], solution["u"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(plan["x"], solution["x"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(plan["time"], solution.t, rtol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "changes"),
    [
        ({"initial_x": 0.4}, {"start": 0.4}),
        ({"initial_x": -0.3, "b": 1.2}, {"start": -0.3, "mean": 1.2}),
        ({"duration": 8.0}, {"duration": 8.0}),
        ({"weight": 5.0, "duration": 9.0}, {"weight": 5.0, "duration": 9.0}),
        (
            {"initial_E": [[0.8, -0.2], [-0.2, 3.0]], "initial_x": 0.5},
            {"covariance": [[0.8, -0.2], [-0.2, 3.0]], "start": 0.5},
        ),
    ],
)
def test_plans_from_elsewhere_cost_what_solve_says(arguments, changes):
    planner = package("planner").python()
    plan, solution = planner(**arguments), solved(**changes)
    assert planner.status == "OK"
    if abs(plan["cost"] / solution.cost - 1) > 1e-6:  # the mirror image, where it is the better one
        solution = co.solve(lag(**changes), **PLANNER, progress=False, tolerance=1e-9, guess={"u": plan["u"]})
    assert plan["cost"] == pytest.approx(solution.cost, rel=1e-8)
    assert plan["infeasibility"] < 1e-6
    assert plan["stationarity"] < 1e-5


def test_a_plan_is_the_guess_of_the_next():
    planner = package("planner").python()
    first = planner(initial_x=0.2)
    second = planner(initial_x=0.25, guess=first["variables"])
    assert planner.status == "OK"
    assert second["cost"] == pytest.approx(planner(initial_x=0.25)["cost"], rel=1e-8)


def test_a_problem_without_a_solution_is_not_called_solved():
    """Bounds on the control that do not let the state arrive in the time that is left."""
    ocp = co.Problem(duration=2.0)
    x, v = ocp.state("cost", initial=0.0, final=1.0), ocp.state("variables", initial=0.0, final=0.0)
    a = ocp.control("a", lower=-2.0, upper=2.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, a)
    ocp.minimize(running=0.5 * a**2)
    made = export_c(ocp, FOLDER / "double_integrator", intervals=10)
    made.build(flags=QUICK)
    planner = made.python()
    assert planner()["cost"] == pytest.approx(co.solve(ocp, intervals=10, progress=False).cost, rel=1e-6)
    assert planner.status == "OK"
    planner(duration=0.2)
    assert planner.status == "NOT_CONVERGED"
    plan = planner(duration=1.8)
    assert planner.status == "OK"
    assert plan["infeasibility"] < 1e-6
    assert plan["a"].shape == (11,)
    np.testing.assert_allclose(plan["state_cost"][[0, -1]], [0.0, 1.0], atol=1e-8)


def test_a_free_duration_stays_free():
    problem = brachistochrone.problem()
    made = export_c(problem, FOLDER / "brachistochrone", intervals=10)
    made.build(flags=QUICK)
    plan = made.python()()
    solution = co.solve(problem, intervals=10, progress=False, tolerance=1e-9)
    assert plan["cost"] == pytest.approx(solution.cost, rel=1e-8)
    assert plan["time"][-1] == pytest.approx(solution.duration, rel=1e-6)
    assert "duration" not in [port.name for port in made.laws[0].arguments]
    assert made.check().ok


def test_constant_controls_and_a_closed_loop():
    problem = unknown_lag.steering()
    made = export_c(problem, FOLDER / "steering", intervals=10, control="constant")
    law = made.laws[0]
    sizes = {port.name: port.size for port in law.outputs}
    assert (sizes["u"], sizes["x"]) == (10, 11)
    plan = made.reference()(initial_x=0.1)
    solution = co.solve(unknown_lag.steering(), intervals=10, control="constant", progress=False, tolerance=1e-9)
    assert made.reference()()["cost"] == pytest.approx(solution.cost, rel=1e-8)
    assert plan["cost"] != pytest.approx(solution.cost, rel=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "blocksqp"}, "has no C code"),
        ({"method": None}, "has no C code"),
        ({"precision": "single"}, "double precision only"),
        ({"period": 0.1}, "no option 'period' for a problem"),
        ({"colour": 3}, "no option 'colour' for a problem"),
        ({"plugin_options": {"no_such_option": 1}}, "refuses the problem or its settings"),
        ({"plugin_options": {"max_iter": 0}}, r"NOT_CONVERGED at the problems near it, .*\n.*method='ipopt'"),
        ({"intervals": 0}, "intervals"),
    ],
)
def test_what_means_nothing_to_a_solver_is_refused(options, words):
    with pytest.raises(co.CovocpError, match=words):
        export_c(unknown_lag.problem(), FOLDER / "no_solver", **({"intervals": 6} | options))
    assert not (FOLDER / "no_solver").exists()


def moved():
    """A double integrator that is moved with least energy."""
    ocp = co.Problem(duration=2.0)
    x, v, u = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=u**2)
    return ocp


@pytest.mark.parametrize("asked", ["calc_f", "calc_lam_p"])
def test_what_casadi_is_asked_for_beside_the_plan_is_taken(asked):
    made = export_c(moved(), FOLDER / asked, intervals=5, plugin_options={asked: True})
    assert made.reference()()["cost"] == pytest.approx(co.solve(moved(), intervals=5, progress=False).cost)


def test_a_function_of_the_user_is_not_replaced(monkeypatch):
    given = ca.Function("given", [ca.MX.sym("x")], [ca.MX(1)])
    taken, nlpsol = [], ca.nlpsol

    def refused(name, plugin, problem, settings):
        if plugin == "ipopt":  # of the plan from which the export starts
            return nlpsol(name, plugin, problem, settings)
        taken.append(settings["hess_lag"])
        raise RuntimeError("seen")

    monkeypatch.setattr(ca, "nlpsol", refused)
    with pytest.raises(co.ExportError, match="seen"):
        export_c(moved(), FOLDER / "given", intervals=5, plugin_options={"hess_lag": given})
    assert taken == [given]


@pytest.mark.parametrize("value", [ca.log, ca.sqrt])
def test_a_plan_along_which_a_condition_has_no_value_is_none(value):
    """Of least cost is x = x(0) - 0.1 t: from 0.1 it is below zero after 1 s, where neither function has a value."""
    ocp = co.Problem(duration=2.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.subject_to(value(x), upper=2.0, name="level")
    ocp.minimize(running=(u + 0.1) ** 2)
    made = export_c(ocp, FOLDER / f"undefined_{value.__name__}", intervals=5)
    made.build(flags=QUICK)
    planner = made.python()
    np.testing.assert_allclose(planner(initial_x=0.5)["x"], 0.5 - 0.1 * np.linspace(0.0, 2.0, 6), atol=1e-6)
    assert planner.status == "OK"
    for start in (0.1, -1.0):
        plan = planner(initial_x=start)
        assert planner.status == "FAILED"
        assert plan["x"][0] == pytest.approx(1.0)  # the plan made at the export
