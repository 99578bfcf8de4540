"""The follower of a formation: matrices by their printed form, published modes, sampling, tracker, steady flight."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.signal import cont2discrete

import covocp as co
from covocp.models.formation import aircraft, drag_map

A, B, VORTEX = aircraft.continuous()
TRACKER = aircraft.tracker()
AT = {name: place for place, name in enumerate(aircraft.STATES)}
MAP = drag_map.drag_map()


def rows(*names):
    return [AT[name] for name in names]


def flown(start, command, seconds, moment):
    """States, controls and sums of the sampled loop; `moment` gives C_l by the position."""
    model, gain = TRACKER.model, TRACKER.gain
    x, z = np.array(start.state), np.array(start.sums)
    states, controls = [x], []
    reference = np.zeros(11)
    reference[-2:] = command
    for _ in range(round(seconds / TRACKER.step)):
        c = -gain @ np.concatenate([x - reference, z])
        z = z + TRACKER.step * (x - reference)[rows("y", "h", "u", "phi")]
        x = model.A @ x + model.B @ c + model.vortex[:, 0] * float(moment(x[-2:]))
        states.append(x)
        controls.append(c)
    return np.array(states), np.array(controls), z


# The aircraft


def test_published_modes():
    modes = np.linalg.eigvals(A)
    oscillations = [-0.3717 + 0.8869j, -0.00329 + 0.0672j, -0.0331 + 0.9470j]
    digits = [5e-5, 5e-6, 5e-5]
    for mode, digit in zip(oscillations, digits, strict=True):
        nearest = modes[np.argmin(np.abs(modes - mode))]
        assert nearest.real == pytest.approx(mode.real, abs=digit)
        assert nearest.imag == pytest.approx(mode.imag, abs=5e-5)
    real = np.sort(modes[np.abs(modes.imag) < 1e-12].real)
    assert real == pytest.approx([-0.5633, -0.00726, 0.0, 0.0, 0.0], abs=5e-5)
    assert real[1] == pytest.approx(-0.00726, abs=5e-6)


def test_longitudinal_matrices_as_printed():
    m, U0, Iy, Zdw, Mdw = 2.83176e6 / 9.81, 235.9, 0.449e8, 1.909e3, -1.702e4
    Zu, Zw, Zq, Mu, Mw, Mq = -2.595e4, -9.030e4, -4.524e5, 1.593e4, -1.563e5, -1.521e7
    h, mu = m - Zdw, Mdw / (m - Zdw)
    expected = [
        [-1.982e3 / m, 4.025e3 / m, 0, -9.81],
        [Zu / h, Zw / h, (Zq + m * U0) / h, 0],
        [(Mu + mu * Zu) / Iy, (Mw + mu * Zw) / Iy, (Mq + mu * (Zq + m * U0)) / Iy, 0],
        [0, 0, 1, 0],
    ]
    order = rows("u", "w", "q", "theta")
    assert np.allclose(A[np.ix_(order, order)], expected, rtol=1e-13)
    force = 0.5 * 0.3045 * U0**2 * 511
    Z, M = -0.3648 * force, -1.444 * force * 8.324
    assert np.allclose(B[order, 0], [-3.818e-6 * force / m, Z / h, (M + mu * Z) / Iy, 0])
    assert np.allclose(B[order, 3], [0.3 * 9.81, 0, 0, 0])


def test_lateral_matrices_as_printed():
    m, U0, Ix, Iz, Ixz = 2.83176e6 / 9.81, 235.9, 0.247e8, 0.673e8, -0.212e7
    x, z, zx = (Ix * Iz - Ixz**2) / Iz, (Ix * Iz - Ixz**2) / Ix, Ixz / (Ix * Iz - Ixz**2)
    Lv, Lp, Lr, Nv, Np, Nr = -3.062e5, -1.076e7, 9.925e6, 2.131e5, -1.330e6, -8.934e6
    expected = [
        [-1.610e4 / m, 0, -U0, 9.81],
        [Lv / x + zx * Nv, Lp / x + zx * Np, Lr / x + zx * Nr, 0],
        [zx * Lv + Nv / z, zx * Lp + Np / z, zx * Lr + Nr / z, 0],
        [0, 1, 0, 0],
    ]
    order = rows("v", "p", "r", "phi")
    assert np.allclose(A[np.ix_(order, order)], expected, rtol=1e-13)
    force = 0.5 * 0.3045 * U0**2 * 511
    loads = np.array([[1 / m, 0, 0], [0, 1 / x, zx], [0, zx, 1 / z], [0, 0, 0]])
    units = force * np.array([1, 59.64, 59.64])
    aileron, rudder = 5 * np.array([0, -1.368e-2, -1.973e-4]), np.array([0.1146, 6.976e-3, -0.1257])
    assert np.allclose(B[order, 1], loads @ (units * aileron))
    assert np.allclose(B[order, 2], loads @ (units * rudder))
    assert np.allclose(VORTEX[order, 0], loads @ (units * [0, 1, 0]))


def test_kinematics_and_what_is_apart():
    x = np.arange(1.0, 12.0)
    rate = A @ x
    assert rate[AT["y"]] == x[AT["v"]] + 235.9 * x[AT["psi"]]
    assert rate[AT["h"]] == 235.9 * x[AT["theta"]] - x[AT["w"]]
    assert [rate[AT[a]] for a in ("phi", "theta", "psi")] == [x[AT[a]] for a in "pqr"]
    longitudinal, lateral = rows("w", "u", "theta", "q", "h"), rows("v", "phi", "psi", "p", "r", "y")
    assert not A[np.ix_(longitudinal, lateral)].any()
    assert not A[np.ix_(lateral, longitudinal)].any()
    assert not B[np.ix_(lateral, [0, 3])].any()
    assert not B[np.ix_(longitudinal, [1, 2])].any()
    assert not VORTEX[longitudinal].any()


def test_signs():
    """The vortex lowers the right wing, a positive aileron lifts it; a positive elevator lowers the nose."""
    assert VORTEX[AT["p"], 0] > 0 > B[AT["p"], 1]
    assert B[AT["q"], 0] < 0 < B[AT["u"], 3]


def test_data_are_those_of_an_aircraft_in_level_flight():
    assert pytest.approx(drag_map.LIFT, abs=5e-4) == aircraft.WEIGHT / (aircraft.PRESSURE * aircraft.AREA)
    assert aircraft.INERTIA["z"] <= aircraft.INERTIA["x"] + aircraft.INERTIA["y"]
    assert (drag_map.PLANFORM.span, drag_map.PLANFORM.area) == (aircraft.SPAN, aircraft.AREA)


@pytest.mark.parametrize("step", [0.02, 0.1, 1.0])
def test_sampling_is_that_of_scipy(step):
    model = aircraft.sampled(step)
    expected = cont2discrete((A, np.hstack([B, VORTEX]), np.eye(11), np.zeros((11, 5))), step)
    assert np.allclose(model.A, expected[0], rtol=1e-12, atol=1e-13)
    assert np.allclose(np.hstack([model.B, model.vortex]), expected[1], rtol=1e-11, atol=1e-12)


# The tracker


def augmented():
    model = TRACKER.model
    selection = np.eye(11)[rows("y", "h", "u", "phi")]
    transition = np.block([[model.A, np.zeros((11, 4))], [0.1 * selection, np.eye(4)]])
    return transition, np.vstack([model.B, np.zeros((4, 4))])


def test_it_is_controllable_and_stable():
    """The rank is that of the modes, each alone: powers of A leave no digits."""
    transition, inputs = augmented()
    modes, size = np.linalg.eigvals(transition), np.linalg.norm(transition)
    for mode in modes:
        singular = np.linalg.svd(np.hstack([transition - mode * np.eye(15), inputs]), compute_uv=False)
        assert singular[-1] > 1e-9 * size
    assert len(modes) == 15
    assert np.abs(TRACKER.eigenvalues).max() == pytest.approx(0.9835, abs=5e-5)
    assert np.allclose(np.sort(np.abs(np.linalg.eigvals(TRACKER.closed))), np.sort(np.abs(TRACKER.eigenvalues)))


def test_its_gain_is_that_of_the_riccati_equation_of_scipy():
    transition, inputs = augmented()
    degree = np.pi / 180
    weights = {"u": 0.5, "phi": degree, "y": 0.5, "h": 0.5}
    Q = np.diag([weights.get(n, np.inf) ** -2.0 for n in aircraft.STATES] + [1 / 9] * 3 + [(5 * degree) ** -2])
    R = np.diag(np.array([3 * degree, 10 * degree, 5 * degree, 0.1]) ** -2.0)
    S = solve_discrete_are(transition, inputs, Q, R)
    gain = np.linalg.solve(R + inputs.T @ S @ inputs, inputs.T @ S @ transition)
    assert TRACKER.gain.shape == (4, 15)
    assert np.allclose(TRACKER.gain, gain, rtol=1e-6, atol=1e-8)
    assert np.allclose(TRACKER.closed, transition - inputs @ gain, atol=1e-8)


def test_a_command_is_followed_without_a_moment():
    start = aircraft.trimmed(TRACKER, 0.0)
    states, _, _ = flown(start, (1.0, -2.0), 120.0, lambda _: 0.0)
    assert np.allclose(states[-1, -2:], (1.0, -2.0), atol=1e-4)
    assert np.abs(states[-1, :-2]).max() < 1e-3


# Steady flight


def test_the_aileron_that_holds_a_moment():
    """8.4 deg for 0.01, five times that with ailerons alone."""
    held = aircraft.trimmed(TRACKER, 0.01)
    assert np.rad2deg(held.controls[1]) == pytest.approx(8.4, abs=0.05)
    weak = aircraft.tracker(roll_effectors=1.0)
    assert np.rad2deg(aircraft.trimmed(weak, 0.01).controls[1]) == pytest.approx(42.0, abs=0.5)


def test_steady_flight_stays_steady():
    position = MAP.best + np.array([-6.0, 5.0])
    start = aircraft.trimmed(TRACKER, MAP.evaluate(position)[1], position)
    assert np.allclose(start.state[-2:], position)
    assert np.allclose(start.state[rows("u", "phi", "p", "q", "r")], 0.0, atol=1e-12)
    states, controls, sums = flown(start, position, 30.0, lambda at: MAP.evaluate(at)[1])
    assert np.allclose(states, start.state, atol=1e-9)
    assert np.allclose(controls, start.controls, atol=1e-9)
    assert np.allclose(sums, start.sums, atol=1e-9)


def test_the_loop_in_the_wake_settles_at_the_minimum_in_the_trim_of_it():
    """What the command ends in does not depend on where it came from; aileron as published, 7.3 deg."""
    position = MAP.best + np.array([-3.0, 2.0])
    start = aircraft.trimmed(TRACKER, MAP.evaluate(position)[1], position)
    states, controls, sums = flown(start, MAP.best, 200.0, lambda at: MAP.evaluate(at)[1])
    end = aircraft.trimmed(TRACKER, MAP.evaluate(MAP.best)[1], MAP.best)
    assert np.allclose(states[-1], end.state, atol=1e-4)
    assert np.allclose(controls[-1], end.controls, atol=1e-4)
    assert np.allclose(sums, end.sums, atol=1e-3)
    assert np.rad2deg(controls[-1, 1]) == pytest.approx(7.3, rel=0.02)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: aircraft.sampled(0.0), "step"),
        (lambda: aircraft.tracker(np.nan), "step"),
        (lambda: aircraft.continuous(roll_effectors=-1.0), "roll_effectors"),
        (lambda: aircraft.trimmed(TRACKER, np.nan), "rolling_moment"),
        (lambda: aircraft.trimmed(TRACKER, "much"), "rolling_moment"),
        (lambda: aircraft.trimmed(TRACKER, np.zeros(2)), "rolling_moment"),
        (lambda: aircraft.trimmed(TRACKER, 0.01, (1.0,)), "position"),
        (lambda: aircraft.trimmed(TRACKER, 0.01, ("left", 1.0)), "position"),
        (lambda: aircraft.trimmed(TRACKER, 0.01, (1.0, np.inf)), "position"),
    ],
)
def test_what_does_not_fit_is_refused(call, words):
    with pytest.raises(co.ProblemError, match=words):
        call()


def test_matrices_are_read_only():
    for array in (A, B, VORTEX, TRACKER.gain, TRACKER.closed, aircraft.trimmed(TRACKER, 0.0).state):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
