"""Panels of data over time: their names, units and values."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from refusals import refused

import covocp as co


def test_data_are_drawn_by_name_with_their_unit():
    times = np.linspace(0.0, 3.0, 201)
    ocp = co.Problem(duration=3.0)
    wind = ocp.data("head wind", times, np.stack([np.sin(times), times], axis=1), unit="m/s")
    calm = ocp.data("calm", [0.0, 3.0], [0.5, 1.0])
    x, u = ocp.state("x", initial=0.0, unit="m"), ocp.control("u")
    ocp.dynamics(x, u + wind[0] + calm)
    ocp.minimize(running=u**2 + x**2)
    solution = co.solve(ocp, intervals=10, progress=False)
    figure = solution.plot(wind, wind[1], calm, 2 * calm, [x, calm])
    labels = [axes.get_ylabel() for axes in figure.axes[:5]]
    assert labels == ["head wind [m/s]", "head wind[1] [m/s]", "calm", "(2.*calm)", "x, calm"]
    lines = {label: axes.lines[0].get_xydata() for label, axes in zip(labels, figure.axes, strict=False)}
    for label, exact in (("head wind[1] [m/s]", lambda t: t), ("calm", lambda t: 0.5 + t / 6)):
        t, values = lines[label].T
        np.testing.assert_allclose(values, exact(t), atol=1e-6)
    plt.close(figure)


def test_data_have_values_and_panels_by_name():
    times = np.linspace(0.0, 3.0, 7)
    ocp = co.Problem(duration=3.0)
    wind = ocp.data("wind", times, np.stack([np.sin(times), times**2], axis=1), unit="m/s")
    x, u = ocp.state("x", initial=0.0, unit="m"), ocp.control("u")
    ocp.dynamics(x, u + wind[0])
    ocp.minimize(running=u**2 + x**2)
    solution = co.solve(ocp, intervals=12, progress=False)
    np.testing.assert_allclose(solution["wind"][:, 1], np.interp(solution.t, times, times**2), atol=1e-12)
    np.testing.assert_allclose(solution["wind[0]"], np.interp(solution.t, times, np.sin(times)), atol=1e-12)
    assert solution.at(1.3)["wind[1]"] == pytest.approx(np.interp(1.3, times, times**2), abs=1e-12)
    figure = solution.plot("wind[1]", ["wind[0]", "x"])
    assert figure.axes[0].get_ylabel() == "wind[1] [m/s]"
    plt.close(figure)
    refused(lambda: solution["wind[2]"], "'wind' has no entry 2")
    refused(lambda: solution.plot("gale"), "'gale' is not in this solution")


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_expressions_and_data_are_drawn_as_they_are_between_the_nodes(control):
    """A gust between two nodes was drawn as 0.002 of it, the square of a held control as slopes."""
    times = np.linspace(0.0, 10.0, 201)
    ocp = co.Problem(10.0)
    gust = ocp.data("gust", times, np.exp(-(((times - 5.25) / 0.1) ** 2)), kind="cubic")
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, u - x + gust, noise=0.01)
    ocp.measurement("m", x, noise=0.001)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2 + (x - 1) ** 2)
    solution = co.solve(ocp, intervals=20, control=control, progress=False)
    figure = solution.plot("gust", {"power": u**2}, {"twice x": 2 * x}, {"E": E[x, x]})
    exact = {
        "gust": lambda at: at["gust"],
        "power": lambda at: at["u"] ** 2,
        "twice x": lambda at: 2 * at["x"],
        "E": lambda at: at["E"][:, 0, 0],
    }
    for axes in figure.axes[:4]:
        curve = max(axes.lines, key=lambda line: line.get_linewidth())  # the others are the edges of its band
        t, values = curve.get_xydata().T
        found = [exact[axes.get_ylabel()](solution.at(t, side)) for side in ("before", "after")]
        nearest = np.min(np.abs(np.array(found) - values), axis=0)
        assert nearest.max() < 1e-9
        assert control == "linear" or axes.get_ylabel() == "E" or np.diff(t).max() < 0.06
        if axes.get_ylabel() == "gust":
            assert values.max() > 0.99
    plt.close(figure)
