"""The statement of every model against its equations, written out once more with numpy."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loops import lower

import covocp as co
from covocp.models import (
    brachistochrone,
    bryson_denham,
    chord_test,
    damped_oscillator,
    free_time_integrator,
    goddard_rocket,
    mass_chain,
    noisy_integrator,
    unknown_gain,
    unknown_lag,
)


def covariance(size, generator):
    root = generator.standard_normal((size, size))
    return root @ root.T


def rates(problem, state, control, matrix=None, *, time=0.3, duration=1.0):
    """Rates of the state and of the half-vector, and the running cost."""
    statement = problem.statement()
    half = np.zeros(0) if matrix is None else lower(matrix)
    values = statement.rates(state, control, half, time, duration, statement.values)
    x, e, running = (value.full().ravel() for value in values)
    return x, e, float(running[0])


def terminal(problem, state, matrix=None, *, duration=1.0):
    statement = problem.statement()
    half = np.zeros(0) if matrix is None else lower(matrix)
    return float(statement.terminal(state, half, duration, statement.values))


def boundary(problem):
    """Initial state, final state, initial matrices, final matrices."""
    statement = problem.statement()
    return statement.boundary_values(statement.values)


def kalman(F, Q, M, U, E):
    return F @ E + E @ F.T + Q - E @ M.T @ np.linalg.solve(U, M @ E)


def test_noisy_integrator():
    problem = noisy_integrator.problem(terminal_weight=0.7, integral_weight=1.3)
    x, e, running = rates(problem, [0.4], [1.7], np.array([[0.9]]))
    np.testing.assert_allclose([x[0], e[0], running], [1.7, 0.4, 1.7**2 / 2 + 1.3 * 0.9], rtol=1e-14)
    assert terminal(problem, [0.4], np.array([[0.9]])) == pytest.approx(0.63, rel=1e-14)
    x0, xf, e0, ef = boundary(problem)
    assert (x0[0], xf[0], e0[0]) == (0.0, 1.0, 0.0)
    assert np.isnan(ef).all()
    assert problem.statement().state_bounds[0][0] == 0.0


def test_unknown_gain():
    problem = unknown_gain.problem(1.5, 0.4, 0.8, 0.2, 3.0, 2.0)
    E = covariance(2, np.random.default_rng(1))
    u, b = 0.6, 1.5
    x, e, running = rates(problem, [0.4], [u], E)
    F = np.array([[0.0, u], [0.0, 0.0]])
    np.testing.assert_allclose(x, [b * u])
    np.testing.assert_allclose(e, lower(F @ E + E @ F.T + np.diag([0.2, 0.0])), rtol=1e-13)
    assert running == pytest.approx(0.8 * u**2 / 2)
    assert terminal(problem, [0.4], E) == pytest.approx(E[0, 0])
    x0, xf, e0, _ = boundary(problem)
    assert (x0[0], xf[0], problem.statement().duration.guess) == (0.0, 3.0, 2.0)
    np.testing.assert_array_equal(e0, lower(np.diag([0.0, 0.4])))


@pytest.mark.parametrize("duration_weight", [None, 0.3])
def test_unknown_lag(duration_weight):
    problem = unknown_lag.problem(7.0, 1.0, 8.0, 0.6, 2.0, duration_weight)
    E = covariance(2, np.random.default_rng(2))
    x, u, b = 0.9, -0.4, 1.0
    rate, e, running = rates(problem, [x], [u], E)
    F = np.array([[-b, -x], [0.0, 0.0]])
    np.testing.assert_allclose(rate, [-b * x + u])
    expected = kalman(F, np.diag([1.0, 0.0]), np.array([[1.0, 0.0]]), np.eye(1), E)
    np.testing.assert_allclose(e, lower(expected), rtol=1e-13)
    # written out in the specification, section 6.4
    E11, E12, E22 = E[0, 0], E[0, 1], E[1, 1]
    by_hand = [-2 * E11 - E11**2 + 1 - 2 * x * E12, -E12 - x * E22 - E11 * E12, -(E12**2)]
    np.testing.assert_allclose(e, by_hand, rtol=1e-13)
    assert running == pytest.approx(u**2 / 2)
    free = 0.0 if duration_weight is None else duration_weight * 9.0
    assert terminal(problem, [x], E, duration=9.0) == pytest.approx(7.0 * E22 + free)
    x0, xf, e0, _ = boundary(problem)
    assert (x0[0], xf[0]) == (0.0, 1.0)
    np.testing.assert_array_equal(e0, lower(np.diag([0.6, 2.0])))
    assert problem.statement().duration.guess == 8.0
    assert problem.statement().duration.free is (duration_weight is not None)


@pytest.mark.parametrize("naming", ["table", "equations"])
def test_damped_oscillator(naming):
    problem = damped_oscillator.problem(11.0, 13.0, 0.02, naming)
    E = covariance(4, np.random.default_rng(3))
    y, v, u, a, b = 1.2, -0.7, 3.0, 2.51, 3.15
    x, e, running = rates(problem, [y, v], [u], E)
    if naming == "table":
        row, acceleration = [-b, -a, -v, -y], -b * y - a * v + u
    else:
        row, acceleration = [-a, -b, -y, -v], -a * y - b * v + u
    F = np.zeros((4, 4))
    F[0, 1] = 1.0
    F[1] = row
    np.testing.assert_allclose(x, [v, acceleration], rtol=1e-14)
    M = np.array([[1.0, 0.0, 0.0, 0.0]])
    expected = kalman(F, np.diag([0.0, 0.005, 0.0, 0.0]), M, np.array([[0.02]]), E)
    np.testing.assert_allclose(e, lower(expected), rtol=1e-12)
    assert running == pytest.approx(u**2 / 2)
    assert terminal(problem, [y, v], E) == pytest.approx(11.0 * E[2, 2] + 13.0 * E[3, 3])
    x0, xf, e0, _ = boundary(problem)
    np.testing.assert_array_equal([x0, xf], [[0.0, 0.0], [10.0, 0.0]])
    np.testing.assert_array_equal(e0, lower(np.diag([0.1, 0.1, 0.2, 0.2])))
    assert problem.statement().duration.guess == 10.0
    assert problem.statement().augmented == ("y", "rate", "a", "b")


@pytest.mark.parametrize("masses", [1, 2, 3, 5])
def test_mass_chain(masses):
    m, n = masses, 2 * masses + 2
    problem = mass_chain.problem(m, 17.0)
    generator = np.random.default_rng(4 + m)
    y, v, u = generator.standard_normal(m), generator.standard_normal(m), 0.8
    E = covariance(n, generator)

    def acceleration(y, v, k, d):
        stretch = np.diff(np.concatenate([[0.0], y]))
        force = k * stretch + 0.5 * stretch**3 + d * np.diff(np.concatenate([[0.0], v]))
        total = -force + np.concatenate([force[1:], [0.0]])
        total[0] += u
        return total

    F = np.zeros((n, n))
    F[:m, m : 2 * m] = np.eye(m)
    point, step = np.concatenate([y, v, [2.0, 0.3]]), 1e-5
    for j in range(n):  # fourth-order differences are exact for this cubic
        shift = step * np.eye(n)[j]
        values = [acceleration(p[:m], p[m : 2 * m], p[-2], p[-1]) for p in (point + k * shift for k in (-2, -1, 1, 2))]
        F[m : 2 * m, j] = np.array([1.0, -8.0, 8.0, -1.0]) @ np.array(values) / (12 * step)
    x, e, running = rates(problem, [*y, *v], [u], E)
    np.testing.assert_allclose(x, [*v, *acceleration(y, v, 2.0, 0.3)], rtol=1e-13)
    M = np.zeros((1, n))
    M[0, m - 1] = 1.0
    Q = np.diag([0.0] * m + [0.002] * m + [0.0, 0.0])
    np.testing.assert_allclose(e, lower(kalman(F, Q, M, np.array([[0.01]]), E)), rtol=1e-7, atol=1e-7)
    assert running == pytest.approx(u**2 / 2)
    assert terminal(problem, [*y, *v], E) == pytest.approx(17.0 * (E[-2, -2] + E[-1, -1]))
    x0, xf, e0, _ = boundary(problem)
    np.testing.assert_array_equal(x0, np.zeros(2 * m))
    fixed = np.full(2 * m, np.nan)
    fixed[[m - 1, 2 * m - 1]] = [1.0, 0.0]
    np.testing.assert_array_equal(xf, fixed)
    np.testing.assert_array_equal(e0, lower(np.diag([0.05] * (2 * m) + [0.2, 0.2])))
    assert problem.statement().duration.guess == 10.0 + 0.5 * (m - 1)


def test_free_time_integrator():
    problem = free_time_integrator.problem(time_weight=0.2)
    x, e, running = rates(problem, [0.4], [1.7], np.array([[0.9]]))
    np.testing.assert_allclose([x[0], e[0], running], [1.7, 0.4, 1.7**2 / 2], rtol=1e-14)
    assert terminal(problem, [1.0], np.array([[0.9]]), duration=1.5) == pytest.approx(0.9 + 0.3)
    x0, xf, e0, _ = boundary(problem)
    assert (x0[0], xf[0], e0[0]) == (0.0, 1.0, 0.0)
    assert problem.statement().duration.free


def test_chord_test():
    problem = chord_test.problem()
    x, e, running = rates(problem, [0.4], [1.7], np.array([[0.9]]))
    np.testing.assert_allclose([x[0], e[0], running], [1.7, 0.4, 1.7**2 / 2 + 1.7**4 / 4], rtol=1e-14)
    assert terminal(problem, [0.4], np.array([[0.9]])) == pytest.approx(0.9 - 1.2)
    x0, xf, e0, _ = boundary(problem)
    assert (x0[0], e0[0]) == (0.0, 0.0)
    assert np.isnan(xf).all()


def test_bryson_denham():
    problem = bryson_denham.problem(0.2)
    x, _, running = rates(problem, [0.4, -0.3], [1.7])
    np.testing.assert_allclose([*x, running], [-0.3, 1.7, 1.7**2 / 2])
    x0, xf, *_ = boundary(problem)
    np.testing.assert_array_equal([x0, xf], [[0.0, 1.0], [0.0, -1.0]])
    path = problem.statement().path
    value = path.function([0.4, -0.3], [1.7], [], 0.0, 1.0, problem.statement().values)
    assert float(value) == pytest.approx(0.2)
    assert (path.lower[0], path.upper[0]) == (-np.inf, 0.0)


def test_brachistochrone():
    problem = brachistochrone.problem()
    x, _, running = rates(problem, [1.0, 2.0, 3.0], [0.7])
    np.testing.assert_allclose(x, [3 * np.sin(0.7), 3 * np.cos(0.7), 9.80665 * np.cos(0.7)])
    assert running == 0.0
    assert terminal(problem, [1.0, 2.0, 3.0], duration=1.9) == 1.9
    x0, xf, *_ = boundary(problem)
    np.testing.assert_array_equal(x0, [0.0, 0.0, 0.0])
    np.testing.assert_array_equal(xf, [10.0, 5.0, np.nan])


def test_goddard_rocket():
    problem = goddard_rocket.problem()
    h, v, m, thrust = 1.005, 0.1, 0.8, 2.0
    x, _, running = rates(problem, [h, v, m], [thrust])
    drag = 0.5 * 620 * v**2 * np.exp(-500 * (h - 1))
    np.testing.assert_allclose(x, [v, (thrust - drag) / m - 1 / h**2, -2 * thrust], rtol=1e-14)
    assert running == 0.0
    assert terminal(problem, [h, v, m], duration=0.2) == -h
    x0, xf, *_ = boundary(problem)
    np.testing.assert_array_equal(x0, [1.0, 0.0, 1.0])
    np.testing.assert_array_equal(xf, [np.nan, np.nan, 0.6])
    low, high = problem.statement().control_bounds
    assert (low[0], high[0]) == (0.0, 3.5)


@pytest.mark.parametrize("masses", [0, -1, 1.5, True, "2"])
def test_a_chain_needs_masses(masses):
    with pytest.raises(co.ProblemError, match="masses"):
        mass_chain.problem(masses)


def test_a_naming_must_be_known():
    with pytest.raises(co.ProblemError, match="naming"):
        damped_oscillator.problem(naming="tabel")
