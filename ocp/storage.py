"""Solutions in files: numpy's .npz or JSON, nothing executed on reading; and as xarray datasets.

A .npz file holds every array under its name ("trajectory.x", "mesh.nodes", ...) and the rest as JSON text in the entry
"document"; a .json file holds all of it as text. Both keep every number to the last bit.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from covocp.checks import check_kind
from covocp.encoding import DamagedFileError, decode, encode
from covocp.errors import ExportError, ProblemError, describe
from covocp.files import written_whole
from covocp.matrices import Array
from covocp.solution import Solution
from covocp.statement import Block, Statement
from covocp.stored import from_tree, to_tree

if TYPE_CHECKING:
    from covocp.problem import Problem

FORMAT = "covocp solution"
VERSION = 2
SUFFIXES = (".npz", ".json")
# Relative difference of the stored rates to those of a problem above which it is another problem; well above what
# another version or compiler changes, well below what another number in the dynamics does.
SAME_RATES = 1e-6


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
    tree = {"format": FORMAT, "version": VERSION, **to_tree(solution)}
    try:
        from_tree(tree)
    except DamagedFileError as error:
        raise ExportError(
            describe(
                f"The solution of '{solution.name}' cannot be written: it could not be read again.",
                expected="arrays that fit its mesh and its symbols",
                received=str(error),
                remedy="save the solution that the solver returned",
            )
        ) from error
    with written_whole(path, SUFFIXES) as part:
        arrays: dict[str, Any] | None = None if part.suffix == ".json" else {}
        encoded = {name: encode(value, name, arrays) for name, value in tree.items()}
        text = json.dumps(encoded, allow_nan=False)
        if arrays is None:
            part.write_text(text, encoding="utf-8")
        else:
            with part.open("wb") as file:
                np.savez_compressed(file, document=np.frombuffer(text.encode(), dtype=np.uint8), **arrays)
    return Path(path)


def load(path: str | Path, problem: Problem | None = None) -> Solution:
    """Read a solution that `save` wrote; nothing in the file is executed.

    Args:
        path: a .npz or .json file.
        problem: the problem that was solved, attached again: expressions of its symbols, `check_path` and everything
            else that needs the model can then be asked for. Without it the solution knows names only.

    Returns:
        The solution, equal to the saved one to the last bit.

    Raises:
        ProblemError: no such file, not a file of this format or version, damaged, or of another problem.
    """
    file = Path(path)
    tree = _read(file)
    if not isinstance(tree, dict) or tree.get("format") != FORMAT:
        raise _unreadable(file, "it is of another format", "give a file that Solution.save wrote")
    if tree.get("version") != VERSION:
        raise _unreadable(
            file,
            f"its version is {str(tree.get('version'))[:20]}",
            "read it with the covocp that wrote it, or solve again",
        )
    try:
        solution = from_tree(tree)
    except DamagedFileError as error:
        raise _unreadable(file, str(error), "solve and save again") from error
    if problem is None:
        return solution
    from covocp.problem import Problem  # here: reading a file needs no builder

    check_kind(problem, Problem, "give the problem that was solved, or load without one")
    return _attached(solution, problem.statement())


def _read(file: Path) -> Any:
    """The decoded content of a file, whatever it is.

    Raises:
        ProblemError: no file, or neither a complete .npz nor a complete .json file.
    """
    try:
        content = file.read_bytes()
        if content[:2] != b"PK":
            return decode(json.loads(content.decode("utf-8")))
        with np.load(io.BytesIO(content), allow_pickle=False) as entries:
            arrays = {name: entries[name] for name in entries.files}
        if "document" not in arrays:
            raise _unreadable(file, "it has no entry 'document'", "give a file that Solution.save wrote")
        return decode(json.loads(arrays.pop("document").tobytes().decode()), arrays)
    except OSError as error:
        reason = str(error) if file.exists() else "there is no such file"
        raise _unreadable(file, reason, "check the path and its permissions") from error
    except ProblemError:
        raise
    except (
        DamagedFileError,
        ValueError,  # also JSON and Unicode errors, and arrays of Python objects, which are never read
        TypeError,
        AttributeError,
        KeyError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
        RuntimeError,  # an encrypted or an unknown compression, too deep a nesting
        MemoryError,
        OverflowError,
    ) as error:
        reason = f"it is damaged or of another format ({type(error).__name__}: {str(error)[:80]})"
        raise _unreadable(file, reason, "give a file that Solution.save wrote, or solve and save again") from error


def _unreadable(file: Path, reason: str, remedy: str) -> ProblemError:
    return ProblemError(
        describe(
            f"'{file.name}' cannot be read as a solution: {reason}.",
            expected=f"a .npz or .json file that Solution.save wrote (format '{FORMAT}', version {VERSION})",
            received=str(file),
            remedy=remedy,
        )
    )


def _attached(solution: Solution, statement: Statement) -> Solution:
    """The solution with its statement.

    Raises:
        ProblemError: symbols, numbers of constraints, durations or rates differ.
    """
    difference = _difference(solution, statement)
    if difference is None:
        return replace(solution, statement=statement)
    what, stored, given = difference
    raise ProblemError(
        describe(
            f"The stored solution of '{solution.name}' is not one of the given problem '{statement.name}': {what}.",
            expected=f"{stored} (stored)",
            received=f"{given} (given)",
            remedy="give the problem that was solved, or load without one",
        )
    )


def _difference(solution: Solution, statement: Statement) -> tuple[str, str, str] | None:
    """What differs first, as stored and as given; None: nothing."""
    if (solution.blocks, solution.augmented) != (statement.blocks, statement.augmented):
        return "their symbols differ", _symbols(solution.blocks), _symbols(statement.blocks)
    m = solution.multipliers
    stored = [m.start.size, m.path.shape[1] if m.path.size else 0, m.end.size]
    given = [statement.start.size, statement.path.size, statement.end.size]
    if any(s not in (0, g) for s, g in zip(stored, given, strict=True)):
        return "their numbers of constraints (start, path, end) differ", str(stored), str(given)
    if not statement.duration.free and not math.isclose(statement.duration.guess, solution.duration):
        return "their durations differ", f"{solution.duration:g} s", f"{statement.duration.guess:g} s"
    attached = replace(solution, statement=statement).extremal
    values = statement.rates.map(solution.mesh.nodes.size)(*attached.columns())
    rates = np.hstack([np.asarray(value.full()).T for value in values[:2]])
    scale = np.abs(solution.rates).max(axis=0, initial=0.0)
    error = np.abs(rates - solution.rates) > SAME_RATES * np.maximum(scale, np.finfo(float).tiny)
    if error.any():
        node, entry = np.argwhere(error)[0]
        name = (*statement.state_names, *statement.matrix_names)[entry]
        return (
            f"the rate of '{name}' at t = {solution.t[node]:g} s differs",
            f"{solution.rates[node, entry]:g}",
            f"{rates[node, entry]:g}",
        )
    return None


def _symbols(blocks: tuple[Block, ...]) -> str:
    return ", ".join(f"{b.kind} {b.name} ({b.size})" for b in blocks)


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
            describe(
                "A solution cannot be converted to xarray: xarray is not installed.",
                expected="the package xarray",
                received=str(error),
                remedy="pip install 'covocp[xarray]'",
            )
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
