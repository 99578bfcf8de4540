"""What the documentation says of the code is true of it: paths, layers, rooms, and the names of the reference."""

import ast
import importlib
import re
import tomllib
from pathlib import Path

import pytest

import covocp as co

ROOT = Path(__file__).resolve().parent.parent
HOUSE = ROOT / "ocp" / "covocp"
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.glob("*.md"), *DOCS.glob("blocks/*.md")]
TEXTS = [*PAGES, *DOCS.glob("reference/*.rst"), *DOCS.glob("scripts/*/*")]
ARCHITECTURE = (DOCS / "architecture.md").read_text(encoding="utf-8")
LAYERS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"][0]
REFERENCE = "".join(path.read_text(encoding="utf-8") for path in DOCS.glob("reference/*.rst"))
FOLDERS = "ocp|models|solvers|tests|examples|benchmarks|docs"
WRITTEN_BY_THE_BUILD = ("docs/_build", "docs/tutorial", "docs/howto", "docs/gallery")


@pytest.mark.parametrize("page", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_path_and_module_that_is_named_exists(page):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(rf"`((?:{FOLDERS})/[\w./]*)`", text):
        assert (ROOT / name).exists() or name.startswith(WRITTEN_BY_THE_BUILD), name
    for name in set(re.findall(r"\bcovocp(?:\.\w+)+", text)):
        assert resolves(name), name


def resolves(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    thing: object = co
    for position, word in enumerate(parts := name.split(".")[1:], start=1):
        try:
            thing = importlib.import_module("covocp." + ".".join(parts[:position]))
        except ModuleNotFoundError:
            if not hasattr(thing, word):
                return False
            thing = getattr(thing, word)
    return True


def marked(comment: str) -> str:
    """The paragraph of the page on architecture that follows a comment."""
    return ARCHITECTURE.partition(f"<!-- {comment}")[2].partition("-->\n")[2].partition("\n\n")[0]


def test_the_page_on_architecture_shows_the_layers_of_the_contract():
    assert marked("layers").splitlines() == ["```text", *LAYERS["layers"], "```"]


def test_the_page_on_architecture_says_what_the_rooms_say_of_themselves():
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", marked("rooms"), re.MULTILINE))
    rooms = [room.strip() for line in LAYERS["layers"] for room in line.split("|")]
    assert list(rows) == rooms
    for room in rooms:
        said = ast.get_docstring(ast.parse((HOUSE / room / "__init__.py").read_text(encoding="utf-8")))
        assert said.splitlines()[0] == rows[room]


def test_the_reference_has_every_public_name_model_and_block():
    documented = set(re.findall(r"auto\w+:: ([\w.]+)", REFERENCE))
    wanted = {f"covocp.{name}" for name in co.__all__}
    wanted |= {f"covocp.models.{path.stem}" for path in (ROOT / "models").glob("*.py") if path.stem != "__init__"}
    wanted |= {
        f"covocp.blocks.{name}"
        for name in ("kalman", "riccati", "theta_d", "theta_d_series", "sdre", "peak_seeking", "so3")
    }
    assert wanted <= documented


@pytest.mark.parametrize("name", ["kalman", "riccati", "theta_d", "so3"])
def test_the_reference_lists_what_a_block_takes_from_its_parts(name):
    code = ast.parse((HOUSE / "blocks" / f"{name}.py").read_text(encoding="utf-8"))
    imported = [entry for line in code.body if isinstance(line, ast.ImportFrom) for entry in line.names]
    given = {entry.name for entry in imported if entry.name == entry.asname}
    section = REFERENCE.partition(f"automodule:: covocp.blocks.{name}\n")[2].partition("\n\n")[0]
    assert given <= set(re.findall(r"\w+", section))


def test_every_example_has_a_title_and_a_section():
    listed = (DOCS / "_extensions" / "scripts.py").read_text(encoding="utf-8")
    for path in (ROOT / "examples").glob("*.py"):
        title, line, *_ = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))).splitlines()
        assert line == "=" * len(title), path
        assert f'"{path.stem}"' in listed, path
