"""What an export refuses by name, before anything is written."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import covocp as co
from covocp.export import export_c
from covocp.export.laws.law import CODES
from covocp.export.text.self_test import reference
from covocp.models import unknown_lag

x, X = ca.MX.sym("x", 2), ca.SX.sym("x", 2)


def _refused(what: Any, folder: Path, words: str, **options: Any) -> str:
    """The message; nothing has been written."""
    with pytest.raises(co.CovocpError, match=words) as caught:
        export_c(what, folder / "refused", **options)
    assert not list(folder.iterdir())
    return str(caught.value)


def _double(name: str = "f") -> ca.Function:
    return ca.Function(name, [X], [2 * X], ["x"], ["y"])


def _with_ipopt() -> ca.Function:
    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0}
    return ca.nlpsol("best", "ipopt", {"x": X, "f": ca.sumsqr(X - 1)}, quiet)(x0=x)["x"]


def _with_osqp() -> ca.Function:
    return ca.conic("best", "osqp", {"h": ca.DM.eye(2).sparsity()}, {"osqp.verbose": False})(h=ca.DM.eye(2), g=x)["x"]


@pytest.mark.parametrize(
    ("make", "library"), [(_with_ipopt, "<coin-or/IpStdCInterface.h>"), (_with_osqp, "<osqp/osqp.h>")]
)
def test_functions_that_call_a_library_are_refused_by_its_header(make: Any, library: str, tmp_path: Path) -> None:
    message = _refused(ca.Function("law", [x], [make()], ["x"], ["y"]), tmp_path, "self-contained C code: 'law'")
    assert f"includes {library} for 'best'" in message


def test_solvers_that_are_written_out_are_exported(tmp_path: Path) -> None:
    """qrqp prints: its code includes headers of the standard library, and is no library."""
    quiet = {"print_iter": False, "print_header": False, "print_info": False}
    best = ca.conic("best", "qrqp", {"h": ca.DM.eye(2).sparsity()}, quiet)(h=ca.DM.eye(2), g=x)["x"]
    made = export_c(ca.Function("law", [x], [best], ["x"], ["y"]), tmp_path / "written")
    np.testing.assert_allclose(made.reference().law([1.0, -2.0]), [-1.0, 2.0])


@pytest.mark.needs_cc
def test_compiled_functions_are_refused(tmp_path: Path) -> None:
    code, library, empty = tmp_path / "inner.c", tmp_path / "inner.so", tmp_path / "empty"
    generator = ca.CodeGenerator("inner.c")
    generator.add(_double("inner"))
    code.write_text(generator.dump())
    subprocess.run(["cc", "-shared", "-fPIC", "-o", str(library), str(code), "-lm"], check=True)
    external = ca.external("inner", str(library))
    empty.mkdir()
    _refused(ca.Function("law", [x], [3 * external(x)], ["x"], ["y"]), empty, "in its function 'inner'")


@pytest.mark.parametrize(
    "values",
    [[ca.sqrt(X[0]), ca.log(-X[0])], [X / 0], [ca.log(-1 - X[0] ** 2)]],  # never together, never, never a number
)
def test_functions_of_which_nothing_would_be_compared_are_refused(values: list[ca.SX], tmp_path: Path) -> None:
    function = ca.Function("law", [X], values, ["x"], ["y", "z"][: len(values)])
    message = _refused(function, tmp_path, r"'law' has finite results at no point.*\n(.*\n)*.*ranges=")
    assert "of 80 points none: 'y' is" in message


def test_ranges_say_where_a_function_has_values(tmp_path: Path) -> None:
    function = ca.Function("law", [X], [ca.log((X[0] - 50.0) * (70.0 - X[0]))], ["x"], ["y"])
    _refused(function, tmp_path, "'y' is finite at none")
    export_c(function, tmp_path / "law", ranges={"x": (51.0, 60.0)})


def _loop(noise: float) -> co.Problem:
    ocp = co.Problem(2.0, name="loop")
    state, u = ocp.state("x", initial=1.0, variance=0.1), ocp.control("u")
    ocp.dynamics(state, u, noise=noise)
    ocp.measurement("m", state, noise=0.02)
    ocp.minimize_expected(running=u**2 + state**2)
    return ocp


@pytest.mark.parametrize("period", [None, 0.05])
def test_a_solution_under_another_truth_has_no_controller(period: float | None, tmp_path: Path) -> None:
    """The gains are those of the design: no mesh is to blame where the truth spreads otherwise."""
    design = co.evaluate(_loop(0.05), nominal={"u": -0.3}, intervals=20)
    other = co.evaluate(design, truth=_loop(0.5))
    message = _refused(other, tmp_path, "evaluated under other statistics", period=period)
    assert "export the design" in message
    assert "mesh" not in message
    np.testing.assert_array_equal(
        export_c(other, tmp_path / "other", feedback=False).reference().sample(0.7)["E"],
        export_c(design, tmp_path / "design", feedback=False).reference().sample(0.7)["E"],
    )


@pytest.mark.parametrize("inside", ["", "own"])
def test_the_current_folder_is_not_replaced(inside: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process would be left without one."""
    export_c(_double(), tmp_path / "mine")
    (tmp_path / "mine" / "own").mkdir()
    monkeypatch.chdir(tmp_path / "mine" / inside)
    for folder in (".", "../mine", tmp_path / "mine")[0 if not inside else 2 :]:
        with pytest.raises(co.ExportError, match="holds the current folder") as caught:
            export_c(_double(), folder, overwrite=True, name="mine")
        assert "os.chdir" in str(caught.value)
    assert Path.cwd() == tmp_path / "mine" / inside
    monkeypatch.chdir(tmp_path)
    export_c(_double(), "mine", overwrite=True)
    assert (tmp_path / "mine" / "own").is_dir()


@pytest.mark.parametrize("folder", ["a\0b", "a" * 300])
def test_names_of_folders_are_quoted_once(folder: str) -> None:
    with pytest.raises(co.ExportError, match=r"^'[^']+' cannot be written"):
        export_c(_double(), folder)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"ranges": {"y": (0.0, 1.0)}}, r"'y', which is no input\.\n.*one of x\n"),
        ({"units": {"z": "m"}}, "'z', which is no input or output"),
        ({"units": {"y": 3}}, "a dict of name to text"),
    ],
)
def test_ranges_and_units_name_what_they_are_for(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    _refused(_double(), tmp_path, words, **options)


def test_names_of_the_runtime_of_casadi_are_refused(tmp_path: Path) -> None:
    square = ca.Function("square", [X], [X**2], ["x"], ["y"])  # its code has <package>_casadi_sq
    _refused([square, _double("casadi_sq")], tmp_path, "'casadi_sq' cannot be the name of a function")


def test_options_of_a_problem_are_told_all(tmp_path: Path) -> None:
    message = _refused(unknown_lag.problem(), tmp_path, "no option 'period' for a problem", period=0.1)
    for name in ("intervals", "grid", "method", "plugin_options", "tolerance"):
        assert name in message
    other = _refused(unknown_lag.problem(), tmp_path, "'periods'", periods=0.1)
    assert message.splitlines()[1] == other.splitlines()[1]


def test_laws_named_like_what_a_mapping_has_are_items(tmp_path: Path) -> None:
    laws = export_c([_double("items"), _double("principal"), _double("law")], tmp_path / "laws").reference()
    for name in ("items", "principal", "law"):
        np.testing.assert_array_equal(laws[name]([1.0, 2.0]), [2.0, 4.0])
    assert dict(laws.items()) == {name: laws[name] for name in laws}
    assert laws.law is laws["law"]


@pytest.mark.parametrize("count", [1, 3])
def test_a_check_of_few_points_compares_something(count: int, tmp_path: Path) -> None:
    """At zero, the first point, this function has no value."""
    (law,) = export_c(ca.Function("law", [X], [1 / X], ["x"], ["y"]), tmp_path / "law").laws
    known = reference(law, count, 0, "double")
    assert known.rows.shape[0] == count
    finite = known.status == CODES["OK"]
    assert finite.any()
    np.testing.assert_allclose(known.values[finite] * known.rows[finite], 1.0, rtol=1e-15)
