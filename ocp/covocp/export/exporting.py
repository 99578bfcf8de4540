"""What can be exported, and how it becomes a folder of C sources."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import casadi as ca

from covocp.base.arguments import checked, mapping, optional, positive, texts_by_name, truth
from covocp.base.dataclass import dataclass
from covocp.base.errors import ExportError, no_export_option, warn_user
from covocp.base.expressions import Given
from covocp.base.short_repr import short_repr
from covocp.base.threads import one_at_a_time
from covocp.export.compiled.building import Sources
from covocp.export.compiled.folder import check_folder, check_names, package_files, write_folder
from covocp.export.compiled.linking import Linking
from covocp.export.compiled.package import CPackage
from covocp.export.laws.controller import controller_law
from covocp.export.laws.design import check_designed, check_measured, design_of
from covocp.export.laws.functions import function_laws
from covocp.export.laws.history import history
from covocp.export.laws.law import Law, stacked_size
from covocp.export.laws.limits import warn_outside
from covocp.export.laws.phase_controller import check_first_readings, legs_of, phases_controller
from covocp.export.laws.phases import histories
from covocp.export.laws.sampled import discretised, sampled_law
from covocp.export.laws.solver import OPTIONS, solver_law
from covocp.export.laws.spread import LARGEST_SPREAD, check_flight, check_lag, sampled_flight
from covocp.export.laws.trajectory import sample_law
from covocp.export.text.casadi_code import Generated, Sizes, generate
from covocp.export.text.collisions import check_identifiers
from covocp.export.text.header import header
from covocp.export.text.names import check_name, package_name
from covocp.export.text.readme import cmake_lists, readme
from covocp.export.text.self_test import self_test
from covocp.export.text.source import source
from covocp.problem.builder import Problem
from covocp.solution.flight import interpolated_flight
from covocp.solution.phases import PhasesSolution, check_begins, limits_of_each
from covocp.solution.solution import Solution

PRECISIONS = {"double": "double", "single": "float"}
# Largest relative deviation from Python that counts as agreement.
TOLERANCES = {"double": 1e-12, "single": 1e-2}
BYTES = {"double": 8, "single": 4}
POINTER = 8


@dataclass(frozen=True, kw_only=True)
class Content:
    """What is written: the laws, what they are, what a plugin needs besides."""

    laws: tuple[Law, ...]
    title: str
    linking: Linking | None = None

    __repr__ = short_repr


@one_at_a_time
@checked(
    overwrite=truth,
    feedback=truth,
    ranges=optional(mapping),
    units=optional(texts_by_name),
)
def export_c(
    what: Given,
    directory: str | os.PathLike[str],
    *,
    name: str | None = None,
    precision: Literal["double", "single"] = "double",
    overwrite: bool = False,
    period: float | None = None,
    limits: Given = None,
    feedback: bool = True,
    largest_spread: float = LARGEST_SPREAD,
    ranges: Mapping[str, Any] | None = None,
    units: Mapping[str, str] | None = None,
    tolerance: float | None = None,
    method: str = "sqpmethod",
    **options: Any,
) -> CPackage:
    """Write C sources of a solution, of functions or of a solver.

    An open-loop solution becomes `sample(time)`; one with feedback also a controller, `init` and
    `step(measurement, time)` -> control; those of phases `sample(time)`, which finds the phase, `sample_<phase>` of
    each, and such a controller; functions themselves; a problem a solver for re-planning,
    `solve(initial state, parameters, ...)` -> plan.

    Args:
        what: a `Solution`, a `PhasesSolution`, a `casadi.Function`, a list of them, or a `Problem`.
        directory: folder to make; its parent must exist.
        name: of the package, an identifier in C; None: from the directory.
        precision: "double" or "single".
        overwrite: replace a package that is there: the files it consists of, and what was built of them. Other files in
            its folder stay.
        period: of a controller [s]: gains and transitions are made for samples of this period, not of phases; None: any
            time between two steps, everything computed along the nominal as it is needed.
        limits: of the control that a controller gives out: None (not limited, not even to the bounds of the problem),
            "bounds" (those of the problem), or a dict of control to (lower, upper). A nominal control outside of them
            is a warning.
        feedback: whether a solution with feedback is exported as a controller; False: its histories only.
        largest_spread: of a controller: the largest factor between the standard deviations of the loop as it flies with
            these gains (interpolated between the nodes, or held over a period) and those that the solution predicts;
            where it is more, nothing is exported. float("inf"): whatever it is.
        ranges: of inputs of functions by name, (lower, upper): where C is compared with Python; None: normal numbers.
        units: of inputs and outputs of functions by name, for the comments.
        tolerance: largest relative deviation of C from Python; None: 1e-12, in single precision 1e-2, of solvers 1e-8.
        method: of a problem: "sqpmethod" (self-contained), or "ipopt" or "fatrop" (to be linked).
        options: of a problem: those of the mesh as in `solve` (intervals, control, grid, ...), and plugin_options.

    Returns:
        The package: `.build()`, `.check()`, `.time()`, `.python()`.

    Raises:
        ExportError: something has no C code, a name, a precision or a folder is not possible, the loop does not hold
            what the solution predicts.
        ProblemError: an option of another kind (overwrite, feedback, ranges, units), limits of unknown controls or that
            mean nothing, values of the options of the mesh that mean nothing.
    """
    target, package = check_settings(directory, name=name, precision=precision, overwrite=overwrite, period=period)
    allowed = TOLERANCES[precision] if tolerance is None else _positive("tolerance", tolerance)
    given = {"period": period, "limits": limits, "ranges": ranges, "units": units}
    usual = isinstance(largest_spread, float) and largest_spread == LARGEST_SPREAD
    given |= {
        "largest_spread": None if usual else largest_spread,
        "feedback": None if feedback is True else feedback,
        "method": None if isinstance(method, str) and method == "sqpmethod" else method,
    }
    if isinstance(what, Solution):
        _check_options("a solution", {**given, **options}, ("period", "limits", "feedback", "largest_spread"))
        _check_spread(largest_spread)
        content = _solution(what, precision, allowed, period, limits, feedback, largest_spread)
    elif isinstance(what, PhasesSolution):
        _check_options("a solution of phases", {**given, **options}, ("limits", "feedback", "largest_spread"))
        _check_spread(largest_spread)
        content = _phases(what, precision, allowed, limits, feedback, largest_spread)
    elif isinstance(what, Problem):
        _check_options("a problem", given, ("method",), OPTIONS)
        content = _problem(what, precision, method, options, tolerance)
    else:
        _check_options("functions", {**given, **options}, ("ranges", "units"))
        content = _functions(what, ranges or {}, units or {}, allowed)
    check_identifiers(package, content.laws)
    linked = content.linking.header if content.linking is not None else ""
    generated = generate(package, content.laws, precision, linked)
    return _written(package, target, precision, content, generated, tolerance)


def check_settings(
    directory: str | os.PathLike[str],
    *,
    name: str | None = None,
    precision: str = "double",
    overwrite: bool = False,
    period: float | None = None,
) -> tuple[Path, str]:
    """What can be checked of the arguments of `export_c` before anything is solved.

    Returns:
        The folder, the name of the package.

    Raises:
        ExportError: one of them is not possible.
    """
    _check_choice("precision", precision, tuple(PRECISIONS))
    if period is not None:
        _positive("period", period)
    target = check_folder(directory, overwrite)
    package = package_name(target.name) if name is None else check_name(name)
    check_names(target, package_files(package))
    return target, package


def _written(
    package: str, target: Path, precision: str, content: Content, generated: Generated, tolerance: float | None
) -> CPackage:
    """All files, in their folder."""
    laws, sizes = content.laws, generated.sizes
    version, date = _version(), _today()
    casadi, real = ca.CasadiMeta.version(), PRECISIONS[precision]
    written = f"Written by covocp {version} (CasADi {casadi}) on {date}; real numbers are {real}."
    about = (content.title, written)
    work = {law.name: _work_bytes(law, sizes[law.name], precision) for law in laws}
    linking = content.linking
    texts = (
        header(package, about, laws, generated, real),
        source(package, laws, sizes),
        generated.source,
        self_test(package, laws, precision, tolerance),
        cmake_lists(package, precision, linking.cmake(package) if linking else ""),
        readme(package, about, laws, work, precision, linking.words if linking else "", alone=generated.alone),
    )
    files = dict(zip(package_files(package), texts, strict=True))
    mark = {"name": package, "covocp": version, "casadi": casadi, "date": date, "precision": precision}
    write_folder(target, files, {**mark, "laws": [law.name for law in laws]})
    return CPackage(
        name=package,
        directory=target,
        precision=precision,
        laws=laws,
        work_bytes=work,
        sources=Sources(
            directory=target,
            name=package,
            linking=linking,
            single=precision == "single",
        ),
        tolerance=tolerance,
    )


def _solution(
    solution: Solution,
    precision: str,
    tolerance: float,
    period: float | None,
    limits: Given,
    feedback: bool,
    largest_spread: float,
) -> Content:
    """The histories of a solution, and its controller where it has feedback."""
    if not solution.converged:
        warn_user(f"The solution that is exported did not converge: {solution.message}.")
    tables = history(solution, precision)
    laws = [sample_law(solution, tables, tolerance)]
    if solution.loop is not None and feedback:
        check_designed(solution)
        check_begins(solution, "A controller")
        design = design_of(solution, limits)
        check_measured([solution.name], [design])
        warn_outside(design.statement, design.limits, tables)
        if period is None:
            check_flight(interpolated_flight(solution), largest_spread, None)
            laws.append(controller_law(design, tables, tolerance))
        else:
            samples = discretised(design, tables, _positive("period", period))
            check_flight(sampled_flight(solution, samples), largest_spread, period)
            check_lag(solution, samples)
            laws.append(sampled_law(design, tables, samples, tolerance))
    elif period is not None or limits is not None:
        raise _no_controller("period= and limits= are", solution.name, feedback)
    return Content(laws=tuple(laws), title=f"{solution.name or 'Solution'}: {', '.join(law.name for law in laws)}.")


def _phases(
    solution: PhasesSolution,
    precision: str,
    tolerance: float,
    limits: Given,
    feedback: bool,
    largest_spread: float,
) -> Content:
    """The histories of all phases, and the controller that flies through them where they have feedback."""
    if not solution.converged:
        warn_user(f"The solution that is exported did not converge: {solution.message}.")
    found = histories(solution, precision, tolerance)
    laws = list(found.laws)
    if feedback and any(phase.loop is not None for phase in solution):
        if len(solution.links) != len(solution) - 1:
            raise ExportError(
                "The controller of these phases cannot be exported: the solution does not know them.",
                expected="a solution with its phases",
                received=f"'{solution.name}', read from a file",
                remedy="load(path, phases) with the phases that were solved",
            )
        for phase in solution:
            check_designed(phase)
        designs = [design_of(phase, own) for phase, own in zip(solution, limits_of_each(solution, limits), strict=True)]
        check_measured([phase.name for phase in solution], designs)
        check_first_readings(solution, designs)
        for phase, design, own in zip(solution, designs, found.tables, strict=True):
            warn_outside(design.statement, design.limits, own)
            check_flight(interpolated_flight(phase), largest_spread, None)
        legs = legs_of(solution, designs, found.tables, found.parts, found.starts)
        laws.append(phases_controller(legs, solution.duration, found.tables[0].margin, tolerance))
    elif limits is not None:
        raise _no_controller("limits= are", solution.name, feedback)
    title = f"{solution.name or 'Phases'}: {', '.join(law.name for law in laws)}."
    return Content(laws=tuple(laws), title=title)


def _no_controller(what: str, name: str, feedback: bool) -> ExportError:
    """The error for options of a controller where none is made."""
    return ExportError(
        f"{what} those of a controller.",
        expected="a solution of a problem with minimize_expected()",
        received=f"'{name}'" + ("" if feedback else " with feedback=False") + ": no controller is made",
        remedy="leave them out",
    )


def _problem(
    problem: Problem, precision: str, method: str, options: dict[str, Any], tolerance: float | None
) -> Content:
    """The solver of a problem."""
    if precision != "double":
        raise ExportError(
            "A solver is exported in double precision only.",
            expected="precision='double'",
            received=f"precision={precision!r}",
            remedy="leave precision= out; what it plans may be rounded afterwards",
        )
    law, linking = solver_law(problem, method, options)
    if tolerance is not None:
        law = replace(law, tolerance=tolerance)
    return Content(laws=(law,), title=f"{problem.name or 'Problem'}: solver ({method}).", linking=linking)


def _functions(what: Given, ranges: Mapping[str, Any], units: Mapping[str, str], tolerance: float) -> Content:
    """One or more functions."""
    functions = [what] if isinstance(what, ca.Function) else what
    listed = isinstance(functions, Sequence) and not isinstance(functions, str) and len(functions) > 0
    if not listed or not all(isinstance(entry, ca.Function) for entry in functions):
        raise ExportError(
            "This cannot be exported.",
            expected="a Solution, a casadi.Function, a list of them, or a Problem",
            received=f"{type(what).__name__}: {what!r}"[:100],
            remedy=getattr(
                what,
                "instead",
                "make a casadi.Function of a law: casadi.Function('law', [x, t], [u], ['x', 't'], ['u'])",
            ),
        )
    laws = function_laws(functions, ranges, units, tolerance)
    return Content(laws=tuple(laws), title="Functions: " + ", ".join(law.name for law in laws) + ".")


def _work_bytes(law: Law, sizes: Sizes, precision: str) -> int:
    """Arrays that a call works in."""
    reals = sizes.reals + 1
    if law.kind in ("function", "controller", "solver"):
        reals += stacked_size(law.outputs)
    return BYTES[precision] * reals + 4 * (sizes.integers + 1) + POINTER * (sizes.arguments + sizes.results)


def _check_options(what: str, given: Mapping[str, Any], known: tuple[str, ...], all_: tuple[str, ...] = ()) -> None:
    """Refuse options that mean nothing to what is exported; `all_`: those that there are, where more are looked at."""
    allowed = all_ or ("name", "precision", "overwrite", "tolerance", *known)
    for name, value in given.items():
        if value is not None and name not in known:
            raise no_export_option(what, name, value, allowed)


def _check_spread(value: Given) -> None:
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not value >= 1:
        raise _wrong_number("largest_spread", "a number >= 1, or inf", value)


def _check_choice(name: str, value: Given, choices: tuple[str, ...]) -> None:
    if not isinstance(value, str) or value not in choices:
        raise ExportError(
            f"The option '{name}' has an unknown value.",
            expected=" or ".join(map(repr, choices)),
            received=repr(value)[:100],
            remedy=f"correct {name}=",
        )


def _positive(name: str, value: Given) -> float:
    """A positive, finite number."""
    if positive(value):
        raise _wrong_number(name, "a number > 0" + (" [s]" if name == "period" else ""), value)
    return float(value)


def _wrong_number(name: str, expected: str, received: Given) -> ExportError:
    """An option that is not the number that it must be."""
    headline = f"The option '{name}' is not " + ("a positive number." if "> 0" in expected else "such a number.")
    return ExportError(headline, expected=expected, received=repr(received)[:100], remedy=f"correct {name}=")


def _version() -> str:
    """Of the toolbox."""
    try:
        return importlib.metadata.version("covocp")
    except importlib.metadata.PackageNotFoundError:
        return "(not installed)"


def _today() -> str:
    """The date, or that of SOURCE_DATE_EPOCH for builds that can be repeated."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    moment = (
        datetime.datetime.fromtimestamp(int(epoch), datetime.UTC)
        if epoch.isdigit()
        else datetime.datetime.now(datetime.UTC)
    )
    return moment.date().isoformat()
