"""Solutions of phases in files: every number comes back, and other phases are told from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from phased import bounce, steered

import covocp as co


@pytest.fixture(scope="module")
def solution() -> co.PhasesSolution:
    return co.solve(bounce(), intervals=10, progress=False)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_a_solution_of_phases_comes_back(solution: co.PhasesSolution, suffix: str, tmp_path: Path) -> None:
    path = solution.save(tmp_path / f"bounce{suffix}")
    for found in (co.load(path), co.load(path, bounce())):
        assert str(found) == str(solution)
        assert found.link_residuals == solution.link_residuals
        for own, phase in zip(solution, found, strict=True):
            np.testing.assert_array_equal(own.values["E"], phase.values["E"])
            np.testing.assert_array_equal(own.costate("v"), phase.costate("v"))
            assert own.multiplier("x") == phase.multiplier("x")
        np.testing.assert_array_equal(found.at([0.1, 2.0])["v"], solution.at([0.1, 2.0])["v"])


def test_other_phases_are_told_from_those_in_the_file(solution: co.PhasesSolution, tmp_path: Path) -> None:
    path = solution.save(tmp_path / "bounce.npz")
    with pytest.raises(co.ProblemError, match="initial value of 'E"):
        co.load(path, bounce(0.7))
    with pytest.raises(co.ProblemError, match="the solution of several phases"):
        co.load(path, bounce().problems[0])
    other = bounce()
    plain = co.Phases(other.problems, name="bounce")  # without the jump of the speed
    with pytest.raises(co.ProblemError, match="other phases: the continuity of v"):
        co.load(path, plain)
    one, two = co.Problem(1.0, name="one"), co.Problem(1.0, name="two")
    steered(one, two)
    with pytest.raises(co.ProblemError, match="of another problem"):
        co.load(path, co.Phases([one, two]))


def test_a_file_of_one_problem_is_no_file_of_phases(tmp_path: Path) -> None:
    one, two = co.Problem(1.0, name="one"), co.Problem(1.0, name="two")
    steered(one, two)
    path = co.solve(one, intervals=2, progress=False).save(tmp_path / "one.npz")
    with pytest.raises(co.ProblemError, match="holds the solution of one problem, 'one'"):
        co.load(path, co.Phases([one, two]))


def test_a_loaded_solution_is_a_start(solution: co.PhasesSolution, tmp_path: Path) -> None:
    found = co.load(solution.save(tmp_path / "bounce.npz"))
    again = co.solve(bounce(), intervals=10, guess=found, progress=False)
    assert again.cost == pytest.approx(solution.cost, rel=1e-8)
