"""Solutions in files: numpy's .npz or JSON, nothing executed on reading; and as xarray datasets.

A .npz file holds every array under its name ("trajectory.x", "mesh.nodes", ...) and the rest as JSON text in the entry
"document"; a .json file holds all of it as text. Both keep every number to the last bit, and end with a checksum.
Beside the solution a file holds the fingerprint of its problem, by which `load` tells it from others. Files of version
1 and 2 had neither, and are refused.
"""

from __future__ import annotations

import stat
import zipfile
import zlib
from pathlib import Path
from typing import Any

from covocp.base.archive import DamagedFileError, packed, unpacked
from covocp.base.errors import ExportError, ProblemError
from covocp.base.files import check_target, written_whole
from covocp.base.matrices import Array
from covocp.base.threads import one_at_a_time
from covocp.solution.schema import from_tree, to_tree
from covocp.solution.solution import Solution

FORMAT = "covocp solution"
VERSION = 3
SUFFIXES = (".npz", ".json")
REASON = 160  # letters of a reason that an error quotes
# What the readers of both formats, and the checks of what they have read, raise for content that is none of a solution.
FOREIGN = (
    ValueError,  # also JSON and Unicode errors, and arrays of Python objects, which are never read
    TypeError,
    AttributeError,
    LookupError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    RuntimeError,  # an encrypted or an unknown compression, too deep a nesting
    SyntaxError,  # of the header of an array
    MemoryError,
    ArithmeticError,
)


@one_at_a_time
def save(solution: Solution, path: str | Path) -> Path:
    """Write a solution, converged or not, to a file that is complete or not there.

    Args:
        solution: what to keep; the residuals of its optimality conditions are evaluated and kept with it.
        path: the file; .npz (compact) or .json (text).

    Returns:
        The path.

    Raises:
        ExportError: unknown suffix, the file cannot be written, or the solution holds something that is not
            plain data or does not fit together.
    """
    check_target(path, SUFFIXES)
    tree = {"format": FORMAT, "version": VERSION, **to_tree(solution)}
    try:
        from_tree(tree)
    except DamagedFileError as error:
        raise ExportError(
            f"The solution of '{solution.name}' cannot be written: it could not be read again.",
            expected="arrays that fit its mesh and its symbols",
            received=str(error),
            remedy="save the solution that the solver returned",
        ) from error
    with written_whole(path, SUFFIXES) as part:
        part.write_bytes(packed(tree, part.suffix))
    return Path(path)


def read(path: str | Path) -> Solution:
    """The solution in a file that `save` wrote, without its problem; nothing in the file is executed.

    Raises:
        ProblemError: no such file, not a file of this format or version, or damaged (a checksum tells).
    """
    file = _checked_path(path)
    tree, sealed = _read(file)
    if not isinstance(tree, dict) or repr(tree.get("format")) != repr(FORMAT):
        raise _unreadable(file, "it is of another format", "give a file that Solution.save wrote")
    version = repr(tree.get("version"))
    if version != repr(VERSION):
        older = " and has no checksum" if version in ("1", "2") else ""
        raise _unreadable(
            file,
            f"its version is {version[:20]}{older}",
            "read it with the covocp that wrote it, or solve again",
        )
    if not sealed:
        raise _unreadable(
            file, "its checksum does not fit: it is damaged, or was changed", "take a copy, or solve and save again"
        )
    try:
        return from_tree(tree)
    except FOREIGN as error:
        raise _damaged(file, error) from error
    except DamagedFileError as error:
        raise _unreadable(file, str(error)[:REASON], "solve and save again") from error


def _checked_path(path: str | Path) -> Path:
    """The path of a file that can be read as a whole.

    Raises:
        ProblemError: nothing that can be a path, no file, a folder, a device.
    """
    try:
        file = Path(path)
        mode = file.stat().st_mode
    except TypeError as error:
        raise _unreadable(Path(repr(path)[:60]), "it is no path", "give the name of a file") from error
    except (FileNotFoundError, NotADirectoryError) as error:
        raise _unreadable(file, "there is no such file", "check the path") from error
    except (OSError, ValueError) as error:  # too long, a null byte, a folder that is closed to us
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise _unreadable(Path(repr(path)[:60]), str(reason), "check the path and its permissions") from error
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "no ordinary file"
        raise _unreadable(file, f"it is {kind}", "give a file that Solution.save wrote")
    return file


def _read(file: Path) -> tuple[Any, bool]:
    """The decoded content of a file, whatever it is, and whether its checksum fits.

    Raises:
        ProblemError: it cannot be read, or is neither a complete .npz nor a complete .json file.
    """
    try:
        return unpacked(file.read_bytes())
    except OSError as error:
        raise _unreadable(file, str(error), "check the path and its permissions") from error
    except (DamagedFileError, *FOREIGN) as error:
        raise _damaged(file, error) from error


def _damaged(file: Path, error: Exception) -> ProblemError:
    kind = "" if isinstance(error, DamagedFileError) else f"{type(error).__name__}: "
    reason = f"it is damaged or of another format ({kind}{str(error)[:REASON]})"
    return _unreadable(file, reason, "give a file that Solution.save wrote, or solve and save again")


def _unreadable(file: Path, reason: str, remedy: str) -> ProblemError:
    return ProblemError(
        f"'{file.name}' cannot be read as a solution: {reason}.",
        expected=f"a .npz or .json file that Solution.save wrote (format '{FORMAT}', version {VERSION})",
        received=str(file),
        remedy=remedy,
    )


def to_xarray(solution: Solution) -> Any:
    """The solution as an xarray.Dataset over the time of the nodes.

    States, controls, matrices and constants under their names; their costates as "costate_<name>", standard deviations
    of the estimates as "deviation_<name>". The entries of vectors run along "<name>_entry", the rows and columns of
    matrices, labelled by what they belong to, along "<name>_row" and "<name>_column".

    Args:
        solution: what to convert.

    Returns:
        The dataset; attributes: name, method, status, converged, cost and its terms, duration, control, mesh_error.

    Raises:
        ExportError: xarray is not installed.
    """
    try:
        import xarray
    except ImportError as error:
        raise ExportError(
            "A solution cannot be converted to xarray: xarray is not installed.",
            expected="the package xarray",
            received=str(error),
            remedy="pip install 'covocp[xarray]'",
        ) from error
    variables: dict[str, tuple[tuple[str, ...], Array]] = {}
    coordinates: dict[str, Any] = {"time": ("time", solution.t, {"units": "s"})}
    estimated = any(block.estimation for block in solution.blocks)
    for block in solution.blocks:
        name, constant = block.name, block.kind in ("unknown", "parameter")
        dimensions: tuple[str, ...] = () if block.size == 1 else (f"{name}_entry",)
        if block.kind == "matrix":
            dimensions = (f"{name}_row", f"{name}_column")
            coordinates |= {dimension: list(block.labels) for dimension in dimensions}
        values = solution.values[name]
        variables[name] = (dimensions, values[0]) if constant else (("time", *dimensions), values)
        if block.kind in ("state", "matrix"):
            variables[f"costate_{name}"] = (("time", *dimensions), solution.costate(name))
        if estimated and block.kind in ("state", "unknown"):
            variables[f"deviation_{name}"] = (("time", *dimensions), solution.deviation(name))
    return xarray.Dataset(variables, coords=coordinates, attrs=_attributes(solution))


def _attributes(solution: Solution) -> dict[str, Any]:
    """Of the dataset; of types that every file format of xarray can hold."""
    terms = {f"cost_{name}": float(value) for name, value in solution.cost_terms.items()}
    return {
        "name": solution.name,
        "method": solution.method,
        "status": solution.status,
        "converged": int(solution.converged),
        "cost": solution.cost,
        **terms,
        "duration": float(solution.duration),
        "control": solution.mesh.control,
        "mesh_error": float(solution.mesh_error),
    }
