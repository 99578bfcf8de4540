"""A solution in a notebook: what print shows as tables, its figure below, and nothing left behind."""

import struct
import subprocess
import sys
from dataclasses import replace

import pytest
from notebooks import Page, letters
from problems import solve

import covocp as co
from covocp.models import unknown_lag


@pytest.fixture(scope="module")
def lag():
    return co.solve(unknown_lag.problem(final=1.0), intervals=60, progress=False)


@pytest.fixture(scope="module")
def failed():
    options = {"max_iterations": 2, "allow_failure": True, "progress": False}
    return co.solve(unknown_lag.problem(final=1.0), intervals=20, **options)


def test_the_words_are_those_of_print(lag, failed):
    for solution in (lag, failed):
        assert letters(" ".join(Page(solution._repr_html_()).words)) == letters(str(solution))


def test_the_numbers_stand_in_tables(lag):
    tables = Page(lag._repr_html_()).tables
    assert tables[0] == [["cost", ""], *([name, f"{v:.8g}"] for name, v in lag.cost_terms.items()), tables[0][-1]]
    assert tables[0][-1] == ["total", f"{lag.cost:.8g}"]
    covariance = next(table for table in tables if table[0][0] == "covariance E at T")
    assert covariance[2] == ["b", f"{lag['E'][-1, 1, 0]:.6g}", f"{lag['E'][-1, 1, 1]:.6g}"]


def test_the_figure_is_a_picture_of_its_size(lag):
    (picture,) = Page(lag._repr_html_()).images
    assert picture.startswith(b"\x89PNG\r\n\x1a\n")
    assert picture.rstrip().endswith(b"IEND\xaeB`\x82")
    width, height = struct.unpack(">II", picture[16:24])
    figure = lag.plot()
    assert width / height == pytest.approx(figure.get_figwidth() / figure.get_figheight(), rel=1e-2)


def test_a_failed_solution_says_so_first_and_in_colour(lag, failed):
    page = Page(failed._repr_html_())
    assert page.words[:2] == ["NOT", "CONVERGED:"]
    assert len(page.warnings) == 1
    assert len(page.images) == 1
    assert Page(lag._repr_html_()).warnings == []


def test_names_are_escaped():
    ocp = co.Problem(1.0, name="<script>alert(1)</script> & co")
    x, u = ocp.state("x<b>", initial=0.0, final=1.0), ocp.control('u"&amp;')
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    solution = solve(ocp, intervals=4)
    for thing in (ocp, solution):
        page = Page(thing._repr_html_())
        assert set(page.tags) <= {"div", "p", "table", "thead", "tbody", "tr", "th", "td", "code", "img"}
        assert "<script>alert(1)</script>" in " ".join(page.words)
        assert any("x<b>" in row for table in page.tables for row in table)
    assert any('u"&amp;' in row for table in Page(ocp._repr_html_()).tables for row in table)


def test_tables_are_shown_where_drawing_fails(lag, monkeypatch):
    def fails(*_, **__):
        raise RuntimeError("no <fonts>")

    whole = Page(lag._repr_html_())
    monkeypatch.setattr("covocp.plot.figure.plot_solutions", fails)
    page = Page(lag._repr_html_())
    assert page.tables == whole.tables
    assert page.images == []
    assert page.warnings == ["The figure could not be drawn: no <fonts>"]


SHOW = """
import warnings
warnings.simplefilter("error")
import matplotlib, matplotlib.backends.backend_agg as agg
import matplotlib.pyplot as plt
import covocp as co
from covocp.models import brachistochrone
solution = co.solve(brachistochrone.problem(), intervals=10, progress=False)
plt.get_backend = lambda: "qtagg"  # a figure would be pyplot's
own = plt.figure()
solution._repr_html_()
assert plt.get_fignums() == [own.number], plt.get_fignums()
assert plt.gcf() is own
assert solution.plot() is plt.gcf()
"""


def test_pyplot_keeps_its_figures():
    run = subprocess.run([sys.executable, "-c", SHOW], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr


def test_a_solution_without_statement_shows_itself(lag, tmp_path):
    stored = co.load(lag.save(tmp_path / "lag.npz"))
    assert letters(" ".join(Page(stored._repr_html_()).words)) == letters(str(stored))


def test_objects_that_hold_arrays_are_one_line(lag):
    from covocp.transcription.mesh import Options

    things = [lag, lag.mesh, lag.trajectory, lag.multipliers, lag.extremal, lag.statement, lag.costates, lag.dense]
    things += [lag.at([0.0, 1.0]), Options(intervals=5), Options(grid=lag.mesh.nodes)]
    for thing in things[:-3]:
        assert len(repr(thing)) <= 120
        assert type(thing).__name__ in repr(thing)
    assert all("\n" not in repr(thing) for thing in things)
    assert repr(lag.trajectory) == "Trajectory(x=array(61, 1), u=array(61, 1), e=array(61, 3), duration=10)"
    assert repr(Options(intervals=5)) == "Options(intervals=5)"
    assert repr(Options(grid=lag.mesh.nodes)) == "Options(grid=array(61,))"
    assert repr(replace(lag.mesh, control="constant")).startswith("Mesh(nodes=array(61,), control='constant'")
