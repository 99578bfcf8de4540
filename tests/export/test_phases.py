"""Histories of phases in C: those of the solution at any time, in each phase and through all of them."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import phased
import phased_loops
import pytest
from exports import FOLDER, QUICK

import covocp as co
from covocp.export import CPackage, export_c

pytestmark = pytest.mark.needs_cc
QUIET: dict[str, Any] = {"progress": False}


@cache
def bounced() -> co.PhasesSolution:
    return co.solve(phased.bounce(), intervals=30, **QUIET)


@cache
def package(precision: Any = "double") -> CPackage:
    made = export_c(bounced(), FOLDER / f"bounce_{precision}", name="bounce", precision=precision)
    made.build(flags=QUICK)
    return made


def test_c_equals_python_everywhere() -> None:
    check = package().check(400)
    assert check.ok
    assert set(check.laws) == {"sample", "sample_fall", "sample_rise"}
    assert check.deviation < 1e-13


def test_in_single_precision_c_chooses_the_same_phase() -> None:
    check = package("single").check(400)
    assert check.ok
    assert check.deviation < 1e-3


def test_the_sample_of_all_phases_is_at_of_the_solution() -> None:
    solution, laws = bounced(), package().python()
    meeting = float(solution.starts[1])
    times = [
        0.0,
        meeting,
        np.nextafter(meeting, 0.0),
        solution.duration,
        *np.random.default_rng(0).uniform(0, 2.7, 100),
    ]
    expected = solution.at(np.array(times))
    for k, time in enumerate(times):
        got = laws.sample(time)
        phase = int(time >= meeting)
        assert (got["status"], got["phase"], got["time"]) == ("OK", phase, time)
        assert got["phase_time"] == pytest.approx(time - solution.starts[phase], abs=1e-15)
        for name in ("x", "v", "u", "q", "w"):
            np.testing.assert_allclose(got[name], expected[name][k], rtol=1e-11, atol=1e-13, err_msg=name)
        assert "E" not in got  # of four rows before, of five after
    assert laws.sample(meeting)["v"] == pytest.approx(-phased.RESTITUTION * bounced()["fall"]["v"][-1], rel=1e-6)


def test_the_sample_of_a_phase_is_at_of_that_phase() -> None:
    laws = package().python()
    for phase in bounced():
        for time in np.linspace(0.0, phase.duration, 23):
            got, expected = laws[f"sample_{phase.name}"](time), phase.at(float(time))
            for name in ("x", "v", "E"):
                np.testing.assert_allclose(got[name], expected[name], rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize(
    ("time", "status", "phase", "clamped"),
    [(-0.1, "TIME_BEFORE", 0, 0.0), (9.0, "TIME_AFTER", 1, None), (np.nan, "TIME_NOT_FINITE", 0, 0.0)],
)
def test_times_outside_have_a_status_and_the_values_of_the_end(
    time: float, status: str, phase: int, clamped: float | None
) -> None:
    got = package().python().sample(time)
    end = bounced().duration if clamped is None else clamped
    assert (got["status"], got["phase"], got["time"]) == (status, phase, end)
    assert got["v"] == pytest.approx(float(bounced().at(end)["v"]), rel=1e-12)


def test_the_header_says_when_the_phases_begin_and_what_they_are_called() -> None:
    header = (package().directory / "bounce.h").read_text()
    assert f"#define BOUNCE_RISE_START {float(bounced().starts[1])!r}" in header
    assert "int phase; /* that this time is in: 0 fall, 1 rise */" in header
    for function in ("sample(", "sample_fall(", "sample_rise("):
        assert f"int bounce_{function}" in header


def test_three_phases_matrices_of_one_size_and_names_that_are_no_words_of_c() -> None:
    """Constant controls, a vector, a phase of which the name begins with a number, names that the struct has."""
    problems = []
    for name in ("1st leg", "2nd leg", "index"):
        ocp = co.Problem(0.5 + 0.25 * len(problems), name=name)
        x = ocp.state("phase", 2, initial=None if problems else [1.0, 0.0], variance=None if problems else [0.1, 0.2])
        u = ocp.control("index")
        ocp.dynamics(x, ca.vertcat(x[1], u - x[0]), noise=[0.0, 0.1])
        ocp.measurement("position", x[0], noise=0.2)
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2 + E[x[0], x[0]])
        problems.append(ocp)
    solution = co.solve(co.Phases(problems), intervals=10, control="constant", **QUIET)
    made = export_c(solution, FOLDER / "legs")
    made.build(flags=QUICK)
    assert made.check(200).ok
    laws = made.python()
    times = np.append(solution.starts, np.linspace(0.01, solution.duration, 40))
    expected = solution.at(times)
    for k, time in enumerate(times):
        got = laws.sample(time)
        assert got["phase"] == int(np.searchsorted(solution.starts[1:], time, side="right"))
        np.testing.assert_allclose(got["phase_2"], expected["phase"][k], rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(got["index"], expected["index"][k], rtol=1e-12)
        np.testing.assert_allclose(got["E"], expected["E"][k], rtol=1e-11, atol=1e-14)


def test_a_state_that_is_called_like_a_field_of_controllers_is_a_number() -> None:
    ocp = co.Problem(1.0, name="counted")
    x, u = ocp.state("index", initial=0.3), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2 + x**2)
    made = export_c(co.solve(ocp, intervals=10, **QUIET), FOLDER / "counted")
    made.build(flags=QUICK)
    assert made.python().sample(0.0)["index"] == 0.3


def test_with_feedback_there_may_be_histories_alone() -> None:
    found = co.evaluate(phased_loops.bounce(), nominal=[{"u": 0.1}, {"w": 0.1}], intervals=20)
    laws = export_c(found, FOLDER / "flown", feedback=False).reference()
    assert set(laws) == {"sample", "sample_fall", "sample_rise"}
    np.testing.assert_allclose(laws.sample_rise(0.4)["S"], found["rise"].at(0.4)["S"], rtol=1e-11, atol=1e-13)


def test_what_means_nothing_is_refused() -> None:
    for given in ({"period": 0.1}, {"limits": "bounds"}, {"intervals": 3}):
        with pytest.raises(co.ExportError, match=r"a solution of phases|those of a controller"):
            export_c(bounced(), FOLDER / "refused", **given)
    with pytest.raises(co.ExportError, match="phases are solved by solve"):
        export_c(phased.bounce(), FOLDER / "refused")
    assert not (FOLDER / "refused").exists()
