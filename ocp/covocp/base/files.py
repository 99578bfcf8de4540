"""Files and folders that are either complete, and on the disk, or not there, whatever fails: a process, the power.

One that is being made carries a name of its own and a lock that the system releases when its process ends, however it
ends: what is found under such a name without a lock belongs to a run that was killed, and may be removed.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from covocp.base.errors import ExportError

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows
    fcntl = None  # type: ignore[assignment]

# Names of files that are being written.
UNFINISHED = re.compile(r"\.covocp-[0-9a-f]{32}\.\w+")
# Seconds after which an unfinished file belongs to a killed run where the system has no locks.
ABANDONED = 86400.0
CURRENT_FOLDER = -100  # AT_FDCWD of renameat2
EXCHANGE = 2  # RENAME_EXCHANGE of renameat2, RENAME_SWAP of renamex_np


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


def flush(path: Path) -> None:
    """Wait until a file or a folder (the names in it) is on the disk.

    Raises:
        OSError: the disk does not take it.
    """
    folder = path.is_dir()
    if folder and os.name == "nt":  # pragma: no cover - a folder cannot be opened there
        return
    handle = os.open(path, os.O_RDONLY if folder or os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(handle)
    except OSError as error:
        if not folder or error.errno not in (errno.EINVAL, errno.EBADF, errno.ENOTSUP):
            raise  # some network file systems cannot flush folders, and need not
    finally:
        os.close(handle)


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Mark a file or folder that exists as being worked on by this process, until the end of the block."""
    handle = _open(path)
    try:
        if handle is not None and fcntl is not None:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        if handle is not None:
            os.close(handle)


def abandoned(path: Path) -> bool:
    """Whether nobody works on an unfinished file or folder any more."""
    if fcntl is None:  # pragma: no cover - Windows
        with suppress(OSError):
            return time.time() - path.lstat().st_mtime > ABANDONED
        return False
    handle = None if path.is_symlink() else _open(path)
    if handle is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(handle)
    return True


def _open(path: Path) -> int | None:
    """A handle to lock by; None where there is none to be had."""
    if fcntl is None and path.is_dir():  # pragma: no cover - Windows
        return None
    try:
        return os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except OSError:
        return None


def exchange(one: Path, other: Path) -> None:
    """Let two paths change places, at no moment of which one of them is missing.

    Raises:
        OSError: they cannot, or neither the system nor the file system knows how to.
    """
    function = _exchanging()
    if function is None:
        raise OSError(errno.ENOSYS, "no exchange of two paths on this system")
    if function(os.fsencode(one), os.fsencode(other)) != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), str(one), None, str(other))


@lru_cache
def _exchanging() -> Any:
    """The system's own function of two names; None where it has none."""
    try:
        library = ctypes.CDLL(None, use_errno=True)
        if sys.platform == "darwin":
            swap = library.renamex_np
            swap.argtypes = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint]
            return lambda one, other: swap(one, other, EXCHANGE)
        rename = library.renameat2
        rename.argtypes = [ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint]
    except (OSError, AttributeError, TypeError):
        return None
    return lambda one, other: rename(CURRENT_FOLDER, one, CURRENT_FOLDER, other, EXCHANGE)
