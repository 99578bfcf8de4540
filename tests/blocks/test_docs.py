"""The examples of docs/blocks run, and print what stands there.

Each ```python block of a page is run after the ones before it; a ```text block that follows it is its output.
"""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

PAGES = sorted((Path(__file__).resolve().parents[2] / "docs" / "blocks").glob("*.md"))
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
