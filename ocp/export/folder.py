"""A folder of files that is either complete or not there, and never takes the place of something else.

What others have put into it stays in it: only files that the mark lists are replaced.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import uuid
from collections.abc import Iterable, Mapping
from pathlib import Path

from covocp.errors import ExportError, describe
from covocp.export.building import FOLDER

# What tells that a folder was written here, and may be replaced.
MARK = "covocp-package.json"


def check_folder(directory: str | os.PathLike[str], overwrite: bool) -> Path:
    """The folder, where it may be written.

    Raises:
        ExportError: it exists and may not be replaced, or its parent does not exist or cannot be written to.
    """
    try:
        target = Path(directory).absolute()
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            target.lstat()
    except TypeError as error:
        raise _refused(repr(directory), "the name of a folder", type(directory).__name__, "give a name") from error
    except (OSError, ValueError) as error:  # too long, a null byte, a parent that may not be looked into
        raise _refused(repr(directory)[:60], "a folder that can be made", str(error)[:200], "choose another") from error
    parent = target.parent
    if target.exists() or target.is_symlink():
        whole = target.is_dir() and not target.is_symlink()
        if not overwrite:
            raise _refused(
                target.name,
                "a folder that does not exist yet",
                str(target),
                "choose another, or overwrite=True (in the shell --overwrite)",
            )
        if not whole or (any(target.iterdir()) and not (target / MARK).is_file()):
            raise _refused(
                target.name,
                "with overwrite=True: a package that export_c has written, or an empty folder",
                f"{target}, which holds other things" if whole else f"{target}, which is no folder",
                "choose another folder; nothing was changed",
            )
    if not parent.is_dir():
        raise _refused(target.name, "a folder within one that exists", str(target), "make that folder first")
    if not os.access(parent, os.W_OK):
        raise _refused(target.name, "a place that can be written to", str(parent), "choose another place")
    return target


def package_files(package: str) -> tuple[str, ...]:
    """Names of the files of a package."""
    return (f"{package}.h", f"{package}.c", f"{package}_casadi.c", "main.c", "CMakeLists.txt", "README.md")


def check_names(target: Path, files: Iterable[str]) -> None:
    """Complain about files of somebody else that have the names of new ones.

    Raises:
        ExportError: there are some.
    """
    taken = sorted(set(files) & {path.name for path in _foreign(target)})
    if taken:
        raise _refused(
            target.name,
            "no files but those of the package under these names",
            f"{', '.join(taken)} in {target}, which export_c has not written",
            "rename them, or the package by name=; nothing was changed",
        )


def write_folder(target: Path, files: Mapping[str, str], mark: Mapping[str, object]) -> None:
    """Write all files into a sibling, then give it the name of the target.

    An old package disappears at the end: the files that its mark lists and what was built. All else that lies in its
    folder is moved into the new one before they change places.

    Raises:
        ExportError: something cannot be written, or a file of somebody else has its name; the target is as it was.
    """
    check_names(target, files)
    part, old = (target.parent / f".{target.name}.{uuid.uuid4().hex}" for _ in range(2))
    moved: list[str] = []
    try:
        part.mkdir()
        for name, text in files.items():
            (part / name).write_text(text, encoding="utf-8")
        listed = {**mark, "files": [*files, MARK]}
        (part / MARK).write_text(json.dumps(listed, indent=2) + "\n", encoding="utf-8")
        for path in _foreign(target):
            path.rename(part / path.name)
            moved.append(path.name)
        if target.exists():
            target.rename(old)
        part.rename(target)
    except BaseException as error:  # an interrupt too must not cost anybody a file
        _undo(part, old, target, moved)
        if isinstance(error, OSError):
            raise _refused(
                target.name, "a place that can be written to, and room", str(error), "choose another"
            ) from error
        raise
    _discard(old, target)


def _undo(part: Path, old: Path, target: Path, moved: list[str]) -> None:
    """The target as it was; the new folder stays where a file of somebody else cannot be moved back out of it."""
    if old.exists():
        old.rename(target)
    for name in moved:
        (part / name).rename(target / name)
    shutil.rmtree(part, ignore_errors=True)


def _discard(old: Path, target: Path) -> None:
    """Remove what belonged to the old package; what has come into its folder meanwhile goes into the new one."""
    if not old.exists():
        return
    with contextlib.suppress(OSError):
        for path in _foreign(old):
            if not (target / path.name).exists():
                path.rename(target / path.name)
        shutil.rmtree(old / FOLDER, ignore_errors=True)
        for name in sorted(_own(old)):
            (old / name).unlink(missing_ok=True)
        old.rmdir()


def _own(target: Path) -> set[str]:
    """Names of the files that belong to the package in a folder; its mark last of all says which."""
    try:
        mark = json.loads((target / MARK).read_text(encoding="utf-8"))
        files = mark.get("files", package_files(mark["name"]))  # marks of old packages list none
        return {MARK, *map(str, files)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {MARK}


def _foreign(target: Path) -> list[Path]:
    """What lies in the folder of a package and is neither a file of it nor what was built."""
    if not target.is_dir():
        return []
    own = _own(target)

    def ours(path: Path) -> bool:
        folder = path.is_dir() and not path.is_symlink()
        return path.name == FOLDER if folder else path.name in own

    return sorted(path for path in target.iterdir() if not ours(path))


def _refused(name: str, expected: str, received: str, remedy: str) -> ExportError:
    return ExportError(describe(f"'{name}' cannot be written.", expected=expected, received=received, remedy=remedy))
