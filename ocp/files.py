"""Files that are either complete or not there."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from covocp.errors import ExportError, describe


def check_target(path: str | Path, suffixes: tuple[str, ...]) -> Path:
    """The path, where a file could be written.

    Args:
        path: where a file is wanted.
        suffixes: the ones that can be written, such as ".npz".

    Returns:
        The path.

    Raises:
        ExportError: unknown suffix, or no such folder.
    """
    target = Path(path)
    if target.suffix.lower() not in suffixes:
        raise ExportError(
            describe(
                f"'{target.name}' cannot be written: its suffix names no format.",
                expected="a file name that ends in " + ", ".join(suffixes),
                received=str(path),
                remedy="change the suffix",
            )
        )
    if target.is_dir() or not target.parent.is_dir():
        raise ExportError(
            describe(
                f"'{target.name}' cannot be written.",
                expected="a file in a folder that exists",
                received=f"{path}, " + ("which is a folder" if target.is_dir() else "whose folder does not exist"),
                remedy="make the folder, or write elsewhere",
            )
        )
    return target


@contextmanager
def written_whole(path: str | Path, suffixes: tuple[str, ...]) -> Iterator[Path]:
    """A temporary file in the folder of `path`, renamed to `path` at the end and removed after an error.

    Args:
        path: where the file is wanted; its folder must exist.
        suffixes: the ones that can be written, such as ".npz".

    Yields:
        The path to write to, with the same suffix.

    Raises:
        ExportError: unknown suffix, folder missing, or the file cannot be written.
    """
    target = check_target(path, suffixes)
    part = target.with_name(f".{uuid.uuid4().hex}{target.suffix.lower()}")
    try:
        yield part
        part.replace(target)
    except OSError as error:
        raise ExportError(
            describe(
                f"'{target.name}' cannot be written.",
                expected="a folder that can be written to, and room on the disk",
                received=str(error),
                remedy="check the permissions, or write elsewhere",
            )
        ) from error
    finally:
        part.unlink(missing_ok=True)
