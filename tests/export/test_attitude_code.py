"""C code of problems with attitudes: solvers from other attitudes."""

from __future__ import annotations

from functools import cache
from typing import Any

import attitudes
import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, QUICK

import covocp as co
from covocp.blocks import so3
from covocp.export import CPackage, export_c

pytestmark = [pytest.mark.needs_cc, pytest.mark.filterwarnings("ignore::covocp.CovocpWarning")]  # coarse meshes
FEW: dict[str, Any] = {"intervals": 4}
GOAL = so3.exp([0.3, 1.5, -0.4])


def seen(first: Any) -> co.Problem:
    """A slew with a star, and what is known of the attitude at the end in the cost."""
    ocp = co.Problem(10.0, "seen")
    omega, torque = ocp.state("omega", 3, initial=0.0, final=0.0), ocp.control("torque", 3, lower=-8.0, upper=8.0)
    known = {"variance": [1e-2, 2e-2, 1e-2], "noise": 1e-5}
    attitude = ocp.attitude("attitude", initial=first, final=GOAL, rate=omega, **known)
    ocp.dynamics(omega, (torque - ca.cross(omega, attitudes.INERTIA @ omega)) / np.diag(attitudes.INERTIA), noise=1e-4)
    ocp.measurement("star", attitude.matrix[:, 0], 1e-4)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.01 * ca.sumsqr(torque), terminal=10.0 * ca.trace(E[attitude, attitude]))
    return ocp


MAKERS = {"slew": lambda first: attitudes.slew(first, GOAL)[0], "seen": seen}
# code of second derivatives grows with the steps
MESHES: dict[str, dict[str, Any]] = {"slew": FEW | {"substeps": 1}, "seen": FEW | {"substeps": 2}}


@cache
def solver(name: str) -> CPackage:
    return export_c(MAKERS[name](np.eye(3)), FOLDER / f"turned_{name}", **MESHES[name])


@pytest.mark.parametrize("name", ["slew", pytest.param("seen", marks=pytest.mark.slow)])
def test_plans_from_other_attitudes_cost_what_solve_says(name: str) -> None:
    """The quaternion, its opposite and one of another length are the same attitude."""
    made = solver(name)
    planner = made.reference()
    if name == "slew":  # the other takes as long again to compile, and has the same code for attitudes
        made.build(flags=QUICK)  # with -O2 it takes a minute
        assert made.check().ok
        planner = made.python()
    for vector in ([0.0, 0.0, 0.0], [0.1, -0.05, 0.02], [0.3, 0.2, -0.1]):
        first = so3.exp(vector)
        known = co.solve(MAKERS[name](first), **MESHES[name], tolerance=1e-9, progress=False).cost
        quaternion = np.asarray(so3.to_quaternion(first)).ravel()
        for factor in (1.0, -1.0, 1.5):
            plan = planner(initial_attitude=factor * quaternion)
            assert plan["status"] == "OK"
            assert plan["cost"] == pytest.approx(known, rel=1e-8)
            np.testing.assert_allclose(plan["attitude"][0], quaternion, atol=1e-7)


def test_a_plan_goes_on_from_its_guess_with_the_quaternion_that_this_begins_with() -> None:
    """Three quarters of a turn from the attitude of the export in two plans; then its opposite quaternion."""
    planner, guess = solver("slew").reference(), None
    for angle in (0.6, 1.2, 1.8, 2.4, 3.0, 3.6, 4.2):
        first = np.append(np.cos(angle / 2), [0.0, 0.0, np.sin(angle / 2)])
        given = {} if guess is None else {"guess": guess}
        plans = [planner(initial_attitude=sign * first, **given) for sign in (1.0, -1.0)]
        assert plans[0]["status"] in ("OK", "COARSE")  # on four steps: of more than a quarter of a turn they tell it
        np.testing.assert_array_equal(plans[1]["variables"], plans[0]["variables"])
        np.testing.assert_allclose(plans[0]["attitude"][0], first, atol=1e-7)
        guess = plans[0]["variables"]


def test_a_quaternion_of_length_zero_is_no_attitude() -> None:
    planner = solver("slew").reference()
    plan = planner(initial_attitude=np.zeros(4))
    assert plan.pop("status") in ("NOT_CONVERGED", "FAILED")
    assert all(np.isfinite(entry).all() for entry in plan.values())


def test_a_free_attitude_is_chosen_by_each_plan() -> None:
    """Nothing turns it: it stays where the goal is."""
    made = export_c(attitudes.slew(None, GOAL)[0], FOLDER / "turned_free", **MESHES["slew"])
    assert [port.name for port in made.laws[0].arguments] == ["initial_omega", "duration", "guess"]
    plan = made.reference()()
    assert plan["status"] == "OK"
    assert plan["cost"] == pytest.approx(0.0, abs=1e-8)


def test_units_are_those_of_quaternions_and_of_rotation_vectors() -> None:
    """In the header and in the README: quaternions have no unit, rows of the estimate are angles."""
    ocp = co.Problem(2.0, "pointed")
    omega = ocp.state("omega", 3, initial=0.0, final=0.0, variance=0.01, unit="rad/s")
    torque = ocp.control("torque", 3, unit="N m")
    attitude = ocp.attitude("att", initial=np.eye(3), final=so3.exp([0, 0, 0.6]), rate=omega, variance=0.02 * np.eye(3))
    ocp.dynamics(omega, torque, noise=1e-3)
    ocp.measurement("star", attitude.matrix[:, 0], 0.01)
    ocp.minimize_expected(running=0.5 * ca.sumsqr(torque), terminal_weight={omega: 1.0, attitude: 2.0})
    made = export_c(co.solve(ocp, intervals=6, progress=False), FOLDER / "pointed")
    planned = export_c(attitudes.slew(np.eye(3), GOAL)[0], FOLDER / "pointed_plan", **MESHES["slew"])
    rates = [f"omega[{i}] [rad/s]" for i in range(3)]
    ports = {port.name: port for law in made.laws for port in law.outputs}
    assert ports["estimate"].entries == (*rates, "att[0] [rad]", "att[1] [rad]", "att[2] [rad]")
    assert ports["nominal_state"].entries == (*rates, "att q0", "att q1", "att q2", "att q3")
    for package, lines in (
        (made, ("state 'att', a unit quaternion, scalar first", "the rotation vector, in body axes, by which it")),
        (
            planned,
            ("initial attitude of 'attitude', a unit quaternion, scalar first", "node: a unit quaternion, scalar"),
        ),
    ):
        for name in (f"{package.name}.h", "README.md"):
            text = " ".join((package.directory / name).read_text().replace("\n *", " ").split())
            assert "[rad] state 'att" not in text
            for line in lines:
                assert line in text, name
