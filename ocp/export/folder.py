"""A folder of files that is either complete or not there, and never takes the place of something else."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path

from covocp.errors import ExportError, describe

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


def write_folder(target: Path, files: Mapping[str, str], mark: Mapping[str, object]) -> None:
    """Write all files into a sibling, then give it the name of the target; an old package disappears at the end.

    Raises:
        ExportError: something cannot be written; the target is as it was.
    """
    parent = target.parent
    part, old = (parent / f".{target.name}.{uuid.uuid4().hex}" for _ in range(2))
    try:
        part.mkdir()
        for name, text in files.items():
            (part / name).write_text(text, encoding="utf-8")
        (part / MARK).write_text(json.dumps(dict(mark), indent=2) + "\n", encoding="utf-8")
        if target.exists():
            target.rename(old)
        try:
            part.rename(target)
        except OSError:
            if old.exists():
                old.rename(target)
            raise
    except OSError as error:
        raise _refused(target.name, "a place that can be written to, and room", str(error), "choose another") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def _refused(name: str, expected: str, received: str, remedy: str) -> ExportError:
    return ExportError(describe(f"'{name}' cannot be written.", expected=expected, received=received, remedy=remedy))
