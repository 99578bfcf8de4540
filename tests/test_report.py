"""print(solution): what happened comes first, and every number is the solution's."""

from dataclasses import fields, replace

import numpy as np
import pytest

import covocp as co
from covocp.models import free_time_integrator, mass_chain, unknown_lag
from covocp.optimality import Optimality
from covocp.report import RESIDUALS, render_table, summary


@pytest.fixture(scope="module")
def lag():
    return co.solve(unknown_lag.problem(final=1.0), intervals=60, progress=False)


def numbers_after(text, beginning):
    """Numbers on the line that begins so."""
    line = next(line for line in text.splitlines() if line.startswith(beginning))
    return [float(word) for word in line[len(beginning) :].split() if word not in ("-", "semidefinite", "minimum")]


def test_first_line_says_what_happened(lag):
    first = str(lag).splitlines()[0]
    assert first == "first-order lag, unknown time constant: solved (ipopt)"


def test_terms_of_the_cost_and_their_sum(lag):
    text = str(lag)
    for name, value in {**lag.cost_terms, "total": lag.cost}.items():
        assert numbers_after(text, name) == [pytest.approx(value, rel=1e-7)]


def test_terminal_values_of_states_and_unknowns(lag):
    text = str(lag)
    expected = [lag["x"][-1], 1.0, lag.multipliers.final[0], lag.deviation("x")[-1]]
    assert numbers_after(text, "x  ") == pytest.approx(expected, rel=1e-7)
    b = lag.deviation("b")
    assert numbers_after(text, "b  ") == pytest.approx([1.0, b[0], b[-1]], rel=1e-7)


def test_terminal_covariance_is_its_lower_triangle(lag):
    text = str(lag)
    block = text[text.index("covariance E at T") :].split("\n\n")[0]
    E = lag["E"][-1]
    assert numbers_after(block, "x") == pytest.approx([E[0, 0]], rel=1e-5)
    assert numbers_after(block, "b") == pytest.approx([E[1, 0], E[1, 1]], rel=1e-5)


def test_every_residual_has_words_and_its_value(lag):
    assert {f.name for f in fields(Optimality)} == set(RESIDUALS)
    text = str(lag)
    for name, value in lag.optimality.as_dict().items():
        if value is None:
            assert RESIDUALS[name] not in text
        else:
            assert numbers_after(text, RESIDUALS[name]) == [pytest.approx(value, rel=1e-2)]


def test_a_saddle_and_an_indefinite_covariance_are_called_so(lag):
    saddle = replace(lag, stored_optimality=replace(lag.optimality, curvature=-1.0))
    assert "NOT A MINIMUM" in summary(saddle)
    assert "NOT A MINIMUM" not in summary(lag)
    e = lag.trajectory.e.copy()
    e[5] = [1.0, 2.0, 1.0]
    indefinite = replace(lag, trajectory=replace(lag.trajectory, e=e), stored_optimality=lag.optimality)
    assert "INDEFINITE" in summary(indefinite)
    assert "INDEFINITE" not in summary(lag)


def test_free_duration_has_its_condition_and_value():
    solution = co.solve(free_time_integrator.problem(), intervals=30, progress=False)
    text = str(solution)
    assert RESIDUALS["transversality"] in text
    assert f"state at T = {solution.duration:.8g} s" in text


def test_what_did_not_converge_says_so_first(lag):
    failed = replace(lag, converged=False, message="stopped early", violations={"limit": 0.125, "other": 2.0})
    lines = summary(failed).splitlines()
    assert lines[0] == "NOT CONVERGED: first-order lag, unknown time constant: stopped early (ipopt)"
    assert [line.split() for line in lines[2:5]] == [
        ["violated", "constraint", "by"],
        ["other", "2"],
        ["limit", "0.125"],
    ]


def test_a_loaded_solution_prints_what_it_knows(lag, tmp_path):
    path = lag.save(tmp_path / "solution.npz")
    assert str(co.load(path, unknown_lag.problem(final=1.0))) == str(lag)
    known = str(co.load(path))
    assert numbers_after(known, "total") == numbers_after(str(lag), "total")
    assert known == str(lag)
    x = numbers_after(known, "x  ")
    assert x == pytest.approx([lag["x"][-1], 1.0, lag.multipliers.final[0], lag.deviation("x")[-1]], rel=1e-7)
    without = replace(co.load(path), stored_optimality=None)
    assert "necessary conditions: not evaluated" in str(without)


def test_nothing_is_wider_than_a_hundred_columns(lag):
    solution = co.solve(mass_chain.problem(3), intervals=30, substeps=4, progress=False)
    long = replace(solution, name="a name " * 30, message="a message " * 30, violations={"v" * 150: 1.0})
    long = replace(long, stored_optimality=lag.optimality)
    text = summary(long)
    assert max(len(line) for line in text.splitlines()) <= 100
    assert numbers_after(text, "y[2]") == pytest.approx(
        [solution["y"][-1, 2], 1.0, solution.multipliers.final[2], solution.deviation("y")[-1, 2]], rel=1e-7
    )
    assert "diagonal" in text


def test_mesh_and_effort(lag):
    text = str(lag)
    assert "60 intervals, controls piecewise linear" in text
    assert f"{lag.stats['iterations']} iterations" in text
    seconds = lag.stats["build_seconds"] + lag.stats["solve_seconds"]
    assert f"{seconds:.3g} s" in text
    constant = co.solve(unknown_lag.problem(), intervals=30, control="constant", progress=False)
    assert "controls piecewise constant" in str(replace(constant, stored_optimality=lag.optimality))


def test_tables_keep_words_that_look_like_markup():
    assert render_table(["[bold]a", "b"], [["x[0]", "1"], ["[red]", "2"]]).splitlines() == [
        "[bold]a  b",
        "x[0]     1",
        "[red]    2",
    ]


def test_values_that_are_not_numbers_are_dashes(lag):
    text = summary(replace(lag, stored_optimality=replace(lag.optimality, control_error=np.nan)))
    line = next(line for line in text.splitlines() if line.startswith(RESIDUALS["control_error"]))
    assert line.split()[-1] == "-"
