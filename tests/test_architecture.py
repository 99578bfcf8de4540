"""Imports run one way: a planted upward import in any layer breaks the contract."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
LAYERS = [[room.strip() for room in line.split("|")] for line in CONTRACTS[0]["layers"]]
ROOMS = [room for line in LAYERS for room in line]


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A copy of the package with its contracts."""
    copy = tmp_path_factory.mktemp("checkout")
    for name in ("ocp", "models", "solvers"):
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", copy)
    return copy


def lint(checkout):
    """What the import checker says of a checkout, and whether it keeps its contracts."""
    program = Path(sys.executable).with_name("lint-imports")
    environment = os.environ | {"PYTHONPATH": str(checkout / "ocp")}
    command = [str(program), "--no-cache"]
    run = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, timeout=120)
    return run.returncode == 0, run.stdout + run.stderr


def planted(checkout, room, line):
    """A file with one more line in a room, and what the checker says then."""
    file = checkout / "ocp" / "covocp" / room / "planted.py"
    file.write_text(line + "\n", encoding="utf-8")
    try:
        return lint(checkout)
    finally:
        file.unlink()


def test_every_folder_has_its_place():
    on_disk = {path.name for path in (ROOT / "ocp" / "covocp").iterdir() if path.is_dir() and path.name[0] != "_"}
    assert on_disk == set(ROOMS)
    assert CONTRACTS[0]["exhaustive"]


def test_the_checkout_keeps_its_contracts(checkout):
    kept, said = lint(checkout)
    assert kept, said


@pytest.mark.parametrize("below", range(1, len(LAYERS)))
def test_an_upward_import_breaks_the_contract(checkout, below):
    room, above = LAYERS[below][-1], LAYERS[below - 1][0]
    kept, said = planted(checkout, room, f"import covocp.{above}")
    assert not kept
    assert f"covocp.{room}.planted -> covocp.{above}" in said


def test_an_import_of_a_sibling_breaks_the_contract(checkout):
    for line in LAYERS:
        if len(line) > 1:
            kept, said = planted(checkout, line[0], f"import covocp.{line[1]}")
            assert not kept
            assert f"covocp.{line[0]}.planted -> covocp.{line[1]}" in said


def test_a_new_folder_must_be_placed(checkout):
    new = checkout / "ocp" / "covocp" / "attic"
    new.mkdir()
    (new / "__init__.py").write_text("", encoding="utf-8")
    try:
        kept, said = lint(checkout)
    finally:
        shutil.rmtree(new)
    assert not kept
    assert "attic" in said


def test_methods_do_not_know_each_other_and_problems_no_mesh(checkout):
    for room, line in (
        ("problem", "import covocp.transcription.mesh"),
        ("solvers/gradient", "import covocp.solvers.ipopt"),
    ):
        kept, said = planted(checkout, room, line)
        assert not kept, said
