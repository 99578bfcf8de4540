"""Steps that stay rotations and gradients of functions of a rotation: orders, exact flights, reference values, C."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from compiled import compile_function
from hypothesis import given
from linear_systems import FIXED, SEEDS
from rotations import ANGLES, ANY_ANGLE, AXIS, IDENTITY, KINDS, ROUNDING, hat, turn
from scipy.linalg import expm

from covocp import ProblemError
from covocp.blocks import so3

PHI = np.array([0.4, -0.7, 1.1])


BODY, SPIN = (2.0, 0.7), np.array([0.4, -0.3, 1.2])  # a symmetric top: moments across and along its axis
INERTIA = np.diag([BODY[0], BODY[0], BODY[1]])


def top(C, omega):
    """The rates of a free body."""
    if isinstance(omega, np.ndarray):
        momentum = omega @ INERTIA
        return omega, np.linalg.solve(INERTIA, np.cross(momentum, omega).T).T
    return omega, ca.DM(np.linalg.inv(INERTIA)) @ ca.cross(ca.DM(INERTIA) @ omega, omega)


def exact_top(C, omega, t):
    """Attitude and rate: a rotation about the momentum, fixed in space, and one about the axis, fixed in the body."""
    momentum = C.T @ INERTIA @ omega
    spin = np.array([0.0, 0.0, omega[2] * (1 - BODY[1] / BODY[0])])
    C = expm(-t * hat(spin)) @ C @ expm(-t * hat(momentum) / BODY[0])
    return C, np.linalg.solve(INERTIA, C @ momentum)


def test_order_of_the_steps():
    start, duration = so3.exp([0.5, 1.0, -0.2]), 2.0
    C_end, omega_end = exact_top(start, SPIN, duration)
    errors, magnus, counts = [], [], np.array([16, 32, 64, 128])
    for count in counts:
        C, omega, h = start, SPIN, duration / count
        D, q = start, so3.to_quaternion(start)
        for k in range(count):
            C, omega = so3.runge_kutta_step(top, C, omega, h)
            rates = [exact_top(start, SPIN, (k + s) * h)[1] for s in (0.0, 0.5, 1.0)]
            sigma = so3.increment(*rates, h)
            D, q = so3.exp(sigma) @ D, so3.quaternion_step(q, sigma)
        np.testing.assert_allclose(so3.from_quaternion(q), D, **IDENTITY)
        errors.append(max(np.abs(C - C_end).max(), np.abs(omega - omega_end).max()))
        magnus.append(np.abs(D - C_end).max())
    for found in (errors, magnus):
        slopes = np.diff(np.log(found)) / np.diff(np.log(counts))
        np.testing.assert_allclose(slopes, -4.0, atol=0.15)


@pytest.mark.parametrize("kind", KINDS)
def test_step_of_expressions_and_a_function(kind):
    C, omega, h = kind.sym("C", 3, 3), kind.sym("omega", 3), kind.sym("h")
    start = so3.exp([0.5, 1.0, -0.2])
    reference = so3.runge_kutta_step(top, start, SPIN, 0.1)
    step = ca.Function("step", [C, omega, h], list(so3.runge_kutta_step(top, C, omega, h)))
    np.testing.assert_allclose(step(start, SPIN, 0.1)[0], reference[0], **ROUNDING)
    np.testing.assert_allclose(step(start, SPIN, 0.1)[1].full().ravel(), reference[1], **ROUNDING)
    rates = ca.Function("rates", [C, omega], list(top(C, omega)))
    for value, expected in zip(so3.runge_kutta_step(rates, start, SPIN, 0.1), reference, strict=True):
        assert value.shape == expected.shape
        np.testing.assert_allclose(value, expected, **ROUNDING)
    starts, spins = np.stack([start, np.eye(3)]), np.stack([SPIN, 2 * SPIN])
    stacks = so3.runge_kutta_step(top, starts, spins, 0.1)
    for k in (0, 1):
        one = so3.runge_kutta_step(top, starts[k], spins[k], 0.1)
        np.testing.assert_allclose(stacks[0][k], one[0], **ROUNDING)
        np.testing.assert_allclose(stacks[1][k], one[1], **ROUNDING)
    # attitude alone, numbers beside an expression: at a constant rate a step is exact
    turned, nothing = so3.runge_kutta_step(lambda C, x: (SPIN, x), start, np.zeros(0), h)
    assert nothing.shape == (0, 1)
    np.testing.assert_allclose(ca.Function("C", [h], [turned])(2.0), so3.exp(2 * SPIN) @ start, **ROUNDING)


def test_derivatives_of_a_step_along_the_rotations():
    """Of the attitude after a step by the attitude before it, at rest too: Ad of the step, no NaN."""
    phi, C = ca.MX.sym("phi", 3), so3.exp([0.5, 1.0, -0.2])
    for rate in (np.zeros(3), SPIN):
        after, _ = so3.runge_kutta_step(top, so3.exp(phi) @ C, ca.DM(rate), 0.1)
        change = so3.log(after @ so3.runge_kutta_step(top, C, rate, 0.1)[0].T)
        slope = ca.Function("slope", [phi], [ca.jacobian(change, phi)])(0)
        # the rate in body axes does not depend on the attitude: phi turns with the step
        turned = so3.runge_kutta_step(top, C, rate, 0.1)[0] @ C.T
        np.testing.assert_allclose(slope, turned, rtol=0, atol=1e-13)


@pytest.mark.parametrize("omega", [np.array([0.001, 0.002, -0.003]), SPIN, 30 * SPIN])
def test_attitudes_stay_rotations(omega):
    C, rate = ca.SX.sym("C", 3, 3), ca.SX.sym("omega", 3)
    after = so3.runge_kutta_step(top, C, rate, 0.01)
    step = ca.Function("step", [ca.vertcat(ca.vec(C), rate)], [ca.vertcat(ca.vec(after[0]), after[1])])
    start = so3.exp([0.5, 1.0, -0.2])
    end = step.fold(10_000)(ca.vertcat(ca.vec(ca.DM(start)), ca.DM(omega)))
    R = end[:9].full().reshape(3, 3).T
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-14
    if np.linalg.norm(omega) < 1e-2:
        np.testing.assert_allclose(R, exact_top(start, omega, 100.0)[0], rtol=0, atol=1e-11)


def test_a_step_draws_expressions_to_the_rotations():
    C = ca.SX.sym("C", 3, 3)
    step = ca.Function("step", [C], [so3.runge_kutta_step(lambda C, x: (0 * SPIN, x), C, np.zeros(0), 0.1)[0]])
    for scale in (0.1, 0.7, 1.5, 10.0):
        before = scale * so3.exp(PHI)
        after = step(before).full()
        closer = np.abs(np.linalg.svd(after, compute_uv=False) - 1)
        assert (closer < abs(scale - 1)).all()
        assert np.linalg.det(after) > 0
        np.testing.assert_allclose(so3.project(after), so3.exp(PHI), **ROUNDING)


# ---------------------------------------------------------------------------------------------------------- gradients

K_A = np.pi / np.sqrt(2.32)
B = np.array([[0.3, -1.0, 2.0], [0.7, 0.1, -0.4], [1.5, -0.6, 0.8]])


def antenna(C):
    """Section 9, with w > 0: the power of a patch antenna [W]."""
    u, v = C[0, 2], C[1, 2]
    angle = 0.5 * K_A / 1.5 * v
    squared = angle**2
    sinc = ca.if_else(squared < 1e-10, 1 - squared / 6, ca.sin(angle) / ca.if_else(squared < 1e-10, 1, angle))
    return 4.61 * (1 - v**2) * sinc**2 * ca.cos(0.5 * K_A * u) ** 2


def test_gradients_of_the_antenna():
    """The reference values of section 13."""
    start = so3.principal(2, np.deg2rad(60)) @ so3.principal(3, np.deg2rad(20))
    other = so3.exp([0.3, -0.5, 0.2])
    assert float(antenna(start)) == pytest.approx(1.8122656533, abs=1e-10)
    assert float(antenna(other)) == pytest.approx(3.2793986559, abs=1e-10)
    found = so3.body_gradient(antenna, np.stack([start, other]))
    published = [[0.0, -2.3221488342, 0.0], [-1.5507071709, 3.1869119321, 0.0358425122]]
    np.testing.assert_allclose(found, published, rtol=0, atol=1e-10)


@FIXED
@given(seed=SEEDS, angle=ANY_ANGLE)
def test_gradient_identities(seed, angle):
    C, generator = so3.exp(turn(seed, angle)), np.random.default_rng(seed)
    b = so3.body_gradient(lambda C: ca.trace(B.T @ C), C)
    # nabla f = P_a(grad C') C = -b^x C / 2, of tr(B'C): -P_a(C B') C
    nabla = so3.antisymmetric_part(B @ C.T) @ C
    np.testing.assert_allclose(-0.5 * so3.cross(b) @ C, nabla, **IDENTITY)
    np.testing.assert_allclose(nabla, -so3.antisymmetric_part(C @ B.T) @ C, **IDENTITY)
    # along e^{-(s phi)^x} C
    phi = generator.standard_normal(3)
    s = ca.SX.sym("s")
    slope = ca.Function("slope", [s], [ca.jacobian(ca.trace(B.T @ (so3.exp(s * phi) @ C)), s)])
    assert float(slope(0)) == pytest.approx(b @ phi, abs=1e-12)
    # the retraction along 2 kappa nabla
    kappa = 0.2
    np.testing.assert_allclose(expm(2 * kappa * nabla @ C.T) @ C, so3.exp(kappa * b) @ C, **IDENTITY)
    # of F(C a): grad F x z, across z
    a = generator.standard_normal(3)
    z = C @ a
    b = so3.body_gradient(lambda C: (C @ a)[0] ** 2 + ca.sin((C @ a)[1]), C)
    np.testing.assert_allclose(b, np.cross([2 * z[0], np.cos(z[1]), 0.0], z), **IDENTITY)
    assert b @ z == pytest.approx(0.0, abs=1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_of_expressions_and_functions(kind):
    C, at = kind.sym("C", 3, 3), so3.exp(PHI)
    reference = so3.body_gradient(antenna, at)
    expression = so3.body_gradient(antenna(C), C)
    assert expression.shape == (3, 1)
    np.testing.assert_allclose(ca.Function("b", [C], [expression])(at).full().ravel(), reference, **ROUNDING)
    function = ca.Function("f", [C], [antenna(C)])
    np.testing.assert_allclose(so3.body_gradient(function, at), reference, **ROUNDING)
    phi = kind.sym("phi", 3)
    composed = ca.Function("b", [phi], [so3.body_gradient(function, so3.exp(phi))])
    np.testing.assert_allclose(composed(PHI).full().ravel(), reference, **ROUNDING)
    np.testing.assert_array_equal(so3.body_gradient(lambda _: 3.0, at), np.zeros(3))
    assert so3.body_gradient(antenna, np.zeros((0, 3, 3))).shape == (0, 3)
    # its derivative: the curvature at the peak about b1 and b2, section 9
    hessian = ca.jacobian(so3.body_gradient(antenna, so3.exp(phi)), phi)
    curvature = ca.Function("H", [phi], [hessian])(0).full()
    expected = [-2 * 4.61 * (1 + (K_A / 1.5) ** 2 / 12), -2 * 4.61 * (K_A / 2) ** 2, 0.0]
    np.testing.assert_allclose(curvature, np.diag(expected), rtol=0, atol=1e-5)  # the sinc above is of second order


@pytest.mark.needs_cc
@pytest.mark.parametrize("kind", KINDS)
def test_compiled_code_agrees_with_python(kind, tmp_path):
    phi, C, omega = kind.sym("phi", 3), kind.sym("C", 3, 3), kind.sym("omega", 3)
    exp = ca.Function("exponential", [phi], [so3.exp(phi)])
    log = ca.Function("logarithm", [C], [so3.log(C), so3.to_quaternion(C)])
    step = ca.Function("step", [C, omega], list(so3.runge_kutta_step(top, C, omega, 0.1)))
    flying = [compile_function(function, tmp_path) for function in (exp, log, step)]
    for angle in (*ANGLES, 3.14, np.pi):
        at = angle * AXIS
        attitude = so3.exp(at)
        np.testing.assert_allclose(flying[0](at)[0], attitude, **ROUNDING)
        np.testing.assert_allclose(np.abs(flying[1](attitude)[0].ravel()), np.abs(so3.log(attitude)), **ROUNDING)
        np.testing.assert_allclose(flying[1](attitude)[1].ravel(), so3.to_quaternion(attitude), **ROUNDING)
        for value, expected in zip(
            flying[2](attitude, SPIN), so3.runge_kutta_step(top, attitude, SPIN, 0.1), strict=True
        ):
            np.testing.assert_allclose(value.reshape(expected.shape), expected, **ROUNDING)


def still(C, x):
    """No motion."""
    return np.zeros(3), x


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda: so3.runge_kutta_step(3.0, np.eye(3), np.zeros(3), 0.1), "'dynamics'"),
        (lambda: so3.runge_kutta_step(still, 2 * np.eye(3), np.zeros(3), 0.1), "'matrix'"),
        (lambda: so3.runge_kutta_step(still, np.eye(3), [np.nan], 0.1), "'state'"),
        (lambda: so3.runge_kutta_step(still, np.eye(3), np.zeros(3), [0.1, 0.2]), "'h'"),
        (lambda: so3.runge_kutta_step(lambda C, x: x, np.eye(3), np.zeros(3), 0.1), "'dynamics'"),
        (lambda: so3.runge_kutta_step(lambda C, x: (x, x), np.eye(3), np.zeros(2), 0.1), "'dynamics, omega'"),
        (lambda: so3.runge_kutta_step(lambda C, x: (x, 0.0), np.eye(3), np.zeros(3), 0.1), "'dynamics, dx/dt'"),
        (lambda: so3.runge_kutta_step(lambda C: C, np.eye(3), np.zeros(3), 0.1), "(?s)'dynamics'.*TypeError"),
        (lambda: so3.increment(np.zeros(3), np.zeros(3), np.zeros(2), 0.1), "'last'"),
        (lambda: so3.body_gradient(lambda C: 1 / 0, np.eye(3)), "(?s)'function'.*ZeroDivisionError"),
        (lambda: so3.body_gradient(1.0, np.eye(3)), "'function'"),
        (lambda: so3.body_gradient(lambda C: C, np.eye(3)), "'function'"),
        (lambda: so3.body_gradient(antenna, np.ones((3, 3))), "'matrix'"),
        (lambda: so3.body_gradient(ca.SX.sym("f"), np.eye(3)), "'matrix'"),
        (lambda: so3.body_gradient(ca.SX.sym("f"), ca.MX.sym("C", 3, 3)), "'matrix'"),
    ],
)
def test_wrong_arguments_are_named(call, argument):
    with pytest.raises(ProblemError, match=argument):
        call()


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_functions_of_numbers_in_a_users_dynamics_are_named(kind):
    """CasADi's own words are "'to_double' not defined", and of an SX math.sin makes NaN in silence."""
    C, x = kind.sym("C", 3, 3), kind.sym("x", 3)
    with pytest.raises(ProblemError, match=r"'dynamics'(?s:.)*casadi\.sin and its like in place of math\.sin"):
        so3.runge_kutta_step(lambda C, x: (ca.vertcat(math.sin(x[0]), x[1], 0), x), C, x, 0.1)
    with pytest.raises(ProblemError, match=r"'function'(?s:.)*casadi\.sin and its like in place of math\.sin"):
        so3.body_gradient(lambda C: math.sin(C[0, 0]), C)
    with pytest.raises(ProblemError, match=r"'function'(?s:.)*casadi\.if_else"):
        so3.body_gradient(lambda C: C[0, 0] if C[0, 0] > 0 else 0.0, C)
