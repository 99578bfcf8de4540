"""The forms of a late import: what stands above in the layers, or is seldom needed, is loaded when it is first used.

What stands above is asked for by `later`; what stands below, and few solves need, is imported in the function that
needs it, where its types are known.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def later(module: str) -> Any:
    """A module of the package by its name below `covocp`."""
    return importlib.import_module(f"covocp.{module}")


def attributes(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package some of whose names are loaded when they are first asked for.

    Args:
        package: its full name.
        modules: by name, the module below `covocp` that has it.
    """

    def found(name: str) -> Any:
        if name in modules:
            return getattr(later(modules[name]), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return found
