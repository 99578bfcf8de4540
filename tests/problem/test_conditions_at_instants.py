"""Conditions at instants as they are stated: what is refused by name, where instants are one, how they are written."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import covocp as co
from covocp.transcription.instants import completed


def stated(duration: Any = 10.0) -> tuple[co.Problem, Any, Any]:
    """A lag with a sensor that is read at instants, and its state and control."""
    ocp = co.Problem(duration, name="lag")
    x = ocp.state("x", initial=0.0, variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, u - x, noise=0.1)
    share = {"at": [0.1, 1 / 3], "relative": True}
    ocp.measurement("fix", x, noise=0.1, **share)
    ocp.minimize(running=u**2)
    return ocp, x, u


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"at": 0.0}, "'initial' and 'final'"),
    ({"at": 10.0}, "'initial' and 'final'"),
    ({"at": -1.0}, r"an instant in \(0, 10\) s"),
    ({"at": 11.0}, r"an instant in \(0, 10\) s"),
    ({"at": 1.0, "relative": True}, r"a share of T in \(0, 1\)"),
    ({"at": [2.0, 4.0]}, "one subject_to for each"),
    ({"at": 4.0, "side": "left"}, "side='before' or 'after'"),
    ({"at": "final", "side": "before"}, "a number at= beside"),
    ({"side": "after"}, "a number at= beside"),
    ({"relative": True}, "a number at= beside"),
    ({"at": "path", "relative": True}, "a number at= beside"),
    ({"at": 4.0, "between": "auto"}, "wrong between="),
    ({"at": 4.0, "equals": 1.0, "upper": 2.0}, "equals= beside a limit"),
    ({"at": "final", "equals": 1.0, "lower": 2.0}, "equals= beside a limit"),
    ({"at": 4.0, "equals": np.inf}, "equals"),
    ({"at": 4.0, "equals": [1.0, 2.0]}, "equals"),
    ({"at": 4.0, "equals": "high"}, "equals"),
    ({"at": 4.0, "lower": 2.0, "upper": 1.0}, "cross"),
    ({"at": 4.0, "lower": -np.inf}, "no bound"),
]


@pytest.mark.parametrize(("given", "text"), WRONG)
def test_what_is_no_condition_at_an_instant_is_refused_by_name(given: dict[str, Any], text: str) -> None:
    ocp, x, _ = stated()
    with pytest.raises(co.ProblemError, match=f"limit(.|\n)*{text}"):
        ocp.subject_to(x, name="limit", **given)


def test_seconds_of_a_free_duration_are_refused() -> None:
    ocp, x, _ = stated(co.Free(10.0))
    with pytest.raises(co.ProblemError, match=r"'limit'(.|\n)*relative=True"):
        ocp.subject_to(x, at=4.0, upper=1.0, name="limit")
    ocp.subject_to(x, at=0.4, relative=True, upper=1.0, name="limit")
    assert ocp.statement().instants == (0.1, 1 / 3, 0.4)


def test_an_integral_and_a_chance_at_an_instant_are_refused() -> None:
    ocp, x, u = stated()
    spent = ocp.integral(u**2, name="spent")
    with pytest.raises(co.ProblemError, match=r"'limit' contains the integral 'spent' elsewhere"):
        ocp.subject_to(spent, at=4.0, upper=1.0, name="limit")
    with pytest.raises(co.ProblemError, match=r"'risk' has an unknown place"):
        ocp.chance(x, upper=1.0, probability=0.9, at=4.0, name="risk")


def test_what_is_constant_holds_at_the_end() -> None:
    ocp, *_ = stated()
    d = ocp.decision("d", guess=1.0)
    ocp.subject_to(d, at=4.0, upper=1.0, name="limit")
    assert ocp.constraints[0].at == "final"


def test_equals_is_both_limits() -> None:
    for at in ("path", "initial", "final", 4.0):
        ocp, x, _ = stated()
        ocp.subject_to(x, at=at, equals=0.5, name="limit")
        assert (ocp.constraints[0].lower, ocp.constraints[0].upper) == (0.5, 0.5)


def test_instants_that_rounding_parts_are_one() -> None:
    """10/3 s, a third of T and the instant of a reading: one place, that of the reading."""
    ocp, x, u = stated()
    ocp.subject_to(x, at=10.0 / 3.0, upper=1.0, name="one")
    ocp.subject_to(x, at=0.3333333333333334, relative=True, lower=-1.0, name="two")
    ocp.subject_to(u, at=0.1 + 0.2, relative=True, upper=1.0, name="three")
    ocp.subject_to(u, at=3.0, upper=2.0, name="four", side="before")
    inside = ocp.statement().inside
    assert [(p.late, p.conditions.names) for p in inside.parts] == [
        (False, ("four",)),
        (True, ("three",)),
        (True, ("one", "two")),
    ]
    assert inside.parts[2].place == 1 / 3
    assert inside.thrice == (inside.places[0], 1 / 3)
    np.testing.assert_array_equal(inside.lower, [-np.inf, -np.inf, -np.inf, -1.0])


def test_nodes_are_there_as_often_as_they_are_needed() -> None:
    """Two before and after; three where a condition comes after a reading, or is about the control that goes on."""
    ocp, x, u = stated()
    ocp.subject_to(x, at=1.0, upper=1.0, name="after the reading")
    ocp.subject_to(x, at=1.0, upper=2.0, name="before the reading", side="before")
    ocp.subject_to(x, at=5.0, upper=1.0, name="of a state")
    ocp.subject_to(u, at=6.0, upper=1.0, name="of a control")
    ocp.subject_to(u, at=7.0, upper=1.0, name="of a control before", side="before")
    nodes = completed(ocp.statement(), np.linspace(0.0, 1.0, 4), ocp.statement().values)
    often = {float(place): int(count) for place, count in zip(*np.unique(nodes, return_counts=True), strict=True)}
    assert often == {0.0: 1, 0.1: 3, 1 / 3: 2, 0.5: 2, 0.6: 3, 2 / 3: 1, 0.7: 2, 1.0: 1}


def test_they_are_written_with_their_instants() -> None:
    ocp, x, _ = stated()
    ocp.subject_to(x, at=4.0, upper=1.0, name="one")
    ocp.subject_to(x, at=5.0, equals=1.0, name="two", side="before")
    lines = {line.split()[0]: line for line in str(ocp).splitlines() if line.strip()}
    assert "at 4 s  " in lines["one"]
    assert "at 5 s, before" in lines["two"]
    free, y, _ = stated(co.Free(3.0))
    free.subject_to(y, at=0.25, relative=True, upper=1.0, name="one")
    assert "at 0.25 T" in str(free)
