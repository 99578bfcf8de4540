"""The Hessian of the reduced method where the cost is concave stays definite, and no run ends in an error of numpy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.solvers.reduced import sequence
from covocp.solvers.reduced.curvature import Curvature, learnt
from covocp.solvers.reduced.subproblem import Quadratic, solved


def pendulum() -> co.Problem:
    """An inverted pendulum whose gain is unknown; its controls reach their bounds."""
    ocp = co.Problem(3.0)
    x = ocp.state("x", 2, initial=(0.5, 0.0), variance=[1e-3, 1e-3])
    b = ocp.unknown("b", mean=1.0, variance=0.1)
    u = ocp.control("u", lower=-20, upper=20)
    ocp.dynamics(x, ca.vertcat(x[1], 9.81 * ca.sin(x[0]) - b * u * ca.cos(x[0])), noise=[0, 1e-3])
    ocp.measurement("y", x[0], noise=1e-3)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.01 * u**2 + 5 * x[0] ** 2 + 0.1 * x[1] ** 2, terminal=E[b, b])
    return ocp


def test_steps_along_concave_directions_leave_the_hessian_definite():
    """Each leaves a tenth of the curvature: before what is left is roundoff, the Hessian is told to be lost."""
    rng, n = np.random.default_rng(3), 6
    curvature = Curvature.of(np.diag(np.linspace(1.0, 2.0, n)))
    directions = rng.normal(size=(2, n))
    for k in range(60):
        step = directions[k % 2]
        more = learnt(curvature, step, -100.0 * step)
        if more is None:
            break
        curvature = more
        assert np.linalg.eigvalsh(curvature.matrix)[0] > 0.0
        assert np.abs(curvature.matrix @ curvature.inverse - np.eye(n)).max() < 1e-5
    assert more is None
    assert k > 1


def test_subproblems_whose_inverse_has_lost_its_rank_are_solved():
    """With a diagonal Hessian each entry is where its own parabola has its least value, or at its bound."""
    n = 3
    inverse = np.eye(n)
    inverse[1:, 1:] = 1e17
    problem = Quadratic(
        curvature=np.eye(n),
        inverse=inverse,
        slope=np.array([-0.25, -3.0, 3.0]),
        rows=np.zeros((0, n)),
        lower=np.zeros(0),
        upper=np.zeros(0),
        low=-np.ones(n),
        high=np.ones(n),
    )
    step = solved(problem, np.zeros(0), np.array([0.0, 1.0, -1.0]))
    assert step is not None
    assert step.change == pytest.approx([0.25, 1.0, -1.0], abs=1e-9)
    assert step.of_bounds == pytest.approx([0.0, 2.0, -2.0], abs=1e-9)


def test_a_pendulum_with_an_unknown_gain_is_solved():
    """It ended in a singular matrix; the point found is stationary by H_u, and no worse than that of Ipopt."""
    with pytest.warns(co.CovocpWarning, match="along these controls alone"):  # it stays upright, by one segment
        found = co.solve(pendulum(), "reduced", intervals=40, progress=False)
    assert found.optimality.stationarity < 1e-4
    other = co.solve(pendulum(), "ipopt", intervals=40, progress=False)
    assert found.cost <= other.cost * (1.0 + 1e-6)


def test_what_numpy_cannot_solve_is_a_run_that_failed(monkeypatch):
    """Then "reduced" says so, and "auto" ends where Ipopt does."""

    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    ocp = pendulum()
    expected = co.solve(ocp, "ipopt", intervals=40, progress=False)
    monkeypatch.setattr(sequence, "solved", singular)
    with pytest.raises(co.SolveError, match="Singular matrix"):
        co.solve(ocp, "reduced", intervals=40, progress=False)
    found = co.solve(ocp, "auto", intervals=40, progress=False)
    assert found.method == "ipopt"
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)


def test_a_step_too_small_to_be_told_from_nothing_teaches_nothing():
    """The product of step and difference underflows: there is no curvature to be read from it."""
    curvature, step = Curvature.of(np.eye(2)), np.array([3e-162, 0.0])
    assert learnt(curvature, step, -step) is curvature
