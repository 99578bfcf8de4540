"""Rotations: truth by scipy, identities and group axioms, derivatives at and near angle zero and half a turn."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, SEEDS
from rotations import ANGLES, ANY_ANGLE, AXIS, IDENTITY, KINDS, ROUNDING, hat, second_derivative, turn
from scipy.integrate import quad_vec
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from covocp import ProblemError
from covocp.blocks import so3

# ---------------------------------------------------------------------------------------------------------- truth


@FIXED
@given(seed=SEEDS, angle=ANY_ANGLE)
def test_numbers_agree_with_scipy(seed, angle):
    phi = turn(seed, angle)
    C = so3.exp(phi)
    np.testing.assert_allclose(C, expm(-hat(phi)), **ROUNDING)
    np.testing.assert_allclose(C, Rotation.from_rotvec(phi).as_matrix().T, **ROUNDING)
    np.testing.assert_allclose(so3.log(C), phi, rtol=1e-14, atol=1e-13)
    if angle > 1e-8:
        np.testing.assert_allclose(so3.cross(so3.log(C)), -np.real(logm(C)), rtol=0, atol=1e-9)
    w, *v = so3.to_quaternion(C)
    np.testing.assert_allclose([*v, w], Rotation.from_rotvec(phi).as_quat(canonical=True), **ROUNDING)
    np.testing.assert_allclose(so3.from_quaternion([w, *v]), C, **ROUNDING)
    average = quad_vec(lambda s: expm(-s * hat(phi)), 0.0, 1.0, epsabs=1e-14)[0]
    np.testing.assert_allclose(so3.left_jacobian(phi), average, **ROUNDING)
    np.testing.assert_allclose(so3.inverse_left_jacobian(phi), np.linalg.inv(average), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("angle", ANGLES)
def test_first_and_second_derivatives_of_exp_are_exact(kind, angle):
    phi, a, b = kind.sym("phi", 3), kind.sym("a"), kind.sym("b")
    U, V = np.array([0.3, -1.0, 0.2]), np.array([-0.5, 0.4, 1.1])
    C = so3.exp(phi + a * U + b * V)
    first = ca.horzcat(ca.jacobian(C, a), ca.jacobian(C, b))
    second = ca.jacobian(ca.jacobian(C, a), b)
    found = ca.Function("derivatives", [phi, a, b], [C, first, second])(angle * AXIS, 0, 0)
    truth = second_derivative(-hat(angle * AXIS), -hat(U), -hat(V))
    np.testing.assert_allclose(found[0], truth[0], **ROUNDING)
    for column in (0, 1):
        np.testing.assert_allclose(found[1][:, column].full().reshape(3, 3).T, truth[1 + column], **ROUNDING)
    np.testing.assert_allclose(found[2].full().reshape(3, 3).T, truth[3], **ROUNDING)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("angle", ANGLES)
def test_derivatives_of_inverses_are_those_of_the_identity(kind, angle):
    """Of log after exp, J^-1 after J, and of the quaternion and back: the first is the identity, the second is zero."""
    phi = kind.sym("phi", 3)
    C = so3.exp(phi)
    unit = ca.vec(so3.inverse_left_jacobian(phi) @ so3.left_jacobian(phi))
    there = ca.vec(so3.from_quaternion(so3.to_quaternion(C)) - C)
    for expression, slope in ((so3.log(C), np.eye(3)), (unit, np.zeros((9, 3))), (there, np.zeros((9, 3)))):
        first = ca.jacobian(expression, phi)
        derivatives = ca.Function("derivatives", [phi], [first, ca.jacobian(ca.vec(first), phi)])
        found = derivatives(angle * AXIS)
        np.testing.assert_allclose(found[0], slope, rtol=0, atol=2e-13)
        np.testing.assert_allclose(found[1], np.zeros(found[1].shape), rtol=0, atol=2e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("angle", ANGLES)
def test_hessian_of_a_scalar(kind, angle):
    """w'e^{-phi^x}u by ca.hessian, against the block exponential."""
    phi, u, w = kind.sym("phi", 3), np.array([1.0, 2.0, -0.5]), np.array([0.2, -1.0, 0.7])
    H, gradient = ca.hessian(ca.dot(ca.DM(w), so3.exp(phi) @ u), phi)
    found = ca.Function("hessian", [phi], [H, gradient])(angle * AXIS)
    for i, a in enumerate(np.eye(3)):
        for j, b in enumerate(np.eye(3)):
            _, first, _, second = second_derivative(-hat(angle * AXIS), -hat(a), -hat(b))
            assert float(found[0][i, j]) == pytest.approx(w @ second @ u, abs=1e-13)
        assert float(found[1][i]) == pytest.approx(w @ first @ u, abs=1e-13)


@pytest.mark.parametrize("angle", [3.09, 3.1, 3.14, np.pi - 1e-6, np.pi - 1e-12, np.pi])
def test_log_near_half_a_turn(angle):
    vectors = np.concatenate([[turn(seed, angle) for seed in range(200)], angle * np.eye(3), -angle * np.eye(3)])
    found = so3.log(so3.exp(vectors))
    off = np.minimum(*(np.abs(found - sign * vectors).max(axis=1) for sign in (1, -1)))
    if angle < np.pi:  # one ulp of pi and more below it the sign is that of the vector
        off = off if np.pi - angle < 1e-10 else np.abs(found - vectors).max(axis=1)
    assert off.max() < 1e-14
    phi = ca.MX.sym("phi", 3)
    expression = ca.Function("log", [phi], [so3.log(so3.exp(phi))])
    for vector, value in zip(vectors[-10:], found[-10:], strict=True):
        np.testing.assert_allclose(np.abs(expression(vector).full().ravel()), np.abs(value), rtol=0, atol=1e-14)
    half = np.stack([np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])])
    np.testing.assert_allclose(so3.log(half), np.pi * np.eye(3), rtol=1e-15, atol=1e-15)


# ----------------------------------------------------------------------------------------- identities of section 2


@FIXED
@given(seed=SEEDS, angles=st.tuples(ANY_ANGLE, ANY_ANGLE, ANY_ANGLE))
def test_group_axioms(seed, angles):
    A, B, D = (so3.exp(turn(seed + k, angle)) for k, angle in enumerate(angles))
    assert so3.is_rotation(A @ B, tolerance=1e-14)
    np.testing.assert_allclose((A @ B) @ D, A @ (B @ D), **ROUNDING)
    np.testing.assert_allclose(A @ so3.exp(-turn(seed, angles[0])), np.eye(3), **ROUNDING)
    np.testing.assert_allclose(A @ so3.exp(np.zeros(3)), A, rtol=0, atol=0)
    np.testing.assert_allclose(so3.exp(2 * turn(seed, angles[0])), A @ A, **ROUNDING)
    phi = turn(seed + 1, angles[1])
    np.testing.assert_allclose(A @ B @ A.T, so3.exp(A @ phi), **ROUNDING)  # the adjoint
    p, q, r = (so3.to_quaternion(C) for C in (A, B, D))
    np.testing.assert_allclose(so3.from_quaternion(so3.quaternion_product(p, q)), B @ A, **ROUNDING)
    left = so3.quaternion_product(so3.quaternion_product(p, q), r)
    np.testing.assert_allclose(left, so3.quaternion_product(p, so3.quaternion_product(q, r)), **ROUNDING)
    np.testing.assert_allclose(so3.from_quaternion(so3.quaternion_step(p, phi)), B @ A, **ROUNDING)
    assert np.linalg.norm(so3.quaternion_step(p, phi)) == pytest.approx(1.0, abs=1e-15)


@FIXED
@given(seed=SEEDS, angle=ANY_ANGLE)
def test_identities_of_rotations(seed, angle):
    generator = np.random.default_rng(seed)
    u, v = generator.standard_normal((2, 3))
    M = generator.standard_normal((3, 3))
    Omega, phi = so3.cross(u), turn(seed, angle)
    np.testing.assert_allclose(so3.cross(u) @ v, np.cross(u, v), **ROUNDING)
    np.testing.assert_allclose(so3.vee(so3.cross(u)), u, rtol=0, atol=0)
    np.testing.assert_allclose(so3.antisymmetric_part(M), (M - M.T) / 2, **ROUNDING)
    assert np.trace(M @ Omega) == pytest.approx(np.trace(so3.antisymmetric_part(M) @ Omega), abs=1e-10)
    assert np.trace(-so3.cross(u) @ so3.cross(v)) == pytest.approx(2 * u @ v, abs=1e-10)
    C = so3.exp(phi)
    sine = -np.sin(angle) * phi / angle if angle else np.zeros(3)
    np.testing.assert_allclose(so3.vee(so3.antisymmetric_part(C)), sine, **IDENTITY)
    # kinematics: the rate of phi that a body rate makes, and back; J phi = phi; J(-phi) = J(phi)'
    J, inverse = so3.left_jacobian(phi), so3.inverse_left_jacobian(phi)
    np.testing.assert_allclose(J @ inverse, np.eye(3), **IDENTITY)
    np.testing.assert_allclose(J @ phi, phi, **ROUNDING)
    np.testing.assert_allclose(so3.left_jacobian(-phi), J.T, **ROUNDING)
    np.testing.assert_allclose(J.T @ C, J, **ROUNDING)
    # dC along the rate of phi is -omega^x C
    _, change, _, _ = second_derivative(-hat(phi), -hat(inverse @ u), -hat(v))
    np.testing.assert_allclose(change, -so3.cross(u) @ C, **IDENTITY)


def test_principal_rotations():
    c, s = np.cos(0.3), np.sin(0.3)
    written = (
        [[1, 0, 0], [0, c, s], [0, -s, c]],
        [[c, 0, -s], [0, 1, 0], [s, 0, c]],
        [[c, s, 0], [-s, c, 0], [0, 0, 1]],
    )
    for axis, matrix in enumerate(written, 1):
        np.testing.assert_allclose(so3.principal(axis, 0.3), matrix, rtol=0, atol=0)
        np.testing.assert_allclose(so3.exp(0.3 * np.eye(3)[axis - 1]), matrix, **ROUNDING)
        for kind in KINDS:
            angle = kind.sym("angle")
            np.testing.assert_allclose(ca.Function("C", [angle], [so3.principal(axis, angle)])(0.3), matrix, **ROUNDING)
        assert so3.principal(axis, np.zeros((2, 4))).shape == (2, 4, 3, 3)


def test_nearest_rotation():
    generator = np.random.default_rng(1)
    C = so3.exp(generator.standard_normal((50, 3)))
    stretched = C @ (np.eye(3) + 0.3 * np.einsum("ki,kj->kij", *[generator.standard_normal((50, 3)) / 3] * 2))
    found = so3.project(stretched)
    np.testing.assert_allclose(found, C, rtol=0, atol=1e-13)  # of C S with S positive definite it is C
    assert so3.is_rotation(found, tolerance=1e-14).all()
    np.testing.assert_allclose(so3.project(-np.diag([1.0, 0.9, 0.1])), np.diag([-1.0, -1.0, 1.0]), **ROUNDING)
    assert so3.is_rotation(np.eye(3)) is True
    assert so3.is_rotation(-np.eye(3)) is False
    assert so3.is_rotation(1.1 * np.eye(3)) is False
    np.testing.assert_array_equal(so3.is_rotation(np.stack([np.eye(3), -np.eye(3)])), [True, False])


# ------------------------------------------------------------------------------------- numbers, stacks, expressions

PHI = np.array([0.4, -0.7, 1.1])
CALLS = {
    "cross": (so3.cross, [PHI]),
    "vee": (so3.vee, [hat(PHI)]),
    "antisymmetric_part": (so3.antisymmetric_part, [np.arange(9.0).reshape(3, 3)]),
    "exp": (so3.exp, [PHI]),
    "log": (so3.log, [expm(-hat(PHI))]),
    "left_jacobian": (so3.left_jacobian, [PHI]),
    "inverse_left_jacobian": (so3.inverse_left_jacobian, [PHI]),
    "to_quaternion": (so3.to_quaternion, [expm(-hat(3 * PHI))]),
    "from_quaternion": (so3.from_quaternion, [[0.5, -0.5, 0.5, 0.5]]),
    "quaternion_product": (so3.quaternion_product, [[0.5, -0.5, 0.5, 0.5], [0.6, 0.0, 0.8, 0.0]]),
    "quaternion_step": (so3.quaternion_step, [[0.5, -0.5, 0.5, 0.5], PHI]),
    "increment": (so3.increment, [PHI, 2 * PHI + 0.1, PHI**2, 0.3]),
}


@pytest.mark.parametrize("name", CALLS)
def test_numbers_stacks_and_expressions_agree(name):
    function, arguments = CALLS[name]
    arguments = [np.asarray(value, dtype=float) for value in arguments]
    value = function(*arguments)
    assert isinstance(value, np.ndarray)
    many = function(*(np.broadcast_to(entry, (4, 2, *entry.shape)) for entry in arguments))
    assert many.shape == (4, 2, *value.shape)
    np.testing.assert_allclose(many, np.broadcast_to(value, many.shape), rtol=1e-15, atol=1e-15)
    assert function(*(np.zeros((0, *entry.shape)) for entry in arguments)).shape == (0, *value.shape)
    np.testing.assert_allclose(function(*(ca.DM(entry) for entry in arguments)), value, rtol=0, atol=0)
    small = function(*(entry.astype(np.float32) for entry in arguments))
    assert small.dtype == np.float32
    np.testing.assert_allclose(small, value, rtol=1e-6, atol=1e-6)
    for kind in KINDS:
        symbols = [kind.sym(f"s{k}", *np.atleast_2d(entry.T).T.shape) for k, entry in enumerate(arguments)]
        expression = function(*symbols)
        assert isinstance(expression, kind)
        found = ca.Function("f", symbols, [expression])(*arguments).full().reshape(value.shape)
        np.testing.assert_allclose(found, value, rtol=1e-14, atol=1e-15)
        if len(symbols) > 1:  # numbers beside an expression
            mixed = function(symbols[0], *arguments[1:])
            found = ca.Function("f", symbols[:1], [mixed])(arguments[0]).full().reshape(value.shape)
            np.testing.assert_allclose(found, value, rtol=1e-14, atol=1e-15)


def test_expressions_off_the_rotations_are_finite():
    """What a solver tries has finite values and derivatives, wherever it is."""
    generator = np.random.default_rng(2)
    C, phi, q = ca.MX.sym("C", 3, 3), ca.MX.sym("phi", 3), ca.MX.sym("q", 4)
    expression = ca.vertcat(so3.log(C), so3.to_quaternion(C))
    derivatives = ca.Function("f", [C], [expression, ca.jacobian(expression, C)])
    for scale in (1e-3, 1.0, 30.0):
        for _ in range(50):
            for value in derivatives(scale * generator.standard_normal((3, 3))):
                assert np.isfinite(value.full()).all()
    expression = ca.vertcat(ca.vec(so3.exp(phi)), ca.vec(so3.left_jacobian(phi)), so3.quaternion_step(q, phi))
    derivatives = ca.Function("f", [phi, q], [expression, ca.jacobian(expression, ca.vertcat(phi))])
    for size in (1e3, 1e20, 1e60):
        for value in derivatives(size * AXIS, [1.0, 0.0, 0.0, 0.0]):
            assert np.isfinite(value.full()).all()


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda: so3.cross([1.0, 2.0]), "'vector'"),
        (lambda: so3.exp([1.0, 2.0, np.nan]), "'vector'"),
        (lambda: so3.exp("x"), "'vector'"),
        (lambda: so3.exp(ca.SX.sym("x", 2)), "'vector'"),
        (lambda: so3.exp(np.zeros((3, 2))), "'vector'"),
        (lambda: so3.vee(np.eye(3)), "'matrix'"),
        (lambda: so3.log(1.001 * np.eye(3)), "(?s)'matrix'.*differs from the identity by 0.002.*so3.project"),
        (lambda: so3.log(-np.eye(3)), "(?s)'matrix'.*determinant -1"),
        (lambda: so3.log(np.stack([np.eye(3), 2 * np.eye(3)])), r"(?s)'matrix'.*at \(1,\)"),
        (lambda: so3.log(np.eye(2)), "'matrix'"),
        (lambda: so3.to_quaternion(np.zeros((3, 3))), "'matrix'"),
        (lambda: so3.from_quaternion([1.0, 1.0, 0.0, 0.0]), "(?s)'quaternion'.*norm of 1.41421"),
        (lambda: so3.quaternion_step([1.0, 0.0, 0.0], np.zeros(3)), "'quaternion'"),
        (lambda: so3.quaternion_product(np.zeros((2, 4)), np.zeros((3, 4))), "'stack'"),
        (lambda: so3.quaternion_product(ca.SX.sym("q", 4), np.zeros((3, 4))), "'stack'"),
        (lambda: so3.quaternion_product(ca.SX.sym("q", 4), ca.MX.sym("q", 4)), "mix SX and MX"),
        (lambda: so3.principal(0, 1.0), "'axis'"),
        (lambda: so3.principal(1, "x"), "'angle'"),
        (lambda: so3.is_rotation(ca.SX.sym("C", 3, 3)), "'matrix'"),
        (lambda: so3.is_rotation(np.eye(3), tolerance=0), "'tolerance'"),
        (lambda: so3.project(np.zeros((3, 3))), "'matrix'"),
        (lambda: so3.project(-np.eye(3)), "'matrix'"),
    ],
)
def test_wrong_arguments_are_named(call, argument):
    with pytest.raises(ProblemError, match=argument):
        call()


@pytest.mark.parametrize("size", [1e155, 1e200, 1e308])
@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.5, -1.0, 0.25]])
def test_a_vector_whose_square_is_no_number_is_a_rotation_about_its_axis(size, direction):
    """Its angle is known to many turns only, but its axis is."""
    vector = size * np.array(direction)
    axis = np.array(direction) / np.linalg.norm(direction)
    C, J = so3.exp(vector), so3.left_jacobian(vector)
    assert so3.is_rotation(C, tolerance=1e-14)
    np.testing.assert_allclose(C @ axis, axis, atol=1e-14)
    np.testing.assert_allclose(J, np.outer(axis, axis), atol=1e-14)  # the mean of the rotations up to it
    for kind in (ca.SX, ca.MX):
        v = kind.sym("v", 3)
        found = ca.Function("exp", [v], [so3.exp(v), so3.left_jacobian(v), ca.jacobian(so3.exp(v), v)])(vector)
        np.testing.assert_allclose(found[0].full(), C, atol=1e-14)
        np.testing.assert_allclose(found[1].full(), J, atol=1e-14)
        assert np.isfinite(found[2].full()).all()
