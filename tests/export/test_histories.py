"""The exported histories are those of the solution, at any time."""

from dataclasses import replace

import numpy as np
import pytest
from exports import FOLDER, lag, open_lag, package

import covocp as co
from covocp.export import export_c
from covocp.export.laws.history import history
from covocp.export.laws.trajectory import sample_law
from covocp.models import unknown_lag

pytestmark = pytest.mark.needs_cc


@pytest.mark.parametrize(("name", "control"), [("history", "linear"), ("steps", "constant")])
def test_sample_is_at_of_the_solution(name, control):
    solution = open_lag(control)
    sample = package(name).python().sample
    times = np.concatenate([solution.t, np.random.default_rng(0).uniform(0.0, solution.duration, 300)])
    expected = solution.at(times)
    for k, time in enumerate(times):
        got = sample(time)
        assert sample.status == "OK"
        for key in ("x", "u", "E"):
            np.testing.assert_allclose(got[key], expected[key][k], rtol=1e-12, atol=1e-14)


def test_sample_of_a_closed_loop_has_its_matrices_whole():
    solution, sample = lag(), package("lag").python().sample
    expected = solution.at(3.21)
    got = sample(3.21)
    np.testing.assert_allclose(got["E"], expected["E"], rtol=1e-12)
    np.testing.assert_allclose(got["S"], expected["S"], rtol=1e-12)
    np.testing.assert_array_equal(got["E"], got["E"].T)


@pytest.mark.parametrize(
    ("time", "status", "clamped"),
    [
        (-1e-3, "TIME_BEFORE", 0.0),
        (-np.inf, "TIME_NOT_FINITE", 0.0),
        (np.nan, "TIME_NOT_FINITE", 0.0),
        (np.inf, "TIME_NOT_FINITE", 0.0),
        (10.5, "TIME_AFTER", 10.0),
        (1e29, "TIME_AFTER", 10.0),
        (10.0 + 1e-9, "OK", 10.0),  # what is left of a sum of steps
        (-1e-9, "OK", 0.0),
    ],
)
def test_times_outside_the_range_have_a_status_and_the_values_of_the_end(time, status, clamped):
    sample = package("history").python().sample
    got, expected = sample(time), open_lag().at(clamped)
    assert sample.status == status
    assert got["time"] == clamped
    assert got["u"] == pytest.approx(float(expected["u"]), abs=1e-14)
    np.testing.assert_allclose(got["E"], expected["E"], rtol=1e-12)


def test_a_solution_read_from_a_file_has_the_same_histories(tmp_path):
    solution = co.load(open_lag().save(tmp_path / "lag.npz"))
    made = export_c(solution, FOLDER / "from_file", name="history")
    casadi = [(folder / "history_casadi.c").read_text() for folder in (made.directory, package("history").directory)]
    assert casadi[0] == casadi[1]


def test_a_graded_grid_finds_its_intervals():
    grid = 1 - (1 - np.linspace(0, 1, 41)) ** 2
    solution = co.solve(unknown_lag.problem(), grid=grid, progress=False)
    law = sample_law(solution, history(solution, "double"), 1e-12)
    times = np.concatenate([solution.t, np.linspace(0, 10, 101)])
    np.testing.assert_allclose(law.values(times[:, None])[:, 1], solution.at(times)["x"], rtol=0, atol=1e-13)


def test_a_covariance_stays_semidefinite_where_its_cubic_would_not():
    solution = open_lag()
    steep = solution.rates.copy()
    steep[5, 1] = -1e4  # a rate of E_xx that no covariance has
    broken = replace(solution, rates=steep)
    law = sample_law(broken, history(broken, "double"), 1e-12)
    times = np.linspace(solution.t[5], solution.t[6], 50)
    covariances = law.values(times[:, None])[:, 3:7].reshape(-1, 2, 2)
    assert np.linalg.eigvalsh(covariances).min() > 0


def test_a_solution_that_is_not_finite_is_refused():
    x = open_lag().trajectory.x.copy()
    x[3] = np.nan
    extremal = replace(open_lag().extremal, trajectory=replace(open_lag().trajectory, x=x))
    broken = replace(open_lag(), extremal=extremal)
    with pytest.raises(co.ExportError, match="NaN or infinite"):
        export_c(broken, FOLDER / "not_finite")
    assert not (FOLDER / "not_finite").exists()


def test_a_solution_that_did_not_converge_is_exported_with_a_warning():
    with pytest.warns(co.CovocpWarning, match="did not converge"):
        export_c(replace(open_lag(), converged=False), FOLDER / "unconverged")
