"""Errors of the filter that die out on the way: what is left of them is what two integrations differ by."""

from __future__ import annotations

import numpy as np
import pytest

import covocp as co


@pytest.mark.parametrize(("rate", "variance"), [(5.0, 0.1), (20.0, None)])
def test_they_are_no_error_of_the_prediction(rate: float, variance: float | None) -> None:
    """An actuator under feedback: its error is e^-50 of what it was, and less."""
    ocp = co.Problem(10.0, name="actuator")
    x = ocp.state("x", initial=1.0, final=0.0, variance=0.1)
    a, u = ocp.state("a", initial=0.0, variance=variance), ocp.control("u")
    ocp.dynamics(x, 0.5 * x + a, noise=0.01)
    ocp.dynamics(a, rate * (u - a))
    ocp.measurement("y", x, noise=1e-2)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 10.0, a: 0.1})
    solution = co.solve(ocp, intervals=60, progress=False)
    sample = co.simulate(solution, 300, seed=1, progress=False)
    left = np.abs(sample.estimates - sample.deviations)[:, sample.augmented.index("a")]
    assert 1e-9 < left.max() < 1e-4 * np.abs(solution["a"]).max()
    assert "are not the predicted ones" not in str(sample)
    assert "OUTSIDE" not in str(sample)
