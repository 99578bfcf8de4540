"""Steps of nominal and covariance against scipy's integrators: order, positivity at any step, exact steady states."""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np
import problems
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_continuous_are

import covocp as co
from covocp.base.matrices import pack, unpack
from covocp.base.quadrature import hermite
from covocp.transcription.mesh import Mesh
from covocp.transcription.shooting import interval_columns
from covocp.transcription.steps import full_interval, nominal_interval

TIGHT = {"rtol": 1e-12, "atol": 1e-13, "method": "DOP853"}
STEPS = ("gauss", "strang", "rk4")


class System:
    """A smooth random time-varying Riccati equation."""

    def __init__(self, size, seed, measured=1.0):
        generator = np.random.default_rng(seed)
        self.size = size
        self.parts = generator.standard_normal((6, size, size)) / np.sqrt(size)
        self.parts[4:] *= measured

    def at(self, t, sin=np.sin):
        """F, Q, W at a time."""
        F0, F1, G0, G1, M0, M1 = self.parts
        F = F0 + sin(2 * t) * F1 - 0.5 * np.eye(self.size)
        G, M = G0 + sin(t) * G1, M0 + sin(3 * t) * M1
        return F, G @ G.T, M.T @ M

    def rate(self, t, e):
        F, Q, W = self.at(t)
        E = e.reshape(self.size, self.size)
        return (F @ E + E @ F.T + Q - E @ W @ E).ravel()

    def reference(self, E0, duration):
        return solve_ivp(self.rate, (0, duration), E0.ravel(), **TIGHT).y[:, -1].reshape(E0.shape)


def statement_of(system, E0, duration):
    ocp = co.Problem(duration=duration)
    x = ocp.state("x", initial=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    E = ocp.symmetric("E", len(E0), initial=E0, lower=0.0)
    F0, F1, G0, G1, M0, M1 = (ca.DM(part) for part in system.parts)
    t = ocp.time
    F = F0 + ca.sin(2 * t) * F1 - 0.5 * ca.DM.eye(system.size)
    G, M = G0 + ca.sin(t) * G1, M0 + ca.sin(3 * t) * M1
    ocp.dynamics(E, F @ E + E @ F.T + G @ G.T - E @ M.T @ M @ E)
    ocp.minimize(running=u**2, terminal=ca.trace(E))
    return ocp.statement()


def mesh_of(intervals, step, substeps=1):
    nodes = np.linspace(0, 1, intervals + 1)
    return Mesh(nodes=nodes, control="linear", substeps=substeps, segments=(intervals,), eliminated=True, step=step)


def run(statement, intervals, step, start, u=None, substeps=1, parameters=()):
    """x and half-vectors stacked at all nodes, and the running cost, by `intervals` discrete intervals."""
    mesh = mesh_of(intervals, step, substeps)
    controls = np.zeros((statement.nu, intervals + 1)) if u is None else u
    interval = full_interval(statement, substeps, step).mapaccum("run", intervals)
    columns = interval_columns(
        mesh, ca.DM(controls), statement.duration.guess, ca.DM(np.asarray(parameters, dtype=float))
    )
    ends, _, cost = interval(start, *columns)
    return np.column_stack([start, np.asarray(ends.full())]).T, float(np.sum(cost.full()))


def covariances(statement, intervals, step, E0, **options):
    nodes, _ = run(statement, intervals, step, np.concatenate([[0.0], pack(E0)]), **options)
    return unpack(nodes[:, 1:], len(E0))


@pytest.mark.parametrize("size", [2, 4, 8])
@pytest.mark.parametrize(("step", "order"), [("gauss", 4), ("rk4", 4), ("strang", 2)])
def test_order_of_the_covariance_steps(size, step, order):
    system, E0, duration = System(size, seed=size), np.eye(size), 2.0
    exact = system.reference(E0, duration)
    statement = statement_of(system, E0, duration)
    counts = [40, 80, 160, 320]
    errors = [np.abs(covariances(statement, n, step, E0)[-1] - exact).max() for n in counts]
    assert problems.order(counts, errors) == pytest.approx(order, abs=0.3)
    assert errors[-1] < {4: 2e-7, 2: 2e-4}[order] * np.abs(exact).max()


@pytest.mark.parametrize("size", [2, 4, 8])
@pytest.mark.parametrize("step", ["gauss", "strang"])
@pytest.mark.parametrize("measured", [1.0, 30.0, 1000.0])
def test_positive_semidefinite_at_any_step(size, step, measured):
    """h W E up to 1e6, from a covariance of rank one."""
    system = System(size, seed=20 + size, measured=measured)
    E0 = np.ones((size, size))
    statement = statement_of(system, E0, 2.0)
    for intervals in (1, 2, 5, 20, 100):
        for E in covariances(statement, intervals, step, E0):
            values = np.linalg.eigvalsh(E)
            assert values[0] >= -1e-9 * values[-1]
            assert np.isfinite(E).all()


def test_rk4_is_not_to_be_trusted_there():
    """The contrast that the choice of the default rests on."""
    system = System(4, seed=24, measured=30.0)
    E = covariances(statement_of(system, np.ones((4, 4)), 2.0), 20, "rk4", np.ones((4, 4)))
    with np.errstate(invalid="ignore"):
        assert not (np.isfinite(E).all() and np.linalg.eigvalsh(E).min() > -1e-9)


@pytest.mark.parametrize("step", STEPS)
def test_substeps_are_shorter_intervals(step):
    """With controls that are linear over both, m substeps of N intervals equal N m intervals."""
    system, E0 = System(3, seed=3), np.eye(3)
    statement = statement_of(system, E0, 2.0)
    coarse = covariances(statement, 10, step, E0, substeps=4)
    fine = covariances(statement, 40, step, E0)
    np.testing.assert_allclose(coarse, fine[::4], rtol=1e-11)


# --- constant systems -------------------------------------------------------------------------------------------------


class Constant(System):
    def __init__(self, F, G, M):
        super().__init__(len(F), 0)
        zero = np.zeros_like(F)
        self.parts = np.stack([F + 0.5 * np.eye(len(F)), zero, G, zero, M, zero])


@pytest.mark.parametrize("size", [1, 3, 6])
@pytest.mark.parametrize("h", [0.01, 1.0, 100.0])
def test_gauss_keeps_the_steady_state_exactly(size, h):
    generator = np.random.default_rng(size)
    F, G, M = (generator.standard_normal((size, size)) for _ in range(3))
    steady = solve_continuous_are(F.T, M.T, G @ G.T, np.eye(size))
    E = covariances(statement_of(Constant(F, G, M), steady, h), 1, "gauss", steady)
    np.testing.assert_allclose(E[-1], steady, rtol=1e-8, atol=1e-10 * np.abs(steady).max())


def test_gauss_reaches_the_steady_state_of_the_lag():
    """E_11 = sqrt(2) - 1 [5.2], for x = 0."""
    F, G, M = -np.eye(1), np.eye(1), np.eye(1)
    E = covariances(statement_of(Constant(F, G, M), np.eye(1), 40.0), 40, "gauss", np.eye(1))
    assert E[-1].item() == pytest.approx(np.sqrt(2) - 1, rel=1e-12)


def gauss_linear(F, h):
    """Transition matrix of the two-stage Gauss method: the (2, 2) Pade approximant."""
    A, I = h * F, np.eye(len(F))
    return np.linalg.solve(I - A / 2 + A @ A / 12, I + A / 2 + A @ A / 12)


def test_without_measurement_gauss_is_the_linear_step():
    generator = np.random.default_rng(4)
    F, G = generator.standard_normal((2, 3, 3))
    E0 = np.diag([1.0, 0.0, 2.0])
    E = covariances(statement_of(Constant(F, 0 * G, 0 * F), E0, 0.7), 1, "gauss", E0)[-1]
    transition = gauss_linear(F, 0.7)
    np.testing.assert_allclose(E, transition @ E0 @ transition.T, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize(("step", "order"), [("gauss", 4), ("strang", 2), ("rk4", 4)])
def test_without_measurement_against_the_matrix_exponential(step, order):
    """E(T) = Phi E0 Phi' + int Phi Q Phi' by Van Loan's block exponential."""
    generator = np.random.default_rng(5)
    F, G = generator.standard_normal((2, 3, 3))
    Q, E0, T = G @ G.T, np.eye(3), 1.5
    block = expm(T * np.block([[-F, Q], [np.zeros((3, 3)), F.T]]))
    transition = block[3:, 3:].T
    exact = transition @ E0 @ transition.T + transition @ block[:3, 3:]
    statement = statement_of(Constant(F, G, 0 * F), E0, T)
    counts = [10, 20, 40, 80]
    errors = [np.abs(covariances(statement, n, step, E0)[-1] - exact).max() for n in counts]
    assert problems.order(counts, errors) == pytest.approx(order, abs=0.3)


@pytest.mark.parametrize("step", STEPS)
def test_pure_diffusion_is_exact(step):
    G = np.array([[1.0, 0.0], [0.5, 0.2]])
    zero = np.zeros((2, 2))
    E = covariances(statement_of(Constant(zero, G, zero), np.eye(2), 3.0), 4, step, np.eye(2))
    np.testing.assert_allclose(E[-1], np.eye(2) + 3 * G @ G.T, rtol=1e-13)


@pytest.mark.parametrize("step", ["gauss", "strang"])
def test_pure_measurement_is_exact(step):
    """E^-1 grows linearly: for F = Q = 0 the update is exact, also for h W E = 1e6."""
    M = np.array([[1e3, 0.0], [0.0, 1.0]])
    zero = np.zeros((2, 2))
    E = covariances(statement_of(Constant(zero, zero, M), np.eye(2), 1.0), 1, step, np.eye(2))[-1]
    np.testing.assert_allclose(E, np.diag([1 / (1 + 1e6), 0.5]), rtol=1e-9, atol=1e-15)


# --- the first-order lag along u = sin t ------------------------------------------------------------------------------

LAG_START = np.diag([1.0, 5.0])


def lag_along_sine(noise):
    """The covariance of the lag, given its nominal under u = sin t in closed form."""
    ocp = co.Problem(duration=10.0)
    u = ocp.control("u")
    ocp.dynamics(ocp.state("unused", initial=0.0), u)
    t = ocp.time
    x = (ca.sin(t) - ca.cos(t) + ca.exp(-t)) / 2
    E = ocp.symmetric("E", 2, initial=LAG_START, lower=0.0)
    F, W = ca.blockcat([[-1, -x], [0, 0]]), ca.diag(ca.DM([1 / noise, 0]))
    ocp.dynamics(E, F @ E + E @ F.T + ca.diag(ca.DM([1, 0])) - E @ W @ E)
    ocp.minimize(running=u**2)
    return ocp.statement()


def lag_reference(noise, duration=10.0):
    """E22(T) by integrating the three equations of the covariance with the nominal."""

    def rate(t, z):
        x, E11, E12, E22 = z
        return [
            -x + np.sin(t),
            -2 * E11 - E11**2 / noise + 1 - 2 * x * E12,
            -E12 - x * E22 - E11 * E12 / noise,
            -(E12**2) / noise,
        ]

    options = {"rtol": 1e-12, "atol": 1e-14 * min(1.0, np.sqrt(noise)), "method": "DOP853"}
    return solve_ivp(rate, (0, duration), [0.0, 1.0, 0.0, 5.0], **options).y[3, -1]


@pytest.mark.parametrize(
    ("noise", "gauss", "strang"), [(1.0, 6.1e-8, 1.5e-3), (1e-3, 9.8e-9, 4.4e-3), (1e-6, 1.4e-9, 4.5e-3)]
)
def test_error_along_a_sine(noise, gauss, strang):
    statement, exact = lag_along_sine(noise), lag_reference(noise)
    for step, published in (("gauss", gauss), ("strang", strang)):
        error = covariances(statement, 100, step, LAG_START)[-1, 1, 1] / exact - 1
        assert abs(error) == pytest.approx(published, rel=0.05)


def test_error_of_rk4_along_a_sine():
    def error(noise, steps):
        return abs(covariances(lag_along_sine(noise), steps, "rk4", LAG_START)[-1, 1, 1] / lag_reference(noise) - 1)

    assert error(1.0, 100) == pytest.approx(2.8e-6, rel=0.05)
    assert not error(1e-3, 100) < 1.0  # overflows
    assert error(1e-3, 6400) == pytest.approx(8.9e-10, rel=0.2)


# --- the nominal ------------------------------------------------------------------------------------------------------


def pendulum():
    ocp = co.Problem(duration=3.0)
    x = ocp.state("x", 2, initial=[1.0, 0.0])
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], -ca.sin(x[0]) + u * ca.cos(ocp.time)))
    ocp.minimize(running=x[0] ** 2 + u**2, terminal=x[1])
    return ocp.statement()


def test_order_of_the_nominal_and_its_cost():
    """Runge-Kutta of order 4, controls linear in between, running cost included."""
    statement = pendulum()

    def rate(t, z):
        u = 0.5 - t / 3
        return [z[1], -np.sin(z[0]) + u * np.cos(t), z[0] ** 2 + u**2]

    exact = solve_ivp(rate, (0, 3), [1.0, 0.0, 0.0], **TIGHT).y[:, -1]
    counts, errors = [10, 20, 40, 80], []
    for n in counts:
        interval = nominal_interval(statement, 1, "rk4").mapaccum("run", n)
        columns = interval_columns(mesh_of(n, "rk4"), ca.DM(np.linspace(0.5, -0.5, n + 1)).T, 3.0, ca.DM(0, 1))
        ends, _, cost = interval([1.0, 0.0], *columns)
        found = np.append(np.asarray(ends.full())[:, -1], np.sum(cost.full()))
        errors.append(np.abs(found - exact).max())
    assert problems.order(counts, errors) == pytest.approx(4, abs=0.3)
    assert errors[-1] < 1e-7


@pytest.mark.parametrize(("step", "order"), [("gauss", 4), ("strang", 2), ("rk4", 4)])
def test_order_of_a_running_cost_on_the_covariance(step, order):
    """Simpson's rule over pairs of substeps keeps the order of the step."""
    ocp = co.Problem(duration=2.0)
    x = ocp.state("x", initial=0.0, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=0.5)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2 + E[x, x] * ca.cos(ocp.time))
    statement = ocp.statement()

    def rate(t, z):
        x, E11, E12, E22, _ = z
        u = 1 - t
        return [
            -x + u,
            -2 * E11 - 2 * E11**2 + 1 - 2 * x * E12,
            -E12 - x * E22 - 2 * E11 * E12,
            -2 * E12**2,
            u**2 + E11 * np.cos(t),
        ]

    exact = solve_ivp(rate, (0, 2), [0.0, 1.0, 0.0, 5.0, 0.0], **TIGHT).y[4, -1]
    counts = [20, 40, 80, 160]
    errors = []
    for n in counts:
        u = np.linspace(1.0, -1.0, n + 1)[None, :]
        errors.append(abs(run(statement, n, step, [0.0, 1.0, 0.0, 5.0], u=u, substeps=2, parameters=[1.0])[1] - exact))
    assert problems.order(counts, errors) == pytest.approx(order, abs=0.35)


def test_hermite_is_exact_for_cubics():
    cubic = np.polynomial.Polynomial([1.0, -2.0, 3.0, 0.5])
    for a, b in pairwise([0.0, 0.4, 1.5]):
        for c in (0.0, 0.3, 1.0):
            value = hermite(cubic(a), cubic(b), (b - a) * cubic.deriv()(a), (b - a) * cubic.deriv()(b), c)
            assert value == pytest.approx(cubic(a + c * (b - a)), abs=1e-13)
