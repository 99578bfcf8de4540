"""The control of a solution is the same on every mesh: against scipy along it, where it jumps, bends or is held."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import covocp as co

QUIET: dict[str, Any] = {"progress": False}
MESHES: list[dict[str, Any]] = [
    *({"intervals": n} for n in (7, 20, 40, 45)),
    {"substeps": 4},
    {"grid": [0.0, 0.31, 1.0]},
    {"step": "rk4"},
]


def cart(gate: bool = True) -> co.Problem:
    """A cart that goes half a metre in two seconds, in the middle at 1 m/s."""
    ocp = co.Problem(2.0, name="gate")
    x, v = ocp.state("x", initial=0.0, variance=0.01), ocp.state("v", initial=0.0, variance=0.01)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u, noise=0.01)
    ocp.measurement("m", x, noise=0.01)
    ocp.estimation_covariance()
    if gate:
        ocp.subject_to(v, at=1.0, equals=1.0, name="gate")
    ocp.minimize(running=u**2, terminal=50 * (x - 0.5) ** 2 + 50 * v**2)
    return ocp


@cache
def through(control: str) -> co.Solution:
    return co.solve(cart(control == "linear"), intervals=10, control=control, **QUIET)


def cost_along(plan: co.Solution) -> float:
    """Of the cart along the control of a solution, by scipy from node to node."""
    z, nodes = np.zeros(3), np.unique(plan.t)
    for begin, end in pairwise(nodes):
        first, last = plan.controls_at([begin])[0, 0], plan.controls_at([end], before=True)[0, 0]

        def rates(t: float, y: Any, ends: Any = (begin, end, first, last)) -> list[float]:
            u = np.interp(t, ends[:2], ends[2:])
            return [y[1], u, u**2]

        z = solve_ivp(rates, (begin, end), z, rtol=1e-11, atol=1e-13).y[:, -1]
    return float(z[2] + 50 * (z[0] - 0.5) ** 2 + 50 * z[1] ** 2)


@pytest.mark.parametrize("control", ["linear", "constant"])
@pytest.mark.parametrize("mesh", MESHES, ids=str)
def test_a_control_that_jumps_or_is_held_costs_what_it_costs_on_every_mesh(control: str, mesh: dict[str, Any]) -> None:
    """Also for a problem without the condition at which it jumps."""
    plan = through(control)
    truth = cost_along(plan)
    for gate in (True, False):
        found = co.evaluate(cart(gate), nominal=plan, **mesh)
        assert found.cost == pytest.approx(truth, rel=1e-9)
        assert found.controls_at([1.0], before=True) == pytest.approx(plan.controls_at([1.0], before=True), rel=1e-12)
        assert found.mesh.control == control


def test_the_linear_control_really_jumps_and_the_printout_says_so() -> None:
    plan = through("linear")
    assert abs(plan.controls_at([1.0], before=True) - plan.controls_at([1.0])).item() > 4.0
    assert "the control jumps at 1 instant" in str(co.evaluate(cart(gate=False), nominal=plan, intervals=40))
    assert "a node for conditions at 1 instant" in str(co.evaluate(cart(), nominal=plan, intervals=40))


def test_phases_are_evaluated_along_controls_that_jump() -> None:
    def two() -> co.Phases:
        first = cart()
        second = co.Problem(1.0, name="on")
        x, v = second.state("x", initial=None), second.state("v", initial=None)
        u = second.control("u")
        second.dynamics(x, v)
        second.dynamics(v, u, noise=0.01)
        second.measurement("m", x, noise=0.01)
        second.estimation_covariance()
        second.minimize(running=u**2, terminal=50 * x**2 + 50 * v**2)
        return co.Phases([first, second])

    plan = co.solve(two(), intervals=10, **QUIET)
    found = co.evaluate(two(), nominal=plan, intervals=14)
    assert found.cost == pytest.approx(plan.cost, rel=1e-9)


def test_a_held_control_is_exact_as_a_linear_one_that_jumps() -> None:
    plan = through("constant")
    for mesh in ({}, {"intervals": 7}, {"intervals": 30}):
        found = co.evaluate(cart(gate=False), nominal=plan, control="linear", **mesh)
        assert found.cost == pytest.approx(cost_along(plan), rel=1e-9)
    near = co.evaluate(cart(gate=False), nominal=through("linear"), control="constant", intervals=200)
    assert near.cost == pytest.approx(cost_along(through("linear")), rel=1e-3)  # which none can be


def test_what_was_evaluated_where_the_control_jumps_is_saved_and_read(tmp_path: Path) -> None:
    """Nodes that are there twice without a condition had been called damage."""
    found = co.evaluate(cart(gate=False), nominal=through("linear"), intervals=12)
    found.save(tmp_path / "jump.npz")
    for read in (co.load(tmp_path / "jump.npz"), co.load(tmp_path / "jump.npz", problem=cart(gate=False))):
        np.testing.assert_array_equal(read.controls_at([1.0], before=True), found.controls_at([1.0], before=True))
        np.testing.assert_array_equal(read["u"], found["u"])


def test_a_guess_that_is_another_function_by_now_is_another_start() -> None:
    """Round an obstacle on either side, by one solver: the second start had been the first."""
    side = {"value": 1.0}
    ocp = co.Problem(2.0)
    x = ocp.state("x", 2, initial=[-1.0, 0.0], final=[1.0, 0.0])
    u = ocp.control("u", 2, guess=lambda s: np.array([1.0, side["value"] * (1.0 - 2.0 * s)]))
    ocp.dynamics(x, u)
    ocp.minimize(running=u[0] ** 2 + u[1] ** 2 + 5.0 * ca.exp(-8.0 * (x[0] ** 2 + x[1] ** 2)))
    solver = co.Solver(ocp, intervals=20)
    ways = []
    for side["value"] in (1.0, -1.0, 1.0):
        ways.append(float(solver.solve(progress=False).trajectory.x[10, 1]))
    assert ways[0] > 0.1
    assert ways == pytest.approx([ways[0], -ways[0], ways[0]], rel=1e-6)


@pytest.mark.parametrize("gate", [False, True])
def test_an_array_over_the_nodes_is_held_from_each_to_the_next(gate: bool) -> None:
    """The values of a solution as it gives them, one at each node, and without the last one."""
    plan = co.solve(cart(gate), intervals=12, control="constant", **QUIET)
    for values in (plan["u"], plan["u"][:-1]):
        found = co.evaluate(cart(gate), nominal={"u": values}, intervals=12, control="constant")
        assert found.cost == pytest.approx(cost_along(plan), rel=1e-9)
    even = np.sin(np.arange(13.0))
    for values in (even[:-1], even) if not gate else (even[:-1],):  # with the gate there are 13 intervals
        found = co.evaluate(cart(gate), nominal={"u": values}, intervals=12, control="constant")
        np.testing.assert_allclose(found.controls_at([0.1, 0.95, 1.9])[:, 0], even[[0, 5, 11]], rtol=1e-12)
