"""The closed loop of the first-order lag, section 6.12, against its equations and the reference integrator.

The integrator, `closed_loops`, is itself held here by closed forms, identities and the values of the specification.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import closed_loops
import numpy as np
import pytest
from closed_loops import closed_loop, lag, least_energy, lower, piecewise_linear, with_statistics

import covocp as co
from covocp.models import unknown_lag

# Half a unit of the last digit that the specification gives.
DIGITS = 0.5e-6

# --- the reference integrator -----------------------------------------------------------------------------------------


@cache
def classical():
    return closed_loop(lag(), least_energy(), 10.0)


def test_classical_design_has_the_specified_costs():
    loop = classical()
    assert loop.deterministic == pytest.approx(1.0, abs=1e-8)  # 2 (1 - e^-20)/(1 - e^-20)^2 / 2
    assert loop.matrix_terms == pytest.approx(1.504062, abs=DIGITS)
    assert loop.feedback == pytest.approx(0.150444, abs=DIGITS)
    assert loop.cost == pytest.approx(2.504062, abs=DIGITS)
    assert loop.x[-1, 0] == pytest.approx(1.0, abs=1e-10)
    assert loop.X[-1, 0, 0] == pytest.approx(1.353619, abs=DIGITS)
    assert loop.E[-1, 0, 0] == pytest.approx(1.014567, abs=DIGITS)
    assert loop.E[-1, 1, 1] == pytest.approx(3.499117, abs=DIGITS)


def test_incorrect_statistics_have_the_specified_effect():
    design = lag()
    loop = closed_loop(design, least_energy(), 10.0, truth=with_statistics(design, Q=np.diag([2.0, 0.0]), U=[[0.5]]))
    values = [loop.cost, loop.X[-1, 0, 0], loop.E[-1, 0, 0], loop.Xhat[-1, 0, 0], loop.Z[-1, 0, 0]]
    np.testing.assert_allclose(values, [2.85209, 1.71474, 1.06310, 0.30324, -0.17420], atol=0.6e-5)
    # (b's deviation is not controlled and has no noise: its actual variance stays)
    np.testing.assert_allclose(loop.X[:, 1, 1], 5.0, rtol=1e-9)


def test_a_kalman_filter_leaves_estimate_and_error_uncorrelated():
    loop = classical()
    assert np.abs(loop.Z).max() < 1e-9
    np.testing.assert_allclose(loop.E[:, 1, 1] + loop.Xhat[:, 1, 1], 5.0, rtol=1e-10)


def test_with_a_known_lag_filter_and_feedback_have_closed_forms():
    """Without uncertainty of b both Riccati equations are scalar: E as in `unknown_lag.exact`, S Bernoulli's."""
    loop = closed_loop(lag(parameter_variance=0.0), least_energy(), 10.0)
    root = np.sqrt(2.0)
    rate = root * (2 + root * np.tanh(root * loop.t)) / (root + 2 * np.tanh(root * loop.t))
    np.testing.assert_allclose(loop.E[:, 0, 0], rate - 1, atol=1e-9)
    np.testing.assert_allclose(loop.S[:, 0, 0], 1 / (np.exp(2 * (10 - loop.t)) - 0.5), rtol=1e-10, atol=1e-12)
    assert np.abs(loop.E[:, 0, 1]).max() < 1e-12


@pytest.mark.parametrize("control", [least_energy(), lambda t: np.sin(t)])
def test_cost_expressions_agree_along_any_control(control):
    """(E-1), (E-20) and the form by innovations, with weights A and N besides."""
    A, N = np.array([[0.3, 0.1], [0.1, 0.2]]), np.array([[0.2], [-0.1]])
    system = replace(lag(), weights=lambda x, u: (A, np.array([[0.8]]), N))
    loop = closed_loop(system, control, 4.0)
    assert loop.equivalent == pytest.approx(loop.cost, rel=1e-9)
    assert loop.innovations == pytest.approx(loop.cost, rel=1e-9)


def test_other_gains_cost_more():
    """The gains of the design are the best ones [Schmidt 6.3]: a tenth more or less of either costs more."""
    best = classical()
    for factor in (0.9, 1.1):
        loops = [
            closed_loop(lag(), least_energy(), 10.0, feedback=lambda t, f=factor: f * best.gains(t)[1]),
            closed_loop(lag(), least_energy(), 10.0, filter=lambda t, f=factor: f * best.gains(t)[0]),
        ]
        assert min(loop.cost for loop in loops) > best.cost + 1e-4
        np.testing.assert_allclose(loops[0].E, best.E, atol=1e-9)
        assert np.linalg.eigvalsh(loops[1].E - best.E)[1:].min() > -1e-9


@pytest.mark.parametrize("make", [lag, closed_loops.mars, closed_loops.mars_in_density])
def test_slopes_by_hand_are_derivatives(make):
    """By complex steps; the measurement's slope is that of the measurement by its definition, 7.5-11."""
    system = make()
    generator = np.random.default_rng(6)
    for _ in range(5):
        x = system.start * (1 + 0.1 * generator.standard_normal(system.start.size))
        if x.size == 5:
            x[1], x[3] = 0.3, -0.2
            x[4] = system.start[4] * 0.95 if x[4] < 0 else 1e-7
        u = np.array([0.4])
        step = 1e-30
        columns = [system.rate(x + 1j * step * e, u).imag / step for e in np.eye(x.size)]
        np.testing.assert_allclose(system.F(x, u), np.array(columns).T, rtol=1e-12, atol=1e-18)
        np.testing.assert_allclose(
            system.G(x, u)[:, 0], system.rate(x.astype(complex), u + 1j * step).imag / step, rtol=1e-12
        )
        if x.size == 5:

            def measurement(x, u=u):
                rho = np.exp(x[4]) if x[4].real < 0 else x[4]
                along = -0.5 * closed_loops.BALLISTIC * rho * x[2] ** 2
                angle = x[1] - x[3]
                T = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
                return T @ np.array([along, -along * u[0]])

            columns = [measurement(x + 1j * step * e).imag / step for e in np.eye(5)]
            np.testing.assert_allclose(system.M(x, u), np.array(columns).T, rtol=1e-12, atol=1e-18)


# --- the model --------------------------------------------------------------------------------------------------------


def test_statement_has_the_equations_of_the_thesis():
    """Components written out in the specification, section 6, with B = 1."""
    statement = unknown_lag.steering(process_noise=1.3, measurement_noise=0.7).statement()
    x, u, b, Q, U = 0.9, -0.4, 1.0, 1.3, 0.7
    E = np.array([[1.2, 0.3], [0.3, 4.0]])
    S = np.array([[0.8, -0.2], [-0.2, 0.5]])
    halves = np.concatenate([lower(E), lower(S)])
    rate, matrices, running = statement.rates([x], [u], halves, 0.3, 10.0, statement.values)
    E_rate = [
        -2 * b * E[0, 0] - 2 * x * E[0, 1] + Q - E[0, 0] ** 2 / U,
        -b * E[0, 1] - x * E[1, 1] - E[0, 0] * E[0, 1] / U,
        -(E[0, 1] ** 2) / U,
    ]
    S_rate = [
        2 * b * S[0, 0] + S[0, 0] ** 2,
        b * S[0, 1] + x * S[0, 0] + S[0, 0] * S[0, 1],
        2 * x * S[0, 1] + S[0, 1] ** 2,
    ]
    assert float(rate) == pytest.approx(-b * x + u)
    np.testing.assert_allclose(matrices.full().ravel(), [*E_rate, *S_rate], rtol=1e-13)
    M = np.array([[1.0, 0.0]])
    assert float(running) == pytest.approx(u**2 / 2 + 0.5 * np.trace(S @ E @ M.T @ M @ E) / U)


def test_arguments_reach_the_statement():
    problem = unknown_lag.steering(0.6, 3.0, 8.0, 2.0, initial_variance=0.5)
    statement = problem.statement()
    x0, xf, e0, _ = statement.boundary_values(statement.values)
    assert (x0[0], xf[0], statement.duration.guess) == (0.0, 0.6, 8.0)
    np.testing.assert_array_equal(e0[:3], lower(np.diag([0.5, 2.0])))
    np.testing.assert_array_equal(statement.matrix_end([0.6], 8.0, statement.values), [[3.0], [0.0], [0.0]])


@cache
def combined():
    return co.solve(unknown_lag.steering(), intervals=100, progress=False)


def test_combined_design_has_the_specified_cost():
    assert combined().cost == pytest.approx(2.027146, rel=1e-5)
    table = [-0.00457, -0.00931, -0.01699, -0.02964, -0.05035, -0.08302, -0.12982, -0.17866, -0.14853, 0.35177, 3.07667]
    # Near the end the control has a boundary layer as long as three intervals of this mesh.
    np.testing.assert_allclose(combined()["u"][:-10:10], table[:-1], atol=2e-3)
    assert combined()["u"][-1] == pytest.approx(table[-1], abs=0.05)


def test_reference_integrator_finds_the_combined_row_along_its_control():
    """The cost is flat at its minimum, so the control of a mesh of 100 intervals gives it to six digits."""
    design, solution = lag(), combined()
    control, breaks = piecewise_linear(solution.t, solution["u"])
    loop = closed_loop(design, control, 10.0, breaks=breaks)
    assert loop.cost == pytest.approx(2.027146, rel=5e-6)
    assert loop.cost == pytest.approx(loop.equivalent, rel=1e-9)
    assert loop.deterministic == pytest.approx(1.286758, rel=1e-4)
    assert loop.X[-1, 0, 0] == pytest.approx(0.719375, rel=1e-4)
    assert loop.E[-1, 0, 0] == pytest.approx(0.646544, rel=1e-4)
    assert loop.E[-1, 1, 1] == pytest.approx(4.310046, rel=1e-4)
    truth = with_statistics(design, Q=np.diag([2.0, 0.0]), U=[[0.5]])
    actual = closed_loop(design, control, 10.0, breaks=breaks, truth=truth)
    values = [actual.cost, actual.X[-1, 0, 0], actual.E[-1, 0, 0], actual.Xhat[-1, 0, 0], actual.Z[-1, 0, 0]]
    np.testing.assert_allclose(values, [2.47971, 1.17660, 0.94895, 0.05554, -0.08606], rtol=1e-3)


def test_statistics_that_cannot_be_are_refused():
    with pytest.raises(co.ProblemError, match="'b'"):
        unknown_lag.steering(parameter_variance=-1.0)
    with pytest.raises(co.ProblemError, match="position"):
        unknown_lag.steering(measurement_noise=0.0)
