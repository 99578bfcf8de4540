"""Figures of problems with conditions at instants: a line where they hold."""

from __future__ import annotations

import numpy as np

import covocp as co


def vertical(figure: object) -> list[list[float]]:
    """Places of the vertical lines of each pair of axes."""
    found = []
    for axes in figure.axes:  # type: ignore[attr-defined]
        lines = [np.asarray(line.get_xdata(), dtype=float) for line in axes.lines]
        found.append(sorted(float(x[0]) for x in lines if x.size == 2 and x[0] == x[1]))
    return found


def stated(duration: float, first: bool = True) -> co.Problem:
    ocp = co.Problem(duration, name="one" if first else "two")
    x = ocp.state("x", initial=0.0 if first else None)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.subject_to(x, at=1.0, equals=1.0, name="gate")
    ocp.subject_to(x, at="final", equals=0.0, name="home")
    ocp.minimize(running=u**2)
    return ocp


def test_an_instant_is_a_line_over_time_and_none_over_states() -> None:
    solution = co.solve(stated(4.0), intervals=8, progress=False)
    assert vertical(solution.plot()) == [[1.0], [1.0]]
    assert vertical(solution.plot("u", over="x")) == [[]]


def test_instants_of_phases_are_lines_at_their_times_of_the_whole() -> None:
    solution = co.solve(co.Phases([stated(4.0), stated(3.0, False)]), intervals=8, progress=False)
    assert vertical(solution.plot("x")) == [[1.0, 4.0, 5.0]]
