"""Unstable nominals start from a run that a feedback holds."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.transcription.held import aim, held, in_moving_units
from covocp.transcription.mesh import Options
from covocp.transcription.starts import own_start
from covocp.transcription.steering import Run
from covocp.transcription.stiffness import resolve_mesh

GRAVITY, LENGTH, POLE, CART = 9.81, 1.0, 0.2, 1.0


def growing(rate, duration, **control):
    """x' = a x + u with noise, x measured: the cost of regulating it."""
    ocp = co.Problem(duration, name="growing")
    x, u = ocp.state("x", initial=1.0, variance=0.1), ocp.control("u", **control)
    ocp.dynamics(x, rate * x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.01)
    ocp.minimize_expected(running=0.5 * (x**2 + u**2))
    return ocp


def regulated(drift, start, variance, noise, measured, weight, price, duration, enters=None, seen=None):
    """Expected cost of the best linear loop by scipy: S backward, E forward.

    One control, which enters the last rate unless a column says more; the first state is read unless rows do.
    """
    size = drift.shape[0]
    enters = np.eye(size)[:, [-1]] if enters is None else enters
    seen = np.eye(size)[[0]] if seen is None else seen
    options = {"method": "LSODA", "rtol": 1e-10, "atol": 1e-14}

    def back(_, values):
        S = values.reshape(size, size)
        return (drift.T @ S + S @ drift + weight - S @ enters @ enters.T @ S / price).ravel()

    S = solve_ivp(back, (0.0, duration), np.zeros(size**2), dense_output=True, **options).sol

    def ahead(t, values):
        E, s = values[:-1].reshape(size, size), S(duration - t).reshape(size, size)
        rate = drift @ E + E @ drift.T + noise - E @ seen.T @ seen @ E / measured
        return np.append(rate.ravel(), np.trace(s @ noise) + np.trace(E @ s @ enters @ enters.T @ s) / price)

    end = solve_ivp(ahead, (0.0, duration), np.append(variance.ravel(), 0.0), **options).y[-1, -1]
    first = S(duration).reshape(size, size)
    return 0.5 * (start @ first @ start + np.trace(first @ variance) + end)


@pytest.mark.parametrize("method", ["ipopt", "auto"])
@pytest.mark.parametrize(("rate", "duration"), [(2.0, 12.0), (3.0, 7.0), (3.0, 8.0), (3.0, 9.0), (5.0, 6.0)])
def test_a_growing_plant_is_regulated_however_long(method, rate, duration):
    """Runs by themselves grow to e^24 and more, and the tolerance was met in the scales of that."""
    solution = co.solve(growing(rate, duration), method, progress=False)
    one = np.eye(1)
    truth = regulated(rate * one, np.ones(1), 0.1 * one, 0.1 * one, 0.01, one, 1.0, duration)
    assert solution.cost == pytest.approx(truth, rel=1e-4)


def pendulum(frequency, duration, **options):
    """An inverted pendulum, 0.2 rad off, balanced by a torque."""
    ocp = co.Problem(duration, name="balanced")
    x = ocp.state("x", 2, initial=[0.2, 0.0], variance=0.01 * np.eye(2), **options)
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], frequency**2 * ca.sin(x[0]) + u), noise=np.diag([0.0, 0.01]))
    ocp.measurement("m", x[0], noise=1e-3)
    ocp.minimize_expected(running=0.5 * (x[0] ** 2 + 0.1 * u**2))
    return ocp


@pytest.mark.parametrize("options", [{}, {"guess": [0.1, 0.0]}])
@pytest.mark.parametrize(("frequency", "duration"), [(4.0, 5.0), (4.0, 10.0), (1.0, 20.0), (4.0, 20.0)])
def test_a_pendulum_is_balanced_not_swung_round(frequency, duration, options):
    """A start that falls round and round ended nowhere, or in a swing of twice the cost."""
    solution = co.solve(pendulum(frequency, duration, **options), progress=False)
    drift = np.array([[0.0, 1.0], [frequency**2, 0.0]])
    start, weight = np.array([0.2, 0.0]), np.diag([1.0, 0.0])
    linear = regulated(drift, start, 0.01 * np.eye(2), np.diag([0.0, 0.01]), 1e-3, weight, 0.1, duration)
    assert solution.cost == pytest.approx(linear, rel=0.004)  # sin(0.2) = 0.2 - 0.7 %
    assert np.abs(solution["x"]).max() < 1.0


def balanced_cart(unit):
    """A pole on a cart, held upright for 10 s by a force in some unit; the frictionless equations of motion."""
    ocp = co.Problem(10.0, name="cart and pole")
    x = ocp.state("x", 4, initial=[0.0, 0.1, 0.0, 0.0], variance=1e-3 * np.eye(4))
    u = ocp.control("u")
    force, sin, cos = unit * u, ca.sin(x[1]), ca.cos(x[1])
    pushed = (force + POLE * LENGTH * x[3] ** 2 * sin - POLE * GRAVITY * sin * cos) / (CART + POLE * sin**2)
    ocp.dynamics(
        x, ca.vertcat(x[2], x[3], pushed, (GRAVITY * sin - pushed * cos) / LENGTH), noise=np.diag([0, 0, 1e-3, 1e-3])
    )
    ocp.measurement("m", x[:2], noise=1e-4 * np.eye(2))
    ocp.minimize_expected(running=0.5 * (x[0] ** 2 + 10 * x[1] ** 2 + 0.1 * force**2))
    return ocp


def test_a_pole_is_balanced_in_any_unit_of_the_force():
    costs = [co.solve(balanced_cart(unit), progress=False).cost for unit in (1e-3, 1.0, 1e3)]
    np.testing.assert_allclose(costs, costs[1], rtol=1e-6)
    rate = (CART + POLE) * GRAVITY / (CART * LENGTH)
    drift = np.zeros((4, 4))
    drift[[0, 1], [2, 3]], drift[2, 1], drift[3, 1] = 1.0, -POLE * GRAVITY / CART, rate
    enters, weight = np.array([[0.0], [0.0], [1.0 / CART], [-1.0 / (CART * LENGTH)]]), np.diag([1.0, 10.0, 0.0, 0.0])
    known = (np.array([0.0, 0.1, 0.0, 0.0]), 1e-3 * np.eye(4), np.diag([0.0, 0.0, 1e-3, 1e-3]), 1e-4, weight, 0.1, 10.0)
    linear = regulated(drift, *known, enters, np.eye(4)[:2])
    assert costs[1] == pytest.approx(linear, rel=0.005)  # sin(0.1) = 0.1 - 0.2 %


@pytest.mark.parametrize("control", ["linear", "constant"])
@pytest.mark.parametrize("scale", [1.0, 1e-4, 1e5])
def test_the_feedback_of_least_energy_mirrors_what_grows(control, scale):
    """x' = a x + b u: of all that bring x to nothing the least energy has u = -2 a x / b, so that x' = -a x."""
    rate, duration = 2.0, 10.0
    ocp = co.Problem(duration, name="mirrored")
    x, u = ocp.state("x", initial=scale, guess=0.0), ocp.control("u", guess=0.0)
    ocp.dynamics(x, rate * x + scale * u)
    ocp.minimize(running=u**2)
    statement = ocp.statement()
    mesh = resolve_mesh(statement, Options(intervals=400, control=control), statement.values)
    line, flat = np.zeros((401, 1)), np.zeros((mesh.control_nodes, 1))
    told = Run(
        statement=statement,
        mesh=mesh,
        start=np.array([scale]),
        duration=duration,
        parameters=statement.values,
        scale=np.array([scale]),
        units=np.ones(1),
    )
    run = in_moving_units(told, line, flat)
    aimed = aim(run, line, flat[0], np.zeros(statement.ne), np.array([np.nan]))
    found = held(run, line, aimed, flat)
    t = duration * mesh.nodes
    np.testing.assert_allclose(found.x[:, 0] / scale, np.exp(-rate * t), atol=2e-3)
    if control == "linear":
        later = slice(2, None)  # the first value, of half the weight, is off by the length of an interval
        np.testing.assert_allclose(found.u[later, 0], -2 * rate * np.exp(-rate * t[later]), atol=2e-3 * rate)
    assert own_start(statement, mesh, statement.values).held


def test_what_is_stable_is_left_alone():
    ocp = co.Problem(10.0, name="pushed")
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.1 * x)
    ocp.minimize(running=u**2)
    statement = ocp.statement()
    mesh = resolve_mesh(statement, Options(intervals=50), statement.values)
    assert not own_start(statement, mesh, statement.values).held


@pytest.mark.parametrize(
    ("duration", "end"), [(8.0, {"final": [np.pi, 0.0]}), (5.0, {"final": [2 * np.pi, 0.0]}), (8.0, {})]
)
def test_what_falls_by_itself_is_left_to_fall(duration, end):
    """To hang is stable, and on the way round as well; without a final value the cost says where it shall be."""
    ocp = co.Problem(duration, name="let down")
    x = ocp.state("x", 2, initial=[0.3, 0.0], **end)
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], 9.81 * ca.sin(x[0]) - 0.1 * x[1] + u))
    ocp.minimize(running=u**2, terminal=0.0 if end else 10 * ((x[0] - np.pi) ** 2 + x[1] ** 2))
    statement = ocp.statement()
    mesh = resolve_mesh(statement, Options(intervals=100), statement.values)
    assert not own_start(statement, mesh, statement.values).held
    solution = co.solve(ocp, progress=False)

    def rate(t, y):
        torque = np.interp(t, solution.t, solution["u"].ravel())
        return [y[1], 9.81 * np.sin(y[0]) - 0.1 * y[1] + torque, torque**2]

    y = np.array([0.3, 0.0, 0.0])
    for begin, stop in zip(solution.t[:-1], solution.t[1:], strict=True):  # the control has corners at the nodes
        y = solve_ivp(rate, (begin, stop), y, method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    held_up = 80.0  # what a start that is held upright leads to
    assert y[2] < 0.2 * held_up
    np.testing.assert_allclose(y[:2], solution["x"][-1], atol=5e-3)


def test_what_no_control_moves_is_not_held():
    ocp = co.Problem(10.0, name="beside")
    x, z = ocp.state("x", initial=1.0, final=0.0), ocp.state("z", initial=1e-6)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.dynamics(z, 1.2 * z)
    ocp.minimize(running=u**2)
    statement = ocp.statement()
    mesh = resolve_mesh(statement, Options(intervals=50), statement.values)
    assert not own_start(statement, mesh, statement.values).held


def falling(**end):
    """A damped pendulum from 0.5 rad off its upper rest, its ends free."""
    ocp = co.Problem(6.0, name="falling")
    x = ocp.state("x", 2, initial=[0.5, 0.0])
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], 4.0 * ca.sin(x[0]) - 0.1 * x[1] + u))
    ocp.minimize(running=u**2 + end.get("share", 0.0) * x[0] ** 2)
    return ocp


@pytest.mark.filterwarnings("ignore:What the steps are off grows")
def test_what_nothing_wants_anywhere_falls():
    """Nothing but the control costs: none is the best. Held up, it had been called solved at 3.9."""
    assert co.solve(falling(), progress=False).cost < 1e-6


@pytest.mark.filterwarnings("ignore:What the steps are off grows")
def test_a_faint_wish_is_not_worth_holding():
    """At most what it costs with no control at all, by scipy."""
    left = solve_ivp(
        lambda t, y: [y[1], 4.0 * np.sin(y[0]) - 0.1 * y[1], 1e-6 * y[0] ** 2], (0, 6), [0.5, 0, 0], rtol=1e-10
    )
    assert co.solve(falling(share=1e-6), progress=False).cost < 1.01 * left.y[2, -1]


def test_a_cost_that_falls_on_and_on_prefers_no_place():
    """1/x: one step of Newton is no place where it wants to be; with no control it costs 1/3 (1 - e^-18)."""
    ocp = co.Problem(6.0, name="away")
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, 3.0 * x + u)
    ocp.minimize(running=u**2 + 1.0 / x)
    assert co.solve(ocp, progress=False).cost < 1.0 / 3.0
