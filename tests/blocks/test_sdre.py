"""Laws of state-dependent Riccati equations in mixed units, against closed forms and the laws in other units."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from linear_systems import FIXED, SEEDS
from scipy import integrate

from covocp.blocks import sdre


def gain(law, size):
    """K of u = -K x, of a law that is linear."""
    return np.array([-law(column, 0.0) for column in np.eye(size)]).T


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1e-3, 1.0, 1e5, 3e5, 1e6, 1e9])
def test_a_double_integrator_in_any_unit_of_its_position(unit):
    """Q = diag(1, 1), R = 1 in metres: K = (1, root 3)."""
    x = ca.SX.sym("x", 2)
    A, Q = np.array([[0.0, unit], [0.0, 0.0]]), np.diag([unit**-2.0, 1.0])
    law = sdre.regulator(x, A, ca.SX(2, 2), [0.0, 1.0], Q, 1.0)
    np.testing.assert_allclose(gain(law, 2), [[1.0 / unit, np.sqrt(3.0)]], rtol=1e-9)
    filtering = sdre.filter_gain(x, A.T, ca.SX(2, 2), [0.0, 1.0], Q, 1.0)
    np.testing.assert_allclose(filtering(np.ones(2), 0.0), [[1.0 / unit], [np.sqrt(3.0)]], rtol=1e-9)


@FIXED
@given(seed=SEEDS, far=st.sampled_from([0, 6, 9]))
def test_laws_do_not_depend_on_units(seed, far):
    """P of the closed loop is the integral of what it costs, in the units in which the plant was made."""
    generator = np.random.default_rng(seed)
    A, B = generator.standard_normal((3, 3)), generator.standard_normal((3, 1))
    units, x = 10.0 ** generator.uniform(-far, far, 3), ca.SX.sym("x", 3)
    law = sdre.regulator(x, A * units / units[:, None], ca.SX(3, 3), B / units[:, None], np.diag(units**2), 1.0)
    K = gain(law, 3) / units
    values, vectors = np.linalg.eig(A - B @ K)
    assert values.real.max() < 0
    cost = np.linalg.inv(vectors)
    stage = vectors.conj().T @ (np.eye(3) + K.T @ K) @ vectors
    P = (cost.conj().T @ (-stage / (values.conj()[:, None] + values)) @ cost).real
    np.testing.assert_allclose(B.T @ P, K, rtol=1e-7, atol=1e-7 * np.abs(K).max())


def test_an_input_that_costs_next_to_nothing():
    """Two lags apart: K = root(1 + 1/r) - 1 of each."""
    law = sdre.regulator(ca.SX.sym("x", 2), -np.eye(2), ca.SX(2, 2), np.eye(2), np.eye(2), np.diag([1e-18, 1.0]))
    np.testing.assert_allclose(gain(law, 2), np.diag([1e9 - 1.0, np.sqrt(2.0) - 1.0]), rtol=1e-8)


def test_an_unstable_spring_in_micrometres_comes_to_rest():
    """x1' = 1e6 x2, x2' = x1 / 1e6 (1 + x1^2 / 1e12) + u; simulated from 1 m."""
    unit, x = 1e6, ca.SX.sym("x", 2)
    A = ca.SX(2, 2)
    A[1, 0] = (x[0] / unit) ** 2 / unit
    law = sdre.regulator(x, [[0.0, unit], [1.0 / unit, 0.0]], A, [0.0, 1.0], np.diag([unit**-2.0, 1.0]), 1.0)

    def slope(t, state):
        metres = state[0] / unit
        return [unit * state[1], metres + metres**3 + law(state, t)[0]]

    run = integrate.solve_ivp(slope, (0.0, 12.0), [unit, 0.0], rtol=1e-6, atol=[1.0, 1e-6])
    assert np.abs(run.y[:, -1] / [unit, 1.0]).max() < 1e-3
