"""The command: what it prints and writes, and how it ends."""

import os
import signal
import subprocess
import sys

import pytest

import covocp as co
import covocp.cli.commands
import covocp.models
import covocp.plot.figure
from covocp.base.progress import Progress
from covocp.cli.commands import main

SCRIPT = """
import covocp as co
import covocp.models

def make(weight=1.0, kind: str = "plain"):
    '''Move a mass point. And more.'''
    ocp = co.Problem(duration=1.0, name=f"script {weight:g} {kind}")
    x = ocp.state("x", initial=0.0, final=1.0)
    u = ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * weight * u**2)
    return ocp

def needs(weight: float):
    return make(weight)

def anything(**parameters):
    return make(**parameters)

def parts(final=1.0):
    first, second = co.Problem(2.0, name="first"), co.Problem(3.0, name="second")
    x, u = first.state("x", initial=0.0), first.control("u")
    first.dynamics(x, u)
    first.minimize(running=0.5 * u**2)
    y, w = second.state("x", initial=None, final=final), second.control("w")
    second.dynamics(y, w)
    second.minimize(running=0.5 * w**2)
    return co.Phases([first, second], name="parts")

def number():
    return 3

def failing():
    return 1 / 0

def leaving():
    raise SystemExit(5)
"""


@pytest.fixture
def script(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    path = tmp_path / "my_script.py"
    path.write_text(SCRIPT, encoding="utf-8")
    return path


def run(capsys, *arguments):
    """Exit code, standard output, standard error."""
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as error:  # argparse
        code = error.code
    out, err = capsys.readouterr()
    return code, out, err


def test_list_shows_every_model_with_its_parameters(capsys):
    code, out, _ = run(capsys, "list")
    assert code == 0
    names = [line for line in out.splitlines() if line and not line.startswith(" ")]
    modules = os.listdir(os.path.dirname(covocp.models.__file__))
    assert [name for name in names if ":" not in name] == sorted(
        name[:-3] for name in modules if name.endswith(".py") and name != "__init__.py"
    )
    assert "--set weight=10.0 final=0.0 duration=10.0" in out
    entry = out[out.index("damped_oscillator") :]
    assert "Damped oscillator with unknown damping and stiffness" in entry


def test_list_shows_the_other_problems_of_a_model_under_the_names_that_solve_takes(capsys):
    from covocp.cli.catalogue import find_model

    out = run(capsys, "list")[1]
    others = [line for line in out.splitlines() if ":" in line and not line.startswith(" ")]
    assert {"unknown_lag:steering", "mars_entry:truth"} <= set(others)
    for name in others:
        assert find_model(name).label == name
    entry = out[out.index("unknown_lag:steering") :].split("\n\n")[0].splitlines()
    assert entry[1].strip().startswith("First-order lag with unknown time constant, steered by feedback")
    assert entry[2].strip().startswith("--set final=1.0 terminal_weight=2.0")


def test_help_of_a_command_that_solves_names_the_options_of_the_solver(capsys):
    for command in ("solve", "compare", "plot", "export"):
        code, out, _ = run(capsys, command, "--help")
        assert code == 0
        for option in ("control=linear", "covariance_step=auto", "max_iterations=None", "variant=gradient", "starts=8"):
            assert option in out
        assert max(len(line) for line in out.splitlines()) <= 100
    assert "values of --option" not in run(capsys, "list", "--help")[1]


def test_help_of_compare_lists_what_compare_takes(capsys):
    """What an expected cost is solved for is no option of it, and options by method are none of solve."""
    listed = {command: run(capsys, command, "--help")[1] for command in ("solve", "compare")}
    assert "nominal=deterministic" in listed["solve"]
    assert "nominal" not in listed["compare"]
    assert "METHOD.NAME=VALUE" in listed["compare"]
    assert "METHOD.NAME" not in listed["solve"]
    assert "ipopt, gradient by default" in " ".join(listed["compare"].split())


def test_unknown_options_are_told_by_the_command_with_the_nearest_one(capsys):
    code, out, err = run(capsys, "solve", "unknown_lag", "--interval", "50")
    assert (code, out) == (2, "")
    assert err.startswith("usage: covocp solve ")
    assert "unrecognized: --interval 50" in err
    assert "perhaps '--intervals' is meant" in err
    code, _, err = run(capsys, "list", "everything")
    assert (code, err.splitlines()[0]) == (2, "usage: covocp list [-h]")
    assert "unrecognized: everything\n" in err


def test_solve_prints_the_solution_and_writes_files(capsys, tmp_path):
    figure, file = tmp_path / "figure.png", tmp_path / "solution.json"
    code, out, err = run(
        capsys, "solve", "unknown_lag", "--set", "weight=1", "--set", "final=1.0", "--intervals", 60,
        "--option", "control=constant", "--option", "substeps=2", "--plot", figure, "--save", file,
    )  # fmt: skip
    assert code == 0, err
    assert out.startswith("first-order lag, unknown time constant: solved (ipopt)")
    assert figure.read_bytes().startswith(b"\x89PNG")
    loaded = co.load(file)
    assert loaded["weight"][0] == 1.0
    assert loaded["x"][-1] == pytest.approx(1.0)
    assert (loaded.mesh.intervals, loaded.mesh.control, loaded.mesh.substeps) == (60, "constant", 2)


def test_quiet_prints_nothing(capsys, tmp_path):
    code, out, err = run(
        capsys, "solve", "noisy_integrator", "--intervals", 10, "--quiet", "--output", tmp_path / "f.pdf"
    )
    assert (code, out, err) == (0, "", "")
    assert (tmp_path / "f.pdf").exists()


def test_quiet_leaves_warnings(capsys):
    """A result that may be wrong is not passed in silence, and the help says so."""
    code, out, err = run(capsys, "solve", "bryson_denham", "--intervals", 4, "--quiet")
    assert (code, out) == (0, "")
    assert err.startswith("covocp: warning: ")
    assert "print errors and warnings only" in run(capsys, "solve", "--help")[1]


def test_a_script_that_takes_the_sine_of_a_symbol_is_told_whose_to_take(capsys, tmp_path):
    """CasADi's own words are "'to_double' not defined"."""
    path = tmp_path / "sine.py"
    path.write_text(
        "import math\nimport covocp as co\n\n\ndef make():\n    ocp = co.Problem(1.0)\n"
        "    x = ocp.state('x', initial=0.0)\n    ocp.dynamics(x, math.sin(x))\n    return ocp\n"
    )
    code, _, error = run(capsys, "solve", f"{path}:make")
    assert code != 0
    assert "sine.py:8" in error
    assert "casadi.sin and its like in place of math.sin" in " ".join(error.split())


def test_a_function_of_a_script_is_solved(capsys, script):
    code, out, _ = run(capsys, "solve", f"{script}:make", "--set", "weight=2", "--set", "kind=3", "--intervals", 5)
    assert code == 0
    assert out.startswith("script 2 3: solved")
    code, out, _ = run(capsys, "solve", f"{script}:needs", "--set", "weight=4", "--intervals", 5)
    assert (code, out.split(":")[0]) == (0, "script 4 plain")
    code, out, _ = run(capsys, "solve", f"{script}:anything", "--set", "kind=free", "--intervals", 5)
    assert (code, out.split(":")[0]) == (0, "script 1 free")


def test_a_solve_that_fails_tells_and_keeps_the_last_iterate(capsys, tmp_path):
    file = tmp_path / "iterate.npz"
    code, out, err = run(
        capsys, "solve", "unknown_lag", "--intervals", 30, "--option", "max_iterations=3", "--save", file
    )
    assert code == 1
    assert "was not solved by ipopt" in err
    assert out.startswith("NOT CONVERGED")
    assert not co.load(file).converged


def test_an_interrupt_shows_the_last_iterate(capsys, monkeypatch):
    def update(self, iteration, *rest):
        if iteration == 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Progress, "update", update)
    code, out, err = run(capsys, "solve", "unknown_lag", "--intervals", 30)
    assert code == 130
    assert out.startswith("NOT CONVERGED: first-order lag, unknown time constant: interrupted")
    assert "effort: " in out
    assert "Traceback" not in err


def test_compare_prints_a_table_and_writes_a_figure(capsys, tmp_path):
    figure = tmp_path / "compare.png"
    code, out, err = run(
        capsys, "compare", "noisy_integrator", "--method", "ipopt", "--intervals", 10, "--plot", figure,
        "--option", "ipopt.hessian=exact",
    )  # fmt: skip
    assert code == 0, err
    assert out.splitlines()[2].split()[:3] == ["method", "cost", "gap"]
    assert figure.exists()


def test_compare_ends_with_one_where_a_run_failed(capsys):
    code, out, _ = run(
        capsys, "compare", "unknown_lag", "--method", "ipopt", "--intervals", 30, "--option", "ipopt.max_iterations=3"
    )
    assert code == 1
    assert "ipopt: did not converge" in out


INFEASIBLE = """
import covocp as co

def infeasible():
    ocp = co.Problem(duration=2.0, name="infeasible")
    x = ocp.state("x", initial=0.0, final=10.0)
    u = ocp.control("u", lower=-1, upper=1)
    ocp.dynamics(x, u - x)
    ocp.minimize(running=u**2)
    return ocp
"""


def test_a_quiet_compare_says_which_run_failed_and_why(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    script = tmp_path / "infeasible.py"
    script.write_text(INFEASIBLE, encoding="utf-8")
    model = f"{script}:infeasible"
    code, out, err = run(capsys, "compare", model, "--quiet", "--method", "ipopt", "--intervals", 5)
    assert (code, out) == (1, "")
    assert err.startswith("covocp: ipopt: did not converge: ")
    assert run(capsys, "compare", "noisy_integrator", "--quiet", "--method", "ipopt", "--intervals", 10) == (0, "", "")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--option", "nominal=deterministic"], "'ipopt' has no option 'nominal' here"),
        (["--option", "variant=gradient"], "write --option gradient.variant=VALUE"),
        (["--option", "tolerances=1"], "perhaps 'tolerance' is meant"),
        (["--method", "ipopt", "--option", "gradient.variant=gradient"], "add --method gradient"),
        (["--method", "ipopt", "--option", "ipopt.variant=gradient"], "remove it"),
        (["--method", "ipopt", "--method", "ipopt"], "A method is given twice"),
        (["--method", "simplex"], "correct --method"),
    ],
)
def test_wrong_options_of_compare_are_refused_in_words_of_the_command(capsys, arguments, words):
    outcome = run(capsys, "compare", "noisy_integrator", "--intervals", "10", *arguments)
    assert_refused(outcome, words)
    assert "method_options" not in outcome[2]
    assert "methods=" not in outcome[2]


def test_plot_draws_the_figures_of_the_source(capsys, tmp_path):
    code, out, _ = run(
        capsys, "plot", "unknown_lag", "--intervals", 20, "--option", "substeps=3", "--output", tmp_path / "lag.png"
    )
    assert code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lag-1.png", "lag-2.png", "lag-3.png"]
    assert "Schmidt 5.2" in out
    assert "Schmidt 5.3" in out
    assert "Schmidt 6.12" in out
    assert [line[:8] for line in out.splitlines()] == 3 * ["figure: "]


def test_plot_names_its_file_after_the_model(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(capsys, "plot", "noisy_integrator", "--intervals", 10, "--quiet")[0] == 0
    assert run(capsys, "plot", "bryson_denham", "--intervals", 10, "--quiet")[0] == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bryson_denham.png", "noisy_integrator.png"]


def test_plot_with_parameters_draws_that_problem(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(capsys, "plot", "unknown_lag", "--intervals", 60, "--set", "weight=3")
    assert (code, out.strip()) == (0, "figure: unknown_lag.png")


@pytest.mark.parametrize("name", ["unknown_lag", "damped_oscillator", "noisy_integrator", "mars_entry"])
def test_figures_of_models_are_labelled_designs(name):
    from covocp.cli.catalogue import find_model

    figures = find_model(name).figures()
    assert figures
    for figure in figures.values():
        designs = figure["designs"] if isinstance(figure, dict) else figure
        labels = [label for label, *_ in designs]
        assert len(set(labels)) == len(labels) >= 2
        nominals = {(problem.statement().values.tobytes(), repr(nominal)) for _, problem, *nominal in designs}
        assert len(nominals) == len(designs)


def test_figures_share_solutions_and_have_names_and_given_nominals(capsys, tmp_path, monkeypatch):
    from covocp.models import unknown_lag

    problem, drawn, solved = unknown_lag.steering(), [], []
    designs = [("combined", problem), ("classical", problem, "deterministic"), ("nothing", problem, {"u": 0.0})]
    figures = {"one": {"designs": designs, "names": [("rms", "x")]}, "two": {"designs": designs[:2], "over": "x"}}
    monkeypatch.setattr(unknown_lag, "figures", lambda: figures)
    solve = co.solve
    monkeypatch.setattr(co, "solve", lambda *a, **k: solved.append(k) or solve(*a, **k))
    draw = covocp.plot.figure.plot_solutions
    monkeypatch.setattr(
        covocp.plot.figure, "plot_solutions", lambda s, *n, **k: drawn.append((s, n, k)) or draw(s, *n, **k)
    )
    code, out, _ = run(capsys, "plot", "unknown_lag", "--intervals", 40, "--output", tmp_path / "lag.png")
    assert code == 0
    assert out.count("figure: ") == len(list(tmp_path.iterdir())) == 2
    assert len(solved) == 2
    (first, names, _), (second, _, options) = drawn
    assert names == (("rms", "x"),)
    assert options["over"] == "x"
    assert [s.method for s in first] == ["ipopt", "ipopt", "evaluate"]
    assert [s.origin for s in second] == ["optimised", "classical"]
    assert first[0] is second[0]


def test_warnings_are_lines(capsys):
    code, _, err = run(capsys, "solve", "mass_chain", "--intervals", 10, "--option", "substeps=1")
    assert code == 0
    lines = err.splitlines()
    assert lines[0].startswith("covocp: warning: The mesh is too coarse")
    assert lines[1].startswith("covocp: warning: The controls change faster")
    assert len(lines) == 2


@pytest.mark.needs_cc
def test_export_writes_compiles_and_compares(capsys, tmp_path):
    folder = tmp_path / "integrator_c"
    code, out, err = run(capsys, "export", "noisy_integrator", folder, "--intervals", 10, "--samples", 50)
    assert code == 0, err
    assert out.startswith("C package 'integrator_c'")
    assert "sample: 50 points, largest relative deviation" in out
    assert "self-test in C: passed" in out
    assert (folder / "integrator_c.h").exists()
    assert_refused(run(capsys, "export", "noisy_integrator", folder, "--quiet"), "overwrite=True")
    arguments = ["--overwrite", "--quiet", "--precision", "single", "--name", "other", "--samples", 20]
    code, out, _ = run(capsys, "export", "noisy_integrator", folder, "--intervals", 10, *arguments)
    assert (code, out) == (0, "")
    assert (folder / "other.h").exists()
    assert "typedef float other_real;" in (folder / "other.h").read_text(encoding="utf-8")


@pytest.mark.needs_cc
def test_export_writes_controllers_and_solvers(capsys, tmp_path):
    code, out, err = run(
        capsys, "export", "unknown_lag:steering", tmp_path / "lag", "--intervals", 80, "--period", 0.1, "--samples", 50
    )
    assert code == 0, err
    assert "lag_sample, lag_step (double precision)" in out
    code, out, err = run(
        capsys, "export", "bryson_denham", tmp_path / "planner", "--intervals", 10, "--solver", "--set", "limit=0.2"
    )
    assert code == 0, err
    assert "planner_solve" in out


def test_export_of_a_failed_solve_writes_nothing(capsys, tmp_path):
    arguments = ["--intervals", 30, "--option", "max_iterations=3"]
    code, _, err = run(capsys, "export", "unknown_lag", tmp_path / "lag", *arguments)
    assert code == 1
    assert "was not solved" in err
    assert not (tmp_path / "lag").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--name", "int"], "cannot be the name of a C package"),
        (["--period", "0.1"], "those of a controller"),
        (["--limits", "bounds"], "those of a controller"),
        (["--solver", "--limits", "bounds"], "no option 'limits' for a problem"),
        (["--solver", "--period", "0.1"], "no option 'period' for a problem"),
        (["--solver", "--option", "colour=3"], "no option 'colour'"),
        (["--period", "-1"], "not a positive number"),
        (["--period", "nan"], "not a positive number"),
    ],
)
def test_wrong_exports_are_refused(capsys, tmp_path, arguments, words):
    outcome = run(capsys, "export", "noisy_integrator", tmp_path / "out", "--intervals", "10", *arguments)
    assert_refused(outcome, words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("model", "folder", "words"),
    [
        ("nonsense", "out", "There is no model 'nonsense'"),
        ("noisy_integrator:closed", "out", "has no problem 'closed'"),
        ("noisy_integrator", "missing/out", "make that folder first"),
        ("noisy_integrator", "class", "cannot be the name of a C package"),
        ("noisy_integrator", ".", "--overwrite"),
    ],
)
def test_wrong_exports_are_refused_before_anything_is_solved(capsys, tmp_path, monkeypatch, model, folder, words):
    monkeypatch.setattr(co, "solve", None)
    assert_refused(run(capsys, "export", model, tmp_path / folder), words)
    assert not list(tmp_path.iterdir())


def test_a_period_that_does_not_fit_is_refused(capsys, tmp_path):
    arguments = ["--intervals", 80, "--quiet", "--period", "100"]
    outcome = run(capsys, "export", "unknown_lag:steering", tmp_path / "lag", *arguments)
    assert_refused(outcome, "1 to 200000 periods within 10 s")
    assert not list(tmp_path.iterdir())


# --- wrong input ------------------------------------------------------------------------------------------------------


def assert_refused(outcome, words):
    """Exit code 2 and one paragraph that begins with the command's name."""
    code, out, err = outcome
    assert (code, out) == (2, "")
    assert words in err
    assert err.startswith("covocp: ")
    assert "\n\n" not in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nonsense"], "There is no model 'nonsense'"),
        (["unknown_lag", "--set", "wait=1"], "'unknown_lag' has no parameter 'wait'"),
        (["goddard_rocket", "--set", "mass=1"], "none: it has no parameters"),
        (["unknown_lag", "--set", "weight=heavy"], "The value of 'weight' does not fit"),
        (["unknown_lag", "--set", "weight=true"], "expected: a number"),
        (["unknown_lag", "--set", "duration_weight=long"], "a number or none"),
        (["mass_chain", "--set", "masses=1.5"], "a whole number"),
        (["mass_chain", "--set", "masses=0"], "The chain needs a number of masses"),
        (["unknown_lag", "--set", "weight"], "--set name=value"),
        (["unknown_lag", "--set", "weight="], "--set name=value"),
        (["unknown_lag", "--set", "duration=-1"], "'duration' must be positive"),
        (["unknown_lag", "--set", "initial_variance=nan"], "contains NaN"),
        (["damped_oscillator", "--set", "naming=mine"], "no such naming"),
        (["unknown_lag", "--method", "simplex"], "There is no such method"),
        (["unknown_lag", "--option", "colour=3"], "has no option 'colour'"),
        (["unknown_lag", "--option", "control=wavy"], "The option 'control' has an unknown value"),
        (["unknown_lag", "--option", "tolerance=small"], "expected: a finite number > 0"),
        (["unknown_lag", "--option", "intervals=3"], "use --intervals"),
        (["unknown_lag", "--option", "guess=magic"], "'magic'"),
        (["unknown_lag", "--plot", "figure.doc"], "suffix names no format"),
        (["unknown_lag", "--save", "solution.mat"], "suffix names no format"),
        (["unknown_lag", "--save", "missing/solution.npz"], "folder does not exist"),
        (["missing.py:make"], "There is no script 'missing.py'"),
    ],
)
def test_wrong_input_is_refused(capsys, arguments, words):
    assert_refused(run(capsys, "solve", *arguments), words)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (":nothing", "has no function 'nothing'"),
        ("", "the function one of make, needs"),
        (":co", "has no function 'co'"),
        (":number", "did not return a problem"),
        (":failing", "ZeroDivisionError: division by zero"),
        (":leaving", "SystemExit: 5"),
        (":needs", "my_script.py:needs' needs a value of weight"),
    ],
)
def test_wrong_functions_of_scripts_are_refused(capsys, script, function, words):
    assert_refused(run(capsys, "solve", f"{script}{function}"), words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\nraise KeyError('lost')\n", "my_script.py:2"),
        ("x = (\n", "SyntaxError"),
        ("import nowhere\n", "nowhere"),
    ],
)
def test_scripts_that_fail_are_refused_with_their_line(capsys, script, text, words):
    script.write_text(text, encoding="utf-8")
    assert_refused(run(capsys, "solve", f"{script}:make"), words)


@pytest.mark.parametrize("arguments", [[], ["dance"], ["solve"], ["solve", "unknown_lag", "--intervals", "0"]])
def test_wrong_commands_are_refused_by_the_parser(capsys, arguments):
    code, _, err = run(capsys, *arguments)
    assert code == 2
    assert "usage: covocp" in err


@pytest.mark.parametrize("command", ["list", "compare --help", "--version"])
def test_a_reader_that_has_gone_is_no_error(command):
    command = f"{sys.executable} -m covocp {command} | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "0"
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("solve noisy_integrator --intervals 10 --save out.npz", 0),
        ("solve unknown_lag --intervals 30 --option max_iterations=3 --save out.npz", 1),
        ("compare noisy_integrator --method ipopt --intervals 10 --plot out.png", 0),
    ],
)
def test_files_are_written_and_the_exit_code_is_right_where_the_reader_has_gone(tmp_path, command, code):
    """Neither stream has a reader: the errors go into the same pipe."""
    line = f"{sys.executable} -m covocp {command} 2>&1 | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.stdout.strip(), done.stderr) == (str(code), "")
    assert all((tmp_path / name).exists() for name in ("out.npz", "out.png") if name in command)


def test_files_are_written_before_anything_is_printed(capsys, tmp_path, monkeypatch):
    """A reader that pages, such as less, holds the output back; what was found must not wait for it."""
    file, seen = tmp_path / "solution.npz", []
    monkeypatch.setattr(covocp.cli.commands, "_print", lambda text, *_, **__: seen.append((text, file.exists())))
    assert run(capsys, "solve", "noisy_integrator", "--intervals", 10, "--save", file)[0] == 0
    assert seen[0][1]
    assert f"solution: {file}" in seen[0][0]


def test_a_figure_that_cannot_be_drawn_hides_no_solution(capsys, tmp_path, monkeypatch):
    def failing(*arguments, **options):
        raise co.ProblemError("No figure.", expected="one", received="none", remedy="none")

    monkeypatch.setattr(covocp.plot.figure, "plot_solutions", failing)
    files = ["--plot", tmp_path / "f.png", "--save", tmp_path / "s.npz"]
    outcome = run(capsys, "solve", "noisy_integrator", "--intervals", 10, *files)
    assert outcome[0] == 2
    assert outcome[1].startswith("integrator with state-dependent noise: solved")
    assert f"solution: {tmp_path / 's.npz'}" in outcome[1]
    assert "figure:" not in outcome[1]
    assert "covocp: No figure." in outcome[2]


def test_other_problems_of_a_model_and_none_as_a_value() -> None:
    from covocp.cli.catalogue import find_model

    steering = find_model("unknown_lag:steering")
    assert steering.build(["duration=5"]).declarations.expected is not None
    assert not steering.figures()
    assert find_model("mars_entry").build(["regularization=none"]).declarations.expected is not None
    with pytest.raises(co.ProblemError, match="perhaps 'steering' is meant"):
        find_model("unknown_lag:steerin")


def test_the_package_runs_as_a_module():
    """Where the script is not on the path."""
    run = subprocess.run([sys.executable, "-m", "covocp", "list"], capture_output=True, text=True, check=True)
    assert "unknown_lag" in run.stdout


def test_version(capsys, monkeypatch):
    monkeypatch.setitem(vars(co), "__version__", "1.2.3")
    assert run(capsys, "--version") == (0, "covocp 1.2.3\n", "")


# --- several phases ---------------------------------------------------------------------------------------------------


def test_phases_are_solved_drawn_saved_and_compared(capsys, script, tmp_path):
    """x' = u from 0 to 3 within 5 s costs 3^2/(2 * 5)."""
    of = f"{script}:parts"
    saved, figure, drawn = tmp_path / "parts.npz", tmp_path / "parts.png", tmp_path / "drawn.png"
    code, out, _ = run(capsys, "solve", of, "--set", "final=3", "--intervals", 5, "--save", saved, "--plot", figure)
    assert code == 0
    assert out.startswith("parts: solved (ipopt)")
    assert "all phases" in out
    assert figure.stat().st_size > 1000
    spaces = {}
    exec(SCRIPT, spaces)
    assert co.load(saved, spaces["parts"](3.0)).cost == pytest.approx(0.9)
    assert run(capsys, "plot", of, "--intervals", 5, "--plot", drawn) == (0, f"figure: {drawn}\n", "")
    assert drawn.stat().st_size > 1000
    code, out, _ = run(capsys, "compare", of, "--intervals", 5)
    assert code == 0
    assert "gradient" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("compare", "--plot", "figure.png"), "does not take phases"),
        (("export", "folder", "--solver"), "does not take phases"),
    ],
)
def test_options_that_mean_nothing_for_phases(capsys, script, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    command, *rest = arguments
    assert_refused(run(capsys, command, f"{script}:parts", *rest), words)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (("--set", "weight=2", "--set", "weight=3"), "'weight' is given twice"),
        (("--option", "substeps=2", "--option", "substeps=3"), "'substeps' is given twice"),
        (("--option", "ipopt.tolerance=1e-6", "--option", "ipopt.tolerance=1e-7"), "'tolerance' is given twice"),
    ],
)
def test_a_value_that_is_given_twice(capsys, script, settings, words):
    """The last one had been taken without a word."""
    assert_refused(run(capsys, "solve", f"{script}:make", *settings), words)
