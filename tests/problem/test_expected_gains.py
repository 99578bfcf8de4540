"""Constrained feedback gains: against the free gain, closed forms and optimisation by scipy."""

from __future__ import annotations

import warnings
from functools import cache

import casadi as ca
import closed_loops
import nonlinear_loop as loop
import numpy as np
import pytest
from problems import graded, solve
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

import covocp as co
from covocp.models import unknown_lag

GRID = graded(40)


def steering(gain):
    """6.12 with a constrained gain."""
    ocp = co.Problem(10.0, name="6.12")
    x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("m", x, noise=1.0)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0}, gain=gain)
    return ocp


@cache
def steered(*key):
    return solve(steering(co.Gain(**dict(key))), grid=GRID)


@cache
def best():
    return solve(unknown_lag.steering(), grid=GRID)


STRUCTURES = (
    (("lower", -5.0), ("upper", 5.0)),
    (("structure", ((1, 0),)), ("lower", -5.0), ("upper", 5.0)),
    (("structure", ((1, 0),)), ("lower", -0.5), ("upper", 0.5)),
    (("constant", True), ("lower", -5.0), ("upper", 5.0)),
    (("structure", ((1, 0),)), ("constant", True)),
)


def test_a_free_gain_finds_the_best_one():
    """F1 against F3: the same cost, and the same gain where it matters."""
    found = steered(*STRUCTURES[0])
    assert found.cost == pytest.approx(best().cost, rel=1e-5)
    assert found.cost == pytest.approx(2.027146, rel=1e-5)
    np.testing.assert_allclose(found.gains["C"][:-1], best().gains["C"][:-1], atol=0.02)
    np.testing.assert_allclose(found["u"], best()["u"], atol=0.02)


def test_each_constraint_costs():
    """Less freedom, more cost: entries, bounds, constancy; never below the free gain."""
    costs = [steered(*structure).cost for structure in STRUCTURES]
    assert min(costs) > best().cost - 1e-6 * best().cost
    free, without_b, bounded, constant, least = costs
    assert free < without_b < bounded < least
    assert free < constant < least


@pytest.mark.parametrize("key", STRUCTURES[1:])
def test_constraints_are_kept(key):
    given, found = dict(key), steered(*key)
    C = found.gains["C"]
    assert C.shape == (41, 1, 2)
    if "structure" in given:
        assert (C[:, 0, 1] == 0).all()
    if given.get("constant"):
        assert np.ptp(C, axis=0).max() == 0
    assert np.abs(C).max() <= given.get("upper", np.inf) + 1e-7
    assert found.smallest_eigenvalue >= 0
    for matrix in (found["E"], found["Xhat"]):
        assert np.diagonal(matrix, axis1=1, axis2=2).min() >= -1e-9
    o = found.optimality
    assert o.cost_identity < 1e-5  # the cost of the gain that is allowed, against that of the loop's covariances
    assert o.conservation < 1e-11
    assert o.stationarity < 1e-6
    assert "classical_cost" not in found.stats


def test_cost_of_a_constrained_gain_by_the_reference_integrator():
    """Along the control and with the gain that were found, both linear between the nodes."""
    found = steered(*STRUCTURES[2])
    control, breaks = closed_loops.piecewise_linear(found.t, found["u"])
    C = found.gains["C"][:, 0]
    exact = closed_loops.closed_loop(
        closed_loops.lag(),
        control,
        10.0,
        breaks=breaks,
        times=[0.0, 10.0],
        feedback=lambda t: [[np.interp(t, found.t, column) for column in C.T]],
    )
    assert found.cost == pytest.approx(exact.cost, rel=2e-5)
    assert found.loop.expected_cost == pytest.approx(exact.cost, rel=2e-5)
    np.testing.assert_allclose(found.loop.X[-1], exact.X[-1], rtol=1e-4, atol=1e-4)
    assert exact.cost > best().cost


# --- a linear system: the gain can be optimised apart from the nominal ------------------------------------------------

DURATION, START = 4.0, np.array([1.0, 0.0])
F, G, M = np.array([[0.0, 1.0], [-0.4, -0.5]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
Q, U, E0 = np.diag([0.0, 0.4]), 0.1, np.diag([0.3, 0.2])
A, N, B, END = np.diag([1.0, 0.3]), np.array([[0.2], [0.0]]), 0.5, np.diag([2.0, 1.0])


def linear(gain):
    ocp = co.Problem(DURATION, name="linear quadratic")
    x, u = ocp.state("x", 2, initial=START, variance=np.diag(E0)), ocp.control("u")
    ocp.dynamics(x, ca.DM(F) @ x + ca.DM(G) @ u, noise=np.diag(Q))
    ocp.measurement("m", x[0], noise=U)
    running = ca.bilin(ca.DM(A), x, x) / 2 + ca.dot(x, ca.DM(N) @ u) + B * u**2 / 2
    ocp.minimize_expected(running=running, terminal=ca.bilin(ca.DM(END), x, x) / 2, gain=gain)
    return ocp


def nominal_cost():
    """1/2 x0' S(0) x0."""

    def back(t, z):
        S = z.reshape(2, 2)
        H = G.T @ S + N.T
        return (-F.T @ S - S @ F - A + H.T @ H / B).ravel()

    S = solve_ivp(back, (DURATION, 0), END.ravel(), rtol=1e-10, atol=1e-12).y[:, -1].reshape(2, 2)
    return 0.5 * START @ S @ START


def deviations_cost(C):
    """What the deviations cost with a constant gain, by (E-1)."""
    C = np.reshape(C, (1, 2))

    def rate(t, z):
        E, X = z[:4].reshape(2, 2), z[4:8].reshape(2, 2)
        K, closed = E @ M.T / U, F - G @ C
        cost = np.trace(A @ (E + X)) + B * np.trace(C @ X @ C.T) - 2 * np.trace(N @ C @ X)
        known = K @ K.T * U
        return np.concatenate(
            [(F @ E + E @ F.T + Q - known).ravel(), (closed @ X + X @ closed.T + known).ravel(), [cost / 2]]
        )

    z = np.concatenate([E0.ravel(), np.zeros(5)])
    z = solve_ivp(rate, (0, DURATION), z, rtol=1e-9, atol=1e-11, method="DOP853").y[:, -1]
    return z[8] + 0.5 * np.trace(END @ (z[:4] + z[4:8]).reshape(2, 2))


@pytest.mark.parametrize("free", [(0, 1), (0,), (1,)])
def test_constant_gain_against_scipy(free):
    """The nominal of a linear-quadratic problem does not depend on the gain, so the gain is found apart."""

    def full(entries):
        C = np.zeros(2)
        C[list(free)] = entries
        return C

    optimum = minimize(
        lambda c: deviations_cost(full(c)), np.full(len(free), 0.5), method="BFGS", options={"gtol": 1e-7}
    )
    structure = np.isin(np.arange(2), free)[None, :]
    found = solve(linear(co.Gain(structure=structure, constant=True)), intervals=60)
    np.testing.assert_allclose(found.gains["C"][0, 0], full(optimum.x), atol=2e-4)
    assert found.cost == pytest.approx(nominal_cost() + optimum.fun, rel=1e-6)
    assert found.cost_terms["deviations"] == pytest.approx(optimum.fun, rel=2e-6)


def scalar(gain):
    """dx = (-x/2 + u) dt + n."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=0.5, variance=0.5), ocp.control("u")
    ocp.dynamics(x, -0.5 * x + u, noise=0.8)
    ocp.measurement("m", x, noise=0.3)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=1.5 * x**2, gain=gain)
    return ocp


def test_bounded_gain_of_a_scalar_system():
    """C = s limited to its bounds, -ds/dt = 2 (-1/2 - C) s + 2 + C^2, s(T) = 3: the slope of the cost by Xhat."""
    low, high = 1.2, 1.45

    def gain(s):
        return np.clip(s, low, high)

    def back(t, s):
        return -(2 * (-0.5 - gain(s)) * s + 2 + gain(s) ** 2)

    tight = {"rtol": 1e-10, "atol": 1e-12, "dense_output": True, "max_step": 0.01}
    s = solve_ivp(back, (2.0, 0.0), [3.0], **tight).sol

    def forward(t, z):
        E, X = z[:2]
        C, known = gain(s(t)[0]), E**2 / 0.3
        return [-E + 0.8 - known, 2 * (-0.5 - C) * X + known, (2 * (E + X) + C**2 * X) / 2]

    E, X, cost = solve_ivp(forward, (0, 2), [0.5, 0.0, 0.0], **tight).y[:, -1]
    found = solve(scalar(co.Gain(lower=low, upper=high)), intervals=80)
    C = found.gains["C"][:, 0, 0]
    exact = gain(s(found.t)[0])
    assert (exact == high).any()  # the bound holds somewhere, and not everywhere
    assert (exact < high).any()
    inside = slice(1, -1)  # at the ends the gain of one node counts for half an interval
    np.testing.assert_allclose(C[inside], exact[inside], atol=0.02)
    assert found.cost_terms["deviations"] == pytest.approx(cost + 1.5 * (E + X), rel=1e-5)
    assert found.cost > solve(scalar(None), intervals=80).cost


# --- the nonlinear loop -----------------------------------------------------------------------------------------------


def test_gains_of_the_nonlinear_loop():
    """Two controls, N and A not zero."""
    free = solve(loop.problem(), intervals=16)
    wide = solve(loop.problem(gain=co.Gain(lower=-5, upper=5)), intervals=16)
    assert wide.cost == pytest.approx(free.cost, rel=5e-6)
    np.testing.assert_allclose(wide.gains["C"][2:-2], free.gains["C"][2:-2], atol=0.02)
    constant = solve(loop.problem(gain=co.Gain(constant=True, structure=[[1, 1, 0], [0, 0, 1]])), intervals=16)
    assert constant.cost > free.cost + 1e-3
    C = constant.gains["C"]
    assert (C[:, 0, 2] == 0).all()
    assert (C[:, 1, :2] == 0).all()
    assert np.ptp(C, axis=0).max() == 0
    assert (np.abs(C[0][[0, 0, 1], [0, 1, 2]]) > 0.01).all()


def test_a_solution_with_a_constant_gain_is_evaluated_with_its_gain():
    """The gain is a free constant: it is taken from the solution, not from its guess."""
    found = steered(*STRUCTURES[4])
    problem = steering(co.Gain(structure=((1, 0),), constant=True))
    again = co.evaluate(problem, nominal=found)  # in shorter steps
    np.testing.assert_array_equal(again.gains["C"], found.gains["C"])
    assert again.cost == pytest.approx(found.cost, rel=2 * found.mesh_error)
    steps = {"grid": found.mesh.nodes, "control": found.mesh.control, "substeps": found.mesh.substeps}
    assert co.evaluate(problem, nominal=found, **steps).cost == pytest.approx(found.cost, rel=1e-9)


def test_incorrect_statistics_with_a_constrained_gain():
    """The truth is stated by the same function; a problem without the constraint is another one."""
    gain = co.Gain(structure=((1, 0),), constant=True)
    found = steered(*STRUCTURES[4])
    again = co.evaluate(found, truth=steering(gain))
    assert again.cost == pytest.approx(found.loop.expected_cost, rel=1e-12)
    with pytest.raises(co.ProblemError, match="another system"):
        co.evaluate(found, truth=unknown_lag.steering())


def test_the_guess_of_a_gain_is_kept_and_limited():
    """In `evaluate`, nothing but the guess says what a constant gain is."""
    gain = co.Gain(constant=True, guess=[[0.7, -3.0]], lower=-1.0)
    found = co.evaluate(steering(gain), nominal={"u": 0.1}, intervals=5)
    np.testing.assert_array_equal(found.gains["C"][0], [[0.7, -1.0]])


def test_gains_that_run_away():
    """9.1: a run that fails is a SolveError with its last iterate, however far off that is."""
    with pytest.raises(co.SolveError) as caught:
        solve(loop.problem(gain=co.Gain()), intervals=6, max_iterations=15)
    assert not caught.value.solution.converged
    # Covariances that leave the range of numbers: no loop, but no error of numpy's either.
    nominal = {"u": 0.0, "w": 0.0, "C": np.full((11, 6), -1e3)}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        away = co.evaluate(loop.problem(gain=co.Gain()), nominal=nominal, intervals=10)
    assert "too coarse" in str(caught[0].message)
    assert away.loop is None
    assert away.cost > 1e50


def test_as_many_entries_as_nodes():
    found = co.evaluate(loop.problem(gain=co.Gain()), nominal={"u": 0.0, "w": 0.0, "C": np.zeros(6)}, intervals=5)
    assert (found.gains["C"] == 0).all()


def test_covariances_by_name_beside_a_constant_gain():
    found = steered(*STRUCTURES[4])
    np.testing.assert_array_equal(found.covariance("x"), found.loop.X[:, :1, :1])
    np.testing.assert_array_equal(found.covariance("b"), found.loop.X[:, 1:, 1:])
    np.testing.assert_allclose(found.deviation("b"), np.sqrt(5.0), rtol=1e-9)
    with pytest.raises(co.ProblemError):
        found.covariance("C")
