"""Mars entry: sample over prediction as in section 9.3 of the specification (3,000 runs of another program)."""

import numpy as np
import pytest

import covocp as co
from covocp.models import mars_entry
from covocp.simulation.runs import simulate

RUNS = 3000
# Of normal runs; the standard error of the ratio of another program's 3,000 runs is 0.013.
NORMAL_RUNS = 1500
ERROR = 3 * np.sqrt(0.013**2 + 1 / (2 * NORMAL_RUNS))
COMPONENTS = ("h", "theta", "v", "gamma")


def ratios(sample):
    return np.array([sample.deviation(key)[-1] / sample.predicted_deviation(key)[-1] for key in COMPONENTS])


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("constant", (0.993, 1.025, 0.991, 0.994)), ("regularised", (0.993, 1.022, 0.997, 1.007))],
)
def test_linear_theory_holds_for_the_smooth_designs(kind, expected):
    problem = mars_entry.problem()
    if kind == "constant":
        solution = co.evaluate(problem, nominal=mars_entry.reference(), intervals=183)
    else:
        solution = co.solve(problem, intervals=183, progress=False)
    sample = simulate(solution, NORMAL_RUNS, 1, step=0.5, store=11, progress=False)
    np.testing.assert_allclose(ratios(sample), expected, atol=ERROR)
    assert sample.verdict.holds
    assert sample.asked_share == 0.0
    assert sample.left_share == 0.0
    assert abs(sample.cost - solution.cost) < 3 * sample.cost_error


def test_linear_theory_fails_for_the_bang_bang_design_and_says_why():
    problem = mars_entry.problem(regularization=None)
    solution = co.solve(problem, intervals=183, guess={"lift_to_drag": mars_entry.bang_bang}, progress=False)
    assert solution.cost <= 3.51e-4  # section 7.2
    assert "no classical design to compare with" in str(solution)  # without noise the cost depends on nothing
    sample = simulate(solution, RUNS, 1, step=0.5, store=62, progress=False)
    found = ratios(sample)
    # These runs have heavy tails: each ratio is as uncertain as the sample's own band says, in both programs.
    error = np.sqrt(2) * np.array([(e.high - e.low) / (2 * e.sample) for e in sample.verdict.deviations[:4]])
    assert (error < 0.13).all()
    assert (np.abs(found / (1.010, 1.648, 0.954, 1.137) - 1) < error).all()
    assert not sample.verdict.holds
    assert "theta" in sample.verdict.outside
    assert sample.verdict.reasons == ("saturated",)
    assert "more control than there is" in str(sample)
    assert sample.asked_share > 0.9
    assert sample.asking.max() > 0.6
    # What it asks for is not there: within the bounds of the problem the spread is another one.
    limited = simulate(solution, 500, 1, step=1.0, store=11, limits="bounds", progress=False)
    assert limited.outside_share["lift_to_drag"] == 0.0
    assert not limited.verdict.holds


def test_another_atmosphere_is_another_truth():
    solution = co.evaluate(mars_entry.problem(), nominal=mars_entry.reference(), intervals=61)
    sample = simulate(solution, 200, 1, step=2.0, store=11, truth=mars_entry.truth("high"), progress=False)
    assert "high atmosphere" in sample.truth
    # The density starts many of the design's standard deviations away, and the filter finds that out.
    assert abs(sample.bias("log_density")[0]) > 3 * np.sqrt(sample.design[0, 4, 4])
    assert not sample.verdict.holds
    assert np.isfinite(sample.deviations).all()
