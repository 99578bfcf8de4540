"""The controller that flies through phases: against that of the whole, independent integrations and flights."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import phased_loops
import pytest
from exports import FOLDER, QUICK, quick
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import covocp as co
from covocp.export import CPackage, export_c

pytestmark = pytest.mark.needs_cc
QUIET: dict[str, Any] = {"progress": False}
PUSHES: list[dict[str, Any]] = [{"u": lambda s: 0.3 - 0.2 * s}, {"w": lambda s: 0.2 + 0.5 * s}]


@cache
def bounced() -> co.PhasesSolution:
    return co.evaluate(phased_loops.bounce(free=False), nominal=PUSHES, intervals=40)


@cache
def package() -> CPackage:
    made = export_c(bounced(), FOLDER / "bouncing")
    made.build(flags=QUICK)
    return made


def test_c_equals_python_everywhere() -> None:
    check = package().check(200)
    assert check.ok
    assert check.laws["step"].deviation < 1e-12


def control(t: Any) -> Any:
    """Of the lag."""
    return 0.3 * np.sin(t) + 0.1


def _lag(
    duration: float, name: str, at: list[float], *, first: bool = True, last: bool = True, gain: Any = None
) -> co.Problem:
    """The lag, or one part of it, that is measured and also read at instants."""
    ocp = co.Problem(duration, name=name)
    x = ocp.state("x", initial=0.0 if first else None, final=1.0 if last else None, variance=1.0 if first else None)
    b = ocp.unknown("b", mean=1.0, variance=0.5)
    u = ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=1.0)
    ocp.measurement("position", x, noise=1.0)
    ocp.measurement("fix", x, noise=0.1, at=at)
    ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 2.0} if last else None, gain=gain)
    return ocp


def _gain(t: Any) -> Any:
    """Of the lag, by x and b."""
    return np.array([0.4 + 0.05 * t, 0.1 - 0.02 * t])


def test_gains_that_are_optimised_are_flown_through_the_phases() -> None:
    """The same readings give the same controls as in the whole, whatever the gains are."""
    own = {"gain": co.Gain()}
    whole = co.evaluate(
        _lag(10.0, "whole", [2, 4, 7], **own),
        nominal={"u": lambda s: control(10 * s), "C": lambda s: _gain(10 * s)},
        grid=np.linspace(0, 1, 51),
        substeps=8,
    )
    parts = co.Phases([_lag(4.0, "A", [2, 4], last=False, **own), _lag(6.0, "B", [3], first=False, **own)])
    cut = co.evaluate(
        parts,
        nominal=[
            {"u": lambda s: control(4 * s), "C": lambda s: _gain(4 * s)},
            {"u": lambda s: control(4 + 6 * s), "C": lambda s: _gain(4 + 6 * s)},
        ],
        intervals=[20, 30],
        substeps=8,
    )
    one, other = (
        export_c(s, FOLDER / f"given_{s.name or 'parts'}", largest_spread=np.inf).reference() for s in (whole, cut)
    )
    for k in range(1, 51):
        reading = [float(np.sin(k)), 0.5 if k in (10, 20, 35) else np.nan]
        known, found = one.step(reading, 0.2 * k), other.step(reading, 0.2 * k)
        assert (one.status, other.status) == ("OK", "OK")
        np.testing.assert_allclose(found, known, rtol=1e-8, atol=1e-9, err_msg=f"{0.2 * k}")


def test_the_controller_of_a_problem_cut_in_two_is_that_of_the_whole() -> None:
    """The same readings give the same estimates and controls, also those at the time where the parts meet."""
    whole = co.evaluate(_lag(10.0, "whole", [2, 4, 7]), nominal={"u": lambda s: control(10 * s)}, substeps=4)
    parts = co.Phases([_lag(4.0, "A", [2, 4], last=False), _lag(6.0, "B", [3], first=False)])
    nominal = [{"u": lambda s: control(4 * s)}, {"u": lambda s: control(4 + 6 * s)}]
    cut = co.evaluate(parts, nominal=nominal, intervals=[40, 60], substeps=4)
    one, other = (export_c(s, FOLDER / f"cut_{s.name or 'parts'}").reference() for s in (whole, cut))
    random = np.random.default_rng(3)
    for k in range(1, 101):
        time, x = 0.1 * k, float(whole.at(0.1 * k if k < 100 else 10.0)["x"])
        fix = x + 0.5 * random.standard_normal() if k in (20, 40, 70) else np.nan
        reading = [x + 3.0 * random.standard_normal(), fix]
        known, found = one.step(reading, time), other.step(reading, time)
        assert (one.status, other.status) == ("OK", "OK")
        np.testing.assert_allclose(found, known, rtol=1e-8, atol=1e-9, err_msg=f"{time}")
        np.testing.assert_allclose(other.estimate, one.estimate, rtol=1e-8, atol=1e-9)
        assert other.state["phase"] == int(k >= 40)


def _slopes(phase: co.Solution, t: float) -> tuple[np.ndarray, np.ndarray]:
    """F and G of the body that bounces, as it falls and rises."""
    v = float(phase.at(float(np.clip(t, 0.0, phase.duration)))["v"])
    size = np.sqrt(v**2 + 0.01)
    n = len(phase.augmented)
    F, G = np.zeros((n, n)), np.zeros(n)
    F[0, 1], F[1, 1], F[1, n - 1], G[1] = 1.0, -phased_loops.DRAG * (size + v**2 / size), -v * size, 1.0
    if n == 5:
        F[1, 2], F[2, 2] = 1.0, -1.0
    return F, G


def _predicted(phase: co.Solution, name: str, y: np.ndarray, held: float, begin: float, end: float) -> np.ndarray:
    def rate(t: float, y: np.ndarray) -> np.ndarray:
        F, G = _slopes(phase, t)
        return F @ y + G * (held - float(phase.at(float(np.clip(t, 0.0, phase.duration)))[name]))

    return solve_ivp(rate, (begin, end), y, rtol=1e-10, atol=1e-13).y[:, -1]


def _mean(phase: co.Solution, name: str, begin: float, end: float) -> float:
    """Of a control that is linear between the nodes."""
    ends = np.unique([begin, *(t for t in phase.t if begin < t < end), min(end, phase.duration)])
    return float(np.trapezoid(np.ravel(phase.at(ends)[name]), ends) / (ends[-1] - begin))


def _joined(phase: co.Solution, z: np.ndarray, held: float, end: float) -> np.ndarray:
    """Deviation of what rises, and integrals of place and speed as they are expected, from its beginning."""

    def rate(t: float, z: np.ndarray) -> np.ndarray:
        F, G = _slopes(phase, t)
        now = phase.at(float(np.clip(t, 0.0, phase.duration)))
        return np.concatenate([F @ z[:5] + G * (held - float(now["w"])), np.ravel([now["x"], now["v"]]) + z[:2]])

    return solve_ivp(rate, (0.0, end), z, rtol=1e-10, atol=1e-13).y[:, -1]


def test_a_step_across_passes_the_estimate_as_an_independent_integration() -> None:
    """Prediction to the end, the tangent of the jump, prediction from there, the reading of the time since then."""
    fall, rise = bounced()
    step = package().python().step
    for k in range(1, 100):
        now = k / 100.0
        step.step([float(fall.at(now)["x"]) + 1.0, np.nan], now)
    before, held = step.estimate[:4].copy(), float(step.state["control"])
    assert abs(before).max() > 0.01
    assert step.state["phase"] == 0
    end = _predicted(fall, "u", before, held, 0.99, 1.0)
    speed = float(fall["v"][-1])
    J = np.zeros((5, 4))
    J[0, 0] = J[3, 2] = J[4, 3] = 1.0
    J[1, 1], J[1, 2] = -phased_loops.RESTITUTION, -speed
    h, begun = 0.02, float(rise["w"][0])
    z = _joined(rise, np.append(J @ end, [0.0, 0.0]), begun, h)
    Phi = np.column_stack([_joined(rise, c, 0, h) for c in np.eye(7)]) - _joined(rise, np.zeros(7), 0, h)[:, None]
    P, M, Q, U = np.zeros((7, 7)), np.eye(5)[:2], np.diag([0.01, 0.02, 0.05, 0.0, 0.0]), np.diag([0.1, 0.2])
    F, noise = _slopes(fall, 0.995)[0], np.diag([0.01, 0.02, 0.0, 0.0])
    unread = expm(0.01 * np.block([[-F, noise], [np.zeros((4, 4)), F.T]]))  # no reading of the last 0.01 s of the fall
    ended = unread[4:, 4:].T @ fall.at(0.99)["E"] @ unread[4:, 4:] + unread[4:, 4:].T @ unread[:4, 4:]
    P[:5, :5] = rise.values["E"][0] + J @ (ended - fall.values["E"][-1]) @ J.T
    F = np.zeros((7, 7))
    F[:5, :5], F[5:, :5] = _slopes(rise, h / 2)[0], M  # what noise makes while F is nearly constant
    density = np.block([[Q, np.zeros((5, 2))], [np.zeros((2, 5)), U]])
    loan = expm(h * np.block([[-F, density], [np.zeros((7, 7)), F.T]]))
    P = Phi @ P @ Phi.T + loan[7:, 7:].T @ loan[:7, 7:]
    at = rise.at(h)
    reading = np.array([float(at["x"]) + 0.2, float(at["v"]) - 0.3])
    y = z[:5] + h * P[:5, 5:] @ np.linalg.inv(P[5:, 5:]) @ (reading - z[5:] / h)
    control = step.step(reading, 1.0 + h)
    assert (step.status, step.state["phase"]) == ("OK", 1)
    np.testing.assert_allclose(step.estimate, y, rtol=1e-6, atol=1e-8)
    C = rise.at(h)["S"][1] @ np.eye(5)
    mean = _mean(rise, "w", h, h + 0.03)  # the last step began at 0.99
    assert float(control[0]) == pytest.approx(mean - float(C @ y), abs=1e-6)


def test_a_step_where_phases_meet_takes_the_reading_of_the_one_that_ends() -> None:
    """It gives out the control of the one that begins, C(0) of its own; the same time again changes nothing."""
    fall, rise = bounced()
    laws = package().python(), quick(co.export_c(fall, FOLDER / "fall")).python()
    for k in range(1, 21):
        time = k / 20.0
        reading = float(fall.at(time)["x"]) + 0.2 * np.cos(9 * time)
        control = laws[0].step([reading, np.nan], time)
        laws[1].step([reading], time)
    J = np.zeros((5, 4))
    J[0, 0] = J[3, 2] = J[4, 3] = 1.0
    J[1, 1], J[1, 2] = -phased_loops.RESTITUTION, -float(fall["v"][-1])
    y = J @ laws[1].estimate
    assert laws[0].status == "OK"
    assert (laws[0].state["phase"], laws[0].state["time"]) == (1, 1.0)
    np.testing.assert_allclose(laws[0].estimate, y, rtol=1e-9, atol=1e-12)
    assert float(control[0]) == pytest.approx(_mean(rise, "w", 0.0, 0.05) - float(rise.gains["C"][0, 0] @ y), rel=1e-9)
    again = laws[0].step([5.0, 5.0], 1.0)
    np.testing.assert_allclose(again, control, rtol=1e-12)
    np.testing.assert_allclose(laws[0].estimate, y, rtol=1e-9, atol=1e-12)


def test_what_should_not_happen_has_a_status_and_nominal_control() -> None:
    fall, rise = bounced()
    step = package().python().step
    step.step([float(fall.at(0.4)["x"]) + 0.3, 0.0], 0.4)
    step.step([float(rise.at(0.1)["x"]), float(rise.at(0.1)["v"]) + 0.4], 1.1)
    kept = step.estimate.copy()
    assert abs(kept).max() > 1e-3
    for time, status, nominal in (
        (0.7, "TIME_BACKWARDS", rise["w"][0]),  # of the phase that it is in, where it begins
        (1.05, "TIME_BACKWARDS", rise.at(0.05)["w"]),
        (9.0, "TIME_AFTER", rise["w"][-1]),
        (-1.0, "TIME_BEFORE", rise["w"][0]),
        (np.nan, "TIME_NOT_FINITE", rise.at(0.1)["w"]),
    ):
        control = step.step([0.0, 0.0], time)
        assert step.status == status
        assert float(control[0]) == pytest.approx(float(nominal), rel=1e-9)
        np.testing.assert_array_equal(step.estimate, kept)
        assert (step.state["time"], step.state["phase"]) == (1.1, 1)


def _leg(name: str, *, first: bool, control: str = "u") -> co.Problem:
    """An integrator that is measured and moved by noise, for a second."""
    ocp = co.Problem(1.0, name=name)
    x = ocp.state("x", initial=1.0 if first else None, variance=0.3 if first else None)
    u = ocp.control(control, lower=-2.0, upper=2.0)
    ocp.dynamics(x, u, noise=0.2)
    ocp.measurement("position", x, noise=0.05)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=2.0 * x**2 if name == "three" else 0.0)
    return ocp


@cache
def kicked() -> co.PhasesSolution:
    """Three phases, with the jump x+ = -0.8 x + noise before the last."""
    one, two, three = (_leg(name, first=name == "one") for name in ("one", "two", "three"))
    phases = co.Phases([one, two, three], name="kicked")
    phases.jump(three.states[0].symbol, -0.8 * two.states[0].symbol, noise=0.1)
    return co.solve(phases, intervals=20, tolerance=1e-9, **QUIET)


def test_the_loop_flies_as_predicted() -> None:
    """200 runs of the linear system with the compiled controller: spread at the ends of all phases, and mean."""
    made = export_c(kicked(), FOLDER / "kicked")
    made.build(flags=QUICK)
    step, random, h = made.python().step, np.random.default_rng(8), 0.05
    runs, ends = 200, {20: "one", 40: "two", 60: "three"}
    found: dict[str, list[float]] = {name: [] for name in ends.values()}
    for _ in range(runs):
        step.init()
        x, u = 1.0 + np.sqrt(0.3) * random.standard_normal(), float(step.state["control"])
        for k in range(1, 61):
            seen = x * h
            x += h * u + np.sqrt(0.2 * h) * random.standard_normal()
            seen = (seen + x * h) / 2 / h + np.sqrt(0.05 / h) * random.standard_normal()
            if k in ends:
                found[ends[k]].append(x)
            u = float(step.step([seen], k * h)[0])
            if k == 40:
                x = -0.8 * x + np.sqrt(0.1) * random.standard_normal()
    for phase in kicked():
        values = np.array(found[phase.name])
        expected = float(phase.loop.X[-1, 0, 0])
        assert values.var() == pytest.approx(expected, rel=4.0 * np.sqrt(2.0 / runs) + 0.05)
        assert values.mean() == pytest.approx(float(phase["x"][-1]), abs=4.0 * np.sqrt(expected / runs) + 0.01)


def test_a_step_over_a_whole_phase() -> None:
    """From the first phase to the last one: y+ = -0.8 (y + what the held control and the nominal make of it)."""
    solution = kicked()
    step = export_c(solution, FOLDER / "skipped").reference()
    step.step([2.0], 0.5)
    y, held = float(step.estimate[0]), float(step.state["control"])
    step.step([np.nan], 2.2)
    moved = y
    for phase, begin, end in ((solution["one"], 0.5, 1.0), (solution["two"], 0.0, 1.0)):
        t = np.linspace(begin, end, 2001)
        moved += held * (end - begin) - np.trapezoid(phase.at(t)["u"], t)
    t = np.linspace(0.0, 0.2, 401)
    moved = -0.8 * moved + held * 0.2 - np.trapezoid(solution["three"].at(t)["u"], t)
    assert (step.status, step.state["phase"]) == ("MEASUREMENT_MISSING", 2)
    assert float(step.estimate[0]) == pytest.approx(moved, abs=1e-9)  # linear controls are integrated exactly
    assert step.state["time"] == 2.2


def test_limits_hold_in_the_phases_that_have_the_control() -> None:
    one, two = _leg("one", first=True), _leg("three", first=False, control="w")
    solution = co.solve(co.Phases([one, two]), intervals=20, **QUIET)
    with pytest.warns(co.CovocpWarning, match="outside the limits"):
        made = export_c(solution, FOLDER / "limited", limits={"w": (-0.05, 0.05)})
    step = made.reference()
    assert abs(float(step.step([9.0], 0.5)[0])) > 0.05
    assert float(step.step([9.0], 1.5)[0]) == -0.05
    header = (made.directory / "limited.h").read_text()
    assert "LIMITED_THREE_LIMIT_W_LOWER" in header
    assert "In one: The control is not limited" in header.replace("\n *  ", "")
    bounded = export_c(solution, FOLDER / "bounded", limits="bounds").reference()
    assert float(bounded.step([99.0], 0.5)[0]) == -2.0
    with pytest.raises(co.ProblemError, match="'v' is not in this solution"):
        export_c(solution, FOLDER / "refused", limits={"v": (0.0, 1.0)})


def test_what_does_not_apply_is_refused() -> None:
    with pytest.raises(co.ExportError, match="a solution of phases"):
        export_c(kicked(), FOLDER / "refused", period=0.1)
    with pytest.raises(co.ExportError, match="largest_spread"):
        export_c(kicked(), FOLDER / "refused", largest_spread=0.5)
    with pytest.raises(co.ExportError, match="limits= are those of a controller"):
        export_c(kicked(), FOLDER / "refused", limits="bounds", feedback=False)
    loaded = co.load(kicked().save(FOLDER / "kicked.npz"))
    with pytest.raises(co.ExportError, match="does not know them"):
        export_c(loaded, FOLDER / "refused")
    assert not (FOLDER / "refused").exists()


@pytest.mark.parametrize(("first", "later"), [([0.0, 2], [3]), ([2], [0.0, 3])])
def test_a_reading_where_a_phase_begins_is_refused_by_name(first: list[float], later: list[float]) -> None:
    parts = co.Phases([_lag(4.0, "A", first, last=False), _lag(6.0, "B", later, first=False)])
    solution = co.evaluate(parts, nominal=[{"u": 0.1}, {"u": 0.1}], intervals=20)
    with pytest.raises(co.ExportError, match=r"Something is read where '[AB]' begins"):
        export_c(solution, FOLDER / "begins")


def _pushed(name: str, order: tuple[str, ...], **start: Any) -> co.Problem:
    """A lag that u moves, and v where it is in the order in which the controls are declared."""
    ocp = co.Problem(1.0, name=name)
    x = ocp.state("x", **start)
    controls = {own: ocp.control(own) for own in order}
    u, v = controls["u"], controls.get("v")
    ocp.dynamics(x, u if v is None else u + 0.5 * v + 0.3, noise=0.01)
    ocp.measurement("position", x, noise=0.01)
    cost = 0.5 * u**2 + x**2
    ocp.minimize_expected(running=cost if v is None else cost + 0.5 * (v - 2.0) ** 2, terminal_weight={x: 4.0})
    return ocp


@pytest.mark.parametrize("order", [("u", "v"), ("v", "u")])
def test_a_spurious_time_changes_nothing_for_the_next_step(order: tuple[str, ...]) -> None:
    """C and Python: the struct is that of the last valid step, the control returned the nominal one of its phase."""
    first = _pushed("one", ("u",), initial=0.5, variance=0.05)
    phases = co.Phases([first, _pushed("two", order, initial=None, final=0.2)])
    solution = co.solve(phases, intervals=10, **QUIET)
    made = export_c(solution, FOLDER / f"spurious_{''.join(order)}")
    made.build(flags=QUICK)
    assert made.check(100).ok
    for laws in (made.python(), made.reference()):
        step, kept = laws["step"], ("time", "phase", "estimate", "control")
        for valid, wrong in (((0.1, 0.2, 0.3), (9.0, -1.0, 0.15, np.nan)), ((0.5, 1.0, 1.5), (0.5, 1.2, 9.0, np.inf))):
            step.init()
            for time in valid:
                step.step([float(solution.at(time)["x"]) + 0.3], time)
            before, phase = step.state, solution[int(step.state["phase"])]
            known = step.step([np.nan], valid[-1] + 0.1), step.estimate.copy()
            for stamp in wrong:
                step.init()
                for time in valid:
                    step.step([float(solution.at(time)["x"]) + 0.3], time)
                returned = step.step([0.0], stamp)
                assert step.status.startswith("TIME_")
                for name in kept:
                    np.testing.assert_array_equal(step.state[name], before[name], err_msg=f"{name} after {stamp}")
                since = (stamp if np.isfinite(stamp) else valid[-1]) - (1.0 if phase.name == "two" else 0.0)
                nominal = phase.at(float(np.clip(since, 0.0, 1.0)))
                names = ("u",) if phase.name == "one" else order
                for row, name in enumerate(names):
                    assert returned[row] == pytest.approx(float(nominal[name]), rel=1e-9)
                np.testing.assert_array_equal(step.step([np.nan], valid[-1] + 0.1), known[0])
                np.testing.assert_array_equal(step.estimate, known[1])


RATE, MOVED, SEEN, TURN, SIDE = -0.5, 0.2, 0.05, -0.8, 0.05


def _quiet(name: str, *, measures: str) -> co.Problem:
    """A lag moved by noise for a second, of which the position is measured, or nothing: said, or left out."""
    first = name == "one"
    ocp = co.Problem(1.0, name=name)
    x = ocp.state("x", initial=1.0 if first else None, variance=0.3 if first else None)
    u = ocp.control("u")
    ocp.dynamics(x, RATE * x + u, noise=MOVED)
    if measures == "position":
        ocp.measurement("position", x, noise=SEEN)
    elif measures == "no information":
        ocp.measurement("position", x, information=0.0)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=2.0 * x**2 if name == "three" else 0.0)
    return ocp


@cache
def unmeasured(first: str, second: str, third: str) -> co.PhasesSolution:
    """Three phases with what each measures, and the jump x+ = -0.8 x + noise before the second."""
    measures = {"one": first, "two": second, "three": third}
    one, two, three = (_quiet(name, measures=own) for name, own in measures.items())
    phases = co.Phases([one, two, three])
    phases.jump(two.states[0].symbol, TURN * one.states[0].symbol, noise=0.1)
    return co.solve(phases, intervals=20, tolerance=1e-9, **QUIET)


def _riccati(measures: list[bool]) -> tuple[np.ndarray, np.ndarray]:
    """E where each of the 60 steps begins and S of each phase at its 21 nodes, by integrations of their own."""
    E, S, errors, weights = 0.3, 4.0, [], np.zeros((3, 21))
    t, accurate = np.linspace(0.0, 1.0, 21), {"rtol": 1e-11, "atol": 1e-13}
    for k, seen in enumerate(measures):
        W = 1.0 / SEEN if seen else 0.0
        path = solve_ivp(lambda _, E, W=W: 2 * RATE * E + MOVED - E * W * E, (0, 1), [E], t_eval=t, **accurate).y[0]
        errors.append(path[:-1])
        E = TURN**2 * path[-1] + 0.1 if k == 0 else path[-1]
    for k in (2, 1, 0):
        path = solve_ivp(lambda _, S: 2 * RATE * S + 2.0 - S**2, (0, 1), [S], t_eval=t, **accurate).y[0]
        weights[k] = path[::-1]
        S = TURN**2 * path[-1] if k == 1 else path[-1]
    return np.concatenate(errors), weights


def _filtered(solution: co.PhasesSolution, measures: list[bool], readings: np.ndarray) -> np.ndarray:
    """Control and estimate after each of 60 steps of 0.05 s: prediction alone in phases that measure nothing."""
    errors, S = _riccati(measures)
    phi, y, held, found = np.exp(RATE * SIDE), 0.0, float(solution[0]["u"][0]), []
    nodes, weights = np.polynomial.legendre.leggauss(5)
    slope = (phi - 1.0) / RATE  # of the integral of the deviation over a step
    F, E = np.array([[RATE, 0.0], [1.0, 0.0]]), 0.0
    loan = expm(SIDE * np.block([[-F, np.diag([MOVED, SEEN])], [np.zeros((2, 2)), F.T]]))
    for k, reading in enumerate(readings):
        phase, begin = k // 20, (k % 20) * SIDE
        inside = SIDE * (1.0 + nodes) / 2.0
        moved, on = held - solution[phase].at(begin + inside)["u"], SIDE - inside
        # integrals of x along the nominal, and of the deviation, which goes on to the end of the step
        seen = float(weights @ (solution[phase].at(begin + inside)["x"] + (np.exp(RATE * on) - 1.0) / RATE * moved))
        seen = SIDE / 2.0 * seen + slope * y
        y = phi * y + SIDE / 2.0 * float(weights @ (np.exp(RATE * on) * moved))
        if measures[phase]:
            if k % 20 == 0 or abs(E / errors[k] - 1.0) < 1e-2:
                E = errors[k]  # what is known is what the design expects
            P = loan[2:, 2:].T @ np.diag([E, 0.0]) @ loan[2:, 2:] + loan[2:, 2:].T @ loan[:2, 2:]
            L, E = SIDE * P[0, 1] / P[1, 1], P[0, 0] - P[0, 1] ** 2 / P[1, 1]
            y += L * (reading - seen / SIDE)
        y *= TURN if k == 19 else 1.0
        now, node = (phase + 1, 0) if k in (19, 39) else (phase, k % 20 + 1)
        begin = solution[now].t[0] + (0.0 if node == 0 else begin + SIDE)
        mean = _mean(solution[now], "u", begin, begin + SIDE) if begin < 1.0 - 1e-9 else float(solution[now]["u"][-1])
        held = mean - S[now, node] * y
        found.append([held, y])
    return np.array(found)


def _stepped(step: Any, readings: np.ndarray) -> np.ndarray:
    """The same of a controller."""
    step.init()
    found = []
    for k, reading in enumerate(readings):
        found.append([float(step.step([reading], SIDE * (k + 1))[0]), float(step.estimate[0])])
        assert step.status == "OK", k
    return np.array(found)


@pytest.mark.parametrize("silent", [0, 1, 2])
def test_a_phase_that_measures_nothing_predicts_and_feeds_back(silent: int) -> None:
    """C and Python as an independent filter, and as with a measurement of no information; what is given is ignored."""
    seen = [k != silent for k in range(3)]
    solution = unmeasured(*("position" if own else "nothing" for own in seen))
    made = export_c(solution, FOLDER / f"silent_{silent}")
    made.build(flags=QUICK)
    assert made.check(200).ok
    own = ("one", "two", "three")[silent]
    assert f"in {own}: nothing" in (made.directory / f"silent_{silent}.h").read_text()
    readings = np.concatenate([phase["x"][1:] for phase in solution]) + 0.4 + 0.2 * np.sin(np.arange(60.0))
    given = readings.copy()
    given[20 * silent : 20 * silent + 20] = np.resize([np.nan, np.inf, 1e200, -7.0], 20)
    known = _filtered(solution, seen, readings)
    if silent:
        assert abs(known[20 * silent + 5, 1]) > 0.01  # the estimate of before goes on
    for laws in (made.python(), made.reference()):
        np.testing.assert_allclose(_stepped(laws["step"], given), known, rtol=1e-5, atol=1e-6)
    said = unmeasured(*("position" if own else "no information" for own in seen))
    other = export_c(said, FOLDER / f"said_{silent}").reference()["step"]
    np.testing.assert_allclose(_stepped(other, readings), known, rtol=1e-5, atol=1e-6)


def test_steps_across_a_phase_that_measures_nothing() -> None:
    """From its inside and over all of it, as with a measurement of no information; its filter gain is zero."""
    steps = [
        export_c(unmeasured("position", own, "position"), FOLDER / name).reference()["step"]
        for own, name in (("nothing", "over"), ("no information", "over_said"))
    ]
    for times in ((0.4, 0.93, 1.31, 2.2), (0.5, 2.3), (0.5, 1.0, 2.0, 2.5)):
        for step in steps:
            step.init()
        for time in times:
            controls = [float(step.step([0.7], time)[0]) for step in steps]
            assert [step.status for step in steps] == ["OK", "OK"]
            assert controls[0] == pytest.approx(controls[1], rel=1e-7)
            assert float(steps[0].estimate[0]) == pytest.approx(float(steps[1].estimate[0]), rel=1e-7)
            assert (float(np.sum(steps[0].state["filter_gain"])) == 0.0) == (1.0 <= time <= 2.0)


def test_phases_none_of_which_measures_anything_have_no_controller() -> None:
    solution = unmeasured("nothing", "nothing", "nothing")
    with pytest.raises(co.ExportError, match="no phase measures anything") as caught:
        export_c(solution, FOLDER / "refused")
    assert "'one', 'two', 'three' without one" in str(caught.value)
    with pytest.raises(co.ExportError, match="the problem measures nothing"):
        export_c(solution["one"], FOLDER / "refused")
    assert not (FOLDER / "refused").exists()


def _regulated(duration: float, name: str, *, first: bool = True, last: bool = True) -> co.Problem:
    p = co.Problem(duration, name=name)
    x, u = p.state("x", initial=1.0 if first else None, variance=1.0 if first else None), p.control("u")
    p.dynamics(x, u - 0.2 * x, noise=0.05)
    p.measurement("place", x, noise=0.05)
    p.minimize_expected(running=0.5 * u**2 + x**2, terminal=2.0 * x**2 if last else 0.0)
    return p


def test_readings_that_were_missing_count_beyond_the_junction() -> None:
    """None comes for two seconds, up to where the phases meet: the next one counts as after the gap in one problem."""
    whole = co.solve(_regulated(4.0, "whole"), intervals=80, progress=False)
    parts = [_regulated(2.0, "one", last=False), _regulated(2.0, "two", first=False)]
    cut = co.solve(co.Phases(parts), intervals=40, progress=False)
    one, other = (export_c(s, FOLDER / f"gap_{s.name or 'parts'}").reference() for s in (whole, cut))
    for k in range(1, 41):
        time = 0.1 * k
        reading = np.nan if k <= 20 else float(whole.at(min(time, 4.0))["x"]) + 0.8
        known, found = one.step(reading, time), other.step(reading, time)
        np.testing.assert_allclose(found, known, rtol=1e-4, atol=1e-5, err_msg=f"{time}")
        np.testing.assert_allclose(other.estimate, one.estimate, rtol=1e-4, atol=1e-5, err_msg=f"{time}")
        if k == 21:  # E of the gap: E' = 0.05 - 0.4 E from 1; a mean over 0.1 s, whose noise is 0.05/0.1
            E = 0.125 + 0.875 * np.exp(-0.4 * 2.05)
            assert float(other.estimate[0]) == pytest.approx(0.8 * E / (E + 0.5), rel=0.02)
