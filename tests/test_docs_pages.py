"""The pages of docs run from top to bottom: each ```python block after those before it, with nothing else at hand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import covocp as co

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGES = ("attitudes", "closed_loop", "data", "files", "instants", "phases", "refinement")
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
# A simulation says the same of fewer runs, with wider bands.
RUNS = re.compile(r"\b\d{3,}(?=, seed=)")
# What a page says of the meshes of a solution that refined itself.
MESHES = re.compile(r"print\((\w+)\.stats\[\"mesh_intervals\"\].*?# (\(.*\))$", re.MULTILINE)


def said(text: str) -> list[int]:
    """Numbers of intervals in a comment, which may go on with the errors."""
    return [int(number) for number in re.findall(r"(?<![\d.e-])\d+(?![\d.e])", text)]


@pytest.mark.filterwarnings("ignore::covocp.CovocpWarning")
@pytest.mark.parametrize("page", PAGES)
def test_the_blocks_of_a_page_run_in_their_order(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    names: dict[str, object] = {"__name__": page}
    for code in BLOCK.findall(text):
        exec(compile(RUNS.sub("20", code), f"{page}.md", "exec"), names)
        for name, comment in MESHES.findall(code):
            refined = names[name]
            assert isinstance(refined, co.Solution | co.PhasesSolution)
            found = said(str(refined.stats["mesh_intervals"]))
            assert said(comment) == pytest.approx(found, abs=2)
