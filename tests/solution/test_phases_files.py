"""Solutions of phases in files: every number comes back, and other phases are told from them."""

from __future__ import annotations

import copy
import pickle
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from phased import bounce, steered
from read_again import printed

import covocp as co
from covocp.base.archive import unpacked
from covocp.solution.storage import write


@pytest.fixture(scope="module")
def solution() -> co.PhasesSolution:
    return co.solve(bounce(), intervals=10, progress=False)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_a_solution_of_phases_comes_back(solution: co.PhasesSolution, suffix: str, tmp_path: Path) -> None:
    path = solution.save(tmp_path / f"bounce{suffix}")
    for found, alone in ((co.load(path), True), (co.load(path, bounce()), False)):
        assert printed(found, alone=alone) == str(solution)
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
    one, two = co.Problem(1.0, name="fall"), co.Problem(1.0, name="rise")
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


def with_parameter(k: float = 1.0) -> co.Phases:
    """Two closed loops with a jump between them, whose rates, noises, costs and initial values have a parameter."""
    problems = []
    for name in ("one", "two"):
        ocp = co.Problem(1.0, name=name)
        own = ocp.parameter("k", k)
        first = name == "one"
        x = ocp.state("x", initial=own if first else None, variance=0.02 * own if first else None)
        u = ocp.control("u")
        ocp.dynamics(x, u - own * x, noise=0.05 * own)
        ocp.measurement("y", x, noise=0.01)
        ocp.minimize_expected(running=0.5 * u**2 + own * (x - 1) ** 2, terminal=x**2)
        problems.append((ocp, x, own))
    phases = co.Phases([ocp for ocp, _, _ in problems])
    (_, before, own), (_, after, _) = problems
    phases.jump(after, 0.9 * own * before, noise=0.01 * own)
    return phases


@pytest.mark.parametrize("how", ["ipopt", "gradient", "refined", "evaluated"])
def test_phases_that_were_solved_for_other_parameters_come_back(how: str, tmp_path: Path) -> None:
    """The file knows what was declared, not only what was solved for; either may be given, nothing else."""
    phases, parameters = with_parameter(), {"k": 1.7}
    run = {"refine": 1e-4} if how == "refined" else {"intervals": 10}
    method = "gradient" if how == "gradient" else "ipopt"
    solved = co.solve(phases, parameters=parameters, method=method, progress=False, **run)
    if how == "evaluated":
        solved = co.evaluate(phases, nominal=solved, parameters=parameters, intervals=10)
    path = solved.save(tmp_path / "phases.npz")
    expected = co.evaluate(solved, truth={"k": 1.7}).cost
    for given in (phases, with_parameter(), with_parameter(1.7)):
        found = co.load(path, given)
        assert found.cost == solved.cost
        assert [phase["k"][0] for phase in found] == [1.7, 1.7]
        again = co.evaluate(found, truth={"k": 1.7})  # what passes between the phases is that of the file
        assert again.cost == pytest.approx(expected, rel=1e-12)
    with pytest.raises(co.ProblemError, match="value of 'k' differs"):
        co.load(path, with_parameter(1.3))


@pytest.mark.parametrize("name", ["costate", "gains", "to_xarray", "trajectory"])
def test_what_a_phase_has_is_asked_of_a_phase(solution: co.PhasesSolution, name: str) -> None:
    assert hasattr(solution["fall"], name)
    assert not hasattr(solution, name)
    with pytest.raises(co.ProblemError, match=r"(?s)one of the phases 'fall', 'rise'.*index a phase first") as caught:
        getattr(solution, name)
    told = pickle.loads(pickle.dumps(caught.value))
    assert (str(told), isinstance(told, AttributeError)) == (str(caught.value), True)


def test_other_attributes_and_copies_are_as_of_any_object(solution: co.PhasesSolution) -> None:
    with pytest.raises(AttributeError, match="no attribute 'colour'") as caught:
        solution.colour  # noqa: B018
    assert not isinstance(caught.value, co.ProblemError)
    assert copy.copy(solution).cost == solution.cost
    assert getattr(solution, "gains", None) is None
    with pytest.raises(AttributeError, match="index a phase first"):  # before it has any, as while it is copied
        co.PhasesSolution.__new__(co.PhasesSolution).gains  # noqa: B018


def test_names_of_phases_are_compared(tmp_path: Path) -> None:
    """By them the phases are asked for: a file of 'one' and 'two' knows no 'zwei'."""

    def named(*names: str) -> co.Phases:
        problems = []
        for name in names:
            ocp = co.Problem(1.0, name=name)
            x, u = ocp.state("x", initial=None if problems else 1.0), ocp.control("u")
            ocp.dynamics(x, u)
            ocp.minimize(running=x**2 + u**2)
            problems.append(ocp)
        return co.Phases(problems, name="both")

    path = co.solve(named("one", "two"), intervals=4, progress=False).save(tmp_path / "both.npz")
    assert co.load(path, named("one", "two"))["two"].statement is not None
    for other in (("one", "zwei"), ("two", "one")):
        with pytest.raises(co.ProblemError, match=f"(?s)other phases.*one, two.*{', '.join(other)}"):
            co.load(path, named(*other))


def thrown(
    *,
    slope: float = 0.9,
    noise: float = 0.01,
    bend: float = 0.0,
    floor: float = 1e6,
    sensor: float = 0.2,
    every: float = 0.25,
) -> co.Phases:
    """Two phases; the state jumps where it is 1, and what bends the jump there shows in none of their values."""
    one, two = co.Problem(1.0, name="one"), co.Problem(1.0, name="two")
    x = one.state("x", initial=0.0, final=1.0, variance=0.5)
    y = two.state("y", initial=None, final=0.0)
    for ocp, symbol in ((one, x), (two, y)):
        u = ocp.control("u")
        ocp.dynamics(symbol, u - symbol, noise=0.1)
        ocp.measurement("m", symbol, noise=sensor, every=every)
        E = ocp.estimation_covariance()
        ocp.minimize(running=u**2, terminal=E[symbol, symbol])
    phases = co.Phases([one, two])
    phases.jump(y, slope * x + bend * (x - 1) ** 2 + ca.fmax(0, x - floor), noise=noise)
    return phases


@pytest.fixture(scope="module")
def thrown_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)
        found = co.evaluate(thrown(), nominal=co.solve(thrown(), intervals=8, progress=False), intervals=8)
    return found.save(tmp_path_factory.mktemp("thrown") / "thrown.npz")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"bend": 0.5}, "other phases: the jump of y from 'one' to 'two' differs"),
        ({"slope": 0.9001}, "other phases: the jump of y from 'one' to 'two' differs"),
        ({"noise": 0.0101}, r"other phases: the continuity of E\[y, y\] from 'one' to 'two' differs"),
        ({"floor": 2e6}, "other phases: the place where a jump switches differs"),
        ({"sensor": 2.0}, "another problem: the noise of the measurement 'm' differs"),
        ({"every": 0.5}, r"another problem: the instants .* of the measurement 'm' differ"),
    ],
    ids=str,
)
def test_each_change_of_phases_is_seen_and_named(thrown_file: Path, change: dict[str, float], named: str) -> None:
    assert co.load(thrown_file, thrown()).links
    with pytest.raises(co.ProblemError, match=named):
        co.load(thrown_file, thrown(**change))


def test_what_is_known_of_jumps_outlives_another_file_and_may_be_missing(thrown_file: Path, tmp_path: Path) -> None:
    copy_of = co.load(thrown_file).save(tmp_path / "copy.json")
    assert co.load(copy_of, thrown()).links
    with pytest.raises(co.ProblemError, match="the jump of y"):
        co.load(copy_of, thrown(bend=0.5))
    tree = {name: value for name, value in unpacked(thrown_file.read_bytes())[0].items() if name != "links"}
    write(tree, tmp_path / "earlier.npz")  # a file of a version that did not keep them
    assert co.load(tmp_path / "earlier.npz", thrown()).links
    cut = unpacked(thrown_file.read_bytes())[0]
    cut["links"][0]["values"] = cut["links"][0]["values"][:, :1]
    write(cut, tmp_path / "cut.npz")
    with pytest.raises(co.ProblemError, match="what passes between its phases contradicts itself"):
        co.load(tmp_path / "cut.npz")
