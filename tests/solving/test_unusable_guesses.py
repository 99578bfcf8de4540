"""A solution as a guess, along which the model gives no numbers for other values: the run begins elsewhere.

The references are the Hamiltonian, which is constant along an optimum, and steps of covariances that never overflow.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import covocp as co


def walled() -> co.Problem:
    """A state that must not come to the wall, of which the logarithm is the cost."""
    ocp = co.Problem(2.0, name="walled")
    wall = ocp.parameter("wall", 3.0)
    x = ocp.state("x", initial=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * u**2 - x - 0.1 * ca.log(wall - x))
    return ocp


def sensed() -> co.Problem:
    """An unknown lag: explicit steps must be the shorter the larger the covariance and the better the sensor."""
    ocp = co.Problem(4.0, name="sensed")
    density, gusts = ocp.parameter("density", 1.0), ocp.parameter("gusts", 100.0)
    x = ocp.state("x", initial=0.0, final=1.0, variance=1e-3)
    b = ocp.unknown("b", mean=1.0, variance=0.5)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=gusts)
    ocp.measurement("y", x, noise=density)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=10.0 * E[b, b])
    return ocp


@pytest.mark.parametrize("elapsed", [None, 0.0])
def test_a_solution_beyond_the_wall_is_left_for_the_own_start(elapsed):
    """It had been refused as an error of the problem: 'The cost running is nan along the initial guess.'"""
    solver = co.Solver(walled(), intervals=20)
    plan = solver.solve(progress=False)
    assert plan["x"].max() > 1.0
    with pytest.warns(co.CovocpWarning, match="own start was taken: The cost 'running' is nan"):
        found = solver.solve({"wall": 1.0}, guess=plan, elapsed=elapsed, progress=False)
    x, u = found["x"].ravel(), found["u"].ravel()
    hamiltonian = -0.5 * u**2 - x - 0.1 * np.log(1.0 - x)
    assert np.ptp(hamiltonian) < 1e-3
    assert u[-1] == pytest.approx(0.0, abs=1e-2)


def test_numbers_of_the_users_own_are_refused_where_they_give_none():
    solver = co.Solver(walled(), intervals=20)
    for guess in (2.0, np.linspace(0.0, 2.0, 21), lambda s: 2.0 * s):
        with pytest.raises(co.ProblemError, match="The cost 'running' is nan along the initial guess"):
            solver.solve({"wall": 1.0}, guess={"x": guess}, progress=False)


def test_covariances_of_another_sensor_are_made_anew():
    """Along them the steps that the new sensor needs were too long: only the nominal is what may be kept."""
    values = {"density": 1e-2, "gusts": 1.0}
    solver = co.Solver(sensed(), intervals=40, covariances="states", covariance_step="rk4")
    plan = solver.solve(progress=False)
    other = co.Solver(sensed(), intervals=40, covariance_step="gauss").solve(values, progress=False)
    found = solver.solve(values, guess=plan, progress=False)
    assert found.cost == pytest.approx(other.cost, rel=1e-4)
