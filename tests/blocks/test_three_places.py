"""One Kalman-Bucy rate in an optimal control problem, in scipy's simulation and in C: the same covariance."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from compiled import compile_function
from scipy.integrate import solve_ivp

import covocp as co
from covocp.base.matrices import pack, unpack
from covocp.blocks import kalman

START = np.diag([1.0, 2.0])
DURATION = 1.0
INTERVALS = 200


def rate(E, x):
    """The block, once: first-order lag dx = -b x + u with b = 1 unknown, measured with noise."""
    return kalman.rate(E, ca.blockcat([[-1.0, -x], [0.0, 0.0]]), [1.0, 0.0], np.diag([0.3, 0.0]), 0.5)


def optimal_control_problem():
    """E is a symmetric state whose rate is the block; its final entry is in the cost."""
    ocp = co.Problem(DURATION)
    x = ocp.state("x", initial=0.0, final=1.0)
    u = ocp.control("u")
    E = ocp.symmetric("E", 2, initial=START, lower=0.0)
    ocp.dynamics(x, -x + u)
    ocp.dynamics(E, rate(E, x))
    ocp.minimize(running=0.5 * u**2, terminal=5.0 * E[1, 1])
    return ocp


@pytest.fixture(scope="module")
def solution():
    return co.solve(optimal_control_problem(), intervals=INTERVALS, substeps=4, progress=False)


@pytest.fixture(scope="module")
def simulated(solution):
    """E(T) by solve_ivp, interval by interval: u is linear between the nodes."""
    E, x = ca.SX.sym("E", 2, 2), ca.SX.sym("x")
    block = ca.Function("rate", [E, x], [rate(E, x)])

    def slope(t, z, start, ends):
        u = ends[0] + (t - start) * INTERVALS / DURATION * (ends[1] - ends[0])
        return np.concatenate([[-z[0] + u], pack(block(unpack(z[1:], 2), z[0]).full())])

    z = np.concatenate([[0.0], pack(START)])
    for k in range(INTERVALS):
        span, ends = solution.t[k : k + 2], solution["u"][k : k + 2]
        z = solve_ivp(slope, span, z, args=(span[0], ends), rtol=1e-13, atol=1e-15, method="DOP853").y[:, -1]
    return z


def test_optimal_control_problem_uses_it_as_a_riccati_rate(solution):
    form = optimal_control_problem().statement().riccati[0]
    assert form is not None  # recognised: so its steps keep E positive semidefinite
    assert np.abs(solution["u"]).max() > 0.1


def test_simulation_agrees_with_the_optimal_control_problem(solution, simulated):
    assert solution["x"][-1] == pytest.approx(simulated[0], abs=1e-10)
    np.testing.assert_allclose(solution["E"][-1], unpack(simulated[1:], 2), rtol=0, atol=1e-10)


@pytest.mark.needs_cc
def test_c_code_agrees_with_both(solution, simulated, tmp_path):
    """The rate itself is compiled; classical Runge-Kutta steps around it."""
    E, x = ca.SX.sym("E", 2, 2), ca.SX.sym("x")
    code = compile_function(ca.Function("rate", [E, x], [rate(E, x)]), tmp_path)
    state, P, steps = 0.0, START, 4
    for k in range(INTERVALS):
        h = (solution.t[k + 1] - solution.t[k]) / steps
        first, last = solution["u"][k : k + 2]
        for j in range(steps):
            u = [first + (last - first) * (j + c) / steps for c in (0.0, 0.5, 1.0)]
            k1, e1 = -state + u[0], code(P, state)[0]
            k2, e2 = -(state + h / 2 * k1) + u[1], code(P + h / 2 * e1, state + h / 2 * k1)[0]
            k3, e3 = -(state + h / 2 * k2) + u[1], code(P + h / 2 * e2, state + h / 2 * k2)[0]
            k4, e4 = -(state + h * k3) + u[2], code(P + h * e3, state + h * k3)[0]
            state, P = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), P + h / 6 * (e1 + 2 * e2 + 2 * e3 + e4)
    np.testing.assert_allclose(P, unpack(simulated[1:], 2), rtol=0, atol=1e-10)
    np.testing.assert_allclose(P, solution["E"][-1], rtol=0, atol=1e-10)
