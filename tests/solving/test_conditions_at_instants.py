"""Conditions at instants of the horizon: splines through points, limits of variances, shares of a free duration."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from problems import unassessed
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.optimize import minimize_scalar

import covocp as co
from covocp.solving.comparison import terminal_miss

FORMS = ("eliminated", "states")
QUIET: dict[str, Any] = {"tolerance": 1e-10, "progress": False}
# How the control moves is said: other numbers of switches, of which each is a run, are tried elsewhere.
MOVING: dict[str, Any] = {"guess": {"u": 0.5}}
GRADIENT: dict[str, Any] = {"method": "gradient", "progress": False, "tolerance": 1e-7, "violation_tolerance": 1e-9}


def errand(duration: Any, *, rest: bool = True) -> tuple[co.Problem, Any, Any, Any]:
    """A double integrator with the energy of its control as cost, and its symbols."""
    ocp = co.Problem(duration, name="errand")
    x, v = ocp.state("x", initial=0.0), ocp.state("v", initial=0.0 if rest else None)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u)
    ocp.minimize(running=u**2)
    return ocp, x, v, u


# --- points to pass through -------------------------------------------------------------------------------------------

TIMES, POINTS = np.array([0.0, 4.0, 7.0, 10.0]), np.array([0.0, 1.0, -1.0, 2.0])


def through(shift: float = 0.0, *, relative: bool = False) -> co.Problem:
    """Least energy through points, the first of them moved."""
    ocp, x, *_ = errand(10.0, rest=False)
    for k, (time, point) in enumerate(zip(TIMES[1:3], POINTS[1:3] + np.array([shift, 0.0]), strict=True)):
        ocp.subject_to(x, at=time / 10.0 if relative else time, relative=relative, equals=point, name=f"point {k}")
    ocp.subject_to(x, at="final", equals=POINTS[3], name="end")
    return ocp


@pytest.mark.parametrize("relative", [False, True])
def test_least_energy_through_points_is_the_natural_spline(relative: bool) -> None:
    """Costates are third and second derivatives of the spline on both sides; multipliers the jumps of the third."""
    found = co.solve(through(relative=relative), intervals=20, **QUIET)
    spline = CubicSpline(TIMES, POINTS, bc_type="natural")
    t = np.linspace(0.0, 10.0, 41)
    np.testing.assert_allclose(found.at(t)["x"], spline(t), atol=1e-10)
    np.testing.assert_allclose(found.at(t)["u"], spline(t, 2), atol=1e-10)
    third = 12.0 * spline.c[0]  # of p' = 0, v' = -p, u = -(costate of v) / 2
    costate = found.costate("x")
    for k, time in enumerate(TIMES[1:3]):
        (before, after) = np.flatnonzero(found.t == time)
        assert costate[before] == pytest.approx(third[k], rel=1e-9)
        assert costate[after] == pytest.approx(third[k + 1], rel=1e-9)
        assert found.multiplier(f"point {k}") == pytest.approx(third[k] - third[k + 1], rel=1e-9)
    np.testing.assert_allclose(found.costate("v"), -2.0 * spline(found.t, 2), atol=1e-9)
    residuals = found.optimality
    assert max(residuals.stationarity, residuals.costate_difference, residuals.hamiltonian_variation) < 1e-12
    assert residuals.curvature > 0


def test_the_multiplier_of_a_point_is_the_difference_of_the_costs() -> None:
    h = 1e-3
    costs = [unassessed(through(shift), intervals=10, tolerance=1e-10).cost for shift in (-h, h)]
    multiplier = co.solve(through(), intervals=10, **QUIET).multiplier("point 0")
    assert multiplier == pytest.approx((costs[0] - costs[1]) / (2 * h), rel=1e-8)


def swift(limit: float, **limits: Any) -> co.Problem:
    """From rest to rest with a velocity prescribed on the way."""
    ocp, x, v, _ = errand(3.0)
    ocp.subject_to(v, at=1.2, name="speed", **(limits or {"equals": limit}))
    ocp.subject_to(x, at="final", equals=1.0, name="end")
    ocp.subject_to(v, at="final", equals=0.0, name="stop")
    return ocp


def hermite(place: float, speed: float) -> CubicHermiteSpline:
    """The least energy through a place and a velocity on the way."""
    return CubicHermiteSpline([0.0, 1.2, 3.0], [0.0, place, 1.0], [0.0, speed, 0.0])


def energy(curve: CubicHermiteSpline) -> float:
    """The integral of its bend squared: Simpson's rule is exact for it."""
    total = 0.0
    for begin, end in ((0.0, 1.2), (1.2, 3.0)):
        bend = curve.derivative(2)(np.array([begin + 1e-13, (begin + end) / 2, end - 1e-13]))
        total += (end - begin) / 6.0 * float(bend**2 @ [1.0, 4.0, 1.0])
    return total


@pytest.mark.parametrize("method", ["ipopt", "gradient"])
def test_where_a_velocity_is_prescribed_the_control_jumps(method: str) -> None:
    place = minimize_scalar(lambda p: energy(hermite(p, 0.9)), tol=1e-12).x
    best = hermite(place, 0.9)
    found = co.solve(swift(0.9), intervals=10, **(QUIET if method == "ipopt" else GRADIENT))
    allowed = 1e-9 if method == "ipopt" else 2e-6
    assert found.cost == pytest.approx(energy(best), rel=allowed)
    bend = best.derivative(2)
    for side, time in (("before", 1.2 - 1e-9), ("after", 1.2 + 1e-9)):
        assert found.at(1.2, side)["u"] == pytest.approx(float(bend(time)), rel=1e-3 if method == "gradient" else 1e-6)
    assert found.costate("v")[np.flatnonzero(found.t == 1.2)] == pytest.approx(
        [-2.0 * float(bend(1.2 - 1e-9)), -2.0 * float(bend(1.2 + 1e-9))], rel=1e-3 if method == "gradient" else 1e-6
    )
    assert found.optimality.control_slope < 1e-6


def test_an_inequality_binds_where_it_must_only() -> None:
    free = co.solve(swift(0.0, lower=-5.0, upper=5.0), intervals=10, **QUIET)
    assert abs(free.multiplier("speed")) < 1e-6
    reached = float(free.at(1.2)["v"])
    below = co.solve(swift(0.0, upper=reached - 0.1), intervals=10, **QUIET)
    assert below.at(1.2)["v"] == pytest.approx(reached - 0.1, abs=1e-8)
    assert below.multiplier("speed") > 1e-2
    above = co.solve(swift(0.0, lower=reached + 0.1), intervals=10, **QUIET)
    assert above.multiplier("speed") < -1e-2
    assert max(below.optimality.complementarity, above.optimality.complementarity) < 1e-7


# --- limits of variances ----------------------------------------------------------------------------------------------


def learning(limit: float, *, sampled: bool = False, side: Any = None, actuator: float | None = None) -> co.Problem:
    """An unknown gain whose variance is limited at 2 of 5 s; where it is sampled, a reading is taken then.

    actuator: variance of a lag between control and plant, known exactly where it is zero; None: there is none.
    """
    ocp = co.Problem(5.0, name="learning")
    x, v = (ocp.state(name, initial=0.0, variance=0.1) for name in ("x", "v"))
    w = None if actuator is None else ocp.state("w", initial=0.0, variance=actuator or None)
    b = ocp.unknown("b", mean=1.0, variance=0.5)
    u = ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(x, v, noise=0.001)
    ocp.dynamics(v, b * (u if w is None else w) - 0.3 * v, noise=0.01)
    if w is not None:
        ocp.dynamics(w, u - w)
    if sampled:
        ocp.measurement("fix", x, noise=0.02, at=[1.0, 1.5, 2.0, 3.0])
    else:
        ocp.measurement("position", x, noise=0.02)
    E = ocp.estimation_covariance()
    ocp.subject_to(E[b, b], at=2.0, upper=limit, name="learnt", side=side)
    ocp.subject_to(x, at="final", equals=1.0, name="goal")
    ocp.minimize(running=u**2 + 0.05 * v**2)
    return ocp


def variance_at(solution: co.Solution, time: float) -> float:
    """The variance of the gain at a time, from scipy's integration of the Riccati equation along the controls."""
    F = np.array([[0.0, 1.0, 0.0], [0.0, -0.3, 0.0], [0.0, 0.0, 0.0]])
    Q, W = np.diag([0.001, 0.01, 0.0]), np.diag([1.0 / 0.02, 0.0, 0.0])

    def rate(t: float, half: Any) -> Any:
        E, slopes = half.reshape(3, 3), F.copy()
        slopes[1, 2] = float(np.interp(t, solution.t, solution.controls[:, 0]))
        return (slopes @ E + E @ slopes.T + Q - E @ W @ E).ravel()

    grid = np.unique(solution.t[solution.t <= time])
    E = np.diag([0.1, 0.1, 0.5]).ravel()
    for begin, end in pairwise(grid):
        E = solve_ivp(rate, (begin, end), E, rtol=1e-10, atol=1e-13).y[:, -1]
    return float(E[8])


def test_a_variance_is_below_its_limit_at_the_instant() -> None:
    """By scipy too; both formulations and both methods agree, and the multiplier is the difference of costs."""
    plain = co.solve(learning(0.05), intervals=40, **QUIET)
    states = unassessed(learning(0.05), intervals=40, covariances="states", tolerance=1e-10, **MOVING)
    assert variance_at(plain, 2.0) == pytest.approx(0.05, rel=3e-5)
    assert float(plain.at(2.0)["E"][2, 2]) == pytest.approx(0.05, abs=1e-7)
    assert states.cost == pytest.approx(plain.cost, rel=1e-10)
    assert states.multiplier("learnt") == pytest.approx(plain.multiplier("learnt"), rel=1e-7)
    scale = np.abs(plain.costates.matrices).max()
    np.testing.assert_allclose(states.costates.matrices, plain.costates.matrices, atol=1e-7 * scale)
    h = 1e-4
    costs = [unassessed(learning(0.05 + d), intervals=40, guess=plain, tolerance=1e-10).cost for d in (-h, h)]
    assert plain.multiplier("learnt") == pytest.approx((costs[0] - costs[1]) / (2 * h), rel=2e-5)
    before, after = np.flatnonzero(plain.t == 2.0)
    jump = plain.costate("E")[before] - plain.costate("E")[after]
    expected = np.zeros((3, 3))
    expected[2, 2] = plain.multiplier("learnt")
    np.testing.assert_allclose(jump, expected, atol=1e-9 * expected[2, 2])
    residuals = plain.optimality
    assert residuals.stationarity < 1e-7
    assert residuals.costate_difference < 1e-3
    assert residuals.hamiltonian_variation < 1e-5
    gradient = unassessed(learning(0.05), "gradient", intervals=40)
    assert gradient.cost == pytest.approx(plain.cost, rel=3e-5)
    assert gradient.multiplier("learnt") == pytest.approx(plain.multiplier("learnt"), rel=3e-5)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("side", [None, "before"])
def test_a_reading_at_the_instant_counts_after_it(side: Any, form: str) -> None:
    moving = MOVING if form == "states" else {}
    found = co.solve(learning(0.05, sampled=True, side=side), intervals=30, covariances=form, **moving, **QUIET)
    early, late = found.at(2.0, "before")["E"], found.at(2.0)["E"]
    assert float((early if side == "before" else late)[2, 2]) == pytest.approx(0.05, abs=1e-7)
    gain = early[:, 0] / (early[0, 0] + 0.02)
    np.testing.assert_allclose(late, early - np.outer(gain, early[0]), atol=1e-9)
    assert found.optimality.stationarity < 1e-7
    assert found.optimality.costate_difference < 1e-4
    assert found.optimality.hamiltonian_variation < 1e-6
    h, options = 1e-4, {"intervals": 30, "covariances": "eliminated", "guess": found, "tolerance": 1e-10}
    costs = [unassessed(learning(0.05 + d, sampled=True, side=side), **options).cost for d in (-h, h)]
    assert found.multiplier("learnt") == pytest.approx((costs[0] - costs[1]) / (2 * h), rel=2e-5)


def test_a_condition_at_a_reading_is_about_what_is_known_after_it() -> None:
    """Where nothing else is said."""
    own, after = (unassessed(learning(0.05, sampled=True, side=side), intervals=10) for side in (None, "after"))
    assert own.cost == after.cost
    assert own.multiplier("learnt") == after.multiplier("learnt")


@cache
def by_gauss_steps() -> co.Solution:
    return unassessed(learning(0.05), intervals=60)


@pytest.mark.parametrize(
    "options", [{"step": "rodas"}, {"covariance_step": "strang"}, {"covariance_step": "rk4", "substeps": 4}]
)
def test_every_step_passes_an_instant(options: dict[str, Any]) -> None:
    found = co.solve(learning(0.05), intervals=60, progress=False, **options)
    gauss = by_gauss_steps()
    assert found.cost == pytest.approx(gauss.cost, rel=1e-3)
    assert found.multiplier("learnt") == pytest.approx(gauss.multiplier("learnt"), rel=1e-2)
    assert found.optimality.stationarity < 1e-6
    assert found.optimality.costate_difference < 1e-3


def test_rows_that_nothing_needs_are_left_out_with_a_condition_too() -> None:
    """A lag that is known exactly: as with a variance of next to nothing; with less a run takes hundreds of steps."""
    options = {"intervals": 40, "tolerance": 1e-10, **MOVING}
    found = [unassessed(learning(0.1, actuator=0.0), covariances=form, **options) for form in FORMS]
    kept = unassessed(learning(0.1, actuator=1e-10), **options)
    for solution in found:
        assert solution.cost == pytest.approx(kept.cost, rel=1e-8)
        assert solution.multiplier("learnt") == pytest.approx(kept.multiplier("learnt"), rel=1e-6)
        assert solution["E"].shape[1:] == (4, 4)


# --- phases -----------------------------------------------------------------------------------------------------------


def stage(duration: float, name: str, first: bool, *conditions: tuple[Any, str, float]) -> co.Problem:
    """A part of an errand with an unknown gain; conditions: when, on what, the limit."""
    ocp = co.Problem(duration, name=name)
    start = {"initial": 0.0, "variance": 0.1} if first else {"initial": None}
    x, v = ocp.state("x", **start), ocp.state("v", **start)
    b = ocp.unknown("b", mean=1.0, variance=0.5)
    u = ocp.control("u", lower=-3.0, upper=3.0)
    ocp.dynamics(x, v, noise=0.001)
    ocp.dynamics(v, b * u - 0.3 * v, noise=0.01)
    ocp.measurement("position", x, noise=0.02)
    ocp.minimize(running=u**2 + 0.05 * v**2)
    E = ocp.estimation_covariance()
    for at, what, limit in conditions:
        if what == "learnt":
            ocp.subject_to(E[b, b], at=at, upper=limit, name=what)
        else:
            ocp.subject_to(x, at=at, equals=limit, name=f"{what} {at}")
    return ocp


def test_the_same_in_two_phases() -> None:
    end = ("final", "goal", 1.0)
    whole = co.solve(stage(5.0, "whole", True, (2.0, "gate", 2.0), (2.0, "learnt", 0.05), end), intervals=50, **QUIET)
    first = stage(2.0, "one", True, ("final", "gate", 2.0), ("final", "learnt", 0.05))
    parts = co.solve(co.Phases([first, stage(3.0, "two", False, end)]), intervals=[20, 30], **QUIET)
    assert whole.cost == pytest.approx(parts.cost, rel=1e-10)
    for name in ("x", "v", "E"):
        joined = np.concatenate([phase.costate(name) for phase in parts.phases])
        np.testing.assert_allclose(whole.costate(name), joined, atol=1e-8 * np.abs(joined).max())
    assert whole.multiplier("learnt") == pytest.approx(parts["one"].multiplier("learnt"), rel=1e-8)
    assert whole.multiplier("gate 2.0") == pytest.approx(parts["one"].multiplier("gate final"), rel=1e-8)


def test_a_phase_has_conditions_at_instants_of_its_own_time() -> None:
    end, mid = ("final", "goal", 1.0), ("final", "gate", 1.0)
    own = [stage(2.0, "one", True, mid), stage(3.0, "two", False, (1.0, "gate", 2.0), (1.0, "learnt", 0.03), end)]
    cut = [
        stage(2.0, "one", True, mid),
        stage(1.0, "two", False, ("final", "gate", 2.0), ("final", "learnt", 0.03)),
        stage(2.0, "three", False, end),
    ]
    found = co.solve(co.Phases(own), intervals=[20, 30], **QUIET)
    parts = co.solve(co.Phases(cut), intervals=[20, 10, 20], **QUIET)
    assert found["two"].multiplier("learnt") > 1.0
    assert found.cost == pytest.approx(parts.cost, rel=1e-9)
    assert found["two"].multiplier("learnt") == pytest.approx(parts["two"].multiplier("learnt"), rel=1e-6)
    joined = np.concatenate([parts["two"].costate("E"), parts["three"].costate("E")])
    np.testing.assert_allclose(found["two"].costate("E"), joined, atol=1e-7 * np.abs(joined).max())
    assert found["two"].optimality.hamiltonian_variation < 1e-5


@pytest.mark.parametrize("method", ["ipopt", "gradient"])
def test_shares_of_the_free_durations_of_phases(method: str) -> None:
    """Transversality of each, with what the Hamiltonian jumps by; the least cost by given durations is there."""

    def part(name: str, first: bool, duration: Any) -> co.Problem:
        ocp, x, v, u = errand(duration)
        gate = x + 0.1 * v**2 - 0.05 * ocp.time
        ocp.subject_to(gate, at=0.3 if first else 0.6, relative=True, equals=0.5 if first else 2.5, name="gate")
        ocp.subject_to(x, at="final", equals=2.0 if first else 3.0, name="place")
        own = ocp.declarations
        if first:
            return co.Problem.of(replace(own, name=name, cost=(u**2 + 0.5, own.cost[1])))
        states = tuple(replace(state, initial=state.final) for state in own.states)  # free
        return co.Problem.of(replace(own, name=name, states=states, cost=(u**2 + 0.5, own.cost[1])))

    free = co.Phases([part("one", True, co.Free(3.0, 0.3, 20.0)), part("two", False, co.Free(3.0, 0.3, 20.0))])
    found = co.solve(free, intervals=20 if method == "ipopt" else 10, **(QUIET if method == "ipopt" else GRADIENT))
    for phase in found.phases:
        assert phase.optimality.transversality < 1e-6
        assert phase.optimality.hamiltonian_variation < 1e-5
        assert abs(phase.multiplier("gate")) > 0.1
    if method == "ipopt":
        h, times = 0.005, [phase.duration for phase in found.phases]
        for k in range(2):
            costs = []
            for step in (-h, 0.0, h):
                moved = [t + step * (i == k) for i, t in enumerate(times)]
                given = co.Phases([part("one", True, moved[0]), part("two", False, moved[1])])
                costs.append(co.solve(given, intervals=20, **QUIET).cost)
            least = h * (costs[0] - costs[2]) / (2.0 * (costs[0] - 2.0 * costs[1] + costs[2]))
            assert found.cost == pytest.approx(costs[1], rel=1e-9)
            assert abs(least) < 5e-5 * times[k]


# --- shares of a free duration ----------------------------------------------------------------------------------------


def timed(duration: Any, *, moving: bool) -> co.Problem:
    """A gate at two fifths of the time, which may move with the time and with the duration."""
    ocp, x, v, u = errand(duration)
    gate = x + 0.3 * v**2 - (0.2 * ocp.time + 0.05 * ocp.duration if moving else 0.0)
    ocp.subject_to(gate, at=0.4, relative=True, equals=2.0, name="gate")
    ocp.subject_to(x, at="final", equals=3.0, name="end")
    ocp.subject_to(v, at="final", equals=0.0, name="stop")
    own = ocp.declarations
    return co.Problem.of(replace(own, cost=(u**2 + 1.0, own.cost[1])))


@pytest.mark.parametrize("moving", [False, True])
def test_a_share_of_a_free_duration_moves_with_it(moving: bool) -> None:
    """The duration is where the costs of given durations are least, and transversality holds."""
    found = co.solve(timed(co.Free(4.0, 0.5, 20.0), moving=moving), intervals=40, **QUIET)
    h = 0.02
    costs = [
        unassessed(timed(found.duration + d, moving=moving), intervals=40, guess=found, tolerance=1e-10).cost
        for d in (-h, 0, h)
    ]
    least = h * (costs[0] - costs[2]) / (2.0 * (costs[0] - 2.0 * costs[1] + costs[2]))
    assert found.cost == pytest.approx(costs[1], rel=1e-10)
    assert abs(least) < 2e-4 * found.duration
    assert found.optimality.transversality < 1e-7
    assert found.optimality.hamiltonian_variation < 1e-6
    assert abs(found.multiplier("gate")) > 0.5
    gradient = co.solve(timed(co.Free(4.0, 0.5, 20.0), moving=moving), "gradient", intervals=40, progress=False)
    assert gradient.cost == pytest.approx(found.cost, rel=3e-6)
    assert gradient.duration == pytest.approx(found.duration, rel=1e-5)


def test_a_share_of_a_free_duration_in_two_phases() -> None:
    """Phases of two and three fifths of a time scale that is decided."""

    def part(share: float, first: bool) -> co.Problem:
        ocp = co.Problem(share, name="one" if first else "two")
        x, v = (ocp.state(name, initial=0.0 if first else None) for name in ("x", "v"))
        u, T = ocp.control("u"), ocp.decision("T", guess=4.0, lower=0.5, upper=20.0)
        ocp.dynamics(x, T * v)
        ocp.dynamics(v, T * u)
        gate, place = (x + 0.3 * v**2, 2.0) if first else (x, 3.0)
        ocp.subject_to(gate, at="final", equals=place, name="gate")
        if not first:
            ocp.subject_to(v, at="final", equals=0.0)
        ocp.minimize(running=T * (u**2 + 1.0))
        return ocp

    found = co.solve(timed(co.Free(4.0, 0.5, 20.0), moving=False), intervals=50, **QUIET)
    parts = co.solve(co.Phases([part(0.4, True), part(0.6, False)]), intervals=[20, 30], **QUIET)
    assert found.cost == pytest.approx(parts.cost, rel=1e-10)
    assert found.duration == pytest.approx(float(parts["one"]["T"]), rel=1e-7)
    assert found.multiplier("gate") == pytest.approx(float(parts["one"].multiplier("gate")), rel=1e-7)


# --- controls, decisions, feedback ------------------------------------------------------------------------------------


@pytest.mark.parametrize("control", ["linear", "constant"])
@pytest.mark.parametrize("side", [None, "before"])
def test_a_condition_on_a_control_is_about_one_side(side: Any, control: str) -> None:
    ocp, x, _, u = errand(5.0)
    ocp.subject_to(x, at="final", equals=3.0, name="end")
    ocp.subject_to(u + 0.5 * x, at=2.0, equals=0.2, name="at two", side=side)
    found = co.solve(ocp, intervals=20, control=control, **QUIET)
    values = {s: float(found.at(2.0, s)["u"] + 0.5 * found.at(2.0, s)["x"]) for s in ("before", "after")}
    assert values[side or "after"] == pytest.approx(0.2, abs=1e-9)
    assert abs(values["after" if side else "before"] - 0.2) > 1e-2
    assert found.optimality.stationarity < 1e-9
    assert found.optimality.curvature > 0
    gradient = co.solve(ocp, "gradient", intervals=20, control=control, progress=False)
    assert gradient.cost == pytest.approx(found.cost, rel=3e-6)
    assert gradient.multiplier("at two") == pytest.approx(found.multiplier("at two"), rel=2e-3)


@pytest.mark.filterwarnings("ignore:The controls change faster")  # few intervals
def test_limits_inside_the_intervals_go_with_conditions_at_instants() -> None:
    ocp, x, v, u = errand(4.0)
    ocp.subject_to(v**2 + 0.1 * x, upper=0.9, name="slow")
    ocp.subject_to(x, at=2.0, equals=1.0, name="gate")
    ocp.subject_to(v + 0.2 * u, at=3.0, lower=0.1, name="going on")
    ocp.subject_to(x, at="final", equals=0.5, name="end")
    once, often = (co.solve(ocp, intervals=20, points=n, substeps=4, **QUIET) for n in (1, 4))
    assert often.cost == pytest.approx(once.cost, rel=1e-6)  # the path is touched nowhere between the nodes
    for found in (once, often):
        assert found.optimality.stationarity < 1e-9
        assert found.optimality.costate_difference < 1e-9


def test_a_decision_in_a_condition_at_an_instant() -> None:
    """The effectiveness of the control against its price: its condition holds, and nearby ones cost more."""

    def problem(fixed: float | None) -> co.Problem:
        ocp = co.Problem(4.0, name="bought")
        x, v = ocp.state("x", initial=0.0), ocp.state("v", initial=0.0)
        u, d = ocp.control("u"), ocp.decision("d", guess=0.5, lower=0.1)
        ocp.dynamics(x, v)
        ocp.dynamics(v, d * u)
        ocp.subject_to(x - d, at=2.0, lower=0.3, name="gate")
        if fixed is not None:
            ocp.subject_to(d, at=1.0, equals=fixed, name="fixed")
        ocp.minimize(running=u**2, terminal=d**2)
        return ocp

    found = co.solve(problem(None), intervals=20, **QUIET)
    assert found.optimality.decisions < 1e-9
    best = float(found["d"])
    costs = [co.solve(problem(best + step), intervals=20, **QUIET).cost for step in (-1e-3, 1e-3)]
    assert min(costs) > found.cost
    assert costs[0] - costs[1] == pytest.approx(0.0, abs=1e-2 * (min(costs) - found.cost) + 1e-7)


def steered(limit: float) -> co.Problem:
    """A system with feedback whose spread is limited on the way."""
    ocp = co.Problem(2.0, name="steered")
    x, v = ocp.state("x", initial=1.0, variance=0.3), ocp.state("v", initial=0.0, variance=0.1)
    u = ocp.control("u")
    ocp.dynamics(x, v, noise=0.02)
    ocp.dynamics(v, u - 0.1 * v, noise=0.1)
    ocp.measurement("position", x, noise=0.02)
    X = ocp.closed_loop_covariance()
    ocp.subject_to(X[x, x], at=1.0, upper=limit, name="narrow")
    ocp.minimize_expected(running=u**2 + x**2, terminal=5 * x**2 + v**2)
    return ocp


def test_the_spread_of_the_closed_loop_at_an_instant() -> None:
    free = unassessed(steered(9.0), intervals=20)
    k = int(np.flatnonzero(free.t == 1.0)[0])
    reached = float(free.covariance("x")[k].item())
    held = co.solve(steered(0.8 * reached), intervals=20, progress=False)
    assert float(held.covariance("x")[k].item()) == pytest.approx(0.8 * reached, rel=2e-3)
    assert held.multiplier("narrow") > 0
    assert held.cost > free.cost


# --- meshes, guesses, files, evaluation -------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{"intervals": 7}, {"grid": [0.0, 0.3, 0.4, 0.55, 1.0]}, {"refine": 1e-6}])
def test_every_mesh_has_the_instants_twice(options: dict[str, Any]) -> None:
    found = co.solve(through(), progress=False, **options)
    for place in (0.4, 0.7):
        assert np.sum(found.mesh.nodes == place) == 2
    assert found.cost == pytest.approx(2.19392034, rel=1e-6)


def test_a_jump_of_the_control_at_an_instant_takes_no_nodes() -> None:
    """With a cost of the state the control is no line; its jump is none of the errors that are refined."""
    ocp = swift(0.9)
    x, u = ocp.states[0].symbol, ocp.controls[0].symbol
    ocp = co.Problem.of(replace(ocp.declarations, cost=(u**2 + 0.3 * x**2, ocp.declarations.cost[1])))
    fine = co.solve(ocp, intervals=400, **QUIET)
    found = co.solve(ocp, refine=1e-6, progress=False)
    assert found.cost == pytest.approx(fine.cost, rel=1e-6)
    assert len(found.stats["mesh_intervals"]) <= 4
    lengths = np.diff(np.unique(found.mesh.nodes))
    assert lengths.min() > 1e-3


def test_warm_starts_keep_the_multipliers() -> None:
    found = co.solve(learning(0.05), intervals=30, progress=False)
    assert co.solve(learning(0.05), intervals=30, guess=found, progress=False).stats["iterations"] <= 2
    other = co.solve(learning(0.05), intervals=37, guess=found, progress=False)
    assert other.stats["iterations"] < found.stats["iterations"]


def test_files_have_them(tmp_path: Any) -> None:
    found = co.solve(through(), intervals=10, progress=False)
    found.save(tmp_path / "errand.npz")
    read = co.load(tmp_path / "errand.npz", problem=through())
    assert read.multiplier("point 0") == found.multiplier("point 0")
    np.testing.assert_array_equal(read.costate("x"), found.costate("x"))
    assert read.optimality.stationarity == found.optimality.stationarity
    assert co.load(tmp_path / "errand.npz").multiplier("point 1") == found.multiplier("point 1")
    moved, x, *_ = errand(10.0, rest=False)
    moved.subject_to(x, at=4.5, equals=1.0, name="point 0")
    moved.subject_to(x, at=7.0, equals=-1.0, name="point 1")
    moved.subject_to(x, at="final", equals=2.0, name="end")
    with pytest.raises(co.ProblemError, match="the instant of 'point 0'"):
        co.load(tmp_path / "errand.npz", problem=moved)
    with pytest.raises(co.ProblemError, match=r"the constraint .end."):
        co.load(tmp_path / "errand.npz", problem=errand(10.0, rest=False)[0])


def test_evaluation_says_what_is_missed() -> None:
    found = co.evaluate(through(), nominal={"u": lambda s: 0.0 * s})
    assert found.violations["point 0"] == pytest.approx(1.0)
    assert found.violations["point 1"] == pytest.approx(1.0)
    along = co.evaluate(through(), nominal=co.solve(through(), intervals=10, **QUIET))
    assert not along.violations


@pytest.mark.filterwarnings("ignore:The controls change faster")  # few intervals
def test_the_printout_has_values_and_multipliers() -> None:
    text = str(co.solve(through(), intervals=10, progress=False))
    assert "condition at an instant" in text
    assert "a node for conditions at 2 instants" in text
    assert "measurements taken" not in text
    rows = {line.split()[0]: line.split() for line in str(sided()).splitlines() if line.startswith(("late", "early"))}
    assert rows["late"][1:3] == ["2", "after"]
    assert rows["early"][1:3] == ["2", "before"]
    assert float(rows["late"][3]) == pytest.approx(0.5)


def sided() -> co.Solution:
    """A control that is something else before and after an instant."""
    ocp, _, _, u = errand(5.0)
    ocp.subject_to(u, at=2.0, lower=0.5, name="late")
    ocp.subject_to(u, at=2.0, upper=-0.5, name="early", side="before")
    return co.solve(ocp, intervals=10, progress=False)


def test_a_comparison_counts_what_is_missed_there() -> None:
    ocp, x, *_ = errand(3.0)
    ocp.subject_to(x, at=1.0, lower=0.25, name="gate")
    assert terminal_miss(co.evaluate(ocp, nominal={"u": 0.0})) == pytest.approx(0.25)
    assert terminal_miss(co.evaluate(ocp, nominal={"u": 1.0})) == 0.0


def test_the_certificate_says_that_it_does_not_know_them() -> None:
    found = co.solve(learning(0.05), intervals=10, progress=False)
    assert "instants" in str(co.certify(found))


# --- other methods, solved from elsewhere -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "problem",
    [
        through,
        lambda: swift(0.0, upper=0.2),
        lambda: learning(0.05, sampled=True),
        lambda: timed(co.Free(4.0, 0.5, 20.0), moving=True),
    ],
)
def test_the_reduced_method_meets_them(problem: Any) -> None:
    found = co.solve(problem(), intervals=30, **QUIET)
    reduced = unassessed(problem(), "reduced", intervals=30)
    assert reduced.cost == pytest.approx(found.cost, rel=1e-6)
    np.testing.assert_allclose(reduced.multipliers.instants, found.multipliers.instants, rtol=2e-6)


def test_instants_stay_where_another_start_is_solved_for() -> None:
    solver = co.Solver(swift(0.9), intervals=10, tolerance=1e-10)
    found = solver.solve(initial={"x": 0.2}, progress=False)
    assert found.at(1.2)["v"] == pytest.approx(0.9, abs=1e-9)
    assert found.at(0.0)["x"] == pytest.approx(0.2)
    with pytest.raises(co.ProblemError, match="'speed' holds at an instant, which another duration"):
        solver.solve(duration=2.0, progress=False)


def test_a_share_of_another_duration_is_a_share_of_it() -> None:
    solver = co.Solver(timed(4.0, moving=False), intervals=30, tolerance=1e-10)
    found = solver.solve(duration=3.5, progress=False)
    other = co.solve(timed(3.5, moving=False), intervals=30, **QUIET)
    assert found.cost == pytest.approx(other.cost, rel=1e-9)
    assert found.at(1.4)["x"] == pytest.approx(other.at(1.4)["x"], rel=1e-7)
