"""Figures of closed loops: deviations, gains and covariances, and what the actual system does."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from figures import edges_of, entries_of, legend_of, main_lines, panels, values_of
from matplotlib.colors import to_hex
from problems import constrained_gain, solve
from scipy.integrate import solve_ivp

import covocp as co
from covocp.models import mars_entry, unknown_lag
from covocp.plot.curves import Drawn
from covocp.plot.figure import COLOURS, plot_solutions


@pytest.fixture(scope="module")
def lag():
    return co.solve(unknown_lag.problem(), intervals=200, progress=False)


@pytest.fixture(scope="module")
def combined():
    return co.solve(unknown_lag.steering(), intervals=200, progress=False)


@pytest.fixture(scope="module")
def classical():
    return co.solve(unknown_lag.steering(), intervals=200, nominal="deterministic", progress=False)


@pytest.fixture(scope="module")
def entry():
    """Mars at constant lift-to-drag ratio, with its problem."""
    problem = mars_entry.problem()
    return problem, co.evaluate(problem, nominal=mars_entry.reference(), intervals=200)


def test_a_closed_loop_shows_what_the_actual_system_does(combined):
    figure = combined.plot()
    assert list(panels(figure)) == ["x", "u", "b (estimate)", "rms of x"]
    loop = combined.loop
    fed_back = np.einsum("ki,kij,kj->k", loop.gain[:, 0], loop.Xhat, loop.gain[:, 0])
    for label, value, variance in (
        ("x", combined["x"], loop.E[:, 0, 0] + loop.Xhat[:, 0, 0] - 2 * loop.Z[:, 0, 0]),
        ("u", combined["u"], fed_back),
        ("b (estimate)", combined["b"], loop.E[:, 1, 1]),
    ):
        low, high = edges_of(panels(figure)[label], combined.t)
        np.testing.assert_allclose((high + low) / 2, value, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose((high - low) / 2, np.sqrt(variance), rtol=1e-9, atol=1e-12)


def test_root_mean_squares_have_their_parts(combined):
    figure = combined.plot("rms")
    assert list(panels(figure)) == ["rms of x", "rms error of b"]
    loop = combined.loop
    for curve, matrix in zip(values_of(figure, "rms of x", combined.t), (loop.X, loop.E, loop.Xhat), strict=True):
        np.testing.assert_allclose(curve, np.sqrt(matrix[:, 0, 0]), rtol=1e-9)
    assert entries_of(panels(figure)["rms of x"]) == ["deviation", "error of the estimate", "estimate"]
    (error,) = values_of(figure, "rms error of b", combined.t)
    np.testing.assert_allclose(error, np.sqrt(loop.E[:, 1, 1]), rtol=1e-9)


def coarse(control="linear"):
    """A loop on ten intervals, in the first of which the error falls by half, and its covariances by scipy."""
    p = co.Problem(4.0, name="coarse")
    y = p.state("y", initial=1.0, variance=0.5)
    w = p.control("w", lower=-1, upper=1)
    p.dynamics(y, w - y, noise=0.1)
    p.measurement("m", y, noise=0.2)
    p.minimize_expected(running=w**2 + y**2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # the mesh is as coarse as it says
        solution = co.solve(p, intervals=10, control=control, progress=False)

    grid = np.linspace(0.0, 4.0, 2001)
    gain = solution.at(grid)["S"][:, 0, 0] / 2

    def rates(t, z):
        learnt = z[0] ** 2 / 0.2
        return [-2 * z[0] + 0.1 - learnt, -2 * (1 + np.interp(t, grid, gain)) * z[1] + learnt]

    exact = solve_ivp(rates, (0, 4), [0.5, 0.0], rtol=1e-7, atol=1e-9, dense_output=True, max_step=0.1)
    return solution, exact.sol


@pytest.mark.parametrize("control", ["linear", "constant"])
def test_between_nodes_root_mean_squares_are_those_of_the_integrator(control):
    """E to the tolerance of the dense output; X and Xhat, which it does not have, to what ten nodes tell of X."""
    solution, exact = coarse(control)
    figure = solution.plot("rms", "y", "w")
    for k, (line, tolerance) in enumerate(zip(main_lines(panels(figure)["rms of y"]), (5e-3, 5e-5, 1e-2), strict=True)):
        t = line.get_xdata()
        assert t.size > 15
        error, estimate = exact(t)
        expected = np.sqrt((error + estimate, error, np.maximum(estimate, 0.0))[k])
        assert np.abs(line.get_ydata() - expected).max() < tolerance
    (deviation,) = values_of(figure, "rms of y")[:1]
    low, high = edges_of(panels(figure)["y"])
    np.testing.assert_allclose((high - low) / 2, deviation, rtol=1e-9)


def test_gains_on_request(combined):
    figure = combined.plot(gains=True)
    assert list(panels(figure))[4:] == ["C[u, x]", "C[u, b]", "K[x]", "K[b]"]
    assert list(panels(combined.plot("C", "K"))) == ["C[u, x]", "C[u, b]", "K[x]", "K[b]"]
    for i, name in enumerate(("x", "b")):
        feedback, filtering = (values_of(figure, f"{gain}{name}]", combined.t)[0] for gain in ("C[u, ", "K["))
        np.testing.assert_allclose(feedback, combined.gains["C"][:, 0, i], atol=1e-15)
        np.testing.assert_allclose(filtering, combined.gains["K"][:, i, 0], atol=1e-15)
    assert list(panels(combined.plot(("C", "b"), ("K", combined.symbols["x"])))) == ["C[u, b]", "K[x]"]


def test_gains_of_a_filter_alone(lag):
    figure = lag.plot("u", gains=True)
    assert list(panels(figure)) == ["u", "K[x]", "K[b]"]
    np.testing.assert_allclose(values_of(figure, "K[b]")[0], lag.gains["K"][:, 1, 0], atol=1e-15)
    (deviation,) = values_of(lag.plot(("rms", "b")), "rms of b")
    np.testing.assert_allclose(deviation, lag.deviation("b"), rtol=1e-12)


def test_covariances_of_a_closed_loop(combined):
    for name in ("X", "Xhat", "Z"):
        figure = combined.plot(name)
        assert list(panels(figure)) == [f"{name}[x, x]", f"{name}[x, b]", f"{name}[b, b]"]
        expected = getattr(combined.loop, name)[:, 0, 1]
        np.testing.assert_allclose(values_of(figure, f"{name}[x, b]", combined.t)[0], expected, atol=1e-15)
    (pair,) = values_of(combined.plot(("x", "b")), "X[x, b]", combined.t)
    np.testing.assert_allclose(pair, combined.loop.X[:, 0, 1], atol=1e-15)
    assert list(panels(combined.plot("E", "S")))[3:] == ["S[x, x]", "S[x, b]", "S[b, b]"]


def test_combined_and_classical_in_one_figure(combined, classical):
    figure = plot_solutions([combined, classical])
    assert legend_of(figure)[:2] == ["combined", "classical"]
    lines = main_lines(panels(figure)["rms of x"])
    assert [to_hex(line.get_color()).upper() for line in lines] == [COLOURS[0]] * 2 + [COLOURS[1]] * 2
    for line, (solution, name) in zip(
        lines, [(s, name) for s in (combined, classical) for name in ("X", "E")], strict=True
    ):
        expected = np.sqrt(getattr(solution.loop, name)[:, 0, 0])
        at_nodes = np.isin(line.get_xdata(), solution.t)
        np.testing.assert_allclose(line.get_ydata()[at_nodes], expected, rtol=1e-9)
    assert entries_of(panels(figure)["rms of x"]) == ["deviation", "error of the estimate"]


def test_other_statistics_show_the_true_errors(combined):
    true = co.evaluate(combined, truth=unknown_lag.steering(process_noise=2.0, measurement_noise=0.5))
    figure = plot_solutions([combined, true], "b", ("rms", "x"), labels=["design", "truth"])
    low, high = edges_of(panels(figure)["b (estimate)"])[2:]
    np.testing.assert_allclose((high - low) / 2, np.sqrt(true.loop.E[:, 1, 1]), rtol=1e-9)
    curves = values_of(figure, "rms of x")
    np.testing.assert_allclose(curves[2], true.deviation("x"), rtol=1e-9)


def test_a_closed_loop_beside_an_estimator(combined, lag):
    figure = plot_solutions([lag, combined], labels=["identified", "steered"])
    assert len(main_lines(panels(figure)["rms of x"])) == 3
    assert list(panels(plot_solutions([lag, combined], "C"))) == ["C[u, x]", "C[u, b]"]


def test_a_loaded_closed_loop_is_drawn_without_its_problem(combined, tmp_path):
    loaded = co.load(combined.save(tmp_path / "solution.npz"))
    assert loaded.statement is None
    found, original = panels(loaded.plot(gains=True)), panels(combined.plot(gains=True))
    assert list(found) == list(original)
    for label, axes in found.items():
        for one, two in zip(main_lines(axes), main_lines(original[label]), strict=True):
            np.testing.assert_array_equal(one.get_ydata(), two.get_ydata())


@pytest.mark.parametrize("constant", [True, False])
def test_a_constrained_gain_is_drawn_as_a_gain(constant):
    solution = solve(constrained_gain(constant), intervals=200)
    assert list(panels(solution.plot())) == ["x", "u", "rms of x"]
    (curve,) = values_of(solution.plot("C"), "C[u, x]", solution.t)
    np.testing.assert_allclose(curve, solution.gains["C"][:, 0, 0], rtol=1e-12)


def test_expressions_have_labels_and_bands(entry):
    problem, flight = entry
    load = mars_entry.load_factor(problem)
    figure = flight.plot({"load factor [g]": load, "velocity gain": ("C", "v")}, ("rms", load), ("rms", "lift_to_drag"))
    assert list(panels(figure))[:2] == ["load factor [g]", "velocity gain"]
    (factor,), (gain,) = (values_of(figure, label, flight.t) for label in ("load factor [g]", "velocity gain"))
    np.testing.assert_allclose(factor, flight[load], rtol=1e-12)
    np.testing.assert_allclose(gain, flight.gains["C"][:, 0, 2], rtol=1e-12)
    # d(load)/load = 2 dv/v + dlambda + u du/(1 + u^2), du = -C x'
    loop, u, v = flight.loop, flight["lift_to_drag"], flight["v"]
    slope = np.zeros((flight.t.size, 5))
    slope[:, 2], slope[:, 4] = 2 / v, 1.0
    by_estimate = slope - (u / (1 + u**2))[:, None] * loop.gain[:, 0]
    variance = np.einsum("ki,kij,kj->k", slope, loop.E, slope)
    variance += np.einsum("ki,kij,kj->k", by_estimate, loop.Xhat, by_estimate)
    variance -= 2 * np.einsum("ki,kij,kj->k", slope, loop.Z, by_estimate)
    low, high = edges_of(panels(figure)["load factor [g]"], flight.t)
    np.testing.assert_allclose((high - low) / 2, flight[load] * np.sqrt(variance), rtol=1e-6)
    (fed_back,) = values_of(figure, "rms of lift_to_drag", flight.t)
    expected = np.einsum("ki,kij,kj->k", loop.gain[:, 0], loop.Xhat, loop.gain[:, 0])
    np.testing.assert_allclose(fed_back, np.sqrt(expected), rtol=1e-9)


def test_another_abscissa_than_time(entry):
    problem, flight = entry
    figure = flight.plot("h", "v", over="theta")
    assert {axes.get_xlabel() for axes in panels(figure).values()} == {"theta [rad]"}
    (line,) = main_lines(panels(figure)["h [ft]"])
    at_nodes = np.isin(Drawn(flight, 0).t, flight.t)
    np.testing.assert_allclose(line.get_xdata()[at_nodes], flight["theta"], rtol=1e-12)
    np.testing.assert_allclose(line.get_ydata()[at_nodes], flight["h"], rtol=1e-12)
    (line,) = main_lines(panels(flight.plot("h", over=flight.symbols["theta"] * 2101.1))["h [ft]"])
    np.testing.assert_allclose(line.get_xdata()[at_nodes], flight["theta"] * 2101.1, rtol=1e-12)
    with pytest.raises(co.ProblemError, match="one number at each time"):
        flight.plot("h", over="E")


def test_entries_are_explained_once_and_units_stand_below_long_names(entry):
    _, flight = entry
    figure = flight.plot("rms", "K")
    assert [bool(entries_of(axes)) for axes in panels(figure).values()] == [True] + [False] * 4 + [True] + [False] * 4
    assert entries_of(panels(figure)["K[h] [ft/((ft/s^2) s)]"]) == ["accelerometers[0]", "accelerometers[1]"]
    assert "rms of log_density\n[ln(slug/ft^3)]" in panels(figure)


@pytest.mark.parametrize("name", ["C", "X", ("C", "x")])
def test_what_only_closed_loops_have_is_refused_elsewhere(lag, name):
    with pytest.raises(co.ProblemError, match=r"'[CX]' is not in this solution"):
        lag.plot(name)


@pytest.mark.parametrize("name", [("rms", "E"), ("C", "u"), ("K", ("x", "b")), ("rms", "terminal_weight")])
def test_what_has_no_spread_and_no_gain_is_refused(combined, name):
    with pytest.raises(co.ProblemError, match="There is no"):
        combined.plot(name)


def test_an_expression_of_a_loaded_solution_asks_for_the_problem(combined, tmp_path):
    loaded = co.load(combined.save(tmp_path / "solution.npz"))
    with pytest.raises(co.CovocpError, match="read from a file"):
        loaded.plot(("rms", combined.symbols["x"] ** 2))


def test_wide_legends_have_several_rows(combined, classical):
    figure = plot_solutions([combined, classical], "x", labels=["a rather long label " * 2, "another long label " * 2])
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1


def test_an_entry_of_the_covariance_of_a_loop_is_that_of_the_whole():
    solution = co.solve(unknown_lag.steering(), intervals=30, progress=False)
    whole, pair = values_of(solution.plot("X"), "X[x, b]"), values_of(solution.plot(("x", "b")), "X[x, b]")
    np.testing.assert_allclose(pair, whole, rtol=1e-14)
    nodes = np.isin(solution.plot(("x", "b")).axes[0].lines[0].get_xdata(), solution.t)
    np.testing.assert_allclose(pair[0][nodes], solution.covariance("x", "b")[:, 0, 0], rtol=1e-12)
