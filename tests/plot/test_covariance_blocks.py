"""Figures of blocks of a covariance: each entry once, and told from the others."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest
from figures import entries_of, main_lines, panels, values_of

import covocp as co
from covocp.plot.figure import COLOURS, DASHES, plot_solutions
from covocp.plot.panels import COLOURED, DASHED


@cache
def correlated():
    """Three positions with a covariance of their own, and an attitude."""
    ocp = co.Problem(1.0, "correlated")
    root = np.array([[3.0, 0, 0], [1.0, 2.0, 0], [0.5, 0.2, 1.0]])
    p = ocp.state("p", 3, initial=0.0, variance=root @ root.T)
    u = ocp.control("u", 3)
    ocp.attitude("C", initial=np.eye(3), rate=u, variance=[0.1, 0.2, 0.3])
    ocp.dynamics(p, u, noise=[0.1, 0.2, 0.3])
    ocp.estimation_covariance()
    ocp.minimize(running=ca.sumsqr(u - 1))
    return co.evaluate(ocp, nominal={"u": 1.0}, intervals=8), root @ root.T


def test_entries_of_a_symmetric_block_are_drawn_once_and_told_apart():
    solution, first = correlated()
    figure = solution.plot(("p", "p"))
    axes = panels(figure)["E[p, p]"]
    assert entries_of(axes) == ["0, 0", "0, 1", "0, 2", "1, 1", "1, 2", "2, 2"]
    for values, (i, j) in zip(values_of(figure, "E[p, p]"), zip(*np.triu_indices(3), strict=True), strict=True):
        assert values[[0, -1]] == pytest.approx([first[i, j], first[i, j] + (0.1 * (i + 1) if i == j else 0)])
    assert len({line.get_color() for line in main_lines(axes)}) == 6
    figure.canvas.draw()
    legend, own = axes.get_legend().get_window_extent(), axes.get_window_extent()
    assert legend.x0 >= own.x1  # beside the curves, which leave no room
    assert legend.x1 <= figure.bbox.width


def test_rows_of_a_block_with_more_entries_than_colours_have_panels():
    solution, _ = correlated()
    figure = solution.plot(("p", "C"))
    assert list(panels(figure)) == [f"E[p[{i}], C]" for i in range(3)]
    assert entries_of(panels(figure)["E[p[1], C]"]) == ["1, 0", "1, 1", "1, 2"]
    assert values_of(figure, "E[p[1], C]", solution.t) == pytest.approx(
        solution.covariance("p", "C")[:, 1].T, abs=1e-12
    )
    compared = plot_solutions([solution, solution], ("p", "p"), labels=["one", "other"])
    assert [len(entries_of(axes)) for axes in panels(compared).values()] == [3, 2, 0]


def test_as_many_entries_share_a_panel_as_are_told_apart():
    assert (len(COLOURS), len(DASHES)) == (COLOURED, DASHED)
