"""A comparison in a notebook: its table, why runs failed, its figure."""

from notebooks import Page, letters

import covocp as co
from covocp.models import unknown_lag


def test_words_failures_and_figure():
    runs = ["ipopt", ("few <b>", "gradient", {"max_iterations": 2})]
    comparison = co.compare(unknown_lag.problem(final=1.0), runs, intervals=20, progress=False)
    page = Page(comparison._repr_html_())
    assert letters(" ".join(page.words)) == letters(str(comparison))
    assert [row[0] for row in page.tables[0]] == ["method", "ipopt", "few <b>"]
    assert page.tables[0][1][1] == f"{comparison['ipopt'].cost:.9g}"
    assert page.warnings[0].startswith("few <b>: did not converge")
    assert len(page.images) == 1
    assert len(repr(comparison)) <= 120


def test_a_comparison_without_solutions_has_no_figure():
    runs = [("none", "ipopt", {"plugin": "nosuchplugin"})]
    comparison = co.compare(unknown_lag.problem(), runs, intervals=5, progress=False)
    page = Page(comparison._repr_html_())
    assert page.images == []
    assert len(page.warnings) == 1
