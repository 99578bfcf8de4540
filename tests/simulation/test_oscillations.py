"""What oscillates with whole periods in each step of a simulation is no constant: means and spreads are those of it."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.simulation.actual import actual_system, design_system
from covocp.simulation.schedule import base_grid
from covocp.simulation.unseen import seeing

FREQUENCY, AMPLITUDE = 40.0, 0.9  # whole periods in steps of 0.1 s, of their halves and quarters' halves


def lag(where="", frequency=FREQUENCY):
    """dx = -0.2 x + u + n over 10 s, a cosine in the rate, a density or the measurement."""
    ocp = co.Problem(10.0)
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u")
    wave = {where: AMPLITUDE * ca.cos(2 * np.pi * frequency * ocp.time)}
    ocp.dynamics(x, -0.2 * x + u + wave.get("rate", 0.0), noise=0.02 * (1 + wave.get("noise", 0.0)))
    ocp.measurement("m", x + wave.get("measurement", 0.0), noise=0.05)
    ocp.estimation_covariance()
    ocp.minimize(running=u**2)
    return ocp


@pytest.fixture(scope="module")
def still():
    return co.solve(lag(), intervals=100, progress=False)


@pytest.mark.parametrize(("where", "step"), [("rate", None), ("rate", 0.1), ("noise", 0.1), ("measurement", 0.1)])
def test_a_truth_that_oscillates_is_its_mean(still, where, step):
    """Far faster than the loop: it moves means by amplitude / frequency, and variances by as much of them."""
    one, other = (co.simulate(still, 200, 1, truth=truth, step=step, progress=False) for truth in (lag(where), lag()))
    little = AMPLITUDE / (2 * np.pi * FREQUENCY)
    assert abs(one.predicted_mean[-1, 0]) < little
    assert one.predicted[-1, 0, 0] == pytest.approx(other.predicted[-1, 0, 0], rel=0.02)
    assert one.predicted_error[-1, 0, 0] == pytest.approx(other.predicted_error[-1, 0, 0], rel=0.02)
    # the sample: its mean has an error of sigma / sqrt(200), where it was off by 9 sigma
    assert abs(one.bias("x")[-1]) < 4 * np.sqrt(one.predicted[-1, 0, 0] / 200)
    assert one.verdict.holds
    assert 4 * FREQUENCY * one.step.longest <= 1 + 1e-9
    assert step is None or "model are faster" in one.step.reason


def test_what_is_too_fast_is_told_with_its_size(still):
    """A million periods: no steps of a run see them; one place of them would move x by 0.9 times 10 s."""
    design, base = design_system(still), base_grid(still, 2)
    actual = actual_system(design, lag("rate", 1e5))
    with pytest.warns(UserWarning, match=r"faster than the steps .* 'x' is off by up to 9"):
        seeing(still, design, actual, base, 100)


def test_what_matters_to_nobody_takes_no_steps(still):
    design, base = design_system(still), base_grid(still, 101)
    for truth in (None, lag("rate", 0.3)):
        seen = seeing(still, design, actual_system(design, truth), base, 100)
        assert np.isinf(seen.seen).all()
