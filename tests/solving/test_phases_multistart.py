"""Random starts of phases, against those of the problem that is not cut."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from phased import lag
from problems import unassessed

import covocp as co
from covocp.solving.random_starts import phase_seed

QUIET: dict[str, Any] = {"progress": False}


def cut() -> co.Phases:
    return co.Phases([lag(4.0, "A", last=False), lag(6.0, "B", first=False)])


def test_they_find_the_optima_of_the_whole_problem() -> None:
    """To learn b the control first pushes to one side or to the other: two optima of different cost."""
    whole = co.solve(lag(10.0, "whole"), intervals=20, guess="multistart", starts=4, **QUIET)
    solution = co.solve(cut(), intervals=[8, 12], guess="multistart", starts=4, **QUIET)
    assert len(solution.stats["starts"]) == 5
    for costs in (whole.stats["starts"], solution.stats["starts"]):
        assert np.ptp(costs) > 0.1
    assert solution.cost == pytest.approx(min(solution.stats["starts"]), rel=1e-12)
    assert solution.cost == pytest.approx(whole.cost, rel=1e-4)
    assert max(solution.stats["starts"]) == pytest.approx(max(whole.stats["starts"]), rel=1e-4)
    assert "best of 5 starts, which found 2 local optima" in str(solution)


def test_a_seed_gives_the_same_starts_again_and_each_phase_its_own() -> None:
    first, again, other = (
        co.solve(cut(), intervals=8, guess="multistart", starts=2, seed=s, **QUIET) for s in (1, 1, 3)
    )
    assert first.stats["starts"] == again.stats["starts"] != other.stats["starts"]
    assert len({phase_seed(seed, phase) for seed in range(3) for phase in range(3)}) == 9


def test_free_durations_and_free_initial_values_are_drawn() -> None:
    """sin has its least values where x is -pi/2 + 2 pi k: the deepest well of a tilted one is found from elsewhere."""
    one = co.Problem(co.Free(1.0, 0.2, 4.0), name="one")
    x, u = one.state("x", initial=None, lower=-10.0, upper=10.0, guess=8.0), one.control("u", lower=-0.1, upper=0.1)
    one.dynamics(x, u)
    one.minimize(running=u**2, terminal=0.05 * one.duration)
    two = co.Problem(1.0, name="two")
    y = two.state("x", initial=None)
    two.dynamics(y, 0.0 * y)
    two.minimize(terminal=ca.sin(y) + 0.02 * y**2)
    phases = co.Phases([one, two])
    near = co.solve(phases, intervals=4, **QUIET)
    far = co.solve(phases, intervals=4, guess="multistart", starts=8, seed=2, **QUIET)
    grid = np.linspace(-10.0, 10.0, 200001)
    least = float((np.sin(grid) + 0.02 * grid**2).min()) + 0.05 * 0.2
    assert far.cost == pytest.approx(least, rel=1e-6)
    assert near.cost > least + 0.3


def test_the_best_one_is_refined() -> None:
    solution = co.solve(cut(), refine=1e-4, guess="multistart", starts=1, **QUIET)
    reference = unassessed(lag(10.0, "whole"), intervals=60)
    assert abs(solution.cost / reference.cost - 1.0) <= solution.stats["mesh_errors"][-1] <= 1e-4
    assert len(solution.stats["starts"]) == 2
