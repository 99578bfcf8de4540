"""Gains of a control that is held over a period, and the spread of the loop that flies with them."""

from __future__ import annotations

import warnings

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, quick
from scipy.linalg import expm

import covocp as co
from covocp.export.laws.design import design_of
from covocp.export.laws.history import history
from covocp.export.laws.sampled import discretised
from covocp.export.laws.spread import check_flight
from covocp.solution.flight import Flight

F, G = np.array([[0.0, 1.0], [0.5, -0.2]]), np.array([[0.0], [1.0]])
M, Q, U = np.array([[1.0, 0.0]]), np.diag([0.0, 0.02]), 0.1
A, B = np.diag([0.3, 0.1]), np.array([[0.5]])
START, DURATION = np.diag([4.0, 0.25]), 6.0


def steep(weight=1e4, noise=1e-2, **options):
    """A double integrator that must end exactly: the gain rises within the last instants."""
    problem = co.Problem(duration=40.0, name="steep end")
    x = problem.state("x", 2, initial=[100.0, 0.0], final=[0.0, 0.0], variance=[25.0, 0.25])
    u = problem.control("u", lower=-5.0, upper=5.0)
    problem.dynamics(x, ca.vertcat(x[1], u), noise=[0.0, noise])
    problem.measurement("position", x[0], noise=0.1)
    problem.minimize_expected(running=0.5 * u**2, terminal_weight={x: [weight, weight]})
    return co.solve(problem, progress=False, **options)


@pytest.fixture(scope="module")
def steep_end():
    return steep()


def linear_quadratic():
    problem = co.Problem(duration=DURATION)
    x = problem.state("x", 2, initial=[0.0, 0.0], variance=START)
    u = problem.control("u")
    problem.dynamics(x, ca.DM(F) @ x + ca.DM(G) @ u, noise=ca.DM(Q))
    problem.measurement("m", x[0], noise=U)
    running = 0.5 * (x.T @ ca.DM(A) @ x + u.T @ ca.DM(B) @ u)
    problem.minimize_expected(running=running, terminal_weight={x: [5.0, 2.0]})
    return co.solve(problem, intervals=60, progress=False)


def tables(solution, period):
    return discretised(design_of(solution, None), history(solution, "double"), period)


def van_loan(period):
    """Transition, control, and weights of (x, u held) over a period, by one matrix exponential."""
    drift = np.zeros((3, 3))
    drift[:2] = np.hstack([F, G])
    weight = np.zeros((3, 3))
    weight[:2, :2], weight[2:, 2:] = A, B
    big = expm(np.block([[-drift.T, weight], [np.zeros((3, 3)), drift]]) * period)
    move = big[3:, 3:]
    return move, move.T @ big[:3, 3:]


def test_gains_are_those_of_the_discrete_regulator():
    period = 0.5
    samples = tables(linear_quadratic(), period)
    move, weight = van_loan(period)
    S = np.diag([5.0, 2.0])
    for k in range(11, -1, -1):
        cost = weight + move[:2].T @ S @ move[:2]
        gain = np.linalg.solve(cost[2:, 2:], cost[2:, :2])
        np.testing.assert_allclose(samples.parts["C"][k], gain, rtol=2e-6)
        S = cost[:2, :2] - cost[:2, 2:] @ gain


def test_the_gain_after_init_is_the_one_that_is_flown():
    """Of the discrete regulator at time zero; that of the continuous one is another."""
    solution, period = linear_quadratic(), 0.5
    move, weight = van_loan(period)
    S = np.diag([5.0, 2.0])
    for _ in range(12):
        cost = weight + move[:2].T @ S @ move[:2]
        gain = np.linalg.solve(cost[2:, 2:], cost[2:, :2])
        S = cost[:2, :2] - cost[:2, 2:] @ gain
    assert abs(solution.loop.gain[0] / gain - 1.0).min() > 0.05
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # what half a second loses
        package = co.export_c(solution, FOLDER / "init_gain", period=period, largest_spread=float("inf"))
    for laws in (quick(package).python(), package.reference()):
        np.testing.assert_allclose(laws.state["feedback_gain"], gain, rtol=2e-6)


def test_spread_as_flown_is_that_of_the_compiled_law_in_the_actual_system(steep_end):
    samples = tables(steep_end, 0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # what a tenth of a second loses
        package = quick(co.export_c(steep_end, FOLDER / "steep_tenth", period=0.1))
    assert package.check().ok
    runs = co.simulate(steep_end, 200, seed=4, law=package.python(), progress=False)
    predicted = np.sqrt(np.diagonal(samples.flown[-1]))
    np.testing.assert_allclose(runs.deviation("x")[-1], predicted, rtol=4.0 / np.sqrt(2 * 200))


def test_a_sampled_loop_promises_what_it_holds(steep_end):
    """The continuous gain times this period is 200: it would end in nonsense; the gain of the held control does not."""
    flown = np.sqrt(np.diagonal(tables(steep_end, 0.02).flown[-1]))
    np.testing.assert_allclose(flown, steep_end.deviation("x")[-1], rtol=0.02)


def test_what_a_period_loses_is_refused_with_the_numbers(steep_end, tmp_path):
    with pytest.raises(co.ExportError, match="held over 4 s") as refused:
        co.export_c(steep_end, tmp_path / "slow", period=4.0)
    for words in ("as flown", "as predicted", "a shorter period=", "largest_spread="):
        assert words in str(refused.value)
    assert not (tmp_path / "slow").exists()
    spreads = pytest.warns(co.CovocpWarning, match="held over 4 s the loop spreads otherwise")
    with spreads, pytest.warns(co.CovocpWarning, match="held over 4 s the loop flies beside the nominal"):
        package = co.export_c(steep_end, tmp_path / "slow", period=4.0, largest_spread=float("inf"))
    assert quick(package).check().ok


def test_what_a_period_loses_at_the_end_is_told_however_large_deviations_were_before(tmp_path):
    problem = co.Problem(duration=6.0)
    x, v = (problem.state(name, initial=0.0, variance=1e2) for name in "xv")
    u = problem.control("u")
    problem.dynamics(x, v, noise=1e-2)
    problem.dynamics(v, u, noise=1e-2)
    problem.measurement("position", x, noise=1e-3)
    problem.minimize_expected(running=0.5 * u**2, terminal_weight={x: 1e4, v: 1e-4})
    solution = co.solve(problem, intervals=150, progress=False)
    flown = np.sqrt(np.diagonal(tables(solution, 0.2).flown[-1]))
    promised = np.array([solution.deviation(name)[-1] for name in "xv"]).ravel()
    worst = int(np.argmax(flown / promised))
    assert flown[worst] > 1.1 * promised[worst]
    assert promised[worst] < 0.1 * solution.deviation("xv"[worst]).max()
    with pytest.warns(co.CovocpWarning, match=f"'{'xv'[worst]}' at t = 6 s is {flown[worst]:.4g} as flown"):
        co.export_c(solution, tmp_path / "pk", period=0.2, largest_spread=10.0)


@pytest.mark.parametrize("value", ["much", 0.5, np.nan, True, None])
def test_a_spread_that_means_nothing_is_refused(steep_end, value, tmp_path):
    with pytest.raises(co.ExportError, match="largest_spread"):
        co.export_c(steep_end, tmp_path / "pk", largest_spread=value)


@pytest.mark.parametrize(("flown", "words"), [(np.inf, "the loop diverges"), (3.0, "is 3 as flown, 1 as predicted")])
def test_gains_between_nodes_that_do_not_hold_are_refused(flown, words):
    flight = Flight(name="'x'", time=1.0, predicted=1.0, flown=flown)
    with pytest.raises(co.ExportError, match="interpolated between the nodes") as refused:
        check_flight(flight, 1.5, None)
    assert words in str(refused.value)
