"""Figures of phases: one time, a line where phases meet, each quantity in the phases that have it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from figures import entries_of, main_lines, panels
from phased import bounce
from phased_loops import lag

import covocp as co
from covocp.plot.figure import plot_solutions
from covocp.plot.loop_panels import PARTS


@pytest.fixture(scope="module")
def solution() -> co.PhasesSolution:
    return co.solve(bounce(), intervals=10, progress=False)


def curves(axes, length: int = 2) -> list[np.ndarray]:
    """The lines of a panel that have more points than a mark."""
    return [np.array(line.get_data()) for line in axes.lines if len(line.get_xdata()) > length]


def test_time_goes_on_and_the_place_where_phases_meet_is_marked(solution: co.PhasesSolution) -> None:
    figure = solution.plot("v", "q", sigmas=())
    speed, q = figure.axes[:2]
    first, second = curves(speed)
    assert first[0, -1] == pytest.approx(solution.durations[0])
    assert second[0, 0] == pytest.approx(solution.durations[0])
    assert second[0, -1] == pytest.approx(solution.duration)
    assert second[1, 0] == pytest.approx(-0.7 * first[1, -1], rel=1e-6)
    assert len(curves(q)) == 1  # it is not there in the first phase
    for axes in (speed, q):
        marks = [line.get_xdata()[0] for line in axes.lines if len(line.get_xdata()) == 2]
        assert marks == pytest.approx([solution.durations[0]])
        assert axes.get_xlim() == pytest.approx((0.0, solution.duration))


def test_a_covariance_of_rows_that_appear_keeps_them_apart(solution: co.PhasesSolution) -> None:
    """Row 2 is r before, and q after the bounce."""
    figure = solution.plot("E", sigmas=())
    labels = [axes.get_ylabel() for axes in figure.axes]
    r = curves(figure.axes[labels.index("E[r, r]")])
    assert r[0][1, -1] == pytest.approx(solution["fall"].values["E"][-1][2, 2])
    assert r[1][1, 0] == pytest.approx(solution["rise"].values["E"][0][3, 3])
    q = [c for c in curves(figure.axes[labels.index("E[q, q]")]) if np.isfinite(c[1]).any()]
    assert len(q) == 1
    assert q[0][1, 0] == pytest.approx(0.3)


def test_a_figure_is_written(solution: co.PhasesSolution, tmp_path: Path) -> None:
    path = tmp_path / "bounce.png"
    solution.plot("x", "v", costates=True, path=path)
    assert path.stat().st_size > 1000
    solution.plot("v", over="x")
    with pytest.raises(co.ProblemError, match="no option 'gains'"):
        solution.plot(gains=True)


def test_root_mean_squares_of_phases_have_all_parts() -> None:
    """Phases follow each other: they are one loop. Compared ones lack the part that follows from the others."""
    loops = co.solve(co.Phases([lag(1.0, "A", last=False), lag(1.0, "B", first=False)]), intervals=10, progress=False)
    axes = panels(loops.plot("rms"))["rms of x"]
    assert entries_of(axes) == ["deviation", "error of the estimate", "estimate"]
    drawn = [(line.get_xdata(), line.get_ydata()) for line in main_lines(axes)]
    assert len(drawn) == 6
    for k, phase in enumerate(loops):
        loop, times = phase.loop, phase.t + loops.starts[k]
        for (t, y), matrix in zip(drawn[3 * k : 3 * k + 3], (loop.X, loop.E, loop.Xhat), strict=True):
            assert y[np.isin(t, times)] == pytest.approx(np.sqrt(matrix[:, 0, 0]), rel=1e-9)
    assert entries_of(panels(plot_solutions([loops[0], loops[0]], "rms"))["rms of x"]) == list(PARTS[:2])
