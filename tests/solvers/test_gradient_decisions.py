"""The slopes by decisions of the gradient method against differences of its own cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from decided import everywhere

from covocp.extremal.extremal import Guess
from covocp.solvers.gradient import method
from covocp.transcription.mesh import Options
from covocp.transcription.starts import own_start

STEP, INTERVALS = 1e-4, 40


@pytest.mark.parametrize("closed", [False, True], ids=["filter", "loop"])
def test_slopes_are_those_of_the_cost(closed):
    """Of the order of the steps: 1e-6 on this mesh."""
    statement = everywhere([0.9, 1.1, 0.7], closed).statement()
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
