"""Figures: the curves are the solution's numbers, and nothing is left in pyplot's global state."""

import subprocess
import sys
import types
from dataclasses import replace

import numpy as np
import pytest
from figures import edges_of, entries_of, legend_of, main_lines, panels, title_of
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

import covocp as co
from covocp.models import bryson_denham, free_time_integrator, mass_chain, noisy_integrator, unknown_lag
from covocp.plot.figure import COLOURS, plot_solutions


@pytest.fixture(scope="module")
def lag():
    return co.solve(unknown_lag.problem(), intervals=200, progress=False)


@pytest.fixture(scope="module")
def weak():
    return co.solve(unknown_lag.problem(weight=1.0), intervals=200, progress=False)


@pytest.fixture(scope="module")
def constant():
    return co.solve(unknown_lag.problem(), intervals=20, control="constant", substeps=4, progress=False)


def test_a_panel_for_every_quantity(lag):
    found = panels(lag.plot())
    assert list(found) == ["x", "u", "b (estimate)", "E[x, x]", "E[x, b]", "E[b, b]"]


def test_curves_are_the_values(lag):
    found = panels(lag.plot())
    for label, expected in {
        "x": lag["x"],
        "u": lag["u"],
        "b (estimate)": lag["b"],
        "E[x, x]": lag["E"][:, 0, 0],
        "E[x, b]": lag["E"][:, 0, 1],
        "E[b, b]": lag["E"][:, 1, 1],
    }.items():
        (line,) = main_lines(found[label])
        np.testing.assert_allclose(line.get_xdata(), lag.t, rtol=1e-15)
        np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-12, atol=1e-14)


def test_coarse_meshes_are_drawn_smoothly_through_the_nodes():
    solution = co.solve(bryson_denham.problem(), intervals=12, progress=False)
    (line,) = main_lines(panels(solution.plot("x"))["x"])
    t, y = line.get_xdata(), line.get_ydata()
    assert t.size >= 200
    np.testing.assert_allclose(y[np.isin(t, solution.t)], solution["x"], atol=1e-12)
    np.testing.assert_allclose(y, solution.at(t)["x"], rtol=1e-12)


@pytest.mark.parametrize("sigmas", [(1.0,), (1, 3), ()])
def test_bands_are_standard_deviations(lag, sigmas):
    found = panels(lag.plot(sigmas=sigmas))
    for label, name in {"x": "x", "b (estimate)": "b"}.items():
        thin = edges_of(found[label])
        expected = [
            lag[name] + sign * w * lag.deviation(name) for w in sorted(sigmas, reverse=True) for sign in (-1, 1)
        ]
        assert len(thin) == len(expected)
        for one, two in zip(thin, expected, strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-14)
        assert len(found[label].collections) == len(sigmas)
    assert not found["u"].collections


def test_the_legend_says_what_the_bands_are(lag):
    assert "± 1 and 3 standard deviations" in legend_of(lag.plot(sigmas=(1, 3)))
    assert "± 1 standard deviation" in legend_of(lag.plot())
    assert not any("deviation" in text for text in legend_of(lag.plot("u")))


def test_constant_controls_are_steps(constant, lag):
    (line,) = main_lines(panels(constant.plot("u"))["u"])
    assert line.get_drawstyle() == "steps-post"
    np.testing.assert_array_equal(line.get_ydata()[:-1], np.ravel(constant.trajectory.u))
    (line,) = main_lines(panels(lag.plot("u"))["u"])
    assert line.get_drawstyle() == "default"


def test_several_solutions_share_the_panels_and_a_legend(lag, weak):
    figure = plot_solutions([lag, weak], labels=["strong", "weak"])
    for axes in panels(figure).values():
        assert [to_hex(line.get_color()).upper() for line in main_lines(axes)] == list(COLOURS[:2])
    strong, other = main_lines(panels(figure)["u"])
    np.testing.assert_allclose(strong.get_ydata(), lag["u"], atol=1e-14)
    np.testing.assert_allclose(other.get_ydata(), weak["u"], atol=1e-14)
    assert legend_of(figure)[:2] == ["strong", "weak"]
    assert title_of(figure) == lag.name


def test_labels_by_default_tell_solutions_apart(lag, weak):
    other = replace(weak, method="gradient")
    assert legend_of(plot_solutions([lag, other]))[:2] == ["ipopt", "gradient"]
    assert legend_of(plot_solutions([lag, replace(weak, name="weak")]))[:2] == [lag.name, "weak"]
    assert legend_of(plot_solutions([lag, weak]))[:2] == ["1: ipopt", "2: ipopt"]


def test_what_did_not_converge_is_in_the_title(lag, weak):
    failed = replace(weak, converged=False, message="stopped early")
    assert title_of(failed.plot()) == f"{lag.name}\nNOT CONVERGED: stopped early"
    figure = plot_solutions([lag, failed], labels=["one", "two"])
    assert title_of(figure).endswith("\ntwo: NOT CONVERGED: stopped early")
    assert legend_of(figure)[:2] == ["one", "two (not converged)"]
    assert "NOT CONVERGED" not in title_of(lag.plot())


def test_costates_on_request(lag):
    assert not any("costate" in label for label in panels(lag.plot()))
    found = panels(lag.plot(costates=True))
    (line,) = main_lines(found["costate of x"])
    np.testing.assert_array_equal(line.get_ydata(), lag.costate("x"))
    P = lag.costate("E")
    for line, (i, j) in zip(main_lines(found["costate of E"]), [(0, 0), (0, 1), (1, 1)], strict=True):
        np.testing.assert_array_equal(line.get_ydata(), P[:, i, j])
    assert entries_of(found["costate of E"]) == ["x, x", "x, b", "b, b"]


def test_chosen_quantities(lag):
    problem = lag.statement.symbols
    found = panels(lag.plot("u", problem["x"], ("x", "b"), problem["x"] ** 2))
    assert len(found) == 4
    assert list(found)[:3] == ["u", "x", "E[x, b]"]
    expression = list(found.values())[3]
    np.testing.assert_allclose(main_lines(expression)[0].get_ydata(), lag["x"] ** 2, atol=1e-14)


@pytest.mark.parametrize("name", ["y", ("x", "y"), 3])
def test_unknown_names_are_refused(lag, name):
    with pytest.raises(co.ProblemError, match="is not in this solution"):
        lag.plot(name)


def test_units_are_on_the_axes(lag):
    found = panels(lag.plot(units={"x": "m", "b": "1/s", "u": "m/s"}))
    assert list(found) == [
        "x [m]",
        "u [m/s]",
        "b (estimate) [1/s]",
        "E[x, x] [m²]",
        "E[x, b] [m (1/s)]",
        "E[b, b] [(1/s)²]",
    ]
    assert {axes.get_xlabel() for axes in found.values()} == {"", "time [s]"}
    assert list(panels(lag.plot(units={"x": "m"})))[:2] == ["x [m]", "u"]


def test_targets_and_near_bounds_are_drawn():
    solution = co.solve(noisy_integrator.problem(), intervals=20, progress=False)
    axes = panels(solution.plot())["x"]
    circles = [line for line in axes.lines if line.get_marker() == "o"]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in circles] == [(1.0, 1.0)]
    assert [tuple(line.get_ydata()) for line in axes.lines if len(line.get_xdata()) == 2] == [(0.0, 0.0)]
    assert legend_of(solution.plot()) == ["required at the end", "bound"]
    assert legend_of(solution.plot("E")) == []


def test_large_vectors_and_matrices_share_panels():
    solution = co.solve(mass_chain.problem(4), intervals=20, substeps=2, progress=False)
    figure = solution.plot()
    found = panels(figure)
    assert list(found) == [
        "y", "v", "u", "k (estimate)", "d (estimate)", "E, diagonal of y", "E, diagonal of v", "E[k, k]", "E[d, d]",
    ]  # fmt: skip
    lines = main_lines(found["E, diagonal of v"])
    for i, line in enumerate(lines):
        np.testing.assert_allclose(line.get_ydata()[-1], solution["E"][-1, 4 + i, 4 + i], rtol=1e-12)
    assert len({to_hex(line.get_color()) for line in lines}) == 4
    assert entries_of(found["y"]) == ["y[0]", "y[1]", "y[2]", "y[3]"]


def test_a_loaded_solution_is_drawn_without_its_problem(lag, tmp_path):
    stored = {"stored_optimality": lag.optimality, "stored_costates": lag.costates, "stored_dense": lag.dense}
    known = replace(lag, **stored, extremal=replace(lag.extremal, stated=None))
    loaded = co.load(known.save(tmp_path / "solution.npz"))
    found, original = panels(loaded.plot("x", "E", costates=True)), panels(lag.plot("x", "E", costates=True))
    assert list(found) == list(original)
    assert len(found) == 6
    for label, axes in found.items():
        for one, two in zip(main_lines(axes), main_lines(original[label]), strict=True):
            np.testing.assert_array_equal(one.get_ydata(), two.get_ydata())


def test_solutions_of_different_problems_and_durations():
    one = co.solve(free_time_integrator.problem(), intervals=20, progress=False)
    two = co.solve(noisy_integrator.problem(), intervals=20, progress=False)
    lines = main_lines(panels(plot_solutions([one, two]))["x"])
    assert [line.get_xdata()[-1] for line in lines] == [one.duration, two.duration]


def test_an_iterate_that_is_not_finite_is_drawn(lag):
    x = np.full_like(lag.trajectory.x, np.nan)
    extremal = replace(lag.extremal, trajectory=replace(lag.trajectory, x=x))
    broken = replace(lag, extremal=extremal, converged=False, message="NaN")
    assert title_of(broken.plot()).endswith("NOT CONVERGED: NaN")


def test_dollars_in_names_are_dollars(lag, tmp_path):
    replace(lag, name="costs $5 or $6").plot("u", path=tmp_path / "figure.png")
    assert title_of(replace(lag, name="costs $5").plot("u")) == r"costs \$5"


@pytest.mark.parametrize(
    ("solutions", "labels", "words"),
    [(0, None, "nothing to draw"), (2, ["one"], "do not fit"), (2, "ab", "do not fit")],
)
def test_wrong_numbers_of_solutions_and_labels(lag, solutions, labels, words):
    with pytest.raises(co.ProblemError, match=words):
        plot_solutions([lag] * solutions, labels=labels)


@pytest.mark.parametrize(("suffix", "start"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")])
def test_figures_are_written(lag, tmp_path, suffix, start):
    path = tmp_path / f"figure{suffix}"
    assert isinstance(lag.plot("x", path=path), Figure)
    assert path.read_bytes().startswith(start)
    assert list(tmp_path.iterdir()) == [path]


def test_a_figure_that_cannot_be_written_leaves_the_old_one(lag, tmp_path, monkeypatch):
    path = tmp_path / "figure.png"
    path.write_bytes(b"old")

    def fail(*arguments, **options):
        raise OSError("disk full")

    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(co.ExportError, match="disk full"):
        lag.plot("x", path=path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_unknown_figure_formats_are_refused(lag, tmp_path):
    with pytest.raises(co.ExportError, match="suffix names no format"):
        lag.plot("x", path=tmp_path / "figure.doc")


def test_drawing_touches_no_global_state():
    code = """
import sys, matplotlib
import covocp as co
from covocp.models import noisy_integrator
def settings():  # all but the backend, which pyplot would be asked for
    return {key: matplotlib.rcParams[key] for key in matplotlib.rcParams if key != 'backend'}
before = settings()
co.solve(noisy_integrator.problem(), intervals=5, progress=False).plot()
assert settings() == before
print('matplotlib.pyplot' in sys.modules)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert run.stdout.strip() == "False", run.stderr


def test_import_loads_no_drawing_and_no_tables():
    code = "import covocp, sys; print([m for m in ('matplotlib', 'rich', 'xarray') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert run.stdout.strip() == "[]", run.stderr


@pytest.mark.parametrize(("backend", "shown"), [("QtAgg", True), ("agg", False), ("module://matplotlib_inline", False)])
def test_pyplot_shows_the_figure_only_where_its_backend_is_interactive(lag, monkeypatch, backend, shown):
    made = []

    def figure(**options):
        made.append(Figure(**options))
        return made[-1]

    pyplot = types.SimpleNamespace(get_backend=lambda: backend, figure=figure)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", pyplot)
    result = lag.plot("x")
    assert (made == [result]) is shown


def test_an_entry_of_a_covariance_between_the_nodes():
    """As the integrator computes it there, which is what the panel of the whole matrix shows."""
    solution = co.solve(unknown_lag.problem(), intervals=12, progress=False)
    x, b = solution.symbols["x"], solution.symbols["b"]
    found = {key: solution.plot(key) for key in ((x, b), ("x[0]", "b"), ("x", "x"))}
    for (i, j), key in zip(((0, 1), (0, 1), (0, 0)), found, strict=True):
        (line,) = found[key].axes[0].lines
        t = line.get_xdata()
        assert t.size >= 200
        np.testing.assert_allclose(line.get_ydata(), solution.at(t)["E"][:, i, j], rtol=1e-12, atol=1e-14)
