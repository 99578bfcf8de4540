"""Figures of simulations: the curves are the sample's numbers, the ellipses those of the covariances."""

import numpy as np
import pytest
from figures import panels
from loops import steered
from matplotlib.figure import Figure

from covocp.base.errors import ProblemError
from covocp.simulation.clouds import ERROR, PREDICTED, SAMPLE, plot_monte_carlo
from covocp.simulation.runs import simulate


@pytest.fixture(scope="module")
def sample():
    return simulate(steered(0.1), 300, 1, step=0.1, store=21, paths=5, progress=False)


def lines(axes, colour):
    return [line for line in axes.lines if line.get_color() == colour]


def test_a_panel_for_what_moves_and_a_cloud_for_every_pair(sample):
    figure = sample.plot()
    assert isinstance(figure, Figure)
    assert list(panels(figure)) == ["deviation of x", "deviation of u", "deviation of b", "deviation of b at T"]
    assert figure.get_suptitle().startswith(sample.name)


def test_bands_are_the_numbers(sample):
    axes = panels(sample.plot("x"))["deviation of x"]
    lower, upper = (line.get_ydata() for line in lines(axes, PREDICTED))
    np.testing.assert_allclose(upper, sample.predicted_deviation("x"))
    np.testing.assert_allclose(lower, -upper)
    mean, low, high = (line.get_ydata() for line in lines(axes, SAMPLE))
    np.testing.assert_allclose(mean, sample.bias("x"))
    np.testing.assert_allclose((high - low) / 2, sample.deviation("x", about="mean"))
    assert len(lines(axes, ERROR)) == 4
    assert len(axes.lines) == 5 + 5 + 4 + 1  # runs, errors of the estimate, the nominal


def test_ellipses_are_those_of_the_covariances(sample):
    """The predicted ones lie about the nominal, those of the runs about their mean, as their bands do."""
    axes = panels(sample.plot(("x", "b"), sigmas=(1.0, 2.0)))["deviation of b at T"]
    mean = sample.deviations.mean(axis=0)
    for colour, covariance, centre in (
        (PREDICTED, sample.predicted[-1], np.zeros(2)),
        (SAMPLE, np.cov(sample.deviations.T, bias=True), mean),
    ):
        for size, line in zip((1.0, 2.0), lines(axes, colour), strict=True):
            points = np.array(line.get_data()) - centre[:, None]
            distance = np.einsum("ik,ij,jk->k", points, np.linalg.inv(covariance), points)
            np.testing.assert_allclose(distance, size**2, rtol=1e-9)


def test_a_prediction_that_fails_stands_in_the_title_and_runs_outside_are_counted():
    failing = simulate(steered(5.0), 200, 1, step=0.1, store=5, progress=False)
    figure = failing.plot(("x", "b"))
    assert "FAILS for x" in figure.get_suptitle()
    (text,) = (text.get_text() for text in figure.axes[0].texts)
    assert "runs are outside" in text


def test_units_and_files(sample, tmp_path):
    figure = plot_monte_carlo(sample, "x", title="a title", units={"x": "m"}, path=tmp_path / "cloud.png")
    assert list(panels(figure)) == ["deviation of x [m]"]
    assert (tmp_path / "cloud.png").stat().st_size > 1000
    assert figure.get_suptitle().startswith("a title")


@pytest.mark.parametrize(
    ("names", "options", "word"),
    [
        (("y",), {}, "'y'"),
        ((("x",),), {}, "pairs"),
        ((("x", "u"),), {}, "scalar"),
        ((), {"sigmas": (0.0,)}, "sigmas"),
        ((), {"sigma": (1.0,)}, "perhaps 'sigmas'"),
    ],
)
def test_what_cannot_be_drawn_is_refused(sample, names, options, word):
    with pytest.raises(ProblemError, match=word):
        sample.plot(*names, **options)
