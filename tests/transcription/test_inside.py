"""Trajectories inside their intervals: right, and the same in compiled code as by CasADi's operations."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from random_problems import draw
from scipy.integrate import solve_ivp

import covocp as co
from covocp.base.buffered import Matrices
from covocp.base.matrices import half_length, pack, unpack
from covocp.models import lqg_double_integrator, mass_chain, unknown_gain, unknown_lag
from covocp.transcription.inside import inside_interval, inside_intervals
from covocp.transcription.mesh import Mesh, Options
from covocp.transcription.shooting import interval_columns
from covocp.transcription.starts import own_start
from covocp.transcription.stiffness import resolve_mesh


def started(problem: co.Problem, **options: object) -> tuple[object, Mesh, tuple[object, ...]]:
    """Statement, mesh, and nodes, controls, terminal time and parameters of a start with controls that vary."""
    statement = problem.statement()
    mesh = resolve_mesh(statement, Options(**options), statement.values)  # type: ignore[arg-type]
    guess = own_start(statement, mesh, statement.values).trajectory
    u = guess.u + 0.1 * np.sin(np.arange(guess.u.size)).reshape(guess.u.shape) * (1 + np.abs(guess.u))
    return statement, mesh, (np.hstack([guess.x, guess.e]), u, guess.duration, statement.values)


@pytest.mark.parametrize("seed", range(6))
def test_an_interval_is_integrated_from_its_node(seed: int) -> None:
    drawn = draw(seed)
    statement, mesh, (nodes, u, duration, values) = started(drawn.problem, intervals=12)
    inside = inside_intervals(statement, mesh, nodes, u, duration, values, 128)  # type: ignore[arg-type]
    nx, rows = statement.nx, drawn.E0.shape[0]  # type: ignore[attr-defined]
    h, k = duration / 12, 5  # type: ignore[operator]

    def rate(t: float, z: np.ndarray) -> np.ndarray:
        share = t / h - k
        control = u[k] + share * (u[k + 1] - u[k])  # type: ignore[index]
        moved, grown, _ = drawn.rates(z[:nx], unpack(z[nx:], rows), control, t, drawn.mean)
        return np.concatenate([np.ravel(moved.full()), pack(grown.full())])

    assert nodes.shape[1] == nx + half_length(rows)  # type: ignore[attr-defined]
    span = (k * h, (k + 1) * h)
    exact = solve_ivp(rate, span, nodes[k], rtol=1e-11, atol=1e-13, t_eval=np.linspace(*span, 129)).y.T  # type: ignore[index]
    np.testing.assert_allclose(inside[k], exact, rtol=2e-6, atol=2e-6 * np.abs(exact).max())


def test_a_variance_that_nothing_moves_stays() -> None:
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    b = ocp.unknown("b", mean=1.0, variance=0.5)
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2 + b**2)
    statement, mesh, given = started(ocp, intervals=8)
    nodes, u_values, duration, values = given
    inside = inside_intervals(statement, mesh, nodes, u_values, duration, values, 2)  # type: ignore[arg-type]
    np.testing.assert_allclose(inside[:, :, statement.nx :] - nodes[0, statement.nx :], 0.0, atol=1e-12)  # type: ignore[attr-defined,index]


PROBLEMS = {
    "chain": lambda: mass_chain.problem(masses=4),
    "gain": unknown_gain.problem,
    "lag": unknown_lag.problem,
    "loop": lqg_double_integrator.problem,  # S runs backward
}


@pytest.mark.parametrize("count", [1, 2, 3, 6])
@pytest.mark.parametrize("name", PROBLEMS)
def test_compiled_code_gives_what_casadi_gives(name: str, count: int) -> None:
    statement, mesh, given = started(PROBLEMS[name](), intervals=40, substeps=2)
    nodes, u, duration, values = given
    found = inside_intervals(statement, mesh, nodes, u, duration, values, count)  # type: ignore[arg-type]
    columns = interval_columns(mesh, ca.DM(u.T), duration, ca.DM(values))  # type: ignore[attr-defined,arg-type]
    function = Matrices(inside_interval(statement, count, mesh.step).map(40))  # type: ignore[arg-type]
    (other,) = function.evaluated(nodes[:-1].T, nodes[1:].T, *columns)  # type: ignore[index]
    other = other.T.reshape(found.shape)
    sizes = np.maximum(np.abs(other).max(axis=(0, 1)), np.finfo(float).tiny)
    np.testing.assert_allclose(found / sizes, other / sizes, rtol=0, atol=1e-9)
