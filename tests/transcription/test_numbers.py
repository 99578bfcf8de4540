"""Runs of numbers by the library alone: what expressions of CasADi's give, segments, steps and loops."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.base.matrices import half_length, pack, unpack
from covocp.extremal import closed_loop, dense_output, joint
from covocp.models import bryson_denham, lqg_double_integrator, mars_entry, mass_chain, unknown_lag
from covocp.passage import columns
from covocp.passage.library import build_info, functions
from covocp.passage.sweep import values_by
from covocp.transcription import numbers
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.numbers import compiled_step, segments_of_numbers
from covocp.transcription.shooting import interval_columns, shoot
from covocp.transcription.starts import own_start
from covocp.transcription.steps import matrices_step
from covocp.transcription.stiffness import resolve_mesh

pytestmark = pytest.mark.skipif(functions() is None, reason=str(build_info()["library"]))


def two_forward() -> co.Problem:
    """A filter, and beside it a Lyapunov equation of other size along the same nominal."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", 2, initial=[1.0, 0.0], variance=[0.1, 0.2]), ocp.control("u", lower=-1.0, upper=1.0)
    b = ocp.unknown("b", mean=1.0, variance=0.3)
    ocp.dynamics(x, ca.vertcat(x[1], -b * ca.sin(x[0]) + u), noise=[0.01, 0.02])
    ocp.measurement("y", x[0], noise=0.1)
    P, E = ocp.symmetric("P", 2, initial=np.diag([0.2, 0.1])), ocp.estimation_covariance()
    F = ca.blockcat([[0.0, 1.0], [-ca.cos(x[0]), -0.3]])
    ocp.dynamics(P, F @ P + P @ F.T + 0.1 * np.eye(2))
    ocp.minimize(running=u**2, terminal=E[b, b] + P[0, 0])
    return ocp


CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "one sensor": (unknown_lag.problem, {}),
    "unequal segments": (unknown_lag.problem, {"segments": 7}),
    "constant controls": (unknown_lag.problem, {"control": "constant", "substeps": 2}),
    "several states": (lambda: mass_chain.problem(masses=3), {"substeps": 3, "intervals": 40}),
    "a segment for each": (lambda: mass_chain.problem(masses=2), {"segments": 50, "intervals": 50}),
    "two forward": (two_forward, {}),
    "a loop": (lqg_double_integrator.problem, {}),
    "a loop and a free duration": (mars_entry.problem, {}),
    "no matrices": (bryson_denham.problem, {"intervals": 30, "segments": 4}),
}


def started(problem: co.Problem, **options: Any) -> tuple[Any, Mesh, Any]:
    """Statement, mesh, and a trajectory with controls that vary."""
    statement = problem.statement()
    mesh = resolve_mesh(statement, Options(**options), statement.values)
    t = own_start(statement, mesh, statement.values).trajectory
    u = t.u + 0.1 * np.sin(np.arange(t.u.size)).reshape(t.u.shape) * (1 + np.abs(t.u))
    return statement, mesh, SimpleNamespace(x=t.x, e=t.e, u=u, duration=t.duration)


def apart(found: Any, expected: Any) -> float:
    """Largest difference of some matrices (K, n, n), in units of both deviations at their largest."""
    deviations = np.sqrt(np.abs(np.diagonal(expected, axis1=1, axis2=2)).max(axis=0))
    units = np.maximum(deviations[:, None] * deviations, np.finfo(float).tiny)
    return float((np.abs(found - expected) / units).max())


@pytest.mark.parametrize("name", CASES)
def test_segments_are_those_of_shooting(name: str):
    """Gaps, costs, states and half-vectors at nodes: to the last bit the library's, to roundoff CasADi's."""
    make, options = CASES[name]
    statement, mesh, t = started(make(), **options)
    starts = list(mesh.starts)
    found = segments_of_numbers(statement, mesh, t.x[starts].T, t.e[0], (t.u.T, float(t.duration), statement.values))
    assert found is not None
    given = {"x": t.x[starts].T, "e": t.e[starts].T, "u": t.u.T, "duration": t.duration, "parameters": statement.values}
    variables = SimpleNamespace(**{key: ca.DM(value) for key, value in given.items()})
    compiled, plain = (shoot(statement, mesh, variables, passage=own) for own in (values_by, None))
    for own, key in ((found.gaps, "gap_x"), (found.costs[None], "cost"), (found.x, "x"), (found.e, "e")):
        np.testing.assert_array_equal(own, np.asarray(ca.DM(compiled[key]).full()))
        expected = np.asarray(ca.DM(plain[key]).full())
        if key != "e":
            np.testing.assert_allclose(own, expected, rtol=1e-12, atol=1e-12)
        for block in statement.matrices if key == "e" else ():
            assert apart(*(unpack(values[block.span].T, block.size) for values in (own, expected))) <= 1e-9


@pytest.mark.parametrize("name", ["one sensor", "a loop", "no matrices"])
def test_of_the_nodes_every_so_many_are_given(name: str):
    """With gaps and costs of all intervals."""
    make, options = CASES[name]
    statement, mesh, t = started(make(), **(options | {"intervals": 40}))
    given = t.x[list(mesh.starts)].T, t.e[0], (t.u.T, float(t.duration), statement.values)
    every, some = (segments_of_numbers(statement, mesh, *given, apart) for apart in (1, 4))
    assert every is not None
    assert some is not None
    for one, other in zip((every.gaps, every.costs, every.x[:, ::4], every.e[:, ::4]), some, strict=True):
        np.testing.assert_array_equal(one, other)


def test_segments_that_the_library_cannot_take_are_none(monkeypatch: pytest.MonkeyPatch):
    """Matrices that are variables, a function that is not known, and fewer columns than pay."""
    statement, mesh, t = started(unknown_lag.problem())
    given = t.x[list(mesh.starts)].T, t.e[0], (t.u.T, float(t.duration), statement.values)
    assert segments_of_numbers(statement, mesh, *given) is not None
    variables = resolve_mesh(statement, Options(covariances="states"), statement.values)
    assert segments_of_numbers(statement, variables, *given) is None
    monkeypatch.setattr(columns, "program", lambda function: None)
    fresh = unknown_lag.problem().statement()
    assert segments_of_numbers(fresh, mesh, *given) is None
    monkeypatch.undo()
    few, short, own = started(unknown_lag.problem(), intervals=columns.FEWEST - 1, substeps=1)
    asked = own.x[list(short.starts)].T, own.e[0], (own.u.T, float(own.duration), few.values)
    assert segments_of_numbers(few, short, *asked) is None


@pytest.mark.parametrize("make", [mars_entry.problem, lqg_double_integrator.problem, unknown_lag.problem, two_forward])
def test_steps_from_many_starts_are_the_steps_of_the_matrices(make: Any):
    """Forward and backward, of different lengths, from covariances of any size."""
    statement, mesh, t = started(make())
    common = interval_columns(mesh, ca.DM(t.u.T), t.duration, ca.DM(statement.values))
    arrays = [np.asarray(ca.DM(value).full()) for value in common]
    rng = np.random.default_rng(5)
    for positions, turned in ((statement.ahead, False), (statement.behind, True)):
        if not positions:
            continue
        begin, end, s, ds, *rest = arrays
        length = ds * rng.uniform(0.2, 1.0, ds.shape)
        along = [t.x[:-1].T, t.x[1:].T, begin, end, s, length, *rest]
        if turned:
            along = [t.x[1:].T, t.x[:-1].T, end, begin, s + length, -length, *rest]
        sizes = [statement.matrices[i].size for i in positions]
        roots = [rng.standard_normal((mesh.intervals, size, size)) for size in sizes]
        halves = np.hstack([pack(root @ root.transpose(0, 2, 1)) for root in roots])
        assert halves.shape == (mesh.intervals, sum(map(half_length, sizes)))
        found = compiled_step(statement, mesh, positions, halves, along)
        assert found is not None
        step = matrices_step(statement, positions, mesh.step).map(mesh.intervals)
        expected = np.asarray(step(halves.T, *along).full()).T
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11 * np.abs(expected).max())


def test_a_loop_is_the_same_without_the_library(monkeypatch: pytest.MonkeyPatch):
    """Joint covariances, the cost by both forms, and what lies between the nodes."""
    solution = co.solve(mars_entry.problem(), progress=False)
    own = solution.extremal
    fine = closed_loop.fine_trajectory(own, 4)
    statistics = closed_loop.design_statistics(own)
    found = joint.joint_covariances(own, fine, statistics, None)
    between = dense_output._between(own, True)
    monkeypatch.setattr(joint, "functions", lambda: None)
    monkeypatch.setattr(dense_output, "numbers_in_columns", lambda *given: None)
    monkeypatch.setattr(dense_output, "compiled_step", lambda *given: None)
    plain = joint.joint_covariances(own, fine, statistics, None)
    assert apart(found, plain) <= 1e-9
    other = dense_output._between(own, True)
    at = np.linspace(0.0, 1.0, 2003)
    values, expected = between.at(at), other.at(at)
    assert (np.abs(values - expected) <= 1e-6 * np.ptp(expected, axis=0)).all()
    loop = closed_loop.close_loop(own)
    assert loop is not None
    assert loop.expected_cost == pytest.approx(solution.loop.expected_cost, rel=1e-10)
    assert loop.other_cost == pytest.approx(loop.expected_cost, rel=1e-4)


def test_a_loop_above_has_costs_of_both_kinds():
    """What is compared with shooting has intervals by parts, and so few others that the library does not take them."""
    statement, mesh, _ = started(mars_entry.problem())
    parted = numbers.parted_intervals(statement, mesh)
    assert 0 < np.count_nonzero(~parted) < columns.FEWEST < np.count_nonzero(parted)
