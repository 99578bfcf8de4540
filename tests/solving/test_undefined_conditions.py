"""Conditions that are NaN or inf along a path do not hold: said by name and time, wherever they are asked about."""

from __future__ import annotations

import re
from typing import Any

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.base.residuals import Residuals
from covocp.solving.comparison import terminal_miss
from covocp.transcription.ranking import merit
from covocp.transcription.steering import Run


def falling(duration: float = 4.0, start: float = 1.0, **root: Any) -> tuple[co.Problem, Any]:
    """dx/dt = u, with a limit of the root of x: along u = -1 from x = 1 it is undefined after 1 s."""
    ocp = co.Problem(duration, name="falling")
    x, u = ocp.state("x", initial=start), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.subject_to(ca.sqrt(x), **{"upper": 2.0, "name": "root", **root})
    ocp.minimize(running=u**2)
    return ocp, x


def first_time(message: str, name: str) -> float:
    """The time that a message names."""
    found = re.search(rf"'{name}' \(first at t = ([\d.]+) s\)", message)
    assert found is not None, message
    return float(found[1])


def test_along_a_nominal_it_is_violated_and_said() -> None:
    """x = 1 - t: the root has no value after 1 s, the logarithm none at the end."""
    ocp, x = falling()
    ocp.subject_to(ca.log(x), at="final", lower=-1.0, name="end")
    ocp.subject_to(x, lower=-4.0, name="met")
    found = co.evaluate(ocp, nominal={"u": -1.0})
    assert found.violations == {"root": np.inf, "end": np.inf}
    assert found.check_path() == {"root": np.inf}
    assert not found.converged
    assert first_time(found.message, "root") == pytest.approx(1.0, abs=4.0 / 1000)  # looked at 1000 times
    assert first_time(found.message, "end") == 4.0
    assert "root" in str(found)
    assert found.cost == pytest.approx(4.0)
    assert terminal_miss(found) == np.inf
    assert co.evaluate(ocp, nominal={"u": -0.1}).violations == {}


@pytest.mark.parametrize("limit", ["upper", "lower"])
def test_infinite_values_meet_no_limit_either(limit: str) -> None:
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.subject_to(ca.log(x), name="log", at="final", **{limit: 1.0})  # of zero: -inf
    ocp.minimize(running=u**2)
    assert co.evaluate(ocp, nominal={"u": 0.0}).violations == {"log": np.inf}


def test_at_an_instant() -> None:
    ocp, _ = falling(at=2.5)
    found = co.evaluate(ocp, nominal={"u": -1.0}, intervals=8)
    assert found.violations == {"root": np.inf}
    assert first_time(found.message, "root") == 2.5


def wavy(**between: Any) -> co.Problem:
    """x = 0 costs nothing; the root of 0.5 + cos(2 pi t) + x has no value from a third of each second to two thirds."""
    ocp = co.Problem(4.0, name="wavy")
    x, u = ocp.state("x", initial=0.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.subject_to(ca.sqrt(0.5 + ca.cos(2 * np.pi * ocp.time) + x), upper=2.0, name="wave", **between)
    ocp.minimize(running=u**2)
    return ocp


def test_between_the_nodes() -> None:
    """At whole seconds all is well; tenths of a second are looked at, so 0.4 s is the first in the gap."""
    found = co.evaluate(wavy(), nominal={"u": 0.0}, intervals=4)
    assert found.violations == {"wave": np.inf}
    assert first_time(found.message, "wave") == pytest.approx(0.4)
    with pytest.warns(co.CovocpWarning, match=r"'wave' is NaN or inf at t = 0.4 s: its limit does not hold there"):
        solution = co.solve(wavy(), intervals=4, progress=False)
    assert solution.check_path() == {"wave": np.inf}
    assert "between them 'wave' is NaN or inf, at t = 0.4 s" in " ".join(str(solution).split())


def test_in_a_phase() -> None:
    one, two = co.Problem(1.0, name="one"), co.Problem(1.0, name="two")
    for ocp in (one, two):
        x, u = ocp.state("x", initial=1.0 if ocp is one else None), ocp.control("u")
        ocp.dynamics(x, u)
        ocp.subject_to(ca.sqrt(x), upper=2.0, name="root")
        ocp.minimize(running=u**2)
    found = co.evaluate(co.Phases([one, two]), nominal=[{"u": 0.0}, {"u": -2.0}], intervals=10)
    assert found.violations == {"two: root": np.inf}
    assert [phase.converged for phase in found] == [True, False]
    assert not found.converged
    assert "the phase 'two'" in found.message
    assert first_time(found.message, "root") == pytest.approx(0.5, abs=0.011)  # looked at 100 times


def test_under_another_truth() -> None:
    """Where next to nothing is measured X is 0.01 + 0.01 t, or 0.01 + t: the root of 0.5 - X exists at T, or not."""

    def spreading(noise: float) -> co.Problem:
        ocp = co.Problem(1.0, name="spreading")
        x, u = ocp.state("x", initial=0.0, variance=0.01), ocp.control("u")
        ocp.dynamics(x, u, noise=noise)
        ocp.measurement("m", x, noise=1e6)
        X = ocp.closed_loop_covariance()
        ocp.subject_to(ca.sqrt(0.5 - X[x, x]), upper=1.0, name="room", at="final")
        ocp.minimize_expected(running=u**2, terminal_weight={x: 1.0})
        return ocp

    design = co.solve(spreading(0.01), intervals=10, progress=False)
    assert design.violations == {}
    found = co.evaluate(design, truth=spreading(1.0))
    assert found.violations == {"room": np.inf}
    assert not found.converged
    assert first_time(found.message, "room") == 1.0


def test_a_slope_that_is_infinite_is_told_as_such() -> None:
    """x = 1 - t: its root has a value at t = 1 and no slope; nothing is violated, and no error of the mesh is known."""
    ocp, _ = falling(1.0)
    with pytest.warns(co.CovocpWarning) as told:
        found = co.evaluate(ocp, nominal={"u": -1.0}, intervals=4)
    assert found.converged
    assert found.violations == {}
    (message,) = (str(entry.message) for entry in told)
    assert "the costates are NaN or inf up to t = 1 s" in message
    assert "nan" not in message.replace("NaN", "")


def test_a_residual_that_is_no_number_is_not_small() -> None:
    """Whichever it is: Python's max() keeps what comes first."""
    for name in ("slope", "complementarity", "infeasibility", "violation"):
        parts = dict.fromkeys(("slope", "complementarity", "infeasibility", "violation"), 0.0)
        assert Residuals(**parts).hold(1e-5)
        found = Residuals(**{**parts, name: np.nan})
        assert not found.hold(1e-5)
        assert found.worst == np.inf


def test_a_start_along_which_it_has_no_value_is_none() -> None:
    ocp, _ = falling()
    st, mesh = ocp.statement(), co.solve(ocp, intervals=4, progress=False).mesh
    one = np.ones(1)
    run = Run(statement=st, mesh=mesh, scale=one, units=one, start=one, duration=4.0, parameters=np.zeros(0))
    control = np.ones((mesh.control_nodes, 1))
    assert merit(run, 0.5 * control)[0] == pytest.approx(1.0)
    assert merit(run, -control) == (np.inf, np.inf)


def test_a_gradient_method_that_starts_there_names_it() -> None:
    ocp, _ = falling()
    with pytest.raises(co.SolveError) as caught:
        co.solve(ocp, "gradient", guess={"u": -1.0}, intervals=10, progress=False)
    assert caught.value.violations == {"root": np.inf}
