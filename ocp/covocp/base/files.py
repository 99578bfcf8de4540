"""Files that are either complete, and on the disk, or not there."""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from covocp.base.disk import abandoned, flush, held
from covocp.base.errors import ExportError

# Names of files that are being written; what is found under one and is written by nobody is left of a killed run.
UNFINISHED = re.compile(r"\.covocp-[0-9a-f]{32}\.\w+")


def check_target(path: str | Path, suffixes: tuple[str, ...]) -> Path:
    """The path, where a file could be written.

    Args:
        path: where a file is wanted.
        suffixes: the ones that can be written, such as ".npz".

    Returns:
        The path.

    Raises:
        ExportError: unknown suffix, no such folder, or a name that no file can have.
    """
    try:
        target = Path(path)
        os.stat(target)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (TypeError, ValueError, OSError) as error:  # no name, a null byte, too long, a folder that is closed to us
        raise ExportError(
            "The file cannot be written.",
            expected="the name of a file in a folder that can be read",
            received=f"{repr(path)[:60]}: {str(error)[:200]}",
            remedy="choose another name or folder",
        ) from error
    if target.suffix.lower() not in suffixes:
        raise ExportError(
            f"'{target.name}' cannot be written: its suffix names no format.",
            expected="a file name that ends in " + ", ".join(suffixes),
            received=str(path),
            remedy="change the suffix",
        )
    if target.is_dir() or not target.parent.is_dir():
        raise ExportError(
            f"'{target.name}' cannot be written.",
            expected="a file in a folder that exists",
            received=f"{path}, " + ("which is a folder" if target.is_dir() else "whose folder does not exist"),
            remedy="make the folder, or write elsewhere",
        )
    return target


@contextmanager
def written_whole(path: str | Path, suffixes: tuple[str, ...]) -> Iterator[Path]:
    """A temporary file in the folder of `path`, flushed to the disk and renamed to `path` at the end.

    It is removed after an error; those of runs that were killed are removed by the next one in the same folder.

    Args:
        path: where the file is wanted; its folder must exist.
        suffixes: the ones that can be written, such as ".npz".

    Yields:
        The path to write to, with the same suffix.

    Raises:
        ExportError: unknown suffix, folder missing, or the file cannot be written.
    """
    target = check_target(path, suffixes)
    part = target.with_name(f".covocp-{uuid.uuid4().hex}{target.suffix.lower()}")
    try:
        remove_unfinished(target.parent)
        part.touch()
        with held(part):
            yield part
            flush(part)
            part.replace(target)
        flush(target.parent)
    except OSError as error:
        raise ExportError(
            f"'{target.name}' cannot be written.",
            expected="a folder that can be written to, and room on the disk",
            received=str(error),
            remedy="check the permissions, or write elsewhere",
        ) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def remove_unfinished(folder: Path) -> None:
    """Remove the files that killed runs have left in a folder."""
    found: list[Path] = []
    with suppress(OSError), os.scandir(folder) as entries:
        found = [folder / entry.name for entry in entries if UNFINISHED.fullmatch(entry.name)]
    for path in found:
        if abandoned(path):
            with suppress(OSError):
                path.unlink()
