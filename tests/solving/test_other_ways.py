"""A condition that does not act leaves the best gain, also where a run with the first steps does not come to an end."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import pytest

import covocp as co
from covocp.solving import solver

INTERVALS = {"intervals": 30, "progress": False}


def swung(*, limited=True):
    """A pendulum from rest to rest, whose variance at the end is a tenth of its limit."""
    ocp = co.Problem(4.0, "swung")
    x = ocp.state("x", 2, initial=[0.0, 0.0], final=[1.0, 0.0], variance=[0.05, 0.03])
    u = ocp.control("u")
    ocp.dynamics(x, ca.vertcat(x[1], u - ca.sin(x[0])), noise=[0.0, 0.02])
    ocp.measurement("m", x[0], noise=0.02)
    X = ocp.closed_loop_covariance()
    ocp.minimize_expected(running=u**2, terminal_weight={x: [3.0, 2.0]})
    if limited:
        ocp.subject_to(X[x, x][0, 0], upper=1.0, at="final", name="wide")
    return ocp


@pytest.fixture(scope="module")
def best():
    """Cost of the best gain, from a Riccati equation: what no condition that does not act can change."""
    return co.solve(swung(limited=False), **INTERVALS).cost


def test_a_condition_that_does_not_act_leaves_the_best_gain(best):
    found = co.solve(swung(), **INTERVALS)
    assert found.cost == pytest.approx(best, rel=1e-5)
    assert found.stats["iterations"] < 50


@pytest.mark.parametrize(
    ("options", "step", "by"),
    [({}, "gauss", "covariance_step='gauss'"), ({"covariance_step": "rk4"}, "rk4", "hessian='limited-memory'")],
    ids=["steps", "hessian"],
)
def test_a_run_that_creeps_along_the_gain_goes_another_way(best, options, step, by):
    """As by one step an interval, which leaves the gain at the start free."""
    found = co.solve(swung(), substeps=1, **INTERVALS, **options)
    assert found.cost == pytest.approx(best, rel=1e-5)
    assert found.mesh.step == step
    assert f"found by {by}" in str(found)


def test_where_none_is_tried_they_are_named():
    with pytest.raises(co.SolveError, match="covariance_step='gauss' or hessian='limited-memory' may find a way"):
        co.solve(swung(), max_iterations=60, substeps=1, **INTERVALS)  # as asked: nothing is tried beyond


class Raises:
    """A problem made ready whose run ends as one in which CasADi cannot solve a step."""

    def __init__(self, prepared):
        self.mesh = prepared.mesh

    def solve(self, *_):
        raise RuntimeError("the linear system is singular")


def raising(monkeypatch, where):
    """Let runs raise where options of the mesh and of the method are such."""
    made_ready = solver.made_ready

    def ready(method, statement, options, parameters, **own):
        prepared = made_ready(method, statement, options, parameters, **own)
        return Raises(prepared) if where(options, own) else prepared

    monkeypatch.setattr(solver, "made_ready", ready)


def test_a_way_that_raises_leaves_the_run_that_failed(monkeypatch):
    monkeypatch.setattr(solver, "PATIENCE", 20)
    raising(monkeypatch, lambda options, own: options.covariance_step == "gauss" or "hessian" in own)
    found = co.solve(swung(), substeps=1, allow_failure=True, **INTERVALS)
    assert not found.converged
    assert found.stats["iterations"] == 20


def test_finer_steps_that_raise_leave_the_solution(monkeypatch):
    monkeypatch.setattr(solver, "finer_steps", lambda extremal, options, *_: replace(options, substeps=7))
    raising(monkeypatch, lambda options, own: options.substeps == 7)
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    assert co.solve(ocp, **INTERVALS).cost == pytest.approx(1.0)
