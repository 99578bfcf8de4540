"""What is called solved is stationary, whatever the scales of the start were; what is not says so."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from problems import unassessed
from random_problems import draw

import covocp as co
from covocp.base.residuals import Residuals
from covocp.extremal.optimality import complementarity
from covocp.models import unknown_lag
from covocp.solvers import runs
from covocp.solvers.gradient.memory import damped, learnt
from covocp.solvers.reached import Round
from covocp.solvers.rounds import best_of

LAG_MINIMA = (7.08523844, 7.71199)  # of the lag with weight 10 on 50 intervals, from starts of the right size


def plant(a: float, duration: float) -> co.Problem:
    """x' = a x + u, x(0) = x(T) = 1, J = int (u^2 + x^2)/2: sqrt(a^2 + 1) for long durations.

    From 1 to 0 the cost is (sqrt(a^2 + 1) + a)/2 and from 0 to 1 (sqrt(a^2 + 1) - a)/2, by the Riccati equation.
    """
    ocp = co.Problem(duration=duration)
    x, u = ocp.state("x", initial=1.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, a * x + u)
    ocp.minimize(running=0.5 * u**2 + 0.5 * x**2)
    return ocp


def lag(**options: object) -> co.Solution:
    return co.solve(unknown_lag.problem(final=1.0, weight=10.0), intervals=50, progress=False, **options)  # type: ignore[arg-type]


@pytest.mark.filterwarnings("ignore:.*along these controls alone")  # flown open loop these controls miss the end
@pytest.mark.parametrize(("a", "duration"), [(1.0, 16.0), (2.0, 12.0), (3.0, 8.0), (3.0, 9.0)])
def test_unstable_plants_have_the_cost_of_the_closed_form(a: float, duration: float) -> None:
    # the simulated start reaches e^(a T); the tolerance is that of the mesh, (a h)^4
    solution = co.solve(plant(a, duration), intervals=100, progress=False)
    assert solution.cost == pytest.approx(np.hypot(a, 1.0), rel=2e-3)
    assert solution["x"][-1] == pytest.approx(1.0, abs=1e-6)
    assert solution.optimality.stationarity is not None
    assert solution.optimality.stationarity < 1e-4


@pytest.mark.filterwarnings("ignore:The mesh is too coarse")
@pytest.mark.parametrize(("a", "duration"), [(1.0, 8.0), (2.0, 16.0), (3.0, 16.0)])
def test_gradient_method_is_right_or_says_that_it_failed(a: float, duration: float) -> None:
    options = {"intervals": 50, "progress": False, "max_iterations": 40, "allow_failure": True}
    solution = co.solve(plant(a, duration), "gradient", **options)
    assert solution.converged or a * duration > 10
    if solution.converged:
        assert solution.cost == pytest.approx(np.hypot(a, 1.0), rel=2e-3)
        assert solution["x"][-1] == pytest.approx(1.0, abs=1e-6)
    else:
        assert solution.status.startswith("NOT CONVERGED: ")
        assert "solved" not in solution.message


@pytest.mark.parametrize("size", [1e5, 1e8])
def test_guess_in_a_wrong_unit_ends_at_a_minimum(size: float) -> None:
    solution = lag(guess={"u": size})
    assert min(abs(solution.cost / minimum - 1) for minimum in LAG_MINIMA) < 1e-6
    assert solution.stats["rounds"] > 1


def test_ordinary_solves_take_one_round() -> None:
    assert "rounds" not in lag().stats


def test_without_another_round_the_failure_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "LARGEST_ROUNDS", 1)
    with pytest.raises(co.SolveError, match="not in those of the point that was reached: slope") as caught:
        lag(guess={"u": 1e8})
    assert caught.value.solution is not None
    assert not caught.value.solution.converged


@pytest.mark.filterwarnings("ignore:The mesh is too coarse")
@pytest.mark.parametrize("seed", [33, 183, 193])
def test_nothing_is_gained_by_solving_again(seed: int) -> None:
    first = co.solve(draw(seed).problem, intervals=30, progress=False)
    again = co.solve(draw(seed).problem, intervals=30, progress=False, guess=first, tolerance=1e-10, allow_failure=True)
    assert again.converged
    assert abs(first.cost - again.cost) < 1e-6 * abs(first.cost)


def test_multipliers_of_inactive_bounds_are_no_stationarity() -> None:
    # min int u^2/2 - u, u <= 1.5: u = 1. With half of the slope u - 1 called a multiplier u = 1.25 seems stationary.
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u", upper=1.5)
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * u**2 - u)
    solution = co.solve(ocp, intervals=10, progress=False)
    assert solution.cost == pytest.approx(-0.5, abs=1e-6)
    assert solution.optimality.complementarity is not None
    assert solution.optimality.complementarity < 1e-6
    solution.extremal.multipliers.controls.setflags(write=True)
    solution.extremal.multipliers.controls[:] = 0.25 * 0.1
    # 11 values, distance 0.5 from the bound, cost 0.5
    assert complementarity(solution.extremal) == pytest.approx(11 * 0.025 * 0.5 / 0.5, rel=1e-6)


def penalised(weight: float, *, unit: float, limit: float) -> co.Problem:
    """x' = u/unit, |u/unit| <= limit, J = int (u/unit)^2 + weight (x(1) - 1)^2.

    From x(0) = 0 a constant u is best: J = weight/(1 + weight) where the limit lets it.
    """
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u", lower=-limit * unit, upper=limit * unit)
    ocp.dynamics(x, u / unit)
    ocp.minimize(running=(u / unit) ** 2, terminal=weight * (x - 1.0) ** 2)
    return ocp


@pytest.mark.parametrize("unit", [1e-3, 1.0])
@pytest.mark.parametrize(("weight", "limit"), [(1e6, 3.0), (1e8, 0.5), (1e8, 1.5), (1e8, 50.0), (1e10, 50.0)])
def test_large_penalties_hide_nothing_of_the_cost(weight: float, limit: float, unit: float) -> None:
    # what is left at bounds was compared with a tenth of the penalty: costs up to 32 times too high were called solved
    least = weight / (1 + weight) if limit > 1 else limit**2 + weight * (1 - limit) ** 2
    found = co.solve(penalised(weight, unit=unit, limit=limit), intervals=20, progress=False)
    assert found.cost == pytest.approx(least, rel=1e-6)
    assert found.stats.get("rounds", 1) <= 3


def test_a_limit_on_a_state_beside_a_large_penalty() -> None:
    # x' = v, v' = u: from 0 to 0.4 in 1 s at v <= 0.5 v rises and falls by parabolas of slope 0 at the limit, each for
    # r with 1 - 2 r/3 = 0.8: J = 2 int u^2 = 2 (4/3) 0.5^2/r, against which 1e7 (x - 0.4)^2 + 1e7 v^2 gives way by 3e-6
    ocp = co.Problem(duration=1.0)
    x, v, u = ocp.state("x", initial=0.0), ocp.state("v", initial=0.0), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.subject_to(v, upper=0.5)
    ocp.minimize(running=u**2, terminal=1e7 * ((x - 0.4) ** 2 + v**2))
    found = co.solve(ocp, intervals=40, progress=False, control="linear")
    assert found.cost == pytest.approx(2 * 4 / 3 * 0.25 / 0.3, rel=1e-3)  # the kink lies between nodes
    assert found.optimality.complementarity is not None
    assert found.optimality.complementarity < 1e-5


@pytest.mark.filterwarnings("ignore:The controls change faster")  # 20 intervals of a jump
def test_what_no_run_makes_less_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "LARGEST_ROUNDS", 1)
    with pytest.warns(co.CovocpWarning, match="The cost may be above the least one") as told:
        found = co.solve(penalised(1e8, unit=1.0, limit=3.0), intervals=20, progress=False)
    (gap,) = (text for text in map(str, (one.message for one in told)) if "above the least one" in text)
    bound = float(gap.split("one: ")[1].split()[0])
    assert 0.0 < 1 - 1 / (1 + 1e-8) / found.cost < bound


def halves() -> co.Phases:
    """`penalised(1e8, unit=1.0, limit=3.0)` in two phases."""
    parts = []
    for k in range(2):
        ocp = co.Problem(duration=0.5, name=f"half {k}")
        x, u = ocp.state("x", initial=0.0 if k == 0 else None), ocp.control("u", lower=-3.0, upper=3.0)
        ocp.dynamics(x, u)
        ocp.minimize(running=u**2, terminal=k * 1e8 * (x - 1.0) ** 2)
        parts.append(ocp)
    return co.Phases(parts)


@pytest.mark.filterwarnings("ignore:The controls change faster")  # 20 intervals of a jump
def test_phases_hide_nothing_either_and_tell_it_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert co.solve(halves(), intervals=10, progress=False).cost == pytest.approx(1 / (1 + 1e-8), rel=1e-6)
    monkeypatch.setattr(runs, "LARGEST_ROUNDS", 1)
    with pytest.warns(co.CovocpWarning, match="above the least one") as told:
        co.solve(halves(), intervals=10, progress=False)
    assert sum("above the least one" in str(one.message) for one in told) == 1


def correlated(seed: int) -> co.Problem:
    """A lag whose final correlation of state and unknown is limited."""
    r = np.random.default_rng(seed)
    ocp = co.Problem(duration=float(r.uniform(1, 5)))
    x = ocp.state("x", initial=0.0, final=float(r.uniform(0.5, 1.5)), variance=float(r.uniform(0.1, 1)))
    b, u = ocp.unknown("b", float(r.uniform(0.3, 1.5)), float(r.uniform(0.5, 4))), ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=float(r.uniform(0.05, 1)))
    ocp.measurement("m", x, noise=float(10 ** r.uniform(-1.5, 0.3)))
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=float(r.uniform(0.5, 5)) * E[b, b])
    ocp.subject_to(E[x, b], lower=-0.02, upper=0.02, at="final", name="correlation")
    return ocp


def test_inequality_at_the_end_is_active_or_has_no_multiplier() -> None:
    gradient = co.solve(correlated(0), "gradient", intervals=20, progress=False)
    shooting = unassessed(correlated(0), intervals=20, guess=gradient, tolerance=1e-9)
    assert gradient.cost == pytest.approx(shooting.cost, rel=1e-5)
    assert gradient.optimality.complementarity is not None
    assert gradient.optimality.complementarity < 1e-4


@pytest.mark.parametrize("seed", [1, 9])
def test_gradient_method_finds_what_shooting_finds(seed: int) -> None:
    gradient, shooting = (unassessed(draw(seed).problem, method, intervals=30) for method in ("gradient", "ipopt"))
    assert gradient.cost == pytest.approx(shooting.cost, rel=1e-5)


def test_learnt_metric_is_the_recursion_of_bfgs() -> None:
    from scipy.sparse import diags_array

    r = np.random.default_rng(3)
    n, base = 9, diags_array(r.uniform(1, 2, 9)).tocsc()
    root = r.normal(size=(n, n))
    pairs = [(s, (root @ root.T) @ s) for s in r.normal(size=(4, n))]
    dense = base.toarray()
    for s, y in pairs:
        image = dense @ s
        dense = dense - np.outer(image, image) / (s @ image) + np.outer(y, y) / (s @ y)
    metric = learnt(base, pairs)
    np.testing.assert_allclose(metric @ np.eye(n), dense, atol=1e-10)
    free = np.array([0, 2, 3, 7])
    inverse = (2.0 * metric).inverse(free)(np.eye(4))
    np.testing.assert_allclose(inverse, np.linalg.inv(2 * dense[np.ix_(free, free)]), atol=1e-10)


def test_negative_curvature_is_damped() -> None:
    d, image = np.array([1.0, 0.0]), np.array([2.0, 0.5])
    kept = damped(d, np.array([-3.0, 1.0]), image)
    assert d @ kept == pytest.approx(0.2 * (d @ image))
    np.testing.assert_array_equal(damped(d, image, image), image)


def test_a_run_that_stands_still_is_asked_for_more() -> None:
    """Its residuals are those of the round before but for rounding: new scales alone do not move it."""
    ocp = co.Problem(10.0)
    x = ocp.state("x", initial=0.0, variance=0.1)
    v = ocp.state("v", initial=0.0, variance=0.1)
    k = ocp.unknown("k", mean=1.0, variance=0.05)
    u = ocp.control("u", guess=0.1)
    ocp.dynamics(x, v)
    ocp.dynamics(v, -k * (2 * x) - 0.1 * v + u, noise=0.01)
    ocp.measurement("place", x, 0.2, every=1.0)
    ocp.minimize_expected((x - 1) ** 2 + 0.1 * u**2, x**2)
    solution = co.solve(ocp, progress=False)
    assert solution.optimality.stationarity is not None
    assert solution.optimality.stationarity < 1e-5


@pytest.mark.parametrize("limit", [1e-2, 1e-3, 1e-4])
def test_limits_of_small_variances_are_met_in_their_own_unit(limit: float) -> None:
    """E <= limit and E/limit <= 1 are one condition: a limit of 1e-3 was met to 1e-5 of itself, and refused for it."""

    def cost(unit: float) -> float:
        ocp = co.Problem(10.0, name="learn gain")
        x, v = ocp.state("x", initial=0.0, variance=0.01), ocp.state("v", initial=0.0, variance=0.01)
        g, u = ocp.unknown("g", mean=1.0, variance=0.25), ocp.control("u")
        ocp.dynamics(x, v)
        ocp.dynamics(v, g * u, noise=1e-4)
        ocp.measurement("m", x, noise=1e-4)
        E = ocp.estimation_covariance()
        ocp.subject_to(E[g, g] / unit, upper=limit / unit, at="final", name="gain known")
        ocp.minimize(running=u**2)
        solution = co.solve(ocp, intervals=50, progress=False)
        assert solution["E"][-1, 2, 2] <= limit * (1 + 1e-6)
        return solution.cost

    assert cost(1.0) == pytest.approx(cost(limit), rel=1e-5)


@pytest.mark.parametrize("prior", [1.0, 0.01])
def test_rounds_that_move_nothing_do_not_use_up_those_that_would(prior):
    """What is left of the cost is a millionth of that at rest, and so is the unit of the first round."""

    def unstable() -> co.Problem:
        ocp = co.Problem(10.0)
        x = ocp.state("x", initial=0.0, variance=0.01)
        b = ocp.unknown("b", mean=1.0, variance=prior)
        u = ocp.control("u")
        ocp.dynamics(x, b * x + u, noise=0.01)
        ocp.measurement("m", x, noise=0.01)
        E = ocp.estimation_covariance()
        ocp.minimize(running=0.01 * u**2, terminal=E[b, b] / prior)
        return ocp

    found, other = (co.solve(unstable(), method, progress=False) for method in ("ipopt", "reduced"))
    assert found.cost == pytest.approx(other.cost, rel=1e-6)
    assert found.optimality.stationarity < 1e-5


@pytest.mark.parametrize("weight", [1e6, 1e8])
def test_a_penalty_of_the_end_is_as_good_as_the_end(weight: float) -> None:
    """Slopes of the order of the cost were called none beside it: 4.63 for 4.2817."""

    def problem(*, free: bool) -> co.Problem:
        ocp = co.Problem(5.0, name="penalised end")
        x = ocp.state("x", initial=0.0, final=None if free else 1.0, variance=0.5)
        b, u = ocp.unknown("b", mean=1.0, variance=1.0), ocp.control("u")
        ocp.dynamics(x, -b * x + u, noise=0.3)
        ocp.measurement("m", x, noise=0.3)
        E = ocp.estimation_covariance()
        ocp.minimize(running=0.5 * u**2, terminal=(weight * (x - 1) ** 2 if free else 0.0) + 10.0 * E[b, b])
        return ocp

    fixed = co.solve(problem(free=False), intervals=30, progress=False)
    assert co.solve(problem(free=True), intervals=30, progress=False).cost == pytest.approx(fixed.cost, rel=2e-6)


def test_a_plant_at_rest_is_solved_again_and_leaves_no_scales_behind() -> None:
    """Its cost vanishes: runs that went on to a share of it ended in magnitudes of nothing, and so did those after."""
    ocp = co.Problem(5.0, name="at rest")
    p = ocp.parameter("p", 0.3)
    x, v = ocp.state("x", initial=p), ocp.state("v", initial=0.0)
    u = ocp.control("u", lower=-2.0, upper=2.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - ca.sin(x))
    ocp.minimize(running=(x - 0.3) ** 2 + v**2 + (u - np.sin(0.3)) ** 2)
    solver, guess = co.Solver(ocp, intervals=20), None
    for _ in range(3):
        guess = solver.solve({"p": 0.3}, guess=guess, progress=False)
        assert guess.cost < 1e-15
    alone = co.Solver(ocp, intervals=20).solve({"p": 1.0}, progress=False)
    assert solver.solve({"p": 1.0}, guess=guess, progress=False).cost == pytest.approx(alone.cost, rel=1e-6)


def ended(running: float, slope: float, varied: float, *, converged: bool = True) -> Round:
    """Where a run might have ended: its cost, what its slopes leave of that, what variables change of it."""
    left = Residuals(slope=slope, complementarity=0.0, infeasibility=0.0, violation=0.0, size=running, varied=varied)
    where: Any = ((), {"parts": [{"running": running, "terminal": 0.0}]})
    rest: Any = {"nlp": None, "point": None}
    return Round(**rest, where=where, residuals=left, converged=converged, settled=False)


def test_of_points_that_have_converged_the_cheapest_counts() -> None:
    """Beside a weight of 7e11 both leave slopes: what came second, with smaller ones, cost 1115 for 37.9."""
    cheap, dear, alike = ended(37.9, 3e4, 3.3e12), ended(1115.0, 47.0, 6e14), ended(37.9 + 1e-7, 2e4, 3.3e12)
    assert best_of([cheap, dear]) is cheap
    assert best_of([cheap, alike, dear]) is alike
    assert best_of([cheap, dear, ended(1.0, 0.1, 1e12, converged=False)]) is cheap
