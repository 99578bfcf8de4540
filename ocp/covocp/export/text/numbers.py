"""Pieces of C: numbers, initialisers, comments, the names of types and constants."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable

import numpy as np

from covocp.base.matrices import Array
from covocp.export.laws.law import CODES, STATUSES, Law, Port

WIDTH = 110


def real(value: float) -> str:
    """A number as a constant of C that has the same value."""
    if np.isnan(value):
        return "NAN"
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    text = repr(float(value))
    return text if any(c in text for c in ".en") else f"{text}.0"


def row(values: Iterable[float]) -> str:
    """Numbers in braces."""
    return "{" + ", ".join(real(v) for v in values) + "}"


def wrapped(text: str, indent: int = 4) -> str:
    """A long initialiser in lines."""
    return "\n".join(
        textwrap.wrap(
            text, WIDTH, initial_indent=" " * indent, subsequent_indent=" " * (indent + 1), break_long_words=False
        )
    )


def table(name: str, values: Array, kind: str, constants: str = "static const") -> str:
    """A constant array of one or two dimensions."""
    dimensions = "".join(f"[{size}]" for size in values.shape)
    rows = [row(values)] if values.ndim == 1 else [row(v) for v in values]
    inner = ",\n".join(wrapped(r) for r in rows)
    body = inner.strip() if values.ndim == 1 else f"{{\n{inner}\n}}"
    return f"{constants} {kind} {name}{dimensions} = {body};"


def comment(lines: Iterable[str], indent: str = "") -> str:
    """Lines as one comment; what would end it is changed."""
    safe = [line.replace("*/", "* /").replace("/*", "/ *").encode("ascii", "replace").decode() for line in lines]
    wrapped_lines = [
        part for line in safe for part in (textwrap.wrap(line, WIDTH - 4 - len(indent), subsequent_indent="  ") or [""])
    ]
    if len(wrapped_lines) == 1:
        return f"{indent}/* {wrapped_lines[0]} */"
    inner = "\n".join(f"{indent} * {line}".rstrip() for line in wrapped_lines)
    return f"{indent}/*\n{inner}\n{indent} */"


def constant(package: str, *parts: str) -> str:
    """Name of a constant."""
    return "_".join([package, *parts]).upper()


def size_names(package: str, law: Law) -> dict[str, tuple[str, ...]]:
    """Constants of the sizes of the ports of a law, by name: rows, or rows and columns; different in capitals too."""
    taken: set[str] = set()
    names: dict[str, tuple[str, ...]] = {}
    for port in (*law.inputs, *law.fields):
        if port.scalar or port.name in names:
            continue
        base, number = constant(package, law.name, port.name), 2
        while base in taken:
            base, number = constant(package, law.name, port.name, str(number)), number + 1
        taken.add(base)
        names[port.name] = (base,) if port.columns == 1 else (f"{base}_ROWS", f"{base}_COLUMNS")
    return names


def described(port: Port) -> str:
    """Unit, meaning and entries of a port, for a comment."""
    parts = [" ".join(part for part in (f"[{port.unit}]" if port.unit else "", port.about) if part)]
    if port.entries:
        listed = ", ".join(port.entries)
        parts[0] = f"{parts[0]} ({listed})" if parts[0] else listed
    if port.columns > 1:
        parts.append(f"{port.rows} x {port.columns}, row by row")
    return "; ".join(part for part in parts if part)


def code(package: str, status: str) -> str:
    """Name of a status code."""
    return constant(package, status)


def status_lines(package: str, names: Iterable[str]) -> list[str]:
    """Definitions of status codes."""
    return [f"#define {code(package, n)} {CODES[n]} /* {STATUSES[n]} */" for n in sorted(names, key=CODES.__getitem__)]
