"""A package that is overwritten: its own files are replaced, those of others stay, whatever happens on the way."""

import errno
import functools
import itertools
import json
import os
import shutil
import signal
import tempfile

import casadi as ca
import pytest
from killed import ends_at

import covocp as co
from covocp.export import export_c
from covocp.export.compiled import folder

X = ca.SX.sym("x")
LAW = ca.Function("law", [X], [ca.sin(X)], ["x"], ["u"])
OTHER = ca.Function("other", [X], [ca.cos(X)], ["x"], ["u"])
MARK = "covocp-package.json"
needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="the system cannot copy a process")
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


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """A used package, and what is in its folder before and after it is overwritten."""
    old = tmp_path_factory.mktemp("old") / "thing"
    used(old)
    mine = {name: old / name for name in ("loop.c", "flight/log.csv", "link/log.csv")}
    mine = {name: path.read_bytes() for name, path in mine.items()}
    new = export_c(OTHER, tmp_path_factory.mktemp("new") / "thing").directory
    return old, own_content(old), own_content(new), mine


def own_content(target):
    return {name: (target / name).read_bytes() for name in OWN if (target / name).is_file()}


def overwrite(target, content):
    """What export_c does to the disk, without the time to make what it writes."""
    mark = json.loads(content[MARK])
    files = {name: content[name].decode() for name in mark.pop("files") if name != MARK}
    folder.write_folder(folder.check_folder(target, overwrite=True), files, mark)


def killed_everywhere(template, tmp_path, may_be_missing=False):
    """Kill the export at each of its operations; what is left, and what the next export makes of it."""
    old, before, after, mine = template
    number, missing = 1, 0
    while True:
        place = tmp_path / str(number)
        place.mkdir()
        target = place / "thing"
        shutil.copytree(old, target, symlinks=True)
        there = ends_at(number, functools.partial(overwrite, target, after), wrapped=[(folder, "exchange")])
        if may_be_missing and not target.exists():
            missing += 1
        else:
            assert own_content(target) in (before, after), number
            assert {name: (target / name).read_bytes() for name in mine} == mine, number
            assert (target / "link").is_symlink()
        overwrite(target, after)
        assert own_content(target) == after, number
        assert {name: (target / name).read_bytes() for name in mine} == mine, number
        assert (target / "link").is_symlink()
        assert {path.name for path in target.iterdir()} == OWN | {"loop.c", "flight", "link"}, number
        assert [path.name for path in place.iterdir()] == ["thing"], number
        if not there:
            return number - 1, missing
        number += 1


@needs_fork
def test_a_run_that_is_killed_leaves_the_old_or_the_new_package_and_every_file_of_the_user(template, tmp_path):
    operations, _ = killed_everywhere(template, tmp_path)
    assert operations > 40


@needs_fork
def test_where_folders_cannot_be_exchanged_the_next_export_brings_back_what_a_killed_run_has_hidden(
    template, tmp_path, monkeypatch
):
    monkeypatch.setattr(folder, "exchange", impossible)
    operations, missing = killed_everywhere(template, tmp_path, may_be_missing=True)
    assert operations > 40
    assert missing == 1


def impossible(*_, **__):
    raise OSError(errno.ENOSYS, "no exchange")


@needs_fork
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_an_error_anywhere_leaves_the_old_or_the_new_package_and_every_file_of_the_user(template, tmp_path, error):
    old, before, after, mine = template

    def end():
        raise error

    for number in itertools.count(1):
        target = tmp_path / str(number) / "thing"
        shutil.copytree(old, target, symlinks=True)
        run = functools.partial(overwrite, target, after)
        there = ends_at(number, run, wrapped=[(folder, "exchange")], end=end)
        assert own_content(target) in (before, after), number
        assert {name: (target / name).read_bytes() for name in mine} == mine, number
        hidden = [path.name for path in target.parent.iterdir() if path != target]
        assert not hidden or own_content(target) == after, number
        if not there:
            assert number > 40
            return


def test_files_that_cannot_be_linked_are_copied(template, tmp_path, monkeypatch):
    old, _, after, mine = template
    target = tmp_path / "thing"
    shutil.copytree(old, target, symlinks=True)
    monkeypatch.setattr(os, "link", impossible)
    export_c(OTHER, target, overwrite=True)
    assert own_content(target) == after
    assert {name: (target / name).read_bytes() for name in mine} == mine
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]


def test_the_new_package_is_on_the_disk_before_it_replaces_the_old(template, tmp_path, monkeypatch):
    target = tmp_path / "thing"
    shutil.copytree(template[0], target, symlinks=True)
    flushed, fsync, exchange = [], os.fsync, folder.exchange

    def noted(handle):
        fsync(handle)
        flushed.append(os.fstat(handle).st_ino)

    def checked(part, old):
        for path in (part, *(part / name for name in OWN), part / "flight"):
            assert path.stat().st_ino in flushed, path
        flushed.clear()
        exchange(part, old)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(folder, "exchange", checked)
    export_c(OTHER, target, overwrite=True)
    assert tmp_path.stat().st_ino in flushed


def test_folders_of_runs_that_go_on_are_left_alone(template, tmp_path, monkeypatch):
    target = tmp_path / "thing"
    shutil.copytree(template[0], target, symlinks=True)
    exchange = folder.exchange

    def slow(part, old):
        monkeypatch.setattr(folder, "exchange", exchange)
        export_c(LAW, target, overwrite=True)  # another run that comes first
        exchange(part, old)

    monkeypatch.setattr(folder, "exchange", slow)
    export_c(OTHER, target, overwrite=True)
    assert own_content(target) == template[2]
    assert (target / "flight" / "log.csv").read_text() == "0, 1\n"
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]


def test_a_file_that_comes_in_meanwhile_is_not_deleted(tmp_path, monkeypatch):
    target = tmp_path / "thing"
    used(target)
    exchange = folder.exchange

    def slow(part, old):
        (target / "late.c").write_text("late")
        (target / "flight" / "late.csv").write_text("late")
        saved = target / "saved"
        saved.write_text("int main(void) { return 1; }\n")
        saved.replace(target / "loop.c")  # as editors do
        exchange(part, old)

    monkeypatch.setattr(folder, "exchange", slow)
    export_c(OTHER, target, overwrite=True)
    assert (target / "late.c").read_text() == "late"
    assert (target / "flight" / "late.csv").read_text() == "late"
    assert (target / "loop.c").read_text() == "int main(void) { return 1; }\n"
    assert [path.name for path in tmp_path.iterdir()] == ["thing"]


def test_a_full_disk_is_said_with_the_name_of_the_folder(tmp_path):
    resource = pytest.importorskip("resource")
    size, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, size[1]))
        with pytest.raises(co.ExportError, match=r"'thing' cannot be written(.|\n)*File too large"):
            export_c(LAW, tmp_path / "thing")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, size)
        signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())


def test_no_temporary_folder_is_needed(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    assert export_c(LAW, tmp_path / "thing").directory.is_dir()
