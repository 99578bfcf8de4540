"""What the disk needs to be told so that a power failure or a killed process leaves nothing half done.

A file or folder that is being made carries a name of its own and a lock that the system releases when its process ends,
however it ends: what is found under such a name without a lock belongs to a run that was killed, and may be removed.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import sys
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows
    fcntl = None  # type: ignore[assignment]

# Seconds after which an unfinished file belongs to a killed run where the system has no locks.
ABANDONED = 86400.0
CURRENT_FOLDER = -100  # AT_FDCWD of renameat2
EXCHANGE = 2  # RENAME_EXCHANGE of renameat2, RENAME_SWAP of renamex_np


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


@contextlib.contextmanager
def held(path: Path) -> Iterator[None]:
    """Mark a file or folder that exists as being worked on by this process, until the end of the block."""
    handle = _open(path)
    try:
        if handle is not None and fcntl is not None:
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        if handle is not None:
            os.close(handle)


def abandoned(path: Path) -> bool:
    """Whether nobody works on an unfinished file or folder any more."""
    if fcntl is None:  # pragma: no cover - Windows
        with contextlib.suppress(OSError):
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
