"""What curved rates do to the mean of a loop and to its cost: against exact second derivatives and simulated runs."""

import nonlinear_loop
import numpy as np
import pytest
from loops import linear_quadratic
from scipy.integrate import solve_ivp

import covocp as co
from covocp.simulation.runs import simulate


def bent(variance, **options):
    """A rate that bends, nothing measured, nothing disturbed but the start: the cost is that of x(0) alone."""
    problem = co.Problem(duration=2.0, name="bent")
    x, u = problem.state("x", initial=1.0, variance=variance), problem.control("u")
    problem.dynamics(x, -0.5 * x**2 + 0.3 * u * x + u)
    problem.minimize_expected(running=0.5 * u**2 + 0.2 * x**3, terminal=x**4 / 4)
    return co.solve(problem, intervals=80, progress=False, **options)


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_cost_and_effect_are_the_second_derivative_by_the_start(control):
    """<J> = J + v/2 J''(x(0)) along the given control, to second order: the cost alone is not, cost and effect are."""
    variance, step = 1e-3, 1e-3
    solution = bent(variance, control=control)

    def cost(start):
        z = np.array([start, 0.0])
        for a, b in zip(solution.t[:-1], solution.t[1:], strict=True):
            first, last = (float(solution.at(t)["u"]) for t in (a + 1e-9, b - 1e-9))

            def rate(t, z, a=a, b=b, first=first, last=last):
                u = first + (last - first) * (t - a) / (b - a)
                return [-0.5 * z[0] ** 2 + 0.3 * u * z[0] + u, 0.5 * u**2 + 0.2 * z[0] ** 3]

            z = solve_ivp(rate, (a, b), z, rtol=1e-11, atol=1e-13).y[:, -1]
        return z[1] + z[0] ** 4 / 4, z[0]

    (low, x_low), (middle, x), (high, x_high) = (cost(1.0 + d) for d in (-step, 0.0, step))
    exact = variance / 2 * (low - 2 * middle + high) / step**2
    effect = solution.mean_effect
    linear = solution.loop.cost["deviations at the end"] + solution.loop.cost["deviations on the way"]
    assert abs(effect.cost) > 0.1 * exact
    assert linear + effect.cost == pytest.approx(exact, rel=2e-3)
    assert effect.mean[-1, 0] == pytest.approx(variance / 2 * (x_low - 2 * x + x_high) / step**2, rel=2e-3)
    assert "not in the cost" in str(solution)


def test_a_linear_loop_has_none():
    solution = co.solve(linear_quadratic(), intervals=20, progress=False)
    assert abs(solution.mean_effect.cost) < 1e-14
    assert "not in the cost" not in str(solution)


def test_the_mean_of_simulated_runs_is_the_predicted_one():
    """Feedback, an unknown, noise that depends on state and control, a measurement that bends: 20,000 runs."""
    scale = 0.1
    spread = {"variance": scale * nonlinear_loop.VARIANCE, "noise": scale}
    noise = scale * nonlinear_loop.MEASUREMENT_NOISE
    solution = co.solve(nonlinear_loop.problem(**spread, measurement_noise=noise), intervals=60, progress=False)
    sample, effect = simulate(solution, 20_000, 1, progress=False), solution.mean_effect
    for found, predicted in ((sample.deviations, effect.mean[-1]), (sample.estimates, effect.estimate[-1])):
        error = found.std(axis=0) / np.sqrt(sample.runs)
        # Of the fourth order, what is left out is about a tenth of what is found.
        assert (np.abs(found.mean(axis=0) - predicted) < 4 * error + 0.1 * np.abs(predicted)).all()
        assert (np.abs(predicted) > 4 * error).any()
    assert abs(sample.cost - solution.cost) > 3 * sample.cost_error
    assert abs(sample.cost - solution.cost - effect.cost) < 4 * sample.cost_error


def test_a_file_remembers_it(tmp_path):
    solution = bent(1e-3)
    loaded = co.load(solution.save(tmp_path / "bent.npz"))
    assert loaded.mean_effect.cost == solution.mean_effect.cost
    np.testing.assert_array_equal(loaded.mean_effect.mean, solution.mean_effect.mean)
