"""The package on the disk: what is in it, how it is written and compiled, and what is refused."""

import json
import os
import re
import shutil
import subprocess
from importlib import metadata

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, STRICT, open_lag, package
from notebooks import Page

import covocp as co
from covocp.export import export_c
from covocp.export.text.names import KEYWORDS

X, T = ca.SX.sym("x", 2), ca.SX.sym("t")
LAW = ca.Function("law", [X, T], [ca.sin(X[0]) * T + X[1]], ["x", "t"], ["u"])
FILES = ["CMakeLists.txt", "README.md", "main.c", "thing.c", "thing.h", "thing_casadi.c", "covocp-package.json"]
needs_cc = pytest.mark.needs_cc


def test_the_files_of_a_package(tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    made = export_c(LAW, tmp_path / "thing")
    assert sorted(path.name for path in made.directory.iterdir()) == sorted(FILES)
    mark = json.loads((made.directory / "covocp-package.json").read_text())
    assert mark["date"] == "1970-01-02"
    assert mark["laws"] == ["law"]
    for name in ("thing.h", "README.md"):
        text = (made.directory / name).read_text()
        assert "1970-01-02" in text
        assert f"covocp {mark['covocp']}" in text
    assert mark["covocp"] in (metadata.version("covocp") if _installed() else "(not installed)")


def test_a_notebook_shows_the_lines_of_print(tmp_path):
    made = export_c(LAW, tmp_path / "a & b", name="thing")
    page = Page(made._repr_html_())
    assert " ".join(page.words) == " ".join(str(made).split())
    assert str(made.directory) in " ".join(page.words)
    assert page.tags == ["div", *["p"] * len(str(made).splitlines())]


def _installed():
    try:
        metadata.version("covocp")
    except metadata.PackageNotFoundError:
        return False
    return True


def test_two_exports_are_the_same_files(tmp_path):
    one, two = (export_c(open_lag(), tmp_path / folder, name="lag") for folder in ("one", "two"))
    for path in one.directory.iterdir():
        assert path.read_text() == (two.directory / path.name).read_text(), path.name


@needs_cc
def test_the_header_says_what_everything_is():
    text = (package("lag").directory / "lag.h").read_text()
    for words in (
        'extern "C"', "#ifndef LAG_H", "typedef double lag_real;", "#define LAG_DURATION 10.0 /* [s] */",
        "#define LAG_STEP_ESTIMATE 2", "[s] of the last step", "(x, b)", "void lag_init(lag_controller *self);",
        "int lag_step(lag_controller *self, lag_real measurement, lag_real time, lag_real *control);",
        "#define LAG_TIME_AFTER 3", "lag_real E[LAG_SAMPLE_E_ROWS][LAG_SAMPLE_E_COLUMNS];",
    ):  # fmt: skip
        assert words in text, words
    mars = (package("mars").directory / "mars.h").read_text()
    for unit in (
        "[ft] state 'h'",
        "(h [ft], theta [rad], v [ft/s], gamma [rad], log_density [ln(slug/ft^3)])",
        "measurement: accelerometers[0] [ft/s^2], accelerometers[1] [ft/s^2]\n",
    ):
        assert unit in mars
    assert (
        "#define LAG_SAMPLED_PERIOD 0.01 /* [s] */" in (package("lag_sampled").directory / "lag_sampled.h").read_text()
    )


@needs_cc
def test_the_readme_says_how_to_build_and_what_it_needs():
    text = (package("lag").directory / "README.md").read_text()
    for words in (
        "cmake -S . -B build",
        "$(CC) -std=c99",
        "stack",
        "-Wunused-parameter",
        "TIME_AFTER",
    ):
        assert words in text, words
    assert re.search(r"\| `lag_step` \| [1-9]\d{2,3} \| stack \|", text)  # bytes


@needs_cc
def test_cxx_users_include_the_header(tmp_path):
    if not shutil.which("g++"):
        pytest.skip("there is no g++")
    folder, main = package("lag").directory, tmp_path / "main.cpp"
    main.write_text(
        '#include "lag.h"\n#include <cmath>\n'
        "int main() { lag_controller c; lag_real u; lag_init(&c); lag_point p;\n"
        "  const int status = lag_step(&c, 0.1, 0.5, &u) + lag_sample(1.0, &p);\n"
        "  return status + (std::isfinite(u) && p.E[0][1] == p.E[1][0] ? 0 : 1); }\n"
    )
    objects = [folder / "build" / name for name in ("lag.o", "lag_casadi.o")]
    flags = ["-std=c++11", "-Wall", "-Wextra", "-pedantic", "-Werror", f"-I{folder}"]
    subprocess.run(["g++", *flags, main, *objects, "-lm", "-o", tmp_path / "main"], check=True)
    assert subprocess.run([tmp_path / "main"]).returncode == 0


@needs_cc
def test_cmake_builds_the_same():
    if not shutil.which("cmake"):
        pytest.skip("there is no cmake")
    made = export_c(LAW, FOLDER / "by_cmake")
    built = made.build("cmake", flags=STRICT)
    assert "cmake" in built.compiler
    assert made.check().ok
    assert subprocess.run(["ctest", "--test-dir", made.directory / "build"], capture_output=True).returncode == 0


@needs_cc
def test_the_line_of_a_makefile_works(tmp_path):
    if not shutil.which("make"):
        pytest.skip("there is no make")
    made = export_c(LAW, tmp_path / "thing")
    line = re.search(r"```make\n(.*?)```", (made.directory / "README.md").read_text(), re.DOTALL)
    (made.directory / "Makefile").write_text(line.group(1))
    subprocess.run(["make", "selftest"], cwd=made.directory, check=True, capture_output=True)
    assert subprocess.run([made.directory / "selftest"], capture_output=True).returncode == 0


@needs_cc
def test_times_of_all_three_ways_are_measured():
    times = package("lag").time(seconds=0.01)
    assert set(times) == {"sample", "step"}
    assert all(number > 0 for t in times.values() for number in (t.c, t.python, t.virtual_machine))


@needs_cc
def test_functions_in_python_take_positions_and_names_and_remember_their_status():
    made = export_c(LAW, FOLDER / "called")
    law = made.python()
    assert (
        law([0.5, 2.0], 3.0)
        == law(t=3.0, x=[0.5, 2.0])
        == law.law([0.5, 2.0], t=3.0)
        == pytest.approx(3 * np.sin(0.5) + 2)
    )
    assert law.status == "OK"
    assert np.isnan(law([np.nan, 0.0], 1.0))
    assert law.status == "RESULT_NOT_FINITE"
    assert list(law) == ["law"]
    for arguments in (([1.0], 2.0), ([1.0, 2.0],), ([1.0, 2.0], 3.0, 4.0)):
        with pytest.raises(co.ExportError, match="do not fit"):
            law(*arguments)
    with pytest.raises(co.ExportError, match="do not fit"):
        law([1.0, 2.0], time=3.0)
    with pytest.raises(AttributeError):
        law.nothing  # noqa: B018


@needs_cc
@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_matrices_are_row_by_row_and_may_be_sparse_or_empty(kind):
    A, d, none = kind.sym("A", 2, 3), kind.sym("d", ca.Sparsity.diag(3)), kind.sym("none", 0, 1)
    f = ca.Function("f", [A, d, none], [A @ d, ca.sum1(A), none], ["A", "d", "none"], ["product", "sums", "nothing"])
    made = export_c(f, FOLDER / f"matrices_{kind.__name__}")
    made.build(flags=STRICT)
    assert made.check().deviation <= 1e-12
    given = np.arange(6.0).reshape(2, 3)
    product, sums = made.python()(given, np.diag([1.0, 10.0, 100.0]))
    np.testing.assert_array_equal(product, given * [1.0, 10.0, 100.0])
    np.testing.assert_array_equal(sums, given.sum(axis=0, keepdims=True))


@needs_cc
def test_results_may_be_written_over_arguments_and_are_not_where_they_are_not_finite(tmp_path):
    made = package("filters")
    main = tmp_path / "main.c"
    main.write_text(
        '#include "filters.h"\n#include <math.h>\n'
        "int main(void) {\n  double x[2] = {1, 2}, P[4] = {1, 0, 0, 1}, y[2] = {0.5, NAN}, other[2], Q[4];\n"
        "  int i, bad = 0;\n"
        "  bad += filters_update_joseph(x, P, y, other, Q) != FILTERS_OK;\n"
        "  bad += filters_update_joseph(x, P, y, x, P) != FILTERS_OK;\n"
        "  for (i = 0; i < 2; ++i) bad += x[i] != other[i];\n  for (i = 0; i < 4; ++i) bad += P[i] != Q[i];\n"
        "  P[0] = NAN;\n  bad += filters_predict(x, P, x, P) != FILTERS_RESULT_NOT_FINITE;\n"
        "  for (i = 0; i < 2; ++i) bad += x[i] != other[i];\n  bad += P[3] != Q[3];\n  return bad;\n}\n"
    )
    objects = [made.directory / "build" / name for name in ("filters.o", "filters_casadi.o")]
    subprocess.run(
        ["cc", "-std=c99", f"-I{made.directory}", main, *objects, "-lm", "-o", tmp_path / "main"], check=True
    )
    assert subprocess.run([tmp_path / "main"]).returncode == 0


@needs_cc
def test_a_second_package_in_the_same_folder_is_the_one_that_is_called(tmp_path):
    first = export_c(LAW, tmp_path / "thing")
    assert first.python()([0.0, 2.0], 1.0) == 2.0
    other = ca.Function("law", [X, T], [X[1] * T**2 + 1], ["x", "t"], ["u"])
    second = export_c(other, tmp_path / "thing", overwrite=True)
    assert second.python()([0.0, 2.0], 3.0) == 19.0
    assert second.check().ok


@needs_cc
def test_names_that_c_does_not_allow_are_changed():
    f = ca.Function("double_", [X, T], [X * T], ["int", "I"], ["return"])
    made = export_c(f, FOLDER / "names")
    made.build(flags=STRICT)
    assert made.check().ok
    problem = co.Problem(duration=1.0)
    x = problem.state("the state, at last", initial=0.0, final=1.0)
    u = problem.control("double")
    problem.dynamics(x, u)
    problem.minimize(running=u**2)
    made = export_c(co.solve(problem, intervals=5, progress=False), FOLDER / "odd_names")
    made.build(flags=STRICT)
    assert made.check().ok
    assert [port.name for port in made.laws[0].outputs] == ["time", "the_state_at_last", "double_", "status"]


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["int", "class", "1st", "a-b", "", "größe", "math", "main", "test", "a" * 41, 3])
def test_names_that_are_no_identifiers_are_refused(tmp_path, name):
    with pytest.raises(co.ExportError, match="cannot be the name of a C package"):
        export_c(LAW, tmp_path / "thing", name=name)
    assert not list(tmp_path.iterdir())


def test_keywords_are_those_of_c_and_of_cxx():
    assert {"int", "while", "inline", "restrict", "_Bool", "class", "template", "namespace"} <= KEYWORDS


def test_the_name_comes_from_the_folder(tmp_path):
    assert export_c(LAW, tmp_path / "my-law").name == "my_law"
    assert export_c(LAW, str(tmp_path / "other"), name="mine").name == "mine"


@pytest.mark.parametrize("precision", ["half", 64, None])
def test_an_unknown_precision_is_refused(tmp_path, precision):
    with pytest.raises(co.ExportError, match="precision"):
        export_c(LAW, tmp_path / "thing", precision=precision)


def test_a_folder_that_exists_is_not_overwritten_unless_told(tmp_path):
    made = export_c(LAW, tmp_path / "thing")
    before = {path.name: path.read_bytes() for path in made.directory.iterdir()}
    with pytest.raises(co.ExportError, match="overwrite=True"):
        export_c(open_lag(), tmp_path / "thing")
    assert {path.name: path.read_bytes() for path in made.directory.iterdir()} == before
    made = export_c(open_lag(), tmp_path / "thing", overwrite=True)
    assert [law.name for law in made.laws] == ["sample"]
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]


def test_a_folder_of_other_things_is_not_overwritten_at_all(tmp_path):
    target = tmp_path / "thesis"
    target.mkdir()
    with pytest.raises(co.ExportError, match="does not exist yet"):
        export_c(LAW, target)
    (target / "chapter.txt").write_text("years of work")
    with pytest.raises(co.ExportError, match="other things"):
        export_c(LAW, target, overwrite=True)
    assert (target / "chapter.txt").read_text() == "years of work"
    file = tmp_path / "file"
    file.write_text("text")
    with pytest.raises(co.ExportError, match="no folder"):
        export_c(LAW, file, overwrite=True)
    for other in (target, file):  # nothing is advised that would be refused
        with pytest.raises(co.ExportError) as caught:
            export_c(LAW, other)
        assert "overwrite" not in str(caught.value)
        assert "choose another" in caught.value.remedy


def test_a_folder_that_cannot_be_written_is_refused(tmp_path, monkeypatch):
    with pytest.raises(co.ExportError, match="within one that exists"):
        export_c(LAW, tmp_path / "missing" / "thing")
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(co.ExportError, match="can be written to"):
        export_c(LAW, tmp_path / "thing")
    with pytest.raises(co.ExportError, match="name of a folder"):
        export_c(LAW, 3)


def test_an_error_on_the_way_leaves_nothing_and_the_old_package(tmp_path, monkeypatch):
    from pathlib import Path

    made = export_c(LAW, tmp_path / "thing")
    before = {path.name: path.read_bytes() for path in made.directory.iterdir()}
    write = Path.write_text

    def full(path, text, **options):
        if path.name == "main.c":
            raise OSError(28, "No space left on device")
        return write(path, text, **options)

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(co.ExportError, match="No space left"):
        export_c(open_lag(), tmp_path / "thing", overwrite=True)
    assert {path.name: path.read_bytes() for path in made.directory.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]


class Python(ca.Callback):
    """A law that only Python can evaluate."""

    def __init__(self):
        ca.Callback.__init__(self)
        self.construct("my_python_law", {})

    def get_n_in(self):
        return 1

    def get_n_out(self):
        return 1

    def eval(self, arguments):
        return [2 * arguments[0]]


def uncompilable():
    """Functions of which a part has no C code, the node's name, and what the remedy names."""
    z, A, b = ca.MX.sym("z"), ca.MX.sym("A", 3, 3), ca.MX.sym("b", 3)
    p = ca.MX.sym("p")
    law = Python()
    newton = ca.rootfinder("root", "newton", {"x": z, "p": p, "g": z**3 + z - p})
    cvodes = ca.integrator("flow", "cvodes", {"x": z, "ode": -(z**3)}, 0.0, 1.0)
    return [
        (ca.Function("f", [z], [law(z)]), "CallbackInternal", "'my_python_law'", law),
        (ca.Function("f", [A, b], [ca.solve(A, b, "lapacklu")]), "LapackLu", "'qr'", None),
        (ca.Function("f", [A, b], [ca.solve(A, b, "csparse")]), "Csparse", "'qr'", None),
        (ca.Function("f", [p], [newton(1.0, p)]), "Newton", "fast_newton", None),
        (ca.Function("f", [z], [cvodes(x0=z)["xf"]]), "Cvodes", "Runge-Kutta", None),
    ]


@pytest.mark.parametrize("case", range(5))
def test_nodes_without_c_code_are_named_with_what_to_do(tmp_path, capfd, case):
    function, node, remedy, kept = uncompilable()[case]
    with pytest.raises(co.ExportError) as error:
        export_c(function, tmp_path / "thing")
    assert node in str(error.value)
    assert remedy in str(error.value)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")
    del kept


@pytest.mark.parametrize(
    ("what", "options", "words"),
    [
        (3, {}, "cannot be exported"),
        ([], {}, "cannot be exported"),
        ([LAW, 3], {}, "cannot be exported"),
        ("law", {}, "cannot be exported"),
        ([LAW, LAW], {}, "Two functions"),
        (ca.Function("empty", [X], []), {}, "returns nothing"),
        (LAW, {"ranges": {"y": (0, 1)}}, "names 'y'"),
        (LAW, {"units": {"y": "m"}}, "names 'y'"),
        (LAW, {"ranges": {"x": (1, 0)}}, "range of 'x'"),
        (LAW, {"ranges": {"x": ([0, 0, 0], 1)}}, "range of 'x'"),
        (LAW, {"ranges": {"x": (0, np.inf)}}, "range of 'x'"),
        (LAW, {"ranges": {"x": 3}}, "range of 'x'"),
        (LAW, {"period": 0.1}, "no option 'period' for functions"),
        (LAW, {"method": "ipopt"}, "no option 'method' for functions"),
        (LAW, {"intervals": 10}, "no option 'intervals' for functions"),
        (LAW, {"range": {"x": (0, 1)}}, r"(?s)no option 'range' for functions.*perhaps 'ranges' is meant"),
        (LAW, {"overwite": True}, r"(?s)no option 'overwite' for functions.*perhaps 'overwrite' is meant"),
        (LAW, {"tolerance": -1.0}, "tolerance"),
        (LAW, {"tolerance": True}, "tolerance"),
    ],
)  # fmt: skip
def test_what_means_nothing_is_refused(tmp_path, what, options, words):
    with pytest.raises(co.ExportError, match=words):
        export_c(what, tmp_path / "thing", **options)
    assert not list(tmp_path.iterdir())


@needs_cc
@pytest.mark.parametrize("arguments", [{"samples": 0}, {"samples": 1.5}, {"samples": True}, {"seed": -1}])
def test_check_needs_whole_numbers(arguments):
    with pytest.raises(co.ExportError, match=next(iter(arguments))):
        package("lag").check(**arguments)


def test_without_a_compiler_the_error_says_so(tmp_path, monkeypatch):
    made = export_c(LAW, tmp_path / "thing")
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(co.ExportError, match="no C compiler and no CMake"):
        made.build()
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(co.ExportError, match="there is no C compiler"):
        made.build("cc")
    with pytest.raises(co.ExportError, match="no such tool"):
        made.build("make")
    with pytest.raises(co.ExportError, match=r"(?s)The flags of the package 'thing' do not fit.*list of flags"):
        made.build(flags="-O3")


@needs_cc
def test_the_message_of_the_compiler_is_passed_on(tmp_path):
    made = export_c(LAW, tmp_path / "thing")
    path = made.directory / "thing.c"
    path.write_text(path.read_text() + "\nthis is not C;\n")
    with pytest.raises(co.ExportError, match=r"thing\.c:\d+:\d+: error"):
        made.check()
    with pytest.raises(co.ExportError, match="no-such-flag"):
        export_c(LAW, tmp_path / "other").build(flags=["--no-such-flag"])
