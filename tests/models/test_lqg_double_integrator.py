"""The double integrator of the notes: its table, the closed form in continuous time, and the solver against it."""

from __future__ import annotations

import numpy as np
import pytest
from linear_systems import AVERAGE_COST, PHI, PRINTED, S_INF, K
from scipy.integrate import solve_ivp

import covocp as co
from covocp.blocks import kalman, riccati
from covocp.models import lqg_double_integrator as model

A, B, H = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
Q, R = np.diag([1.0, 0.1]), 0.4


def test_table():
    sampled = model.sampled()
    design = riccati.lqg(**vars(sampled))
    np.testing.assert_array_equal(sampled.transition, PHI)
    np.testing.assert_allclose(design.regulator.cost, S_INF, **PRINTED)
    np.testing.assert_allclose(design.regulator.gain, K, **PRINTED)
    assert design.average_cost == pytest.approx(AVERAGE_COST, abs=1e-8)


def test_exact_by_integration():
    """Both Riccati equations and the cost, integrated as they are written in any textbook."""
    exact = model.exact(duration=4.0, position=0.7, speed=-0.2, initial_variance=0.3)

    def backward(t, s):
        S = s.reshape(2, 2)
        return -(A.T @ S + S @ A + Q - S @ B @ B.T @ S / R).ravel()

    options = {"rtol": 1e-11, "atol": 1e-13, "dense_output": True}
    S = solve_ivp(backward, (4.0, 0.0), np.zeros(4), **options).sol
    gain = lambda t: B.T @ S(t).reshape(2, 2) / R  # noqa: E731

    def forward(t, z):
        """Nominal, E, covariance of the estimated deviation, cost."""
        x, E, X = z[:2], z[2:6].reshape(2, 2), z[6:10].reshape(2, 2)
        C, L = gain(t), E @ H.T / 0.025
        closed = A - B @ C
        u = -C @ x
        slope_E = A @ E + E @ A.T + 0.1 * B @ B.T - 0.025 * L @ L.T
        slope_X = closed @ X + X @ closed.T + 0.025 * L @ L.T
        cost = x @ Q @ x + R * u @ u + np.trace(Q @ (E + X)) + R * float((C @ X @ C.T).item())
        return np.concatenate([closed @ x, slope_E.ravel(), slope_X.ravel(), [cost]])

    start = np.concatenate([[0.7, -0.2], 0.3 * np.eye(2).ravel(), np.zeros(5)])
    run = solve_ivp(forward, (0.0, 4.0), start, **options).sol
    np.testing.assert_allclose(exact.S.reshape(-1, 4), S(exact.t).T, atol=1e-8)
    np.testing.assert_allclose(exact.x, run(exact.t)[:2].T, atol=1e-8)
    np.testing.assert_allclose(exact.E.reshape(-1, 4), run(exact.t)[2:6].T, atol=1e-8)
    assert exact.cost == pytest.approx(run(4.0)[-1], rel=1e-9)
    np.testing.assert_allclose(
        exact.u, [-(gain(t) @ x).item() for t, x in zip(exact.t, exact.x, strict=True)], atol=1e-8
    )


def test_blocks_are_the_rates_of_the_closed_form():
    exact, h = model.exact(t=[2.0 - 1e-4, 2.0, 2.0 + 1e-4]), 2e-4
    slope = (exact.S[2] - exact.S[0]) / h
    np.testing.assert_allclose(riccati.rate(exact.S[1], A, B, Q, R), slope, rtol=1e-5, atol=1e-7)
    slope = (exact.E[2] - exact.E[0]) / h
    np.testing.assert_allclose(kalman.rate(exact.E[1], A, H, 0.1 * B @ B.T, 0.025), slope, rtol=1e-5, atol=1e-7)


def test_long_horizon_begins_with_the_steady_regulator():
    exact = model.exact(duration=18.0)
    np.testing.assert_allclose(exact.gain[0], riccati.lqr(A, B, Q, R).gain, rtol=1e-6)
    steady = kalman.steady_state(A, H, 0.1 * B @ B.T, 0.025, discrete=False)
    np.testing.assert_allclose(exact.E[-1], steady.prior, rtol=1e-6)


def test_solver_finds_regulator_and_filter():
    """Certainty equivalence: the nominal is that without noise; costs converge with the mesh."""
    errors = []
    for intervals in (50, 100, 200):
        solution = co.solve(model.problem(), intervals=intervals, progress=False)
        exact = model.exact(t=solution.t)
        errors.append(abs(solution.cost - exact.cost))
    assert errors[2] < 1e-5 * exact.cost
    assert errors[0] > 2.5 * errors[1] > 6 * errors[2]
    np.testing.assert_allclose(solution["position"], exact.x[:, 0], atol=1e-3)  # the end weighs next to nothing
    np.testing.assert_allclose(solution["E"], exact.E, atol=1e-6)
    np.testing.assert_allclose(solution.gains["C"][:-1], exact.gain[:-1], atol=5e-3)


def test_documented_cost():
    exact = model.exact()
    assert f"J = {exact.cost:.8f}, of which {exact.nominal_cost:.8f}" in model.__doc__
