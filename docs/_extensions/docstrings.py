"""Docstrings as they stand, read as reStructuredText.

They are written to be read by `help()`: equations are indented, tables are those of Markdown, and |x|, x* and x_ mean
what they say. Here equations become literal blocks, tables become tables, and what reStructuredText would take for
markup outside of backticks is escaped. The sections (Args, Returns, ...) are left to napoleon, which comes after.
"""

from __future__ import annotations

import re
from dataclasses import is_dataclass
from itertools import groupby
from typing import Any

from docutils.nodes import Element
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

SECTION = re.compile(r"^(Args|Attributes|Returns|Yields|Raises|Warns):$")
CODE = re.compile(r"(``.+?``|`[^`]+`)")
STARRED = re.compile(r"^\s*\*{1,2}\w+:")
INITIAL = re.compile(r"^[A-Z]\. ")
MADE = ("Free", "Gain")  # dataclasses that the user makes
ITEM = re.compile(r"^(-|\d+\.) ")


def escaped(line: str) -> str:
    """A line without markup, but for what is in backticks."""
    start = STARRED.match(line)  # *args and **kwargs of an Args section: napoleon's
    head = start.group() if start else ""
    parts = CODE.split(line[len(head) :])
    plain = (re.sub(r"(?<=\w)_(?!\w)", r"\\_", re.sub(r"([\\*|])", r"\\\1", part)) for part in parts[::2])
    codes = (f"`{code}`" if code.startswith("`.") else code for code in parts[1::2])  # of whatever was just named
    return head + "".join(text + code for text, code in zip(plain, [*codes, ""], strict=True))


def table(lines: list[str]) -> list[str]:
    """A Markdown table as a list-table."""
    filled = [line for line in lines if not line.startswith("|--")]
    rows = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in filled]
    result = [".. list-table::", "   :header-rows: 1", ""]
    for row in rows:
        result += [f"   {'* -' if i == 0 else '  -'} {escaped(cell)}".rstrip() for i, cell in enumerate(row)]
    return ["", *result, ""]


def paragraph(lines: list[str]) -> list[str]:
    """A paragraph, of which runs of indented lines are equations unless it is a list."""
    if all(line.startswith("|") for line in lines) and len(lines) > 1:
        return table(lines)
    if ITEM.match(lines[0]):
        return [escaped(line) for line in lines]
    if INITIAL.match(lines[0]):  # the name of an author is no item of a list
        return ["\\" + escaped(lines[0]), *map(escaped, lines[1:])]
    result: list[str] = []
    for indented, group in groupby(lines, key=lambda line: line.startswith("  ")):
        run = list(group)
        result += ["", "::", "", *run, ""] if indented else [escaped(line) for line in run]
    return result


def rewritten(lines: list[str]) -> list[str]:
    """The text of a docstring."""
    first = next((i for i, line in enumerate(lines) if SECTION.match(line)), len(lines))
    result: list[str] = []
    for filled, run in groupby(lines[:first], key=lambda line: bool(line.strip())):
        result += paragraph(list(run)) if filled else [""]
    return [*result, *(escaped(line) for line in lines[first:])]


def process(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Rewrite a docstring in place."""
    lines[:] = rewritten(lines)


def signature(app: Sphinx, what: str, name: str, thing: Any, options: Any, *parts: Any) -> tuple[str, None] | None:
    """Results are not made by hand: what they hold is listed, their constructor is not."""
    return ("", None) if what == "class" and is_dataclass(thing) and thing.__name__ not in MADE else None


def public_name(app: Sphinx, env: BuildEnvironment, node: pending_xref, shown: Element) -> Element | None:
    """Where `solve` leads that is written outside of a module: to the one of `covocp`."""
    if node.get("refdomain") != "py" or node["reftype"] != "obj" or node.get("py:module"):
        return None
    name = f"covocp.{node['reftarget']}"
    return env.domains.python_domain.resolve_xref(env, node["refdoc"], app.builder, "obj", name, node, shown)


def setup(app: Sphinx) -> dict[str, Any]:
    """Before napoleon, which listens with the usual priority."""
    app.connect("autodoc-process-docstring", process, priority=400)
    app.connect("autodoc-process-signature", signature)
    app.connect("missing-reference", public_name)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
