"""A solution as nested dictionaries of plain data and back, with every entry checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from covocp.closed_loop import ClosedLoop
from covocp.encoding import DamagedFileError
from covocp.errors import CovocpError
from covocp.hamiltonian import Costates
from covocp.mesh import Mesh
from covocp.optimality import Optimality
from covocp.solution import Solution
from covocp.statement import Block
from covocp.trajectory import Multipliers, Trajectory

PARTS: dict[str, Any] = {
    "mesh": Mesh,
    "trajectory": Trajectory,
    "multipliers": Multipliers,
    "stored_costates": Costates,
    "stored_optimality": Optimality,
    "loop": ClosedLoop,
}
OPTIONAL = ("stored_optimality", "loop")
ARRAYS = {
    "parameters",
    "rates",
    "end_rates",
    "targets",
    "mesh.nodes",
    *(f"trajectory.{name}" for name in ("x", "u", "e")),
    *(f"stored_costates.{f.name}" for f in fields(Costates)),
    *(f"multipliers.{f.name}" for f in fields(Multipliers)),
    *(f"loop.{name}" for name in ("E", "Xhat", "Z", "gain")),
}
WORDS = {"name", "method", "message", "mesh.control", "mesh.step"}
NUMBERS = {"mesh_error", "trajectory.duration"}
WHOLE = {"mesh.substeps"}
TRUTHS = {"converged", "mesh.eliminated"}
MAPPINGS = {"cost_terms", "violations", "loop.cost"}  # of numbers by name


def to_tree(solution: Solution) -> dict[str, Any]:
    """All entries of a solution but the statement, its parts as dictionaries."""
    tree = {f.name: getattr(solution, f.name) for f in fields(Solution) if f.name != "statement"}
    tree["stored_optimality"] = _known_optimality(solution)
    tree["stored_costates"] = solution.costates
    for name in PARTS:
        if tree[name] is not None:
            tree[name] = {f.name: getattr(tree[name], f.name) for f in fields(tree[name])}
    tree["blocks"] = tuple({f.name: getattr(b, f.name) for f in fields(Block)} for b in solution.blocks)
    return tree


def from_tree(tree: Mapping[str, Any]) -> Solution:
    """The solution that `to_tree` made the dictionaries of.

    Raises:
        DamagedFileError: an entry is missing, of another type or of another shape.
    """
    _check_types(tree)
    values = {f.name: tree[f.name] for f in fields(Solution) if f.name != "statement"}
    for name, part in PARTS.items():
        if values[name] is not None:
            values[name] = part(**{f.name: values[name][f.name] for f in fields(part)})
    values["blocks"] = tuple(Block(**{f.name: entry[f.name] for f in fields(Block)}) for entry in values["blocks"])
    solution = Solution(**values)
    _check_shapes(solution)
    return solution


def _known_optimality(solution: Solution) -> Optimality | None:
    """The residuals; None where they cannot be evaluated (the last iterate of a failed run may not be finite)."""
    if solution.statement is None:
        return solution.stored_optimality
    try:
        return solution.optimality
    except (CovocpError, RuntimeError, ArithmeticError, ValueError):
        return None


def _check_types(tree: Mapping[str, Any]) -> None:
    """Every entry is there and of its type."""
    missing = [f.name for f in fields(Solution) if f.name != "statement" and f.name not in tree]
    flat = {name: tree[name] for name in tree if name not in PARTS}
    for name, part in PARTS.items():
        content = tree.get(name)
        if content is None and name in OPTIONAL:
            continue
        if not isinstance(content, Mapping):
            missing += [name] * (name in tree)
            continue
        missing += [f"{name}.{f.name}" for f in fields(part) if f.name not in content]
        flat |= {f"{name}.{key}": value for key, value in content.items()}
    if missing:
        raise DamagedFileError("it lacks the entries " + ", ".join(missing))
    wrong = [name for name, value in flat.items() if not _of_type(name, value)]
    if wrong:
        raise DamagedFileError("entries of the wrong type: " + ", ".join(wrong))


def _of_type(name: str, value: Any) -> bool:
    """Whether an entry is what its place in a solution needs; entries that are not known may be anything."""
    if name in ARRAYS:
        return isinstance(value, np.ndarray) and value.dtype == np.float64
    if name in WORDS:
        return isinstance(value, str)
    if name in TRUTHS:
        return isinstance(value, (bool, np.bool_))
    if name in WHOLE:
        return _is_whole(value) and value > 0
    if name in NUMBERS:
        return _is_number(value)
    if name in MAPPINGS:
        return isinstance(value, Mapping) and all(isinstance(k, str) and _is_number(v) for k, v in value.items())
    if name.startswith("stored_optimality.") or name in ("loop.other_cost", "loop.conservation"):
        return value is None or _is_number(value)
    if name == "filter_gain":
        return value is None or (isinstance(value, np.ndarray) and value.dtype == np.float64)
    if name == "mesh.segments":
        return isinstance(value, tuple) and all(_is_whole(n) for n in value)
    if name == "augmented":
        return isinstance(value, tuple) and all(isinstance(label, str) for label in value)
    if name == "blocks":
        return isinstance(value, tuple) and all(_is_block(entry) for entry in value)
    return isinstance(value, Mapping) if name == "stats" else True


def _is_number(value: Any) -> bool:
    return isinstance(value, (float, int, np.floating, np.integer)) and not isinstance(value, bool)


def _is_whole(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _is_block(entry: Any) -> bool:
    if not isinstance(entry, Mapping) or any(f.name not in entry for f in fields(Block)):
        return False
    kinds = ("state", "control", "matrix", "unknown", "parameter")
    return (
        isinstance(entry["name"], str)
        and entry["kind"] in kinds
        and all(_is_whole(entry[name]) and entry[name] >= 0 for name in ("size", "offset"))
        and isinstance(entry["labels"], tuple)
        and all(isinstance(entry[name], bool) for name in ("covariance", "estimation", "backward"))
    )


def _check_shapes(solution: Solution) -> None:
    """All arrays fit the mesh and the symbols."""
    mesh, m = solution.mesh, solution.multipliers
    nodes = mesh.nodes
    if nodes.ndim != 1 or nodes.size < 2 or not (np.diff(nodes) > 0).all() or nodes[0] != 0 or nodes[-1] != 1:
        raise DamagedFileError("the nodes of its mesh do not rise from 0 to 1")
    if mesh.control not in ("linear", "constant") or sum(mesh.segments) != mesh.intervals or min(mesh.segments) < 1:
        raise DamagedFileError("its mesh contradicts itself")
    ends = {kind: [b.span.stop for b in solution.blocks if b.kind == kind] for kind in ("state", "control", "matrix")}
    nx, nu, ne = (max(ends[kind], default=0) for kind in ("state", "control", "matrix"))
    constants = max((b.span.stop for b in solution.blocks if b.kind in ("unknown", "parameter")), default=0)
    count, controls = nodes.size, mesh.control_nodes
    expected: list[tuple[str, Any, tuple[int, ...]]] = [
        ("parameters", solution.parameters, (constants,)),
        ("trajectory.x", solution.trajectory.x, (count, nx)),
        ("trajectory.u", solution.trajectory.u, (controls, nu)),
        ("trajectory.e", solution.trajectory.e, (count, ne)),
        ("costates.state", solution.costates.state, (count, nx)),
        ("costates.matrices", solution.costates.matrices, (count, ne)),
        ("rates", solution.rates, (count, nx + ne)),
        ("targets", solution.targets, (nx,)),
        ("end_rates", solution.end_rates, (count - 1, nx + ne)),
        ("multipliers.final", m.final, (nx,)),
        ("multipliers.final_matrices", m.final_matrices, (ne,)),
        ("multipliers.start", m.start, (m.start.size,)),
        ("multipliers.end", m.end, (m.end.size,)),
    ]
    for name, array, columns in (
        ("path", m.path, m.path.shape[-1]),
        ("states", m.states, nx),
        ("matrices", m.matrices, ne),
        ("controls", m.controls, nu),
    ):
        rows = controls if name == "controls" else count
        expected.append((f"multipliers.{name}", array, (rows, columns) if array.size else array.shape))
    if solution.filter_gain is not None:
        gain = solution.filter_gain
        expected.append(("filter_gain", gain, (count, len(solution.augmented), gain.shape[-1])))
    if solution.loop is not None:
        size = len(solution.augmented)
        expected += [(f"loop.{name}", getattr(solution.loop, name), (count, size, size)) for name in ("E", "Xhat", "Z")]
        expected.append(("loop.gain", solution.loop.gain, (count, solution.loop.gain.shape[1], size)))
    wrong = [f"{name} {array.shape} instead of {shape}" for name, array, shape in expected if array.shape != shape]
    if wrong:
        raise DamagedFileError("entries of the wrong shape: " + ", ".join(wrong))
