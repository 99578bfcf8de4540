"""Rates of Riccati or Lyapunov form are recognised however they are written, and no others."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.base.matrices import half_length, pack, pack_symbolic, unpack_symbolic
from covocp.base.riccati_rates import recognise, riccati_rate


def random_form(size, seed):
    generator = np.random.default_rng(seed)
    F, G, B = (generator.standard_normal((size, size)) for _ in range(3))
    return F, G @ G.T, B @ B.T


def found(rate_of, size):
    """The recognised form of a user's rate, as numbers."""
    half = ca.SX.sym("e", half_length(size))
    form = recognise(pack_symbolic(ca.densify(rate_of(unpack_symbolic(half, size)))), half, size)
    return None if form is None else [ca.evalf(ca.densify(entry)).full() for entry in form]


@pytest.mark.parametrize("size", range(1, 7))
def test_riccati_form_is_recovered(size):
    F, Q, W = random_form(size, size)
    form = found(lambda E: ca.DM(F) @ E + E @ ca.DM(F).T + ca.DM(Q) - E @ ca.DM(W) @ E, size)
    for one, two in zip(form, (F, Q, W), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-12)


@pytest.mark.parametrize("size", [1, 3, 5])
def test_lyapunov_form_is_recovered(size):
    F, Q, _ = random_form(size, 10 + size)
    form = found(lambda E: ca.DM(F) @ E + E @ ca.DM(F).T + ca.DM(Q), size)
    np.testing.assert_allclose(form[0], F, atol=1e-12)
    np.testing.assert_allclose(form[1], Q, atol=1e-12)
    np.testing.assert_allclose(form[2], 0, atol=1e-12)


def test_given_gain_written_out():
    """(F - K M) E + E (F - K M)' + K U K' + Q [Schmidt 3.2-30]."""
    F, Q, _ = random_form(3, 5)
    K, M, U = np.array([[0.3], [0.1], [-0.2]]), np.array([[1.0, 0, 0]]), 0.7
    A = F - K @ M
    form = found(lambda E: ca.DM(A) @ E + E @ ca.DM(A).T + U * ca.DM(K @ K.T) + ca.DM(Q), 3)
    np.testing.assert_allclose(form[0], A, atol=1e-12)
    np.testing.assert_allclose(form[1], K @ K.T * U + Q, atol=1e-12)


def test_inverse_of_the_noise_inside_the_rate():
    F, Q, _ = random_form(2, 6)
    U = np.array([[2.0, 0.3], [0.3, 1.0]])
    noise = ca.SX(ca.DM(U))
    form = found(lambda E: ca.DM(F) @ E + E @ ca.DM(F).T + ca.DM(Q) - E @ ca.inv(noise) @ E, 2)
    np.testing.assert_allclose(form[2], np.linalg.inv(U), rtol=1e-12)


def test_outer_product_of_a_column():
    """A measurement of the first entry: E m m' E / U as a product of columns."""
    form = found(lambda E: ca.DM.eye(2) - E[:, 0] @ E[:, 0].T / 0.1, 2)
    np.testing.assert_allclose(form[2], [[10, 0], [0, 0]], rtol=1e-12)


def test_trace_in_a_scalar_rate():
    form = found(lambda E: 2 * ca.trace(E) + 1 - E**2 / 3, 1)
    np.testing.assert_allclose([entry.item() for entry in form], [1, 1, 1 / 3], rtol=1e-12)


@pytest.mark.parametrize(
    "rate",
    [
        lambda E: E @ E @ E,
        lambda E: ca.sin(E),
        lambda E: ca.sqrt(E**2 + 1),
        lambda E: ca.trace(E) * ca.DM.eye(E.shape[0]),
        lambda E: ca.trace(E) * E,
        lambda E: ca.diag(ca.diag(E)),
        lambda E: -ca.diag(ca.diag(E) ** 2),
        lambda E: ca.inv(E),
    ],
    ids=["cube", "sin", "sqrt", "trace times I", "trace times E", "diagonal", "squared diagonal", "inverse"],
)
def test_other_rates_are_refused(rate):
    assert found(rate, 2) is None


def test_scalar_cube_is_refused():
    assert found(lambda E: 1 - E**3, 1) is None


def test_coefficients_of_nominal_and_time():
    x, half = ca.SX.sym("x"), ca.SX.sym("e", 3)
    F = ca.blockcat([[-1, -x], [0, 0]])
    M = ca.SX(ca.DM([[1.0, 0.0]]))
    E = unpack_symbolic(half, 2)
    rate = F @ E + E @ F.T + ca.diag(ca.vertcat(1 + x**2, 0)) - E @ M.T @ M @ E / (1 + ca.exp(x))
    form = recognise(pack_symbolic(rate), half, 2)
    function = ca.Function("form", [x], [ca.densify(v) for v in form])
    drift, noise, information = (np.asarray(v.full()) for v in function(0.4))
    np.testing.assert_allclose(drift, [[-1, -0.4], [0, 0]], atol=1e-14)
    np.testing.assert_allclose(noise, [[1.16, 0], [0, 0]], atol=1e-14)
    np.testing.assert_allclose(information, [[1 / (1 + np.exp(0.4)), 0], [0, 0]], atol=1e-14)


def test_riccati_rate_is_the_formula():
    F, Q, W = random_form(4, 9)
    E = Q + np.eye(4)
    value = ca.DM(riccati_rate(ca.DM(E), ca.DM(F), ca.DM(Q), ca.DM(W))).full()
    np.testing.assert_allclose(value, F @ E + E @ F.T + Q - E @ W @ E, rtol=1e-12)


# --- in a problem -----------------------------------------------------------------------------------------------------


def two_matrices(rate_of_B):
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", initial=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    A, B = ocp.symmetric("A", 2, initial=np.eye(2)), ocp.symmetric("B", 2, initial=np.eye(2))
    ocp.dynamics(A, -2 * A)
    ocp.dynamics(B, rate_of_B(A, B, x))
    ocp.minimize(running=u**2, terminal=ca.trace(B))
    return ocp.statement()


def test_matrix_driven_by_another_is_refused():
    assert two_matrices(lambda A, B, x: A - B).riccati[1] is None
    assert two_matrices(lambda A, B, x: A @ B + B @ A).riccati[1] is None


def test_each_matrix_for_itself():
    forms = two_matrices(lambda A, B, x: -x * B - B @ B).riccati
    assert forms[0] is not None
    drift, noise, information = (np.asarray(ca.densify(v).full()) for v in forms[1](0.6, 0.0, 0.0, 1.0, []))
    np.testing.assert_allclose(drift, -0.3 * np.eye(2), atol=1e-14)
    np.testing.assert_allclose(noise, 0, atol=1e-14)
    np.testing.assert_allclose(information, np.eye(2), atol=1e-14)


def test_user_written_kalman_equals_the_built_in_one():
    """The first-order lag with its covariance written by hand has the F, Q, W of estimation_covariance()."""
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", initial=0.0, variance=1.0)
    b = ocp.unknown("b", mean=1.0, variance=5.0)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=0.8)
    ocp.measurement("position", x, noise=0.5)
    E = ocp.estimation_covariance()
    S = ocp.symmetric("S", 2, initial=np.diag([1.0, 5.0]), lower=0.0)
    F = ca.blockcat([[-b, -x], [ca.MX(0), ca.MX(0)]])
    M = ca.DM([[1.0, 0.0]])
    ocp.dynamics(S, F @ S + S @ F.T + ca.diag(ca.DM([0.8, 0])) - S @ M.T @ ca.inv(ca.MX(0.5)) @ M @ S)
    ocp.minimize(running=u**2, terminal=E[b, b] + S[1, 1])
    statement = ocp.statement()
    arguments = (0.7, 0.2, 0.1, 1.0, [1.0])
    built_in, own = ([np.asarray(ca.densify(v).full()) for v in f(*arguments)] for f in statement.riccati)
    for one, two in zip(built_in, own, strict=True):
        np.testing.assert_allclose(one, two, atol=1e-14)
    np.testing.assert_allclose(built_in[0], [[-1, -0.7], [0, 0]])
    half = pack(np.array([[2.0, 0.3], [0.3, 1.0]]))
    rates = statement.rates([0.7], [0.2], np.concatenate([half, half]), 0.1, 1.0, [1.0])[1]
    np.testing.assert_allclose(rates.full().ravel()[:3], rates.full().ravel()[3:], rtol=1e-14)
