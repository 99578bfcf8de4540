"""A simulation in a notebook."""

import pytest
from notebooks import Page, letters

import covocp as co
from covocp.models import lqg_double_integrator


@pytest.fixture(scope="module")
def runs():
    solution = co.solve(lqg_double_integrator.problem(), intervals=20, progress=False)
    return co.simulate(solution, runs=50, seed=1, progress=False)


def test_words_numbers_and_figure(runs):
    page = Page(runs._repr_html_())
    assert letters(" ".join(page.words)) == letters(str(runs))
    assert page.tables[0][1][:3] == ["position", *(f"{v:.4g}" for v in sampled(runs))]
    assert len(page.images) == 1


def sampled(runs):
    entry = runs.verdict.deviations[0]
    return entry.predicted, entry.sample


def test_one_line(runs):
    for thing in (runs, runs.step, runs.moments, runs.verdict):
        assert len(repr(thing)) <= 120
        assert repr(thing).startswith(type(thing).__name__)
