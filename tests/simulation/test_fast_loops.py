"""Runs with noise of loops that are faster than the given step: variances in closed form, whatever the rate."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from covocp.base.errors import CovocpWarning
from covocp.simulation.laws import extended_filter, gain_filter, simulate_law

X, U, T = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("t")
NOTHING = ca.Function("law", [X, T], [0.0 * X])
RUNS = 20_000
# Four standard deviations of a variance of so many runs.
SPREAD = 4.0 * np.sqrt(2.0 / RUNS)


def lag(rate: float) -> ca.Function:
    return ca.Function("plant", [X, U], [-rate * X + U])


@pytest.mark.parametrize("rate", [1.0, 100.0, 250.0, 300.0, 3000.0])
def test_a_fast_lag_has_the_variance_of_its_rate(rate):
    run = simulate_law(
        lag(rate), NOTHING, initial=[0.0], duration=10.0 / rate, samples=3, runs=RUNS, process_noise=1.0, seed=1
    )
    assert run.x[:, -1, 0].var() * 2.0 * rate == pytest.approx(1.0, abs=SPREAD)


@pytest.mark.parametrize("noise", [1e-2, 1e-4, 1e-6])
def test_a_filter_with_an_accurate_sensor_has_the_error_of_its_riccati_equation(noise):
    """p^2 / r + 2 p = 1 for x' = -x with noise of density 1."""
    variance = noise * (np.sqrt(1.0 + 1.0 / noise) - 1.0)
    gain = ca.Function("gain", [X, T], [ca.DM(variance / noise)])
    observer = gain_filter(lag(1.0), gain, [[1.0]], [0.0])
    run = simulate_law(
        lag(1.0),
        NOTHING,
        initial=[0.0],
        duration=20.0 * noise / variance,
        samples=2,
        runs=RUNS,
        observer=observer,
        process_noise=1.0,
        measurement_noise=noise,
        seed=2,
    )
    error = run.x[:, -1, 0] - run.filter_state[:, -1, 0]
    assert error.var() / variance == pytest.approx(1.0, abs=SPREAD)


def test_a_filter_that_is_fast_at_first_alone_takes_short_steps_there_alone():
    noise = 1e-4
    observer = extended_filter(lag(1.0), [[1.0]], 1.0, noise, [0.0], 1e8)
    run = simulate_law(
        lag(1.0),
        NOTHING,
        initial=[0.0],
        duration=0.5,
        samples=11,
        runs=2000,
        observer=observer,
        process_noise=1.0,
        measurement_noise=noise,
    )
    variance = noise * (np.sqrt(1.0 + 1.0 / noise) - 1.0)
    assert run.filter_state[:, -1, 1] == pytest.approx(variance, rel=1e-3)
    error = run.x[:, -1, 0] - run.filter_state[:, -1, 0]
    assert error.var() / variance == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 2000))


def test_what_is_too_fast_for_any_number_of_steps_is_told():
    with pytest.warns(CovocpWarning, match=r"rates of 1e\+08 per s"):
        simulate_law(lag(1e8), NOTHING, initial=[0.0], duration=1.0, samples=3, runs=2, process_noise=1.0)


@pytest.mark.parametrize("samples", [3, 11, 401])
def test_runs_with_noise_end_their_steps_where_the_law_jumps(samples):
    """x' = u with u = 1000 between two breaks and 1 from a third one on."""
    breaks = [0.5037, 0.5087, 0.7011]
    pulse = ca.if_else(ca.logic_and(breaks[0] <= T, breaks[1] > T), 1000.0, 0.0) + ca.if_else(breaks[2] <= T, 1.0, 0.0)
    law = ca.Function("law", [X, T], [pulse])
    plant = ca.Function("plant", [X, U], [U])
    run = simulate_law(plant, law, initial=[0.0], duration=1.0, samples=samples, breaks=breaks, runs=2)
    assert run.x[:, -1, 0] == pytest.approx(1000.0 * (breaks[1] - breaks[0]) + 1.0 - breaks[2], rel=1e-7)
