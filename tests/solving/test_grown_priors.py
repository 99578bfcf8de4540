"""More that is uncertain than what a mesh was graded for: the nodes follow, whether or not the run is assessed."""

from __future__ import annotations

import numpy as np
import pytest
from limited_speed import NOISE, cost_along, limited_speed

import covocp as co


def moved() -> co.Problem:
    """Its noise is a parameter."""
    ocp = co.Problem(4.0, "moved")
    return limited_speed(ocp.parameter("noise", NOISE), ocp=ocp)


def integrated(solution: co.Solution, prior: float, noise: float = NOISE) -> float:
    """The cost along the controls of a solution by scipy."""
    return cost_along(solution.t, solution["u"].ravel(), prior * np.eye(2), noise)


@pytest.mark.parametrize(
    ("method", "prior"),
    [
        *((method, prior) for method in ("ipopt", "reduced") for prior in (1.0, 1e3, 1e6)),
        *(("gradient", prior) for prior in (1.0, 1e6)),
    ],
)
def test_a_larger_prior_in_a_loop_has_its_own_cost(method, prior):
    solver = co.Solver(moved(), method, intervals=12)
    solver.solve(progress=False)
    found = solver.solve(covariance=prior * np.eye(2), assess=False, progress=False)
    assert found.cost == pytest.approx(integrated(found, prior), rel=1e-3)


def test_less_noise_counts_as_well():
    solver = co.Solver(moved(), intervals=20)
    found = solver.solve({"noise": 1e-6}, assess=False, progress=False)
    assert found.cost == pytest.approx(integrated(found, 0.01, 1e-6), rel=1e-3)
    assert found.t.size > solver.solve(progress=False).t.size - 1 > 21


# 5 % more nodes had been no reason for others: 25 % of the cost, also where the run was assessed.
@pytest.mark.parametrize("assess", [True, False])
def test_few_more_nodes_among_many_count(assess):
    solver = co.Solver(moved(), intervals=200)
    found = solver.solve(covariance=100.0 * np.eye(2), assess=assess, progress=False)
    assert found.cost == pytest.approx(integrated(found, 100.0), rel=1e-3)
    assert 200 < found.t.size < 220


def test_a_mesh_that_became_finer_stays():
    solver = co.Solver(moved(), intervals=20)
    meshes = [
        solver.solve(covariance=prior * np.eye(2), assess=False, progress=False).mesh
        for prior in (0.01, 0.012, 0.005, 10.0, 0.01, 5.0, 12.0, 10.0)
    ]
    assert meshes[0] is meshes[1] is meshes[2]
    assert meshes[3].intervals > meshes[2].intervals
    assert all(later is meshes[3] for later in meshes[4:])
