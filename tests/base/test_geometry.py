"""States that are no vectors: their moves against rotations, finite differences and each other."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from covocp.base.geometry import Geometry
from covocp.blocks import so3
from covocp.blocks.rotation_chart import rotation_chart, rotation_vectors, turning

CHART = rotation_chart()
WHOLE = Geometry.stacked(2, Geometry.of([type("Entry", (), {"size": 4, "chart": CHART})]), 1)
QUATERNIONS = arrays(float, 4, elements=st.floats(-2.0, 2.0)).filter(lambda q: np.linalg.norm(q) > 0.1)
VECTORS = arrays(float, 3, elements=st.floats(-1.7, 1.7))


def attitude(q):
    return so3.from_quaternion(np.asarray(q).ravel() / np.linalg.norm(q))


def numbers(value):
    return np.asarray(ca.DM(value).full()).ravel()


@given(QUATERNIONS, VECTORS)
def test_a_tangent_turns_in_body_axes_and_keeps_the_length(q, d):
    moved = numbers(CHART.move(q, d))
    assert attitude(moved) == pytest.approx(so3.exp(d) @ attitude(q), abs=1e-12)
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(q), rel=1e-14)


@given(QUATERNIONS, VECTORS, st.sampled_from([1.0, -3.0]))
def test_a_difference_undoes_a_move_whatever_the_sign_and_length(q, d, factor):
    found = numbers(CHART.difference(factor * CHART.move(q, d), q))
    assert found == pytest.approx(d, abs=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1e-3, 0.4472, 0.4473, 1.0, 3.0, 3.1415])
def test_differences_have_exact_slopes_at_every_angle(angle):
    d, z = ca.SX.sym("d", 3), ca.SX.sym("z", 4)
    value = CHART.difference(CHART.move(z, d), z)
    slope = ca.jacobian(value, d)
    at = ca.Function("slopes", [z, d], [slope, ca.jacobian(slope, d)])
    first, second = at([0.5, 0.5, -0.5, 0.5], angle * np.array([0.6, 0.0, 0.8]))
    assert first.full() == pytest.approx(np.eye(3), abs=1e-11)
    assert second.full() == pytest.approx(np.zeros((9, 3)), abs=1e-9)


def test_the_basis_is_the_slope_of_a_move():
    q = np.array([0.3, -0.5, 0.9, 1.1])
    columns = [numbers(CHART.move(q, h) - CHART.move(q, -h)) / 2e-5 for h in 1e-5 * np.eye(3)]
    assert CHART.basis(q).full() == pytest.approx(np.array(columns).T, abs=1e-9)


def test_the_velocity_of_a_turning_attitude_is_its_rate():
    q, omega = np.array([0.3, -0.5, 0.9, 1.1]), np.array([0.4, -1.0, 0.2])
    assert numbers(CHART.velocity(q, turning(ca.DM(q), ca.DM(omega)))) == pytest.approx(omega, abs=1e-14)


def test_two_attitudes_that_turn_alike_differ_as_the_drift_says():
    """Both with rates of their own: dd/dt = D d + domega to first order in d."""
    omega, other = np.array([0.4, -1.0, 0.2]), np.array([1e-6, 3e-6, -2e-6])
    d = np.array([2e-6, -1e-6, 4e-6])
    q = np.array([0.5, 0.5, -0.5, 0.5])

    def apart(t):
        first = CHART.move(q, omega * t)
        return numbers(CHART.difference(CHART.move(CHART.move(q, d), (omega + other) * t), first))

    rate = (apart(1e-4) - apart(-1e-4)) / 2e-4
    assert rate == pytest.approx(CHART.drift(omega).full() @ d + other, abs=1e-10)


def test_the_step_of_a_stacked_state_is_of_order_four_and_keeps_unit_length():
    """A tumbling body, its kinetic energy beside it; against scipy's integration of the rotation."""
    inertia = np.diag([1.0, 2.0, 3.5])
    geometry = Geometry.stacked(3, Geometry.of([type("Entry", (), {"size": 4, "chart": CHART})]))

    def rate(value, _):
        w, q = value[:3], value[3:7]
        torque = -ca.cross(w, ca.DM(inertia) @ w) + ca.vertcat(0.3, 0, 0)
        return ca.vertcat(torque / ca.DM(np.diag(inertia)), turning(q, w), ca.sumsqr(w))

    start = np.concatenate([[1.0, -0.7, 0.4], [1.0, 0.0, 0.0, 0.0], [0.0]])
    value, h = ca.SX.sym("value", 8), ca.SX.sym("h")
    step = ca.Function("step", [value, h], [geometry.step(rate, value, h)])
    plain = ca.Function("rate", [value], [rate(value, 0.0)])
    true = solve_ivp(lambda _, y: plain(y).full().ravel(), (0.0, 2.0), start, rtol=1e-12, atol=1e-13).y[:, -1]
    errors = []
    for count in (20, 40):
        found = start
        for _ in range(count):
            found = step(found, 2.0 / count).full().ravel()
        assert np.linalg.norm(found[3:7]) == pytest.approx(1.0, abs=1e-14)
        errors.append(np.abs(found - true).max())
    assert errors[1] < 1e-5
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.25)


@given(QUATERNIONS, VECTORS, arrays(float, 3, elements=st.floats(-2.0, 2.0)))
def test_a_stacked_state_moves_part_by_part(q, d, others):
    x = np.concatenate([others[:2], q, others[2:]])
    tangent = np.concatenate([[1.0, -2.0], d, [3.0]])
    moved = numbers(WHOLE.move(ca.DM(x), ca.DM(tangent)))
    assert moved[[0, 1, 6]] == pytest.approx(x[[0, 1, 6]] + [1.0, -2.0, 3.0])
    assert WHOLE.moved(x[None], tangent[None])[0] == pytest.approx(moved, abs=1e-15)
    assert WHOLE.differences(moved[None], x[None])[0] == pytest.approx(tangent, abs=1e-13)


def test_rotation_vectors_run_on_through_half_a_turn():
    angles = np.linspace(0.0, 6.0, 50)
    axis = np.array([0.6, 0.0, -0.8])
    q = np.column_stack([np.cos(angles / 2), np.sin(angles / 2)[:, None] * axis])
    assert rotation_vectors(-q) == pytest.approx(angles[:, None] * axis, abs=1e-12)
    # so3 turns axes, scipy vectors: its rotations are transposed
    assert so3.from_quaternion(q[20]) == pytest.approx(Rotation.from_rotvec(angles[20] * axis).as_matrix().T)
