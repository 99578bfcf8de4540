"""The examples of docs/blocks run, and print what stands there; functions have the arguments that it says.

Each ```python block of a page is run after the ones before it; a ```text block that follows it is its output.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

PAGES = sorted((Path(__file__).resolve().parents[2] / "docs" / "blocks").glob("*.md"))
CALL = re.compile(r"`(\w+)\(([^`]*)\)`")
FENCE = re.compile(r"^```(python|text)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def examples(page: Path) -> list[tuple[str, str | None]]:
    """Codes of a page, each with its output."""
    result: list[tuple[str, str | None]] = []
    for kind, content in FENCE.findall(page.read_text(encoding="utf-8")):
        if kind == "python":
            result.append((content, None))
        elif result:
            result[-1] = (result[-1][0], content)
    return result


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_examples_print_what_the_page_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = examples(page)
    assert any(output for _, output in found), "a page has at least one example with its output"
    names: dict[str, object] = {"__name__": page.stem}
    for code, output in found:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, str(page), "exec"), names)
        if output is not None:
            assert printed.getvalue().rstrip() == output.rstrip()


def arguments(function: Any) -> list[tuple[str, Any]]:
    """Names and defaults of what a function takes; * stands for itself."""
    result: list[tuple[str, Any]] = []
    for p in inspect.signature(function).parameters.values():
        star = {p.VAR_POSITIONAL: "*", p.VAR_KEYWORD: "**"}.get(p.kind, "")
        if p.kind is p.KEYWORD_ONLY and ("*", p.empty) not in result:
            result.append(("*", p.empty))
        result.append((star + p.name, p.default))
    return result


def written(text: str) -> list[tuple[str, Any]]:
    """Those that a page writes: name, name=default, or name= where there is none."""
    pairs = [word.partition("=")[::2] for word in text.split(", ")]
    return [(name, eval(value, {"inf": np.inf}) if value else inspect.Parameter.empty) for name, value in pairs]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_functions_have_the_arguments_that_the_page_says(page):
    module = importlib.import_module(f"covocp.blocks.{page.stem}")
    for name, text in CALL.findall(page.read_text(encoding="utf-8")):
        function = getattr(module, name, None)
        if callable(function) and "..." not in text:
            keywords = [entry for entry in written(text) if entry[0]]
            taken = arguments(function)
            if text.endswith("=") or "=, " in text:  # all by name, as the fields of a record
                taken = [entry for entry in taken if entry[0] != "*"]
            assert keywords == taken, name
