"""The reported residuals of the necessary conditions: small at a solution, of the order they claim, and not blind."""

from __future__ import annotations

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from certificates import lag_hamiltonian
from problems import LAG_COSTS, LAG_EIGENVALUE, lag, order, solve

import covocp as co
from covocp.base.krylov import krylov
from covocp.extremal.curvature import smallest_curvature
from covocp.extremal.optimality import _stationarity, assess
from covocp.models import (
    brachistochrone,
    bryson_denham,
    free_time_integrator,
    mass_chain,
    noisy_integrator,
    unknown_lag,
)

FORMULATIONS = ("eliminated", "states")


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("control", ["linear", "constant"])
def test_residuals_of_a_solution(formulation, control):
    optimality = solve(lag().problem, covariances=formulation, control=control, intervals=50).optimality
    assert optimality.stationarity < 1e-5
    assert optimality.costate_difference < 1e-3
    assert optimality.curvature > 1e-3
    assert optimality.transversality is None
    assert 0 < optimality.mesh_error < 1e-5
    assert optimality.smallest_eigenvalue > 0.1
    if control == "linear":
        assert optimality.hamiltonian_variation < 1e-3
        assert optimality.control_slope < 2e-3


def test_residuals_of_the_chain():
    optimality = solve(mass_chain.problem(2), intervals=80).optimality
    assert optimality.stationarity < 1e-5
    assert optimality.costate_difference < 1e-2
    assert optimality.hamiltonian_variation < 1e-3


@pytest.mark.parametrize("final", [0.0, 1.0])
def test_mesh_error_estimates_the_mesh_error(final):
    """Against the true error of the integration: the cost of the same mesh with many substeps."""
    for intervals in (20, 40):
        problem = lag(10.0, final).problem
        solution = solve(problem, intervals=intervals)
        fine = solve(problem, intervals=intervals, substeps=8).cost
        assert solution.mesh_error == pytest.approx(abs(fine - solution.cost) / fine, rel=0.35)


@pytest.mark.parametrize(("control", "intervals"), [("constant", 20), ("linear", 5)])
def test_control_error_estimates_the_error_of_the_control(control, intervals):
    """The noisy integrator is integrated exactly, so that the error of the cost is that of the control's form."""
    solution = solve(noisy_integrator.problem(0.0, 1.0), control=control, intervals=intervals, tolerance=1e-11)
    truth = (solution.cost - 59 / 90) / (59 / 90)
    assert solution.optimality.control_error == pytest.approx(truth, rel=0.1)


@pytest.mark.parametrize("noise", [1e-3, 1e-4, 1e-5])
def test_costates_behind_accurate_sensors_are_compared_where_explicit_steps_reach(noise):
    """Differences had been 6e159, and 0 where they overflowed; the costates are right, see the last assertion."""

    def behind(noise, start):
        ocp = co.Problem(10.0)
        x = ocp.state("x", initial=start, final=1.0, variance=1.0)
        b = ocp.unknown("b", mean=1.0, variance=5.0)
        u = ocp.control("u")
        ocp.dynamics(x, -b * x + u, noise=1.0)
        ocp.measurement("position", x, noise=noise)
        ocp.minimize(running=0.5 * u**2, terminal=10 * ocp.estimation_covariance()[b, b])
        return ocp

    solution = solve(behind(noise, 0.0), intervals=100)
    assert 1e-9 < solution.optimality.costate_difference < 0.1
    ahead, back = (solve(behind(noise, s), intervals=100, guess=solution, tolerance=1e-10).cost for s in (1e-3, -1e-3))
    assert solution.costate("x")[0] == pytest.approx((ahead - back) / 2e-3, rel=1e-4)


def test_costates_that_explicit_steps_do_not_reach_are_not_compared():
    """All the way each interval is 1e5 times as long as the covariance lives."""
    ocp = co.Problem(10.0)
    x = ocp.state("x", initial=1.0, variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=1.0)
    ocp.measurement("position", x, noise=1e-12)
    ocp.minimize(running=u**2 + x**2 + ocp.estimation_covariance()[x, x])
    with pytest.warns(co.CovocpWarning, match="The integration steps are long"):
        solution = solve(ocp, intervals=10)
    assert solution.optimality.costate_difference is None
    assert "not checked" in str(solution)


def test_stationarity_does_not_grow_with_an_interval_that_is_short():
    """A control that acts for 1e-5 of the time has its slope from rounding of the cost, divided by that time."""
    extremal = solve(lag().problem, grid=[0.0, *(0.02 * np.arange(1, 50)), 1.0 - 1e-9, 1.0]).extremal
    left = np.zeros((52, 1))
    left[-1] = 1e-9
    units = extremal.trajectory.duration / 51
    assert _stationarity(extremal, left, 1.0, 0.0) == pytest.approx(1e-9 / units, rel=0.1)


def test_residuals_shrink_with_the_mesh():
    counts, slopes, variations, differences = [20, 40, 80], [], [], []
    for n in counts:
        optimality = solve(lag().problem, intervals=n, substeps=1, tolerance=1e-10).optimality
        slopes.append(optimality.control_slope)
        variations.append(optimality.hamiltonian_variation)
        differences.append(optimality.costate_difference)
    assert order(counts, slopes) > 1.7
    assert order(counts, variations) > 2.0
    assert order(counts, differences) > 3.0


def test_reported_hamiltonian_variation():
    """Against H written out."""
    solution = solve(lag().problem, intervals=50)
    values = lag_hamiltonian(solution)
    p, u, x = solution.costate("x"), solution["u"], solution["x"]
    size = np.abs(p * (-x + u)).max()
    reported = solution.optimality.hamiltonian_variation
    assert np.ptp(values) / (10 * size) < reported < 10 * np.ptp(values) / size


def test_explicit_time_has_no_constant_hamiltonian():
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u * ca.exp(ocp.time))
    ocp.minimize(running=0.5 * u**2)
    assert solve(ocp, intervals=20).optimality.hamiltonian_variation is None


@pytest.mark.parametrize("w", [1.0, 0.2])
def test_transversality_vanishes(w):
    """The control is linear in time, and so exact."""
    assert solve(free_time_integrator.problem(w), intervals=10, tolerance=1e-9).optimality.transversality < 1e-7


def test_an_iterate_is_not_optimal():
    solution = solve(lag().problem, max_iterations=2, allow_failure=True, intervals=30)
    assert solution.optimality.stationarity > 1e-3


@pytest.mark.filterwarnings("ignore:This is no minimum")  # a run of no steps at a saddle
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_curvature_is_negative_at_the_saddle(formulation):
    """u = 0 of 5.2 above the weight 0.0459816, positive below it."""
    signs = []
    for weight in (0.045, 0.047, 10.0):
        solution = solve(
            lag(weight, 0.0, guess=np.zeros(51)).problem,
            covariances=formulation,
            intervals=50,
            max_iterations=0,
            allow_failure=True,
        )
        np.testing.assert_allclose(solution["u"], 0, atol=1e-9)
        signs.append(np.sign(solution.optimality.curvature))
    assert signs == [1, -1, -1]


@pytest.mark.filterwarnings("ignore:This is no minimum")  # a run of no steps at a saddle
def test_curvature_at_the_saddle_is_that_of_the_closed_form():
    """J = C22/(1/5 + 2 lambda energy) + energy with energy = a^2/2 along the eigenfunction: J'' = 1 - 50 lambda C22."""
    for weight in (0.02, 1.0):
        problem = lag(weight, 0.0, guess=np.zeros(80)).problem
        options = {"control": "constant", "intervals": 80, "max_iterations": 0, "allow_failure": True}
        curvature = smallest_curvature(solve(problem, **options).extremal)
        expected = 1 - 50 * LAG_EIGENVALUE * weight
        assert curvature.value == pytest.approx(expected, abs=2e-3 * 50 * weight)


def test_lanczos_finds_extreme_eigenvalues():
    generator = np.random.default_rng(3)
    vectors = np.linalg.qr(generator.standard_normal((80, 80)))[0]
    values = np.concatenate([[-2.0], np.linspace(0.9, 1.1, 78), [5.0]])
    matrix = vectors @ np.diag(values) @ vectors.T
    found = krylov(
        lambda v: matrix @ v,
        generator.standard_normal(80),
        60,
        lambda value, residual, largest: residual < 1e-6 * largest,
    )
    assert found.asymmetry < 1e-12
    right = generator.standard_normal(80)
    solved = krylov(lambda v: matrix @ v, right, 60, lambda *_: False).inverse_form(
        3.0, float(np.linalg.norm(right)), -2.0
    )
    assert solved == pytest.approx(right @ np.linalg.solve(matrix + 3.0 * np.eye(80), right), rel=1e-9)
    assert found.values[0] == pytest.approx(-2.0, abs=1e-8)
    assert found.values[-1] == pytest.approx(5.0, abs=1e-8)
    assert abs(found.vectors[:, 0] @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-8)


def test_state_bound_counts_in_the_residuals():
    solution = solve(bryson_denham.problem(0.2), intervals=50)
    assert solution.optimality.stationarity < 1e-6
    assert solution.optimality.costate_difference < 1e-6


def test_covariance_steps_that_explode_are_refused_by_name():
    """rk4 far beyond its stability: the covariance of the first guess already leaves the range of numbers."""
    problem = lag(10.0, 1.0, noise=1e-3).problem
    with pytest.raises(co.ProblemError, match="covariance_step='gauss'"):
        solve(problem, covariance_step="rk4", substeps=1, intervals=40, max_iterations=60, allow_failure=True)


def test_substeps_follow_the_stiffness():
    """Chosen for rk4 where it would explode otherwise; 5.2 with U = 1e-3 then costs what gauss finds."""
    solution = solve(lag(10.0, 0.0, noise=1e-3).problem, covariance_step="rk4", intervals=200)
    assert solution.mesh.substeps > 1
    assert solution.cost == pytest.approx(4.5802190, rel=1e-6)


def test_printing():
    text = str(solve(lag().problem, intervals=20).optimality)
    for word in ("stationarity", "curvature", "mesh error"):
        assert word in text


def test_cost_is_the_sum_of_its_terms():
    solution = solve(lag().problem)
    E22 = solution["E"][-1, 1, 1]
    u, t = solution["u"], solution.t
    energy = np.sum((u[1:] ** 2 + u[1:] * u[:-1] + u[:-1] ** 2) / 6 * np.diff(t))
    assert solution.cost_terms["terminal"] == pytest.approx(10 * E22, rel=1e-10)
    assert solution.cost_terms["running"] == pytest.approx(energy, rel=1e-10)
    assert solution.cost == pytest.approx(LAG_COSTS[1.0, 10.0], rel=1e-6)


def test_a_cost_of_zero_is_no_coarse_mesh():
    """A decay followed exactly costs nothing; roundoff is no share of that."""
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", initial=None)
    ocp.dynamics(x, -x)
    ocp.minimize(terminal=(x - 1.0) ** 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error", co.CovocpWarning)
        solution = co.solve(ocp, intervals=20, progress=False)
    assert solution["x"][0] == pytest.approx(np.e, rel=1e-6)
    assert solution.mesh_error < 1e-8


@pytest.mark.parametrize("method", ["ipopt", "gradient"])
@pytest.mark.parametrize("dynamics", ["one term", "decaying term", "terms of the costates"])
def test_slope_has_a_size_without_a_running_cost(method, dynamics):
    """H_u = p' f_u alone: it vanishes at the optimum, and is no measure of itself."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    if dynamics == "terms of the costates":  # u = 1
        y = ocp.state("y", initial=0.0, final=1.0)
        ocp.dynamics(y, u)
        ocp.dynamics(x, u**2)
        ocp.minimize(terminal=x)
        cost = 1.0
    else:  # u = 1/2
        decay = 0.3 if dynamics == "decaying term" else 0.0
        ocp.dynamics(x, u - u**2 - decay * x)
        ocp.minimize(terminal=-x)
        cost = -0.25 * (1 - np.exp(-decay)) / decay if decay else -0.25
    solution = solve(ocp, method=method, intervals=20)
    assert solution.cost == pytest.approx(cost, rel=1e-7)
    assert solution.optimality.stationarity < 1e-5
    trajectory = replace(solution.trajectory, u=1.1 * solution["u"][:, None])
    off = replace(solution, extremal=replace(solution.extremal, trajectory=trajectory))
    assert off.optimality.stationarity > 1e-2


def test_minimum_time_by_the_gradient_method_is_stationary():
    assert solve(brachistochrone.problem(), method="gradient", intervals=50).optimality.stationarity < 1e-5


def under_a_roof(roof: float, **jump: float) -> co.Problem:
    """A mass over a distance of 1 in 1 s with the least energy: 12 where the roof is out of reach."""
    ocp = co.Problem(1.0)
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.subject_to(v, upper=roof, name="roof")
    ocp.minimize(running=u**2)
    return ocp


def test_the_form_of_the_controls_counts_beside_a_limit_that_is_never_reached():
    """It was called 0 as soon as there was any condition along the path."""
    solution = co.solve(under_a_roof(100.0), intervals=6, control="constant", progress=False)
    assert solution.optimality.control_error == pytest.approx(solution.cost / 12.0 - 1.0, rel=1e-3)
    assert solution.optimality.control_slope > 0.0


def test_the_form_of_the_controls_is_told_where_a_limit_is_reached():
    """Two parabolas of the speed and a rest at the roof; see also test_finer_cost.py."""
    solution = co.solve(under_a_roof(1.3), intervals=6, progress=False)
    optimum = 16.0 / 9.0 * 1.3**3 / 0.3
    assert solution.optimality.control_error == pytest.approx(solution.cost / optimum - 1.0, rel=0.5)
    assert solution.optimality.control_slope is None
    assert "estimated effect of the piecewise" in str(solution)


@pytest.mark.parametrize("at", [[0.25], [0.25, 0.5, 0.75], [0.0, 0.5, 1.0]])
def test_a_free_duration_meets_its_condition_with_readings_and_limits_inside_the_intervals(at: list[float]) -> None:
    """The instants move with the duration; those of the mesh were looked for on the one of all points."""

    def learning(duration: float | co.Free) -> co.Problem:
        ocp = co.Problem(duration)
        x, b = ocp.state("x", initial=0.0, final=1.0, variance=0.3), ocp.unknown("b", mean=1.0, variance=0.5)
        u = ocp.control("u", lower=-5.0, upper=5.0)
        ocp.dynamics(x, u - b * x, noise=0.01)
        ocp.measurement("m", x, noise=0.01, at=at, relative=True)
        E = ocp.estimation_covariance()
        ocp.subject_to(x, upper=1.5, name="wall")
        ocp.minimize(running=0.05 * u**2 + 0.1, terminal=E[b, b])
        return ocp

    best = co.solve(learning(co.Free(1.5, 0.5, 8.0)), intervals=20, points=2, progress=False)
    assert best.optimality.transversality < 1e-4
    for share in (0.97, 1.03):
        fixed = co.solve(learning(share * best.duration), intervals=20, points=2, guess=best, progress=False)
        assert fixed.cost > best.cost


@pytest.mark.parametrize("constant", [0.0, 1e6])
def test_transversality_away_from_all_bounds_is_told_whatever_constants_cost(constant):
    """Of a fixed duration it is the slope of the costs of fixed durations, in terms of H."""

    def problem(duration):
        ocp = co.Problem(duration)
        x, v = ocp.state("x", initial=0.0, final=3.0), ocp.state("v", initial=0.0, final=0.0)
        u = ocp.control("u", guess=0.5)
        ocp.dynamics(x, v)
        ocp.dynamics(v, u - 0.3 * v**3)
        ocp.minimize(running=0.4 + 0.5 * u**2, terminal=constant)
        return ocp

    T, step = 3.5, 1e-2
    fixed = co.solve(problem(T), intervals=100, progress=False)
    costs = [co.solve(problem(T + s), intervals=100, progress=False).cost for s in (-step, step)]
    slope = (costs[1] - costs[0]) / (2 * step)
    v, u, p = fixed["v"], fixed["u"], fixed.costates.state
    terms = np.abs(p[:, 0] * v) + np.abs(p[:, 1] * (u - 0.3 * v**3)) + 0.4 + 0.5 * u**2
    free = co.Solver(problem(co.Free(T, 2.0, 12.0)), intervals=100).statement
    found = assess(replace(fixed.extremal, stated=free), fixed.costates, 0.0, np.inf)
    assert found.transversality == pytest.approx(abs(slope) / terms.max(), rel=1e-2)


def test_transversality_is_zero_where_a_bound_holds_the_duration():
    """Of which a solver stays a little off."""

    def problem(upper):
        ocp = co.Problem(co.Free(2.5, 2.0, upper))
        x, v = ocp.state("x", initial=0.0, final=3.0), ocp.state("v", initial=0.0, final=0.0)
        u = ocp.control("u", guess=0.5)
        ocp.dynamics(x, v)
        ocp.dynamics(v, u)
        ocp.minimize(running=0.4 + 0.5 * u**2)
        return ocp

    free = co.solve(problem(20.0), intervals=40, progress=False).duration
    held = co.solve(problem(0.7 * free), intervals=40, progress=False)
    assert held.duration == pytest.approx(0.7 * free, rel=1e-5)
    assert held.optimality.transversality == 0.0


@pytest.mark.parametrize("intervals", [100, 200])
def test_a_hamiltonian_that_is_rounding_does_not_vary(intervals: int) -> None:
    """Of a plant so fast that nothing can be learnt the best control is none: all terms of H are what rounding left."""
    solver = co.Solver(unknown_lag.problem(weight=10.0), intervals=intervals)
    solution = solver.solve(means={"b": 10.0}, progress=False)
    assert solution.cost == pytest.approx(50.0, rel=1e-9)
    assert solution.optimality.hamiltonian_variation < 1e-3
