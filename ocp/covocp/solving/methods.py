"""The methods, looked up by name, and their options."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from covocp.base.checks import check_kind
from covocp.base.errors import ProblemError, no_option, spelling
from covocp.base.expressions import Given
from covocp.problem.builder import Problem
from covocp.transcription.mesh import Options

METHODS = {
    "ipopt": "covocp.solvers.ipopt",
    "gradient": "covocp.solvers.gradient",
    "reduced": "covocp.solvers.reduced",
    "auto": "covocp.solving.automatic",
}

# Arguments of `solve` beside the options of mesh and method.
ARGUMENTS = ("method", "guess", "nominal", "progress", "allow_failure", "parameters", "starts", "seed")
NOMINALS = ("combined", "deterministic")


def methods() -> tuple[str, ...]:
    """Names of the methods installed."""
    return tuple(METHODS)


def method_options(method: str) -> dict[str, Any]:
    """Options of a method besides those of the mesh, with their defaults."""
    parameters = inspect.signature(importlib.import_module(METHODS[method]).prepare).parameters
    return {name: p.default for name, p in parameters.items() if p.kind is p.KEYWORD_ONLY}


def mesh_options(method: str) -> tuple[str, ...]:
    """Options of the mesh that a method takes."""
    not_taken = getattr(importlib.import_module(METHODS[method]), "NOT_TAKEN", ())
    return tuple(field.name for field in fields(Options) if field.name not in not_taken)


def check_method(method: str) -> None:
    """There must be a method of that name.

    Raises:
        ProblemError: there is none.
    """
    if method not in METHODS:
        raise ProblemError(
            "There is no such method.",
            expected="one of " + ", ".join(repr(name) for name in METHODS),
            received=repr(method),
            remedy=spelling(method, METHODS, "correct method="),
        )


def check_problem(problem: Given) -> None:
    """What is solved or compared must be a problem.

    Raises:
        ProblemError: it is something else.
    """
    check_kind(problem, Problem, "pass the Problem itself (solutions go into guess=)")


def divided_options(method: str, nominal: Given, options: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of the mesh, and those of the method.

    Raises:
        ProblemError: one is neither, or the nominal is unknown.
    """
    known, own = {field.name for field in fields(Options)}, method_options(method)
    for name in options:
        if name not in known and name not in own:
            taken = [*mesh_options(method), *own]
            raise no_option(f"The method '{method}'", name, options[name], taken, ARGUMENTS)
    if nominal not in NOMINALS:
        raise ProblemError(
            "The option 'nominal' has an unknown value.",
            expected="'combined' or 'deterministic'",
            received=repr(nominal),
            remedy="correct nominal=; evaluate(problem, nominal=...) takes any given nominal",
        )
    return {k: v for k, v in options.items() if k in known}, {k: v for k, v in options.items() if k in own}
