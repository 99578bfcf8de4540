"""Laws in a loop with plant and filter: linear loops have closed forms."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_are, solve_continuous_lyapunov

import covocp as co
from covocp.base.matrices import unpack
from covocp.simulation.laws import extended_filter, gain_filter, simulate_law

A, B, H = np.array([[0.0, 1.0], [0.5, -0.2]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
W, V = np.diag([0.02, 0.1]), np.array([[0.05]])
COST = solve_continuous_are(A, B, np.eye(2), np.eye(1))
GAIN = B.T @ COST
FILTER = solve_continuous_are(A.T, H.T, W, V) @ H.T @ np.linalg.inv(V)
X, U, T = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("t")
PLANT = ca.Function("plant", [X, U], [ca.DM(A) @ X + ca.DM(B) @ U])
LAW = ca.Function("law", [X, T], [-ca.DM(GAIN) @ X])
CONSTANT = ca.Function("gain", [X, T], [ca.DM(FILTER)])
START, ESTIMATE = np.array([1.0, -0.5]), np.array([0.2, 0.3])


def test_state_feedback_is_the_matrix_exponential():
    running = ca.Function("running", [X, U], [0.5 * (ca.sumsqr(X) + U**2)])
    run = simulate_law(PLANT, LAW, initial=START, duration=6.0, running=running, samples=13)
    closed = A - B @ GAIN
    np.testing.assert_allclose(run.x, [expm(closed * t) @ START for t in run.t], atol=1e-7)
    np.testing.assert_allclose(run.u, -run.x @ GAIN.T, atol=1e-12)
    np.testing.assert_array_equal(run.filter_state, run.x)
    spent = 0.5 * START @ COST @ START - 0.5 * np.einsum("ki,ij,kj->k", run.x, COST, run.x)
    np.testing.assert_allclose(run.cost, spent, atol=1e-7)
    assert not run.diverged


def test_python_laws_give_what_casadi_functions_give():
    observer = gain_filter(PLANT, CONSTANT, H, ESTIMATE, integrate=[[1.0, 2.0]])
    law = ca.Function("law", [ca.SX.sym("e", 3), T], [0.0])
    whole = ca.SX.sym("whole", 3)
    law = ca.Function("law", [whole, T], [-ca.DM(GAIN) @ whole[:2] - 0.1 * whole[2]])
    wanted = simulate_law(PLANT, law, initial=START, duration=3.0, observer=observer)
    plain = gain_filter(PLANT, lambda x, t: FILTER, H, ESTIMATE, integrate=[[1.0, 2.0]])
    found = simulate_law(PLANT, lambda x, t: -GAIN @ x[:2] - 0.1 * x[2], initial=START, duration=3.0, observer=plain)
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-8)
    np.testing.assert_allclose(found.filter_state, wanted.filter_state, atol=1e-8)


def test_filter_and_integral_of_its_estimate():
    """The estimation error obeys e' = (A - K H) e whatever the law; the integral is that of the estimate."""
    observer = gain_filter(PLANT, CONSTANT, H, ESTIMATE, integrate=[1.0, 0.0])
    whole = ca.SX.sym("whole", 3)
    law = ca.Function("law", [whole, T], [-ca.DM(GAIN) @ whole[:2]])
    run = simulate_law(PLANT, law, initial=START, duration=4.0, observer=observer, samples=2001)
    errors = run.filter_state[:, :2] - run.x
    wanted = [expm((A - FILTER @ H) * t) @ (ESTIMATE - START) for t in run.t]
    np.testing.assert_allclose(errors, wanted, atol=1e-7)
    assert run.filter_state[-1, 2] == pytest.approx(np.trapezoid(run.filter_state[:, 0], run.t), abs=1e-6)


def test_extended_filter_of_a_linear_plant_is_the_kalman_bucy_filter():
    """Covariance by the exponential of its Hamiltonian matrix."""
    first = np.diag([0.5, 0.8])
    observer = extended_filter(PLANT, H, W, V, ESTIMATE, first)
    run = simulate_law(PLANT, LAW, initial=START, duration=3.0, observer=observer, samples=7)
    hamiltonian = np.block([[-A.T, H.T @ np.linalg.solve(V, H)], [W, A]])
    for t, half in zip(run.t, run.filter_state[:, 2:], strict=True):
        flow = expm(hamiltonian * t)
        below, above = flow[2:, :2] + flow[2:, 2:] @ first, flow[:2, :2] + flow[:2, 2:] @ first
        np.testing.assert_allclose(unpack(half, 2), below @ np.linalg.inv(above), atol=1e-7)


def test_extended_filter_uses_the_slope_at_the_estimate():
    plant = ca.Function("plant", [X, U], [ca.vertcat(X[1] - X[0] ** 3, U - ca.sin(X[1]))])
    observer = extended_filter(plant, H, W, V, ESTIMATE, np.eye(2))
    state, y = np.array([0.2, 0.3, 1.0, 0.1, 0.7]), 0.9
    rate = observer.rate(state, 0.0, 0.4, y).full().ravel()
    P = np.array([[1.0, 0.1], [0.1, 0.7]])
    slope = np.array([[-3 * 0.2**2, 1.0], [0.0, -np.cos(0.3)]])
    gain = P @ H.T / V
    np.testing.assert_allclose(rate[:2], plant(state[:2], 0.4).full().ravel() + (gain * (y - 0.2)).ravel(), rtol=1e-13)
    np.testing.assert_allclose(unpack(rate[2:], 2), slope @ P + P @ slope.T + W - gain @ H @ P, rtol=1e-13)


def test_jumps_of_the_law_at_breaks_are_integrated_exactly():
    plant = ca.Function("plant", [X, U], [ca.vertcat(U, X[0])])
    law = ca.Function("law", [X, T], [ca.if_else(T < 1.0, 1.0, -1.0)])
    run = simulate_law(plant, law, initial=[0.0, 0.0], duration=2.0, breaks=(1.0,), samples=5)
    np.testing.assert_allclose(run.x[:, 0], [0.0, 0.5, 1.0, 0.5, 0.0], atol=1e-8)


def test_a_run_that_diverges_says_so():
    law = ca.Function("law", [X, T], [100.0 * X[0]])
    run = simulate_law(PLANT, law, initial=START, duration=10.0, samples=101)
    assert run.diverged
    assert np.isfinite(run.x[:10]).all()
    assert np.isnan(run.x[-1]).all()
    assert np.isnan(run.u[-1]).all()
    noisy = simulate_law(PLANT, law, initial=START, duration=10.0, samples=11, runs=3)
    assert noisy.diverged.shape == (3,)
    assert noisy.diverged.all()


SCALAR, RATE = ca.SX.sym("x"), ca.SX.sym("u")
NOTHING = ca.Function("law", [SCALAR, T], [0.0])


@pytest.mark.parametrize("start", [1.0, 1e5, 2e9, 1e40])
@pytest.mark.parametrize("runs", [None, 2])
def test_a_stable_loop_from_far_away_has_not_diverged(start, runs):
    """x' = -0.1 x: neither the size of the start nor that of the cost says anything about divergence."""
    plant = ca.Function("plant", [SCALAR, RATE], [-0.1 * SCALAR + RATE])
    cost = ca.Function("cost", [SCALAR, RATE], [SCALAR**2])
    run = simulate_law(plant, NOTHING, initial=[start], duration=20.0, samples=5, running=cost, runs=runs)
    assert not run.diverged.any()
    np.testing.assert_allclose(
        run.x[..., 0], np.broadcast_to(start * np.exp(-0.1 * run.t), run.x.shape[:-1]), rtol=1e-6
    )
    np.testing.assert_allclose(run.cost[..., -1], 5.0 * start**2 * -np.expm1(-4.0), rtol=1e-6)


def test_a_plant_that_starts_at_zero_may_go_far_in_its_units():
    """x' = 1e22 - x, as a density that is filled."""
    plant = ca.Function("plant", [SCALAR, RATE], [1e22 - SCALAR + RATE])
    for runs in (None, 2):
        run = simulate_law(plant, NOTHING, initial=[0.0], duration=4.0, samples=5, runs=runs)
        assert not run.diverged.any()
        np.testing.assert_allclose(run.x[..., -1, 0], -1e22 * np.expm1(-4.0), rtol=1e-7)


def test_a_filter_that_knows_nothing_yet_has_not_diverged():
    """P' = -0.2 P - P^2 / V from P(0) = (100 km)^2: 1/P grows as exp(0.2 t) and its integral."""
    plant = ca.Function("plant", [SCALAR, RATE], [-0.1 * SCALAR + RATE])
    observer = extended_filter(plant, [1.0], [[0.0]], [[1e4]], [0.0], [[1e10]])
    run = simulate_law(plant, NOTHING, initial=[1e5], duration=20.0, samples=5, observer=observer)
    assert not run.diverged
    inverse = np.exp(0.2 * run.t) * 1e-10 + np.expm1(0.2 * run.t) / 0.2 / 1e4
    np.testing.assert_allclose(run.filter_state[:, 1], 1.0 / inverse, rtol=1e-5)


@pytest.mark.parametrize(("start", "samples"), [(10.0, 61), (0.05, 61), (1e-4, 3)])
@pytest.mark.parametrize("runs", [None, 2])
def test_a_finite_escape_is_a_divergence(start, samples, runs):
    """x' = x^2: x = 1 / (1 / x(0) - t), also where it escapes before the first sample."""
    plant = ca.Function("plant", [SCALAR, RATE], [SCALAR**2 + RATE])
    duration = max(60.0, 3.0 / start)
    run = simulate_law(
        plant, NOTHING, initial=[start], duration=duration, samples=samples, runs=runs, step=duration / 6000
    )
    assert run.diverged.all()
    before = run.t < 0.95 / start
    wanted = 1.0 / (1.0 / start - run.t[before])
    np.testing.assert_allclose(run.x[..., before, 0], np.broadcast_to(wanted, run.x[..., before, 0].shape), rtol=1e-5)
    assert np.isnan(run.x[..., run.t > 1.0 / start, 0]).all()


@pytest.mark.parametrize("jump", [1e3, 1e12])
def test_a_jump_that_is_not_named_is_found_to_the_rounding_of_time(jump):
    plant = ca.Function("plant", [SCALAR, RATE], [RATE])
    run = simulate_law(plant, lambda x, t: np.array([jump * (t > 0.5)]), initial=[0.0], duration=1.0, samples=11)
    assert not run.diverged
    np.testing.assert_allclose(run.x[:, 0], jump * np.clip(run.t - 0.5, 0.0, None), rtol=1e-9, atol=1e-8)


def test_a_loop_that_cannot_be_followed_is_told():
    """x' = 1 / (1 - x) has no solution beyond t = 1/2, where it would jump to and fro about 1."""
    plant = ca.Function("plant", [SCALAR, RATE], [1.0 / (1.0 - SCALAR) + RATE])
    with pytest.warns(co.CovocpWarning, match="ends at 0.5"):
        run = simulate_law(plant, NOTHING, initial=[0.0], duration=2.0, samples=9)
    assert run.diverged
    np.testing.assert_allclose(run.x[:2, 0], 1.0 - np.sqrt(1.0 - 2.0 * run.t[:2]), rtol=1e-7)
    assert np.isnan(run.x[3:]).all()


def test_runs_without_noise_are_the_accurate_run():
    observer = gain_filter(PLANT, CONSTANT, H, ESTIMATE)
    wanted = simulate_law(PLANT, LAW, initial=START, duration=3.0, observer=observer, samples=31)
    found = simulate_law(PLANT, LAW, initial=START, duration=3.0, observer=observer, samples=31, runs=2, step=0.01)
    assert found.x.shape == (2, 31, 2)
    assert found.u.shape == (2, 31, 1)
    for run in range(2):
        np.testing.assert_allclose(found.x[run], wanted.x, atol=1e-7)
        np.testing.assert_allclose(found.filter_state[run], wanted.filter_state, atol=1e-7)


def test_covariance_of_runs_with_noise():
    """State and estimation error of the closed loop, stationary: their covariance solves a Lyapunov equation."""
    runs = 2000
    observer = gain_filter(PLANT, CONSTANT, H, np.zeros(2))
    found = simulate_law(
        PLANT,
        LAW,
        initial=np.zeros(2),
        duration=8.0,
        observer=observer,
        samples=2,
        runs=runs,
        step=0.05,
        process_noise=W,
        measurement_noise=V,
        seed=3,
    )
    loop = np.block([[A, -B @ GAIN], [FILTER @ H, A - B @ GAIN - FILTER @ H]])
    density = np.block([[W, np.zeros((2, 2))], [np.zeros((2, 2)), FILTER @ V @ FILTER.T]])
    wanted = solve_continuous_lyapunov(loop, -density)
    measured = np.cov(np.hstack([found.x[:, -1], found.filter_state[:, -1]]).T)
    spread = np.sqrt((wanted**2 + np.outer(np.diag(wanted), np.diag(wanted))) / runs)
    assert np.all(np.abs(measured - wanted) < 4.0 * spread)
    again = simulate_law(PLANT, LAW, initial=np.zeros(2), duration=1.0, samples=2, runs=2, process_noise=0.1, seed=5)
    same = simulate_law(PLANT, LAW, initial=np.zeros(2), duration=1.0, samples=2, runs=2, process_noise=0.1, seed=5)
    np.testing.assert_array_equal(again.x, same.x)
    assert not np.array_equal(again.x[0], again.x[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"initial": [1.0]}, "'initial'"),
        ({"runs": 2, "process_noise": -1.0}, "'process_noise'"),
        ({"runs": 2, "law": lambda x, t: np.zeros(1)}, "'law'"),
        ({"duration": 0.0}, "'duration'"),
        ({"samples": 1}, "'samples'"),
        ({"runs": 0}, "'runs'"),
        ({"runs": 2, "step": 0.0}, "'step'"),
    ],
)
def test_bad_arguments_are_named(change, message):
    options = {"law": LAW, "initial": START, "duration": 1.0, **change}
    with pytest.raises(co.ProblemError, match=message):
        simulate_law(PLANT, options.pop("law"), **options)
