"""Riccati and Lyapunov equations, regulators, duality, LQG: closed forms, residuals, and the tables of the notes."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from compiled import compile_function
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import (
    AVERAGE_COST,
    FIXED,
    GAMMA,
    L_INF,
    M_INF,
    NOISE,
    P_INF,
    PHI,
    PRINTED,
    Q_1,
    Q_2,
    R_V,
    S_INF,
    SEEDS,
    H,
    K,
    T,
    by_doubling,
    definite,
)
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

from covocp import ProblemError
from covocp.blocks import kalman, riccati


def random_regulator(seed, size, count, *, discrete=False, cross=True):
    """A, B, Q, R, N; generic, hence controllable and observable."""
    generator = np.random.default_rng(seed)
    joint = definite(generator, size + count)
    A = generator.standard_normal((size, size)) * (0.7 if discrete else 1.0)
    N = joint[:size, size:] if cross else np.zeros((size, count))
    return A, generator.standard_normal((size, count)), joint[:size, :size], joint[size:, size:], N


# the equations


@FIXED
@given(seed=SEEDS, size=st.integers(1, 5), count=st.integers(1, 3), discrete=st.booleans())
def test_solution_has_no_residual_and_stabilises(seed, size, count, discrete):
    A, B, Q, R, N = random_regulator(seed, size, count, discrete=discrete)
    S = (riccati.discrete if discrete else riccati.continuous)(A, B, Q, R, cross=N)
    if discrete:
        gain = np.linalg.inv(R + B.T @ S @ B) @ (B.T @ S @ A + N.T)
        residual = A.T @ S @ A - S + Q - (A.T @ S @ B + N) @ gain
        assert np.abs(np.linalg.eigvals(A - B @ gain)).max() < 1
    else:
        gain = np.linalg.inv(R) @ (B.T @ S + N.T)
        residual = A.T @ S + S @ A + Q - (S @ B + N) @ gain
        assert np.linalg.eigvals(A - B @ gain).real.max() < 0
    scale = np.abs(S).max() * max(1.0, np.abs(A).max() ** 2) + np.abs((S @ B + N) @ gain).max()
    assert np.abs(residual).max() <= 1e-11 * scale
    np.testing.assert_array_equal(S, S.T)
    assert np.linalg.eigvalsh(S)[0] > 0


# plants whose unstable modes the input hardly reaches: scipy's start is off by up to a tenth where R is far from Q
HARD = [
    ([[-1.7, 0.5, -0.1], [-0.2, 0.6, 1.3], [0.4, 0.4, -2.3]], [[0.6], [-0.3], [1.0]]),
    ([[-2.8, -2.4, -2.6], [-1.2, 2.9, -3.2], [1.9, 2.5, -0.7]], [[-0.7], [0.5], [1.2]]),
]


@pytest.mark.parametrize(("A", "B"), HARD)
@pytest.mark.parametrize("ratio", [1e-8, 1e-4, 1e4, 1e6, 1e8])
def test_sizes_of_the_weights_far_apart(A, B, ratio):
    A, B = np.array(A), np.array(B)
    S = riccati.discrete(A, B, np.eye(3), ratio)
    truth = by_doubling(A, B, np.eye(3), np.array([[ratio]]))
    closed = A - B @ np.linalg.solve(ratio + B.T @ truth @ B, B.T @ truth @ A)
    # what rounding of A'S A leaves in S, by the inverse of the equation's derivative, a Lyapunov equation's operator
    condition = np.linalg.norm(np.linalg.inv(np.eye(9) - np.kron(closed.T, closed.T)), 2)
    error = np.finfo(float).eps * condition * np.linalg.norm(A, 2) ** 2 * S.max()
    np.testing.assert_allclose(S, truth, rtol=0, atol=error)
    np.testing.assert_allclose(riccati.discrete(A, B, np.eye(3) / ratio, 1.0) * ratio, truth, rtol=0, atol=error)
    np.testing.assert_allclose(kalman.steady_state(A.T, B.T, np.eye(3), ratio).prior, truth, rtol=0, atol=error)


@pytest.mark.parametrize(("A", "B"), HARD)
@pytest.mark.parametrize("discrete", [False, True])
def test_a_dear_input_reflects_the_unstable_modes(A, B, discrete):
    A, B = np.array(A), np.array(B)
    closed = riccati.lqr(A, B, np.eye(3), 1e8, discrete=discrete).eigenvalues
    modes = np.linalg.eigvals(A).astype(complex)
    if discrete:
        wanted = np.where(np.abs(modes) > 1, 1 / modes.conj(), modes)
    else:
        wanted = np.where(modes.real > 0, -modes.conj(), modes)
    apart = np.abs(closed[:, None] - wanted[None, :])
    assert max(apart.min(axis=0).max(), apart.min(axis=1).max()) < 1e-5


@pytest.mark.parametrize("a", [-2.0, 0.0, 0.5, 3.0])
def test_scalar_equations(a):
    """S = r (a + root(a^2 + b^2 q/r)) / b^2; discrete: the positive root of b^2 s^2 + ((1 - a^2) r - b^2 q) s - q r."""
    b, q, r = 0.7, 2.0, 0.3
    assert riccati.continuous(a, b, q, r) == pytest.approx(r * (a + np.sqrt(a**2 + b**2 * q / r)) / b**2, rel=1e-13)
    linear = (1 - a**2) * r - b**2 * q
    assert riccati.discrete(a, b, q, r) == pytest.approx(
        (-linear + np.sqrt(linear**2 + 4 * b**2 * q * r)) / (2 * b**2), rel=1e-13
    )


def test_double_integrator_in_closed_form():
    """Q = diag(1, 0), R = 1: S = [root 2, 1; 1, root 2]."""
    regulator = riccati.lqr([[0, 1], [0, 0]], [0, 1], np.diag([1, 0]), 1)
    np.testing.assert_allclose(regulator.cost, [[np.sqrt(2), 1], [1, np.sqrt(2)]], rtol=1e-13)
    np.testing.assert_allclose(regulator.gain, [[1, np.sqrt(2)]], rtol=1e-13)
    np.testing.assert_allclose(regulator.eigenvalues, np.array([-1 - 1j, -1 + 1j]) / np.sqrt(2), rtol=1e-12)


def test_solution_of_an_unstable_system_without_state_weight():
    """The equation has a stabilising solution, 2 a r / b^2; as a regulator it is refused: the cost sees nothing."""
    assert riccati.continuous(3.0, 2.0, 0.0, 0.5) == pytest.approx(2 * 3.0 * 0.5 / 4.0)
    with pytest.raises(ProblemError, match=r"mode 3, which Q gives no weight"):
        riccati.lqr(3.0, 2.0, 0.0, 0.5)


@FIXED
@given(seed=SEEDS, size=st.integers(1, 5))
def test_lyapunov_by_quadrature_and_by_series(seed, size):
    generator = np.random.default_rng(seed)
    A = generator.standard_normal((size, size))
    A -= (np.linalg.eigvals(A).real.max() + 1.0) * np.eye(size)
    Q = definite(generator, size)
    X = riccati.lyapunov(A, Q)
    integral, _ = quad_vec(lambda s: expm(A * s) @ Q @ expm(A.T * s), 0.0, 30.0, epsrel=1e-9)
    np.testing.assert_allclose(X, integral, rtol=1e-6, atol=1e-6 * np.abs(integral).max())
    Phi = A / (1.3 * np.linalg.norm(A, 2))
    series, power = np.zeros((size, size)), np.eye(size)
    for _ in range(140):
        series, power = series + power @ Q @ power.T, Phi @ power
    np.testing.assert_allclose(riccati.lyapunov(Phi, Q, discrete=True), series, rtol=1e-9)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("discrete", [False, True])
def test_symbolic_lyapunov(kind, discrete):
    A, Q = kind.sym("A", 3, 3), kind.sym("Q", 3, 3)
    function = ca.Function("lyapunov", [A, Q], [riccati.lyapunov(A, Q, discrete=discrete)]).expand()
    generator = np.random.default_rng(1)
    matrix, right = 0.4 * generator.standard_normal((3, 3)) - np.eye(3), definite(generator, 3)
    matrix = 0.3 * matrix if discrete else matrix
    X = function(matrix, right).full()
    residual = matrix @ X @ matrix.T - X + right if discrete else matrix @ X + X @ matrix.T + right
    np.testing.assert_allclose(residual, 0.0, atol=1e-12 * np.abs(right).max())


def test_lyapunov_without_unique_solution():
    with pytest.raises(ProblemError, match=r"add up to zero(?s:.)*-1 and 1"):
        riccati.lyapunov(np.diag([-1.0, 1.0]), np.eye(2))
    with pytest.raises(ProblemError, match=r"product one(?s:.)*0.5 and 2"):
        riccati.lyapunov(np.diag([0.5, 2.0]), np.eye(2), discrete=True)


def test_rates_lead_back_to_the_algebraic_solution():
    """The cost to go, integrated backward for a long time, is the solution of the algebraic equation."""
    A, B, Q, R, N = random_regulator(3, 3, 2)

    def backward(_, s):
        return -riccati.rate(s.reshape(3, 3), A, B, Q, R, cross=N).ravel()

    end = solve_ivp(backward, (0.0, 30.0), np.zeros(9), rtol=1e-10, atol=1e-12, method="LSODA").y[:, -1].reshape(3, 3)
    np.testing.assert_allclose(end, riccati.continuous(A, B, Q, R, cross=N), rtol=1e-7)


@FIXED
@given(seed=SEEDS, size=st.integers(1, 4), count=st.integers(1, 3))
def test_rate_as_printed(seed, size, count):
    A, B, Q, R, N = random_regulator(seed, size, count)
    generator = np.random.default_rng(seed)
    S, gain = definite(generator, size), generator.standard_normal((count, size))
    best = -(A.T @ S + S @ A + Q - (S @ B + N) @ np.linalg.inv(R) @ (S @ B + N).T)
    np.testing.assert_allclose(riccati.rate(S, A, B, Q, R, cross=N), best, rtol=1e-9, atol=1e-9 * np.abs(best).max())
    closed = A - B @ gain
    other = -(closed.T @ S + S @ closed + Q + gain.T @ R @ gain - N @ gain - gain.T @ N.T)
    np.testing.assert_allclose(
        riccati.rate(S, A, B, Q, R, gain=gain, cross=N), other, rtol=1e-9, atol=1e-9 * np.abs(other).max()
    )


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_laws_of_regulators_expand(kind):
    A, B, Q, R, N = random_regulator(5, 3, 2)
    S = kind.sym("S", 3, 3)
    value = definite(np.random.default_rng(0), 3)
    rate = ca.Function("rate", [S], [riccati.rate(S, A, B, Q, R, cross=N)]).expand()
    np.testing.assert_allclose(rate(value), riccati.rate(value, A, B, Q, R, cross=N), rtol=1e-11)
    recursion = ca.Function("recursion", [S], list(riccati.recursion(S, A, B, Q, R))).expand()
    for one, two in zip(recursion(value), riccati.recursion(value, A, B, Q, R), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-11)


@pytest.mark.needs_cc
def test_recursion_as_c_code(tmp_path):
    S = ca.MX.sym("S", 2, 2)
    code = compile_function(ca.Function("recursion", [S], list(riccati.recursion(S, PHI, GAMMA, Q_1, Q_2))), tmp_path)
    before, gain = code(np.array(S_INF))
    np.testing.assert_allclose(before, S_INF, rtol=0, atol=3e-8)
    np.testing.assert_allclose(gain, K, rtol=0, atol=3e-8)


# regulators, filters and both


def test_regulator_of_the_table():
    regulator = riccati.lqr(PHI, GAMMA, Q_1, Q_2, discrete=True)
    np.testing.assert_allclose(regulator.cost, S_INF, **PRINTED)
    np.testing.assert_allclose(regulator.gain, K, **PRINTED)
    np.testing.assert_allclose(riccati.discrete(PHI, GAMMA, Q_1, Q_2), S_INF, **PRINTED)
    assert not regulator.gain.flags.writeable


def test_filter_of_the_table():
    steady = kalman.steady_state(PHI, H, NOISE, R_V)
    for value, printed in ((steady.prior, M_INF), (steady.posterior, P_INF), (steady.gain, L_INF)):
        np.testing.assert_allclose(value, printed, **PRINTED)
    # the second form of the gain, and the control solver called with the dual matrices
    np.testing.assert_allclose(steady.posterior @ H.T @ np.linalg.inv(R_V), L_INF, **PRINTED)
    np.testing.assert_allclose(riccati.discrete(PHI.T, H.T, NOISE, R_V), M_INF, **PRINTED)


def test_filter_is_what_the_recursion_converges_to():
    x, P = np.zeros(2), 100.0 * np.eye(2)
    for _ in range(200):
        x, M = kalman.predict(x, P, PHI, NOISE)
        x, P = kalman.update(x, M, 0.0, H, R_V)
    steady = kalman.steady_state(PHI, H, NOISE, R_V)
    np.testing.assert_allclose(M, steady.prior, rtol=1e-12)
    np.testing.assert_allclose(P, steady.posterior, rtol=1e-12)


def test_regulator_is_what_the_recursion_converges_to():
    S = np.zeros((2, 2))
    for _ in range(200):
        S, gain = riccati.recursion(S, PHI, GAMMA, Q_1, Q_2)
    np.testing.assert_allclose(S, S_INF, **PRINTED)
    np.testing.assert_allclose(gain, K, **PRINTED)


def test_continuous_filter():
    """dx = -x + n, m = x + v: e = root(1 + q/u) u - u."""
    steady = kalman.steady_state(-1.0, 1.0, 3.0, 0.5, discrete=False)
    assert steady.prior[0, 0] == pytest.approx(0.5 * (np.sqrt(7.0) - 1.0))
    assert steady.gain[0, 0] == pytest.approx(np.sqrt(7.0) - 1.0)
    assert steady.eigenvalues[0] == pytest.approx(-np.sqrt(7.0))
    np.testing.assert_array_equal(steady.prior, steady.posterior)
    A, M, Q, U, _ = random_regulator(9, 3, 2, cross=False)
    E = kalman.steady_state(A, M.T, Q, U, discrete=False).prior
    np.testing.assert_allclose(kalman.rate(E, A, M.T, Q, U), 0.0, atol=1e-10 * np.abs(E).max() ** 2)


def closed_loop(design):
    """Transition of (x, estimate) and covariance of what drives it, one step of u = -K estimate, from the models."""
    L, gain = design.filter.gain, design.regulator.gain
    # estimate+ = (I - L H)(Phi - Gamma K) estimate + L H x+ + L v,  x+ = Phi x - Gamma K estimate + w
    keep = np.eye(2) - L @ H
    top = np.hstack([PHI, -GAMMA @ gain])
    bottom = np.hstack([L @ H @ PHI, keep @ (PHI - GAMMA @ gain) - L @ H @ GAMMA @ gain])
    noise_in, reading_in = np.vstack([np.eye(2), L @ H]), np.vstack([np.zeros((2, 1)), L])
    return np.vstack([top, bottom]), noise_in @ NOISE @ noise_in.T + reading_in @ R_V @ reading_in.T


def test_average_cost_and_spectrum_of_the_loop():
    """The table, and the joint covariance of state and estimate, which knows neither S nor P."""
    design = riccati.lqg(PHI, GAMMA, H, NOISE, R_V, Q_1, Q_2)
    assert design.average_cost == pytest.approx(AVERAGE_COST, abs=1e-8)
    A, W = closed_loop(design)
    X = np.zeros((4, 4))
    for _ in range(300):
        X = A @ X @ A.T + W
    gain = design.regulator.gain
    cost = np.trace(Q_1 @ X[:2, :2]) + np.trace(gain.T @ Q_2 @ gain @ X[2:, 2:])
    assert cost == pytest.approx(AVERAGE_COST, abs=1e-8)
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(A)), design.eigenvalues, atol=1e-12)
    np.testing.assert_allclose(X[:2, :2] - X[2:, 2:], design.filter.posterior, rtol=1e-10)


def test_lqg_by_simulation():
    """200 loops of 2000 steps: within three standard errors, estimated from the loops themselves."""
    design = riccati.lqg(PHI, GAMMA, H, NOISE, R_V, Q_1, Q_2)
    generator = np.random.default_rng(5)
    runs, steps = 200, 2000
    x, estimate, costs = np.zeros((runs, 2)), np.zeros((runs, 2)), np.zeros(runs)
    for k in range(steps + 50):
        u = -estimate @ design.regulator.gain.T
        if k >= 50:
            costs += np.einsum("ki,ij,kj->k", x, Q_1, x) + Q_2[0, 0] * u[:, 0] ** 2
        w = np.sqrt(0.2) * generator.standard_normal((runs, 1))
        x = x @ PHI.T + (u + w) @ GAMMA.T
        y = x @ H.T + np.sqrt(R_V[0, 0]) * generator.standard_normal((runs, 1))
        predicted = estimate @ PHI.T + u @ GAMMA.T
        estimate = predicted + (y - predicted @ H.T) @ design.filter.gain.T
    mean = costs / steps
    assert abs(mean.mean() - design.average_cost) < 3 * mean.std() / np.sqrt(runs)


@FIXED
@given(seed=SEEDS, size=st.integers(1, 4), count=st.integers(1, 3), discrete=st.booleans())
def test_regulator_is_optimal_among_gains(seed, size, count, discrete):
    """The cost of any other stabilising gain, from its Lyapunov equation, is larger by a positive matrix."""
    A, B, Q, R, N = random_regulator(seed, size, count, discrete=discrete)
    regulator = riccati.lqr(A, B, Q, R, cross=N, discrete=discrete)
    gain = regulator.gain + 0.01 * np.random.default_rng(seed).standard_normal(regulator.gain.shape)
    for other, sign in ((regulator.gain, 0), (gain, 1)):
        closed = A - B @ other
        values = np.linalg.eigvals(closed)
        if (np.abs(values).max() >= 1) if discrete else (values.real.max() >= 0):
            return
        stage = Q + other.T @ R @ other - N @ other - other.T @ N.T
        cost = riccati.lyapunov(closed.T, 0.5 * (stage + stage.T), discrete=discrete)
        scale = 1e-9 * np.abs(regulator.cost).max()
        if sign:
            assert np.linalg.eigvalsh(cost - regulator.cost)[0] >= -scale
        else:
            np.testing.assert_allclose(cost, regulator.cost, rtol=0, atol=scale)


# duality


def test_dual_follows_the_table():
    control = riccati.Control(transition=PHI, input=GAMMA, state_weight=Q_1, control_weight=Q_2, cross=[0.1, 0.2])
    estimation = riccati.dual(control)
    for value, expected in (
        (estimation.transition, PHI.T),
        (estimation.measurement, GAMMA.T),
        (estimation.noise, Q_1),
        (estimation.measurement_noise, Q_2),
        (estimation.cross, [[0.1], [0.2]]),
    ):
        np.testing.assert_array_equal(np.asarray(value), expected)
    back = riccati.dual(estimation)
    assert isinstance(back, riccati.Control)
    np.testing.assert_array_equal(np.asarray(back.input), GAMMA)
    assert (
        riccati.dual(riccati.Estimation(transition=PHI, measurement=[1, 0], noise=NOISE, measurement_noise=R_V)).cross
        is None
    )


def test_rows_of_the_duality_table():
    """S -> M, M -> P, K -> (Phi L)', each from its own recursion; the dual of LQR is the predictor."""
    steady = kalman.steady_state(PHI, H, NOISE, R_V)
    dual = riccati.dual(riccati.Estimation(transition=PHI, measurement=H, noise=NOISE, measurement_noise=R_V))
    regulator = riccati.lqr(dual.transition, dual.input, dual.state_weight, dual.control_weight, discrete=True)
    np.testing.assert_allclose(regulator.cost, steady.prior, rtol=1e-12)
    np.testing.assert_allclose(regulator.gain, (PHI @ steady.gain).T, rtol=1e-12)
    S, B, R = (np.asarray(v) for v in (regulator.cost, dual.input, dual.control_weight))
    after = S - S @ B @ np.linalg.inv(R + B.T @ S @ B) @ B.T @ S  # item 5
    np.testing.assert_allclose(after, steady.posterior, rtol=1e-12)
    np.testing.assert_allclose(np.sort(regulator.eigenvalues), np.sort(steady.eigenvalues), rtol=1e-10)


@FIXED
@given(seed=SEEDS, size=st.integers(1, 4), count=st.integers(1, 3))
def test_backward_regulator_is_a_forward_filter(seed, size, count):
    """A finite horizon: costs to go of the dual problem are the covariances, step by step."""
    A, B, Q, R, _ = random_regulator(seed, size, count, discrete=True, cross=False)
    problem = riccati.dual(riccati.Control(transition=A, input=B, state_weight=Q, control_weight=R))
    S = M = definite(np.random.default_rng(seed), size)
    for _ in range(4):
        S, gain = riccati.recursion(S, A, B, Q, R)
        zero = np.zeros(size)
        P = kalman.update(zero, M, np.zeros(count), problem.measurement, problem.measurement_noise)[1]
        L = P @ np.asarray(problem.measurement).T @ np.linalg.inv(R)
        np.testing.assert_allclose(gain, (np.asarray(problem.transition) @ L).T, rtol=1e-7, atol=1e-9)
        M = kalman.predict(zero, P, problem.transition, problem.noise)[1]
        np.testing.assert_allclose(S, M, rtol=1e-9, atol=1e-9)


def test_duals_of_expressions():
    x = ca.SX.sym("x")
    dual = riccati.dual(riccati.Control(transition=x, input=ca.horzcat(x, 1), state_weight=1, control_weight=np.eye(2)))
    assert dual.measurement.shape == (2, 1)


# references and integrals


def test_reference_input():
    regulator = riccati.lqr(PHI, GAMMA, Q_1, Q_2, discrete=True)
    reference = riccati.reference_input(PHI, GAMMA, [1.0, 0.0], discrete=True)
    np.testing.assert_allclose(reference.state, [[1.0], [0.0]], atol=1e-14)
    feedforward = reference.law(regulator.gain)
    x = np.zeros(2)
    for _ in range(100):
        u = -regulator.gain @ x + feedforward @ [3.0]
        x = PHI @ x + GAMMA @ u
    np.testing.assert_allclose(x, [3.0, 0.0], atol=1e-12)
    plant = riccati.reference_input(-2.0, 4.0, 1.0)
    assert (plant.state[0, 0], plant.control[0, 0]) == pytest.approx((1.0, 0.5))
    with pytest.raises(ProblemError, match="no steady state"):  # the speed of a stable position
        riccati.reference_input([[0.0, 1.0], [-1.0, -1.0]], [0.0, 1.0], [0.0, 1.0])


STEADY_CASES = [
    *(([[-a]], [2 * a], [1.0], 0.5) for a in (1e-6, 1e-12, 1e-17)),
    *(([[0, 1.0], [-w * w, -w]], [0, w * w], [1.0, 0], 1.0) for w in (1e2, 1e6)),
    *(
        ([[-a, a, 0], [0, 0, 1], [0, -w * w, -1.4 * w]], [0, 0, w * w], [1.0, 0, 0], 1.0)
        for a, w in ((1e-4, 1e4), (1e-6, 1e6))
    ),
    *(([[-2.0]], [3.0], [s], 2 / 3 / s) for s in (1e9, 1e-9, 1e-17)),
]


@pytest.mark.parametrize(("A", "B", "output", "control"), STEADY_CASES)
def test_steady_states_in_any_units(A, B, output, control):
    reference = riccati.reference_input(A, B, output)
    np.testing.assert_allclose(reference.control, [[control]], rtol=1e-12)


@pytest.mark.parametrize("unit", [1.0, 1e-6, 6.68e-12, 1e12])
def test_a_steady_speed_is_none_in_any_units(unit):
    """A position in astronomical units, its speed in m/s."""
    with pytest.raises(ProblemError, match="no steady state"):
        riccati.reference_input([[0.0, unit], [0.0, 0.0]], [0.0, 1.0], [0.0, 1.0])


def test_two_controls_share_a_steady_state_by_their_norm():
    reference = riccati.reference_input([[-1.0]], [[3.0, 4.0]], [1.0])
    np.testing.assert_allclose(reference.control, [[0.12], [0.16]], rtol=1e-13)


def test_gains_of_another_shape_have_no_feedforward():
    reference = riccati.reference_input([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0])
    np.testing.assert_allclose(reference.law([3.0, 2.0]), [[3.0]])
    for gain in (np.ones((2, 2)), [1.0]):
        with pytest.raises(ProblemError, match="'gain'"):
            reference.law(gain)


@pytest.mark.parametrize("step", [None, T])
def test_integral_states_remove_a_constant_disturbance(step):
    A, B = (PHI, GAMMA) if step else (np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]))
    model = riccati.integral_states(A, B, H, step=step)
    regulator = riccati.lqr(model.A, model.B, np.diag([1.0, 0.1, 0.3]), 0.4, discrete=step is not None)
    closed = model.A - model.B @ regulator.gain
    push = np.vstack([B, [[0.0]]]) * 0.7 + model.reference * 2.0  # disturbance 0.7 at the input, reference 2
    rest = np.linalg.solve(np.eye(3) - closed if step else -closed, push).ravel()
    np.testing.assert_allclose(rest[:2], [2.0, 0.0], atol=1e-12)
    symbolic = riccati.integral_states(ca.SX(A), ca.SX.sym("B", 2), H, step=step)
    assert symbolic.A.shape == (3, 3)


# what cannot be solved


BAD_PAIRS = [
    (
        lambda: riccati.lqr(np.diag([-1.0, 2.0]), [1.0, 0.0], np.eye(2), 1.0),
        r"\(A, B\) is not stabilisable(?s:.)*mode 2, ",
    ),
    (lambda: riccati.lqr(np.diag([1.0, 0.0]), [1, 1], np.diag([1.0, 0.0]), 1), r"not detectable(?s:.)*mode 0, which Q"),
    (lambda: riccati.continuous(np.diag([1.0, 0.0]), [1, 1], np.diag([1.0, 0.0]), 1), r"not detectable(?s:.)*mode 0, "),
    (lambda: riccati.lqr(np.diag([0.5, 1.0]), [1, 0], np.eye(2), 1, discrete=True), r"not stabilisable(?s:.)*mode 1, "),
    (
        lambda: kalman.steady_state(np.diag([0.5, 1.5]), [1, 0], np.eye(2), 1),
        r"\(transition, H\) is not detectable(?s:.)*1.5",
    ),
    (
        lambda: kalman.steady_state(np.eye(1), [1.0], 0.0, 1.0),
        r"noise\^1/2\) is not stabilisable(?s:.)*mode 1, which the n",
    ),
    (lambda: kalman.steady_state(PHI, H, NOISE, 0.0), "'R'(?s:.)*definite"),
    (lambda: kalman.steady_state(PHI, H, -NOISE, R_V), "'noise'(?s:.)*semidefinite"),
    (lambda: riccati.lqr(PHI, GAMMA, Q_1, 0.0), "'R'(?s:.)*definite"),
    (lambda: riccati.lqr(PHI, GAMMA, -Q_1, Q_2), "'Q'(?s:.)*semidefinite"),
    (lambda: riccati.lqr(PHI, GAMMA, [[1.0, 0.2], [0.0, 1.0]], Q_2), "'Q'(?s:.)*asymmetry"),
    (lambda: riccati.lqr(PHI, GAMMA, Q_1, Q_2, cross=[1.0, 0.0]), r"cross', R\]"),
    (lambda: riccati.lqr(PHI, np.ones((3, 1)), Q_1, Q_2), "'B'(?s:.)*3 x 1"),
    (lambda: riccati.lqr(ca.SX.sym("A"), 1, 1, 1), "'A'(?s:.)*numbers"),
    (lambda: riccati.rate(np.eye(2), PHI, GAMMA, Q_1, 0.0), "'R'(?s:.)*definite"),
    (lambda: riccati.rate(np.eye(3), PHI, GAMMA, Q_1, 1.0), "'S'(?s:.)*2 x 2(?s:.)*3 x 3"),
    (lambda: riccati.rate(np.ones((2, 3)), PHI, GAMMA, Q_1, 1.0), "'S'(?s:.)*2 x 3"),
    (lambda: riccati.rate(np.eye(2), PHI, GAMMA, Q_1, 1.0, cross=[1.0, 2.0]), r"cross', R\]'"),
    (lambda: riccati.lqg(PHI, GAMMA, H, NOISE, R_V, Q_1, 0.0), "'control_weight'(?s:.)*definite"),
    (lambda: riccati.lqg(PHI, GAMMA, H, NOISE, R_V, -Q_1, Q_2), "'state_weight'(?s:.)*semidefinite"),
    (lambda: riccati.lqg(np.ones((2, 3)), GAMMA, H, NOISE, R_V, Q_1, Q_2), "'transition'(?s:.)*square"),
    (lambda: riccati.lqg(PHI, GAMMA, H, NOISE, 0.0, Q_1, Q_2), "'R'(?s:.)*definite"),
    (lambda: riccati.lqg(PHI, GAMMA, H.T, NOISE, R_V, Q_1, Q_2), "'H'(?s:.)*2 x 1"),
    (
        lambda: riccati.lqg(np.diag([0.5, 1.5]), [1, 0], [1, 1], np.eye(2), 1, np.eye(2), 1),
        r"\(transition, B\) is not stabilisable(?s:.)*1.5",
    ),
    (lambda: kalman.steady_state(PHI, H.T, NOISE, R_V), "'H'(?s:.)*2 x 1"),
    (lambda: kalman.steady_state(PHI, "H", NOISE, R_V), "'H'(?s:.)*numbers"),
    (lambda: kalman.steady_state(PHI, H, NOISE, "R"), "'R'(?s:.)*numbers"),
    (lambda: kalman.steady_state(PHI, ca.SX.sym("H", 1, 2), NOISE, R_V), "'H'(?s:.)*numbers"),
]


@pytest.mark.parametrize(("call", "message"), BAD_PAIRS)
def test_bad_input_names_what_is_wrong(call, message):
    with pytest.raises(ProblemError, match=message):
        call()


@pytest.mark.parametrize("discrete", [False, True])
def test_regulators_without_inputs_or_states(discrete):
    A = np.diag([-0.5, -0.25])
    regulator = riccati.lqr(A, np.zeros((2, 0)), np.eye(2), np.zeros((0, 0)), discrete=discrete)
    np.testing.assert_allclose(regulator.cost, riccati.lyapunov(A, np.eye(2), discrete=discrete), rtol=1e-12)
    assert regulator.gain.shape == (0, 2)
    empty = riccati.lqr(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((0, 0)), 1.0, discrete=discrete)
    assert empty.gain.shape == (1, 0)
