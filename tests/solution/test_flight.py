"""The loop with its gains as they are flown, against what the solution predicts."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.solution.flight import interpolated_flight


def steep(seed):
    """Random closed loops whose filter starts fast and whose feedback ends fast."""
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 4))
    problem = co.Problem(duration=float(random.uniform(5.0, 50.0)), name=f"steep {seed}")
    prior, weight = 10.0 ** random.uniform(0, 3), 10.0 ** random.uniform(1, 4)
    x = problem.state("x", n, initial=random.normal(size=n), variance=[prior] * n)
    u = problem.control("u")
    drift = 0.3 * random.normal(size=(n, n)) - 0.2 * np.eye(n)
    problem.dynamics(x, ca.DM(drift) @ x + ca.DM([1.0] * n) * u, noise=[0.05] * n)
    problem.measurement("m", x, noise=ca.DM.eye(n) * 10.0 ** random.uniform(-2, 0))
    problem.minimize_expected(running=0.5 * u**2, terminal_weight={x: [weight] * n})
    return co.solve(problem, progress=False)


@pytest.mark.parametrize("seed", range(4))
def test_promised_and_flown_deviations_agree_on_the_default_mesh(seed):
    assert interpolated_flight(steep(seed)).worst < 1.02


def test_a_loop_that_diverges_is_told():
    solution = steep(0)
    flown = np.full_like(solution.loop.X, np.nan)
    from covocp.solution.flight import compared

    flight = compared(solution, flown, solution.loop.X, solution.t)
    assert flight.worst == float("inf")
    assert "diverges" in flight.words
