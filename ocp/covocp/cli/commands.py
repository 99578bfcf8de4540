"""The command `covocp`: list, solve, compare, plot and export models and the user's own problems."""

from __future__ import annotations

import argparse
import os
import sys
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn, TextIO

import covocp as co
from covocp.base.errors import CovocpError, Interrupted, ProblemError, SolveError, spelling
from covocp.base.expressions import Given
from covocp.base.files import check_target
from covocp.base.later import later
from covocp.base.pages import WIDTH
from covocp.cli.catalogue import check_once, find_model, models, parse_value, problems, split_setting
from covocp.plot.figure import SUFFIXES as FIGURES
from covocp.solution.storage import SUFFIXES as FILES
from covocp.solving.comparison import COMPARED, SOLVE_OPTIONS
from covocp.solving.methods import method_options
from covocp.solving.random_starts import STARTS
from covocp.transcription.mesh import INTERVALS, Options

FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130
# Solutions and exit codes by problem and nominal: figures of one model share them.
Known = dict[tuple[int, str], tuple[Any, int]]
# Arguments of `solve` that have an option of their own here.
TAKEN = ("problem", "method", "intervals", "progress", "allow_failure", "parameters", "methods", "method_options")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: those of the command line without the command; None: of this process.

    Returns:
        0; 1 where a solve failed, 2 where the input is wrong, 130 where it was interrupted before an iterate existed.
    """
    try:
        parsed, unknown = _parser().parse_known_args(arguments)
    except SystemExit:  # of --help and --version, whose reader may have gone too
        _print("", sys.stdout, end="")
        raise
    if unknown:  # told by the command that was meant, with its usage
        parsed.parser.refuse(unknown)
    try:
        with _plain_warnings():
            code = int(parsed.run(parsed))
    except SolveError as error:
        code = _complain(error, FAILED)
    except CovocpError as error:
        code = _complain(error, WRONG_INPUT)
    except KeyboardInterrupt:
        code = _complain("interrupted", INTERRUPTED)
    _print("", sys.stdout, end="")  # what is left of the output goes now, while a reader that has gone is no error
    return code


class _Version(argparse.Action):
    """Shows the version, which is looked up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print it and end."""
        _print(f"covocp {co.__version__}", sys.stdout)
        parser.exit()


class _Parser(argparse.ArgumentParser):
    """A parser of whole names: what is an abbreviation today may be two options tomorrow."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        """Make a parser without abbreviations, whose lines of help stay as they are written."""
        settings |= {"allow_abbrev": False, "formatter_class": argparse.RawDescriptionHelpFormatter}
        super().__init__(*arguments, **settings)
        self.set_defaults(parser=self)

    def format_help(self) -> str:
        """The help; below that of a command that solves, the options of the solver, looked up only now."""
        if "--option" in self._option_string_actions:
            self.epilog = _solver_options(self.get_default("several"))
        return super().format_help()

    def refuse(self, unknown: list[str]) -> NoReturn:
        """End with what is not known, and the option that was probably meant."""
        name = unknown[0].partition("=")[0]
        hint = spelling(name, self._option_string_actions, "") if name.startswith("-") else ""
        self.error(f"unrecognized: {' '.join(unknown)}" + (f"; {hint}" if hint else ""))


def _solver_options(several: bool) -> str:
    """What `--option` takes, with the defaults; several: where more than one method runs."""
    groups = {
        "of the mesh": {f.name: f.default for f in fields(Options) if f.name != "intervals"},
        **{f"of {method}": method_options(method) for method in co.methods()},
        "of the start": {"guess": "multistart", "starts": STARTS, "seed": 0},
    }
    if not several:
        groups["of an expected cost"] = {"nominal": "deterministic"}
    own = "; METHOD.NAME=VALUE for one of the methods" if several else ""
    lines = [f"values of --option (docs/api.md says what they mean{own}):"]
    for title, options in groups.items():
        words = "  " + " ".join(f"{name}={value}" for name, value in options.items())
        lines += [f"  {title}:", *textwrap.wrap(words, WIDTH, initial_indent="  ", subsequent_indent="    ")]
    return "\n".join(lines)


def _parser() -> _Parser:
    """The options of all commands."""
    parser = _Parser(prog="covocp", description="Optimal control of a trajectory together with its uncertainty.")
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and end")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = commands.add_parser("list", help="show the models with their parameters")
    listing.set_defaults(run=_list)
    solve = commands.add_parser("solve", help="solve a model and print what came out")
    _common(solve)
    solve.add_argument("--plot", "--output", metavar="FILE", help="write a figure (" + ", ".join(FIGURES) + ")")
    solve.add_argument("--save", metavar="FILE", help="write the solution (" + ", ".join(FILES) + ")")
    solve.set_defaults(run=_solve)
    compare = commands.add_parser("compare", help="solve a model by several methods and print a table")
    _common(compare, several=True)
    compare.add_argument("--plot", "--output", metavar="FILE", help="write a figure of all solutions")
    compare.set_defaults(run=_compare)
    plot = commands.add_parser("plot", help="solve a model and draw its figures")
    _common(plot)
    plot.add_argument("--plot", "--output", metavar="FILE", help="name of the figures; MODEL.png by default")
    plot.set_defaults(run=_plot)
    _export_options(commands.add_parser("export", help="solve a model and write C code, compiled and compared"))
    return parser


def _export_options(export: argparse.ArgumentParser) -> None:
    """Options of `covocp export`."""
    _common(export)
    export.add_argument("directory", metavar="DIR", help="folder to make")
    export.add_argument("--name", help="of the package, an identifier in C; that of the folder by default")
    export.add_argument("--precision", choices=("double", "single"), default="double", help="of all numbers (double)")
    export.add_argument(
        "--period", type=float, metavar="SECONDS", help="of the samples of a controller; any by default"
    )
    export.add_argument(
        "--limits", choices=("bounds",), help="of a controller's control: the bounds of the problem; none by default"
    )
    export.add_argument(
        "--largest-spread",
        type=float,
        metavar="FACTOR",
        help="of a controller: by how much its loop may spread more than the solution predicts (1.5)",
    )
    export.add_argument("--samples", type=_whole, default=1000, metavar="N", help="points of the comparison (1000)")
    export.add_argument("--overwrite", action="store_true", help="replace a package that is there")
    export.add_argument("--solver", action="store_true", help="write the solver of the model, for re-planning")
    export.set_defaults(run=_export)


def _common(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Options of every command that solves; several: by more than one method."""
    parser.set_defaults(several=several)
    parser.add_argument("model", metavar="MODEL", help="a name from `covocp list`, or path/to/script.py:function")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a parameter of the model; may be repeated"
    )
    parser.add_argument("--intervals", type=_whole, metavar="N", help="control intervals (100)")
    parser.add_argument(
        "--option", action="append", default=[], metavar="NAME=VALUE", help="an option of the solver; may be repeated"
    )
    parser.add_argument("--quiet", action="store_true", help="print errors and warnings only")
    methods = ", ".join(co.methods())
    if several:
        words = f"one of {methods}; may be given several times, {', '.join(COMPARED)} by default"
        parser.add_argument("--method", action="append", help=words)
    else:
        parser.add_argument("--method", default="ipopt", help="one of " + methods)


def _whole(text: str) -> int:
    """A positive whole number of the command line."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a positive whole number")
    return number


def _list(arguments: argparse.Namespace) -> int:
    """covocp list."""
    for model in (entry for own in models() for entry in problems(own)):
        words = " ".join(f"{name}={value}" for name, value in model.defaults().items())
        setting = f"    --set {words}\n" if words else "    no parameters\n"
        _print(f"{model.label}\n    {model.description}\n{setting}", sys.stdout)
    return 0


def _solve(arguments: argparse.Namespace) -> int:
    """covocp solve MODEL."""
    _check_targets((arguments.plot, FIGURES), (arguments.save, FILES))
    problem = find_model(arguments.model).build(arguments.set)
    solution, code = _solved(problem, arguments)
    if solution is None:
        return code
    with _told(arguments, solution) as written:
        if arguments.save:
            solution.save(arguments.save)
            written.append(f"solution: {arguments.save}")
        if arguments.plot:
            solution.plot(path=arguments.plot)
            written.append(f"figure: {arguments.plot}")
    return code


def _compare(arguments: argparse.Namespace) -> int:
    """covocp compare MODEL."""
    _check_targets((arguments.plot, FIGURES))
    problem = find_model(arguments.model).build(arguments.set)
    if arguments.plot and isinstance(problem, co.Phases):
        raise _not_of_phases(
            "compare", "--plot", "draw the figure of each method by `covocp plot MODEL --method METHOD`"
        )
    methods = arguments.method or list(COMPARED)
    shared, own = _options(arguments.option, co.methods())
    _check_compared(methods, shared, own)
    comparison = co.compare(
        problem, methods, intervals=arguments.intervals, progress=not arguments.quiet, method_options=own, **shared
    )
    with _told(arguments, comparison) as written:
        if arguments.plot and comparison.solutions:
            comparison.plot(path=arguments.plot)
            written.append(f"figure: {arguments.plot}")
    for row in comparison if arguments.quiet else ():  # else the table has said it
        if row.reason:
            _complain(f"{row.label}: {row.reason}", FAILED)
    return 0 if comparison.converged else FAILED


def _check_compared(methods: Sequence[str], shared: Mapping[str, Any], own: Mapping[str, Mapping[str, Any]]) -> None:
    """What `compare` refuses, in words of the command line.

    Args:
        methods: that are compared.
        shared: options of all of them.
        own: options by method.

    Raises:
        ProblemError: an unknown method, one that is given twice, options of one that is not compared or that one of
            them does not have.
    """
    for method in methods:
        if method not in co.methods():
            raise ProblemError(
                f"There is no such method: '{method}'.",
                expected="one of " + ", ".join(co.methods()),
                received=f"--method {method}",
                remedy=spelling(method, co.methods(), "correct --method"),
            )
    shared_by_all = {f.name for f in fields(Options)} | set(SOLVE_OPTIONS)
    known = {method: {*method_options(method), *shared_by_all} for method in methods}
    given = [(method, f"{method}.{name}", name) for method, options in own.items() for name in options]
    given += [(method, name, name) for name in shared for method in methods]
    for method, written, name in given:
        if method not in known or name not in known[method]:
            has = [other for other in known if name in known[other]]
            remedy = f"write --option {has[0]}.{name}=VALUE for the method that has it" if has else "remove it"
            raise ProblemError(
                f"'{method}' is not compared." if method not in known else f"'{method}' has no option '{name}' here.",
                expected="options of the compared methods: `covocp compare --help` lists them",
                received=f"--option {written}=...",
                remedy=f"add --method {method}, or remove the option"
                if method not in known
                else spelling(name, known[method], remedy),
            )
    if len(set(methods)) < len(methods):
        raise ProblemError(
            "A method is given twice.",
            expected="each method once",
            received=" ".join(f"--method {method}" for method in methods),
            remedy="remove one of them",
        )


def _plot(arguments: argparse.Namespace) -> int:
    """covocp plot MODEL."""
    model = find_model(arguments.model)
    target = check_target(arguments.plot or f"{model.name}.png", FIGURES)
    figures = model.figures() if not arguments.set else {}
    figures = figures or {"": [("", model.build(arguments.set))]}
    worst, known = 0, Known()
    for number, (title, content) in enumerate(figures.items(), start=1):
        path = target if len(figures) == 1 else target.with_name(f"{target.stem}-{number}{target.suffix}")
        figure = dict(content) if isinstance(content, Mapping) else {"designs": content}
        worst = max(worst, _figure(title, figure, path, arguments, known))
    return worst


def _figure(title: str, figure: dict[str, Any], path: Path, arguments: argparse.Namespace, known: Known) -> int:
    """Solve the problems of one figure, those that no other figure has solved, and draw it."""
    worst, labels, solutions = 0, [], []
    for label, problem, *nominal in figure.pop("designs"):
        key = (id(problem), repr(nominal))
        if key not in known:
            known[key] = _solved(problem, arguments, *nominal)
        solution, code = known[key]
        worst = max(worst, code)
        if solution is not None:
            labels.append(label)
            solutions.append(solution)
    if solutions and isinstance(solutions[0], co.PhasesSolution):  # alone: it has a figure of its own
        solutions[0].plot(path=path)
        _say(arguments, f"figure: {path}")
    elif solutions:
        draw = later("plot.figure").plot_solutions
        draw(solutions, *figure.pop("names", ()), labels=labels, title=title or None, path=path, **figure)
        _say(arguments, f"figure: {path}" + (f": {title}" if title else ""))
    return worst


def _export(arguments: argparse.Namespace) -> int:
    """covocp export MODEL DIR."""
    exporting = later("export.exporting")
    settings: dict[str, Any] = {"name": arguments.name, "precision": arguments.precision}
    settings |= {"overwrite": arguments.overwrite, "period": arguments.period}
    exporting.check_settings(arguments.directory, **settings)
    what = find_model(arguments.model).build(arguments.set)
    code = 0
    if arguments.solver and isinstance(what, co.Phases):
        raise _not_of_phases("export", "--solver", "export the solver of one problem, or the solution without --solver")
    if arguments.solver:
        shared, _ = _options(arguments.option, ())
        settings |= {**shared, "intervals": arguments.intervals or INTERVALS}
    else:
        what, code = _solved(what, arguments)
        if code:
            return code
    for name in ("limits", "largest_spread"):  # to a solver too, which says that it has no such option
        if getattr(arguments, name) is not None:
            settings[name] = getattr(arguments, name)
    package = exporting.export_c(what, arguments.directory, **settings)
    check = package.check(samples=arguments.samples)
    _say(arguments, str(package))
    return 0 if check.ok else FAILED


def _not_of_phases(command: str, option: str, remedy: str) -> ProblemError:
    """The error of an option that has no meaning for several phases."""
    return ProblemError(
        f"`covocp {command} {option}` does not take phases.",
        expected="a function that returns a covocp.Problem",
        received="one that returns covocp.Phases",
        remedy=remedy,
    )


def _solved(problem: Given, arguments: argparse.Namespace, nominal: Given = None) -> tuple[Any, int]:
    """The solution, or the last iterate, and the exit code; a failure is told on the standard error."""
    shared, own = _options(arguments.option, (arguments.method,))
    options = {**shared, **own.get(arguments.method, {})}
    try:
        if isinstance(nominal, Mapping):  # given, not solved for: only the mesh matters
            mesh = {name: value for name, value in options.items() if name in {f.name for f in fields(Options)}}
            return co.evaluate(problem, nominal=nominal, intervals=arguments.intervals, **mesh), 0
        if nominal is not None:
            options["nominal"] = nominal
        solution = co.solve(
            problem, arguments.method, intervals=arguments.intervals, progress=not arguments.quiet, **options
        )
    except SolveError as error:
        _complain(error, FAILED)
        return error.solution, FAILED
    except Interrupted as error:
        _complain(error, INTERRUPTED)
        return error.solution, INTERRUPTED
    except CovocpError:
        raise
    except (RuntimeError, TypeError, ValueError, ArithmeticError, ImportError) as error:
        raise ProblemError(
            f"The problem could not be given to {arguments.method}.",
            expected="options that it understands, and a model that can be evaluated",
            received=f"{type(error).__name__}: {' '.join(str(error).split())[:300]}",
            remedy="check the values of --option and --set",
        ) from error
    return solution, 0 if solution.converged else FAILED


def _options(given: list[str], methods: Sequence[str]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Options of the solver: for all methods, and by method where they are written method.name=value."""
    shared: dict[str, Any] = {}
    own: dict[str, dict[str, Any]] = {}
    for entry in given:
        name, value = split_setting("--option", entry)
        method, dot, rest = name.partition(".")
        if dot and method in methods:
            check_once("--option", rest, entry, own.setdefault(method, {}))
            own[method][rest] = parse_value(value)
        elif name in TAKEN:
            raise ProblemError(
                f"'{name}' is not an option of the solver.",
                expected="an option of the method or the mesh, such as control=constant",
                received=f"--option {entry}",
                remedy=f"use --{name}" if name in ("method", "intervals") else "remove it",
            )
        else:
            check_once("--option", name, entry, shared)
            shared[name] = parse_value(value)
    return shared, own


def _check_targets(*targets: tuple[str | None, tuple[str, ...]]) -> None:
    """Complain about files that cannot be written before anything is solved."""
    for path, suffixes in targets:
        if path is not None:
            check_target(path, suffixes)


@contextmanager
def _told(arguments: argparse.Namespace, outcome: object) -> Iterator[list[str]]:
    """Write files, then print what came out, also where a file could not be written.

    First the files: printing waits for a reader that pages, and ends with one that goes. What is put into the list is
    printed below, a line each.
    """
    written: list[str] = []
    try:
        yield written
    finally:
        _say(arguments, str(outcome), *([""] if written else []), *written)


def _say(arguments: argparse.Namespace, *lines: str) -> None:
    """Lines on the standard output, where these are wanted."""
    if not arguments.quiet:
        _print("\n".join(lines), sys.stdout)


def _complain(error: object, code: int) -> int:
    """A message on the standard error."""
    _print(f"covocp: {error}", sys.stderr)
    return code


def _print(text: str, stream: TextIO | None, end: str = "\n") -> None:
    """Print, or print nothing from now on where the reader has gone (`covocp list | head`): that is no error."""
    if stream is None:  # closed by the shell
        return
    try:
        print(text, end=end, file=stream, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Warnings as lines without the place in the code."""

    def show(message: Warning | str, *place: Any) -> None:
        _print(f"covocp: warning: {message}", sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", co.CovocpWarning)
        warnings.showwarning = show  # type: ignore[assignment]
        yield


if __name__ == "__main__":
    sys.exit(main())
