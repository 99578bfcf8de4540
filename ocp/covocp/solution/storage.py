"""Solutions in files: numpy's .npz or JSON, nothing executed on reading, every entry checked against its class.

A .npz file holds every array under its name ("trajectory.x", "mesh.nodes", ...) and the rest as JSON text in the entry
"document"; a .json file holds all of it as text. Both keep every number to the last bit, and end with a checksum.
Entries are the fields of the classes. Beside the solution a file holds the fingerprint of its problem, by which `load`
tells it from others. Files of version 1 and 2 had neither, and are refused.
"""

from __future__ import annotations

import stat
import types
import typing
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union

import numpy as np

from covocp.base.archive import DamagedFileError, packed, unpacked
from covocp.base.errors import CovocpError, ExportError, ProblemError
from covocp.base.files import check_target, written_whole
from covocp.base.threads import one_at_a_time
from covocp.extremal.links import Within
from covocp.extremal.mean_effect import MEAN_EFFECT, noted
from covocp.extremal.optimality import Optimality
from covocp.solution.fingerprint import Fingerprint, fingerprint
from covocp.solution.origin import Origin
from covocp.solution.solution import Solution

T = TypeVar("T")

FORMAT = "covocp solution"
VERSION = 3
# Fields with a default that files of this version may lack.
ADDED = ("readings", "words", "aspects", "flown", "flown_matrices")
SUFFIXES = (".npz", ".json")
REASON = 160  # letters of a reason that an error quotes
# Fields: of the problem, which is not kept; of the candidate, whose own fields are entries of the file.
NOT_KEPT, OPENED = "stated", "extremal"
OPTIONAL = ("within",)  # not there where they are None
# Types of fields of a solution that its module does not load.
LATER = {kind.__name__: kind for kind in (Optimality, Fingerprint, Within)}
NEEDED = ("stored_costates", "stored_dense")  # may be None in a solution that knows its problem, not in a file
# Of the numbers that methods report, those that the printed summary takes for granted.
STATS: dict[str, Any] = {
    "iterations": int,
    "classical_cost": float | None,
    "intervals_asked": int | None,
    "nodes_added": tuple[int, int] | None,
    "refine": float,
    "mesh_intervals": tuple[int, ...],
    "mesh_errors": tuple[float, ...],
    **MEAN_EFFECT,
}
SECONDS = "seconds"
# Entries of the table of all values at the nodes, above which the file is not one of a solution.
LARGEST_TABLE = 10**8
LARGEST_WHOLE = 2**63 - 1  # that numpy counts with
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
    return write({"format": FORMAT, "version": VERSION, **checked_tree(solution)}, path)


def write(tree: Mapping[str, Any], path: str | Path) -> Path:
    """Write a tree to a file that is complete or not there."""
    with written_whole(path, SUFFIXES) as part:
        part.write_bytes(packed(tree, part.suffix))
    return Path(path)


def checked_tree(solution: Solution) -> dict[str, Any]:
    """The entries of a solution, as they can be read again.

    Raises:
        ExportError: they cannot.
    """
    tree = to_tree(solution)
    try:
        from_tree(tree)
    except DamagedFileError as error:
        raise ExportError(
            f"The solution of '{solution.name}' cannot be written: it could not be read again.",
            expected="arrays that fit its mesh and its symbols",
            received=str(error),
            remedy="save the solution that the solver returned",
        ) from error
    return tree


def read(path: str | Path) -> Solution:
    """The solution in a file that `save` wrote, without its problem; nothing in the file is executed.

    Raises:
        ProblemError: no such file, not a file of this format or version, or damaged (a checksum tells).
    """
    return made(path, opened(path, {FORMAT: VERSION}), from_tree)


def opened(path: str | Path, versions: Mapping[str, int]) -> Mapping[str, Any]:
    """The tree in a file of one of some formats.

    Args:
        path: the file.
        versions: by format, the version that is read.

    Raises:
        ProblemError: no such file, of another format or version, or damaged.
    """
    file = _checked_path(path)
    try:
        tree, sealed = unpacked(file.read_bytes())
    except OSError as error:
        raise _unreadable(file, str(error), "check the path and its permissions") from error
    except (DamagedFileError, *FOREIGN) as error:
        raise _damaged(file, error) from error
    words = {repr(name): number for name, number in versions.items()}
    if not isinstance(tree, dict) or repr(tree.get("format")) not in words:
        raise _unreadable(file, "it is of another format", "give a file that Solution.save wrote")
    version = repr(tree.get("version"))
    if version != repr(words[repr(tree["format"])]):
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
    return tree


def made(path: str | Path, tree: Mapping[str, Any], make: Callable[[Mapping[str, Any]], T]) -> T:
    """What is made of the tree in a file.

    Raises:
        ProblemError: it contradicts itself.
    """
    try:
        return make(tree)
    except FOREIGN as error:
        raise _damaged(Path(path), error) from error
    except DamagedFileError as error:
        raise _unreadable(Path(path), str(error)[:REASON], "solve and save again") from error


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


# --- solutions as nested dictionaries ---------------------------------------------------------------------------------


def to_tree(solution: Solution) -> dict[str, Any]:
    """All entries of a solution but the statement, its parts as dictionaries; of the statement its fingerprint."""
    known = replace(
        solution,
        stored_optimality=_known_optimality(solution),
        stored_costates=solution.costates,
        stored_dense=solution.dense,
        stored_problem=_known_problem(solution),
        stats={**solution.stats, **noted(solution.mean_effect)},
    )
    tree: dict[str, Any] = plain(known)
    return tree


def from_tree(tree: Mapping[str, Any]) -> Solution:
    """The solution that `to_tree` made the dictionaries of.

    Raises:
        DamagedFileError: an entry is missing, of another type or of another shape.
    """
    missing: list[str] = [name for name in NEEDED if name in tree and tree[name] is None]
    wrong: list[str] = []
    solution: Solution = _made(Solution, tree, "", missing, wrong)
    _refuse("it lacks the entries ", missing)
    _refuse("entries of the wrong type: ", wrong)
    _refuse("entries of the wrong type: ", _wrong_stats(solution.stats))
    _check_blocks(solution)
    _check_mesh(solution)
    lengths = _lengths(solution)
    _refuse("entries of the wrong shape: ", _misfits(Solution, solution, "", lengths))
    _refuse("entries of the wrong shape: ", _misfits(Any, solution.mean_effect, "mean_effect", lengths))
    return solution


def record(hint: Any, value: Any, place: str) -> Any:
    """What `plain` took apart of a value of some type, outside the entries of a solution.

    Args:
        hint: the type.
        value: what the file has for it.
        place: its name.

    Raises:
        DamagedFileError: an entry is missing or of another type.
    """
    missing: list[str] = []
    wrong: list[str] = []
    made = _made(hint, value, place, missing, wrong)
    _refuse("it lacks the entries ", missing)
    _refuse("entries of the wrong type: ", wrong)
    return made


def _refuse(reason: str, entries: Iterable[str]) -> None:
    """The error that names entries, where there are any."""
    if listed := ", ".join(entries):
        raise DamagedFileError(reason + listed)


def _known_optimality(solution: Solution) -> Optimality | None:
    """The residuals; None where they cannot be evaluated (the last iterate of a failed run may not be finite)."""
    if solution.statement is None:
        return solution.stored_optimality
    try:
        return solution.optimality
    except (CovocpError, RuntimeError, ArithmeticError, ValueError):
        return None


def _known_problem(solution: Solution) -> Fingerprint | None:
    """What tells the problem from others; None where the solution was made without one."""
    if solution.statement is None:
        return solution.stored_problem
    return fingerprint(solution.statement, solution.trajectory, solution.parameters)


@lru_cache
def _parts(kind: Any) -> dict[str, Any]:
    """Types of the fields of a class by name, those that are kept; none of what is no dataclass."""
    if not is_dataclass(kind):
        return {}
    hints = typing.get_type_hints(kind, localns=LATER, include_extras=True)
    return {f.name: hints[f.name] for f in fields(kind) if f.name != NOT_KEPT}


def plain(value: Any) -> Any:
    """Dataclasses as dictionaries, also within tuples."""
    if isinstance(value, tuple):
        return tuple(plain(entry) for entry in value)
    kind: Any = type(value)
    tree: dict[str, Any] = {}
    for name in _parts(kind):
        entry = plain(getattr(value, name))
        if name not in OPTIONAL or entry is not None:
            tree |= entry if name == OPENED else {name: entry}
    return tree or value


def _made(hint: Any, value: Any, place: str, missing: list[str], wrong: list[str]) -> Any:
    """The value of a field, with the objects that `plain` took apart.

    Args:
        hint: the type of the field.
        value: what the file has for it.
        place: its name, with those of the parts that it lies in.
        missing: where the names of entries are noted that are not there.
        wrong: the same of entries of another type; what is returned is then of no use.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        hint, origin, arguments = arguments[0], np.ndarray, ()
    if hint is Any:
        return value
    if origin in (Union, types.UnionType):
        hint = next((arm for arm in arguments if _of_type(arm, value)), arguments[0])
        return _made(hint, value, place, missing, wrong)
    if isinstance(value, Mapping) and (parts := _parts(hint)):
        faults, entries = len(missing) + len(wrong), {}
        for name, kind in parts.items():
            here = f"{place}.{name}".lstrip(".")
            if name == OPENED:
                entries[name] = _made(kind, value, place, missing, wrong)
            elif name in value:
                entries[name] = _made(kind, value[name], here, missing, wrong)
            elif name in (*ADDED, *OPTIONAL):  # files that were written before have none of it
                continue
            else:
                missing.append(here)
        return hint(**entries) if len(missing) + len(wrong) == faults else None
    if origin is tuple and isinstance(value, tuple):
        kinds = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(kinds) == len(value):
            return tuple(_made(kinds[i], entry, f"{place}.{i}", missing, wrong) for i, entry in enumerate(value))
    if origin is Mapping and isinstance(value, Mapping):
        for key, entry in value.items():
            _made(arguments[0], key, place, missing, wrong)
            _made(arguments[1], entry, f"{place}.{key}", missing, wrong)
    elif not _is_leaf(hint, value):
        wrong.append(place)
    return value


def _is_leaf(hint: Any, value: Any) -> bool:
    """Whether a value without parts is of the type of a field."""
    if typing.get_origin(hint) is np.ndarray:
        return isinstance(value, np.ndarray) and value.dtype == np.float64
    if typing.get_origin(hint) is Literal:
        return isinstance(value, str) and value in typing.get_args(hint)
    if hint in (float, int):
        kinds = (int, np.integer) if hint is int else (float, int, np.floating, np.integer)
        too_large = isinstance(value, int) and abs(value) > LARGEST_WHOLE
        return isinstance(value, kinds) and not isinstance(value, bool) and not too_large
    return isinstance(hint, type) and isinstance(value, hint)


def _of_type(hint: Any, value: Any) -> bool:
    """Whether a value and all its parts are of the type of a field."""
    missing: list[str] = []
    wrong: list[str] = []
    _made(hint, value, "", missing, wrong)
    return not missing and not wrong


# --- contents ---------------------------------------------------------------------------------------------------------


def _wrong_stats(stats: Mapping[str, Any]) -> list[str]:
    """What the summary prints of a method's own numbers, where it is not of the type that it prints."""
    kinds = {name: STATS.get(name, float if name.endswith(SECONDS) else Any) for name in stats}
    wrong = [f"stats.{name}" for name, kind in kinds.items() if not _of_type(kind, stats[name])]
    starts = stats.get("starts", ())
    if not (isinstance(starts, np.ndarray) and starts.ndim == 1 and starts.dtype.kind in "fiu"):
        listed = isinstance(starts, (tuple, list)) and all(_of_type(float, cost) for cost in starts)
        wrong += [] if listed else ["stats.starts"]
    return wrong if stats.get("origin", Origin.OPTIMISED) in list(Origin) else [*wrong, "stats.origin"]


def _check_blocks(solution: Solution) -> None:
    """The symbols lie one behind the other, and have names of their own."""
    blocks = solution.blocks
    kinds = ("state", "control", "matrix", "unknown", "parameter")
    groups = [[b for b in blocks if b.kind == kind] for kind in kinds[:3]]
    groups.append([b for kind in ("parameter", "unknown") for b in blocks if b.kind == kind])
    whole = all(b.kind in kinds and b.size >= 1 and b.offset >= 0 for b in blocks)
    whole = whole and len({b.name for b in blocks}) == len(blocks)
    whole = whole and all(
        (group[0].offset == 0 if group else True) and all(b.offset == a.offset + a.length for a, b in pairwise(group))
        for group in groups
    )
    whole = whole and all(len(b.labels) == b.size for b in blocks if b.kind == "matrix")
    whole = whole and all(b.size == len(solution.augmented) for b in blocks if b.estimation)
    if not whole:
        raise DamagedFileError("its symbols contradict each other")


def _check_mesh(solution: Solution) -> None:
    """The mesh is one, and the solution is what it holds on it."""
    mesh, nodes, knots = solution.mesh, solution.mesh.nodes, solution.dense.knots
    if nodes.ndim != 1 or nodes.size < 2 or not (np.diff(nodes) >= 0).all() or nodes[0] != 0 or nodes[-1] != 1:
        raise DamagedFileError("the nodes of its mesh do not rise from 0 to 1")
    read = mesh.readings.any(axis=0) if mesh.readings.shape[-1] == mesh.intervals else np.zeros(mesh.intervals, bool)
    still, held = np.diff(nodes) == 0, bool(solution.constraints.get("instants"))
    jumps = mesh.control == "linear"  # which a control that was given may do anywhere
    if (read & ~still).any() or (not held and not jumps and (still & ~read).any()):
        raise DamagedFileError("the nodes of its mesh are not those at which something is read")
    known = mesh.control in ("linear", "constant") and mesh.linear_solver.isalnum()
    least = min(*mesh.segments, mesh.substeps, mesh.points)
    if not known or sum(mesh.segments) != mesh.intervals or least < 1:
        raise DamagedFileError("its mesh contradicts itself")
    if knots.ndim != 1 or not (np.diff(knots) >= 0).all() or not np.isin(nodes, knots).all() or knots[-1] != 1:
        raise DamagedFileError("the knots between the nodes of its mesh contradict it")
    if set(solution.constraints) - {"instants"} != {"path", "start", "end"}:  # earlier files have no instants
        raise DamagedFileError("its constraints are not those of the path, the ends and the instants")


def _lengths(solution: Solution) -> dict[str, int]:
    """What the arrays of a solution have as lengths, by the words they are annotated with."""
    mesh, knots, kept = solution.mesh, solution.dense.knots.size, solution.stored_problem
    nx, nu, ne, unknown, parameter = (
        max((b.span.stop for b in solution.blocks if b.kind == kind), default=0)
        for kind in ("state", "control", "matrix", "unknown", "parameter")
    )
    constants = max(unknown, parameter)
    if mesh.nodes.size * (nx + nu + ne + constants) > LARGEST_TABLE:
        raise DamagedFileError(f"{mesh.nodes.size} nodes of {nx + nu + ne + constants} entries are no solution")
    points = {"nodes": mesh.nodes.size, "intervals": mesh.intervals, "controls": mesh.control_nodes}
    points |= {"inside": mesh.points - 1, "knots": knots, "pieces": knots - 1}
    points["points"] = kept.points.shape[0] if kept is not None and kept.points.ndim else 0
    entries = {"x": nx, "u": nu, "e": ne, "xe": nx + ne, "p": constants, "augmented": len(solution.augmented)}
    return {
        **points,
        **entries,
        **{"instants": 0},
        **{place: len(names) for place, names in solution.constraints.items()},
    }


def _misfits(hint: Any, value: Any, place: str, lengths: Mapping[str, int]) -> Iterator[str]:
    """Arrays of another shape than their fields are annotated with, in words.

    An annotation names the length of each axis; "any": whatever it is, "some": at least one entry, "or none": no
    entries at all are right too, for bounds, and for inequalities where there are none.
    """
    if typing.get_origin(hint) in (Union, types.UnionType):
        hint = typing.get_args(hint)[0]  # or None
    kind: Any = type(value)
    if parts := _parts(kind):
        for name, kind in parts.items():
            here = place if name == OPENED else f"{place}.{name}".lstrip(".")
            yield from _misfits(kind, getattr(value, name), here, lengths)
    elif typing.get_origin(hint) is Mapping:
        for key, entry in value.items():
            yield from _misfits(typing.get_args(hint)[1], entry, f"{place}.{key}", lengths)
    elif isinstance(value, np.ndarray) and typing.get_origin(hint) is Annotated:
        words, _, none = typing.get_args(hint)[1].partition(" or ")
        own = (*value.shape, 0, 0, 0)
        axes = words.split()
        shape = tuple({"any": n, "some": max(n, 1), **lengths}[word] for word, n in zip(axes, own, strict=False))
        left_out = none and value.ndim and not value.size and not (axes[-1] == "path" and shape[-1])
        if value.shape != shape and not left_out:
            yield f"{place} {value.shape} instead of {shape}"
