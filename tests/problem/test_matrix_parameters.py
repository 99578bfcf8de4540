"""Parameters that are matrices: in the shape in which they were declared, and changed without rebuilding."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

import covocp as co

A = np.array([[0.0, 1.0], [-0.4, -0.3]])
B = np.array([[0.1], [1.0]])


def regulator(drift=A) -> tuple[co.Problem, ca.MX]:
    """A linear regulator over a time that is long beside its closed loop."""
    ocp = co.Problem(25.0)
    x, u = ocp.state("x", 2, initial=[1.0, -0.5]), ocp.control("u", guess=0.0)
    matrix = ocp.parameter("A", drift)
    assert matrix.shape == (2, 2)
    ocp.dynamics(x, matrix @ x + ca.DM(B) @ u)
    ocp.minimize(running=0.5 * (ca.sumsqr(x) + u**2))
    return ocp, matrix


def cost(drift) -> float:
    start = np.array([1.0, -0.5])
    return float(0.5 * start @ solve_continuous_are(drift, B, np.eye(2), np.eye(1)) @ start)


def test_a_matrix_is_taken_as_a_matrix_by_name_and_by_symbol():
    ocp, matrix = regulator()
    solver = co.Solver(ocp, intervals=200)
    assert solver.solve().cost == pytest.approx(cost(A), rel=1e-4)
    other = np.array([[-0.2, 0.7], [0.1, -0.9]])
    for key in ("A", matrix):
        found = solver.solve({key: other})
        assert found.cost == pytest.approx(cost(other), rel=1e-4)
        assert found.parameters.reshape(2, 2, order="F") == pytest.approx(other)
    assert solver.solve(initial={"x": [2.0, -1.0]}, parameters={"A": other}).cost == pytest.approx(
        4 * cost(other), 1e-4
    )


def test_other_shapes_are_refused():
    ocp, matrix = regulator()
    for wrong in (np.ones(4), 1.0, np.ones((3, 2)), np.ones((1, 4))):
        with pytest.raises(co.ProblemError, match="The value of 'A' has the wrong size"):
            co.Solver(ocp, intervals=10).solve({matrix: wrong})
    with pytest.raises(co.ProblemError, match="NaN or inf"):
        co.Problem(1.0).parameter("A", [[1.0, np.nan], [0.0, 1.0]])
