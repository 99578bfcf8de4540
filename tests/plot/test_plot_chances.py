"""Bands of conditions on probabilities: how far from a limit the value has to be, by scipy's normal law."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.stats import norm

import covocp as co
from covocp.plot.panels import choose_panels


@pytest.fixture(scope="module")
def solution():
    """A drift of deviation sqrt(0.01 + 0.1 t) between two walls, and below one."""
    ocp = co.Problem(2.0, "drift")
    x = ocp.state("x", initial=0.0, variance=0.01)
    u = ocp.control("u")
    ocp.dynamics(x, u, noise=0.1)
    ocp.minimize(running=(u - 1.0) ** 2)
    ocp.chance(x, lower=-1.0, upper=2.5, probability=0.95, name="walls")
    ocp.chance(x, upper=2.0, probability=0.9, name="ceiling")
    ocp.chance(x, upper=2.2, probability=0.9, at="final", name="end")
    return co.solve(ocp, intervals=10, progress=False)


def test_bands_are_drawn_where_nothing_is_asked_for(solution):
    panels = {panel.label: panel for panel in choose_panels([solution], (), costates=False, units={})}
    assert {"walls", "ceiling"} <= panels.keys()
    assert "end" not in panels
    assert [bound.value for bound in panels["walls"].bounds] == [-1.0, 2.5]
    assert [bound.value for bound in panels["ceiling"].bounds] == [2.0]


def test_the_band_is_what_the_normal_law_asks_for(solution):
    y, deviation = solution["x"].ravel(), np.sqrt(0.01 + 0.1 * solution.t)
    (ceiling,) = choose_panels([solution], ("ceiling",), costates=False, units={})
    (curve,) = ceiling.curves
    np.testing.assert_allclose(curve.needed, [0 * y, norm.ppf(0.9) * deviation], atol=1e-6)
    assert (curve.y + curve.needed[1]).max() == pytest.approx(2.0, abs=1e-5)
    (walls,) = choose_panels([solution], ("walls",), costates=False, units={})
    (curve,) = walls.curves
    below, above = curve.needed
    np.testing.assert_allclose(below, above)
    drawn_in = np.minimum(2.5 - y, y + 1.0) - above
    share = norm.cdf((2.5 - drawn_in - y) / deviation) - norm.cdf((-1.0 + drawn_in - y) / deviation)
    np.testing.assert_allclose(share, 0.95, atol=1e-6)


def test_a_figure_says_what_the_band_is(solution):
    figure = solution.plot("walls")
    try:
        words = [text.get_text() for text in figure.findobj(plt.Text)]
        assert any("must be inside the limits" in word for word in words)
    finally:
        plt.close(figure)


def test_a_name_that_is_none_is_refused(solution):
    with pytest.raises(co.ProblemError, match="'wall'"):
        solution.plot("wall")
