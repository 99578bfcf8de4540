"""The closed loop along a nominal against the reference integrator; identities along any nominal; its costates."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import casadi as ca
import nonlinear_loop as loop
import numpy as np
import pytest
from nonlinear_loop import CONTROLS, NODES, NOMINAL, slopes
from problems import graded, order, solve
from scipy.integrate import solve_ivp

import covocp as co
from covocp.extremal import closed_loop, joint
from covocp.extremal.costates import discrete_costates, integrated_costates
from covocp.models import unknown_lag

UNIFORM = np.linspace(0.0, 1.0, NODES.size)  # as the reference: the default would be graded


@cache
def reference():
    return loop.reference()


@cache
def problem(curved=True):
    """Built once; without `curved` S(T) does not depend on x(T)."""
    return loop.problem(curved=curved, terminal_weight=None if curved else {"r": 0.5})


@cache
def evaluated(substeps=16, step="gauss", *, curved=True):
    """Along the same control as the reference."""
    return co.evaluate(problem(curved), nominal=NOMINAL, grid=UNIFORM, substeps=substeps, covariance_step=step)


def histories(found, exact):
    """Pairs of histories at the nodes."""
    return ((found.E, exact.E), (found.Xhat, exact.Xhat), (found.Z, exact.Z), (found.gain, exact.C), (found.X, exact.X))


# --- against the reference integrator ---------------------------------------------------------------------------------


def test_covariances_without_the_compiled_passage_are_the_same(monkeypatch):
    extremal = evaluated().extremal
    fast = closed_loop.close_loop(extremal)
    monkeypatch.setattr(joint, "functions", lambda: None)
    plain = closed_loop.close_loop(extremal)
    for one, two in ((fast.E, plain.E), (fast.Xhat, plain.Xhat), (fast.Z, plain.Z), (fast.gain, plain.gain)):
        np.testing.assert_allclose(one, two, atol=1e-12)
    assert fast.expected_cost == pytest.approx(plain.expected_cost, rel=1e-12)


def test_covariances_gains_and_costs():
    found, exact = evaluated().loop, reference()
    for one, two in histories(found, exact):
        np.testing.assert_allclose(one, two, atol=1e-6)
    assert np.abs(exact.Xhat).max() > 0.3  # there is something to compare
    np.testing.assert_allclose(evaluated()["S"], exact.S, atol=1e-6)
    np.testing.assert_allclose(evaluated()["E"], exact.E, atol=1e-6)
    assert found.cost["terminal"] + found.cost["running"] == pytest.approx(exact.deterministic, rel=1e-6)
    end = 0.5 * np.trace(loop.terminal_curvature(exact.x[-1]) @ exact.X[-1])
    assert found.cost["deviations at the end"] == pytest.approx(end, rel=1e-6)
    assert found.expected_cost == pytest.approx(exact.cost, rel=1e-6)
    assert found.other_cost == pytest.approx(exact.equivalent, rel=1e-6)
    assert evaluated().cost == pytest.approx(exact.innovations, rel=1e-6)
    np.testing.assert_allclose(evaluated().covariance("r", "c"), exact.X[:, :2, 2:], atol=1e-6)
    np.testing.assert_allclose(
        evaluated().deviation("r"), np.sqrt(np.diagonal(exact.X, axis1=1, axis2=2))[:, :2], atol=1e-6
    )


def test_errors_are_of_fourth_order():
    counts = np.array([8, 16, 32])
    exact = reference()
    runs = [evaluated(m) for m in counts.tolist()]
    errors = np.array([[np.abs(a - b).max() for a, b in histories(run.loop, exact)] for run in runs])
    costs = np.array([[r.cost, r.loop.expected_cost, r.loop.other_cost] for r in runs]) - exact.cost
    for column in np.hstack([errors, costs]).T:
        assert order(counts, column) == pytest.approx(4.0, abs=0.2)


def test_incorrect_statistics():
    """Another E(0), Q and U than the design's: gains of the design, Z not zero (6.11)."""
    variance, noise = np.diag([0.5, 0.1, 0.3]), np.array([[0.3, -0.1], [-0.1, 0.5]])
    truth = replace(
        loop.system(np.eye(3)),
        variance=variance,
        U=noise,
        Q=lambda x, u: loop.process_noise(x, u, 2.0),
    )
    exact = loop.reference(truth)
    actual = loop.problem(noise=2.0, variance=variance, measurement_noise=noise)
    found = co.evaluate(evaluated(), truth=actual)
    assert np.abs(exact.Z).max() > 0.02
    for one, two in histories(found.loop, exact):
        np.testing.assert_allclose(one, two, atol=1e-6)
    assert found.cost == pytest.approx(exact.cost, rel=1e-6)
    assert found.loop.other_cost is None
    assert found.optimality.cost_identity is None
    np.testing.assert_allclose(found["E"], reference().E, atol=1e-6)  # what the filter believes
    np.testing.assert_allclose(found.covariance("r"), exact.X[:, :2, :2], atol=1e-6)


def test_statistics_of_the_design_as_truth_change_nothing():
    for truth in ({}, {"noise": 1.0}, problem()):
        found = co.evaluate(evaluated(), truth=truth)
        for one, two in histories(found.loop, reference()):
            np.testing.assert_allclose(one, two, atol=1e-6)
        assert found.cost == pytest.approx(evaluated().loop.expected_cost, rel=1e-12)


def test_any_gain():
    """A feedback that is not the best one: given as a control."""
    C = np.array([[0.4, 0.7, -0.3], [0.2, -0.1, 0.5]])
    exact = loop.reference(feedback=lambda t: (1 + t) * C)
    history = (1 + NODES)[:, None] * C.ravel(order="F")
    nominal = {**NOMINAL, "C": history}
    found = co.evaluate(loop.problem(gain=co.Gain()), nominal=nominal, intervals=4, substeps=32)
    for one, two in histories(found.loop, exact):
        np.testing.assert_allclose(one, two, atol=2e-6)
    assert found.cost == pytest.approx(exact.cost, rel=2e-6)
    assert found.loop.expected_cost == pytest.approx(exact.cost, rel=2e-6)
    assert exact.cost > reference().cost + 0.1


# --- identities along any nominal -------------------------------------------------------------------------------------

NOMINALS = {
    "rest": {"u": 0.0, "w": 0.0},
    "waves": {"u": lambda s: np.sin(9 * s), "w": lambda s: np.cos(7 * s)},
    "jumps": {"u": lambda s: np.sign(np.sin(20 * s)), "w": lambda s: np.where(s < 0.4, -1.0, 0.7)},
}


@pytest.mark.parametrize("control", ["linear", "constant"])
@pytest.mark.parametrize("nominal", NOMINALS)
def test_both_forms_of_the_cost_agree(nominal, control):
    """(E-1) = (E-20), Z = 0, c's variance is kept, along a nominal that is optimal in no sense; by order four."""
    errors = []
    for substeps in (2, 4, 8):
        found = co.evaluate(problem(), nominal=NOMINALS[nominal], intervals=20, substeps=substeps, control=control)
        o = found.optimality
        np.testing.assert_allclose(found.loop.X[:, 2, 2], 0.15, rtol=1e-11)
        assert o.conservation < 1e-11
        errors.append((o.cost_identity, o.cross_covariance, abs(found.cost - found.loop.expected_cost)))
    assert max(errors[-1]) < 2e-7
    for column in np.array(errors).T:
        assert order([2, 4, 8], column) > 3.5


@pytest.mark.parametrize("step", ["gauss", "rk4", "strang"])
def test_identities_hold_for_every_covariance_step(step):
    """The loop is stepped by its own integrator; what the design's E and S are off shows in the identities."""
    counts = [16, 32, 64]
    found = [evaluated(m, step).optimality for m in counts]
    expected = 2.0 if step == "strang" else 4.0
    for name in ("cost_identity", "cross_covariance"):
        assert order(counts, [getattr(o, name) for o in found]) == pytest.approx(expected, abs=0.35)


def drifting(control, *, drift=0.0):
    """A lag whose time constant walks at random, by a noise that depends on the control."""
    ocp = co.Problem(duration=3.0)
    x = ocp.state("x", initial=0.0, variance=1.0)
    d = ocp.state("d", initial=1.0, variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, -d * x + u, noise=0.5)
    ocp.dynamics(d, -drift * d, noise=0.2 + u**2)
    ocp.measurement("m", x, noise=1.0)
    ocp.minimize_expected(running=0.5 * u**2 + (x - 1) ** 2)
    values = np.array([1.0, -0.5, 2.0, 0.3, -1.0, 0.4])
    nominal = values if control == "linear" else values[:-1]
    return co.evaluate(ocp, nominal={"u": nominal}, intervals=5, control=control, substeps=8), values


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_an_uncontrolled_variance_grows_by_its_noise(control):
    found, u = drifting(control)
    linear = [(a * a + a * b + b * b) / 3 for a, b in pairwise(u)]  # u^2 in the mean over an interval
    noise = 0.2 + np.array(linear if control == "linear" else u[:-1] ** 2)
    np.testing.assert_allclose(found.loop.X[:, 1, 1], 1 + 0.6 * np.cumsum([0.0, *noise]), rtol=1e-12)
    assert found.optimality.conservation < 1e-12


def test_what_decays_is_not_conserved():
    """d is still moved by no control, but by itself."""
    found, _ = drifting("linear", drift=0.3)
    assert found.optimality.conservation is None


def test_a_combination_of_states_may_be_conserved():
    """x + 2 y, where y takes back half of what x gets."""
    ocp = co.Problem(duration=1.0)
    x, y = ocp.state("x", initial=0.0, variance=1.0), ocp.state("y", initial=1e4, variance=1e6)
    u = ocp.control("u")
    rate = ca.sin(x) * 2 + u - 1e-3 * y
    ocp.dynamics(x, rate)
    ocp.dynamics(y, -0.5 * rate, noise=10.0)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=u**2 + x**2)
    found = co.evaluate(ocp, nominal={"u": lambda s: np.cos(5 * s)}, intervals=20)
    w = np.array([1.0, 2.0])
    np.testing.assert_allclose(found.loop.X @ w @ w, 1 + 4e6 + 40 * found.t, rtol=1e-11)
    assert found.optimality.conservation < 1e-11


def test_states_known_exactly_do_not_count():
    """A state without variance that the control moves, beside one that decays: nothing is conserved, and no error."""
    ocp = co.Problem(duration=3.0)
    x, y = ocp.state("x", initial=0.0), ocp.state("y", initial=0.0, variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, -x + u)
    ocp.dynamics(y, -y + x, noise=0.5)
    ocp.minimize_expected(running=0.5 * u**2 + (y - 1) ** 2)
    found = co.evaluate(ocp, nominal={"u": 1.0}, intervals=40)
    assert found.optimality.conservation is None
    # nothing is measured: nothing is fed back, y's variance decays to 1/4
    np.testing.assert_allclose(found.loop.X[:, 1, 1], 0.25 + 0.75 * np.exp(-2 * found.t), rtol=1e-7)
    assert np.abs(found.loop.Xhat).max() == 0
    # x = 1 - e^-t, y = 1 - (1 + t) e^-t; int (1 + t)^2 e^-2t dt = 5/4 - (2 T^2 + 6 T + 5) e^-2T/4
    variance = 0.75 + 0.375 * (1 - np.exp(-6.0))
    expected = 1.5 + 1.25 - 41 / 4 * np.exp(-6.0) + variance
    assert found.cost == pytest.approx(expected, rel=1e-7)


# --- costates ---------------------------------------------------------------------------------------------------------


@cache
def error_costates():
    """P of (6.3-21) at the nodes, from P(T) = S(T) backward, with x, E, S from their values at the end."""
    inverse, exact = np.linalg.inv(loop.MEASUREMENT_NOISE), reference()

    def rate(t, z):
        x, (E, S, P), u = z[:3], z[3:].reshape(3, 3, 3), loop.control(t)
        F, G, M, A, B, N = slopes(x, u)
        W, H = M.T @ inverse @ M, G.T @ S + N.T
        dE = F @ E + E @ F.T + loop.process_noise(x, u) - E @ W @ E
        dS = -F.T @ S - S @ F - A + H.T @ np.linalg.solve(B, H)
        dP = -(F - E @ W).T @ P - P @ (F - E @ W) - W @ E @ S - S @ E @ W - A
        return np.concatenate([loop.rate(x, u), dE.ravel(), dS.ravel(), dP.ravel()])

    z = np.concatenate([exact.x[-1], *(v.ravel() for v in (exact.E[-1], exact.S[-1], exact.S[-1]))])
    result = [z[21:].reshape(3, 3)]
    for end, start in pairwise(NODES[::-1]):
        z = solve_ivp(rate, (end, start), z, method="DOP853", rtol=1e-9, atol=1e-11).y[:, -1]
        result.append(z[21:].reshape(3, 3))
    np.testing.assert_allclose(z[3:12].reshape(3, 3), loop.VARIANCE, atol=1e-7)
    return np.array(result[::-1])


@pytest.mark.parametrize("step", ["gauss", "rk4", "strang"])
def test_costates_of_the_matrices(step):
    """Of S: -Xhat/2; of E: P/2."""
    limit = {"gauss": 1e-6, "rk4": 2e-6, "strang": 2e-3}[step]  # h^4, h^2, h = 1/32
    np.testing.assert_allclose(evaluated(16, step).costate("S"), -reference().Xhat / 2, atol=limit)
    np.testing.assert_allclose(evaluated(16, step).costate("E"), error_costates() / 2, atol=limit)


def test_costate_of_the_error_exceeds_that_of_the_deviation():
    """P - S >= 0: errors cost by the feedback they cause [2.1 of chapter 6, 2]."""
    assert np.linalg.eigvalsh(2 * evaluated().costate("E") - evaluated()["S"]).min() > -1e-6


@pytest.mark.parametrize(("step", "limit"), [("gauss", 1e-6), ("rk4", 1e-6), ("strang", 2e-3)])
def test_two_ways_to_the_costates_in_a_loop(step, limit):
    solution = evaluated(16, step)
    other = integrated_costates(solution.extremal, 16)
    np.testing.assert_allclose(solution.costates.state, other.state, atol=limit)
    np.testing.assert_allclose(solution.costates.matrices, other.matrices, atol=limit)


@pytest.mark.parametrize("curved", [False, True])
def test_slopes_of_the_cost_by_the_controls(curved):
    """Of the discretised problem: only the differences' own error, 1e-8."""
    _, found, _ = discrete_costates(evaluated(4, curved=curved).extremal)

    def cost(i, j, change):
        moved = CONTROLS.copy()
        moved[i, j] += change
        nominal = {"u": moved[:, 0], "w": moved[:, 1]}
        return co.evaluate(problem(curved), nominal=nominal, grid=UNIFORM, substeps=4).cost

    for i, j in ((0, 0), (2, 1), (4, 0)):
        slope = (cost(i, j, 1e-4) - cost(i, j, -1e-4)) / 2e-4
        assert found[i, j] == pytest.approx(slope, rel=1e-6, abs=1e-7)


def nonquadratic_end(solution):
    """k_x + {tr k_xx (E + Xhat)}_x/2 at x(T) [C]."""
    x, X, h = np.append(solution["r"][-1], loop.START[2]), solution.loop.X[-1], 1e-5

    def half(at):
        return 0.5 * np.trace(loop.terminal_curvature(at) @ X)

    third = [(half(x + h * e) - half(x - h * e)) / (2 * h) for e in np.eye(3)]
    return (loop.terminal_slope(x) + third)[:2]


def test_terminal_costate_along_a_given_nominal():
    np.testing.assert_allclose(evaluated().costate("r")[-1], nonquadratic_end(evaluated()), rtol=1e-6)


@cache
def optimum(formulation, method="ipopt"):
    options = {"covariances": formulation, "covariance_step": "gauss"} if method == "ipopt" else {}
    return solve(problem(), method=method, intervals=40, tolerance=1e-8, **options)


@pytest.mark.parametrize(
    ("formulation", "method"), [("eliminated", "ipopt"), ("states", "ipopt"), ("eliminated", "gradient")]
)
def test_terminal_costate_of_a_solution(formulation, method):
    """The third derivative of k, which the thesis drops, is there."""
    solution = optimum(formulation, method)
    np.testing.assert_allclose(solution.costate("r")[-1], nonquadratic_end(solution), rtol=1e-6)
    assert np.abs(solution.costate("r")[-1] - loop.terminal_slope(np.append(solution["r"][-1], 0.8))[:2]).max() > 0.1


def test_nothing_is_known_exactly_in_theory_and_nearly_in_practice():
    """The lag with Z, (E-1) = (E-20) and the conserved variance in the printed record of a solution."""
    grid = graded(40)
    solution = solve(unknown_lag.steering(), grid=grid)
    o = solution.optimality
    assert 0 < o.cost_identity < 1e-5
    assert 0 < o.cross_covariance < 1e-3
    assert o.conservation < 1e-12
    for text in (
        "expected cost: as optimised against from the covariances",
        "correlation of the estimate and its error",
    ):
        assert text in str(solution)


def test_what_is_known_exactly_has_no_correlation_of_its_estimate_and_error() -> None:
    """An actuator without noise behind a gain that is free: rounding divided by rounding was 0.94."""
    ocp = co.Problem(4.0)
    x, v = ocp.state("x", initial=1.0, variance=0.02), ocp.state("v", initial=0.0, variance=0.01)
    a, u = ocp.state("a", initial=0.0), ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, a, noise=0.01)
    ocp.dynamics(a, (u - a) / 0.3)
    ocp.measurement("m", x, noise=0.005)
    ocp.minimize_expected(running=0.05 * u**2 + x**2 + 0.1 * a**2, terminal_weight={x: 20.0, v: 5.0})
    ocp.chance(x, lower=-0.45, probability=0.95, name="wall")
    found = co.solve(ocp, intervals=20, progress=False)
    assert np.sqrt(found.loop.E[:, 2, 2].max()) < 1e-20
    assert found.optimality.cross_covariance < 1e-4
