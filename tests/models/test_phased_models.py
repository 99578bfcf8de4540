"""Models in phases against published values, and against integrations of their equations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co
from covocp.models import goddard_rocket, launch_vehicle


def test_goddard_rocket_in_three_phases() -> None:
    """The arcs one after the other, integrated to events in test_closed_forms.py, have this height and these times."""
    solution = co.solve(goddard_rocket.phases(), intervals=40, progress=False)
    assert solution.cost == pytest.approx(-1.01283, abs=1e-5)  # published, five decimals
    assert solution.cost == pytest.approx(-1.0128369183, abs=1e-7)
    np.testing.assert_allclose(np.cumsum(solution.durations), [0.0235097, 0.0726707, 0.1988563], rtol=2e-2)
    for phase in solution:
        assert phase.optimality.transversality < 1e-4
    assert max(solution.link_residuals) < 1e-6


@pytest.fixture(scope="module")
def ascent() -> co.PhasesSolution:
    return co.solve(launch_vehicle.phases(), intervals=20, progress=False)


def test_the_launch_vehicle_brings_the_published_mass_into_orbit(ascent: co.PhasesSolution) -> None:
    assert 1e3 * ascent["second stage"]["m"][-1] == pytest.approx(7529.712412, rel=3e-7)
    assert ascent.duration == pytest.approx(924.139, abs=1e-3)
    assert "tried" not in ascent.stats  # from its first start


def test_the_second_stage_is_guessed_to_fly_above_the_ground() -> None:
    positions, speeds = launch_vehicle._way_to_perigee()
    heights = np.linalg.norm(positions, axis=1) - launch_vehicle.RADIUS
    assert heights.min() > 100.0
    momentum, eccentricity = launch_vehicle.target()
    np.testing.assert_allclose(positions[-1], 24361.14 * (1 - 0.7308) * eccentricity / 0.7308, rtol=1e-9)
    assert np.linalg.norm(speeds[-1]) == pytest.approx(np.linalg.norm(momentum) / np.linalg.norm(positions[-1]))


def test_the_launch_vehicle_ends_in_its_orbit(ascent: co.PhasesSolution) -> None:
    r, v = ascent[-1]["r"][-1], ascent[-1]["v"][-1]
    mu = 398601.2
    h = np.cross(r, v)
    node = np.cross([0.0, 0.0, 1.0], h)
    e = np.cross(v, h) / mu - r / np.linalg.norm(r)
    perigee = np.arccos(node @ e / np.linalg.norm(node) / np.linalg.norm(e))
    found = [
        1.0 / (2.0 / np.linalg.norm(r) - v @ v / mu),
        np.linalg.norm(e),
        np.rad2deg(np.arccos(h[2] / np.linalg.norm(h))),
        np.rad2deg(np.arctan2(node[1], node[0])) % 360.0,
        np.rad2deg(perigee if e[2] > 0 else 2.0 * np.pi - perigee),
    ]
    np.testing.assert_allclose(found, [24361.14, 0.7308, 28.5, 269.8, 130.5], rtol=1e-6)


def test_the_launch_vehicle_flies_as_its_published_equations_say(ascent: co.PhasesSolution) -> None:
    """In metres and kilograms, from the published table, along the directions that were found."""
    table = [(6 * 628500.0 + 1083100.0, 6 * 17010.0 / 75.2 + 95550.0 / 261.0, 6 * 2280.0)]
    table += [(3 * 628500.0 + 1083100.0, 3 * 17010.0 / 75.2 + 95550.0 / 261.0, 3 * 2280.0)]
    table += [(1083100.0, 95550.0 / 261.0, 8830.0), (110094.0, 16820.0 / 700.0, 0.0)]
    latitude = np.deg2rad(28.5)
    start = 6378145.0 * np.array([np.cos(latitude), 0.0, np.sin(latitude)])
    spin = np.array([0.0, 0.0, 7.29211585e-5])
    z = np.concatenate([start, np.cross(spin, start), [9 * 19290.0 + 104380.0 + 19300.0 + 4164.0]])
    for phase, (thrust, flow, dropped) in zip(ascent, table, strict=True):

        def rate(t: float, z: np.ndarray, phase=phase, thrust=thrust, flow=flow) -> np.ndarray:
            r, v, m = z[:3], z[3:6], z[6]
            u = phase.controls_at(np.array([min(t, phase.duration)]))[0]
            wind = v - np.cross(spin, r)
            density = 1.225 * np.exp(-(np.linalg.norm(r) - 6378145.0) / 7200.0)
            drag = 0.5 * density * 0.5 * 4.0 * np.pi * np.linalg.norm(wind) * wind
            gravity = -3.986012e14 * r / np.linalg.norm(r) ** 3
            return np.concatenate([v, gravity + (thrust * u / np.linalg.norm(u) - drag) / m, [-flow]])

        z = solve_ivp(rate, (0.0, phase.duration), z, rtol=1e-9, atol=1e-6, max_step=phase.duration / 20).y[:, -1]
        np.testing.assert_allclose(z[:3], 1e3 * phase["r"][-1], rtol=0, atol=20.0)
        np.testing.assert_allclose(z[6], 1e3 * phase["m"][-1], rtol=1e-9)
        z[6] -= dropped
