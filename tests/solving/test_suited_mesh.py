"""Steps of a problem that is solved for other values than those declared go with the former."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from problems import unassessed
from scipy.integrate import solve_ivp

import covocp as co

RATE = 5.0


def actuator(rate=RATE, duration=5.0):
    """A lag with an unknown gain behind an actuator, whose rate is a parameter."""
    ocp = co.Problem(duration, name="actuator")
    k = ocp.parameter("k", rate)
    x, a = ocp.state("x", initial=1.0, variance=0.1), ocp.state("a", initial=0.0)
    b, u = ocp.unknown("b", mean=1.0, variance=2.0), ocp.control("u")
    ocp.dynamics(x, -b * x + a, noise=0.01)
    ocp.dynamics(a, k * (u - a))
    ocp.measurement("m", x, noise=0.05)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2 + 0.1 * x**2, terminal=10 * E[b, b])
    return ocp


def integrated(solution, rate):
    """The cost along the controls of a solution by LSODA of scipy, rows x, a, E_xx, E_xb, E_bb, cost."""

    def slope(t, y):
        x, a = y[:2]
        u = np.interp(t, solution.t, solution["u"])
        F, E = np.array([[-1.0, -x], [0.0, 0.0]]), np.array([[y[2], y[3]], [y[3], y[4]]])
        by_t = F @ E + E @ F.T + np.diag([0.01, 0.0]) - np.outer(E[:, 0], E[0]) / 0.05
        return [a - x, rate * (u - a), by_t[0, 0], by_t[0, 1], by_t[1, 1], 0.5 * u**2 + 0.1 * x**2]

    y = np.array([1.0, 0.0, 0.1, 0.0, 2.0, 0.0])
    for begin, end in zip(solution.t[:-1], solution.t[1:], strict=True):
        y = solve_ivp(slope, (begin, end), y, method="LSODA", rtol=1e-9, atol=1e-11).y[:, -1]
    return y[5] + 10 * y[4]


@cache
def as_declared(method, rate):
    return unassessed(actuator(rate), method, intervals=40)


# At 22 the explicit step of the declared rate is beyond its limit of stability (7.4 % off), at 200 far beyond.
@pytest.mark.parametrize(
    ("method", "rate", "assess"),
    [
        *((m, rate, assess) for m in ("ipopt", "reduced") for rate in (22.0, 200.0) for assess in (True, False)),
        ("gradient", 200.0, True),
        ("gradient", 22.0, False),
    ],
)
def test_a_stiffer_plant_is_solved_as_if_it_had_been_declared(method, rate, assess):
    solver = co.Solver(actuator(), method, intervals=40)
    solution = solver.solve({"k": rate}, progress=False, assess=assess)
    assert abs(solution.cost / integrated(solution, rate) - 1) <= 1e-5
    declared = as_declared(method, rate)
    assert abs(solution.cost / declared.cost - 1) <= 1e-7
    assert (solution.mesh.step, solution.mesh.substeps) == (declared.mesh.step, declared.mesh.substeps)


def test_one_call_for_other_values_is_the_same():
    solution = co.solve(actuator(), intervals=40, parameters={"k": 200.0}, progress=False)
    assert abs(solution.cost / integrated(solution, 200.0) - 1) <= 1e-5


def test_meshes_that_refine_themselves_begin_with_such_steps():
    solution = co.Solver(actuator(), refine=1e-5).solve({"k": 200.0}, progress=False)
    assert abs(solution.cost / integrated(solution, 200.0) - 1) <= 2e-5


def test_slower_values_keep_the_mesh():
    solver = co.Solver(actuator(), intervals=40)
    first = solver.solve(progress=False)
    assert solver.solve({"k": 1.0}, progress=False).mesh is first.mesh


def test_steps_that_were_given_and_diverge_are_refused():
    solver = co.Solver(actuator(), intervals=40, step="rk4", substeps=2)
    first = solver.solve(progress=False)
    with pytest.raises(co.ProblemError, match=r"integration steps of the nominal are too long.*"):
        solver.solve({"k": 200.0}, progress=False, assess=False)
    assert abs(solver.solve(progress=False).cost / first.cost - 1) <= 1e-9


def steered(rate=RATE, prior=0.1, density=0.05):
    """A lag behind an actuator, under feedback from its filter."""
    ocp = co.Problem(5.0, name="steered")
    k, variance, noise = ocp.parameter("k", rate), ocp.parameter("P", prior), ocp.parameter("R", density)
    x, a = ocp.state("x", initial=1.0, variance=variance), ocp.state("a", initial=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, a - x, noise=0.01)
    ocp.dynamics(a, k * (u - a))
    ocp.measurement("m", x, noise=noise)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal_weight={x: 1.0})
    return ocp


def test_the_classical_design_beside_it_has_the_steps_of_these_values_too():
    solver = co.Solver(steered(), intervals=40)
    solution = solver.solve({"k": 22.0}, progress=False)
    alone = unassessed(steered(22.0), intervals=40, nominal="deterministic")
    assert solution.stats["classical_cost"] == pytest.approx(alone.cost, rel=1e-9)


@pytest.mark.parametrize("rate", [10.0, 16.0])
def test_a_stable_plant_is_not_called_unstable_by_the_steps_of_two_runs(rate):
    solution = co.solve(steered(rate), intervals=40, nominal="deterministic", progress=False)
    finer = unassessed(steered(rate), intervals=80, substeps=4, nominal="deterministic")
    assert solution.cost == pytest.approx(finer.cost, rel=1e-5)


@pytest.mark.parametrize(("name", "value"), [("P", 200.0), ("R", 1e-4)])
@pytest.mark.parametrize("options", [{}, {"covariance_step": "rk4"}, {"nominal": "deterministic"}])
def test_a_default_mesh_is_graded_for_the_values_that_are_solved_for(name, value, options):
    declared = {"P": {"prior": value}, "R": {"density": value}}[name]
    solution = co.Solver(steered(), intervals=40, **options).solve({name: value}, progress=False)
    other = unassessed(steered(**declared), intervals=40, **options)
    assert solution.t.size == other.t.size > 41
    assert solution.cost == pytest.approx(other.cost, rel=1e-7)


def test_values_that_alternate_do_not_make_the_problem_ready_again(monkeypatch):
    solver, made = co.Solver(actuator(), intervals=40), []
    solver.solve({"k": 200.0}, progress=False, assess=False)
    ready = co.Solver._ready
    monkeypatch.setattr(co.Solver, "_ready", lambda self, *args, **own: made.append(1) or ready(self, *args, **own))
    for rate in (50.0, 200.0, 5.0, 200.0):
        solver.solve({"k": rate}, progress=False, assess=False)
    assert not made
