"""A folder of files that is either complete or not there, and never takes the place of something else.

What others have put into it stays in it: only files that the mark lists are replaced. The new folder is made beside the
old one, with links to the files of others, and is on the disk before both change places in one step of the system; only
then the old one is removed. So whenever a run is killed, there is the old or the new package with the files of others
in it, and beside it at most a hidden folder that the next export to the same place removes. Where the system knows no
exchange (Windows, some file systems) the old folder is renamed first: a run that is killed between both names leaves it
hidden, and the next export brings it back.
"""

from __future__ import annotations

import contextlib
import filecmp
import json
import os
import shutil
import stat
import uuid
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from covocp.base.digests import sha256
from covocp.base.errors import ExportError
from covocp.base.files import abandoned, exchange, flush, held
from covocp.export.compiled.building import FOLDER

# What tells that a folder was written here, and may be replaced.
MARK = "covocp-package.json"
# Names of hidden folders: the beginning of the target's name, a digest of the whole, a random number and, while the new
# package is being made in it, the number of the folder on its disk; after the exchange another folder has the name.
SHOWN, LETTERS = 40, 16
REPLACED = "old"  # instead of that number: the old folder, where two names cannot be exchanged


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
        raise _refused(_told(directory), "the name of a folder", type(directory).__name__, "give a name") from error
    except (OSError, ValueError) as error:  # too long, a null byte, a parent that may not be looked into
        raise _refused(_told(directory), "a folder that can be made", str(error)[:200], "choose another") from error
    _recover(target)
    parent = target.parent
    if target.exists() or target.is_symlink():
        whole = target.is_dir() and not target.is_symlink()
        if overwrite and whole and _works_in(target):
            raise _refused(
                target.name,
                "with overwrite=True: a folder that this process does not work in, as another takes its place",
                f"{target}, which holds the current folder",
                "os.chdir() to its parent before, and give the path from there; nothing was changed",
            )
        known = whole and _replaceable(target)
        holds = "" if known else ", which holds other things" if whole else ", which is no folder"
        if not overwrite:
            raise _refused(
                target.name,
                "a folder that does not exist yet",
                f"{target}{holds}",
                "choose another, or overwrite=True (in the shell --overwrite)"
                if known
                else "choose another: nothing but packages and empty folders is replaced",
            )
        if not known:
            raise _refused(
                target.name,
                "with overwrite=True: a package that export_c has written, or an empty folder",
                f"{target}{holds}",
                "choose another folder; nothing was changed",
            )
    if not parent.is_dir():
        raise _refused(target.name, "a folder within one that exists", str(target), "make that folder first")
    if not os.access(parent, os.W_OK):
        raise _refused(target.name, "a place that can be written to", str(parent), "choose another place")
    return target


def _replaceable(target: Path) -> bool:
    """Whether a folder is one that `overwrite` replaces: a package, or empty."""
    return (target / MARK).is_file() or not any(target.iterdir())


def _works_in(target: Path) -> bool:
    """Whether the current folder of this process is a folder, or lies in it."""
    try:
        current = Path.cwd().resolve()
    except OSError:  # it has none
        return False
    return target.resolve() in (current, *current.parents)


def _told(directory: object) -> str:
    """What was given as a folder, as it may stand between quotes."""
    return repr(str(directory))[1:-1][:60]


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
    """Write all files into a hidden folder beside the target, then let both change places.

    An old package disappears: the files that its mark lists and what was built. All else that lies in its folder is
    linked into the new one before they change places (copied, where links are not possible).

    Raises:
        ExportError: something cannot be written, or a file of somebody else has its name; the target is as it was.
    """
    check_names(target, files)
    try:
        with _made(target, files, mark) as part:
            if target.exists():
                with held(target):
                    part = _exchanged(part, target)
                    flush(target.parent)
                    _discard(part, target)
            else:
                part.rename(target)
                flush(target.parent)
    except OSError as error:
        raise _refused(target.name, "a place that can be written to, and room", str(error), "choose another") from error


@contextlib.contextmanager
def _made(target: Path, files: Mapping[str, str], mark: Mapping[str, object]) -> Iterator[Path]:
    """The new folder, complete and on the disk, with links to the files of others; removed after an error."""
    part = _hidden(target)
    part.mkdir()
    try:
        with held(part):
            staged = _hidden(target, str(part.stat().st_ino))
            part.rename(staged)
            part = staged
            listed = {**mark, "files": [*files, MARK]}
            for name, text in {**files, MARK: json.dumps(listed, indent=2) + "\n"}.items():
                (part / name).write_text(text, encoding="utf-8")
                flush(part / name)
            for path in _foreign(target):
                _link(path, part / path.name, target.stat().st_dev)
            if target.exists():
                shutil.copymode(target, part)
            flush(part)
            yield part
    finally:
        if _is_new(part):  # it has not become the target: nothing in it is the only one of its kind
            shutil.rmtree(part, ignore_errors=True)


def _link(path: Path, new: Path, device: int) -> None:
    """A file of somebody else under a second name, which stays when the first goes; folders are made again.

    Raises:
        OSError: it lies on another disk, or is neither a file, a link nor a folder.
    """
    entry = path.lstat()
    if entry.st_dev != device:
        raise OSError(f"{path} is another file system: unmount it, or move it out of the package")
    if stat.S_ISLNK(entry.st_mode):
        new.symlink_to(os.readlink(path))
    elif stat.S_ISDIR(entry.st_mode):
        new.mkdir()
        for inside in sorted(path.iterdir()):
            _link(inside, new / inside.name, device)
        shutil.copystat(path, new)
        flush(new)
    else:
        try:
            os.link(path, new, follow_symlinks=False)
        except OSError:
            if not stat.S_ISREG(entry.st_mode):
                raise
            shutil.copy2(path, new)
            flush(new)


def _exchanged(part: Path, target: Path) -> Path:
    """Give the new folder the name of the target; returns where the old one is."""
    try:
        exchange(part, target)
        return part
    except OSError:
        old = _hidden(target, REPLACED)
        target.rename(old)
        try:
            part.rename(target)
        except BaseException:
            old.rename(target)
            raise
        return old


def _discard(old: Path, target: Path) -> None:
    """Remove what belonged to the old package; what has come into its folder meanwhile goes into the new one."""
    with contextlib.suppress(OSError):
        for path in _foreign(old):
            _merge(path, target / path.name)
        shutil.rmtree(old / FOLDER, ignore_errors=True)
        for name in sorted(_own(old) - {MARK}):
            (old / name).unlink(missing_ok=True)
        (old / MARK).unlink(missing_ok=True)  # last: until then it says what belongs to the package
        old.rmdir()


def _merge(path: Path, kept: Path) -> None:
    """Remove a file of somebody else from the old folder where the new one has it; of two states the later stays."""
    entry = path.lstat()
    if not os.path.lexists(kept):
        path.rename(kept)
    elif stat.S_ISDIR(entry.st_mode):
        path.chmod(stat.S_IMODE(entry.st_mode) | stat.S_IRWXU)
        for inside in sorted(path.iterdir()):
            _merge(inside, kept / inside.name)
        path.rmdir()
    elif _same(path, kept) or kept.lstat().st_mtime_ns > entry.st_mtime_ns:
        path.unlink()
    else:
        path.replace(kept)


def _same(one: Path, other: Path) -> bool:
    """Whether both are the same file, or links or copies of the same content."""
    first, second = one.lstat(), other.lstat()
    if os.path.samestat(first, second):
        return True
    if stat.S_ISLNK(first.st_mode) and stat.S_ISLNK(second.st_mode):
        return os.readlink(one) == os.readlink(other)
    whole = stat.S_ISREG(first.st_mode) and stat.S_ISREG(second.st_mode)
    return whole and filecmp.cmp(one, other, shallow=False)


def _recover(target: Path) -> None:
    """Bring back, and remove, what killed runs have left of a folder."""
    start = _hidden(target).name.rpartition("-")[0]
    found: list[Path] = []
    with contextlib.suppress(OSError), os.scandir(target.parent) as entries:
        found = sorted(Path(entry.path) for entry in entries if entry.name.startswith(start) and entry.is_dir())
    for path in (entry for entry in found if abandoned(entry)):
        with contextlib.suppress(OSError):
            if _is_new(path):
                shutil.rmtree(path, ignore_errors=True)
            elif os.path.lexists(target):
                _discard(path, target)
            elif path.name.endswith(f".{REPLACED}"):
                path.rename(target)


def _hidden(target: Path, last: str = "") -> Path:
    """A name beside the target that nothing else has, and that tells whose it is."""
    digest = sha256(target.name.encode(errors="surrogateescape")).hexdigest()[:LETTERS]
    name = f".{target.name[:SHOWN]}.covocp-{digest}-{uuid.uuid4().hex}"
    return target.with_name(f"{name}.{last}" if last else name)


def _is_new(path: Path) -> bool:
    """Whether a hidden folder is one in which a new package was being made, not an old one after the exchange."""
    number = path.name.rpartition("-")[2].partition(".")[2]
    try:
        return not number or number == str(path.lstat().st_ino)
    except OSError:
        return False


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
    return ExportError(f"'{name}' cannot be written.", expected=expected, received=received, remedy=remedy)
