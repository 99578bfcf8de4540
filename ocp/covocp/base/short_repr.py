"""A representation of one line for what holds arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np

LONGEST = 120
# Characters of one field.
LONGEST_FIELD = 40
# Numbers in a row up to this many are shown one by one.
FEW = 4


def short_repr(thing: Any) -> str:
    """One line of at most 120 characters for a dataclass: `__repr__ = short_repr` in its body.

    Fields at their defaults are left out, arrays of more than a few numbers are their shapes, other dataclasses their
    names; the fields at the end are left out where all of them are too long for a line.

    Args:
        thing: an object of a dataclass.

    Returns:
        Such as Trajectory(x=array(101, 2), u=array(101, 1), e=array(101, 3), duration=10).
    """
    name = type(thing).__qualname__
    shown = [
        f"{f.name}={_field(getattr(thing, f.name))}"
        for f in fields(thing)
        if f.repr and not _same(getattr(thing, f.name), f.default)
    ]
    line = f"{name}({', '.join(shown)})"
    while len(line) > LONGEST and shown:
        shown.pop()
        line = f"{name}({', '.join([*shown, '...'])})"
    return line


def _same(value: Any, default: Any) -> bool:
    """Whether a field holds its default; arrays are not compared."""
    if default is MISSING:
        return False
    return value is default or (isinstance(default, (bool, int, float, str)) and _plain(value) and value == default)


def _plain(value: Any) -> bool:
    """Whether a value is a number, a truth or a word."""
    return isinstance(value, (bool, int, float, str))


def _field(value: Any) -> str:
    """A value in a few characters."""
    text = _value(value)
    text = " ".join(text.split())
    return text if len(text) <= LONGEST_FIELD else text[: LONGEST_FIELD - 3] + "..."


def _value(value: Any) -> str:
    if isinstance(value, np.ndarray):
        if 0 < value.size <= FEW:
            return str(np.array2string(value, separator=", ", formatter={"float_kind": lambda v: f"{v:.6g}"}))
        return f"array({', '.join(map(str, value.shape))}{',' if value.ndim == 1 else ''})"
    if isinstance(value, (ca.DM, ca.SX, ca.MX)):
        return f"{type(value).__name__}({value.shape[0]}, {value.shape[1]})"
    if isinstance(value, ca.Function):
        return f"Function {value.name()}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return "{" + ", ".join(map(str, value)) + "}"
    if isinstance(value, (list, tuple)):
        return _sequence(value)
    if is_dataclass(value) and not isinstance(value, type):
        return f"{type(value).__name__}(...)"
    if callable(value) and hasattr(value, "__name__"):
        return str(value.__name__)
    return repr(value)


def _sequence(values: Any) -> str:
    """A list or a tuple: what it holds where that is short, else how much."""
    left, right = "()" if isinstance(values, tuple) else "[]"
    if len(values) <= FEW:
        shown = left + ", ".join(map(_value, values)) + ("," if len(values) == 1 and left == "(" else "") + right
        if len(shown) <= LONGEST_FIELD:
            return shown
    return f"{left}{len(values)} entries{right}"
