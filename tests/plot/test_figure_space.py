"""Legends and titles stay inside figures, paths are drawn to scale, lists share a panel."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from figures import entries_of, legend_of, panels
from problems import solve

import covocp as co
from covocp.plot.figure import plot_solutions
from covocp.plot.legends import axis_label, entry_labels


@pytest.fixture(scope="module")
def walk():
    """A noisy walk whose positions are correlated from the start."""
    ocp = co.Problem(1.0, "walk")
    variance = [[1.0, 0.4], [0.4, 0.5]]
    p = ocp.state("p", 2, initial=0.0, final=[1.0, 2.0], variance=variance, unit="m", lower=-90.0, upper=4.0)
    v = ocp.state("v", initial=0.0, variance=1.0, unit="m/s")
    u = ocp.control("u", 2, lower=-1.5, upper=3.0)
    ocp.dynamics(p, u, noise=0.2)
    ocp.dynamics(v, -v)
    ocp.measurement("m", p, noise=1.0)
    ocp.minimize_expected(running=ca.sumsqr(u), terminal_weight={p: 1.0})
    return solve(ocp, intervals=20)


@pytest.fixture(scope="module")
def runs(walk):
    return co.simulate(walk, 64, seed=1, progress=False, limits="bounds")


def inside(figure):
    """Whether legends and title lie within the figure."""
    figure.canvas.draw()
    boxes = [legend.get_window_extent() for legend in figure.legends]
    boxes += [] if figure._suptitle is None else [figure._suptitle.get_window_extent()]
    width, height = figure.bbox.width, figure.bbox.height
    return all(b.x0 >= 0 and b.y0 >= 0 and b.x1 <= width and b.y1 <= height for b in boxes)


@pytest.mark.parametrize("title", [None, "a title that says rather more than one line of a small figure can hold " * 2])
def test_nothing_is_cut_from_a_figure_of_one_panel(walk, runs, title):
    assert inside(runs.plot("p[0]", title=title))
    assert inside(walk.plot("p[0]", title=title))
    labels = ["the first of two designs with a name that is very much longer than anything", "another"]
    figure = plot_solutions([walk, walk], "p[0]", labels=labels, title=title)
    assert inside(figure)
    assert "".join(legend_of(figure)[0].split()) == "".join(labels[0].split())


LONG = "position_of_the_vehicle_in_the_inertial_frame_of_reference"


@pytest.fixture(scope="module")
def lengthy():
    """A problem whose names are much longer than a panel."""
    ocp = co.Problem(1.0, "lengthy")
    x = ocp.state(LONG, initial=0.0, final=1.0, variance=1.0, unit="m")
    v = ocp.state("v", initial=0.0, variance=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=0.1)
    ocp.dynamics(v, u - v)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x, x])
    return solve(ocp, intervals=10)


@pytest.mark.parametrize("how", ["usual", "asked", "alone", "over", "costates"])
def test_long_names_stay_within_their_panels(lengthy, how):
    names = {
        "asked": ([LONG, "v"], (LONG, "v"), {"a label of the user's own that says much too much " * 3: LONG}, "u"),
        "alone": (LONG,),
        "over": ("v",),
    }
    options = {"over": {"over": LONG}, "costates": {"costates": True}}
    figure = lengthy.plot(*names.get(how, ()), **options.get(how, {}))
    figure.canvas.draw()
    axes = [place for place in figure.axes if place.get_visible()]
    page = figure.bbox
    for place in axes:
        own, outer = place.get_window_extent(), place.get_tightbbox()
        assert outer.x0 >= 0
        assert outer.y0 >= 0
        assert outer.x1 <= page.width
        assert outer.y1 <= page.height
        assert own.width > 0.15 * page.width  # what labels take is not taken from the curves
        assert not any(outer.overlaps(other.get_window_extent()) for other in axes if other is not place)
        if place.get_legend() is not None:
            assert place.get_legend().get_window_extent().width <= own.width
    labels = "".join(place.get_ylabel() + place.get_xlabel() for place in axes).replace("\n", "")
    assert "position_of_the_vehicle" in labels
    assert "…" in labels


def test_labels_that_fit_are_left_alone():
    assert axis_label("E[v[0], v[0]] [(m/s)²]") == "E[v[0], v[0]] [(m/s)²]"
    assert axis_label("rms of log_density [ln(slug/ft^3)]") == "rms of log_density\n[ln(slug/ft^3)]"
    assert axis_label("a name of more than one line of a panel") == "a name of more than one\nline of a panel"
    assert entry_labels([f"accelerometer[{i}]" for i in range(4)]) == ([f"accelerometer[{i}]" for i in range(4)], 2)


def test_a_path_has_equal_axes_where_units_agree(walk):
    figure = walk.plot("p[1]", "v", over="p[0]")
    place, other = panels(figure).values()
    figure.canvas.draw()
    (x0, x1), (y0, y1), box = place.get_xlim(), place.get_ylim(), place.get_window_extent()
    assert box.width / (x1 - x0) == pytest.approx(box.height / (y1 - y0))
    assert other.get_aspect() == "auto"


def test_ellipses_along_a_path_are_those_of_the_covariances(walk):
    """Points r of an ellipse of two deviations about c have (r - c)' X^-1 (r - c) = 4."""
    axes = panels(walk.plot("p[1]", over="p[0]", sigmas=(2.0,)))["p[1] [m]"]
    outlines = [line.get_xydata() for line in axes.lines if len(line.get_xdata()) == 121]
    assert len(outlines) == 9
    for points, k in ((outlines[0], 0), (outlines[-1], -1)):
        gap = points - walk["p"][k]
        distance = np.einsum("ki,ij,kj->k", gap, np.linalg.inv(walk.covariance("p")[k]), gap)
        np.testing.assert_allclose(distance, 4.0, rtol=1e-6)
    starts = [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "s"]
    targets = [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "o"]
    np.testing.assert_allclose([*starts, *targets], [[0.0, 0.0], [1.0, 2.0]], atol=1e-6)


def test_a_list_shares_a_panel(walk):
    figure = walk.plot(["p[0]", "p[1]"], ["p", "v"])
    assert list(panels(figure)) == ["p[0], p[1] [m]", "p[0], p[1], v"]
    one, two = panels(figure).values()
    assert entries_of(one) == ["p[0]", "p[1]"]
    assert entries_of(two) == ["p[0] [m]", "p[1] [m]", "v [m/s]"]
    with pytest.raises(co.ProblemError, match="nothing to show"):
        walk.plot([])


def test_a_simulation_shows_the_errors_of_the_filter_and_the_limits(walk, runs):
    figure = runs.plot("p[0]", "u[0]")
    place, control = panels(figure).values()
    green = [line.get_ydata() for line in place.lines if line.get_color() == "#009E73"]
    np.testing.assert_allclose(np.abs(green[0]), np.sqrt(runs.predicted_error[:, 0, 0]))
    np.testing.assert_allclose(np.abs(green[1]), np.sqrt(runs.error_covariance("p[0]")[:, 0, 0]))
    grey = [line.get_ydata() for line in control.lines if line.get_color() == "#666666"]
    np.testing.assert_allclose(grey, [-1.5 - runs.nominal_control[:, 0], 3.0 - runs.nominal_control[:, 0]])
    bounds = [line.get_ydata() for line in place.lines if line.get_color() == "#666666"]
    np.testing.assert_allclose(bounds, [4.0 - runs.nominal[:, 0]])  # the lower one is far away
    assert {"predicted error of the estimate", "limit"} <= set(legend_of(figure))
