"""Solves from elsewhere against problems that are declared so; limits on time and iterations; shifted plans."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest

import covocp as co

E0 = np.array([[0.7, 0.1], [0.1, 0.4]])


def lag(start: float = 0.3, prior=None, mean: float = 1.0, *, duration=5.0, expected: bool = False) -> co.Problem:
    """A lag of unknown rate, estimated while it is brought to rest."""
    ocp = co.Problem(duration, "lag")
    variance = np.diag([0.5, 0.2]) if prior is None else prior
    x = ocp.state("x", initial=start, variance=variance[0, 0], lower=-5.0, upper=5.0)
    b = ocp.unknown("b", mean, variance[1, 1])
    u = ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(x, -b * x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.2)
    if expected:
        ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal_weight={"x": 1.0})
    else:
        E = ocp.estimation_covariance(initial=variance)
        terminal = 10 * E["b", "b"] + (0.3 * ocp.duration if isinstance(duration, co.Free) else 0.0)
        ocp.minimize(running=0.5 * u**2 + x**2, terminal=terminal)
    return ocp


@pytest.mark.parametrize("method", ["ipopt", "reduced", "gradient"])
def test_from_elsewhere_is_what_a_problem_declared_so_gives(method):
    solver = co.Solver(lag(), method, intervals=40)
    fresh = co.solve(lag(1.5, E0, 1.3), method, intervals=40)
    for _ in range(2):
        found = solver.solve(initial={"x": 1.5}, covariance=E0, means={"b": 1.3})
        assert found.cost == pytest.approx(fresh.cost, rel=1e-9)
        assert found["u"] == pytest.approx(fresh["u"], abs=1e-5)
        assert found["E"][0] == pytest.approx(E0)
        assert found.mesh_error == pytest.approx(fresh.mesh_error, rel=1e-3)
        for name in ("stationarity", "costate_difference", "hamiltonian_variation"):
            mine, known = (getattr(solution.optimality, name) for solution in (found, fresh))
            assert mine == pytest.approx(known, rel=0.1, abs=1e-5)
    declared = solver.solve()
    assert declared.cost == pytest.approx(co.Solver(lag(), method, intervals=40).solve(assess=False).cost, rel=1e-9)


def test_simulations_and_evaluations_start_from_there(tmp_path):
    found = co.Solver(lag(), intervals=40).solve(initial={"x": 1.5}, covariance=E0, means={"b": 1.3})
    fresh = co.solve(lag(1.5, E0, 1.3), intervals=40)
    one, other = (co.simulate(solution, 50, 3, step=0.05) for solution in (found, fresh))
    assert one.terminal("x") == pytest.approx(other.terminal("x"), abs=1e-6)
    found.save(tmp_path / "plan.npz")
    with pytest.raises(co.ProblemError, match="of another problem"):
        co.load(tmp_path / "plan.npz", problem=lag())
    loaded = co.load(tmp_path / "plan.npz", problem=co.movable(lag()))
    again = co.evaluate(co.movable(lag()), nominal=loaded, parameters=dict(_values(loaded)))
    assert again.cost == pytest.approx(fresh.cost, rel=1e-8)


def test_a_plan_of_another_duration_is_loaded_with_the_problem_of_that_duration(tmp_path):
    def problem(duration: float) -> co.Problem:
        ocp = co.Problem(duration)
        x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
        ocp.dynamics(x, u)
        ocp.minimize(running=u**2)
        return ocp

    path = co.Solver(problem(2.0), intervals=4).solve(initial={"x": 0.5}, duration=1.6).save(tmp_path / "plan.npz")
    for given, duration in ((co.movable(problem(2.0)), " stated with a duration of 1.6 s"), (problem(1.6), "")):
        with pytest.raises(co.ProblemError, match="of another problem") as refused:
            co.load(path, given)
        assert "loaded with movable(problem)" in refused.value.remedy
        assert duration in refused.value.remedy
    assert co.load(path, co.movable(problem(1.6))).cost == pytest.approx(0.5**2 / 1.6)


def _values(solution: co.Solution):
    """Parameters of a solution by name."""
    for block in solution.blocks:
        if block.kind in ("parameter", "unknown"):
            yield block.name, solution.parameters[block.span]


def test_closed_loops_and_free_durations():
    found = co.Solver(lag(expected=True), intervals=30).solve(initial={"x": -1.0}, covariance=E0)
    prior = lag(-1.0, expected=True)
    prior.estimation_covariance(initial=E0)
    fresh = co.Solver(prior, intervals=30).solve(assess=False)
    assert found.cost == pytest.approx(fresh.cost, rel=1e-7)
    assert found.loop.Xhat[-1] == pytest.approx(fresh.loop.Xhat[-1], abs=1e-6)
    free = co.Free(guess=4.0, lower=1.0, upper=20.0)
    found = co.Solver(lag(duration=free), intervals=30).solve(initial={"x": 2.0}, covariance=1e3 * E0)
    fresh = co.Solver(lag(2.0, 1e3 * E0, duration=free), intervals=30).solve(assess=False)
    assert found.cost == pytest.approx(fresh.cost, rel=1e-6)
    assert found.duration == pytest.approx(fresh.duration, rel=1e-3)


def test_another_duration():
    solver = co.Solver(lag(), intervals=40)
    fresh = {T: co.Solver(lag(1.0, duration=T), intervals=40).solve(assess=False).cost for T in (3.0, 7.0)}
    for duration in (3.0, 7.0, 3.0):
        found = solver.solve(duration=duration, initial={"x": 1.0})
        assert found.cost == pytest.approx(fresh[duration], rel=1e-8)
        assert found.duration == duration


def test_a_plan_of_which_time_has_passed_is_nearly_what_is_left_to_do():
    """By the principle of optimality the rest of a plan is the plan from there, with the covariance of then."""
    solver = co.Solver(lag(duration=6.0), intervals=60)
    plan = solver.solve()
    then = plan.at(2.0)
    start = {"initial": {"x": then["x"]}, "covariance": then["E"], "duration": 4.0}
    left = solver.solve(**start, guess=plan, elapsed=2.0)
    assert left["u"] == pytest.approx(plan.controls_at(2.0 + left.t)[:, 0], abs=2e-3)
    cold = solver.solve(**start)
    assert left.cost == pytest.approx(cold.cost, rel=1e-8)
    assert left.stats["iterations"] < cold.stats["iterations"]


@pytest.mark.parametrize("method", ["ipopt", "reduced", "gradient"])
def test_limits_return_what_is_there_and_say_so(method):
    solver = co.Solver(lag(1.5, E0), method, intervals=40)
    whole = solver.solve()
    assert whole.stats["iterations"] > 3
    few = solver.solve(iteration_limit=2)
    assert not few.converged
    assert "stopped at the limit of 2 iterations" in few.message
    assert np.isfinite(few.cost)
    assert few.cost >= whole.cost - 1e-9
    short = solver.solve(time_limit=1e-6)
    assert "stopped at the limit of 1e-06 s" in short.message
    assert solver.solve(iteration_limit=500, time_limit=100.0).cost == pytest.approx(whole.cost, rel=1e-8)


@pytest.mark.parametrize("method", ["ipopt", "reduced"])
def test_a_larger_limit_returns_nothing_worse(method):
    """An iteration may be worse than one before; what is returned is not: it violates less, or costs less."""
    ocp = co.Problem(2.0)
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - ca.sin(3 * x) - 0.3 * v**3)
    ocp.minimize(running=u**2 + ca.sin(4 * x) ** 2)
    ocp.subject_to(v, upper=0.8, name="speed")
    solver = co.Solver(ocp, method, intervals=20)
    most, ranks = solver.solve(progress=False).stats["iterations"], []
    for limit in range(most + 1):
        found = solver.solve(progress=False, iteration_limit=limit)
        violated = max(found.violations.values(), default=0.0)
        ranks.append((violated, found.cost if violated == 0.0 else 0.0))
    assert len(ranks) > 8
    assert all(later <= earlier or np.allclose(later, earlier, rtol=1e-9) for earlier, later in pairwise(ranks))
    assert ranks[-1][0] == 0.0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"initial": 1.0}, "not given by name"),
        ({"initial": {"y": 1.0}}, "not a symbol of this problem"),
        ({"initial": {"x": [1.0, 2.0]}}, "The initial value of 'x' does not fit"),
        ({"initial": {"x": np.nan}}, "finite numbers"),
        ({"initial": {"x": 6.0}}, "within the bounds"),
        ({"covariance": np.eye(3)}, "a symmetric 2 x 2 matrix, rows x, b"),
        ({"covariance": [[1.0, 2.0], [2.0, 1.0]]}, "not positive semidefinite"),
        ({"covariance": [[1.0, 2.0], [0.0, 5.0]]}, "not symmetric"),
        ({"covariance": {"P": np.eye(2)}}, "not a symbol of this problem"),
        ({"means": {"x": 1.0}}, "not a symbol of this problem"),
        ({"means": {"b": 1.0}, "parameters": {"b": 2.0}}, "given twice"),
        ({"duration": -1.0}, "must be positive"),
        ({"elapsed": 1.0}, "of no plan"),
        ({"time_limit": 0.0}, "time_limit"),
        ({"iteration_limit": -1}, "iteration_limit"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(given, said):
    with pytest.raises(co.ProblemError, match=said):
        co.Solver(lag(), intervals=10).solve(**given)


def test_more_that_is_refused():
    solver = co.Solver(lag(), intervals=10)
    plan = solver.solve()
    with pytest.raises(co.ProblemError, match="not within the plan"):
        solver.solve(guess=plan, elapsed=6.0)
    with pytest.raises(co.ProblemError, match="the problem chooses it"):
        co.Solver(lag(duration=co.Free(guess=4.0, lower=1.0, upper=20.0)), intervals=10).solve(duration=3.0)
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=(u - 1) ** 2)
    with pytest.raises(co.ProblemError, match="no covariance of estimation errors"):
        co.Solver(ocp, intervals=10).solve(covariance=np.eye(1))
    sampled = co.Problem(2.0)
    x, u = sampled.state("x", initial=0.0, variance=1.0), sampled.control("u")
    sampled.dynamics(x, u, noise=0.1)
    sampled.measurement("m", x, noise=0.1, every=0.5)
    sampled.minimize_expected(running=u**2 + x**2)
    with pytest.raises(co.ProblemError, match="read at instants"):
        co.Solver(sampled, intervals=10).solve(duration=1.0)


@pytest.mark.parametrize("given", [None, 3, "x", co.Problem])
def test_only_a_problem_is_movable(given):
    with pytest.raises(co.ProblemError, match=r"expected: a Problem(?s:.)*movable\(problem\)"):
        co.movable(given)


def test_no_solution_and_no_phases_are_movable():
    problem = lag()
    for given in (co.solve(problem, intervals=10, progress=False), co.Phases([problem, lag()])):
        with pytest.raises(co.ProblemError, match="expected: a Problem"):
            co.movable(given)


@pytest.mark.parametrize("moved", [False, True])
def test_a_plan_that_goes_on_has_a_clock_that_goes_on(moved: bool) -> None:
    """A wind that sets in at 2 s: with a parameter for the time the rest costs the rest; without one it is told."""
    ocp = co.Problem(4.0, name="wind")
    begin = ocp.parameter("t0", 0.0) if moved else 0.0
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u - 1.0 / (1.0 + ca.exp(-4.0 * (ocp.time + begin - 2.0))))
    ocp.minimize(running=u**2 + (x - 1.0) ** 2)
    solver = co.Solver(ocp, intervals=64)
    plan = solver.solve(progress=False)
    fine = plan.at(np.linspace(0.0, 1.0, 4001))
    spent = np.trapezoid(fine["u"] ** 2 + (fine["x"] - 1.0) ** 2, fine.t)
    start = {"initial": {"x": float(plan.at(1.0)["x"])}, "duration": 3.0, "guess": plan, "elapsed": 1.0}
    if moved:
        left = solver.solve({"t0": 1.0}, **start, progress=False)
        assert spent + left.cost == pytest.approx(plan.cost, rel=1e-3)
        return
    with pytest.warns(co.CovocpWarning, match="which begins at 0 again"):
        left = solver.solve(**start, progress=False)
    assert abs(spent + left.cost - plan.cost) > 0.05 * plan.cost


def cart(angle: float) -> co.Problem:
    """A cart whose pendulum, of unknown length, hangs at the end."""
    ocp = co.Problem(4.0, "cart")
    s = ocp.state("s", initial=0.0, final=1.0, variance=1e-3)
    q = ocp.state("q", initial=angle, final=0.0, variance=1e-3)
    vs, w = (ocp.state(name, initial=0.0, final=0.0, variance=1e-3) for name in ("vs", "w"))
    length, a = ocp.unknown("l", mean=1.0, variance=0.04), ocp.control("a", lower=-6.0, upper=6.0, guess=0.1)
    ocp.dynamics(s, vs)
    ocp.dynamics(q, w)
    ocp.dynamics(vs, a, noise=1e-3)
    ocp.dynamics(w, (-9.81 * ca.sin(q) - a * ca.cos(q)) / length - 0.1 * w, noise=1e-3)
    ocp.measurement("ms", s, noise=1e-3)
    ocp.measurement("mq", q, noise=1e-3)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.05 * a**2, terminal=300.0 * E[length, length])
    return ocp


@cache
def cost_of_a_cart_declared_so() -> float:
    return co.Solver(cart(3.0), intervals=50).solve(progress=False, assess=False).cost


@pytest.mark.parametrize("before", [0.0, 1.0])
def test_what_a_new_solver_finds_is_found_after_solves_for_other_values(before):
    """In the units of the first one the run ends where the conditions seem to contradict."""
    solver = co.Solver(cart(0.0), intervals=50)
    solver.solve(initial={"q": before}, progress=False, assess=False)
    found = solver.solve(initial={"q": 3.0}, progress=False, assess=before == 0.0)
    assert found.cost == pytest.approx(cost_of_a_cart_declared_so(), rel=1e-6)
    assert solver.solve(initial={"q": before}, progress=False, assess=False).converged
