"""Controllers in C that are given nonsense: a status of the list, a control that is a number, nothing out of bounds."""

import re
import shutil
import subprocess

import casadi as ca
import numpy as np
import pytest
from exports import SANITIZE, package, quick, sanitized

import covocp as co
from covocp.export import export_c
from covocp.export.laws.law import span

pytestmark = pytest.mark.needs_cc
PROGRAM = """\
#include "{name}.h"
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

static unsigned long state = 1;
static int pick(int count)
{{
    state = (1103515245UL * state + 12345UL) & 0x7fffffffUL;
    return (int)((state >> 8) % (unsigned long)count);
}}
static const {name}_real values[] = {{NAN, INFINITY, -INFINITY, 1e38, -1e38, 9e29, -9e29, 1e-38, -1, 0.5, 3, 0, 77}};
static const int indices[] = {{INT_MIN, -7, -1, 0, 1, 5, 1000, 100000000, INT_MAX}};
static void spoil({name}_real *to, int count)
{{
    int i;
    for (i = 0; i < count; ++i) if (pick(3) == 0) to[i] = values[pick(13)];
}}

int main(void)
{{
    {name}_controller self;
    {name}_real measurement[{rows}], control[{controls}], time;
    int i, k, status, seen[14] = {{0}};
    for (i = 0; i < {rounds}; ++i) {{
        {name}_init(&self);
        if (i % 2) {{
            {spoilt}
        }}
        for (k = 0; k < 4; ++k) {{
            memset(measurement, 0, sizeof measurement);
            spoil(measurement, {rows});
            time = {duration} * (pick(1000) / 1000.0);
            spoil(&time, 1);
            status = {name}_step(&self, {measurement}, time, control);
            if (status < 0 || (status > 6 && status < 12) || status > 13 || status != self.status) return 1;
            ++seen[status];
            if (i % 2 == 0 && !isfinite(self.time)) return 2;
            {{ int j; for (j = 0; j < {controls}; ++j) if (!isfinite(control[j])) return 3; }}
        }}
    }}
    for (i = 0; i <= {statuses}; i = i == 6 ? 12 : i + 1) printf("%d ", seen[i]);
    return 0;
}}
"""
# Needs the header and the object code of any package.
APP = """\
#include "{name}.h"
#include <stdio.h>
int main(void)
{{
    int (*volatile law)() = (int (*)())&{name}_{law};
    printf("{name} %d\\n", law != 0 ? {capitals}_OK : -1);
    return 0;
}}
"""


def app(name):
    """A program of the user's."""
    return APP.format(name=name, law=package(name).laws[-1].name, capitals=name.upper())


def spoilt(law):
    """C that spoils what a controller keeps, as a struct that was never set would be."""
    lines = []
    for port in law.inputs:
        field = law.held.get(port.name)
        if field in ("index", "passed", "overdue"):
            lines.append(f"self.{field} = indices[pick(9)];")
        elif field is not None:
            lines.append(f"spoil({'&' if port.scalar else ''}self.{field}, {port.size});")
    return " ".join(lines)


@pytest.mark.parametrize("name", ["lag", "lag_sampled", "lag_single", "mars", "mars_sampled", "mars_single", "swing"])
def test_no_nonsense_leads_to_a_crash_or_a_control_that_is_no_number(name, tmp_path):
    made = package(name)
    law = next(law for law in made.laws if law.name == "step")
    sizes = {port.name: port.size for port in (*law.inputs, *law.outputs)}
    text = PROGRAM.format(
        name=name,
        rounds=3_000 if name.endswith("sampled") else 1_500,  # of these the last status is the rarest: one step in 1000
        rows=sizes["measurement"],
        controls=sizes["control"],
        spoilt=spoilt(law),
        statuses=13 if name.endswith("sampled") or name == "swing" else 6,
        duration=f"{name.upper()}_DURATION",
        measurement="measurement" if sizes["measurement"] > 1 else "measurement[0]",
    )
    (tmp_path / "main.c").write_text(text)
    if not sanitized(name):
        pytest.skip("the compiler has no sanitizers")
    command = ["cc", "-std=c99", "-Werror", *SANITIZE, f"-I{made.directory}", tmp_path / "main.c", *sanitized(name)]
    subprocess.run([*command, "-lm", "-o", tmp_path / "main"], check=True, capture_output=True)
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert all(int(count) > 0 for count in done.stdout.split())  # every status was seen


@pytest.mark.parametrize("period", [None, 0.05])
def test_a_control_that_overflows_is_the_nominal_one(period, tmp_path):
    """Gains of 1e12 in floats: an estimate below the largest one would give an infinite control."""
    ocp = co.Problem(duration=2.0, name="tiny")
    x, u = ocp.state("x", initial=0.0, variance=0.1), ocp.control("u", unit="pN")
    ocp.dynamics(x, -x + 1e-12 * u, noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    ocp.minimize_expected(running=0.5e-24 * u**2, terminal_weight={x: 2.0})
    solution = co.evaluate(ocp, nominal={"u": 3e11})
    controller = quick(export_c(solution, tmp_path / "tiny", precision="single", period=period)).python().step
    controller.step(0.0, 1.9)
    controller._values[span(controller.law.outputs, "estimate")] = 9e29
    control = controller.step(np.nan, 1.95)
    assert controller.status == "ESTIMATE_LOST"
    assert control[0] == pytest.approx(3e11, rel=1e-6)


# --- names ------------------------------------------------------------------------------------------------------------


def sine(name, argument="x", size=2, result="u"):
    """A function with these names."""
    x = ca.SX.sym("x", size)
    return ca.Function(name, [x], [ca.sin(x)], [argument], [result])


@pytest.mark.parametrize(
    ("functions", "word"),
    [
        ([sine("law"), sine("law_", size=3)], "pk_law_core"),
        ([sine("law"), sine("law_core", size=3)], "pk_law_core"),
        ([sine("a", "b_c"), sine("a_b", "c", 3)], "PK_A_B_C"),
        ([sine("Law"), sine("law", size=3)], "PK_LAW_X"),
        ([sine("real"), sine("real_law")], "pk_real_law"),
        ([sine("result", "not_finite")], "PK_RESULT_NOT_FINITE"),
        ([sine("law", "pk_real")], "pk_real"),
    ],
)
def test_two_things_of_one_name_are_refused(functions, word, tmp_path):
    with pytest.raises(co.ExportError, match=f"would be called '{word}' in C") as error:
        export_c(functions, tmp_path / "pk")
    assert "rename" in str(error.value)
    assert not list(tmp_path.iterdir())


def test_names_of_the_standard_headers_are_changed(tmp_path):
    names = ["M_E", "memcpy", "all_finite", "errno", "I", "complex", "unix", "near"]
    x = [ca.SX.sym(name) for name in names]
    made = export_c(ca.Function("law", x, [ca.sum1(ca.vertcat(*x))], names, ["NAN"]), tmp_path / "pk")
    made.build(flags=["-Werror"])
    assert made.check().ok
    assert made.python()(*range(8)) == 28.0
    main = tmp_path / "main.c"
    main.write_text(
        "#include <complex.h>\n#include <errno.h>\n#include <math.h>\n#include <stdio.h>\n"
        f'#include "{made.directory}/pk.h"\nint main(void) {{ return 0; }}\n'
    )
    subprocess.run(["cc", "-std=gnu99", "-Wall", "-Werror", main, "-o", tmp_path / "main"], check=True)


@pytest.mark.parametrize("name", ["a__b", "a_", "_a"])
def test_underscores_that_casadi_refuses_are_refused_before(name, tmp_path):
    with pytest.raises(co.ExportError, match="underscores"):
        export_c(sine("law"), tmp_path / "pk", name=name)


def test_folders_give_their_name_or_say_why_not(tmp_path):
    assert export_c(sine("law"), tmp_path / "my--law_").name == "my_law"
    for folder in ("class", "math"):
        with pytest.raises(co.ExportError, match=rf"'{folder}' cannot be the name of a C package.*") as error:
            export_c(sine("law"), tmp_path / folder)
        assert "name=" in str(error.value)
    for folder in ("a" * 300, "null\0byte"):
        with pytest.raises(co.ExportError, match="a folder that can be made"):
            export_c(sine("law"), tmp_path / folder, name="law")


# --- what the README says ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lag_sampled", "lag_single", "theta"])
def test_every_line_of_the_readme_for_the_shell_works(name, tmp_path):
    text = (package(name).directory / "README.md").read_text(encoding="utf-8")
    lines = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    assert [line.split()[0] for line in lines] == ["cmake", "cc", "cc"]
    (tmp_path / "app.c").write_text(app(name))
    for file in package(name).directory.glob("*.*"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    for line in lines:
        done = subprocess.run(["sh", "-c", line], cwd=tmp_path, capture_output=True, text=True, timeout=300)
        if done.returncode and "cmake: not found" in done.stderr:
            continue
        assert done.returncode == 0, done.stdout + done.stderr
        assert "warning" not in done.stdout + done.stderr
        assert "passed" in done.stdout or "-o app" in line
    assert subprocess.run([tmp_path / "app"], capture_output=True, text=True).stdout == f"{name} 0\n"


@pytest.mark.parametrize("name", ["lag", "lag_single", "planner"])
def test_the_lines_of_the_readme_for_cmake_make_a_program(name, tmp_path):
    if not shutil.which("cmake"):
        pytest.skip("there is no cmake")
    text = (package(name).directory / "README.md").read_text(encoding="utf-8")
    (tmp_path / "CMakeLists.txt").write_text(re.findall(r"```cmake\n(.*?)```", text, re.DOTALL)[0])
    (tmp_path / "app.c").write_text(app(name))
    shutil.copytree(package(name).directory, tmp_path / name, ignore=shutil.ignore_patterns("build"))
    quick = "" if name == "lag" else "-DCMAKE_BUILD_TYPE=Debug"  # as the package asks where nothing is said: optimised
    command = f"cmake -S . -B build {quick} && cmake --build build --target app"
    done = subprocess.run(["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    made = subprocess.run([tmp_path / "build" / "app"], capture_output=True, text=True)
    assert made.stdout == f"{name} 0\n"


@pytest.mark.parametrize("name", ["lag", "lag_sampled", "mars"])
def test_header_and_readme_say_what_counts_as_not_finite_and_what_comes_after_the_end(name):
    for file in (f"{name}.h", "README.md"):
        text = (package(name).directory / file).read_text(encoding="utf-8")
        joined = " ".join(text.replace("\n *", " ").split())
        assert "readings beyond 1e30 count as not finite" in joined
        assert "nominal control of the end without feedback: the caller must stop" in joined
        assert ":  (" not in text
        assert "|  (" not in text


@pytest.mark.parametrize(("reading", "missing"), [(0.99e30, False), (1.01e30, True)])
def test_readings_beyond_1e30_are_left_out(reading, missing):
    controller = package("lag").python().step
    controller.init()
    controller.step(reading, 0.5)
    assert (controller.status == "MEASUREMENT_MISSING") == missing


@pytest.mark.parametrize("name", ["lag", "mars_sampled"])
def test_the_readme_shows_how_a_controller_is_called(name, tmp_path):
    text = (package(name).directory / "README.md").read_text(encoding="utf-8")
    snippet = re.findall(r"```c\n(.*?)```", text, re.DOTALL)[-1]
    before, after = snippet.split("int status;")
    given = "measurement[0] = measurement[1] = 0;" if name == "mars_sampled" else "measurement = 0;"
    main = tmp_path / "main.c"
    body = f"{before}int status;\n{given}\ntime = 1;\n{after}\nreturn status;\n"
    main.write_text(f'#include "{name}.h"\nint main(void)\n{{\n{body}}}\n')
    folder = package(name).directory
    objects = [folder / "build" / f"{stem}.o" for stem in (name, f"{name}_casadi")]
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", f"-I{folder}"]
    subprocess.run(["cc", *flags, main, *objects, "-lm", "-o", tmp_path / "main"], check=True)
    assert subprocess.run([tmp_path / "main"]).returncode == 0


@pytest.mark.parametrize("name", ["lag_sampled", "mars", "mars_single", "history", "filters", "theta", "planner"])
def test_every_header_is_one_of_cxx_too(name, tmp_path):
    main = tmp_path / "main.cpp"
    main.write_text(f'#include "{name}.h"\nint main() {{ return {name.upper()}_OK; }}\n')
    flags = ["-std=c++11", "-Wall", "-Wextra", "-pedantic", "-Werror", f"-I{package(name).directory}"]
    subprocess.run(["g++", *flags, "-fsyntax-only", main], check=True)


def test_two_packages_have_no_symbol_in_common():
    symbols = []
    for name in ("lag", "mars", "theta"):
        folder = package(name).directory / "build"
        command = ["nm", "-g", "--defined-only", folder / f"{name}.o", folder / f"{name}_casadi.o"]
        lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
        symbols += [line.split()[-1] for line in lines if len(line.split()) == 3]
    assert len(symbols) == len(set(symbols)) > 0
    assert all(symbol.startswith(("lag_", "mars_", "theta_")) for symbol in symbols)
    assert np.size(symbols) > 30


@pytest.mark.parametrize("reading", [[0.3], 0.3, [0.3, 0.3], np.zeros(4), [], "a", None, [0.1, "b", 0.2]])
@pytest.mark.parametrize("kind", ["python", "reference"])
def test_a_reading_that_is_none_is_an_error_and_no_step(kind, reading):
    """Three values are measured: one number is not taken for all of them."""
    controller = getattr(package("swing"), kind)()
    controller.step([0.1, 0.2, 0.3], 0.5)
    before = controller.state
    with pytest.raises(co.ExportError, match=r"(?s)arguments of 'step'.*measurement \(3,\)"):
        controller.step(reading, 0.55)
    for name, value in controller.state.items():
        np.testing.assert_array_equal(value, before[name])
    with pytest.raises(co.ExportError, match="time"):
        controller.step([0.1, 0.2, 0.3], [0.5, 0.6])
