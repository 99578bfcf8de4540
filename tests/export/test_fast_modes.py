"""Modes that are over, or turn, within a step: gains of the exported filters by exponentials of matrices."""

from __future__ import annotations

from typing import Any

import means
import numpy as np
import pytest
from exports import FOLDER

import covocp as co
from covocp.export import export_c

STEP = 0.1


def _coloured(tau: float) -> tuple[Any, co.Solution]:
    """A position seen with an error of correlation time tau: F, G, M, H, Q, U, and the solution."""
    ocp = co.Problem(2.0, name="coloured")
    x, b = (ocp.state(name, initial=0.0, variance=1e-2) for name in "xb")
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=1e-3)
    ocp.dynamics(b, -b / tau, noise=2e-2 / tau)
    ocp.measurement("m", x + b, noise=1e-4)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 1.0})
    F, Q = np.diag([0.0, -1.0 / tau]), np.diag([1e-3, 2e-2 / tau])
    system = F, np.array([[1.0], [0.0]]), np.ones((1, 2)), np.zeros((1, 1)), Q, np.array([[1e-4]])
    return system, co.evaluate(ocp, nominal={"u": 0.0}, intervals=10, substeps="auto")


def _gains(system: Any, steps: int) -> np.ndarray:
    """Of the discrete filter of means; steps in parts, as exponentials of both signs overflow."""
    F, _, M, _, Q, U = system
    n, parts = len(F), 64
    own = means.told(*system, STEP / parts)
    size = n + len(M)
    move = np.eye(size)
    move[:, :n] = own.state
    move[n:, :n] *= STEP / parts
    scale = np.diag([*np.ones(n), *np.full(len(M), STEP / parts)])
    P, noise, gains = 1e-2 * np.eye(n), scale @ own.noise @ scale, []
    for _ in range(steps):
        joint = np.zeros((size, size))
        joint[:n, :n] = P
        for _ in range(parts):
            joint = move @ joint @ move.T + noise
        gains.append(STEP * joint[:n, n:] / joint[n:, n:])
        P = joint[:n, :n] - joint[:n, n:] @ joint[n:, :n] / joint[n, n]
    return np.array(gains)


@pytest.mark.parametrize("tau", [0.05, 0.01, 0.001])
@pytest.mark.parametrize("period", [None, STEP])
def test_an_error_that_is_forgotten_within_a_step_counts_as_what_it_is(tau: float, period: float | None) -> None:
    system, solution = _coloured(tau)
    law = export_c(solution, FOLDER / f"coloured_{tau:g}_{period}", period=period, largest_spread=np.inf).reference()
    expected = _gains(system, 8)
    for k in range(8):
        law.step(0.0, STEP * (k + 1))
        np.testing.assert_allclose(law.state["filter_gain"][0], expected[k][0], rtol=0.02)
