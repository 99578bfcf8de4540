"""Conditions on integrals, counted run by run by what each run did."""

import numpy as np
import pytest

import covocp as co


def budgeted(limit, *, gain=1.0, closed=True):
    """A Wiener process with prior; its integral and, closed, the energy of its control have limits."""
    ocp = co.Problem(2.0, "budget")
    x = ocp.state("x", initial=0.5, variance=0.3)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=0.2)
    ocp.measurement("position", x, noise=0.05, every=0.25)
    area, effort = ocp.integral(x, name="area"), ocp.integral(u**2, name="effort")
    ocp.subject_to(area, upper=limit, name="largest area")
    ocp.subject_to(effort, upper=0.5, name="budget")
    if closed:
        ocp.minimize_expected(running=u**2 + gain * x**2)
    else:
        ocp.minimize(running=(u - 0.1) ** 2)
        ocp.estimation_covariance()
    return ocp


def test_an_open_loop_integral_has_its_normal_law():
    """int x dt is normal: mean 1.2, variance 0.3 T^2 + 0.2 T^3/3; what no run changes is not counted."""
    solution = co.solve(budgeted(2.0, closed=False), intervals=20, progress=False)
    runs = co.simulate(solution, 4000, seed=5, progress=False)
    assert set(runs.inequalities.left_out) == {"budget"}
    counted = runs.violations["largest area"]
    from scipy.stats import norm

    expected = norm.sf((2.0 - 1.2) / np.sqrt(0.3 * 4 + 0.2 * 8 / 3))
    assert counted.low < expected < counted.high
    assert counted.runs == counted.at_end
    assert np.isnan(counted.promised_end)
    assert "largest area" in str(runs)
    assert counted.as_promised


@pytest.mark.parametrize("kind", ["perturbation", "extended"])
def test_an_integral_under_feedback_is_that_of_the_run(kind):
    """Of a loop written out in numpy: filter, feedback, energy of the actual control."""
    solution = co.solve(budgeted(1.1), intervals=32, progress=False)
    runs = co.simulate(solution, 3000, seed=6, filter=kind, progress=False)
    rng, count, h = np.random.default_rng(1), 6000, 2.0 / 800
    deviation, estimate = rng.normal(0.0, np.sqrt(0.3), count), np.zeros(count)
    area, effort, E = np.zeros(count), np.zeros(count), 0.3
    t = (np.arange(800) + 0.5) * h
    C, u = (
        solution.at(t)[key] if key == "u" else np.interp(t, solution.t, solution.gains["C"][:, 0, 0]) for key in "Cu"
    )
    x = solution.at(t)["x"]
    for k in range(800):
        control = u[k] - C[k] * estimate
        area += h * (x[k] + deviation)
        effort += h * control**2
        deviation += h * (control - u[k]) + rng.normal(0.0, np.sqrt(0.2 * h), count)
        estimate += h * (control - u[k])
        E += 0.2 * h
        if (k + 1) % 100 == 0:
            gain = E / (E + 0.05)
            estimate += gain * (deviation + rng.normal(0.0, np.sqrt(0.05), count) - estimate)
            E *= 1 - gain
    for name, share in (("largest area", np.mean(area > 1.1)), ("budget", np.mean(effort > 0.5))):
        found = runs.violations[name]
        assert 0.02 < share < 0.98
        assert found.low - 0.02 < share < found.high + 0.02
