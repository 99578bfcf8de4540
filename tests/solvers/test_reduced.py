"""The reduced method against closed forms, against Ipopt, and where it must say no."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from problems import unassessed
from random_problems import draw, true_cost
from scipy.optimize import brentq

import covocp as co
from covocp.models import brachistochrone, free_time_integrator, mars_entry, unknown_gain, unknown_lag
from covocp.solvers.reduced import method as reduced_method
from covocp.solvers.reduced.subproblem import Quadratic, eased, solved
from covocp.transcription.mesh import Options


def steered(limit: float = np.inf, **options: float) -> co.Problem:
    """A double integrator from rest to rest over a unit of length in a second, with little effort."""
    ocp = co.Problem(1.0)
    x = ocp.state("x", 2, initial=[0.0, 0.0], final=[1.0, 0.0], **options)
    u = ocp.control("u", lower=-limit, upper=limit) if np.isfinite(limit) else ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize(running=0.5 * u**2)
    return ocp


def measured(n: int, seed: int, **kinds: bool) -> co.Problem:
    """A random linear plant with an unknown gain whose variance at the end counts."""
    rng = np.random.default_rng(seed)
    ocp = co.Problem(co.Free(guess=2.0, lower=0.5, upper=6.0) if kinds.get("free") else 2.0)
    final = {"final": np.zeros(n)} if kinds.get("final") else {}
    x = ocp.state("x", n, initial=rng.normal(size=n), variance=10.0 ** rng.uniform(-2, 2) * np.eye(n), **final)
    b = ocp.unknown("b", 1.0, 0.5)
    u = ocp.control("u", n, **({"lower": -2.0, "upper": 2.0} if kinds.get("bounded") else {}))
    f = (rng.normal(size=(n, n)) - np.eye(n)) @ x + b * (rng.normal(size=(n, n)) @ u)
    ocp.dynamics(x, f, noise=0.1 * np.eye(n))
    ocp.measurement("m", x[0], noise=10.0 ** rng.uniform(-3, 1))
    E = ocp.estimation_covariance()
    if kinds.get("path"):
        ocp.subject_to(ca.sumsqr(u), upper=3.0)
    running = 0.5 * ca.sumsqr(u) + ca.sumsqr(x) + (1.0 if kinds.get("free") else 0.0)
    ocp.minimize(running=running, terminal=5.0 * E["b", "b"])
    return ocp


def test_effort_of_a_double_integrator():
    """u = 6 - 12 t: cost 6; the multipliers of the final state are the costates 12 and -6."""
    solution = co.solve(steered(), "reduced", intervals=40)
    assert solution.cost == pytest.approx(6.0, rel=1e-9)
    assert solution["u"] == pytest.approx(6 - 12 * solution.t, abs=1e-5)
    assert solution.costates.state[-1] == pytest.approx([-12.0, 6.0], abs=1e-5)
    assert solution.method == "reduced"


def test_effort_with_a_bound_that_is_active():
    """u = k (1/2 - t) cut at the bound, k such that the way is one."""
    limit, t = 5.0, np.linspace(0, 1, 200_001)

    def way(k: float) -> float:
        return float(np.trapezoid((1 - t) * np.clip(k * (0.5 - t), -limit, limit), t)) - 1.0

    k = brentq(way, 1.0, 100.0)
    expected = float(np.trapezoid(0.5 * np.clip(k * (0.5 - t), -limit, limit) ** 2, t))
    solution = co.solve(steered(limit), "reduced", intervals=200)
    assert solution.cost == pytest.approx(expected, rel=1e-4)
    assert np.abs(solution["u"]).max() <= limit
    same = co.solve(steered(limit), intervals=200)
    assert solution.multipliers.controls == pytest.approx(same.multipliers.controls, abs=1e-4)


def test_closed_forms_with_a_free_duration_and_a_state_dependent_noise():
    exact = free_time_integrator.exact()
    solution = co.solve(free_time_integrator.problem(), "reduced")
    assert solution.duration == pytest.approx(exact.duration, rel=1e-6)
    assert solution.cost == pytest.approx(exact.cost, rel=1e-6)


@pytest.mark.parametrize("kinds", [{}, {"final"}, {"free"}, {"bounded"}, {"path"}, {"final", "bounded"}])
def test_it_ends_where_ipopt_ends(kinds):
    for seed in range(2):
        problem = measured(2 + seed, seed, **dict.fromkeys(kinds, True))
        one, other = (unassessed(problem, method, intervals=15) for method in ("ipopt", "reduced"))
        assert other.cost == pytest.approx(one.cost, rel=1e-7)
        assert other["u"] == pytest.approx(one["u"], abs=2e-3 * np.abs(one["u"]).max() + 1e-6)
        size = np.abs(one.costates.state).max()
        assert other.costates.state == pytest.approx(one.costates.state, abs=2e-3 * size + 1e-6)


@pytest.mark.parametrize("model", [unknown_gain, unknown_lag, brachistochrone, mars_entry])
def test_necessary_conditions_hold_on_models(model):
    one, other = (co.solve(model.problem(), method, intervals=50) for method in ("ipopt", "reduced"))
    assert other.cost == pytest.approx(one.cost, rel=1e-8)
    for name in ("stationarity", "costate_difference", "transversality", "complementarity"):
        mine, known = (getattr(solution.optimality, name) for solution in (other, one))
        assert (mine is None and known is None) or mine < 1e-5 + 1.01 * known  # of this mesh


def test_what_was_learnt_at_a_plan_helps_near_it():
    """The same answer as from scratch with fewer iterations."""
    problem = unknown_lag.problem()
    solver = co.Solver(problem, "reduced", intervals=40)
    plan = solver.solve()
    near = {"b": 1.02}
    again = solver.solve(near, guess=plan)
    fresh = co.solve(problem, intervals=40, parameters=near)
    assert again.cost == pytest.approx(fresh.cost, rel=1e-8)
    assert again.stats["iterations"] < plan.stats["iterations"]


def test_what_contradicts_is_said_and_the_last_iterate_kept():
    ocp = steered(limit=1.0)
    with pytest.raises(co.SolveError, match="no step brings the constraints closer") as error:
        co.solve(ocp, "reduced", intervals=20)
    assert error.value.solution is not None
    assert error.value.violations


def held_below() -> co.Problem:
    """Bryson and Denham's problem; its limit must hold between the nodes too. Cost 4 / (9 l) (1975, 3.11)."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", 2, initial=[0.0, 1.0], final=[0.0, -1.0]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.subject_to(x[0], upper=1 / 9, between="auto")
    ocp.minimize(running=0.5 * u**2)
    return ocp


def test_meshes_are_refined_and_limits_hold_between_the_nodes():
    solution = co.solve(held_below(), "reduced", refine=1e-5)
    assert solution.cost == pytest.approx(4.0, rel=2e-5)
    fine = solution.at(np.linspace(0, 1, 5000))["x"]
    assert fine[:, 0].max() < 1 / 9 + 1e-5
    known = unassessed(measured(2, 0), intervals=100).cost
    for method in ("reduced", "auto"):
        found = co.solve(measured(2, 0), method, refine=1e-5)
        assert found.cost == pytest.approx(known, rel=3e-5)
        assert found.mesh_error < 1e-5


def unstable() -> co.Problem:
    """A plant that grows by e^60, steered to rest while its gain is estimated."""
    ocp = co.Problem(6.0)
    x, b, u = ocp.state("x", initial=1.0, final=0.0, variance=0.1), ocp.unknown("b", 1.0, 0.1), ocp.control("u")
    ocp.dynamics(x, 10.0 * x + b * u, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E["b", "b"])
    return ocp


def test_a_plant_that_is_too_unstable_is_named():
    with pytest.raises(co.SolveError, match=r"too unstable to be solved in its controls alone.*method='ipopt'"):
        co.solve(unstable(), "reduced", intervals=60)


@pytest.mark.filterwarnings("ignore:.*along these controls alone")  # along its controls alone
def test_auto_takes_the_faster_one_and_falls_back():
    assert co.solve(measured(2, 0), "auto", intervals=20).method == "reduced"
    assert co.solve(steered(), "auto", intervals=20).method == "ipopt"
    found, known = co.solve(unstable(), "auto", intervals=60), co.solve(unstable(), intervals=60)
    assert found.method == "ipopt"
    assert found.cost == pytest.approx(known.cost, rel=1e-9)
    with pytest.raises(co.SolveError, match="not solved by auto"):
        co.solve(steered(limit=1.0), "auto", intervals=20)


def test_what_it_cannot_do_is_refused_before_anything_is_computed():
    with pytest.raises(co.ProblemError, match="no matrices as variables"):
        co.solve(measured(2, 0), "reduced", covariances="states")
    with pytest.raises(co.ProblemError, match="at most 2000"):
        co.solve(measured(2, 0), "reduced", intervals=1500)
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    E = ocp.symmetric("E", 1, initial=1.0)
    ocp.dynamics(x, u - 0.1 * E[0, 0])
    ocp.dynamics(E, -E[0, 0] * u**2)
    ocp.minimize(running=u**2)
    with pytest.raises(co.ProblemError, match="follow from the nominal"):
        co.solve(ocp, "reduced")


@pytest.mark.parametrize("seed", range(12))
def test_subproblems_meet_their_conditions(seed):
    """Stationarity, feasibility, signs and complementarity of random convex problems with bounds and rows."""
    rng = np.random.default_rng(seed)
    n, m = 12, 5
    root = rng.normal(size=(n, n))
    rows, inside = rng.normal(size=(m, n)), 0.3 * rng.normal(size=n)
    value = rows @ inside
    lower = np.where(np.arange(m) < 2, value, value - rng.uniform(0, 1, m))
    upper = np.where(np.arange(m) < 2, value, value + rng.uniform(0, 1, m))
    curvature = root @ root.T + 0.1 * np.eye(n)
    problem = Quadratic(
        curvature=curvature,
        inverse=np.linalg.inv(curvature),
        slope=10 * rng.normal(size=n),
        rows=rows,
        lower=lower,
        upper=upper,
        low=np.minimum(inside, 0) - 0.2,
        high=np.maximum(inside, 0) + 0.2,
    )
    step = solved(problem, np.zeros(m), np.zeros(n))
    assert step is not None
    slope = problem.curvature @ step.change + problem.slope + rows.T @ step.of_rows + step.of_bounds
    assert np.abs(slope).max() < 1e-9
    for at, multiplier, low, high in (
        (rows @ step.change, step.of_rows, lower, upper),
        (step.change, step.of_bounds, problem.low, problem.high),
    ):
        assert (at >= low - 1e-9).all()
        assert (at <= high + 1e-9).all()
        free = low < high
        assert np.abs(np.maximum(multiplier, 0) * (high - at))[free].max() < 1e-7
        assert np.abs(np.minimum(multiplier, 0) * (at - low))[free].max() < 1e-7


def test_a_subproblem_that_contradicts_is_eased_by_what_it_takes():
    """d <= 1 and d >= 3: what is left of the violation of 3 is 2/3, at any price of it."""
    one = np.ones(1)
    problem = Quadratic(
        curvature=np.eye(1),
        inverse=np.eye(1),
        slope=0 * one,
        rows=np.eye(1),
        lower=3 * one,
        upper=np.inf * one,
        low=-one,
        high=one,
    )
    assert solved(problem, np.zeros(1), np.zeros(1)) is None
    step, left = eased(problem, np.zeros(1), np.zeros(1), 1e4)
    assert step.change == pytest.approx([1.0], abs=1e-6)
    assert left == pytest.approx(2 / 3, abs=1e-6)


def test_long_valleys_are_followed_to_their_end():
    """1300 cheap steps, where limited-memory Ipopt gives up after 1000; the exact Hessian ends at the same cost."""
    drawn = draw(46)
    solution = co.solve(drawn.problem, "auto", intervals=40, progress=False)
    assert solution.method == "reduced"
    assert solution.cost == pytest.approx(true_cost(drawn, solution, rtol=1e-7), rel=max(1e-6, 2 * solution.mesh_error))
    assert solution.optimality.stationarity <= 1e-4
    assert solution.optimality.curvature > 0


def test_starts_that_move_a_little_do_not_spoil_what_was_learnt():
    """A loop that plans again: the steps that close the gaps of a new start say nothing of the curvature."""
    ocp = co.Problem(2.0, name="pendulum")
    a, w = ocp.state("a", initial=0.3), ocp.state("w", initial=0.0)
    u = ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(a, w)
    ocp.dynamics(w, 1.962 * ca.sin(a) + u - 0.1 * w)
    ocp.minimize(running=a**2 + 0.1 * w**2 + 0.05 * u**2)
    solver, other = (co.Solver(ocp, method, intervals=40) for method in ("reduced", "ipopt"))
    plan = solver.solve(progress=False)
    for k in range(14):
        start = {a: 0.3 + 1e-4 * (k % 7)}
        plan = solver.solve(initial=start, guess=plan, progress=False, assess=False)
        assert plan.stats["iterations"] <= 12
        cost = other.solve(initial=start, progress=False, assess=False).cost
        assert plan.cost == pytest.approx(cost, rel=1e-9)


def steady():
    """A loop whose last steps change the cost by its rounding, from which a smaller tolerance still goes on."""
    ocp = co.Problem(6.0)
    x = ocp.state(
        "x", 3, initial=[1.5, 1.1, 2.0], variance=[[0.02, -0.02, -0.03], [-0.02, 0.13, 0.02], [-0.03, 0.02, 0.09]]
    )
    u = ocp.control("u")
    drift = ca.DM([[-1.0, 1.5, 0.2], [0.5, -0.1, 0.0], [-0.2, -1.3, -1.2]])
    pushed = ca.DM([1.1, 0.5, -0.1])
    noise = np.array([[0.48, 0.13, -0.14], [0.13, 0.06, -0.03], [-0.14, -0.03, 0.29]])
    ocp.dynamics(x, drift @ x + pushed * (u + 0.5 * ca.sin(x[0])), noise=noise)
    seen = ca.DM([[1.4, -1.5, 0.1], [-0.7, 0.3, -2.0], [0.7, 0.2, -1.1]]) @ x + 0.4 * x[0] ** 2
    accuracy = np.array([[16.0, 22.0, -4.0], [22.0, 50.0, -7.0], [-4.0, -7.0, 13.0]])
    ocp.measurement("sensors", seen, noise=1e-4 * accuracy * (1 + 0.04 * x[0] ** 2))
    ocp.subject_to(x[0], equals=0.3, at="final")
    ocp.minimize_expected(running=0.5 * u**2 + 0.2 * ca.sumsqr(x), terminal=2 * ca.sumsqr(x), terminal_weight={x: 1.0})
    return ocp


def test_rounds_that_begin_where_the_last_one_did_ask_for_more():
    """They had been the same run five times, and "the tolerance was met in the scales of the start" the end."""
    one, other = (co.solve(steady(), method, intervals=100, progress=False) for method in ("reduced", "ipopt"))
    assert one.converged
    assert one.cost == pytest.approx(other.cost, rel=1e-8)
    assert one.optimality.stationarity < 1e-5


def test_beside_a_penalty_that_hides_every_step_no_point_is_called_solved() -> None:
    """The least cost is W/(1 + W); it was called solved at 1.6 times that."""
    ocp = co.Problem(1.0, name="penalty")
    x, u = ocp.state("x", initial=0.0), ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2, terminal=1e10 * (x - 1) ** 2)
    found = co.solve(ocp, "reduced", intervals=20, progress=False, allow_failure=True)
    assert not found.converged or found.cost == pytest.approx(1.0, rel=1e-4)
    assert co.solve(ocp, "auto", intervals=20, progress=False).cost == pytest.approx(1.0, rel=1e-4)


def test_iterates_that_diverge_are_told_in_words() -> None:
    """A run that wanders off is ended from outside, by Ipopt's name of it."""
    statement = unknown_lag.problem().statement()
    prepared = reduced_method.prepare(statement, Options(intervals=10))
    ending = prepared._runs._ending("Diverging_Iterates")
    assert ending is not None
    assert "diverge" in str(ending)
