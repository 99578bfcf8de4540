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


def pushed(name: str, bound: float, *, initial: float | None = None, final: float | None = None) -> co.Problem:
    """A second in which u, at most some bound, moves x as far as it can."""
    problem = co.Problem(1.0, name)
    x = problem.state("x", initial=initial, final=final)
    u = problem.control("u", lower=-bound, upper=bound)
    problem.dynamics(x, u)
    problem.minimize(running=1e-3 * u**2, terminal=(x - 50.0) ** 2)
    return problem


def stretches(axes) -> list[tuple[float, float, float]]:
    """Begin, end and height of the horizontal lines that are bounds."""
    lines = [line.get_data() for line in axes.lines if line.get_color() == "#666666"]
    return sorted((float(t[0]), float(t[1]), float(y[0])) for t, y in lines if y[0] == y[1])


def test_bounds_are_drawn_along_the_phases_that_have_them() -> None:
    phases = [pushed("a", 3.0, initial=0.0), pushed("b", 0.5), pushed("c", 3.0)]
    solution = co.solve(co.Phases(phases, "three"), intervals=4, progress=False)
    (axes,) = solution.plot("u").axes
    np.testing.assert_allclose(
        stretches(axes), [(0.0, 1.0, 3.0), (1.0, 2.0, 0.5), (2.0, 3.0, 3.0)], atol=1e-4
    )  # -0.5, -3: far away
    (axes,) = solution.plot("u", over="x").axes
    np.testing.assert_allclose(stretches(axes), [(0.0, 3.0, 3.0), (3.0, 3.5, 0.5), (3.5, 6.5, 3.0)], atol=1e-4)
    (axes,) = solution["b"].plot("u").axes
    assert stretches(axes)[-1] == pytest.approx((0.0, 1.0, 0.5))


def test_bounds_of_all_solutions_compared_are_drawn() -> None:
    solutions = [co.solve(pushed(str(b), b, initial=0.0), intervals=4, progress=False) for b in (3.0, 2.5, 3.0)]
    (axes,) = plot_solutions(solutions, "u").axes
    np.testing.assert_allclose(stretches(axes), [(0.0, 1.0, 2.5), (0.0, 1.0, 3.0)], atol=1e-4)
