"""A package that is overwritten: its own files are replaced, those of others stay, whatever happens on the way."""

import json
from pathlib import Path

import casadi as ca
import pytest

import covocp as co
from covocp.export import export_c

X = ca.SX.sym("x")
LAW = ca.Function("law", [X], [ca.sin(X)], ["x"], ["u"])
OTHER = ca.Function("other", [X], [ca.cos(X)], ["x"], ["u"])
MARK = "covocp-package.json"
OWN = {"CMakeLists.txt", "README.md", "main.c", "thing.c", "thing.h", "thing_casadi.c", MARK}


def content(folder):
    """All files below a folder by their path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def used(target):
    """A package with files of its user, and something built."""
    made = export_c(LAW, target)
    (target / "loop.c").write_text("int main(void) { return 0; }\n")
    (target / "flight").mkdir()
    (target / "flight" / "log.csv").write_text("0, 1\n")
    (target / "link").symlink_to("flight")
    (target / "build").mkdir()
    (target / "build" / "thing.o").write_text("old")
    return made


def test_the_mark_lists_the_files(tmp_path):
    made = export_c(LAW, tmp_path / "thing")
    assert set(json.loads((made.directory / MARK).read_text())["files"]) == OWN


def test_files_of_the_user_stay_where_a_package_is_overwritten(tmp_path):
    target = tmp_path / "thing"
    used(target)
    inode = (target / "loop.c").stat().st_ino
    export_c(OTHER, target, name="second", overwrite=True)
    assert (target / "loop.c").stat().st_ino == inode
    assert (target / "loop.c").read_text() == "int main(void) { return 0; }\n"
    assert (target / "link" / "log.csv").read_text() == "0, 1\n"
    own = {name.replace("thing", "second") for name in OWN}
    assert {path.name for path in target.iterdir()} == own | {"loop.c", "flight", "link"}
    assert "second_other" in (target / "second.h").read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]


def test_a_mark_that_lists_no_files_stands_for_those_of_its_package(tmp_path):
    target = tmp_path / "thing"
    used(target)
    mark = json.loads((target / MARK).read_text())
    del mark["files"]
    (target / MARK).write_text(json.dumps(mark))
    export_c(OTHER, target, name="second", overwrite=True)
    assert not list(target.glob("thing*"))
    assert (target / "loop.c").exists()


@pytest.mark.parametrize("mark", ["", "[]", "{}", '{"files": 3}'])
def test_a_mark_that_says_nothing_protects_every_file(tmp_path, mark):
    target = tmp_path / "thing"
    export_c(LAW, target)
    (target / MARK).write_text(mark)
    before = content(target)
    with pytest.raises(co.ExportError, match=r"thing\.h, thing_casadi\.c in .*not written"):
        export_c(OTHER, target, overwrite=True)
    assert content(target) == before


def test_a_file_of_the_user_with_the_name_of_a_new_one_is_refused(tmp_path):
    target = tmp_path / "thing"
    used(target)
    before = content(target)
    with pytest.raises(co.ExportError, match=r"loop\.c in .*has not written") as error:
        export_c(OTHER, target, name="loop", overwrite=True)
    assert "name=" in str(error.value)
    assert content(target) == before


@pytest.mark.parametrize("failing", ["loop.c", "flight", "thing", "part"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_an_error_while_files_are_moved_leaves_everything_as_it_was(tmp_path, monkeypatch, failing, error):
    target = tmp_path / "thing"
    used(target)
    before, rename, failed = content(target), Path.rename, []

    def broken(path, new):
        part = path.name.startswith(".thing") and not failed
        if (path.name == failing or (failing == "part" and part)) and not failed:
            failed.append(path)
            raise error
        return rename(path, new)

    monkeypatch.setattr(Path, "rename", broken)
    with pytest.raises(co.ExportError if isinstance(error, OSError) else KeyboardInterrupt):
        export_c(OTHER, target, overwrite=True)
    assert failed
    assert content(target) == before
    assert (target / "link").is_symlink()
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]


def test_a_file_that_comes_in_meanwhile_is_not_deleted(tmp_path, monkeypatch):
    target = tmp_path / "thing"
    used(target)
    rename = Path.rename

    def slow(path, new):
        if path == target:
            (target / "late.c").write_text("late")
        return rename(path, new)

    monkeypatch.setattr(Path, "rename", slow)
    export_c(OTHER, target, overwrite=True)
    assert (target / "late.c").read_text() == "late"
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]
