"""Formation flight by peak seeking: what section 1.8.4 of the specification says of 40 runs, and of literal choices."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from covocp import ProblemError
from covocp.models import formation_flight
from covocp.models.formation import aircraft
from covocp.models.formation.drag_map import drag_map
from covocp.models.formation.flight_figure import differences


@pytest.fixture(scope="module")
def runs():
    return formation_flight.simulate()


def test_the_benefit_is_found(runs):
    assert not runs.lost.any()
    middle, end = runs.gap_at(300.0), runs.gap_at(420.0)
    assert np.median(middle) <= 0.03
    assert np.mean(middle < 0.10) >= 0.95
    assert np.median(end) <= 0.015
    assert np.all(end < 0.05)


def test_the_aircraft_stays_calm(runs):
    assert np.abs(runs.tracking_error).max() <= 0.8
    assert np.degrees(np.abs(runs.angles)).max() < 1.0
    elevator, aileron, rudder = np.degrees(np.abs(runs.controls[..., :3])).max(axis=(0, 1))
    assert elevator < 1.0
    assert 7.0 < aileron < 10.0
    assert rudder < 1.5
    final = np.degrees(runs.controls[:, -1, 1])
    assert np.median(final) == pytest.approx(7.3, abs=0.5)


# Start, and the share that misses less than 0.10 at 300 s; 0.95 miss less than 0.05 at 420 s: section 1.8.4.
STARTS = {(-8.0, 3.0): 1.00, (-4.0, 8.0): 0.75, (-10.0, 6.0): 0.85, (6.0, 5.0): 1.00}


@pytest.mark.parametrize("start", STARTS)
def test_other_starts(start):
    """At least the shares of the specification, to 0.1: from (-4, 8) more arrive than there."""
    found = formation_flight.simulate(start)
    assert not found.lost.any()
    assert np.mean(found.gap_at(300.0) < 0.10) >= STARTS[start] - 0.1
    assert np.mean(found.gap_at(420.0) < 0.05) >= 0.85


def test_literal_choices_fail():
    """The paper's command filter loses all; plain Newton steps without a limit about half."""
    printed = formation_flight.simulate(runs=12, settings="printed")
    assert printed.lost.mean() == 1.0
    fast = formation_flight.simulate(runs=10, command_gain=10.0)
    assert fast.lost.mean() >= 0.9
    plain = formation_flight.simulate(runs=40, settings="printed", command_gain=1.0, transport=True)
    assert 0.3 < plain.lost.mean() < 0.8


def test_excitation_of_three_radians_a_second_shakes_the_aircraft():
    shaken = formation_flight.simulate(runs=10, turn=2 * np.pi / 3)
    assert not shaken.lost.any()
    assert np.abs(shaken.tracking_error).max() > 1.0
    still = formation_flight.simulate(runs=10, radius=0.0)
    assert not still.lost.any()


def test_histories_are_those_of_the_model(runs):
    """The flight repeated with the model's own matrices: states from the recorded controls, drag from the map."""
    assert runs.position.shape == runs.command.shape == (40, runs.t.size, 2)
    assert runs.benefit_gap.shape == (40, runs.t.size)
    assert runs.angles.shape == (40, runs.t.size, 3)
    np.testing.assert_allclose(runs.position[:, 0], [[-6.0, 5.0]] * 40, atol=1e-9)
    np.testing.assert_allclose(runs.tracking_error[:, 0], 0.0, atol=1e-9)
    field = drag_map()
    drag, _ = field.evaluate(runs.position + field.best)
    np.testing.assert_allclose(runs.drag, drag, rtol=1e-12)
    # what was measured is the mean of positions over a period, sampled twice a second here
    inner = runs.position[:, 1:21].mean(axis=1) + field.best
    np.testing.assert_allclose(runs.measured[:, 0, :2], inner, atol=0.02)
    tracker = aircraft.tracker()
    assert np.abs(tracker.eigenvalues).max() == pytest.approx(0.9835, abs=5e-5)


def test_estimates_before_seeking(runs):
    """Circles of 0.7 m: the gradient is known to 2 counts/m by 120 s, the Hessian hardly at all (section 1.8.4)."""
    index = int(np.searchsorted(runs.samples, 120.0))
    gradient, _ = differences(runs, runs.measured[0, [index], :2])
    error = runs.estimate.gradient[:, index] - gradient[0]
    assert np.sqrt(np.mean(error**2)) < 2.5
    assert runs.estimate.hessian_deviation[:, index, 0, 0].min() > 3.0


def test_result_prints_and_draws(runs, tmp_path):
    assert "40 runs of 420 s, 0 lost" in str(runs)
    plt.close(runs.plot(tmp_path / "flight.png"))
    assert (tmp_path / "flight.png").stat().st_size > 50_000


def test_run_i_is_the_same_whatever_the_number(runs):
    few = formation_flight.simulate(runs=2, duration=200.0)
    np.testing.assert_array_equal(few.position, runs.position[:2, : few.t.size])


def test_wrong_arguments_are_named():
    for arguments, name in (
        ({"settings": "best"}, "'settings'"),
        ({"start": 3.0}, "'start'"),
        ({"start": (np.nan, 1.0)}, "'start'"),
        ({"duration": 15.0}, "'duration'"),
        ({"runs": 0}, "'runs'"),
        ({"turn": 0.0}, "'turn'"),
        ({"radius": -1.0}, "'radius'"),
        ({"command_gain": 0.0}, "'command_gain'"),
        ({"window": 3}, "'window'"),
    ):
        with pytest.raises(ProblemError, match=name):
            formation_flight.simulate(**arguments)
