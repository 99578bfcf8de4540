"""Problems are values: what is derived from one leaves it as it was."""

import dataclasses

import casadi as ca
import pytest

import covocp as co
from covocp.models import unknown_lag
from covocp.problem.expected_cost import derive, deterministic


def test_declarations_are_frozen():
    own = unknown_lag.steering().declarations
    with pytest.raises(dataclasses.FrozenInstanceError):
        own.name = "other"


def test_each_call_makes_other_declarations_and_another_statement():
    ocp = co.Problem(duration=1.0)
    x = ocp.state("x", initial=1.0)
    before = ocp.declarations
    u = ocp.control("u")
    assert before.controls == ()
    assert [control.name for control in ocp.controls] == ["u"]
    ocp.dynamics(x, -x + u)
    ocp.minimize(running=u**2)
    first = ocp.statement()
    assert ocp.statement() is first
    ocp.subject_to(x**2, upper=4.0)
    assert ocp.statement() is not first
    assert ocp.statement().path.size == 1


def test_derived_problems_leave_the_original():
    ocp = unknown_lag.steering()
    own = ocp.declarations
    combined, classical = derive(own), deterministic(own)
    assert ocp.declarations is own
    assert {matrix.name for matrix in combined.matrices} == {"E", "S"}
    assert own.cost is None
    assert combined.cost is not None
    assert classical.expected is None
    assert classical.matrices == ()


def test_a_problem_of_the_same_declarations_is_the_same_problem():
    ocp = unknown_lag.problem(final=1.0)
    again = co.Problem.of(ocp.declarations)
    costs = [co.solve(problem, intervals=20, substeps=1, progress=False).cost for problem in (ocp, again)]
    assert costs[0] == costs[1]
    assert ca.is_equal(again.time, ocp.time)


def test_none_is_no_symbol():
    """Not the first state either, which has no matrix."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, variance=1.0), ocp.control("u")
    with pytest.raises(co.ProblemError, match=r"dynamics\(\)(?s:.)*received: None"):
        ocp.dynamics(None, u)
    ocp.dynamics(x, u, noise=0.1)
    with pytest.raises(co.ProblemError, match=r"received: None"):
        ocp.minimize_expected(running=u**2, terminal_weight={None: 2.0})
    S = ocp.symmetric("S", 2, initial=ca.DM.eye(2))
    ocp.dynamics(S, -S)  # the whole matrix still is one
