"""The methods, looked up by name."""

from __future__ import annotations

import importlib
import inspect
from typing import Any

from covocp.base.errors import ProblemError, spelling

METHODS = {
    "ipopt": "covocp.solvers.ipopt",
    "gradient": "covocp.solvers.gradient",
    "reduced": "covocp.solvers.reduced",
    "auto": "covocp.solving.automatic",
}


def methods() -> tuple[str, ...]:
    """Names of the methods installed."""
    return tuple(METHODS)


def method_options(method: str) -> dict[str, Any]:
    """Options of a method besides those of the mesh, with their defaults."""
    parameters = inspect.signature(importlib.import_module(METHODS[method]).prepare).parameters
    return {name: p.default for name, p in parameters.items() if p.kind is p.KEYWORD_ONLY}


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
