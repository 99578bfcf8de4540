"""A solution as nested dictionaries of plain data and back, every entry checked against what its class declares."""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, Literal, Union

import numpy as np

from covocp.base.archive import DamagedFileError
from covocp.base.errors import CovocpError
from covocp.extremal.mean_effect import MEAN_EFFECT, noted
from covocp.extremal.optimality import Optimality
from covocp.solution.fingerprint import Fingerprint, fingerprint
from covocp.solution.origin import Origin
from covocp.solution.solution import Solution
from covocp.transcription.trajectory import Multipliers

NOT_KEPT = "statement"
NEEDED = ("stored_costates", "stored_dense")  # may be None in a solution that knows its problem, not in a file
# Of the numbers that methods report, those that the printed summary takes for granted.
STATS: dict[str, Any] = {
    "iterations": int,
    "classical_cost": float | None,
    "intervals_asked": int | None,
    "nodes_added": tuple[int, int] | None,
    **MEAN_EFFECT,
}
SECONDS = "seconds"
# Entries of the table of all values at the nodes, above which the file is not one of a solution.
LARGEST_TABLE = 10**8
LARGEST_WHOLE = 2**63 - 1


def to_tree(solution: Solution) -> dict[str, Any]:
    """All entries of a solution but the statement, its parts as dictionaries; of the statement its fingerprint."""
    tree = {f.name: getattr(solution, f.name) for f in fields(Solution) if f.name != NOT_KEPT}
    tree["stored_optimality"] = _known_optimality(solution)
    tree["stored_costates"], tree["stored_dense"] = solution.costates, solution.dense
    tree["stored_problem"] = _known_problem(solution)
    tree["stats"] = {**solution.stats, **noted(solution.mean_effect)}
    return {name: _plain(value) for name, value in tree.items()}


def from_tree(tree: Mapping[str, Any]) -> Solution:
    """The solution that `to_tree` made the dictionaries of.

    Raises:
        DamagedFileError: an entry is missing, of another type or of another shape.
    """
    missing: list[str] = [name for name in NEEDED if name in tree and tree[name] is None]
    wrong: list[str] = []
    solution: Solution = _built(Solution, tree, "", missing, wrong)
    if missing:
        raise DamagedFileError("it lacks the entries " + ", ".join(missing))
    if wrong:
        raise DamagedFileError("entries of the wrong type: " + ", ".join(wrong))
    _check_stats(solution.stats)
    _check_blocks(solution)
    _check_shapes(solution)
    return solution


def _plain(value: Any) -> Any:
    """Dataclasses as dictionaries, also within tuples."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    return tuple(_plain(entry) for entry in value) if isinstance(value, tuple) else value


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


# --- types ------------------------------------------------------------------------------------------------------------


@lru_cache
def _hints(kind: Any) -> dict[str, Any]:
    """Types of the fields of a class by name, those that are kept."""
    hints = typing.get_type_hints(kind)
    return {f.name: hints[f.name] for f in fields(kind) if f.init and f.name != NOT_KEPT}


def _built(kind: Any, tree: Mapping[str, Any], place: str, missing: list[str], wrong: list[str]) -> Any:
    """An object of a class from its entries; None, and the names of the entries, where one is missing or wrong."""
    values = {}
    before = len(missing) + len(wrong)
    for name, hint in _hints(kind).items():
        here = f"{place}.{name}" if place else name
        if name not in tree:
            missing.append(here)
        else:
            values[name] = _made(hint, tree[name], here, missing, wrong)
    return kind(**values) if len(missing) + len(wrong) == before else None


def _made(hint: Any, value: Any, place: str, missing: list[str], wrong: list[str]) -> Any:
    """The value of a field; its name is noted where it is of another type."""
    if typing.get_origin(hint) in (Union, types.UnionType):
        arms = typing.get_args(hint)
        if value is None and type(None) in arms:
            return None
        kinds = [arm for arm in arms if arm is not type(None)]
        hint = next((arm for arm in kinds if _of_type(arm, value)), kinds[0])
    if is_dataclass(hint) and isinstance(value, Mapping):
        return _built(hint, value, place, missing, wrong)
    arguments = typing.get_args(hint)
    if typing.get_origin(hint) is tuple and isinstance(value, tuple) and is_dataclass(arguments[0]):
        return tuple(_made(arguments[0], entry, f"{place}.{i}", missing, wrong) for i, entry in enumerate(value))
    if not _of_type(hint, value):
        wrong.append(place)
    return value


def _of_type(hint: Any, value: Any) -> bool:
    """Whether a value is of the type of a field."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return True
    if origin is np.ndarray:
        return isinstance(value, np.ndarray) and value.dtype == np.float64
    if origin is Literal:
        return isinstance(value, str) and value in arguments
    if origin is tuple:
        kinds = arguments[:1] * len(value) if isinstance(value, tuple) and arguments[-1] is Ellipsis else arguments
        return (
            isinstance(value, tuple)
            and len(kinds) == len(value)
            and all(_of_type(kind, entry) for kind, entry in zip(kinds, value, strict=True))
        )
    if origin is not None and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(
            _of_type(arguments[0], key) and _of_type(arguments[1], entry) for key, entry in value.items()
        )
    if origin in (Union, types.UnionType):
        return any(_of_type(arm, value) for arm in arguments)
    if hint in (float, int):
        kinds = (int, np.integer) if hint is int else (float, int, np.floating, np.integer)
        return isinstance(value, kinds) and not isinstance(value, bool) and not _too_large(value)
    return isinstance(hint, type) and isinstance(value, hint)


def _too_large(number: Any) -> bool:
    """Whether a whole number is one that numpy does not count with."""
    return isinstance(number, int) and abs(number) > LARGEST_WHOLE


# --- contents ---------------------------------------------------------------------------------------------------------


def _check_stats(stats: Mapping[str, Any]) -> None:
    """What the summary prints of a method's own numbers is of the type that it prints."""
    kinds = {name: STATS.get(name, float if name.endswith(SECONDS) else Any) for name in stats}
    wrong = [f"stats.{name}" for name, kind in kinds.items() if not _of_type(kind, stats[name])]
    starts = stats.get("starts", ())
    if not (isinstance(starts, np.ndarray) and starts.ndim == 1 and starts.dtype.kind in "fiu"):
        listed = isinstance(starts, (tuple, list)) and all(_of_type(float, cost) for cost in starts)
        wrong += [] if listed else ["stats.starts"]
    if stats.get("origin", Origin.OPTIMISED) not in list(Origin):
        wrong.append("stats.origin")
    if wrong:
        raise DamagedFileError("entries of the wrong type: " + ", ".join(wrong))


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


def _check_shapes(solution: Solution) -> None:
    """All arrays fit the mesh and the symbols."""
    mesh, m = solution.mesh, solution.multipliers
    nodes = mesh.nodes
    if nodes.ndim != 1 or nodes.size < 2 or not (np.diff(nodes) > 0).all() or nodes[0] != 0 or nodes[-1] != 1:
        raise DamagedFileError("the nodes of its mesh do not rise from 0 to 1")
    held = mesh.control in ("linear", "constant") and mesh.linear_solver.isalnum()
    if (
        not held
        or sum(mesh.segments) != mesh.intervals
        or min(mesh.segments) < 1
        or mesh.substeps < 1
        or mesh.points < 1
    ):
        raise DamagedFileError("its mesh contradicts itself")
    knots = solution.dense.knots
    if knots.ndim != 1 or not (np.diff(knots) > 0).all() or not np.isin(nodes, knots).all() or knots[-1] != 1:
        raise DamagedFileError("the knots between the nodes of its mesh contradict it")
    nx, nu, ne = (_length(solution, kind) for kind in ("state", "control", "matrix"))
    constants = max(_length(solution, "unknown"), _length(solution, "parameter"))
    count, controls = nodes.size, mesh.control_nodes
    if count * (nx + nu + ne + constants) > LARGEST_TABLE:
        raise DamagedFileError(f"{count} nodes of {nx + nu + ne + constants} entries are no solution")
    places = solution.constraints
    if set(places) != {"path", "start", "end"}:
        raise DamagedFileError("its constraints are not those of the path, the start and the end")
    expected: list[tuple[str, Any, tuple[int, ...]]] = [
        ("parameters", solution.parameters, (constants,)),
        ("trajectory.x", solution.trajectory.x, (count, nx)),
        ("trajectory.u", solution.trajectory.u, (controls, nu)),
        ("trajectory.e", solution.trajectory.e, (count, ne)),
        ("costates.state", solution.costates.state, (count, nx)),
        ("costates.matrices", solution.costates.matrices, (count, ne)),
        ("rates", solution.rates, (count, nx + ne)),
        ("stored_dense.values", solution.dense.values, (knots.size, nx + ne)),
        ("stored_dense.first", solution.dense.first, (knots.size - 1, nx + ne)),
        ("stored_dense.last", solution.dense.last, (knots.size - 1, nx + ne)),
        ("targets", solution.targets, (nx,)),
        ("end_rates", solution.end_rates, (count - 1, nx + ne)),
        ("multipliers.final", m.final, (nx,)),
        ("multipliers.final_matrices", m.final_matrices, (ne,)),
        *_multiplier_shapes(m, places, count, controls, (nx, ne, nu)),
        ("multipliers.inside_path", m.inside_path, (mesh.intervals, mesh.points - 1, len(places["path"]))),
        ("multipliers.inside_states", m.inside_states, (mesh.intervals, mesh.points - 1, nx)),
    ]
    size = len(solution.augmented)
    if solution.filter_gain is not None:
        gain = solution.filter_gain
        expected.append(("filter_gain", gain, (count, size, gain.shape[-1] if gain.ndim else 0)))
    if solution.loop is not None:
        expected += [(f"loop.{name}", getattr(solution.loop, name), (count, size, size)) for name in ("E", "Xhat", "Z")]
        gain = solution.loop.gain
        if (effect := solution.mean_effect) is not None:
            expected += [("mean_effect", values, (count, size)) for values in (effect.mean, effect.estimate)]
        expected.append(("loop.gain", gain, (count, gain.shape[1] if gain.ndim > 1 else 0, size)))
    if solution.stored_problem is not None:
        expected += _fingerprint_shapes(solution.stored_problem)
    wrong = [f"{name} {array.shape} instead of {shape}" for name, array, shape in expected if array.shape != shape]
    if wrong:
        raise DamagedFileError("entries of the wrong shape: " + ", ".join(wrong))


def _length(solution: Solution, kind: str) -> int:
    """Entries of the stacked vector in which the symbols of a kind lie."""
    return max((b.span.stop for b in solution.blocks if b.kind == kind), default=0)


def _multiplier_shapes(
    m: Multipliers, places: Mapping[str, tuple[str, ...]], count: int, controls: int, sizes: tuple[int, int, int]
) -> list[tuple[str, Any, tuple[int, ...]]]:
    """Of the multipliers of inequalities, and of bounds, which need not be there."""
    nx, ne, nu = sizes
    rows: list[tuple[str, Any, tuple[int, ...]]] = [
        ("start", m.start, (len(places["start"]),)),
        ("end", m.end, (len(places["end"]),)),
        ("path", m.path, (count, len(places["path"]))),
    ]
    rows = [entry for entry in rows if entry[1].size or entry[2][-1] or entry[1].ndim == 0]
    bounds: list[tuple[str, Any, tuple[int, ...]]] = [
        ("states", m.states, (count, nx)),
        ("matrices", m.matrices, (count, ne)),
        ("controls", m.controls, (controls, nu)),
    ]
    kept = [entry for entry in bounds if entry[1].size or entry[1].ndim == 0]
    return [(f"multipliers.{name}", array, shape) for name, array, shape in rows + kept]


def _fingerprint_shapes(kept: Fingerprint) -> list[tuple[str, Any, tuple[int, ...]]]:
    """Values at every point; numbers in rows."""
    rows, columns = (*kept.points.shape, 0, 0)[:2]
    shapes: list[tuple[str, Any, tuple[int, ...]]] = [("stored_problem.points", kept.points, (rows, columns))]
    for name, array in {**kept.values, "the switches": kept.switches}.items():
        shapes.append((f"stored_problem of {name}", array, (rows, array.shape[-1] if array.ndim else 0)))
    for name, array in kept.numbers.items():
        shapes.append((f"stored_problem of {name}", array, (max(array.size, 1),)))
    return shapes
