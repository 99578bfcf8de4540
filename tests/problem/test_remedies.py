"""What an error says of a statement is so, and its remedy works."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co


def pair(noise, **at):
    ocp = co.Problem(2.0)
    x, v = ocp.state("x", initial=0.0, variance=0.2), ocp.state("v", initial=1.0, variance=0.1)
    R = ocp.parameter("R", [[0.05, 0.01], [0.01, 0.08]])
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=0.02)
    ocp.measurement("two", ca.vertcat(x, v), noise=noise(R), **at)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x, x])
    return ocp


@pytest.mark.parametrize("at", [{}, {"at": [1.0, 2.0]}])
def test_a_matrix_parameter_as_noise(at):
    """Its remedy gives the noise of its numbers, and refuses others by name."""
    with pytest.raises(co.ProblemError) as caught:
        pair(lambda R: 2 * R, **at)
    assert "of 'two' is symmetric only where 'R' is" in str(caught.value)
    assert caught.value.remedy == "write (R + R.T) / 2 for R"
    ocp = pair(lambda R: (R + R.T) / 2, **at)
    plain = pair(lambda R: np.array([[0.05, 0.01], [0.01, 0.08]]), **at)
    costs = [co.evaluate(problem, nominal={"u": 0.0}, intervals=5).cost for problem in (ocp, plain)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-12)
    with pytest.raises(co.ProblemError, match="of 'two' is not positive semidefinite"):
        co.evaluate(ocp, nominal={"u": 0.0}, intervals=5, parameters={"R": [[0.05, 0.2], [0.2, 0.08]]})


def test_a_matrix_that_no_parameter_makes_symmetric():
    with pytest.raises(co.ProblemError, match="of 'two' is not symmetric"):
        pair(lambda R: R @ ca.DM([[1.0, 2.0], [0.0, 1.0]]))


def test_an_instant_that_is_to_be_chosen():
    ocp = co.Problem(2.0)
    x = ocp.state("x", initial=0.0, variance=0.2)
    when = ocp.decision("when", guess=1.0, lower=0.5, upper=1.5)
    for at in ([when], when, [0.2, when]):
        with pytest.raises(
            co.ProblemError, match="instants at= of the measurement 'fix' contain an expression"
        ) as caught:
            ocp.measurement("fix", x, noise=0.1, at=at)
        assert "phase" in caught.value.remedy


def test_knots_of_another_shape():
    knots, values = [0.0, 1.0, 2.0], np.ones((3, 3))
    with pytest.raises(co.ProblemError, match=r"'map' has knots of another shape") as caught:
        co.table("map", [knots, knots], values)
    assert "a tuple" in caught.value.expected
    assert caught.value.received == "shape (2, 3)"
    assert co.table("map", (knots, knots), values)(0.5, 0.5) is not None
    with pytest.raises(co.ProblemError, match="'map' has knots that are not finite"):
        co.table("map", [0.0, np.nan, 2.0], values[0])


def test_several_numbers_for_one_entry_may_mean_several_entries():
    ocp = co.Problem(2.0)
    with pytest.raises(co.ProblemError, match="initial value of 'x' has the wrong size") as caught:
        ocp.state("x", initial=[0.2, 0.0])
    assert "declare 'x' with 2 entries (shape=2)" in caught.value.remedy
    assert ocp.state("x", shape=2, initial=[0.2, 0.0]).shape == (2, 1)
