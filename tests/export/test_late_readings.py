"""Readings at instants that come late, twice or at a wrong time: the exported controllers against a Kalman filter."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from exports import FOLDER

import covocp as co
from covocp.export import export_c

P0, Q, R, START = 1.0, 0.01, 0.1, 0.4


@cache
def _made(period: float | None) -> Any:
    ocp = co.Problem(2.0, name="inst")
    x = ocp.state("x", initial=START, variance=P0)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=Q)
    ocp.measurement("fix", x, noise=R, at=[0.0, 1.0])
    ocp.minimize_expected(running=u**2, terminal_weight={x: 1.0})
    solution = co.solve(ocp, intervals=20, progress=False)
    return export_c(solution, FOLDER / f"late_{period}", period=period)


def _law(period: float | None = None) -> Any:
    law = _made(period).reference()["step"]
    law.init()
    return law


def _gains(*given: tuple[float, bool]) -> list[float]:
    """Of a Kalman filter of an integrator, at some times with or without a reading; zero without."""
    P, last, gains = P0, 0.0, []
    for time, read in given:
        P += (time - last) * Q
        L = P / (P + R) if read else 0.0
        P, last = (1.0 - L) * P, time
        gains.append(L)
    return gains


@pytest.mark.parametrize(
    "given",
    [
        [(0.0, True), (1.0, False), (1.0, True), (1.25, False)],  # in a second call at its instant
        [(0.0, True), (1.0, False), (1.25, False), (1.3, True)],  # two calls later
        [(0.0, True), (0.7, False), (1.2, False), (1.3, True)],  # no call at the instant
        [(0.0, False), (0.35, True), (1.0, True)],  # that of time zero
        [(0.3, False), (0.65, True)],  # no call at time zero
        [(0.0, True), (0.0, True), (1.0, True)],  # another reading at the same time
    ],
)
def test_a_reading_is_weighed_by_what_is_known_without_those_that_did_not_come(given: list[tuple[float, bool]]) -> None:
    law = _law()
    for (time, read), expected in zip(given[:-1], _gains(*given), strict=False):
        law.step(0.9 if read else np.nan, time)
        assert float(law.state["filter_gain"]) == pytest.approx(expected, rel=1e-9, abs=1e-15)
    time, read = given[-1]
    law.step(0.9 if read else np.nan, time)
    late = given[0] == given[1]  # what came twice is not in the design
    assert late or float(law.state["filter_gain"]) == pytest.approx(_gains(*given)[-1], rel=1e-9, abs=1e-15)


def test_the_design_counts_where_it_is_what_is_known() -> None:
    law = _law()
    law.step(np.nan, 0.0)
    assert (law.status, law.state["overdue"]) == ("MEASUREMENT_MISSING", 1)
    law.step(np.nan, 0.5)
    assert (law.status, law.state["overdue"]) == ("OK", 1)
    law.step(0.9, 1.0)
    assert (law.status, law.state["overdue"]) == ("OK", 1)  # it knows 0.091, the design 0.050
    law.init()
    for time, reading, own in ((0.0, 0.9, 0), (0.5, np.nan, 0), (1.0, np.nan, 1), (1.0, 0.9, 0)):
        law.step(reading, time)
        assert law.state["overdue"] == own


def test_with_a_period_a_reading_counts_at_its_sample_alone_and_once() -> None:
    """As header and README say: elsewhere it is left out, and NaN is no missing row."""
    law, silent = _law(0.25), _law(0.25)
    for time, reading in ((0.0, 0.9), (0.25, 5.0), (1.0, 0.7), (1.0, 5.0), (1.25, 5.0)):
        counts = time in (0.0, 1.0) and reading < 5.0
        law.step(reading, time)
        if counts or time not in (0.0, 1.0):
            silent.step(reading if counts else np.nan, time)
        assert (law.status, silent.status) == ("OK", "OK")
        np.testing.assert_array_equal(law.estimate, silent.estimate)
    for period, said, not_said in (
        (0.25, "at the sample of their instant alone, and once", "in every call"),
        (None, "in every call in which they are finite", "sample"),
    ):
        package = _made(period)
        for name in (f"{package.name}.h", "README.md"):
            text = " ".join((package.directory / name).read_text().replace("\n *", " ").split())
            part = text[text.index("Rows of the measurement that are read at instants") :][:400]
            assert said in part
            assert not_said not in part
