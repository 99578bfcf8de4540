"""Limits of the spread that a run does not find its way to are tightened step by step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import unassessed

import covocp as co
from covocp.solving import gain_ways, other_ways, solver
from covocp.solving.loosened import PATIENCE_OF_STEPS


def brisk(limit=1.2):
    """Five metres in eight seconds with a speed that 98 % of the runs keep below a limit."""
    ocp = co.Problem(8.0, name="brisk")
    x = ocp.state("x", initial=0.0, final=5.0, variance=0.2)
    v = ocp.state("v", initial=0.0, final=0.0, variance=0.05)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=0.02)
    ocp.measurement("m", x, noise=0.02)
    ocp.minimize_expected(running=u**2, terminal_weight={x: 10.0, v: 1.0})
    ocp.chance(v, upper=limit, probability=0.98, name="speed")
    return ocp


def passed(solution, gap=0.0):
    """By how much v + z sqrt(E_vv + Xhat_vv + gap), z the quantile of 98 %, passes 1.2 at the nodes."""
    deviation = np.sqrt(solution["E"][:, 1, 1] + solution["Xhat"][:, 1, 1] + gap)
    return float((np.ravel(solution["v"]) + 2.0537489 * deviation).max()) - 1.2


def test_a_run_that_gives_up_finds_its_way_by_loosened_limits(monkeypatch):
    """On 100 intervals a run from the start alone takes more than a thousand iterations; here it may take twelve."""
    options = {"intervals": 30, "progress": False}
    with pytest.raises(co.SolveError, match="largest number of iterations"):
        co.solve(brisk(), max_iterations=12, **options)  # as asked: nothing is tried beyond
    alone = unassessed(brisk(), intervals=30)
    monkeypatch.setattr(solver, "PATIENCE", 12)
    found = co.solve(brisk(), **options)
    assert found.cost == pytest.approx(alone.cost, rel=1e-6)
    assert found.stats["iterations"] > 2 * 12  # of all runs
    largest = found["v"] + 2.0537489 * np.ravel(found.deviation("v"))  # the quantile of 98 %
    assert largest.max() == pytest.approx(1.2, abs=1e-6)


def test_a_step_that_raises_leaves_the_run_that_failed(monkeypatch):
    """As CasADi does where a linear system is singular."""
    monkeypatch.setattr(solver, "PATIENCE", 12)
    monkeypatch.setattr(other_ways, "other_ways", lambda *_: iter(()))
    made_ready = solver.made_ready

    class Raises:
        def solve(self, *_):
            raise RuntimeError("the linear system is singular")

    def ready(*given, **own):
        return Raises() if own.get("max_iterations") == PATIENCE_OF_STEPS else made_ready(*given, **own)

    monkeypatch.setattr(solver, "made_ready", ready)
    found = co.solve(brisk(), intervals=30, progress=False, allow_failure=True)
    assert not found.converged
    assert found.stats["iterations"] == 12


def test_other_plugins_and_methods_keep_their_own_iterations():
    """Sequential quadratic programming has no such option; it finds the same limits kept."""
    problem = brisk(1.4)  # which do not bind
    by_other = unassessed(problem, intervals=10, plugin="sqpmethod")
    assert by_other.cost == pytest.approx(unassessed(problem, intervals=10).cost, rel=1e-6)


def test_at_a_limit_inside_a_loosened_run_the_best_point_counts(monkeypatch):
    """With what it violates of the limit itself."""
    monkeypatch.setattr(solver, "PATIENCE", 2)  # the first run ends early, and far away
    first, later = (co.Solver(brisk(), intervals=30).solve(iteration_limit=limit, progress=False) for limit in (31, 80))
    assert not later.converged
    assert later.message == "stopped at the limit of 80 iterations"
    assert later.stats["iterations"] > first.stats["iterations"] + 10  # of all runs
    assert max(later.violations.values()) < 0.3 * max(first.violations.values())
    gap = later.violations["continuity of Xhat[v, v]"]  # before or after it the limit is passed
    assert passed(later) < later.violations["speed"] < passed(later, gap)


def test_a_solution_under_wider_limits_is_not_one_of_the_problem(monkeypatch):
    """Where the user interrupts after it, and the first run ended worse: it is told with what it violates."""
    monkeypatch.setattr(solver, "PATIENCE", 2)
    made_ready, tightened = solver.made_ready, gain_ways.tightened
    reached = []

    class Last:
        def __init__(self, prepared):
            self.mesh, self._prepared = prepared.mesh, prepared

        def solve(self, parameters, start, reporter):
            found = self._prepared.solve(parameters, start, reporter)
            reporter.asked = found.converged
            reached.append(found)
            return found

    def ready(*given, **own):
        prepared = made_ready(*given, **own)
        return Last(prepared) if own.get("max_iterations") == PATIENCE_OF_STEPS else prepared

    def after_worse(statement, failed, *rest):
        return tightened(statement, replace(failed, violations={"speed": np.inf}), *rest)

    monkeypatch.setattr(solver, "made_ready", ready)
    monkeypatch.setattr(gain_ways, "tightened", after_worse)
    with pytest.raises(co.Interrupted) as told:
        co.solve(brisk(), intervals=30, progress=False)
    found = told.value.solution
    assert reached[-1].converged
    assert reached[-1].violations == {}
    assert not found.converged
    assert passed(found) > 0.01
    assert found.violations == pytest.approx({"speed": passed(found)}, rel=1e-5)
