"""Rates and measurements through a linear system that CasADi solves, as by a mass matrix, are those written out."""

from __future__ import annotations

import casadi as ca
import pytest
from problems import unassessed

import covocp as co


def solved(M, v):
    """By CasADi, an operation that has no scalar form."""
    return ca.solve(M, v)


def written(M, v):
    """By the adjugate."""
    det = M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]
    return ca.vertcat(M[1, 1] * v[0] - M[0, 1] * v[1], M[0, 0] * v[1] - M[1, 0] * v[0]) / det


def cost(by, more):
    """Of two joints; more(problem, x, by(M, x)) states what else there is."""
    ocp = co.Problem(3.0)
    x, u = ocp.state("x", 2, initial=[0.0, 0.0], variance=[0.04, 0.01]), ocp.control("u")
    M = ca.vertcat(ca.horzcat(2 + ca.cos(x[0]), 0.1), ca.horzcat(0.1, 1.0))
    ocp.dynamics(x, by(M, ca.vertcat(x[1] * 2, u)), noise=[0.0, 0.05])
    ocp.measurement("position", x[0], noise=0.02)
    ocp.minimize_expected(running=0.1 * u**2 + (x[0] - 1) ** 2)
    more(ocp, x, by(M, x))
    return unassessed(ocp, intervals=8).cost


STATED = {
    "chance": lambda ocp, x, z: ocp.chance(x[0], upper=1.4, probability=0.95, name="wall"),
    "variance": lambda ocp, x, z: ocp.subject_to(ocp.closed_loop_covariance()[x[0], x[0]], upper=0.5, at="final"),
    "reading": lambda ocp, x, z: ocp.measurement("fix", x[0], noise=0.02, at=[1.0, 2.0]),
    "reading through it": lambda ocp, x, z: ocp.measurement("fix", z, noise=[0.02, 0.01], at=[1.0, 2.0]),
    "correlated": lambda ocp, x, z: ocp.measurement("fix", z, noise=[[0.02, 0.005], [0.005, 0.01]], at=[1.0, 2.0]),
}


@pytest.mark.parametrize("more", STATED.values(), ids=STATED)
def test_a_system_that_casadi_solves_is_the_one_written_out(more):
    assert cost(solved, more) == pytest.approx(cost(written, more), rel=1e-7)
