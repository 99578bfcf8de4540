"""Steps of an exported solver that are too long for what it is given: against its own controls, integrated by scipy."""

from __future__ import annotations

import itertools
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


LIMIT = 0.08
WEIGHTS = {
    "terminal": (0.0, 10.0),
    "running": (1.0, 0.0),
    "condition": (0.0, 0.0),
}  # of the variance, on the way and at the end


def oscillator(*, term: str, frequency: float = 1.0) -> co.Problem:
    """A sensor on a carriage sees an oscillator better the farther it is away; the nominal of this one rests."""
    ocp = co.Problem(duration=10.0, name="oscillator")
    s = ocp.state("s", initial=0.0, final=0.0)
    q, v = ocp.state("q", initial=0.0, variance=1.0), ocp.state("v", initial=0.0, variance=1.0)
    w, u = ocp.parameter("w", frequency), ocp.control("u")
    ocp.dynamics(s, u)
    ocp.dynamics(q, v)
    ocp.dynamics(v, -(w**2) * q - 0.1 * v, noise=0.1)
    ocp.measurement("place", q * s, noise=0.1)
    E = ocp.estimation_covariance()
    if term == "condition":
        ocp.subject_to(E[q, q], at="final", upper=LIMIT)
    weights = WEIGHTS[term]
    ocp.minimize(running=0.5 * u**2 + weights[0] * E[q, q], terminal=weights[1] * E[q, q])
    return ocp


def cost_and_variance(plan: dict[str, Any], w: float, term: str) -> tuple[float, float]:
    """Of the oscillator along the controls of a plan, and the variance of its place at the end."""
    t, u = plan["time"], np.ravel(plan["u"])
    F = np.array([[0.0, 1.0], [-(w**2), -0.1]])

    def rate(q: float, z: Any) -> Any:
        E, force, M = z[1:5].reshape(2, 2), np.interp(q, t, u), np.array([[z[0], 0.0]])
        change = F @ E + E @ F.T + np.diag([0.0, 0.1]) - E @ M.T @ M @ E / 0.1
        return np.array([force, *change.ravel(), 0.5 * force**2 + WEIGHTS[term][0] * E[0, 0]])

    z = np.array([0.0, 1.0, 0.0, 0.0, 1.0, 0.0])
    for a, b in itertools.pairwise(t):
        z = solve_ivp(rate, (a, b), z, method="DOP853", rtol=1e-8, atol=1e-10).y[:, -1]
    return float(z[5] + WEIGHTS[term][1] * z[1]), float(z[1])


@pytest.mark.parametrize(("term", "fast"), [("terminal", 15.0), ("running", 15.0), ("condition", 6.0)])
def test_covariances_that_are_fast_beside_a_nominal_at_rest_are_seen(tmp_path, term: str, fast: float) -> None:
    """Of the nominal all steps are short enough: it rests."""
    made = co.export_c(oscillator(term=term), tmp_path / "oscillator", intervals=40).reference()
    for w, status in ((1.0, "OK"), (2.0, "OK"), (fast, "COARSE")):
        plan = made.solve(w=w)
        cost, variance = cost_and_variance(plan, w, term)
        off = abs(plan["cost"] / cost - 1.0)
        missed = abs(variance / LIMIT - 1.0) if term == "condition" else 0.0  # of the limit, which is reached
        assert plan["status"] == status
        assert max(off, missed) < 0.01 if status == "OK" else max(off, missed) > 0.01


def coupled(rate: float = 1.0) -> co.Problem:
    """A nominal that a matrix moves: S tends to 1 + s with a rate, s with the frequency of that rate."""
    ocp = co.Problem(duration=2.0, name="coupled")
    x, u, S = ocp.state("x", initial=1.0), ocp.control("u"), ocp.symmetric("S", 2, initial=np.eye(2))
    k = ocp.parameter("k", rate)
    ocp.dynamics(x, u - 0.2 * S[0, 0] * x)
    ocp.dynamics(S, ca.blockcat([[k * S[0, 1], k * (1 - S[0, 0])], [k * (1 - S[0, 0]), -S[1, 1]]]))
    ocp.minimize(running=0.5 * u**2, terminal=x**2 + S[0, 1] ** 2 + S[0, 0])
    return ocp


@pytest.mark.parametrize("initial", [1.0, 3.0])
def test_matrices_that_move_the_nominal_are_run_with_it(tmp_path, initial: float) -> None:
    """S oscillates about 1: S00 = 1 + (S00(0) - 1) cos kt, S01 = -(S00(0) - 1) sin kt."""
    made = co.export_c(coupled(), tmp_path / "coupled", intervals=10).reference()
    for k in (1.0, 3.0, 20.0):
        plan = made.solve(k=k, initial_S=np.diag([initial, 1.0]))
        t, u = plan["time"], np.ravel(plan["u"])

        def rate(q: float, z: Any, k=k, t=t, u=u) -> list[float]:
            force = np.interp(q, t, u)
            return [force - 0.2 * (1 + (initial - 1) * np.cos(k * q)) * z[0], 0.5 * force**2]

        z = np.array([1.0, 0.0])
        for a, b in itertools.pairwise(t):
            z = solve_ivp(rate, (a, b), z, rtol=1e-9, atol=1e-11).y[:, -1]
        end = (initial - 1) * np.array([np.cos(2 * k), -np.sin(2 * k)])
        cost = float(z[1] + z[0] ** 2 + end[1] ** 2 + 1 + end[0])
        off = abs(plan["cost"] / cost - 1.0)
        assert plan["status"] in (("OK",) if k < 10 or initial == 1.0 else ("COARSE", "NOT_CONVERGED"))
        assert off < 0.01 if plan["status"] == "OK" else off > 0.01


def gate(duration: float) -> co.Problem:
    """It is at a place after a second."""
    ocp = co.Problem(duration, "gate")
    x, v = ocp.state("x", initial=0.0, final=1.0), ocp.state("v", initial=0.0, final=0.0)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.subject_to(x, at=1.0, equals=0.8, name="gate")
    ocp.minimize(running=0.5 * u**2)
    return ocp


def mean(duration: float) -> co.Problem:
    """Its cost is a mean over the time."""
    ocp = co.Problem(duration, "mean")
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=(0.5 * u**2 + x**2) / ocp.duration)
    return ocp


@pytest.mark.parametrize("make", [gate, mean])
def test_no_other_duration_is_taken_where_that_is_another_problem(tmp_path, make: Any) -> None:
    """It would be half a second or two for the gate, and a mean over the time of the export."""
    made = co.export_c(make(2.0), tmp_path / "made", intervals=10).reference()
    assert made.solve()["status"] == "OK"
    with pytest.raises(co.ExportError, match="the other duration"):
        made.solve(duration=4.0)
    with pytest.raises(co.ProblemError, match="duration"):
        co.Solver(make(2.0), intervals=10).solve(duration=4.0, progress=False)


def test_what_follows_something_in_time_is_exported(tmp_path) -> None:
    """Its covariance hangs on nothing that is planned: CasADi writes no slopes of it."""
    ocp = co.Problem(5.0, "tracking")
    x, v = ocp.state("x", initial=0.0, variance=0.1), ocp.state("v", initial=0.0, variance=0.1)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.5 * x, noise=0.1)
    ocp.measurement("place", x, noise=0.05)
    ocp.minimize_expected(running=0.5 * u**2 + (x - ca.sin(ocp.time)) ** 2)
    plan = quick(co.export_c(ocp, tmp_path / "tracking", intervals=20)).python().solve()
    assert plan["status"] == "OK"
    assert plan["cost"] == pytest.approx(co.solve(ocp, intervals=20, progress=False).cost, rel=1e-7)


OBSTACLE, RADIUS = np.array([2.5, -0.05]), 0.5


def round_an_obstacle(form: str) -> co.Problem:
    """A point that flies past a circle."""
    ocp = co.Problem(10.0, "obstacle")
    p, u = ocp.state("p", 2, initial=[0.0, 0.0], final=[5.0, 0.0]), ocp.control("u", 2)
    radius = ocp.parameter("radius", RADIUS)
    ocp.dynamics(p, u)
    apart = ca.sumsqr(p - OBSTACLE)
    if form == "zero":
        ocp.subject_to(radius**2 - apart, upper=0.0, name="obstacle")
    else:
        ocp.subject_to(apart, lower=RADIUS**2, name="obstacle")
    ocp.minimize(running=0.5 * ca.sumsqr(u))
    return ocp


def clearance(plan: dict[str, Any]) -> float:
    """The closest that it comes to the middle, u linear between the nodes."""
    p, u, h = plan["p"].reshape(-1, 2), plan["u"].reshape(-1, 2), 10.0 / (len(plan["time"]) - 1)
    s = np.linspace(0.0, 1.0, 101)[:, None]
    paths = [p[i] + h * (s * u[i] + s**2 / 2 * (u[i + 1] - u[i])) for i in range(len(p) - 1)]
    return float(np.linalg.norm(np.vstack(paths) - OBSTACLE, axis=1).min())


@pytest.mark.parametrize("form", ["zero", "limit"])
def test_a_plan_through_an_obstacle_between_two_nodes_is_not_ok(tmp_path, form: str) -> None:
    """From 10 m away an interval is longer than the obstacle, and no node is in it."""
    made = co.export_c(round_an_obstacle(form), tmp_path / "obstacle", intervals=20).reference()
    for start, status in ((0.0, "OK"), (-5.0, "OK"), (-10.0, "COARSE"), (-20.0, "COARSE")):
        plan = made.solve(initial_p=[start, 0.0])
        assert plan["status"] == status
        assert clearance(plan) > 0.98 * RADIUS if status == "OK" else clearance(plan) < 0.1 * RADIUS


def test_bounds_of_states_are_looked_at_between_the_nodes(tmp_path) -> None:
    """There and back in one interval, x = speed (t - t^2 / 2): it turns round at half the speed."""
    ocp = co.Problem(2.0, "there and back")
    x = ocp.state("x", initial=0.0, final=0.0, lower=-0.4, upper=0.4)
    speed, u = ocp.parameter("speed", 0.1), ocp.control("u")
    v = ocp.state("v", initial=speed, final=-speed)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=u**2)
    made = co.export_c(ocp, tmp_path / "there", intervals=1).reference()
    for at, status in ((0.1, "OK"), (0.7, "OK"), (1.0, "COARSE"), (3.0, "COARSE")):
        plan = made.solve(initial_v=at, speed=at)
        assert plan["cost"] == pytest.approx(2.0 * at**2, rel=1e-8)
        assert plan["status"] == status
