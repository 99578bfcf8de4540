"""Linearly implicit steps of stiff nominals: order, damping, the choice against explicit ones, both methods."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.base.quadrature import GAUSS_NODES
from covocp.transcription.rosenbrock import between, implicit_interval, implicit_step

TIGHT = {"rtol": 1e-12, "atol": 1e-13, "method": "DOP853"}


def plant(count=2):
    """A nonlinear system with a control that moves, and its rates with the running cost as numpy sees them."""
    problem = co.Problem(duration=2.0)
    x = problem.state("x", count, initial=np.linspace(1.0, 0.5, count))
    u = problem.control("u")
    rates = [x[1] - x[0] ** 2 + ca.sin(3 * problem.time), -x[0] * x[1] + u * ca.cos(x[0])]
    rates += [x[i - 1] - x[i] for i in range(2, count)]
    problem.dynamics(x, ca.vertcat(*rates))
    problem.minimize(running=x[0] ** 2 + u**2)

    def rate(t, y):
        control = 0.3 + 0.35 * t
        first = [y[1] - y[0] ** 2 + np.sin(3 * t), -y[0] * y[1] + control * np.cos(y[0])]
        return [*first, *(y[i - 1] - y[i] for i in range(2, count)), y[0] ** 2 + control**2]

    return problem.statement(), rate


@pytest.mark.parametrize("count", [2, 8])  # written out in scalars; with linear systems of CasADi's
def test_order_four_in_state_and_running_cost(count):
    statement, rate = plant(count)
    start = np.linspace(1.0, 0.5, count)
    true = solve_ivp(rate, (0, 2), [*start, 0.0], **TIGHT).y[:, -1]
    errors = []
    for substeps in (32, 64, 128):
        end, _, cost = implicit_interval(statement, substeps, GAUSS_NODES)(start, 0.3, 1.0, 0, 1, 2.0, [], [])
        errors.append([np.abs(np.ravel(end.full()) - true[:-1]).max(), abs(float(cost) - true[-1])])
    order = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    assert (order > 3.6).all()


def test_inside_a_step_the_polynomial_is_of_order_three_and_turning_round_changes_nothing():
    statement, rate = plant()
    errors = []
    for h in (0.2, 0.1, 0.05):
        true = solve_ivp(rate, (0, h), [1.0, 0.5, 0.0], dense_output=True, **TIGHT).sol
        after, s = true(h)[:2], h / 2
        ahead = between(statement, (0.3, 0.7))([1.0, 0.5], after, 0.3, 0.3 + 0.35 * h, 0, s, 2.0, [], [])
        turned = between(statement, (0.3, 0.7))(after, [1.0, 0.5], 0.3 + 0.35 * h, 0.3, s, -s, 2.0, [], [])
        np.testing.assert_allclose(turned.full()[:, ::-1], ahead.full(), rtol=1e-13)
        errors.append(np.abs(ahead.full() - np.column_stack([true(0.3 * h)[:2], true(0.7 * h)[:2]])).max())
    assert (np.log2(np.array(errors)[:-1] / np.array(errors)[1:]) > 3.7).all()  # of one step: an order more


@pytest.mark.parametrize("rate", [1e2, 1e5, 1e9])
def test_what_decays_fast_is_gone_after_a_step_and_follows_its_equilibrium(rate):
    problem = co.Problem(duration=1.0)
    x, u = problem.state("x", initial=5.0), problem.control("u")
    problem.dynamics(x, -rate * (x - u))
    problem.minimize(running=u**2)
    end = float(implicit_step(problem.statement(), ())([5.0], 1.0, 1.0, 0, 1, 1.0, [], [])[0])
    assert abs(end - 1.0) < 4.0 * 20 / rate  # stability function: of the order of 1/z where z is large


def motor(actuator=2e3, duration=0.5):
    """A current that follows its voltage within half a millisecond, a speed that takes its time."""
    problem = co.Problem(duration=duration, name="motor")
    i = problem.state("i", initial=0.0, variance=0.01)
    w = problem.state("w", initial=0.0, variance=1.0)
    k = problem.unknown("k", mean=40.0, variance=25.0)
    u = problem.control("u", lower=-8.0, upper=8.0)
    problem.dynamics(i, actuator * (u - i), noise=1e-2)
    problem.dynamics(w, k * i - 5.0 * w, noise=0.1)
    problem.measurement("speed", w, noise=1e-3)
    return problem, (i, w, k, u)


def identification():
    problem, (_, _, k, u) = motor()
    covariance = problem.estimation_covariance()
    problem.minimize(running=1e-3 * u**2, terminal=covariance[k, k])
    return problem


def test_a_stiff_nominal_is_stepped_implicitly_and_costs_the_same():
    stiff = co.solve(identification(), intervals=40, progress=False)
    explicit = co.solve(identification(), intervals=40, step="rk4", progress=False)
    assert stiff.mesh.step == "rodas"
    assert stiff.mesh.substeps <= 8
    assert (explicit.mesh.step, explicit.mesh.substeps) == ("gauss", 26)
    assert stiff.cost == pytest.approx(explicit.cost, rel=2e-4)  # the accuracy that is warned below
    assert np.isfinite(stiff.optimality.costate_difference)  # explicit steps of the adjoint, as many as it needs
    again = co.evaluate(identification(), nominal=stiff, step="rk4", substeps=60, intervals=40)
    np.testing.assert_allclose(stiff["w"], again["w"], atol=1e-3 * np.abs(again["w"]).max())


def test_closed_loop_with_a_stiff_actuator_agrees_with_explicit_steps():
    costs = []
    for options in ({}, {"step": "rk4", "substeps": 50}):
        problem, (_, w, _, u) = motor()
        problem.minimize_expected(running=0.5 * u**2, terminal_weight={w: 0.01})
        along = {"u": lambda s: 4.0 * np.cos(5.0 * s)}
        costs.append(co.evaluate(problem, nominal=along, intervals=40, **options).loop.expected_cost)
    assert costs[0] == pytest.approx(costs[1], rel=5e-4)


def test_both_methods_agree_on_a_stiff_nominal():
    problem = co.Problem(duration=1.0)
    x, y = problem.state("x", initial=0.0), problem.state("y", initial=0.0, final=1.0)
    u = problem.control("u")
    problem.dynamics(x, 1e3 * (u - x))
    problem.dynamics(y, x - y)
    problem.minimize(running=u**2)
    shooting, gradient = (co.solve(problem, method, intervals=20, progress=False) for method in ("ipopt", "gradient"))
    assert shooting.mesh.step == gradient.mesh.step == "rodas"
    assert gradient.cost == pytest.approx(shooting.cost, rel=1e-6)
    # without the lag the least energy is 2 / (e^2 - 1) e^2 (y(1) = int e^(s - 1) u ds); it costs of the order of 1e-3
    assert shooting.cost == pytest.approx(2.0 / (1.0 - np.exp(-2.0)), rel=5e-3)


def test_what_oscillates_keeps_explicit_steps():
    problem = co.Problem(duration=1.0)
    x, u = problem.state("x", 2, initial=[1.0, 0.0]), problem.control("u")
    problem.dynamics(x, ca.vertcat(x[1], -(400.0**2) * x[0] - 4.0 * x[1] + u))
    problem.minimize(running=u**2, terminal=x[0] ** 2)
    with pytest.warns(co.CovocpWarning, match="too coarse"):  # 64 turns: what even the most steps lose is said
        solution = co.evaluate(problem, nominal={"u": 0.0}, intervals=40)
    assert solution.mesh.step == "gauss"
    damping, frequency = 2.0, np.sqrt(400.0**2 - 4.0)
    phase = frequency * solution.t
    exact = np.exp(-damping * solution.t) * (np.cos(phase) + damping / frequency * np.sin(phase))
    np.testing.assert_allclose(solution["x"][:, 0], exact, atol=2e-3)
    assert abs(solution.cost - exact[-1] ** 2) / exact[-1] ** 2 < 2 * solution.mesh_error


@pytest.mark.parametrize("method", ["ipopt", "gradient"])
def test_explicit_steps_that_diverge_are_refused(method):
    with pytest.raises(co.ProblemError, match="about 26 steps an interval") as refused:
        co.solve(identification(), method, intervals=40, step="rk4", substeps=4, progress=False)
    assert "received: 4 steps" in str(refused.value)
    assert "substeps=26" in str(refused.value)


def test_few_steps_of_a_stiff_nominal_are_implicit_ones():
    assert co.evaluate(identification(), nominal={"u": 1.0}, intervals=40, substeps=3).mesh.step == "rodas"


def test_implicit_steps_are_refused_where_they_do_not_apply():
    with pytest.raises(co.ProblemError, match="step='rodas' does not apply"):
        co.solve(identification(), intervals=40, step="rodas", covariance_step="rk4", progress=False)
    with pytest.raises(co.ProblemError, match="one of 'auto', 'rk4', 'rodas'"):
        co.solve(identification(), intervals=40, step="euler", progress=False)
