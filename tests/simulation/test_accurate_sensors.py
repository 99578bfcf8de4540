"""Filters that begin with a large variance and an accurate sensor: faster at the start by orders of magnitude."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import covocp as co

POSITION, SPEED, BIAS, RESTLESS, SENSOR, DURATION = 1e4, 1.0, 1e6, 1e-4, 1e-9, 20.0


def accurate() -> co.Problem:
    """A mass with an unknown force and an accurate position: the first gain is 1e13 / s."""
    ocp = co.Problem(DURATION, name="accurate")
    x = ocp.state("x", initial=0.0, final=5.0, variance=POSITION)
    v = ocp.state("v", initial=0.0, final=0.0, variance=SPEED)
    b = ocp.unknown("b", mean=0.0, variance=BIAS)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u + b, noise=RESTLESS)
    ocp.measurement("position", x, noise=SENSOR)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 10, v: 10})
    return ocp


def filtered() -> np.ndarray:
    """Covariance of the filter at the end: the Riccati equation by its Hamiltonian matrix, over times that double."""
    F = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    information, noise = np.diag([1.0 / SENSOR, 0.0, 0.0]), np.diag([0.0, RESTLESS, 0.0])
    E, t, h = np.diag([POSITION, SPEED, BIAS]), 0.0, 1e-13
    while t < DURATION:
        h = min(h, DURATION - t)
        moves = expm(h * np.block([[-F.T, information], [noise, F]]))
        E = (moves[3:, :3] + moves[3:, 3:] @ E) @ np.linalg.inv(moves[:3, :3] + moves[:3, 3:] @ E)
        E, t, h = 0.5 * (E + E.T), t + h, min(2.0 * h, 1e-3)
    return E


@pytest.mark.parametrize("step", [None, 0.01])
def test_a_filter_with_a_fast_start_is_predicted_and_simulated(step):
    """1.7e7 steps of 1e-14 s were called too many, whatever step= was given."""
    solution = co.solve(accurate(), progress=False)
    runs = co.simulate(solution, runs=500, seed=1, step=step, progress=False)
    expected = np.sqrt(np.diag(filtered()))
    np.testing.assert_allclose(np.sqrt(np.diag(runs.predicted_error[-1])), expected, rtol=1e-4)
    deviations = [solution.deviation(name)[-1] for name in ("x", "v")]
    np.testing.assert_allclose(np.sqrt(np.diag(runs.predicted[-1])[:2]), deviations, rtol=1e-3)
    assert runs.verdict.holds


def test_steps_that_are_too_many_are_refused_by_what_helps():
    solution = co.solve(accurate(), progress=False)
    with pytest.raises(co.ProblemError, match="give a longer step=, or leave it out"):
        co.simulate(solution, runs=10, seed=1, step=1e-9, progress=False)


def test_a_covariance_is_known_within_a_transient_that_no_interval_shows():
    """E = 1 / (1/P + t/R): its rate at the start made the fall from 1e9 to 1e-9 count as no change."""
    ocp = co.Problem(10.0, name="constant")
    x, b, u = ocp.state("x", initial=0.0, final=1.0), ocp.unknown("b", mean=0.0, variance=1e9), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.measurement("raw", b, noise=1e-10)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[b, b])
    solution = co.solve(ocp, progress=False)
    t = np.geomspace(1e-13, 1e-2, 23)
    np.testing.assert_allclose(solution.at(t)["E"][:, 1, 1], 1.0 / (1e-9 + t / 1e-10), rtol=0.02, atol=1e-11 * 1e9)
