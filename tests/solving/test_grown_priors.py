"""More that is uncertain than what a mesh was graded for: the nodes follow, whether or not the run is assessed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co

NOISE = 0.01


def moved(noise: float = NOISE) -> co.Problem:
    """A double integrator whose position is measured the less, the further it is; the cost is E's own on the way."""
    ocp = co.Problem(4.0, "moved")
    x = ocp.state("x", initial=0.0, final=3.0, variance=0.01)
    v = ocp.state("v", initial=0.0, final=0.0, upper=1.0, variance=0.01)
    u = ocp.control("u", lower=-2.0, upper=2.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=0.01)
    ocp.measurement("m", x, noise=ocp.parameter("noise", noise) * (1 + x**2))
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + E[x, x])
    return ocp


def integrated(solution: co.Solution, prior: float, noise: float = NOISE) -> float:
    """The cost along the controls of a solution by scipy's LSODA."""
    t, u = solution.t, solution["u"].ravel()

    def slope(s, y):
        E = y[2:6].reshape(2, 2)
        F = np.array([[0.0, 1.0], [0.0, 0.0]])
        rate = F @ E + E @ F.T + np.diag([0.0, 0.01]) - np.outer(E[:, 0], E[0]) / (noise * (1 + y[0] ** 2))
        now = np.interp(s, t, u)
        return np.r_[y[1], now, rate.ravel(), 0.5 * now**2 + E[0, 0]]

    y = np.r_[0.0, 0.0, prior, 0.0, 0.0, prior, 0.0]
    for begin, end in pairwise(t):
        y = solve_ivp(slope, (begin, end), y, method="LSODA", rtol=1e-9, atol=1e-12).y[:, -1]
    return float(y[-1])


@pytest.mark.parametrize("method", ["ipopt", "reduced", "gradient"])
@pytest.mark.parametrize("prior", [1.0, 1e3, 1e6])
def test_a_larger_prior_in_a_loop_has_its_own_cost(method, prior):
    solver = co.Solver(moved(), method, intervals=20)
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
