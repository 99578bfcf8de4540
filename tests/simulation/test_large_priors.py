"""Priors that are larger than what is left of them by many orders of magnitude: filters as they are flown."""

import numpy as np
import pytest
from scipy.linalg import expm

import covocp as co

PRIOR, DENSITY = 1e9, 1e-10
DURATION, DECAY = 10.0, 0.5


def started(noise, *, fed_back=True, blind=False):
    """x' = -x/2 + u from a prior of 1e9, with an accurate sensor; `blind`: beside a constant that nothing measures."""
    ocp = co.Problem(DURATION)
    x = ocp.state("x", initial=0.0, variance=PRIOR)
    if blind:
        ocp.unknown("b", mean=0.0, variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, -DECAY * x + u, noise=DENSITY)
    ocp.measurement("m", x, noise=noise)
    if fed_back:
        ocp.minimize_expected(running=0.5 * u**2 + x**2)
    else:
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2 + (x - 1.0) ** 2, terminal=1e-6 * E[x, x])
    return ocp


def riccati(noise, t):
    """E(t) of E' = -2 a E + q - E^2 / r from the linear equations of its numerator and denominator."""
    both = expm(np.array([[DECAY, 1.0 / noise], [DENSITY, -DECAY]]) * t) @ [1.0, PRIOR]
    return both[1] / both[0]


@pytest.mark.filterwarnings("ignore:The mesh is too coarse")  # of the cost of the filter's own transient
@pytest.mark.parametrize("blind", [False, True])
@pytest.mark.parametrize("noise", [1e-2, 1e-3, 1e-4, 1e-5])
def test_covariance_between_nodes_keeps_its_relative_accuracy(noise, blind):
    """What the variance was at first says nothing of how accurate it has to be when it is less by 10^18."""
    solution = co.evaluate(started(noise, blind=blind), nominal={"u": 0.0}, intervals=50)
    times = np.concatenate([np.geomspace(1e-9, DURATION, 300), np.linspace(0.01, DURATION, 400)])
    found = solution.at(times)["E"].reshape(times.size, -1)[:, 0]
    np.testing.assert_allclose(found, [riccati(noise, t) for t in times], rtol=5e-3)


@pytest.mark.filterwarnings("ignore:The mesh is too coarse")
@pytest.mark.parametrize("noise", [1e-2, 1e-3, 1e-4, 1e-5])
def test_closed_loop_with_a_large_prior_is_predicted_and_flown_right(noise):
    """The filter's error at the end is sqrt(E(T)), in the prediction and, by its sampling error, in the runs."""
    solution = co.solve(started(noise), intervals=50, progress=False)
    runs = co.simulate(solution, runs=500, seed=1, progress=False)
    truth = np.sqrt(riccati(noise, DURATION))
    assert runs.verdict.holds, str(runs.verdict)
    assert float(np.sqrt(runs.error_covariance("x")[-1]).squeeze()) == pytest.approx(truth, rel=4 / np.sqrt(2 * 500))
    assert runs.predicted_deviation("x")[-1] == pytest.approx(solution.deviation("x")[-1], rel=1e-3)


def test_filter_alone_with_a_large_prior():
    """Without feedback the deviation is that of the plant: e^(-a T) times the prior."""
    solution = co.solve(started(1e-4, fed_back=False), intervals=50, progress=False)
    runs = co.simulate(solution, runs=500, seed=1, progress=False)
    assert runs.verdict.holds, str(runs.verdict)
    assert runs.predicted_deviation("x")[-1] == pytest.approx(np.exp(-DECAY * DURATION) * np.sqrt(PRIOR), rel=1e-3)
