"""The simulated system reads its instruments at their instants: both filters, other truths, laws of the user."""

from __future__ import annotations

from typing import ClassVar

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.base.errors import ProblemError


def mixed(at=(0.0, 0.7, 1.3, 3.0), every=0.65, noise=0.05):
    """A double integrator with an unknown force; a rate all the time, two instruments at instants."""
    ocp = co.Problem(3.0, "mixed")
    x = ocp.state("x", 2, initial=[1, 0], variance=np.array([[1.0, 0.2], [0.2, 0.5]]))
    b = ocp.unknown("b", 0.3, 0.2)
    u = ocp.control("u", guess=0.0)
    ocp.dynamics(x, ca.vertcat(x[1], -0.3 * x[1] + u + b), noise=[0, 0.1])
    ocp.measurement("rate", x[1], 0.5)
    ocp.measurement("both", x, np.array([[0.1, 0.05], [0.05, 0.2]]), at=at)
    ocp.measurement("sum", x[0] + b, noise, every=every)
    ocp.minimize_expected(x[0] ** 2 + 0.1 * u**2, 3 * x[1] ** 2)
    return ocp


@pytest.fixture(scope="module")
def solution():
    return co.solve(mixed(), intervals=30, progress=False)


@pytest.mark.parametrize("kind", ["perturbation", "extended"])
def test_runs_of_a_linear_system_are_as_predicted(solution, kind):
    sample = co.simulate(solution, 3000, 2, filter=kind, progress=False)
    assert sample.verdict.holds
    cost, error = sample.costs.mean(), sample.costs.std() / np.sqrt(sample.runs)
    assert abs(cost - solution.cost) < 3 * error
    spread = np.sqrt(np.diagonal(solution.loop.X[-1]))
    found = sample.deviations.std(axis=0)
    assert np.abs(found / spread - 1).max() < 4 / np.sqrt(2 * sample.runs)


def test_prediction_is_that_of_the_loop_before_and_after_each_reading(solution):
    sample = co.simulate(solution, 64, 1, store=300, progress=False)
    again = np.flatnonzero(np.diff(sample.t) == 0.0)
    assert again.size == len(solution.mesh.instants)
    for k in again:
        for row, side in ((k, "before"), (k + 1, "after")):
            E = solution.at(sample.t[k], side)["E"]
            assert np.abs(sample.predicted_error[row] - E).max() < 1e-5 * np.abs(E).max()
        assert np.allclose(sample.predicted[k], sample.predicted[k + 1], rtol=1e-9)


@pytest.mark.parametrize("truth", [{"b": 1.0}, "noisier"])
def test_another_truth_is_predicted_too(solution, truth):
    given = mixed(noise=0.5) if truth == "noisier" else truth
    sample = co.simulate(solution, 3000, 3, truth=given, progress=False)
    assert sample.verdict.holds
    if truth == "noisier":
        other = co.evaluate(solution, truth=given)
        assert other.cost > solution.cost
        assert abs(sample.costs.mean() - other.cost) < 3 * sample.costs.std() / np.sqrt(sample.runs)


def test_a_truth_is_read_at_the_instants_of_the_design(solution):
    with pytest.raises(ProblemError, match="other instants"):
        co.simulate(solution, 64, 1, truth=mixed(every=1.0), progress=False)
    with pytest.raises(ProblemError, match="another system"):
        co.evaluate(solution, truth=mixed(every=1.0))


def test_results_are_the_same_however_runs_are_divided(solution):
    one, two = (co.simulate(solution, 256, 5, batch=b, step=0.05, progress=False) for b in (64, 256))
    assert np.array_equal(one.deviations, two.deviations)


class Recorder:
    """A law that holds the nominal's mean control and notes what it is given."""

    period = 0.325
    seen: ClassVar[dict[float, np.ndarray]] = {}

    def step(self, measurement, time):
        Recorder.seen[round(time, 6)] = np.asarray(measurement)
        return np.zeros(1)


def test_a_law_is_given_what_was_read_since_its_last_step(solution):
    co.simulate(solution, 2, 1, law=Recorder(), progress=False)
    for time, row in Recorder.seen.items():
        assert row.size == 4
        assert np.isfinite(row[0]) == (time > 0)
        due = any(time - 0.325 + 1e-9 < t <= time + 1e-9 for t in (0.0, 0.7, 1.3, 3.0))
        assert np.isfinite(row[1:3]).all() == due, time
        whole = round(time / 0.65, 9)
        assert np.isfinite(row[3]) == (time > 0 and whole == int(whole)), time
