"""Comparisons: every run is a row, numbers are the solutions', a failure is a reason."""

import signal
import sys
import types
import warnings

import numpy as np
import pytest

import covocp as co
from covocp.base.progress import Progress
from covocp.models import noisy_integrator, unknown_lag
from covocp.solving.methods import METHODS
from covocp.solving.solver import Solver

FORMULATIONS = [
    ("ipopt", "ipopt", {"substeps": 2}),
    ("states", "ipopt", {"covariances": "states", "substeps": 2}),
    ("constant", "ipopt", {"control": "constant", "substeps": 3}),
]


@pytest.fixture(scope="module")
def formulations():
    return co.compare(unknown_lag.problem(), FORMULATIONS, intervals=20, progress=False)


def row_of(text, label):
    """Words of the row of the table."""
    return next(line.split() for line in text.splitlines() if line.split() and line.split()[0] == label)


def test_rows_are_the_runs(formulations):
    assert isinstance(formulations, co.Comparison)
    assert [row.label for row in formulations] == ["ipopt", "states", "constant"]
    assert list(formulations.solutions) == ["ipopt", "states", "constant"]
    assert formulations["states"] is formulations[1] is formulations.solutions["states"]
    assert formulations["constant"].mesh.control == "constant"
    assert not formulations["states"].mesh.eliminated
    assert formulations.converged
    assert len(formulations) == 3


def test_the_table_has_cost_gap_and_residuals(formulations):
    text = str(formulations)
    best = min(solution.cost for solution in formulations.solutions.values())
    assert formulations.best == best
    for label, solution in formulations.solutions.items():
        words = row_of(text, label)
        gap = solution.cost / best - 1
        assert float(words[1]) == pytest.approx(solution.cost, rel=1e-8)
        assert float(words[2]) == pytest.approx(gap, rel=0.06, abs=1e-14)
        assert float(words[3]) == pytest.approx(solution.optimality.stationarity, rel=0.06)
        assert float(words[4]) == pytest.approx(solution.optimality.costate_difference, rel=0.06)
        assert float(words[5]) <= 1e-6
        assert float(words[6]) == pytest.approx(solution.smallest_eigenvalue, rel=0.01)
        assert int(words[7]) == solution.stats["iterations"]
        assert float(words[8]) > 0
    assert max(len(line) for line in text.splitlines()) <= 100


def test_methods_agree():
    comparison = co.compare(unknown_lag.problem(), intervals=50, progress=False)
    assert [row.method for row in comparison] == ["ipopt", "gradient"]
    costs = [solution.cost for solution in comparison.solutions.values()]
    assert comparison.converged, str(comparison)
    assert np.ptp(costs) <= 1e-5 * costs[0]


def test_all_solutions_in_one_figure(formulations, tmp_path):
    figure = formulations.plot("u", path=tmp_path / "compare.png")
    words = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert words[:3] == ["ipopt", "states", "constant"]
    assert (tmp_path / "compare.png").stat().st_size > 10_000


def test_a_run_that_does_not_converge_is_a_row_with_its_reason():
    comparison = co.compare(
        unknown_lag.problem(),
        ["ipopt", ("short", "ipopt", {"max_iterations": 3})],
        intervals=30,
        substeps=2,
        progress=False,
    )
    assert comparison["short"].converged is False
    assert not comparison.converged
    assert comparison.best == comparison["ipopt"].cost
    text = str(comparison)
    assert row_of(text, "short")[2] == "-"
    assert "short: did not converge: stopped at the largest number of iterations" in " ".join(text.split())


@pytest.fixture
def broken(monkeypatch):
    """A method that raises what it is told to."""

    def make(error):
        def prepare(statement, options, parameters, *, strength=1.0):
            raise error

        monkeypatch.setitem(sys.modules, "broken_method", types.SimpleNamespace(prepare=prepare))
        monkeypatch.setitem(METHODS, "broken", "broken_method")

    return make


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (co.ProblemError("not for this problem"), "not for this problem"),
        (RuntimeError("out of range"), "RuntimeError: out of range"),
        (ZeroDivisionError("x"), "ZeroDivisionError: x"),
    ],
)
def test_a_method_that_fails_is_a_row_with_its_reason(broken, error, reason):
    broken(error)
    comparison = co.compare(noisy_integrator.problem(), ["broken", "ipopt"], intervals=10, progress=False)
    assert comparison.rows[0].reason == reason
    assert comparison.rows[0].solution is None
    assert comparison["ipopt"].converged
    assert f"broken: {reason}" in str(comparison)
    assert list(comparison.solutions) == ["ipopt"]
    with pytest.raises(co.ProblemError, match=r"no solution 'broken'"):
        comparison["broken"]


def test_a_comparison_in_which_everything_fails_prints(broken):
    broken(RuntimeError("out of range"))
    comparison = co.compare(noisy_integrator.problem(), ["broken"], progress=False)
    assert np.isnan(comparison.best)
    assert row_of(str(comparison), "broken")[1:8] == ["-"] * 7
    with pytest.raises(co.ProblemError, match="nothing to draw"):
        comparison.plot()


def test_options_reach_the_methods_that_they_are_for(broken):
    broken(RuntimeError("reached"))
    comparison = co.compare(
        noisy_integrator.problem(),
        ["ipopt", "broken"],
        intervals=10,
        control="constant",
        progress=False,
        method_options={"ipopt": {"hessian": "exact"}, "broken": {"strength": 2.0}},
    )
    assert comparison["ipopt"].stats["hessian"] == "exact"
    assert comparison["ipopt"].mesh.control == "constant"
    assert comparison.rows[1].reason == "RuntimeError: reached"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"methods": ["ipopt", "simplex"]}, "no such method"),
        ({"methods": ["ipopt", "ipopt"]}, "same label"),
        ({"methods": []}, "nothing to compare"),
        ({"methods": [("a", "ipopt")]}, "not understood"),
        ({"methods": [3]}, "not understood"),
        ({"methods": ["ipopt"], "colour": 3}, "has no option 'colour'"),
        ({"methods": ["ipopt"], "method_options": {"gradient": {}}}, "not compared"),
        ({"methods": ["ipopt"], "method_options": {"ipopt": {"colour": 3}}}, "has no option 'colour'"),
    ],
)
def test_wrong_requests_are_refused_before_anything_runs(arguments, words, monkeypatch):
    monkeypatch.setattr(Solver, "solve", lambda *a, **k: pytest.fail("it ran"))
    with pytest.raises(co.ProblemError, match=words):
        co.compare(noisy_integrator.problem(), progress=False, **arguments)


def test_an_interrupt_ends_the_comparison(monkeypatch):
    def update(self, iteration, *rest):
        if iteration == 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Progress, "update", update)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        comparison = co.compare(
            unknown_lag.problem(), ["ipopt", ("again", "ipopt", {})], intervals=30, substeps=2, progress=False
        )
    assert not comparison["ipopt"].converged
    assert comparison.rows[1].reason == "not run: interrupted"
