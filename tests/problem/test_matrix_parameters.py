"""Parameters that are matrices against problems with their numbers written in."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co

A0 = np.array([[0.0, 1.0], [-2.0, -0.3]])
A1 = np.array([[0.1, 0.7], [-1.5, -0.6]])
W = np.array([[1.0, 2.0], [0.5, -1.0], [0.2, 0.3]])


def oscillator(A=A0, weight=W, *, declared: bool = True):
    """A plant x' = A x + [0; u], estimated, with a cost of three combinations of its state."""
    ocp = co.Problem(2.0)
    A, weight = (ocp.parameter("A", A), ocp.parameter("W", weight)) if declared else (ca.DM(A), ca.DM(weight))
    x = ocp.state("x", 2, initial=[1.0, 0.0], variance=0.2)
    u = ocp.control("u", lower=-2.0, upper=2.0)
    ocp.dynamics(x, A @ x + ca.vertcat(0.0, u), noise=0.05)
    ocp.measurement("m", x[0], noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2 + ca.sumsqr(weight @ x), terminal=ca.trace(E.matrix))
    return ocp, A, weight


def test_values_of_a_matrix_are_matrices():
    ocp, A, weight = oscillator()
    assert (A.shape, weight.shape) == ((2, 2), (3, 2))
    solver = co.Solver(ocp, intervals=30)
    for values, numbers in (
        ({}, (A0, W)),
        ({"A": A1}, (A1, W)),
        ({A: A1, weight: -2.0 * W}, (A1, -2.0 * W)),
        ({"W": W[::-1].copy()}, (A0, W[::-1])),
    ):
        found = solver.solve(values)
        fresh = co.solve(oscillator(*numbers, declared=False)[0], intervals=30)
        assert found.cost == pytest.approx(fresh.cost, rel=1e-9)
        assert found["x"] == pytest.approx(fresh["x"], abs=1e-6)
        assert found[A][-1] == pytest.approx(numbers[0])  # by its symbol a matrix
        assert found["W"][0] == pytest.approx(numbers[1].ravel(order="F"))  # by its name column by column


def test_matrices_from_elsewhere_in_evaluations_and_files(tmp_path):
    ocp = oscillator()[0]
    found = co.Solver(ocp, intervals=30).solve({"A": A1}, initial={"x": [0.5, -1.0]})
    plain = co.Solver(oscillator(A1, declared=False)[0], intervals=30).solve(initial={"x": [0.5, -1.0]})
    assert found.cost == pytest.approx(plain.cost, rel=1e-9)
    own = co.solve(ocp, intervals=30, parameters={"A": A1})
    again = co.evaluate(ocp, nominal=own, parameters={"A": A1})
    assert again.cost == pytest.approx(own.cost, rel=1e-7)
    own.save(tmp_path / "plan.npz")
    assert co.load(tmp_path / "plan.npz", problem=ocp)["A"] == pytest.approx(own["A"])


@pytest.mark.parametrize(
    ("name", "value"), [("A", A0.ravel()), ("A", 1.0), ("W", W.T), ("A", np.eye(3)), ("A", np.full((2, 2), np.nan))]
)
def test_values_of_another_shape_are_refused(name, value):
    with pytest.raises(co.ProblemError, match=f"The value of '{name}'"):
        co.Solver(oscillator()[0], intervals=10).solve({name: value})
