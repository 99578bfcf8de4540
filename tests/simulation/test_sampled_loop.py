"""Plant at a fast rate, law at a slow one: against loops written out, and reproducible."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp import ProblemError

STEP, PERIOD = 0.5, 2.0


def parts(noise=0.0, shift=0.0):
    """A lag that follows what is held, its position measured, and a law that remembers the sum of what it was given."""
    x, held, t, w = ca.SX.sym("x"), ca.SX.sym("held"), ca.SX.sym("t"), ca.SX.sym("w")
    plant = ca.Function("plant", [x, held, t, w], [0.9 * x + 0.1 * held + 0.01 * ca.sin(t) + noise * w])
    sensor = ca.Function("sensor", [x, t, w], [ca.vertcat(x, x**2 + t + noise * w)])
    memory, measured = ca.SX.sym("memory", 2), ca.SX.sym("measured", 2)
    new = memory + measured
    law = ca.Function("law", [memory, measured, t], [new, -0.1 * new[0] + 0.01 * t + shift])
    return plant, sensor, law


def simulated(*, functions=None, **changes):
    plant, sensor, law = functions or parts()
    given = {"initial": [1.0], "memory": [0.0, 0.0], "step": STEP, "period": PERIOD, "duration": 8.0} | changes
    return co.simulate_sampled(plant, sensor, law, **given)


@pytest.mark.parametrize("average", [True, False])
def test_against_a_loop_written_out(average):
    """Without noise: state, held value, means and memories at every time."""
    found = simulated(average=average, held=0.3)
    x, held, memory, t = 1.0, 0.3, np.zeros(2), 0.0
    states, holds, memories, measured = [x], [held], [], []
    for _ in range(4):
        readings = []
        for _ in range(4):
            x = 0.9 * x + 0.1 * held + 0.01 * np.sin(t)
            t += STEP
            readings.append([x, x**2 + t])
            states.append(x)
            holds.append(held)
        measured.append(np.mean(readings, axis=0) if average else np.array(readings[-1]))
        memory = memory + measured[-1]
        memories.append(memory)
        held = -0.1 * memory[0] + 0.01 * t
    np.testing.assert_allclose(found.t, STEP * np.arange(17), rtol=1e-14)
    np.testing.assert_allclose(found.x[0, :, 0], states, rtol=1e-13)
    np.testing.assert_allclose(found.held[0, :, 0], holds, rtol=1e-13)
    np.testing.assert_allclose(found.samples, [2.0, 4.0, 6.0, 8.0])
    np.testing.assert_allclose(found.measured[0], measured, rtol=1e-13)
    np.testing.assert_allclose(found.memory[0], memories, rtol=1e-13)
    thinned = simulated(average=average, held=0.3, every=4)
    np.testing.assert_array_equal(thinned.x[0], found.x[0, ::4])
    assert not found.diverged.any()


def test_a_run_is_the_same_whatever_the_number_of_runs():
    few, many = (simulated(functions=parts(0.1), runs=runs, seed=7) for runs in (3, 130))
    for name in ("x", "held", "measured", "memory"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name)[:3])
    other = simulated(functions=parts(0.1), runs=3, seed=8)
    assert np.abs(other.x[:, 1:] - few.x[:, 1:]).min() > 0.0


def test_noise_has_variance_one_and_is_independent():
    """A random walk of 400 runs: mean square of the increments, and of their products in time and between runs."""
    x, held, t, w, none = (ca.SX.sym(name, size) for name, size in zip("xhtwn", (1, 1, 1, 1, 0), strict=True))
    plant = ca.Function("plant", [x, held, t, w], [x + w])
    sensor = ca.Function("sensor", [x, t, none], [x])
    law = ca.Function("law", [held, x, t], [held, held])
    found = co.simulate_sampled(
        plant, sensor, law, initial=[0.0], memory=[0.0], step=1.0, period=10.0, duration=100.0, runs=400, seed=3
    )
    shocks = np.diff(found.x[..., 0], axis=1)
    count = shocks.size
    assert abs(np.mean(shocks)) < 4 / np.sqrt(count)
    assert abs(np.mean(shocks**2) - 1.0) < 4 * np.sqrt(2.0 / count)
    assert abs(np.mean(shocks[:, 1:] * shocks[:, :-1])) < 4 / np.sqrt(count)
    assert abs(np.mean(shocks[1:] * shocks[:-1])) < 4 / np.sqrt(count)


def test_python_laws_and_starts_of_each_run():
    starts = np.array([[1.0], [2.0], [-3.0]])
    plant, sensor, law = parts(0.2)

    def python(memory, measured, time):
        new = memory + measured
        return new, -0.1 * new[0] + 0.01 * time

    symbolic = simulated(functions=(plant, sensor, law), runs=3, initial=starts)
    written = simulated(functions=(plant, sensor, python), runs=3, initial=starts)
    np.testing.assert_allclose(written.x, symbolic.x, rtol=1e-12)
    np.testing.assert_array_equal(symbolic.x[:, 0], starts)


def test_runs_that_diverge_are_told_and_leave_the_others_alone():
    plant, sensor, _ = parts()
    memory, measured, t = ca.SX.sym("memory", 2), ca.SX.sym("measured", 2), ca.SX.sym("t")
    wild = ca.if_else(measured[0] > 2.0, 1e6 * measured[0], 0.0)
    law = ca.Function("law", [memory, measured, t], [memory, wild])
    found = simulated(functions=(plant, sensor, law), runs=2, initial=[[1.0], [50.0]])
    np.testing.assert_array_equal(found.diverged, [False, True])
    assert np.isnan(found.x[1, -1]).all()
    np.testing.assert_array_equal(found.x[0], simulated(functions=(plant, sensor, law)).x[0])


@pytest.mark.parametrize(
    ("changes", "argument"),
    [
        ({"initial": [1.0, 2.0]}, "'initial'"),
        ({"initial": [np.nan]}, "'initial'"),
        ({"memory": [0.0]}, "'law'"),
        ({"memory": [0.0, np.inf]}, "'memory'"),
        ({"held": [0.0, 1.0]}, "'held'"),
        ({"step": 0.0}, "'step'"),
        ({"period": 1.7}, "'period'"),
        ({"period": 0.1}, "'period'"),
        ({"duration": 7.0}, "'duration'"),
        ({"runs": 0}, "'runs'"),
        ({"seed": -1}, "'seed'"),
        ({"every": 0}, "'every'"),
        ({"average": "yes"}, "'average'"),
    ],
)
def test_wrong_arguments_are_named(changes, argument):
    with pytest.raises(ProblemError, match=argument):
        simulated(**changes)


def test_wrong_functions_are_named():
    plant, sensor, law = parts()
    x, t = ca.SX.sym("x"), ca.SX.sym("t")
    two = ca.Function("two", [x, t], [x])
    for functions, name in (
        ((two, sensor, law), "'plant'"),
        ((plant, two, law), "'sensor'"),
        ((plant, sensor, two), "'law'"),
        ((plant, sensor, 3), "'law'"),
        ((plant, sensor, lambda memory, measured, time: memory), "law does not return"),
        ((plant, sensor, lambda memory, measured, time: (memory, [1.0, 2.0])), "law does not return"),
    ):
        with pytest.raises(ProblemError, match=name):
            simulated(functions=functions)


def test_readings_inside_a_period():
    """The law gets the last measurement, `reading` all before it, each with its time; nothing is averaged."""
    plant, sensor, law = parts(noise=0.1)
    memory, measured, t = ca.SX.sym("memory", 2), ca.SX.sym("measured", 2), ca.SX.sym("t")
    reading = ca.Function("reading", [memory, measured, t], [0.5 * memory + measured * t])
    found = simulated(functions=(plant, sensor, law), reading=reading, runs=3, average=True)
    single = simulated(functions=(plant, sensor, law), runs=3, average=False)
    np.testing.assert_array_equal(found.measured[:, 0], single.measured[:, 0])
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(0, spawn_key=(1,))))
    shocks, x, expected = generator.standard_normal((4, 2)), 1.0, np.zeros(2)
    for j in range(4):
        x = 0.9 * x + 0.01 * np.sin(STEP * j) + 0.1 * shocks[j, 0]
        seen = np.array([x, x**2 + STEP * (j + 1) + 0.1 * shocks[j, 1]])
        expected = 0.5 * expected + seen * STEP * (j + 1) if j < 3 else expected + seen
    np.testing.assert_allclose(found.memory[1, 0], expected, rtol=1e-12)


def test_readings_that_do_not_fit_are_named():
    memory, measured, t = ca.SX.sym("memory", 2), ca.SX.sym("measured", 3), ca.SX.sym("t")
    for wrong in (ca.Function("reading", [memory, measured, t], [memory]), lambda *given: given[0], 3):
        with pytest.raises(ProblemError, match="'reading'"):
            simulated(reading=wrong)


def test_a_run_that_falls_from_far_away_has_not_diverged():
    plant, sensor, law = parts()
    memory, measured, t = ca.SX.sym("memory", 2), ca.SX.sym("measured", 2), ca.SX.sym("t")
    idle = ca.Function("law", [memory, measured, t], [memory, 0.0])
    found = simulated(functions=(plant, sensor, idle), runs=3, initial=[[1.0], [5e13], [1e40]])
    assert not found.diverged.any()
    np.testing.assert_allclose(found.x[1:, -1, 0], np.array([5e13, 1e40]) * 0.9**16, rtol=1e-10)
