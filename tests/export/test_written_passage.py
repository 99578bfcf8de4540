"""Covariances in exported solvers: the source of the compiled passage beside CasADi's own operations."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, QUICK

import covocp as co
from covocp.export import CPackage, export_c
from covocp.models import mass_chain, unknown_lag
from covocp.passage import library, ordering, sweep
from covocp.passage.shape import shape
from covocp.transcription import shooting

# The meshes are coarse.
pytestmark = [
    pytest.mark.skipif(library.functions() is None, reason=str(library.build_info()["library"])),
    pytest.mark.filterwarnings("ignore::covocp.CovocpWarning"),
]

MESH = {"intervals": 8, "substeps": 2}
CALL = "written_forward("


def code(made: CPackage) -> str:
    """What CasADi and the passage compute."""
    return (made.directory / f"{made.name}_casadi.c").read_text(encoding="utf-8")


def plain(problem: co.Problem, name: str, monkeypatch: pytest.MonkeyPatch) -> CPackage:
    """The package without the compiled passage."""
    with monkeypatch.context() as without:
        without.setattr(shooting, "functions", lambda: None)
        return export_c(problem, FOLDER / name, **MESH)


@pytest.mark.needs_cc
@pytest.mark.parametrize(("masses", "share"), [(1, 0.0), (2, 1e9)])
def test_plans_are_those_of_casadis_operations(masses: int, share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 4 rows, and of 6 rows that are eliminated by their nonzeros."""
    monkeypatch.setattr(ordering, "SMALLEST", 1)
    monkeypatch.setattr(ordering, "LARGEST_SHARE", share)
    monkeypatch.setattr(sweep, "shape", shape.__wrapped__)  # it is remembered by the pattern alone
    problem = mass_chain.problem(masses=masses)
    made = export_c(problem, FOLDER / f"chain_{masses}", **MESH)
    beside = plain(problem, f"chain_{masses}_plain", monkeypatch)
    assert CALL in code(made)
    assert CALL not in code(beside)
    shapes = re.findall(r"passage_\w+\[\d+\] = \{\s*\d+, \d+, \d+, \d+, (\d),", code(made))
    assert set(shapes) == {str(int(share > 1.0))}
    made.build(flags=QUICK)
    assert made.check().ok
    planner, reference = made.python(), beside.reference()
    for duration in (None, 1.1 * float(problem.declarations.duration)):
        given = {} if duration is None else {"duration": duration}
        plan, known = planner(**given), reference(**given)
        assert planner.status == reference.status == "OK"
        assert plan["cost"] == pytest.approx(known["cost"], rel=1e-10)
        np.testing.assert_allclose(plan["u"], known["u"], atol=1e-5 * np.abs(known["u"]).max())


@pytest.mark.needs_cc
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_plans_do_not_depend_on_units(unit: float) -> None:
    """A position in micrometres or in thousands of kilometres, an unknown in units of its own."""

    def problem(size: float) -> co.Problem:
        ocp = co.Problem(duration=2.0)
        x, u = ocp.state("x", 2, initial=[1.0 / size, 0.0], variance=[0.1 / size**2, 0.2]), ocp.control("u", guess=0.2)
        b = ocp.unknown("b", mean=1.0 / size, variance=0.3 / size**2)
        ocp.dynamics(x, ca.vertcat(x[1] / size, b * size * u - 0.3 * x[0] * size), noise=[0.0, 0.02])
        ocp.measurement("y", x[0] * size, noise=0.02)
        E = ocp.estimation_covariance()
        ocp.minimize(running=0.1 * u**2 + 0.1 * (size * x[0]) ** 2, terminal=size**2 * (E[b, b] + E[x[0], x[0]]))
        return ocp

    name = "small" if unit < 1 else "large"
    usual = export_c(problem(1.0), FOLDER / f"usual_{name}", **MESH).reference()
    other = export_c(problem(unit), FOLDER / f"other_{name}", **MESH)
    assert CALL in code(other)
    other.build(flags=QUICK)
    planner = other.python()
    assert planner()["cost"] == pytest.approx(usual()["cost"], rel=1e-9)
    assert planner.status == usual.status == "OK"


def test_a_planner_that_is_not_compiled_goes_to_another_process(tmp_path: Path) -> None:
    """What is evaluated there is made of CasADi's operations only, and gives the same plan."""
    made = export_c(unknown_lag.problem(), tmp_path / "lag", **MESH)
    own = made.reference()
    other = pickle.loads(pickle.dumps(own))
    assert other(initial_x=0.9)["cost"] == pytest.approx(own(initial_x=0.9)["cost"], rel=1e-9)
    assert own.status == other.status == "OK"


@pytest.mark.needs_cc
def test_a_compiled_planner_goes_to_another_process_as_it_is(tmp_path: Path) -> None:
    made = export_c(unknown_lag.problem(), tmp_path / "lag", **MESH)
    made.build(flags=QUICK)
    own = made.python()
    other = pickle.loads(pickle.dumps(own))
    assert other()["cost"] == own()["cost"]


def test_second_derivatives_are_taken_of_casadis_operations(tmp_path: Path) -> None:
    exact = {"plugin_options": {"hessian_approximation": "exact"}}
    assert CALL not in code(export_c(unknown_lag.problem(), tmp_path / "exact", **MESH, **exact))


def test_the_same_package_is_written_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names in the code do not depend on what was exported before."""
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    first = code(export_c(unknown_lag.problem(), tmp_path / "one", **MESH, name="lag"))
    export_c(mass_chain.problem(masses=1), tmp_path / "between", **MESH)
    assert code(export_c(unknown_lag.problem(), tmp_path / "two", **MESH, name="lag")) == first


def test_few_segments_are_exported_unless_changes_grow_or_they_are_asked_for(tmp_path: Path) -> None:
    """Constraints: the continuity of a state where segments meet, beside those of the problem itself."""

    def constraints(problem: co.Problem, name: str, **options: int) -> int:
        made = export_c(problem, tmp_path / name, intervals=40, substeps=2, **options)
        found = re.search(r"/\* nlp:\(.*\)->\(x\[\d+\],f,g(\[\d+\]|),", code(made))
        assert found is not None
        return int(found[1].strip("[]") or 1)

    ocp = co.Problem(duration=30.0)
    x, u = ocp.state("x", initial=0.1, final=0.0, variance=0.1), ocp.control("u")
    ocp.dynamics(x, 0.45 * x + u, noise=0.1)  # grows by e^13.5
    ocp.measurement("y", x, noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=E[x, x])
    lag = unknown_lag.problem()
    of_one = constraints(lag, "one", segments=1)
    assert constraints(lag, "lag") - of_one + 1 == 2
    assert constraints(lag, "asked", segments=5) - of_one + 1 == 5
    assert constraints(ocp, "unstable") - constraints(ocp, "unstable_one", segments=1) + 1 == 3
