"""Steps of an exported solver that are too long for what it is given: against its own controls, integrated by scipy."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from exports import quick
from scipy.integrate import solve_ivp

import covocp as co
from covocp.models import unknown_lag


def drag(speed: float = 1.0, drag: float = 0.5) -> co.Problem:
    """A car with quadratic drag that shall be somewhere at a time."""
    ocp = co.Problem(duration=3.0, name="drag")
    s, v, u = ocp.state("s", initial=0.0, final=6.0), ocp.state("v", initial=speed), ocp.control("u")
    k = ocp.parameter("k", drag)
    ocp.dynamics(s, v)
    ocp.dynamics(v, u - k * v * ca.sqrt(v**2 + 1e-4))
    ocp.minimize(running=0.5 * u**2)
    return ocp


def place_and_cost(plan: dict[str, Any], speed: float, k: float) -> tuple[float, float]:
    t, u, y = plan["time"], np.ravel(plan["u"]), np.array([0.0, speed, 0.0])
    for a, b, before, after in zip(t[:-1], t[1:], u[:-1], u[1:], strict=True):

        def rate(q: float, y: Any, a=a, b=b, before=before, after=after) -> list[float]:
            force = before + (after - before) * (q - a) / (b - a)
            return [y[1], force - k * y[1] * np.sqrt(y[1] ** 2 + 1e-4), 0.5 * force**2]

        y = solve_ivp(rate, (a, b), y, rtol=1e-10, atol=1e-12).y[:, -1]
    return float(y[0]), float(y[2])


@pytest.fixture(scope="module")
def drag_solver(tmp_path_factory):
    return quick(co.export_c(drag(), tmp_path_factory.mktemp("drag") / "drag", intervals=20)).python()


@pytest.mark.parametrize(("speed", "k"), [(1.0, 0.5), (0.5, 0.5), (2.0, 0.5), (3.0, 0.5), (1.0, 1.0)])
def test_what_is_ok_is_where_its_controls_lead(drag_solver, speed: float, k: float) -> None:
    plan = drag_solver.solve(initial_v=speed, k=k)
    assert plan["status"] == "OK"
    place, cost = place_and_cost(plan, speed, k)
    assert place == pytest.approx(6.0, rel=4e-3)
    assert cost == pytest.approx(plan["cost"], rel=1e-6)


@pytest.mark.parametrize(("speed", "k"), [(8.0, 0.5), (10.0, 0.5), (20.0, 0.5), (40.0, 0.5), (4.0, 10.0)])
def test_a_plan_for_a_plant_that_is_none_is_not_ok(drag_solver, speed: float, k: float) -> None:
    """Its residuals are zero: the steps are too long."""
    plan = drag_solver.solve(initial_v=speed, k=k)
    assert plan["status"] in ("COARSE", "NOT_CONVERGED")
    place, _ = place_and_cost(plan, speed, k)
    optimum = co.solve(drag(speed, k), intervals=60, substeps=8, progress=False).cost
    assert abs(place - 6.0) > 4e-3 * 6.0 or abs(plan["cost"] / optimum - 1.0) > 0.01


def test_shorter_steps_bear_it(tmp_path) -> None:
    made = co.export_c(drag(), tmp_path / "drag", intervals=20, substeps=8).reference()
    plan = made.solve(initial_v=10.0)
    assert plan["status"] == "OK"
    assert place_and_cost(plan, 10.0, 0.5)[0] == pytest.approx(6.0, rel=1e-3)


def test_what_was_told_at_the_export_is_not_told_again(tmp_path) -> None:
    """On five intervals of one step the problem itself is coarse: Python says so."""
    with pytest.warns(co.CovocpWarning):
        co.solve(unknown_lag.problem(weight=1000.0), intervals=5, substeps=1, progress=False)
    with pytest.warns(co.CovocpWarning):
        made = co.export_c(unknown_lag.problem(weight=1000.0), tmp_path / "lag", intervals=5, substeps=1)
    assert made.reference().solve()["status"] == "OK"


@pytest.fixture(scope="module")
def lag_solver(tmp_path_factory):
    made = co.export_c(unknown_lag.problem(weight=10.0), tmp_path_factory.mktemp("lag") / "lag", intervals=20)
    return made.reference()


@pytest.mark.parametrize(("given", "status"), [({}, "OK"), ({"b": 5.0}, "COARSE"), ({"duration": 60.0}, "COARSE")])
def test_a_faster_lag_and_a_longer_time(lag_solver, given: dict[str, float], status: str) -> None:
    """Found by scipy to cost 57.2 for 46.5, and 23.5 for 2.31."""
    assert lag_solver.solve(**given)["status"] == status
