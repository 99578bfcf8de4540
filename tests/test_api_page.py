"""docs/api.md against the code: every public name, argument and option is on the page, and nothing else.

A section begins with "## `Class`" or "## Options of `what`"; the first column of its table holds the names: methods and
functions with their arguments and defaults, data by name, options as name=default.
"""

from __future__ import annotations

import importlib
import inspect
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import pytest

import covocp as co
from covocp.plot.figure import plot_solutions
from covocp.solving.methods import method_options
from covocp.solving.solver import Solver
from covocp.transcription.mesh import Options

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "api.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.*)\n((?:(?!^## ).*\n)*)", PAGE, re.MULTILINE))
CODE = re.compile(r"`([^`]+)`")
# Classes that a user meets without making them.
MET = {
    "EstimationCovariance": "covocp.problem.estimation_covariance",
    "ClosedLoopCovariance": "covocp.problem.closed_loop_covariance",
    "Sample": "covocp.solution.sample",
    "Optimality": "covocp.extremal.optimality",
    "ClosedLoop": "covocp.extremal.closed_loop",
    "Row": "covocp.solving.comparison",
    "MeanEffect": "covocp.extremal.mean_effect",
    "Count": "covocp.simulation.counts",
    "Share": "covocp.simulation.chances",
    "Reached": "covocp.solution.chances",
    "Verdict": "covocp.simulation.verdict",
    "Check": "covocp.export.compiled.package",
    "Timing": "covocp.export.compiled.package",
}
# By the user: their data are set on construction.
MADE = ("Free", "Gain", "Phases", "Problem", "Solver", "SolveError", "Interrupted")
HELD = (
    "Solution",
    "PhasesSolution",
    "MonteCarlo",
    "PhasesMonteCarlo",
    "CPackage",
    "Comparison",
    "Certificate",
    "Worth",
    "LawSimulation",
    "SampledSimulation",
)


def listed(section: str) -> list[str]:
    """What the first column of the tables of a section names."""
    rows = [line for line in SECTIONS[section].splitlines() if line.startswith("| `")]
    return [name for row in rows for name in CODE.findall(row.split(" | ")[0])]


def default(value: Any) -> str:
    """A default as the page writes it."""
    if isinstance(value, float):
        return repr(value) if value in (float("inf"), -float("inf")) or value.is_integer() else f"{value:.4g}"
    return repr(value).replace("'", '"')


def written(name: str, function: Any) -> str:
    """A function with its arguments and defaults."""
    words: list[str] = []
    for p in inspect.signature(function).parameters.values():
        if p.name == "self":
            continue
        if p.kind is p.KEYWORD_ONLY and not any(word.startswith("*") for word in words):
            words.append("*")
        stars = {p.VAR_POSITIONAL: "*", p.VAR_KEYWORD: "**"}.get(p.kind, "")
        words.append(stars + p.name + ("" if p.default is p.empty else f"={default(p.default)}"))
    return f"{name}({', '.join(words)})"


def named(name: str) -> Any:
    """The class of a section."""
    return getattr(importlib.import_module(MET[name]) if name in MET else co, name)


def members(cls: Any) -> set[str]:
    """Public methods with their arguments, properties and data by name, what a class adds to Python's in brackets."""
    found = set()
    own = [base for base in cls.__mro__ if base.__module__.partition(".")[0] == co.__name__]
    for name, value in [entry for base in reversed(own) for entry in vars(base).items()]:
        function = value.__func__ if isinstance(value, staticmethod) else value
        if not name.startswith("_"):
            found.add(written(name, function) if inspect.isfunction(function) else name)
    if is_dataclass(cls):
        found |= {field.name for field in fields(cls) if not field.name.startswith("_")}
    return found


def made(name: str) -> set[str]:
    """Public data that a new object has."""
    ocp = co.Problem(1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    example = {"Problem": ocp, "SolveError": co.SolveError(""), "Interrupted": co.Interrupted("")}
    thing = Solver(ocp) if name == "Solver" else example.get(name)
    return {key for key in vars(thing) if not key.startswith("_")} if thing is not None else set()


def test_every_public_name_is_listed_with_its_arguments():
    expected = set()
    for name in co.__all__:
        value = getattr(co, name)
        if inspect.isfunction(value) or name in MADE:
            expected.add(written(name, value))
        else:
            expected.add(name)
    found = listed("Names of `covocp`")
    assert sorted(found) == sorted(expected)


@pytest.mark.parametrize("name", sorted({*HELD, *MADE, *MET} - {"Free", "Gain"}))
def test_every_method_and_every_datum_is_listed(name):
    found = [entry for entry in listed(f"`{name}`") if not entry.startswith("[")]
    assert sorted(found) == sorted(members(named(name)) | made(name))
    assert ("__getitem__" in vars(named(name))) == any(entry.startswith("[") for entry in listed(f"`{name}`"))


def test_every_option_is_listed_with_its_default():
    starts = inspect.signature(Solver.solve).parameters
    options = {
        "the mesh": {f.name: f.default for f in fields(Options)},
        "a start": {name: starts[name].default for name in ("guess", "starts", "seed")},
        **{f"`{method}`": method_options(method) for method in co.methods()},
        "a figure": {
            n: p.default for n, p in inspect.signature(plot_solutions).parameters.items() if p.kind is p.KEYWORD_ONLY
        },
    }
    for title, own in options.items():
        assert sorted(listed(f"Options of {title}")) == sorted(f"{n}={default(value)}" for n, value in own.items())


def test_no_section_is_left_over():
    classes = {f"`{name}`" for name in {*HELD, *MADE, *MET} - {"Free", "Gain"}}
    others = {"Names of `covocp`", "Command line"}
    assert {title for title in SECTIONS if not title.startswith("Options of ")} == classes | others


def test_the_namespace_shows_what_is_meant_and_nothing_else():
    shown = {name for name in dir(co) if not name.startswith("__")}
    assert shown == set(co.__all__)
    assert all(hasattr(co, name) for name in dir(co))
    assert len(co.__all__) == len(shown)
    assert all(f"`{name}`" in co.__doc__ for name in co.__all__ if inspect.isfunction(getattr(co, name)))


def test_what_may_be_a_list_in_dynamics_is_what_the_page_says() -> None:
    """A rate is one expression; its noise may be a list that mixes numbers and expressions."""
    (row,) = (line for line in SECTIONS["`Problem`"].splitlines() if line.startswith("| `dynamics("))
    rate, noise = row.split("; noise: ")
    assert "not a list" in rate
    assert "as a list too, which may mix numbers and expressions" in noise
    problem = co.Problem(1.0)
    x, k = problem.state("x", 2, initial=0.0, variance=1.0), problem.parameter("k", 2.0)
    with pytest.raises(co.ProblemError, match=r"(?s)rate of 'x' is not an expression.*casadi\.vertcat.*not lists"):
        problem.dynamics(x, [x[1], -k * x[0]])
    problem.dynamics(x, ca.vertcat(x[1], -k * x[0]), noise=[0.1, k])
