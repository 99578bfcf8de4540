"""Solving again and again: nothing is looked at after the run, and the solution is the same."""

from __future__ import annotations

import numpy as np
import pytest
from problems import lag

import covocp as co
from covocp.models import mass_chain
from covocp.solvers.ipopt import ShootingSolver


def test_a_loop_without_assessment_finds_the_same_solutions():
    """Other means of the unknown from step to step, each from the plan before."""
    solver = co.Solver(lag(10.0, 0.0).problem, intervals=40)
    (name,) = (block.name for block in solver.statement.of_kind("unknown"))
    plan = solver.solve(progress=False)
    for mean in (1.1, 1.2, 1.3):
        plan = solver.solve({name: mean}, guess=plan, progress=False, assess=False)
        assert np.isnan(plan.mesh_error)
        afresh = solver.solve({name: mean}, progress=False)
        assert afresh.mesh_error < 1e-3
        assert plan.cost == pytest.approx(afresh.cost, rel=1e-8)
        assert "not assessed" in str(plan)


def test_a_warm_start_on_the_same_nodes_is_the_trajectory_itself():
    solver = co.Solver(lag(10.0, 0.0).problem, intervals=40)
    first = solver.solve(progress=False)
    again = solver.solve(guess=first, progress=False, assess=False)
    assert again.stats["iterations"] <= 1
    np.testing.assert_allclose(again.trajectory.u, first.trajectory.u, atol=1e-6 * np.abs(first.trajectory.u).max())


def test_what_is_left_out_can_be_asked_for():
    solver = co.Solver(lag(10.0, 0.0).problem, intervals=40)
    first = solver.solve(progress=False)
    again = solver.solve(guess=first, progress=False, assess=False)
    assert again.optimality.curvature == pytest.approx(first.optimality.curvature, rel=1e-3)
    assert again.optimality.stationarity < 1e-4


def test_steps_of_a_large_covariance_are_looked_at_before_the_first_run(monkeypatch):
    """A chain of 14 masses needs two steps an interval: found along the guess, the program is solved once."""
    made = []
    own = ShootingSolver.solve
    monkeypatch.setattr(ShootingSolver, "solve", lambda self, *given: made.append(self.mesh) or own(self, *given))
    solution = co.solve(mass_chain.problem(masses=14), intervals=50, progress=False)
    assert [mesh.substeps for mesh in made] == [2]
    halved = co.solve(mass_chain.problem(masses=14), intervals=50, substeps=4, progress=False)
    assert solution.cost == pytest.approx(halved.cost, rel=1e-4)
    made.clear()
    co.solve(mass_chain.problem(masses=1), intervals=50, progress=False)
    assert [mesh.substeps for mesh in made] == [1]
