"""The one form of a late import: what stands above in the layers, or is heavy, is loaded when it is first used."""

from __future__ import annotations

import importlib
from typing import Any


def later(module: str) -> Any:
    """A module of the package by its name below `covocp`."""
    return importlib.import_module(f"covocp.{module}")
