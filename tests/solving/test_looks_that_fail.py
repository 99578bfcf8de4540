"""What is solved is kept where a look at it, or a run that may better it, fails in CasADi."""

from __future__ import annotations

import numpy as np
import pytest
from problems import lag

import covocp as co
from covocp.base.progress import Progress
from covocp.extremal import curvature
from covocp.solving import classical_runs, other_minima, phases_runs, solver
from covocp.solving.coarse_start import coarser, from_coarser
from covocp.transcription.instants import with_instants
from covocp.transcription.mesh import Options
from covocp.transcription.stiffness import resolve_mesh

MINIMUM = 0.05  # of the weight 0.01, at u = 0


def singular(*_, **__):
    """What CasADi raises where it cannot factorise."""
    raise RuntimeError(".../linsol.cpp:1: Assertion failed:\nthe linear system is singular")


class SomeRaise:
    """A problem made ready, of which the runs fail that are counted among these."""

    def __init__(self, prepared, failing):
        self.mesh, self._prepared, self._failing, self.count = prepared.mesh, prepared, failing, 0

    def solve(self, *given):
        self.count += 1
        return singular() if self.count - 1 in self._failing else self._prepared.solve(*given)


def failing(monkeypatch, runs):
    """Let runs of solvers made from now on fail that are counted among these."""
    made_ready = solver.made_ready
    monkeypatch.setattr(solver, "made_ready", lambda *given, **own: SomeRaise(made_ready(*given, **own), runs))


def at_rest(weight):
    """Solver and guess of the lag: rest is the minimum for small weights, a saddle for large ones."""
    return co.Solver(lag(weight, 0.0).problem, intervals=50), {"u": np.zeros(51)}


def test_a_point_is_kept_where_it_cannot_be_looked_at(monkeypatch):
    monkeypatch.setattr(other_minima, "longest", singular)
    problem, guess = at_rest(0.01)
    with pytest.warns(co.CovocpWarning, match=r"at a saddle failed \(the linear system is singular\)"):
        found = problem.solve(guess=guess, progress=False)
    assert found.converged
    assert found.cost == pytest.approx(MINIMUM, rel=1e-8)


def test_a_curvature_that_cannot_be_had_is_none(monkeypatch):
    """Of a step that can be differentiated, but not everywhere."""
    monkeypatch.setattr(curvature._Reduced, "operator", lambda *_: singular)
    problem, guess = at_rest(0.01)
    found = problem.solve(guess=guess, progress=False)
    assert found.cost == pytest.approx(MINIMUM, rel=1e-8)
    assert found.optimality.curvature is None


@pytest.mark.parametrize("side", [1, 2])
def test_a_saddle_is_left_by_the_side_that_runs(monkeypatch, side):
    """Both sides are mirror images of each other."""
    problem, guess = at_rest(10.0)
    with pytest.warns(co.CovocpWarning, match="it was left along that direction"):
        expected = problem.solve(guess=guess, progress=False)
    failing(monkeypatch, {side})
    problem, guess = at_rest(10.0)
    with pytest.warns(co.CovocpWarning, match="it was left along that direction"):
        found = problem.solve(guess=guess, progress=False)
    assert found.cost == pytest.approx(expected.cost, rel=1e-7)


def test_a_saddle_that_cannot_be_left_is_told(monkeypatch):
    failing(monkeypatch, {1, 2})
    problem, guess = at_rest(10.0)
    with pytest.warns(co.CovocpWarning, match="runs from beside it fail"):
        found = problem.solve(guess=guess, progress=False)
    assert found.converged
    with pytest.warns(co.CovocpWarning, match="no minimum"):
        assert found.optimality.curvature < 0
    np.testing.assert_allclose(found["u"], 0.0, atol=1e-6)


def test_a_course_is_kept_where_turns_cannot_be_looked_for(monkeypatch):
    monkeypatch.setattr(other_minima, "unwound", singular)
    problem, guess = at_rest(0.01)
    with pytest.warns(co.CovocpWarning, match="whether angles turn full circle between its nodes"):
        found = problem.solve(guess=guess, progress=False)
    assert found.cost == pytest.approx(MINIMUM, rel=1e-8)


def test_phases_are_kept_where_turns_cannot_be_looked_for(monkeypatch):
    """An integrator from 0 to 1 in two seconds, by u = 1/2."""
    monkeypatch.setattr(phases_runs, "unwound", singular)
    parts = []
    for name in ("A", "B"):
        ocp = co.Problem(1.0, name=name)
        first = name == "A"
        x, u = ocp.state("x", initial=0.0 if first else None, final=None if first else 1.0), ocp.control("u")
        ocp.dynamics(x, u)
        ocp.minimize(running=u**2)
        parts.append(ocp)
    with pytest.warns(co.CovocpWarning, match="whether angles turn full circle between its nodes"):
        found = co.solve(co.Phases(parts), intervals=10, progress=False)
    assert found.converged
    assert found.cost == pytest.approx(0.5)


def test_without_a_coarse_start_there_are_others():
    """Of a gain that is free while all is read at instants."""
    ocp = co.Problem(2.0, "read each second")
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, u, noise=0.1)
    ocp.measurement("place", x, 0.1, every=1.0)
    X = ocp.closed_loop_covariance()
    ocp.subject_to(x + X.deviation(x), upper=2.0, name="wall")
    ocp.minimize_expected(u**2 - x, terminal_weight={x: 1.0})
    statement, options = ocp.statement(), with_instants(ocp.statement(), Options(intervals=96), ocp.statement().values)
    mesh = resolve_mesh(statement, options, statement.values)
    given = (statement.values, None, Progress("", False))
    assert coarser(statement, options, mesh, statement.values) is not None
    assert from_coarser(statement, options, mesh, singular, given) is None


def test_a_solution_is_kept_where_the_classical_design_fails(monkeypatch):
    problem = co.Solver(beside(), intervals=10)
    monkeypatch.setattr(classical_runs, "from_starts", raising_for_the_classical(classical_runs.from_starts))
    found = problem.solve(progress=False)
    assert found.converged
    assert "the linear system is singular" in found.stats["classical_missing"]


def beside():
    """An integrator with noise, to be near one at the end."""
    ocp = co.Problem(1.0, name="beside")
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, u - x**2, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=u**2, terminal=(x - 1.0) ** 2)
    return ocp


def raising_for_the_classical(from_starts):
    """Runs that fail where there are no covariances to choose by."""

    def run(prepared, values, guesses, reporter):
        outcome, start = from_starts(prepared, values, guesses, reporter)
        return (outcome, start) if outcome.extremal.statement.matrices else singular()

    return run


def test_a_solution_is_kept_where_going_on_from_it_fails(monkeypatch):
    problem = co.Solver(beside(), intervals=10)
    found = problem.solve(progress=False)
    monkeypatch.setattr(problem, "_ready", lambda *_, **__: SomeRaise(problem._prepared, {0}))
    assert problem._continued(found.extremal.parameters, found) is found
