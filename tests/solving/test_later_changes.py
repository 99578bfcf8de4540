"""What a solver was built from stays as it was; matrices that need not be semidefinite; what cannot be pickled."""

from __future__ import annotations

import copy
import pickle

import casadi as ca
import numpy as np
import pytest

import covocp as co


def lag() -> co.Problem:
    """A lag of unknown rate in closed loop."""
    ocp = co.Problem(4.0)
    x, b = ocp.state("x", initial=0.5, variance=0.5), ocp.unknown("b", 1.0, 0.2)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=0.1)
    ocp.measurement("m", x, noise=0.2)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal_weight={"x": 1.0})
    return ocp


def general(initial: np.ndarray) -> co.Problem:
    """A symmetric matrix that is no covariance, and drives the cost."""
    ocp = co.Problem(2.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    P = ocp.symmetric("P", 2, initial=initial)
    ocp.dynamics(x, -x + u)
    A = ca.blockcat([[0, 1], [x, -1]])
    ocp.dynamics(P, A @ P + P @ A.T + 0.1 * np.eye(2))
    ocp.minimize(running=u**2 + x**2, terminal=P[0, 0] ** 2 + P[1, 1])
    return ocp


def test_what_is_declared_later_belongs_to_later_solvers():
    """The classical design beside a solution is that of the problem that was solved."""
    ocp, untouched = lag(), co.Solver(lag(), intervals=20).solve(progress=False)
    solver = co.Solver(ocp, intervals=20)
    ocp.subject_to(ocp.controls[0].symbol, lower=-0.05, upper=0.05, name="late")
    found = solver.solve(progress=False)
    assert found.cost == pytest.approx(untouched.cost, rel=1e-9)
    assert found.stats["classical_cost"] == pytest.approx(untouched.stats["classical_cost"], rel=1e-9)
    limited = co.solve(ocp, intervals=20, progress=False)
    assert limited.cost > found.cost * 1.001
    assert np.abs(limited["u"]).max() < 0.051


def test_an_initial_value_that_is_no_covariance_may_be_indefinite_but_not_unsymmetric():
    solver, start = co.Solver(general(np.eye(2)), intervals=10), np.array([[1.0, 0.5], [0.5, -2.0]])
    found = solver.solve(covariance={"P": start}, progress=False)
    assert found.cost == pytest.approx(co.solve(general(start), intervals=10, progress=False).cost, rel=1e-7)
    for wrong in (np.array([[1.0, 2.0], [0.0, 1.0]]), np.array([[1e-9, 8e-10], [0.0, -1e-9]])):
        with pytest.raises(co.ProblemError, match="'P' is not symmetric") as moved:
            solver.solve(covariance={"P": wrong}, progress=False)
        with pytest.raises(co.ProblemError, match="'P' is not symmetric") as declared:
            general(wrong)
        assert moved.value.expected == declared.value.expected == "a symmetric matrix"


def test_a_guess_of_a_matrix_is_symmetric_in_its_own_size():
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    P = ocp.symmetric("P", 2, initial=None, guess=np.array([[1e-9, 8e-10], [0.0, 1e-9]]), final=1e-9 * np.eye(2))
    ocp.dynamics(x, -x + u)
    ocp.dynamics(P, x * P)
    ocp.minimize(running=u**2)
    with pytest.raises(co.ProblemError, match="guess of 'P' does not fit"):
        co.solve(ocp, intervals=10, progress=False)


def test_what_cannot_be_pickled_says_what_can(tmp_path):
    problem = lag()
    solver = co.Solver(problem, intervals=20)
    solution = solver.solve(progress=False)
    for thing in (problem, solver, solution):
        with pytest.raises(co.ProblemError, match=r"solution\.save\(path\)"):
            pickle.dumps(thing)
    assert copy.deepcopy(solution).cost == copy.copy(solution).cost == solution.cost
    solution.save(tmp_path / "plan.npz")
    again = pickle.loads(pickle.dumps(co.load(tmp_path / "plan.npz")))
    assert again.cost == solution.cost
