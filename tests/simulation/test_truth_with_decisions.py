"""A truth that is stated as the design is, with its decisions and integrals."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co


def steered(*, integral_first=True, noise=1.0):
    """An integrator with a budget of energy, and a sensor whose accuracy is decided."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=1.0, final=0.0, variance=0.1), ocp.control("u")
    if integral_first:
        energy = ocp.integral(u**2, name="energy")
    price = ocp.decision("density", guess=0.1, lower=0.02, upper=1.0)
    if not integral_first:
        energy = ocp.integral(u**2, name="energy")
    ocp.dynamics(x, u, noise=0.1 * noise)
    ocp.measurement("y", x, noise=price)
    ocp.subject_to(energy, upper=2.0)
    ocp.minimize_expected(running=0.5 * u**2 + 0.01 / price, terminal_weight={x: 1.0})
    return ocp


@pytest.mark.parametrize("first", [True, False])
def test_the_same_problem_as_truth_changes_nothing(first):
    solution = co.solve(steered(integral_first=first), intervals=12, progress=False)
    own = co.simulate(solution, 256, 3, step=0.05, progress=False)
    same = co.simulate(solution, 256, 3, step=0.05, truth=steered(integral_first=first), progress=False)
    assert np.array_equal(own.deviations, same.deviations)
    assert same.predicted_cost == pytest.approx(own.predicted_cost, rel=1e-6)
    noisy = co.simulate(solution, 256, 3, step=0.05, truth=steered(integral_first=first, noise=4.0), progress=False)
    assert noisy.deviations.std() > 1.3 * own.deviations.std()


def test_a_truth_with_another_decision_is_refused():
    solution = co.solve(steered(), intervals=12, progress=False)
    other = steered()
    other.decision("more", guess=0.1, lower=0.0, upper=1.0)
    with pytest.raises(co.ProblemError, match="other decisions or integrals"):
        co.simulate(solution, 64, 3, truth=other, progress=False)


def test_a_decided_variance_stays_at_its_bound():
    ocp = co.Problem(1.0)
    start = ocp.decision("start", guess=1.0, lower=0.0, upper=2.0)
    x, u = ocp.state("x", initial=0.0, variance=start), ocp.control("u", lower=-1.0, upper=1.0)
    b = ocp.unknown("b", mean=1.0, variance=1.0)
    ocp.dynamics(x, b * u)
    ocp.measurement("y", x, noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(terminal=E[b, b] + 0.1 * start)
    solution = co.solve(ocp, intervals=12, progress=False)
    assert 0.0 <= solution["start"] < 1e-6
    assert solution.semidefinite
