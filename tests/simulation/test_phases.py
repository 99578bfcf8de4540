"""Simulated phases: a cut changes nothing, jumps do what is stated, linear systems scatter as predicted."""

from __future__ import annotations

import concurrent.futures
import pickle
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from phased import RESTITUTION, bounce, lag
from scipy.integrate import solve_ivp

import covocp as co

QUIET: dict[str, Any] = {"progress": False}


@pytest.fixture(scope="module")
def bounced() -> Any:
    return co.solve(bounce(), intervals=[20, 20], **QUIET)


def test_what_is_in_phases(bounced):
    """`in` had compared solutions with names and found none."""
    sample = co.simulate(bounced, 4, 1, progress=False)
    for whole in (bounced, sample):
        assert all(phase.name in whole for phase in whole)
        assert whole[0] in whole
        assert "third" not in whole


@pytest.mark.parametrize("filter", ["perturbation", "extended"])
@pytest.mark.parametrize("at", [None, [0.5, 1.0]])
def test_a_cut_changes_no_run(filter: Any, at: list[float] | None) -> None:
    options: dict[str, Any] = {"substeps": 2, **QUIET}
    late = None if at is None else [0.5]
    whole = lag(2.0, "whole", at=None if at is None else [*at, 1.5])
    parts = co.Phases([lag(1.0, "first", last=False, at=at), lag(1.0, "second", first=False, at=late)])
    one = co.solve(whole, intervals=20, **options)
    two = co.solve(parts, intervals=10, **options)
    asked: dict[str, Any] = {"runs": 150, "seed": 3, "step": 0.02, "filter": filter, **QUIET}
    expected, got = co.simulate(one, **asked), co.simulate(two, **asked)
    # The same random numbers in the same order: the runs themselves agree, to what the two optima differ by.
    np.testing.assert_allclose(got["second"].deviations, expected.deviations, rtol=1e-4, atol=2e-4)
    np.testing.assert_allclose(got[1].estimates, expected.estimates, rtol=1e-4, atol=2e-4)
    np.testing.assert_allclose(got[1].predicted[-1], expected.predicted[-1], atol=1e-4)
    np.testing.assert_allclose(got[1].predicted_error[-1], expected.predicted_error[-1], atol=1e-4)
    np.testing.assert_allclose(got[1].predicted_error[0], got[0].predicted_error[-1], atol=1e-12)


def fed_back(duration: float, name: str, *, first: bool = True, last: bool = True) -> co.Problem:
    """An oscillator with an expected cost."""
    ocp = co.Problem(duration, name=name)
    x = ocp.state("x", initial=1.0 if first else None, variance=0.3 if first else None)
    v = ocp.state("v", initial=0.0 if first else None, variance=0.1 if first else None)
    u = ocp.control("u")
    ocp.dynamics(x, v)
    ocp.dynamics(v, u - 0.5 * x, noise=0.2)
    ocp.measurement("position", x, noise=0.05)
    ocp.minimize_expected(running=0.5 * u**2 + x**2, terminal=2 * x**2 if last else 0.0)
    return ocp


def test_a_cut_changes_no_run_with_feedback() -> None:
    one = co.solve(fed_back(2.0, "whole"), intervals=40, **QUIET)
    parts = [fed_back(1.0, "first", last=False), fed_back(1.0, "second", first=False)]
    two = co.solve(co.Phases(parts), intervals=20, **QUIET)
    asked: dict[str, Any] = {"runs": 150, "seed": 3, "step": 0.025, **QUIET}
    expected, got = co.simulate(one, **asked), co.simulate(two, **asked)
    np.testing.assert_allclose(got["second"].deviations, expected.deviations, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(got["first"].costs + got["second"].costs, expected.costs, rtol=2e-3, atol=2e-3)
    assert "and feedback" in str(got).splitlines()[0]


def test_feedback_through_a_jump_scatters_as_predicted() -> None:
    parts = [fed_back(1.0, "first", last=False), fed_back(1.0, "second", first=False)]
    (x, v), (_, w) = ([state.symbol for state in part.states] for part in parts)
    phases = co.Phases(parts)
    phases.jump(w, -0.8 * v + 0.1 * x, noise=0.1)
    sample = co.simulate(co.solve(phases, intervals=20, **QUIET), 5000, seed=2, step=0.025, **QUIET)
    assert sample.holds
    for phase in sample:
        assert abs(phase.cost - phase.predicted_cost) < 3 * phase.cost_error


def linear_phases() -> co.Phases:
    """A body whose speed is turned and whose position is shifted by what is not known exactly; a wind appears."""
    first = co.Problem(duration=1.0, name="first")
    x = first.state("x", initial=0.0, variance=0.3)
    v = first.state("v", initial=1.0, variance=[[0.2]])
    b = first.unknown("b", mean=0.5, variance=0.1)
    u = first.control("u", lower=-1.0, upper=1.0)
    first.dynamics(x, v, noise=0.02)
    first.dynamics(v, -0.5 * v + u + b, noise=0.1)
    first.measurement("position", x, noise=0.05)
    first.estimation_covariance()
    first.minimize(running=u**2)
    second = co.Problem(duration=1.5, name="second")
    y, w = second.state("x", initial=None, final=1.0), second.state("v", initial=None)
    q = second.state("q", initial=0.2, variance=0.4)
    c = second.unknown("b", mean=0.5, variance=0.1)
    a = second.control("a")
    second.dynamics(y, w, noise=0.02)
    second.dynamics(w, a + c + q, noise=0.05)
    second.dynamics(q, -q, noise=0.1)
    second.measurement("speed", w, noise=0.1)
    second.estimation_covariance()
    second.minimize(running=a**2)
    phases = co.Phases([first, second], name="turned")
    phases.jump(w, -0.8 * v + 0.3 * x + 0.5 * b, noise=0.15)
    return phases


def covariances_by_hand() -> list[Any]:
    """Covariance of the actual system, and of the filter's error, at the end of both phases, b the last row."""
    F1 = np.array([[0.0, 1.0, 0.0], [0.0, -0.5, 1.0], [0.0, 0.0, 0.0]])
    Q1, M1, r1 = np.diag([0.02, 0.1, 0.0]), np.array([[1.0, 0.0, 0.0]]), 0.05
    F2 = np.array([[0.0, 1, 0, 0], [0, 0, 1, 1], [0, 0, -1, 0], [0, 0, 0, 0]])
    Q2, M2, r2 = np.diag([0.02, 0.05, 0.1, 0.0]), np.array([[0.0, 1.0, 0.0, 0.0]]), 0.1
    J = np.array([[1.0, 0, 0], [0.3, -0.8, 0.5], [0, 0, 0], [0, 0, 1.0]])
    N = np.diag([0.0, 0.15, 0.4, 0.0])

    def moved(P: Any, F: Any, Q: Any, M: Any, r: float, T: float) -> Any:
        def rate(_: float, p: Any) -> Any:
            P = p.reshape(F.shape)
            return (F @ P + P @ F.T + Q - P @ M.T @ M @ P / r).ravel()

        return solve_ivp(rate, (0.0, T), P.ravel(), rtol=1e-10, atol=1e-12).y[:, -1].reshape(F.shape)

    found = []
    for last in (np.inf, None):  # without a measurement: the actual system
        P = moved(np.diag([0.3, 0.2, 0.1]), F1, Q1, M1, last or r1, 1.0)
        found += [P, moved(J @ P @ J.T + N, F2, Q2, M2, last or r2, 1.5)]
    return found


@pytest.mark.parametrize("filter", ["perturbation", "extended"])
def test_a_linear_system_scatters_as_predicted(filter: Any) -> None:
    solution = co.solve(linear_phases(), intervals=[40, 60], **QUIET)
    sample = co.simulate(solution, 20_000 if filter == "perturbation" else 2_000, seed=7, filter=filter, **QUIET)
    assert sample.holds
    assert not sample.failing
    assert sample.left_share == 0.0
    by_hand = covariances_by_hand()
    for k, phase in enumerate(sample):
        actual, error = by_hand[k], by_hand[k + 2]
        np.testing.assert_allclose(phase.predicted[-1], actual, rtol=2e-5, atol=1e-6)
        np.testing.assert_allclose(phase.predicted_error[-1], error, rtol=2e-4, atol=1e-5)
        for entries, values in ((phase.verdict.deviations, actual), (phase.verdict.errors, error)):
            for entry, variance in zip(entries, np.diag(values), strict=False):
                assert entry.low <= np.sqrt(variance) <= entry.high, (phase.name, entry)
        # Correlations too: those of a normal sample scatter by (s_ii s_jj + s_ij^2)/R.
        got = phase.deviations.T @ phase.deviations / phase.runs
        sigma = np.sqrt((np.outer(np.diag(actual), np.diag(actual)) + actual**2) / phase.runs)
        assert (np.abs(got - actual) <= 4.0 * sigma).all()
    # Right after the jump.
    J = np.array([[1.0, 0, 0], [0.3, -0.8, 0.5], [0, 0, 0], [0, 0, 1.0]])
    expected = J @ by_hand[0] @ J.T + np.diag([0.0, 0.15, 0.4, 0.0])
    np.testing.assert_allclose(sample["second"].predicted[0], expected, rtol=2e-5, atol=1e-6)
    start = sample["second"].moments.product[0][:4, :4]
    assert (np.abs(start - expected) <= 0.1 * np.sqrt(np.outer(np.diag(expected), np.diag(expected)))).all()


def test_the_actual_system_jumps_by_its_expression_and_keeps_its_unknowns(bounced: Any) -> None:
    phases = bounce()
    kept = co.Phases(list(phases.problems), name="exact")
    kept.jump(_speed(phases), phases.jumps[0].expression)
    solution = co.solve(kept, intervals=[20, 20], guess=bounced, **QUIET)
    sample = co.simulate(solution, 130, seed=2, paths=130, step=0.05, **QUIET)
    fall, rise = sample["fall"], sample["rise"]
    np.testing.assert_array_equal(rise.terminal("r"), fall.terminal("r"))
    np.testing.assert_array_equal(rise.terminal("k"), fall.terminal("k"))
    before = fall.terminal("v") + fall.nominal[-1, 1]
    after = rise.paths[:, 0, 1] + rise.nominal[0, 1]
    np.testing.assert_allclose(after, -(RESTITUTION + fall.terminal("r")) * before, atol=1e-12)
    np.testing.assert_allclose(rise.paths[:, 0, 0] + rise.nominal[0, 0], fall.terminal("x") + fall.nominal[-1, 0])
    assert 0.4 < rise.paths[:, 0, 2].std() / np.sqrt(0.3) < 1.3  # the state that appears is drawn
    # The perturbation filter passes its deviation by the tangent along the nominal.
    n, m = fall.size, rise.size
    speed, r = fall.estimates[:, 1], fall.estimates[:, 2]
    tangent = -RESTITUTION * speed - fall.nominal[-1, 1] * r
    np.testing.assert_allclose(rise.paths[:, 0, m + 1], tangent, atol=1e-12)
    np.testing.assert_allclose(rise.paths[:, 0, m + 3 : 2 * m], fall.estimates[:, 2:n])
    # The extended filter puts its own estimate into the expression.
    sample = co.simulate(solution, 130, seed=2, paths=130, step=0.05, filter="extended", **QUIET)
    fall, rise = sample["fall"], sample["rise"]
    whole = -(RESTITUTION + fall.estimates[:, 2]) * (fall.nominal[-1, 1] + fall.estimates[:, 1])
    np.testing.assert_allclose(rise.paths[:, 0, m + 1] + rise.nominal[0, 1], whole, atol=1e-12)


def _speed(phases: co.Phases) -> Any:
    """The speed of the later phase."""
    return next(state.symbol for state in phases.problems[1].declarations.states if state.name == "v")


def test_runs_do_not_depend_on_batches_or_executors(bounced: Any) -> None:
    asked: dict[str, Any] = {"runs": 150, "seed": 5, "step": 0.05, **QUIET}
    here, parts = co.simulate(bounced, **asked), co.simulate(bounced, batch=64, **asked)
    with concurrent.futures.ThreadPoolExecutor(2) as executor:
        there = co.simulate(bounced, batch=64, executor=executor, **asked)
    for k in range(2):
        np.testing.assert_array_equal(here[k].deviations, parts[k].deviations)
        np.testing.assert_array_equal(here[k].estimates, there[k].estimates)
        np.testing.assert_array_equal(here[k].moments.product, there[k].moments.product)
    assert str(pickle.loads(pickle.dumps(here))) == str(here)


def test_who_left_the_domain_stays_outside(bounced: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("covocp.simulation.stretch.LEFT", 2.0)
    sample = co.simulate(bounced, 128, seed=5, step=0.05, **QUIET)
    fall, rise = sample
    gone = ~fall.stayed
    assert 0 < np.count_nonzero(gone) < np.count_nonzero(~rise.stayed) < 128
    assert (rise.left[gone] == 0.0).all()
    assert np.isinf(rise.deviations[gone]).all()
    assert (rise.moments.count <= fall.moments.count[-1]).all()
    assert rise.moments.count[0] > 0
    np.testing.assert_array_equal(sample.left[gone], fall.left[gone])
    late = fall.stayed & ~rise.stayed
    np.testing.assert_allclose(sample.left[late], sample.starts[1] + rise.left[late])
    assert "left the domain" in str(sample)
    assert not sample.holds


def test_what_is_said_and_drawn(bounced: Any, tmp_path: Path) -> None:
    sample = co.simulate(bounced, 128, seed=5, step=0.05, **QUIET)
    text = str(sample)
    assert "bounce: 128 runs through 2 phases" in text
    assert "fall: 128 runs" in text
    assert "rise: 128 runs" in text
    assert len(sample) == 2
    assert sample.runs == 128
    assert "rise" in repr(sample)
    assert sample[-1] is sample["rise"]
    with pytest.raises(co.ProblemError, match="There is no phase 'third'"):
        sample["third"]
    figure = sample.plot(path=tmp_path / "runs.png")
    axes = [a for a in figure.axes if a.get_visible()]
    assert [a.get_ylabel().split("[")[0].strip() for a in axes][:2] == ["deviation of x", "deviation of v"]
    end = float(sample.starts[1] + sample["rise"].t[-1])
    assert all(a.get_xlim() == pytest.approx((0.0, end)) for a in axes)
    marks = [line for line in axes[0].lines if np.ptp(np.asarray(line.get_xdata(), dtype=float)) == 0.0]
    assert any(line.get_xdata()[0] == pytest.approx(sample.starts[1]) for line in marks)  # type: ignore[index]
    assert (tmp_path / "runs.png").stat().st_size > 1000
    with pytest.raises(co.ProblemError, match="Clouds"):
        sample.plot(("x", "v"))
    with pytest.raises(co.ProblemError, match="speed"):
        sample.plot("speed")
    plt.close("all")


def test_files_and_what_is_refused(bounced: Any, tmp_path: Path) -> None:
    path = bounced.save(tmp_path / "bounce.npz")
    with pytest.raises(co.ProblemError, match="load\\(path, phases\\)"):
        co.simulate(co.load(path), 10, seed=1)
    asked: dict[str, Any] = {"runs": 64, "seed": 1, "step": 0.1, **QUIET}
    again = co.simulate(co.load(path, bounce()), **asked)
    np.testing.assert_array_equal(again["rise"].deviations, co.simulate(bounced, **asked)["rise"].deviations)
    first, second = co.Problem(1.0, name="first"), co.Problem(1.0, name="second")
    for ocp in (first, second):
        x = ocp.state("x", initial=0.0 if ocp is first else None, variance=1.0 if ocp is first else None)
        u = ocp.control("u")
        ocp.dynamics(x, u, noise=0.1)
        ocp.minimize(running=u**2 + x**2)
    first.estimation_covariance()
    solution = co.solve(co.Phases([first, second]), intervals=4, **QUIET)
    with pytest.raises(co.ProblemError, match="Nothing is estimated in the phase 'second'"):
        co.simulate(solution, 10, seed=1)


@cache
def steady() -> co.PhasesSolution:
    """A single state in two phases, without feedback."""
    problems: list[co.Problem] = []
    for name in ("first", "second"):
        ocp = co.Problem(1.0, name=name)
        start: dict[str, Any] = {"initial": None} if problems else {"initial": 1.0, "variance": 0.1}
        x, u = ocp.state("x", **start), ocp.control("u")
        ocp.dynamics(x, u, noise=0.1)
        ocp.measurement("m", x, noise=0.1)
        ocp.estimation_covariance()
        ocp.minimize(running=u**2)
        problems.append(ocp)
    return co.solve(co.Phases(problems), intervals=10, **QUIET)


@pytest.mark.parametrize("filter", ["perturbation", "extended"])
def test_a_single_state_without_unknowns_goes_on(filter: Any) -> None:
    sample = co.simulate(steady(), 1000, seed=1, filter=filter, **QUIET)
    # Without feedback the variance is 0.1 + 0.1 t; E starts at its steady value sqrt(0.1 * 0.1) and stays there.
    for k, phase in enumerate(sample):
        np.testing.assert_allclose(phase.predicted[-1], 0.1 + 0.1 * (k + 1), rtol=1e-6)
        np.testing.assert_allclose(phase.predicted_error[-1], 0.1, rtol=1e-6)
        assert phase.verdict.holds
