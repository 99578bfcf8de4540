"""What flies in phases: limits of the control, laws, and systems other than the design's."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import covocp as co

QUIET: dict[str, Any] = {"progress": False}
PERIOD = 0.125
ASKED: dict[str, Any] = {"runs": 128, "seed": 3, "step": 0.0625, **QUIET}


def oscillator(
    duration: float, name: str, *, first: bool = True, last: bool = True, noise: float = 0.2, spread: float = 0.3
) -> co.Problem:
    """An oscillator of a frequency that is a parameter, with an expected cost, or one part of it."""
    ocp = co.Problem(duration, name=name)
    x = ocp.state("x", initial=1.0 if first else None, variance=spread if first else None)
    v = ocp.state("v", initial=0.0 if first else None, variance=0.1 if first else None)
    b = ocp.unknown("b", mean=0.2, variance=0.05)
    k = ocp.parameter("k", 0.5)
    u = ocp.control("u", lower=-2.0, upper=2.0)
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - k * x + b, noise=noise)
    ocp.measurement("position", x, noise=0.05)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=2 * x**2 if last else 0.0)
    return ocp


def cut(**options: Any) -> co.Phases:
    parts = [oscillator(1.0, "first", last=False, **options), oscillator(1.0, "second", first=False, **options)]
    return co.Phases(parts)


@pytest.fixture(scope="module")
def whole_and_cut() -> tuple[Any, Any]:
    whole = co.solve(oscillator(2.0, "whole"), intervals=32, **QUIET)
    return whole, co.solve(cut(), intervals=16, **QUIET)


@pytest.fixture(scope="module")
def plain(whole_and_cut: tuple[Any, Any]) -> Any:
    return co.simulate(whole_and_cut[0], **ASKED)


class Spring:
    """Pushes against the mean of the measured position; knows nothing where a phase begins, at some time."""

    def __init__(self, begins: float = 0.0) -> None:
        """Keep the time."""
        self.begins, self.steps = begins, 0

    def init(self) -> None:
        self.steps = 0

    def step(self, measurement: Any, time: float) -> Any:
        begins = time == 0.0 or abs(time - self.begins) < 1e-9
        self.steps = 0 if begins else self.steps + 1
        return 0.1 * self.steps - (0.0 if begins else 0.9 * measurement)


OPTIONS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "bounds": ({"limits": "bounds"}, {"limits": "bounds"}),
    "limits": ({"limits": {"u": (-0.8, 0.6)}}, {"limits": {"u": (-0.8, 0.6)}}),
    "parameter": ({"truth": {"k": 0.8}}, {"truth": {"k": 0.8}}),
    "unknown": ({"truth": {"b": 0.6}}, {"truth": {"b": 0.6}}),
    "constant": ({"truth": {"b": 0.2}}, {"truth": {"b": 0.2}}),
    "extended": ({"truth": {"k": 0.8}, "filter": "extended"}, {"truth": {"k": 0.8}, "filter": "extended"}),
    "noise": (
        {"truth": oscillator(2.0, "true", noise=0.4, spread=0.1), "limits": "bounds"},
        {"truth": cut(noise=0.4, spread=0.1), "limits": "bounds"},
    ),
    "law": (
        {"law": Spring(1.0), "period": PERIOD, "limits": "bounds"},
        {"law": {"first": Spring(), "second": Spring()}, "period": PERIOD, "limits": "bounds"},
    ),
}


@pytest.mark.parametrize("case", OPTIONS)
def test_a_cut_changes_no_run(whole_and_cut: tuple[Any, Any], plain: Any, case: str) -> None:
    (one, two), (of_one, of_two) = whole_and_cut, OPTIONS[case]
    expected, got = co.simulate(one, **ASKED, **of_one), co.simulate(two, **ASKED, **of_two)
    assert np.abs(expected.deviations - plain.deviations).max() > 0.02  # the option does something
    # To what the two optima differ by.
    np.testing.assert_allclose(got["second"].deviations, expected.deviations, rtol=1e-3, atol=1e-3)
    if case != "law":
        np.testing.assert_allclose(got["second"].estimates, expected.estimates, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(got["first"].costs + got["second"].costs, expected.costs, rtol=2e-3, atol=2e-3)
    np.testing.assert_array_equal(got["first"].asked | got["second"].asked, expected.asked)
    for name in ("predicted", "predicted_error", "predicted_mean", "predicted_control"):
        np.testing.assert_allclose(getattr(got["second"], name)[-1], getattr(expected, name)[-1], atol=1e-4)
    np.testing.assert_allclose(sum(p.predicted_cost for p in got), expected.predicted_cost, rtol=1e-5)
    # What is no more uncertain, or moves otherwise, `evaluate` does not know.
    assert np.isnan(expected.predicted_cost) == ("truth" in of_one and case != "noise")
    assert all(bool(phase.truth) == bool(expected.truth) for phase in got)


def jumping(factor: float = -0.8, noise: float = 0.1, density: float = 0.2) -> co.Phases:
    """Both parts, with a speed that turns where they meet."""
    parts = [oscillator(1.0, "first", last=False, noise=density), oscillator(1.0, "second", first=False, noise=density)]
    (x, v), (_, w) = ([state.symbol for state in part.states] for part in parts)
    phases = co.Phases(parts)
    phases.jump(w, factor * v + 0.1 * x, noise=noise)
    return phases


def test_a_jump_under_another_truth_scatters_as_evaluated() -> None:
    solution = co.solve(jumping(), intervals=16, **QUIET)
    truth = jumping(noise=0.3, density=0.1)
    evaluated = co.evaluate(solution, truth=truth)
    sample = co.simulate(solution, 2048, seed=2, step=0.0625, truth=truth, **QUIET)
    for phase, linear, design in zip(sample, evaluated, solution, strict=True):
        for k in (0, -1):
            np.testing.assert_allclose(phase.predicted[k], linear.loop.X[k], rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(phase.design[k], design.loop.X[k], rtol=1e-4, atol=1e-5)
        for entry, variance in zip(phase.verdict.deviations, np.diag(linear.loop.X[-1]), strict=False):
            assert entry.low <= np.sqrt(variance) <= entry.high, (phase.name, entry)
        assert phase.predicted_cost == pytest.approx(linear.cost, rel=1e-6)
        assert abs(phase.cost - linear.cost) < 4 * phase.cost_error
    assert not np.allclose(evaluated[1].loop.X[-1], solution[1].loop.X[-1], rtol=0.05)


F1 = np.array([[0.0, 1, 0], [0, -0.5, 1], [0, 0, 0]])
F2 = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 0], [0, 0, 0, 0]])
DENSITY = 0.1


def thrown(factor: float = -0.8, shift: float = 0.0, mean: float = 0.5, appearing: float = 0.0) -> co.Phases:
    """A body along an open-loop control that turns; a wind that is not known appears with the second phase."""
    one, two = co.Problem(1.0, name="one"), co.Problem(1.5, name="two")
    x, v = one.state("x", initial=0.0, variance=0.3), one.state("v", initial=1.0, variance=0.2)
    b, u = one.unknown("b", mean=mean, variance=0.1), one.control("u")
    one.dynamics(x, v)
    one.dynamics(v, -0.5 * v + u + b, noise=DENSITY)
    one.measurement("position", x, noise=0.05)
    y, w = two.state("x", initial=None), two.state("v", initial=None)
    c, q, a = (
        two.unknown("b", mean=mean, variance=0.1),
        two.unknown("q", mean=appearing, variance=0.4),
        two.control("u"),
    )
    two.dynamics(y, w)
    two.dynamics(w, a + c + 0.5 * q, noise=DENSITY)
    two.measurement("speed", w, noise=0.1)
    for ocp in (one, two):
        ocp.estimation_covariance()
        ocp.minimize(running=ocp.controls[0].symbol ** 2)
    phases = co.Phases([one, two])
    phases.jump(w, factor * v + 0.5 * b + shift, noise=0.15)
    return phases


def moved(P: Any, F: Any, T: float) -> Any:
    """Covariance of the actual system after a time."""
    Q = np.zeros_like(F)
    Q[1, 1] = DENSITY

    def rate(_: float, p: Any) -> Any:
        half = F @ p.reshape(F.shape)
        return (half + half.T + Q).ravel()

    return solve_ivp(rate, (0.0, T), P.ravel(), rtol=1e-10, atol=1e-12).y[:, -1].reshape(F.shape)


@cache
def designed() -> co.PhasesSolution:
    return co.solve(thrown(), intervals=10, **QUIET)


@pytest.mark.parametrize("given", ["phases", "values"])
def test_another_jump_and_other_means_by_hand(given: str) -> None:
    design = designed()
    factor, shift = (-0.5, 0.3) if given == "phases" else (-0.8, 0.0)
    truth = thrown(factor, shift, mean=0.8, appearing=-0.4) if given == "phases" else {"b": 0.8, "q": -0.4}
    sample = co.simulate(design, 2048, seed=3, step=0.05, truth=truth, **QUIET)
    known = np.diag([0.3, 0.2, 0.1 if given == "phases" else 0.0])
    J = np.array([[1.0, 0, 0], [0, factor, 0.5], [0, 0, 1], [0, 0, 0]])
    before = expm(F1) @ [0.0, 0.0, 0.3]
    v = design["one"]["v"][-1]  # of the nominal, whose jump is -0.8 v + 0.5 b
    mean = expm(1.5 * F2) @ (J @ before + [0.0, (factor + 0.8) * v + shift, 0.0, -0.4])
    P = J @ moved(known, F1, 1.0) @ J.T + np.diag([0.0, 0.15, 0.0, 0.4 if given == "phases" else 0.0])
    P = moved(P, F2, 1.5)
    last = sample["two"]
    np.testing.assert_allclose(last.predicted_mean[-1], mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(last.predicted[-1], P + np.outer(mean, mean), rtol=1e-4, atol=1e-6)
    got = last.deviations - mean
    sigma = np.sqrt(np.diag(P) / last.runs)
    assert (np.abs(got.mean(axis=0)) <= 4.0 * sigma + 1e-12).all()
    scatter = np.sqrt((np.outer(np.diag(P), np.diag(P)) + P**2) / last.runs)
    assert (np.abs(got.T @ got / last.runs - P) <= 4.0 * scatter + 1e-12).all()


def test_laws_that_fail_and_what_is_refused(whole_and_cut: tuple[Any, Any]) -> None:
    _, cut = whole_and_cut

    class Failing(Spring):
        def step(self, measurement: Any, time: float) -> Any:
            if time > 0.4:
                raise ValueError("no answer")
            return 0.0

    asked: dict[str, Any] = {"runs": 64, "seed": 1, "step": 0.1, **QUIET}
    with pytest.raises(co.SolveError, match="in the phase 'second' the law failed in run 0"):
        co.simulate(cut, **asked, law=[Spring(), Failing()], period=0.25)
    with_laws = co.simulate(cut, **asked, law=[Spring(), Spring()], period=0.25)
    assert "a law in each phase" in str(with_laws)
    cases: list[tuple[dict[str, Any], str]] = [
        ({"law": Spring(), "period": 0.25}, "a list of 2 laws"),
        ({"law": [Spring()], "period": 0.25}, "a list of 2 laws"),
        ({"law": {"first": Spring()}, "period": 0.25}, "a list of 2 laws"),
        ({"law": {"third": Spring()}, "period": 0.25}, "'third'"),
        ({"law": [Spring(), object()], "period": 0.25}, "In the phase 'second'"),
        ({"law": [Spring(), Spring()]}, "In the phase 'first'"),
        ({"law": [Spring(), Spring()], "period": 0.25, "filter": "extended"}, "no filter="),
        ({"period": 0.25}, "law="),
        ({"limits": {"w": (0.0, 1.0)}}, "'w'"),
        ({"limits": {"u": 1.0}}, "no pair"),
        ({"limits": 3.0}, "unknown kind"),
        ({"truth": {"c": 1.0}}, "'c'"),
        ({"truth": oscillator(2.0, "whole")}, "unknown kind"),
        ({"truth": cut}, "unknown kind"),
        ({"truth": thrown()}, "In the phase 'second': The truth has other measurements"),
    ]
    for options, words in cases:
        with pytest.raises(co.ProblemError, match=words):
            co.simulate(cut, **asked, **options)
