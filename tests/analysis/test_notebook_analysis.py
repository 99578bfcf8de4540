"""A certificate and a worth in a notebook."""

import pytest
from notebooks import Page, letters

import covocp as co
from covocp.analysis.certificate import Certificate
from covocp.models import lqg_double_integrator


@pytest.mark.parametrize(
    "certificate",
    [
        Certificate(verdict="does not apply", reason="states x < 0 & more"),
        Certificate(
            verdict="not certified",
            reason="no",
            smallest_eigenvalue=0.1,
            tolerance=1e-3,
            stationarity=1e-4,
            consistency=1e-9,
        ),
    ],
)
def test_a_certificate_is_its_sentence(certificate):
    page = Page(certificate._repr_html_())
    assert " ".join(page.words) == " ".join(str(certificate).split())
    assert page.tags == ["div", "p"]


def test_a_worth_is_its_verdict_and_numbers():
    worth = co.worth(lqg_double_integrator.problem(), intervals=10)
    page = Page(worth._repr_html_())
    assert letters(" ".join(page.words)) == letters(str(worth))
    assert page.tables[0][0] == ["expected cost of the classical design", f"{worth.classical.cost:.8g}"]
    assert str(worth).splitlines()[0].startswith("double integrator, regulator and filter: ")
