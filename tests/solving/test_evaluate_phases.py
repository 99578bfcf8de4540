"""Phases evaluated along given controls, and under other statistics: against the whole, scipy and differences."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import phased
import phased_loops
import pytest
from read_again import printed
from scipy.integrate import solve_ivp
from scipy.stats import norm

import covocp as co

QUIET: dict[str, Any] = {"progress": False}
PUSHES: list[dict[str, Any]] = [{"u": lambda s: 0.3 - 0.2 * s}, {"w": lambda s: 0.2 + 0.5 * s}]


def control(t: Any) -> Any:
    """Of the lag."""
    return 0.3 * np.sin(t) + 0.1


@pytest.mark.parametrize("module", [phased, phased_loops])
def test_a_problem_cut_in_two_has_the_values_of_the_whole(module: Any) -> None:
    """Cost, covariances and the slopes of the cost by them, along the same control on the same nodes."""
    parts = co.Phases([module.lag(4.0, "A", last=False), module.lag(6.0, "B", first=False)])
    whole = co.evaluate(module.lag(10.0, "whole"), nominal={"u": lambda s: control(10 * s)}, substeps=4)
    nominal = {"A": {"u": lambda s: control(4 * s)}, "B": {"u": lambda s: control(4 + 6 * s)}}
    cut = co.evaluate(parts, nominal=nominal, intervals=[40, 60], substeps=4)
    assert cut.cost == pytest.approx(whole.cost, rel=1e-9)
    for phase, nodes in zip(cut, (slice(0, 41), slice(40, 101)), strict=True):
        for name, values in phase.values.items():
            if name not in ("time", "duration") and "(" not in name:
                np.testing.assert_allclose(values, whole.values[name][nodes], rtol=1e-8, atol=1e-10, err_msg=name)
        for own, known in (
            (phase.costates.state, whole.costates.state),
            (phase.costates.matrices, whole.costates.matrices),
        ):
            np.testing.assert_allclose(own, known[nodes], rtol=1e-7, atol=1e-8)
    assert cut["B"].violations["final value of x"] == pytest.approx(1.0 - whole["x"][-1], rel=1e-9)
    assert cut.violations.keys() == {"B: final value of x"}


@cache
def bounced() -> co.PhasesSolution:
    return co.evaluate(phased.bounce(), nominal=PUSHES, intervals=40)


def _drag(v: float) -> float:
    return phased.DRAG * v * float(np.sqrt(v**2 + 0.01))


def test_a_jump_with_noise_and_a_state_that_appears_are_those_of_an_independent_integration() -> None:
    """State, E and cost of the body that bounces, from differences of its rates and scipy alone."""
    fall, rise = bounced()
    R, Q = [[0.1], [0.1, 0.2]], [np.diag([0.01, 0.02, 0, 0]), np.diag([0.01, 0.02, 0.05, 0, 0])]

    def rates(phase: int, z: np.ndarray, t: float) -> np.ndarray:
        if not phase:
            x, v, _, k = z
            u = 0.3 - 0.2 * t
            return np.array([v, -1.0 - k * v * np.sqrt(v**2 + 0.01) + u, 0.0, 0.0])
        x, v, q, _, k = z
        w = 0.2 + 0.5 * t / 1.5
        return np.array([v, -1.0 - k * v * np.sqrt(v**2 + 0.01) + w + q, -q, 0.0, 0.0])

    def forth(phase: int, z: np.ndarray, E: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray, float]:
        n = z.size
        M = np.eye(n)[: len(R[phase])]
        W = M.T @ np.diag(1.0 / np.array(R[phase])) @ M

        def rate(t: float, y: np.ndarray) -> np.ndarray:
            z, E = y[:n], y[n : n + n * n].reshape(n, n)
            step = 1e-6 * np.eye(n)
            F = np.column_stack([(rates(phase, z + d, t) - rates(phase, z - d, t)) / 2e-6 for d in step])
            u = 0.3 - 0.2 * t if not phase else 0.2 + 0.5 * t / 1.5
            L = 0.5 * u**2 + (0.0 if phase else 0.3 * E[1, 1])
            dE = F @ E + E @ F.T + Q[phase] - E @ W @ E
            return np.concatenate([rates(phase, z, t), dE.ravel(), [L]])

        y = solve_ivp(rate, (0.0, duration), np.concatenate([z, E.ravel(), [0.0]]), rtol=1e-9, atol=1e-11).y[:, -1]
        return y[:n], y[n : n + n * n].reshape(n, n), float(y[-1])

    z, E, cost = forth(0, np.array([1.0, 0.0, phased.RESTITUTION, phased.DRAG]), np.diag([0.1, 0.5, 0.04, 0.01]), 1.0)
    assert fall.duration == 1.0  # as guessed
    np.testing.assert_allclose(fall.trajectory.x[-1], z[:2], atol=1e-7)
    np.testing.assert_allclose(fall.values["E"][-1], E, atol=1e-7)
    assert fall.cost == pytest.approx(cost + 0.1, rel=1e-7)
    J = np.zeros((5, 4))
    J[0, 0] = J[3, 2] = J[4, 3] = 1.0
    J[1, 1], J[1, 2] = -phased.RESTITUTION, -z[1]
    E = J @ E @ J.T + np.diag([0.0, 0.01 * z[1] ** 2, 0.3, 0.0, 0.0])
    z = np.array([z[0], -phased.RESTITUTION * z[1], 0.1, *z[2:]])
    np.testing.assert_allclose(rise.values["E"][0], E, atol=1e-7)
    z, E, own = forth(1, z, E, 1.5)
    np.testing.assert_allclose(rise.trajectory.x[-1], z[:3], atol=1e-7)
    np.testing.assert_allclose(rise.values["E"][-1], E, atol=1e-7)
    assert rise.cost == pytest.approx(own + 20.0 * E[4, 4] + 3.0 * E[0, 0] + 2.0 * E[3, 3], rel=1e-7)
    assert bounced().cost == fall.cost + rise.cost
    assert bounced().violations["fall: final value of x"] == pytest.approx(abs(fall["x"][-1]), rel=1e-12)


def test_costates_are_slopes_of_the_cost_of_all_phases() -> None:
    """By the initial variance of the speed, through the jump; by differences of evaluated costs."""
    costs = [co.evaluate(phased.bounce(0.5 + d), nominal=PUSHES, intervals=40).cost for d in (-1e-4, 1e-4)]
    slope = (costs[1] - costs[0]) / 2e-4
    assert bounced()["fall"].costate("E")[0, 1, 1] == pytest.approx(slope, rel=1e-6)


def test_along_a_solution_of_the_phases() -> None:
    """The same cost, durations and gains; link residuals, which compare what was optimised, are not there."""
    for phases in (phased.bounce(), phased_loops.bounce()):
        best = co.solve(phases, intervals=20, tolerance=1e-9, **QUIET)
        again = co.evaluate(phases, nominal=best)
        assert again.cost == pytest.approx(best.cost, rel=1e-10)
        np.testing.assert_array_equal(again.durations, best.durations)
        assert not again.violations
        assert np.isnan(again.link_residuals).all()
        assert "k_x + J' p+" not in str(again)
        finer = co.evaluate(phases, nominal=best, intervals=[40, 80])
        assert finer.cost == pytest.approx(best.cost, rel=1e-7)
    np.testing.assert_allclose(again["fall"].gains["C"], best["fall"].gains["C"], rtol=1e-9, atol=1e-11)


def test_what_was_evaluated_is_kept_and_simulated(tmp_path: Path) -> None:
    found = co.evaluate(phased_loops.bounce(), nominal=PUSHES, intervals=20)
    path = found.save(tmp_path / "bounce.json")
    for read, alone in ((co.load(path), True), (co.load(path, phased_loops.bounce()), False)):
        assert printed(read, alone=alone) == str(found)
    assert co.simulate(found, 400, seed=3, **QUIET).holds
    truth = phased_loops.bounce()
    other = co.evaluate(co.load(path, phased_loops.bounce()), truth=truth)
    assert other.cost == pytest.approx(found.cost, rel=1e-6)  # by the covariances in place of E and S
    with pytest.raises(co.ProblemError, match="knows no phases"):
        co.evaluate(co.load(path), truth=truth)


# --- other statistics than the design's -------------------------------------------------------------------------------


def integrator(
    name: str, *, first: bool, noise: float = 0.2, variance: float = 0.3, accuracy: float = 0.05
) -> co.Problem:
    """A state that is measured and moved by noise, for a second."""
    ocp = co.Problem(1.0, name=name)
    x = ocp.state("x", initial=1.0 if first else None, variance=variance if first else None)
    u = ocp.control("u")
    q = ocp.parameter("q", noise)
    ocp.dynamics(x, u - 0.3 * x, noise=q)
    ocp.measurement("position", x, noise=accuracy)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=0.0 if first else 2.0 * x**2)
    return ocp


def kicked(factor: float = -0.8, jump: float = 0.1, **numbers: float) -> co.Phases:
    """Two of them, with a jump between."""
    one, two = (integrator(name, first=name == "one", **numbers) for name in ("one", "two"))
    phases = co.Phases([one, two], name="kicked")
    phases.jump(two.states[0].symbol, factor * one.states[0].symbol, noise=jump)
    return phases


@cache
def designed() -> co.PhasesSolution:
    return co.solve(kicked(), intervals=40, tolerance=1e-9, **QUIET)


def test_another_truth_is_that_of_an_independent_integration() -> None:
    """<e e>, <e y>, <y y> of the scalar loop with the gains of the design, and their cost, by scipy."""
    found = co.evaluate(designed(), truth=kicked(jump=0.4, noise=0.5, variance=0.9, accuracy=0.02))
    value, cost = np.array([0.9, 0.0, 0.0]), 0.0
    for phase in designed():

        def rate(t: float, z: np.ndarray, phase: co.Solution = phase) -> list[float]:
            at = phase.at(min(t, 1.0))
            K, C = float(at["E"][0, 0]) / 0.05, float(at["S"][0, 0])
            e, c, y = z[:3]
            spread = K**2 * 0.02
            de = 2 * (-0.3 - K) * e + spread + 0.5
            dc = (-0.3 - K) * c + (-0.3 - C) * c - K * e + spread
            dy = 2 * ((-0.3 - C) * y - K * c) + spread
            nominal = 0.5 * float(at["u"]) ** 2 + float(at["x"]) ** 2
            return [de, dc, dy, nominal + e + y - 2 * c + 0.5 * C**2 * y]

        value[0] = 0.64 * value[0] + 0.4 if phase.name == "two" else value[0]
        value[1:] *= 0.64 if phase.name == "two" else 1.0
        end = solve_ivp(rate, (0.0, 1.0), [*value, 0.0], rtol=1e-9, atol=1e-11).y[:, -1]
        value, cost = end[:3], cost + end[3]
        loop = found[phase.name].loop
        np.testing.assert_allclose([m[-1, 0, 0] for m in (loop.E, loop.Z, loop.Xhat)], value, rtol=2e-6, atol=1e-8)
    cost += 2.0 * (designed()["two"]["x"][-1] ** 2 + value[0] + value[2] - 2 * value[1])
    assert found.cost == pytest.approx(cost, rel=2e-6)
    assert found["two"].origin == "other truth"
    np.testing.assert_array_equal(found["one"]["u"], designed()["one"]["u"])


def test_a_truth_by_a_parameter_counts_in_all_phases() -> None:
    by_name = co.evaluate(designed(), truth={"q": 0.5})
    assert by_name.cost == co.evaluate(designed(), truth=kicked(noise=0.5)).cost
    same = co.evaluate(designed(), truth={"q": 0.2})
    assert same.cost == pytest.approx(designed().cost, rel=1e-6)
    assert by_name.cost > same.cost + 0.1


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        (kicked(factor=-0.7), "jumps differently from 'one' to 'two'"),
        (co.Phases([integrator(n, first=n == "a") for n in "abc"]), "3 phases"),
        (3, "unknown kind"),
        ({"z": 1.0}, "There is no parameter 'z'"),
        (kicked(noise=-1.0), "In the phase 'one'.*density.*truth"),
        (phased_loops.bounce(), "In the phase 'fall'.*another system"),
    ],
)
def test_truths_that_do_not_fit_are_refused(truth: Any, words: str) -> None:
    with pytest.raises(co.ProblemError, match=f"(?s){words}"):
        co.evaluate(designed(), truth=truth)


# --- what is given ----------------------------------------------------------------------------------------------------


def weighed() -> co.Phases:
    """A mass that both phases move, chosen."""
    problems = []
    for name in ("one", "two"):
        ocp = co.Problem(1.0, name=name)
        x = ocp.state("x", initial=None if problems else 1.0)
        m = ocp.decision("m", guess=1.0, lower=0.5, upper=4.0)
        u = ocp.control("u", guess=0.2)
        ocp.dynamics(x, u / m)
        ocp.minimize(running=u**2, terminal=x**2 + 0.1 * m if problems else 0.0)
        problems.append(ocp)
    return co.Phases(problems)


def test_a_decision_is_given_once_and_goes_on() -> None:
    found = co.evaluate(weighed(), nominal={"one": {"u": 1.0, "m": 2.0}, "two": {"u": -1.0}}, intervals=5)
    assert found["two"]["m"] == 2.0
    assert found.cost == pytest.approx(2.0 + 1.0 + 0.2, rel=1e-12)
    same = co.evaluate(weighed(), nominal=[{"u": 1.0, "m": 2.0}, {"u": -1.0, "m": 2.0}], intervals=5)
    assert same.cost == found.cost
    guessed = co.evaluate(weighed(), intervals=5)
    assert guessed.cost == pytest.approx(0.08 + 1.4**2 + 0.1, rel=1e-12)
    with pytest.raises(co.ProblemError, match="gives the decision 'm' two values"):
        co.evaluate(weighed(), nominal=[{"u": 1.0, "m": 2.0}, {"u": -1.0, "m": 3.0}])
    with pytest.raises(co.ProblemError, match="In the phase 'one': The nominal does not give the decision 'm'"):
        co.evaluate(weighed(), nominal=[{"u": 1.0}, {"u": -1.0, "m": 3.0}])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"nominal": {"one": {"u": 1.0, "m": 2.0}}}, "In the phase 'two': The nominal does not give the control 'u'"),
        ({"nominal": {"third": {"u": 1.0}}}, "There is no phase 'third'"),
        ({"nominal": [None]}, "The nominal does not fit the phases"),
        ({"nominal": 3}, "The nominal does not fit the phases"),
        ({"nominal": [4, None]}, "In the phase 'one': The nominal is of an unknown kind"),
        ({"intervals": [3]}, "'intervals' has a value that does not apply"),
        ({"parameters": {"z": 1.0}}, "There is no parameter 'z'"),
        ({"refine": 1e-6}, "has no option 'refine'"),
        ({"nominals": {}}, "(?s)one of .*intervals.*nominal.*parameters.*truth.*perhaps 'nominal' is meant"),
        ({"truth": {}}, "truth= needs a closed loop"),
    ],
)
def test_what_does_not_fit_is_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(co.ProblemError, match=words):
        co.evaluate(weighed(), **{"intervals": 5, **given})


def test_a_jump_without_a_value_is_told_from_the_phases_it_joins() -> None:
    """sqrt(-x) where x ends above zero, along a nominal at exp(-0.3); the phases themselves have values."""
    one, two = (integrator(name, first=name == "one") for name in ("one", "two"))
    phases = co.Phases([one, two], name="rooted")
    phases.jump(two.states[0].symbol, ca.sqrt(-one.states[0].symbol))
    words = "jump of x from 'one' to 'two' is nan for what 'one' ends with.*received: x = "
    with pytest.raises(co.SolveError, match=f"(?s){words}0.7408, duration 1 s"):
        co.evaluate(phases, nominal=[{"u": 0.0}, {"u": 0.0}], intervals=20)
    with pytest.raises(co.ProblemError, match=f"(?s){words}") as caught:
        co.solve(phases, intervals=5, **QUIET)
    assert "steps" not in str(caught.value)


def test_a_truth_for_a_loop_that_was_lost_says_so() -> None:
    """As where the last iterate of a failed run is not finite: its problem has an expected cost all the same."""
    found = designed()
    lost = replace(found, phases=(found.phases[0], replace(found.phases[1], loop=None)))
    with pytest.raises(co.ProblemError, match="covariances of that of the phase 'two' are NaN or inf"):
        co.evaluate(lost, truth={"q": 0.5})


def test_a_nominal_that_leaves_the_domain_is_an_error_that_names_the_phase() -> None:
    one, two = co.Problem(1.0, name="one"), co.Problem(1.0, name="two")
    for ocp in (one, two):
        x, u = ocp.state("x", initial=1.0 if ocp is one else None), ocp.control("u")
        ocp.dynamics(x, -ca.sqrt(x) + u)
        ocp.minimize(running=u**2)
    with pytest.raises(co.SolveError, match="The phase 'two' becomes NaN or inf"):
        co.evaluate(co.Phases([one, two]), nominal=[{"u": 0.0}, {"u": -3.0}], intervals=10)
    with pytest.raises(co.ProblemError, match="keeps its nominal"):
        co.evaluate(designed(), nominal={"one": {"u": 0.0}})


def test_chances_under_another_truth_are_those_of_its_deviations():
    """The probability of a normal variable with the deviations of the loop under that truth, at the worst node."""

    def flight(name, noise, initial=None, variance=None):
        ocp = co.Problem(1.0, name=name)
        x, u = ocp.state("x", initial=initial, variance=variance), ocp.control("u")
        ocp.dynamics(x, u, noise=noise)
        ocp.measurement("y", x, noise=noise / 2)
        ocp.minimize_expected(running=0.5 * u**2 + 2 * (x - 1) ** 2)
        ocp.chance(x, upper=0.8, probability=0.95, name="wall", at="path")
        return ocp

    def both(noise):
        return co.Phases([flight("a", noise, 0.0, 0.02), flight("b", noise)])

    found = co.evaluate(co.solve(both(0.02), intervals=20, progress=False), truth=both(0.08))
    for phase in found.phases:
        spread = np.sqrt(phase.loop.X[:, 0, 0])
        expected = float(np.min(norm.cdf((0.8 - phase["x"]) / spread)))
        assert phase.chances[0].reached == pytest.approx(expected, abs=1e-6)
        assert not phase.chances[0].met
        assert any("wall" in name for name in phase.violations)
    assert found.violations == {f"{p.name}: {name}": by for p in found.phases for name, by in p.violations.items()}


def test_a_free_duration_at_its_bound_is_held_by_it():
    """From rest to rest through a jump of the speed: both durations end at their bounds.

    An interior-point method stays off them by what that costs: the Hamiltonian there is no residual.
    """
    chosen = []

    def leg(name, mass, first):
        ocp = co.Problem(co.Free(1.0, 0.2, 5.0), name=name)
        chosen.append(ocp.decision("d", guess=0.1, lower=-1.0, upper=0.25))
        x = ocp.state("x", initial=0.0 if first else None, final=None if first else 2.0)
        v = ocp.state("v", initial=0.0 if first else None, final=None if first else 0.0)
        u = ocp.control("u", lower=-20.0, upper=20.0)
        ocp.dynamics(x, v)
        ocp.dynamics(v, u / mass)
        ocp.minimize(running=u**2 + (0.3 if first else 0.1), terminal=chosen[0] ** 2 if first else 0)
        return ocp

    legs = [leg("a", 2.0, True), leg("b", 1.0, False)]
    phases = co.Phases(legs)
    phases.jump(legs[1].states[1].symbol, 0.5 * legs[0].states[1].symbol * legs[0].duration + chosen[0])
    found = co.solve(phases, intervals=20, progress=False)
    assert found.durations == pytest.approx([0.2, 5.0], rel=1e-4)
    assert all(phase.optimality.transversality <= 1e-5 for phase in found.phases)
