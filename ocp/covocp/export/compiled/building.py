"""Compiling a package, by the C compiler itself or by CMake."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from covocp.base.dataclass import dataclass
from covocp.base.errors import ExportError
from covocp.export.compiled.linking import Linking

COMPILERS = ("cc", "gcc", "clang")
STANDARD = ("-std=c99", "-Wall", "-Wextra", "-pedantic", "-O2")
TOOLS = ("auto", "cc", "cmake")
MISSING = {"auto": "C compiler and no CMake", "cc": "C compiler", "cmake": "CMake"}
FOLDER = "build"
LINES = 20  # of a compiler's message that an error quotes
TIMEOUT = 1800.0  # s


@dataclass(frozen=True, kw_only=True)
class Build:
    """A compiled package.

    Attributes:
        library: shared library.
        self_test: program that compares C with the reference vectors; returns 0 where they agree.
        compiler: that made them.
        object_bytes: code and constants of the package, without the self-test; None where that is not known.
        stack_bytes: of the deepest call, an upper bound: the frames of all functions together; None where the compiler
            does not say.
    """

    library: Path
    self_test: Path
    compiler: str
    object_bytes: int | None
    stack_bytes: int | None

    @property
    def sizes(self) -> str:
        """Sizes and compiler, a line."""
        code = f"{self.object_bytes} bytes" if self.object_bytes is not None else "not known"
        stack = f"at most {self.stack_bytes} bytes" if self.stack_bytes is not None else "not known"
        return f"object code: {code}; stack: {stack}; {self.compiler}"

    def __str__(self) -> str:
        """Where everything is, and how large."""
        return f"library: {self.library}\nself-test: {self.self_test}\n{self.sizes}"


@dataclass(frozen=True, kw_only=True)
class Sources:
    """What is compiled: the folder, the name, and what a plugin needs besides."""

    directory: Path
    name: str
    linking: Linking | None = None
    single: bool = False


def build(sources: Sources, tool: str = "auto", flags: Sequence[str] = ()) -> Build:
    """Compile.

    Args:
        sources: of a package.
        tool: "cc" (the variable CC, cc, gcc or clang), "cmake", or "auto", the first that there is.
        flags: more flags for the C compiler, such as "-Werror".

    Raises:
        ExportError: no compiler, or it failed (with its message).
    """
    if tool not in TOOLS:
        raise ExportError(
            "There is no such tool to build with.",
            expected="one of " + ", ".join(map(repr, TOOLS)),
            received=repr(tool),
            remedy="correct tool=",
        )
    compiler = _compiler()
    if compiler is not None and tool != "cmake":
        return _by_compiler(sources, compiler, tuple(flags))
    if tool != "cc" and shutil.which("cmake"):
        return _by_cmake(sources, tuple(flags))
    raise ExportError(
        f"'{sources.name}' cannot be compiled: there is no {MISSING[tool]}.",
        expected="a C compiler on the path (" + ", ".join(COMPILERS) + ") or in the variable CC, or CMake",
        received="CC=" + os.environ.get("CC", "") + ", PATH=" + os.environ.get("PATH", ""),
        remedy="install one, such as gcc; or compile the sources elsewhere (README.md says how)",
    )


def _compiler() -> list[str] | None:
    """The command of the C compiler."""
    own = os.environ.get("CC", "").split()
    if own:
        return own if shutil.which(own[0]) else None
    found = next((name for name in COMPILERS if shutil.which(name)), None)
    return None if found is None else [found]


def _run(command: list[str], sources: Sources, what: str) -> str:
    """Run a command in the folder of the package.

    Raises:
        ExportError: it failed.
    """
    try:
        done = subprocess.run(
            command, cwd=sources.directory, capture_output=True, text=True, errors="replace", timeout=TIMEOUT
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise _failed(sources, what, str(error)) from error
    if done.returncode:
        raise _failed(sources, what, (done.stderr.strip() or done.stdout.strip()))
    return done.stdout


def _failed(sources: Sources, what: str, message: str) -> ExportError:
    lines = message.splitlines() or ["no message"]
    kept = [line for line in lines if "error" in line.lower()][:LINES] or lines[:LINES]
    return ExportError(
        f"'{sources.name}' could not be compiled.",
        expected=f"{what} without errors",
        received="\n    ".join(kept),
        remedy="check the compiler and what is linked; README.md in the package says what is needed",
    )


def _folder(sources: Sources) -> Path:
    """A new, empty folder for what is built."""
    folder = sources.directory / FOLDER
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    except OSError as error:
        raise _failed(sources, "a folder that can be written to", str(error)) from error
    return folder


def _by_compiler(sources: Sources, compiler: list[str], flags: tuple[str, ...]) -> Build:
    """Objects, a shared library, the self-test."""
    folder = _folder(sources)
    version = _run([*compiler, "--version"], sources, "the compiler's version").splitlines()[0]
    gnu = "clang" not in version.lower()
    include = [f"-I{path}" for path in sources.linking.include] if sources.linking else []
    own = ["-fstack-usage"] if gnu else []
    own += ["-fsingle-precision-constant"] if gnu and sources.single else []
    objects = {}
    for stem in (sources.name, f"{sources.name}_casadi", "main"):
        objects[stem] = folder / f"{stem}.o"
        command = [*compiler, *STANDARD, *own, *flags, *include, "-fPIC", "-c", f"{stem}.c", "-o", str(objects[stem])]
        _run(command, sources, "the compiler")
    library, program = folder / _library_name(sources.name), folder / f"{sources.name}_selftest"
    both = [str(objects[sources.name]), str(objects[f"{sources.name}_casadi"])]
    link = [*flags, *(sources.linking.link if sources.linking else ()), "-lm"]
    _run([*compiler, "-shared", "-o", str(library), *both, *link], sources, "the linker")
    _run([*compiler, "-o", str(program), str(objects["main"]), *both, *link], sources, "the linker")
    stems = (sources.name, f"{sources.name}_casadi")
    return Build(
        library=library,
        self_test=program,
        compiler=version,
        object_bytes=_object_bytes([objects[stem] for stem in stems]),
        stack_bytes=_stack_bytes([folder / f"{stem}.su" for stem in stems]),
    )


def _by_cmake(sources: Sources, flags: tuple[str, ...]) -> Build:
    """The same by the CMakeLists.txt of the package."""
    folder = _folder(sources)
    command = ["cmake", "-S", ".", "-B", FOLDER, "-DCMAKE_BUILD_TYPE=Release", "-DBUILD_SHARED_LIBS=ON"]
    command += sources.linking.cmake_options if sources.linking else ()
    if flags:
        command.append(f"-DCMAKE_C_FLAGS={' '.join(flags)}")
    _run(command, sources, "CMake")
    _run(["cmake", "--build", FOLDER, "--config", "Release"], sources, "CMake")
    found = {
        what: next((p for p in sorted(folder.rglob(pattern)) if p.is_file()), None)
        for what, pattern in {
            "library": f"*{sources.name}{Path(_library_name(sources.name)).suffix}",
            "program": f"{sources.name}_selftest{'.exe' if os.name == 'nt' else ''}",
        }.items()
    }
    library, program = found["library"], found["program"]
    if library is None or program is None:
        raise _failed(sources, "a shared library and a self-test", "neither is in " + str(folder))
    objects = [p for p in folder.rglob(f"{sources.name}*.c.o*") if p.is_file()]
    version = _run(["cmake", "--version"], sources, "CMake").splitlines()[0]
    return Build(
        library=library,
        self_test=program,
        compiler=version,
        object_bytes=_object_bytes(objects) if objects else None,
        stack_bytes=None,
    )


def _library_name(name: str) -> str:
    """File name of a shared library on this machine."""
    if sys.platform == "win32":
        return f"{name}.dll"
    return f"lib{name}.dylib" if sys.platform == "darwin" else f"lib{name}.so"


def _object_bytes(objects: list[Path]) -> int | None:
    """Code and initialised data, as `size` counts them."""
    if not shutil.which("size"):
        return None
    done = subprocess.run(["size", *map(str, objects)], capture_output=True, text=True, timeout=TIMEOUT)
    rows = re.findall(r"^\s*(\d+)\s+(\d+)\s+\d+\s+\d+\s+\S+\s", done.stdout, re.MULTILINE)
    return sum(int(text) + int(data) for text, data in rows) if rows else None


def _stack_bytes(files: list[Path]) -> int | None:
    """Frames of all functions together: none calls itself, so no call is deeper."""
    if not all(path.is_file() for path in files):
        return None
    frames = [line.split("\t") for path in files for line in path.read_text(encoding="utf-8").splitlines()]
    return sum(int(frame[1]) for frame in frames if len(frame) == 3)
