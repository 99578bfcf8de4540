"""Trajectories run again with shorter steps: right, and the same numbers whichever way a run is made."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from covocp.models import mass_chain, unknown_lag
from covocp.passage import library
from covocp.transcription import halved_steps
from covocp.transcription.halved_steps import Refined, refined_run, refined_states
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.starts import own_start
from covocp.transcription.stiffness import resolve_mesh
from covocp.transcription.trajectory import Trajectory

MANY = halved_steps.FEW + 2


def mesh_of(statement: object, **options: object) -> Mesh:
    """The mesh of some options."""
    return resolve_mesh(statement, Options(intervals=10, **options), statement.values)  # type: ignore[arg-type,attr-defined]


def flat(values: Refined) -> np.ndarray:
    """All numbers of a run."""
    parts = (values.jumps, [values.running], values.costs, values.states, values.matrices)
    return np.concatenate([np.ravel(part) for part in parts])


@pytest.mark.parametrize("control", ["linear", "constant"])
@pytest.mark.parametrize("segments", [1, 3])
def test_runs_that_come_often_give_the_numbers_of_the_first(control: str, segments: int) -> None:
    statement = mass_chain.problem(masses=4).statement()
    mesh = mesh_of(statement, control=control, segments=segments, substeps=2)
    guess = own_start(statement, mesh, statement.values).trajectory
    moved = [Trajectory(x=guess.x, u=guess.u + 0.1 * k, e=guess.e, duration=guess.duration) for k in range(MANY)]
    first = []
    for trajectory in moved:  # each on a mesh of its own: none of them is a repeated one
        fresh = mesh_of(statement, control=control, segments=segments, substeps=2)
        first.append(
            (
                flat(refined_run(statement, fresh, trajectory, statement.values)),
                refined_states(statement, fresh, trajectory, statement.values),
            )
        )
    for trajectory, (whole, end) in zip(moved, first, strict=True):
        again = flat(refined_run(statement, mesh, trajectory, statement.values))
        np.testing.assert_allclose(again, whole, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(refined_states(statement, mesh, trajectory, statement.values), end, rtol=1e-12)
    assert np.abs(first[0][0] - first[1][0]).max() > 1e-3  # the runs differ


def test_the_function_that_is_kept_takes_parameters_as_they_come() -> None:
    problem = mass_chain.problem(masses=4)
    statement = problem.statement()
    mesh = mesh_of(statement)
    trajectory = own_start(statement, mesh, statement.values).trajectory
    runs = [refined_run(statement, mesh, trajectory, (1.0 + k) * statement.values) for k in range(MANY)]
    own = refined_run(statement, mesh_of(statement), trajectory, MANY * statement.values)
    np.testing.assert_allclose(flat(runs[-1]), flat(own), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("times", [1, MANY])
def test_the_states_of_one_run_are_those_of_scipy(times: int) -> None:
    statement = mass_chain.problem(masses=2).statement()
    mesh = mesh_of(statement, substeps=8, segments=1)
    trajectory = own_start(statement, mesh, statement.values).trajectory
    for _ in range(times):
        found = refined_states(statement, mesh, trajectory, statement.values)
        jumps = refined_run(statement, mesh, trajectory, statement.values).jumps
    T, nodes = trajectory.duration, mesh.nodes

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        u = np.interp(t / T, nodes, trajectory.u[:, 0])
        D, dD = np.array([x[0], x[1] - x[0]]), np.array([x[2], x[3] - x[2]])
        f = mass_chain.STIFFNESS * D + mass_chain.CUBIC * D**3 + mass_chain.DAMPING * dD
        return np.array([x[2], x[3], u - f[0] + f[1], -f[1]])

    states = [trajectory.x[0]]
    for begin, stop in zip(T * nodes[:-1], T * nodes[1:], strict=True):  # the control has corners at the nodes
        states.append(solve_ivp(rate, (begin, stop), states[-1], rtol=1e-10, atol=1e-12).y[:, -1])
    np.testing.assert_allclose(found, states, atol=2e-6)
    np.testing.assert_allclose(trajectory.x[-1] + jumps[-1], states[-1], atol=2e-6)


def test_without_the_compiled_passage_the_runs_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    statement = unknown_lag.problem().statement()
    compiled, plain = (mesh_of(statement) for _ in range(2))
    trajectory = own_start(statement, compiled, statement.values).trajectory
    for _ in range(MANY):
        there = refined_run(statement, compiled, trajectory, statement.values)
    monkeypatch.setattr("covocp.transcription.shooting.functions", lambda: None)
    for _ in range(MANY):
        without = refined_run(statement, plain, trajectory, statement.values)
    np.testing.assert_allclose(flat(without), flat(there), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("expected", [False, True])
def test_large_matrices_pass_in_short_runs_to_the_same_numbers(monkeypatch: pytest.MonkeyPatch, expected: bool) -> None:
    problem = mass_chain.problem(masses=4) if not expected else unknown_lag.steering()
    statement = problem.statement()
    whole, short = (mesh_of(statement, substeps=3) for _ in range(2))
    trajectory = own_start(statement, whole, statement.values).trajectory
    at_once = refined_run(statement, whole, trajectory, statement.values)
    monkeypatch.setattr("covocp.transcription.sequences.NUMERIC_ENTRIES", 1)
    parted = refined_run(statement, short, trajectory, statement.values)
    np.testing.assert_allclose(flat(parted), flat(at_once), rtol=1e-13, atol=1e-14)
    assert np.ptp(parted.matrices, axis=0).max() > 1e-3  # they move


@pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"]))
def test_places_of_buffers() -> None:
    places = library.needed()["addresses"]
    one, other = np.arange(3.0), np.arange(5.0)
    found = places((memoryview(one), None, memoryview(other).toreadonly()))
    assert found == (one.ctypes.data, None, other.ctypes.data)
    assert places(()) == ()
    with pytest.raises(TypeError):
        places((1.5,))
