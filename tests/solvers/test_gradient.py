"""The gradient method of Schmidt, chapter 4, against closed forms, its own predictions and the shooting method."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from problems import unassessed

import covocp as co
from covocp.models import (
    chord_test,
    damped_oscillator,
    free_time_integrator,
    mass_chain,
    noisy_integrator,
    unknown_gain,
    unknown_lag,
)
from covocp.solvers.gradient import influence, iterate, one_iteration, prepare
from covocp.solving.warm_start import make_guess
from covocp.transcription.mesh import Options


def noisy(
    alpha: float = 0.0, beta: float = 0.0, *, final: float | None = 1.0, guess: Any = (1.0, 1.0), **bounds: float
) -> co.Problem:
    """The integrator of [3.4] without its bound x >= 0."""
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", initial=0.0, final=final)
    u = ocp.control("u", guess=guess, **bounds)
    ocp.dynamics(x, u)
    E = ocp.symmetric("E", 1, initial=0.0)
    ocp.dynamics(E, x)
    ocp.minimize(running=0.5 * u**2 + beta * E, terminal=alpha * E)
    return ocp


def solve(problem: co.Problem, **options: Any) -> co.Solution:
    return co.solve(problem, method="gradient", progress=False, **options)


@pytest.mark.parametrize(("alpha", "beta"), [(0, 0), (0, 1), (1, 0)])
def test_closed_forms_of_the_noisy_integrator(alpha: float, beta: float) -> None:
    # H_uu = 1 and the costates do not depend on u: one step with W = H_uu is exact. The piecewise-linear control adds
    # (h^4/1440) int u''^2 dt to the cost.
    solution = solve(noisy_integrator.problem(alpha, beta))
    exact = noisy_integrator.exact(alpha, beta)
    assert solution.converged
    assert solution.stats["iterations"] == 1
    assert solution.cost == pytest.approx(exact.cost, abs=1e-10)
    assert solution.multipliers.final[0] == pytest.approx(exact.ell, abs=1e-8)
    # The L2 projection of a parabola on hats misses it by up to h^2/8.
    np.testing.assert_allclose(solution["u"], exact.u, atol=1e-4 / 8)
    np.testing.assert_allclose(solution.costate("E")[:, 0, 0], exact.P, atol=1e-12)


def test_worked_iteration() -> None:
    # [4.4] on case b with u = 1, W = 1. The cost of a parabola on 100 hats is h^4/720 = 1.4e-11 away.
    iteration = one_iteration(noisy(0, 1).statement(), Options(intervals=100), weight=1.0)
    expected = {
        "I_kk": 1,
        "I_kj": 7 / 6,
        "I_jj": 83 / 60,
        "ell": -7 / 6,
        "predicted_cost": -1 / 45,
        "actual_cost": -1 / 90,
        "predicted_miss": 0,
        "actual_miss": 0,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(np.squeeze(getattr(iteration, name)), value, atol=1e-9, err_msg=name)
    t = np.linspace(0, 1, 101)
    np.testing.assert_allclose(iteration.change[:, 0], -1 / 3 + t - t**2 / 2, atol=1e-4 / 8)


def test_one_iteration_with_free_time() -> None:
    # 6.6 with w = 1 from u = 1, T = 1: h = 3/2 everywhere, chi_0 = 5/2, I_kk = 1, I_kj = 3/2, I_jj = 7/3. With b = 4:
    # l = -(1 + 1/4)^-1 (3/2 + 5/8) = -1.7, du = t - 0.3, dT = -(5/2 - 1.7)/4 = -0.2,
    # predicted dJ = -0.2 * 5/2 - 7/3 + 1.7 * 3/2.
    ocp = co.Problem(co.Free(guess=1.0))
    x = ocp.state("x", initial=0.0, final=1.0)
    u = ocp.control("u", guess=np.ones(2))
    ocp.dynamics(x, u)
    E = ocp.symmetric("E", 1, initial=0.0)
    ocp.dynamics(E, x)
    ocp.minimize(running=0.5 * u**2, terminal=E + ocp.duration)
    iteration = one_iteration(ocp.statement(), Options(intervals=20), duration_weight=4.0)
    assert iteration.I_jj == pytest.approx(7 / 3, abs=1e-12)
    assert iteration.ell == pytest.approx(-1.7, abs=1e-12)
    assert iteration.duration_change == pytest.approx(-0.2, abs=1e-12)
    np.testing.assert_allclose(iteration.change[:, 0], np.linspace(0, 1, 21) - 0.3, atol=1e-12)
    assert iteration.predicted_cost == pytest.approx(-0.5 - 7 / 3 + 2.55, abs=1e-12)
    assert iteration.predicted_miss == pytest.approx(0.0, abs=1e-12)


def test_predictions_are_first_order() -> None:
    # Halving the step (doubling W and b) quarters the difference between predicted and actual changes. u is not
    # constant, so stretching it with T matters.
    def differences(size: float) -> np.ndarray:
        ocp = unknown_lag.problem(final=1.0, duration_weight=0.3)
        step = one_iteration(
            ocp.statement(), Options(intervals=200), weight=size, fraction=1 / size, duration_weight=size
        )
        cost = step.actual_cost - step.predicted_cost
        return np.array([cost, *(step.actual_miss - step.predicted_miss)])

    ratio = differences(400.0) / differences(800.0)
    np.testing.assert_allclose(ratio, 4.0, rtol=0.05)


@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_free_time(weight: float) -> None:
    exact = free_time_integrator.exact(weight)
    solution = solve(free_time_integrator.problem(weight))
    assert solution.duration == pytest.approx(exact.duration, abs=1e-6)
    assert solution.cost == pytest.approx(exact.cost, rel=1e-9)
    assert solution.multipliers.final[0] == pytest.approx(exact.ell, abs=1e-6)
    assert solution.optimality.transversality == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("start", [-3.0, 0.0, 10.0])
def test_chord_is_exact_after_one_step(start: float) -> None:
    exact = chord_test.exact()
    solution = solve(
        chord_test.problem(), variant="chord", guess={"u": start * np.ones(101)}, max_iterations=1, allow_failure=True
    )
    assert solution.converged
    # u'' = -6 u u'^2/(1 + 3 u^2) is below 0.35, so the hats cost less than h^4 u''^2 (1 + 3 u^2)/1440.
    assert solution.cost == pytest.approx(exact.cost, abs=1e-10)
    np.testing.assert_allclose(solution["u"], exact.u, atol=1e-5)


def test_chord_with_terminal_conditions_and_free_time() -> None:
    for problem, guess in (
        (free_time_integrator.problem(), None),
        (unknown_lag.problem(weight=1.0, final=1.0), {"u": 0.5}),  # no other side is looked at
    ):
        one, two = solve(problem, variant="chord", guess=guess), solve(problem)
        assert one.cost == pytest.approx(two.cost, rel=1e-9)


def test_a_chord_step_of_a_quadratic_hamiltonian_takes_one_newton_step_with_a_free_duration_too(monkeypatch) -> None:
    calls = []
    monkeypatch.setattr(iterate, "reweigh", lambda *args: calls.append(1) or influence.reweigh(*args))
    solution = solve(free_time_integrator.problem(), variant="chord", guess={"u": 0.5})
    # one more where the conditions along the new control are looked at
    assert len(calls) <= 2 * (solution.stats["iterations"] + 1)


CASES = {
    "unknown gain": (unknown_gain.problem(), {}),
    **{
        f"lag, {final:g}, {weight:g}": (unknown_lag.problem(weight, final), {})
        for final in (0.0, 1.0)
        for weight in (0.1, 1.0, 10.0)
    },
    "lag, free time": (unknown_lag.problem(10.0, 1.0, duration_weight=0.2), {}),
    **{
        f"oscillator, {naming}, {a:g}, {b:g}": (damped_oscillator.problem(a, b, naming=naming), {})
        for naming in damped_oscillator.NAMINGS
        for a, b in ((0.0, 0.0), (1000.0, 0.0), (0.0, 1000.0))
    },
    "chord test": (chord_test.problem(), {}),
    "chain": (mass_chain.problem(), {"intervals": 50, "control": "constant"}),
}


@pytest.mark.parametrize("name", CASES)
def test_same_cost_as_shooting(name: str) -> None:
    problem, options = CASES[name]
    gradient, shooting = (unassessed(problem, method, **options) for method in ("gradient", "ipopt"))
    assert gradient.cost == pytest.approx(shooting.cost, rel=1e-6)
    np.testing.assert_allclose(
        gradient.multipliers.final,
        shooting.multipliers.final,
        atol=1e-9 + 1e-3 * np.abs(shooting.multipliers.final).max(),
    )
    assert gradient.violations == {}


def test_bounds_by_projection() -> None:
    # p = l + 1 - t, u = min(top, c + t) with c + t1 = top; x(1) = top - t1^2/2 = 1.
    top = 1.2
    t1 = np.sqrt(2 * (top - 1))
    start = top - t1
    solution = solve(noisy(1.0, upper=top), intervals=200)
    t = solution.t
    # The kink lies inside an interval: an error of the order of h there.
    np.testing.assert_allclose(solution["u"], np.minimum(top, start + t), atol=2 / 200)
    assert solution["u"].max() <= top
    energy = ((start + t1) ** 3 - start**3) / 6 + top**2 / 2 * (1 - t1)
    final_E = start * t1**2 / 2 + t1**3 / 6 + (start * t1 + t1**2 / 2) * (1 - t1) + top * (1 - t1) ** 2 / 2
    assert solution.cost == pytest.approx(energy + final_E, abs=(1 / 200) ** 2)
    assert solution.multipliers.final[0] == pytest.approx(-start - 1, abs=1e-4)
    # The multiplier of the bound is -H_u = -(top + p) dt >= 0.
    weights = np.gradient(t)
    inside = t > t1 + 0.01
    expected = (-top + start + t) * weights
    np.testing.assert_allclose(solution.multipliers.controls[inside, 0][:-1], expected[inside][:-1], atol=1e-7)
    assert solution.optimality.stationarity < 1e-8


@pytest.mark.parametrize(("guess", "control_weight"), [(3.0, 0.0), (2.2, 0.0), (3.0, 0.01), (5.0, 0.1)])
def test_terminal_conditions_against_saturated_controls(guess: float, control_weight: float) -> None:
    """A mass moved by 1 m from rest to rest at least T + w int u^2, |u| <= 1: bang-bang with T = 2 s for w = 0.

    The cost pulls T down so hard that saturated controls cannot meet the end. By H = 0 in the middle, where u = 0, the
    control is saturated for t1 and then falls within s, s (1 - w) = 2 w t1, t1^2/2 + t1 s + s^2/3 = 1/2.
    """
    ocp = co.Problem(duration=co.Free(guess))
    x = ocp.state("x", 2, initial=0.0, final=[1.0, 0.0])
    u = ocp.control("u", lower=-1.0, upper=1.0)
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize(running=control_weight * u**2, terminal=ocp.duration)
    solution = solve(ocp, intervals=100)
    share = 2 * control_weight / (1 - control_weight)  # s / t1
    t1 = np.sqrt(0.5 / (0.5 + share + share**2 / 3))
    exact = 2 * t1 * (1 + share) + 2 * control_weight * t1 * (1 + share / 3)
    assert solution.cost == pytest.approx(exact, rel=2e-4)  # the switch of a continuous control takes an interval
    assert solution.stats["iterations"] < 20


def test_penalty_against_the_arc_on_the_bound() -> None:
    # Weight 5: x = u = 0 until t1 = 1 - sqrt(2/5). The mesh adds an error of the order of h^2 (the corner of u).
    exact = noisy_integrator.exact(5.0)
    assert exact.arc > 0.3
    solution = solve(noisy_integrator.problem(5.0), intervals=50)
    assert solution.converged
    assert solution.stats["passes"] > 1
    assert solution.cost == pytest.approx(exact.cost, rel=1e-5)
    assert solution["x"].min() > -1e-5
    assert solution.multipliers.final[0] == pytest.approx(exact.ell, rel=1e-3)


def test_penalty_on_controls_agrees_with_the_projection() -> None:
    ocp = noisy(1.0)
    ocp.subject_to(ocp.declarations.controls[0].symbol - 1.2, name="cap")
    one, two = solve(ocp, intervals=50), solve(noisy(1.0, upper=1.2), intervals=50)
    assert one.cost == pytest.approx(two.cost, rel=1e-6)
    np.testing.assert_allclose(one.multipliers.path[:, 0], two.multipliers.controls[:, 0], atol=1e-5)


def test_final_value_of_a_matrix() -> None:
    # x' = u, E' = x, x(1) = 1, E(1) = 0.4: u = a + b t with a + b/2 = 1, a/2 + b/6 = 0.4; p = l_x + l_E (1 - t) = -u.
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", initial=0.0, final=1.0)
    u = ocp.control("u")
    E = ocp.symmetric("E", 1, initial=0.0, final=0.4)
    ocp.dynamics(x, u)
    ocp.dynamics(E, x)
    ocp.minimize(running=0.5 * u**2)
    solution = solve(ocp, intervals=20)
    assert solution.multipliers.final_matrices == pytest.approx([1.2], abs=1e-10)
    assert solution.multipliers.final == pytest.approx([-1.6], abs=1e-10)
    assert solution.cost == pytest.approx(0.56, abs=1e-12)


def test_conditions_between_final_values() -> None:
    # min int |u|^2/2, x + y = 1 and x <= 0.2 at the end: u = (0.2, 0.8), multipliers -0.8 and 0.6.
    ocp = co.Problem(duration=1.0)
    x, y = ocp.state("x", initial=0.0), ocp.state("y", initial=0.0)
    u = ocp.control("u", 2)
    ocp.dynamics(x, u[0])
    ocp.dynamics(y, u[1])
    ocp.subject_to(x + y - 1, lower=0.0, upper=0.0, at="final", name="sum")
    ocp.subject_to(x - 0.2, at="final", name="cap")
    ocp.minimize(running=0.5 * ca.sumsqr(u))
    solution = solve(ocp, intervals=10)
    assert solution.multipliers.end == pytest.approx([-0.8, 0.6], abs=1e-4)
    assert solution.cost == pytest.approx(0.34, abs=1e-5)


def test_free_initial_state() -> None:
    # min int (u^2 + x^2)/2, x(1) = 1, x(0) free: x = cosh t / cosh 1, J = tanh(1)/2.
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", initial=None, final=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * (u**2 + x**2))
    solution = solve(ocp, intervals=100)
    assert solution["x"][0] == pytest.approx(1 / np.cosh(1), abs=1e-6)
    assert solution.cost == pytest.approx(0.5 * np.tanh(1), abs=1e-9)
    assert solution.costate("x")[0] == pytest.approx(0.0, abs=1e-6)


def test_matrix_that_drives_the_nominal() -> None:
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", initial=0.0, final=1.0)
    u = ocp.control("u")
    E = ocp.symmetric("E", 1, initial=0.1)
    ocp.dynamics(x, u - E * x)
    ocp.dynamics(E, x - E)
    ocp.minimize(running=0.5 * u**2, terminal=E)
    assert solve(ocp).cost == pytest.approx(co.solve(ocp, progress=False).cost, rel=1e-7)


def test_uncontrollable_condition_is_an_error() -> None:
    ocp = co.Problem(duration=1.0)
    x, y = ocp.state("x", initial=0.0, final=1.0), ocp.state("y", initial=0.0, final=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.dynamics(y, -y)
    ocp.minimize(running=0.5 * u**2)
    with pytest.raises(co.ProblemError, match="no influence on final value of y"):
        solve(ocp)


def test_dependent_conditions_are_an_error() -> None:
    ocp = co.Problem(duration=1.0)
    x, y = ocp.state("x", initial=0.0, final=1.0), ocp.state("y", initial=0.0, final=2.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.dynamics(y, u)
    ocp.minimize(running=0.5 * u**2)
    with pytest.raises(co.ProblemError, match="cannot be met"):
        solve(ocp)


def test_stop_test_does_not_depend_on_the_weighting() -> None:
    problem = unknown_lag.problem(weight=1.0, final=1.0)
    first, ends = [], []
    for weight, factor in ((1.5, 1.0), ("curvature", 2.0), ("adaptive", 1.0)):
        solution = unassessed(problem, "gradient", weight=weight, weight_factor=factor, intervals=20)
        first.append(solution.stats["history"][0]["slope"])
        ends.append(solution)
    np.testing.assert_allclose(first, first[0], rtol=1e-12)
    for solution in ends:
        assert solution.stats["history"][-1]["slope"] <= 1e-6
        assert solution.cost == pytest.approx(ends[0].cost, rel=1e-9)


def test_too_small_a_weight_does_not_look_solved() -> None:
    with pytest.raises(co.SolveError, match="raise the weight"):
        solve(unknown_lag.problem(), weight=0.1, intervals=50)


@pytest.mark.parametrize(
    ("name", "value"),
    [("variant", "newton"), ("weight", "large"), ("weight", -1.0), ("fraction", 0.0), ("weight_factor", 0)],
)
def test_options_are_checked(name: str, value: Any) -> None:
    with pytest.raises(co.ProblemError, match=f"'{name}'"):
        solve(noisy(), **{name: value})


class Stop:
    """A progress whose user interrupts at the third report."""

    def __init__(self) -> None:
        self.stop, self.reports = False, []

    def update(self, iteration: int, cost: float, violation: float) -> None:
        self.reports.append((iteration, cost, violation))
        self.stop = len(self.reports) >= 3


def test_interruption_returns_the_last_iterate() -> None:
    statement = unknown_lag.problem().statement()
    solver = prepare(statement, Options(intervals=50))
    guess = make_guess(statement, solver.mesh, statement.values, None)
    progress: Any = Stop()
    outcome = solver.solve(statement.values, guess, progress)
    assert not outcome.converged
    assert "interrupted" in outcome.message
    assert [iteration for iteration, _, _ in progress.reports] == [0, 1, 2]
    assert sum(outcome.cost_terms.values()) == pytest.approx(progress.reports[-1][1])
    assert np.isfinite(outcome.extremal.trajectory.e).all()


def test_new_parameters_without_rebuilding() -> None:
    solver = co.Solver(noisy_integrator.problem(), method="gradient", intervals=50)
    for alpha in (0.0, 1.0):
        solution = solver.solve({"terminal_weight": alpha}, progress=False)
        assert solution.cost == pytest.approx(noisy_integrator.exact(alpha).cost, abs=1e-10)


def test_a_plant_that_runs_away_ends_as_an_error_without_numpy_telling_of_overflows() -> None:
    ocp = co.Problem(200.0)
    x, v = ocp.state("x", initial=0.0), ocp.state("v", initial=0.0)
    u = ocp.control("u", guess=0.1)
    ocp.dynamics(x, v)
    ocp.dynamics(v, 2 * x + u)
    ocp.minimize(running=u**2 + x**2)
    with pytest.raises(co.SolveError):
        co.solve(ocp, "gradient", max_iterations=10, progress=False)


@pytest.mark.parametrize("final", [None, 0.0])
@pytest.mark.parametrize("variant", ["gradient", "chord"])
def test_where_nothing_is_to_be_done_the_controls_are_zero(final, variant):
    """All terms of H_u fall with the controls, none is small beside the others: runs went on to a cost of 1e-267."""
    ocp = co.Problem(10.0)
    x, u = ocp.state("x", initial=0.0, final=final), ocp.control("u", guess=1.0)
    ocp.dynamics(x, -x + u)
    ocp.minimize(running=0.5 * u**2)
    solution = co.solve(ocp, "gradient", variant=variant, progress=False)
    assert solution.cost == 0.0
    assert not solution.controls.any()
    assert solution.stats["iterations"] <= 3


def test_slopes_whose_squares_are_no_numbers_are_not_remembered():
    """Where nothing is learnt yet of a squared distance, a first step sees the curvature of a run-away cost."""
    ocp = co.Problem(7.98583251431159)
    x, z = ocp.state("x", initial=0.0, final=1.0, variance=0.1), ocp.unknown("z", mean=0.0, variance=0.5)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=0.05)
    ocp.measurement("m", (x - z) ** 2, noise=0.010871872224233789)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=0.27190384789361033 * E[z, z])
    found = co.solve(ocp, "gradient", intervals=30, progress=False)
    assert found.cost == pytest.approx(co.solve(ocp, intervals=30, progress=False).cost, rel=1e-4)
