"""The slopes by decisions of the gradient method against differences of its own cost."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.extremal.extremal import Guess
from covocp.solvers.gradient import method
from covocp.transcription.mesh import Options
from covocp.transcription.starts import own_start

STEP, INTERVALS = 1e-4, 40


def everywhere(closed):
    """Decisions in rates, noises, measurements, initial values and covariances, integrals and costs."""
    ocp = co.Problem(1.5, "everywhere")
    d = ocp.decision("d", 3, guess=[0.9, 1.1, 0.7], lower=0.1, upper=3.0)
    x, v = ocp.state("x", initial=d[2], variance=0.4 * d[1]), ocp.state("v", initial=0.2, variance=0.1)
    b = ocp.unknown("b", mean=0.8, variance=0.3 * d[0] * d[1])
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, -b * d[0] * ca.sin(x) + u, noise=0.1 * d[2])
    ocp.measurement("m", x * d[1], noise=0.2 + d[0] ** 2)
    E = ocp.estimation_covariance()
    total = ocp.integral(E[x, x] * (1 + x**2))
    if closed:
        ocp.minimize_expected(running=0.5 * u**2 + x**2 / d[1], terminal=d[0] * x**2 + v**2)
    else:
        ocp.minimize(running=u**2 + 0.1 * E[b, b], terminal=E[x, b] ** 2 + total * d[0] + x**2)
    return ocp.statement()


@pytest.mark.parametrize("closed", [False, True], ids=["filter", "loop"])
def test_slopes_are_those_of_the_cost(closed):
    """Of the order of the steps: 1e-6 on this mesh."""
    statement = everywhere(closed)
    solver = method.prepare(statement, Options(grid=np.linspace(0.0, 1.0, INTERVALS + 1), substeps=2))
    u = np.cos(np.linspace(0.0, 2.0, INTERVALS + 1))[:, None]
    start = Guess(trajectory=replace(own_start(statement, solver.mesh, statement.values).trajectory, u=u))
    space = solver.space(statement.values, start)
    current = space.first(start)
    slopes = space.linearise(current).slope[space.controls :]
    assert slopes.size == 3
    for k in range(3):
        shift = STEP * np.eye(current.point.size)[space.controls + k]
        near, far = (
            space.at(current.point + m * shift).run.cost - space.at(current.point - m * shift).run.cost for m in (1, 2)
        )
        assert slopes[k] == pytest.approx((8 * near - far) / (12 * STEP), rel=1e-6)
