"""Costates against finite differences of the optimal cost, closed forms, and the adjoint equations written out."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from certificates import is_symmetric, lag_hamiltonian, lag_rates, second_singular_value
from problems import LAG_EIGENVALUE, lag, solve

import covocp as co
from covocp.extremal.costates import integrated_costates
from covocp.models import (
    chord_test,
    free_time_integrator,
    mass_chain,
    noisy_integrator,
    unknown_gain,
    unknown_lag,
)

FORMULATIONS = ("eliminated", "states")


@pytest.fixture(scope="module", params=FORMULATIONS)
def solved(request):
    """Solver and solution of the lag with x(T) = 1, weight 10."""
    solver = co.Solver(lag().problem, covariances=request.param, tolerance=1e-9)
    return solver, solver.solve(progress=False)


def slope(solver, solution, name, index, step):
    """Central difference of the optimal cost by one entry of a parameter."""
    value = {"start": [0.0], "final": [1.0], "initial": [1.0, 0.0, 5.0]}[name]
    costs = []
    for sign in (1, -1):
        moved = list(value)
        moved[index] += sign * step
        costs.append(solver.solve({name: moved}, guess=solution, progress=False).cost)
    return (costs[0] - costs[1]) / (2 * step)


def test_costate_of_the_start_is_the_slope_of_the_cost(solved):
    solver, solution = solved
    assert solution.costate("x")[0] == pytest.approx(slope(solver, solution, "start", 0, 1e-3), rel=1e-5)


@pytest.mark.parametrize("entry", [(0, 0), (1, 0), (1, 1)])
def test_matrix_costate_of_the_start_is_the_slope_of_the_cost(solved, entry):
    """The slope by an off-diagonal entry, which stands twice in the matrix, is 2 P_ij."""
    solver, solution = solved
    index = [(0, 0), (1, 0), (1, 1)].index(entry)
    expected = solution.costate("E")[0][entry] * (1 if entry[0] == entry[1] else 2)
    assert slope(solver, solution, "initial", index, 1e-3) == pytest.approx(expected, rel=1e-5, abs=1e-7)


def test_multiplier_of_the_end_is_minus_the_slope_of_the_cost(solved):
    solver, solution = solved
    ell = solution.multipliers.final[0]
    assert -slope(solver, solution, "final", 0, 1e-3) == pytest.approx(ell, rel=1e-5)
    assert solution.costate("x")[-1] == pytest.approx(ell, rel=1e-12)  # p(T) = k_x + l, k_x = 0
    assert ell == pytest.approx(-1.4158328, rel=1e-4)


@pytest.mark.parametrize("duration", [6.0, 10.0])
def test_hamiltonian_is_the_slope_by_the_duration(duration):
    costs = [solve(lag(duration=duration + d).problem, tolerance=1e-9).cost for d in (0.01, -0.01)]
    values = lag_hamiltonian(solve(lag(duration=duration).problem, tolerance=1e-9))
    assert np.mean(values) == pytest.approx((costs[0] - costs[1]) / 0.02, abs=2e-5)


@pytest.mark.parametrize(
    ("final", "weight", "ell", "H"),
    [
        (0.0, 0.1, 0.0616565, -0.00289492),
        (0.0, 1.0, 0.1712804, -0.02234059),
        (0.0, 10.0, 0.3317939, -0.08383322),
        (1.0, 0.1, -1.8356321, -0.00002238),
        (1.0, 1.0, -1.6178997, -0.00494070),
        (1.0, 10.0, -1.4158328, -0.04275282),
    ],
)
def test_published_multiplier_and_hamiltonian(final, weight, ell, H):
    solution = solve(lag(weight, final).problem, intervals=200)
    found = solution.multipliers.final[0]
    assert found * (1 if final else np.sign(found)) == pytest.approx(ell, rel=2e-5)
    values = lag_hamiltonian(solution)
    assert np.mean(values) == pytest.approx(H, abs=2e-6)
    assert np.ptp(values) < 1e-5


# --- the adjoint equations --------------------------------------------------------------------------------------------


def test_costates_obey_the_adjoint_equations(solved):
    """Integral of the rates written out, by Simpson's rule over two intervals, against the change of the costates."""
    _, solution = solved
    h = 0.1
    for values, rates in zip((solution.costate("x"), solution.costate("E")), lag_rates(solution), strict=True):
        change = values[2:] - values[:-2]
        expected = h / 3 * (rates[:-2] + 4 * rates[1:-1] + rates[2:])
        scale = np.abs(values).max()
        np.testing.assert_allclose(change[2:], expected[2:], atol=2e-5 * scale)


def test_terminal_costates(solved):
    """P(T) = C."""
    _, solution = solved
    np.testing.assert_allclose(solution.costate("E")[-1], np.diag([0.0, 10.0]), atol=1e-9)


def test_optimal_control(solved):
    """H_u = u + p = 0 in the mean over the two intervals at a node, weighted by its hat; by Simpson's rule here."""
    _, solution = solved
    middle = 0.05 + 0.1 * np.arange(100)
    rates, h = lag_rates(solution)[0], 0.1
    p = solution.costate("x")
    between = (p[1:] + p[:-1]) / 2 + h / 8 * (rates[:-1] - rates[1:])
    residual = solution["u"] + p
    inside = solution.at(middle)["u"] + between
    mean = (2 * inside[:-1] + 2 * residual[1:-1] + 2 * inside[1:]) / 6
    np.testing.assert_allclose(mean, 0, atol=1e-5)


def test_matrix_costate_is_symmetric_of_rank_one(solved):
    """Rank-one C and no running cost on E [specification, section 5, (iii)]."""
    _, solution = solved
    P = solution.costate("E")
    assert is_symmetric(P)
    assert second_singular_value(P) < 1e-6
    assert np.linalg.eigvalsh(P).min() > -1e-6


@pytest.mark.parametrize("weight", [0.1, 1.0, 10.0])
def test_costate_of_the_parameter_variance(weight):
    """P_22(0) = 1/(50 lambda) for every weight [specification, 6.4]."""
    solution = solve(lag(weight, 0.0).problem, intervals=200)
    assert solution.costate("E")[0, 1, 1] == pytest.approx(1 / (50 * LAG_EIGENVALUE), rel=1e-5)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("step", ["gauss", "rk4", "strang"])
def test_two_ways_to_the_costates(formulation, step):
    """The adjoint of the discrete steps against the integrated adjoint equations: the error of the step."""
    solution = solve(lag().problem, covariances=formulation, covariance_step=step, intervals=200)
    one, two = solution.costates, integrated_costates(solution.extremal, 2)
    size = np.abs(one.matrices).max()
    limit = {"gauss": 1e-6, "rk4": 1e-6, "strang": 2e-3}[step]
    assert np.abs(one.state - two.state).max() < limit * np.abs(one.state).max() * 5
    assert np.abs(one.matrices - two.matrices).max() < limit * size


def test_two_ways_to_the_costates_of_the_chain():
    solution = solve(mass_chain.problem(2), intervals=200)
    one, two = solution.costates, integrated_costates(solution.extremal, 1)
    np.testing.assert_allclose(one.state, two.state, atol=1e-4 * np.abs(one.state).max())
    np.testing.assert_allclose(one.matrices, two.matrices, atol=1e-4 * np.abs(one.matrices).max())
    assert second_singular_value(solution.costate("E")) > 0.01  # C of rank two


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("alpha", "beta"), [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (0.7, 1.3)])
def test_noisy_integrator(alpha, beta):
    solution = solve(noisy_integrator.problem(alpha, beta), intervals=200)
    exact = noisy_integrator.exact(alpha, beta, solution.t)
    np.testing.assert_allclose(solution.costate("E").ravel(), exact.P, atol=1e-5)
    np.testing.assert_allclose(solution.costate("x"), exact.p, atol=1e-4)
    assert solution.multipliers.final[0] == pytest.approx(exact.ell, rel=1e-5)


def test_unknown_gain():
    """p is constant; P_12 falls from 2 ... to 0 linearly: dP_12/dt = -u P_11 [E3]."""
    solution = solve(unknown_gain.problem())
    exact = unknown_gain.exact(t=solution.t)
    np.testing.assert_allclose(solution.costate("x"), exact.ell, rtol=1e-6)
    P = solution.costate("E")
    np.testing.assert_allclose(P[:, 0, 0], 1.0, rtol=1e-9)
    np.testing.assert_allclose(P[:, 0, 1], 1.0 - solution.t, atol=1e-6)
    np.testing.assert_allclose(P[:, 1, 1], (1.0 - solution.t) ** 2, atol=1e-6)


def test_chord():
    solution = solve(chord_test.problem())
    np.testing.assert_allclose(solution.costate("x"), -2 - solution.t, atol=1e-8)
    np.testing.assert_allclose(solution.costate("E").ravel(), 1.0, atol=1e-12)


def test_lag_against_its_eigenfunction():
    solution = solve(lag(10.0, 0.0).problem, intervals=200)
    exact = unknown_lag.exact(t=solution.t)
    sign = np.sign(solution.multipliers.final[0] * exact.ell)
    np.testing.assert_allclose(sign * solution["x"], exact.x, atol=1e-4)
    np.testing.assert_allclose(-sign * solution.costate("x")[1:-1], exact.u[1:-1], atol=1e-4)


@pytest.mark.parametrize("w", [1.0, 0.2])
def test_transversality(w):
    """k_T + H(T) = 0: w + u^2/2 + p u + x = 0 at T, H constant."""
    solution = solve(free_time_integrator.problem(w), intervals=100)
    exact = free_time_integrator.exact(w, solution.t / solution.duration)
    x, u, p = solution["x"], solution["u"], solution.costate("x")
    values = u**2 / 2 + p * u + x
    np.testing.assert_allclose(values[1:-1] + w, 0, atol=1e-5)
    assert solution.duration == pytest.approx(exact.duration, rel=1e-6)
    assert solution.multipliers.final[0] == pytest.approx(exact.ell, rel=1e-5)
    assert abs(solution.optimality.transversality) < 1e-4


def test_vector_costates():
    """x' = v, v' = u to (1, 0): p_x constant, p_v = -u linear: u = 6 - 12 t."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", 2, initial=0.0, final=[1, 0]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize(running=0.5 * u**2)
    solution = solve(ocp, intervals=20)
    np.testing.assert_allclose(
        solution.costate("x"), np.column_stack([np.full(21, -12.0), 12 * solution.t - 6]), atol=1e-6
    )
    np.testing.assert_allclose(solution.multipliers.final, [-12, 6], rtol=1e-7)


def test_terminal_cost_and_terminal_condition_add_up():
    """p(T) = k_x + l: with k = 3 x, the costate is the same and the multiplier 3 less."""
    found = []
    for slope_of_cost in (0.0, 3.0):
        ocp = co.Problem(duration=1.0)
        x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
        ocp.dynamics(x, u)
        ocp.minimize(running=0.5 * u**2, terminal=slope_of_cost * x)
        solution = solve(ocp, intervals=10)
        found.append((solution.costate("x")[-1], solution.multipliers.final[0]))
    assert found[0] == pytest.approx((-1.0, -1.0))
    assert found[1] == pytest.approx((-1.0, -4.0))


def test_jump_of_the_costate_where_a_state_bound_is_touched():
    """x' = v, v' = u, x <= 0.2 touched at one time t = 1/2: p_x jumps there by the multiplier, constant elsewhere."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", 2, initial=[0, 1], final=[0, -1], upper=[0.2, np.inf]), ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u))
    ocp.minimize(running=0.5 * u**2)
    solution = solve(ocp, intervals=100, tolerance=1e-9)
    p = solution.costate("x")[:, 0]
    limit = 0.2
    slope_of_control = 24 * (1 - 4 * limit)  # Bryson and Ho, section 3.11: u = -8 (1 - 3 l) + 24 (1 - 4 l) t, t < 1/2
    np.testing.assert_allclose(solution["u"][:45], -8 * (1 - 3 * limit) + slope_of_control * solution.t[:45], atol=1e-3)
    np.testing.assert_allclose(p[2:49], slope_of_control, atol=1e-3)
    np.testing.assert_allclose(p[52:-2], -slope_of_control, atol=1e-3)
    assert solution.multipliers.states[:, 0].sum() == pytest.approx(2 * slope_of_control, rel=1e-3)
