"""What a figure of solutions shows: panels of curves as plain numbers, before anything is drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from covocp.errors import ProblemError
from covocp.lookup import name_of
from covocp.matrices import Array, half_indices
from covocp.solution import Sample, Solution
from covocp.statement import Block, Statement, entry_names

# Curves are sampled at the nodes, on coarser meshes at least this often.
SAMPLES = 200
# Vectors up to this size get a panel an entry, larger ones share one; matrices up to this size are shown whole, larger
# ones by their diagonal.
SEPARATE_ENTRIES = 3
WHOLE_MATRIX = 2
LONGEST_LABEL = 40


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One curve.

    Args:
        t: times [s].
        y: values, the shape of t.
        deviation: standard deviation, the shape of t; None: no band.
        order: number of its solution.
        entry: number of its entry in a panel of several.
        steps: whether the value holds until the next time.
        target: value asked for at the end.
    """

    t: Array
    y: Array
    deviation: Array | None = None
    order: int = 0
    entry: int = 0
    steps: bool = False
    target: float | None = None


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One pair of axes: its label, the names of its entries (one: all curves are of the same), curves and bounds."""

    label: str
    entries: tuple[str, ...]
    curves: tuple[Curve, ...]
    bounds: tuple[float, ...] = ()


class Drawn:
    """A solution sampled for drawing."""

    def __init__(self, solution: Solution, order: int) -> None:
        """Choose the times."""
        self.solution, self.order = solution, order
        self.names = {b.name for b in solution.blocks}
        self.estimated = any(b.estimation for b in solution.blocks)
        nodes, parts = solution.t, -(-SAMPLES // solution.mesh.intervals)
        if solution.mesh.control == "constant":  # rates jump at the nodes, which a smooth curve would follow
            parts = 1
        inner = nodes[:-1, None] + np.diff(nodes)[:, None] * np.arange(parts) / parts
        self.t = np.append(inner.ravel(), nodes[-1])

    @cached_property
    def sample(self) -> Sample:
        """Values between the nodes."""
        return self.solution.at(self.t)

    def deviation(self, name: str) -> Array | None:
        """Standard deviation of a state or an unknown at the times, (K, size); None where nothing is estimated."""
        if not self.estimated:
            return None
        order = [b for kind in ("state", "unknown") for b in self.solution.blocks if b.kind == kind]
        owners = [b.name for b in order for _ in range(b.size)]
        rows = [i for i, owner in enumerate(owners) if owner == name]
        covariance = self.sample[next(b.name for b in self.solution.blocks if b.estimation)]
        return np.sqrt(np.maximum(covariance[:, rows, rows], 0.0))

    def target(self, block: Block) -> Array:
        """What a state should be at the end, NaN where it is free."""
        if block.kind != "state":
            return np.full(block.size, np.nan)
        return self.solution.targets[block.span]


def choose_panels(
    solutions: list[Solution], names: tuple[Any, ...], *, costates: bool, units: Mapping[str, str]
) -> list[Panel]:
    """The panels of a figure; see `covocp.plot.plot_solutions`.

    Raises:
        ProblemError: a name is in none of the solutions.
    """
    drawn = [Drawn(solution, i) for i, solution in enumerate(solutions)]
    blocks: dict[str, Block] = {}
    for solution in solutions:
        for block in solution.blocks:
            blocks.setdefault(block.name, block)
    keys = [_resolved(solutions, key) for key in names]
    if not names:
        kinds = ("state", "control", "unknown", "matrix")
        keys = [b.name for kind in kinds for b in blocks.values() if b.kind == kind]
    panels: list[Panel] = []
    for key in keys:
        panels += _of_key(drawn, key, blocks, units)
    for key in keys if costates else ():
        if isinstance(key, str) and blocks[key].kind in ("state", "matrix"):
            panels += _costates(drawn, blocks[key])
    return panels


def _of_key(drawn: list[Drawn], key: Any, blocks: Mapping[str, Block], units: Mapping[str, str]) -> list[Panel]:
    """Panels of one quantity."""
    if isinstance(key, tuple):
        return _pair(drawn, key, units)
    if not isinstance(key, str):
        return _expression(drawn, key)
    if blocks[key].kind == "matrix":
        return _matrix(drawn, blocks[key], units)
    return _vector(drawn, blocks[key], units)


def _resolved(solutions: list[Solution], key: Any) -> Any:
    """A name, a pair of names, or the expression itself.

    Raises:
        ProblemError: no solution knows it.
    """
    if isinstance(key, tuple):
        return tuple(_resolved(solutions, part) for part in key)
    error: ProblemError | None = None
    for solution in solutions:
        try:
            return name_of(key, solution.symbols, tuple(b.name for b in solution.blocks))
        except ProblemError as unknown:
            error = unknown
    if error is None or isinstance(key, ca.MX):
        return key
    raise error


def _expression(drawn: list[Drawn], key: Any) -> list[Panel]:
    """An expression of the symbols, at the nodes."""
    curves, count = [], 1
    for d in drawn:
        values = d.solution[key].reshape(d.solution.t.size, -1)
        count = values.shape[1]
        curves += [Curve(t=d.solution.t, y=values[:, i], order=d.order, entry=i) for i in range(count)]
    text = str(key)
    label = text if len(text) <= LONGEST_LABEL else text[: LONGEST_LABEL - 3] + "..."
    return [Panel(label=label, entries=tuple(str(i) for i in range(count)), curves=tuple(curves))]


def _vector(drawn: list[Drawn], block: Block, units: Mapping[str, str]) -> list[Panel]:
    """A state with its band and target, a control, an unknown or a parameter with its band."""
    curves = []
    for d in drawn:
        if block.name not in d.names:
            continue
        own = d.solution.block(block.name)
        t, values = d.t, d.sample[block.name]
        steps = own.kind == "control" and d.solution.mesh.control == "constant"
        if steps:
            t, values = d.solution.t, d.solution.values[block.name]
        values = values.reshape(t.size, -1)
        deviation = d.deviation(block.name) if own.kind in ("state", "unknown") else None
        target = d.target(own)
        curves += [
            Curve(
                t=t,
                y=values[:, i],
                deviation=None if deviation is None else deviation[:, i],
                order=d.order,
                entry=i,
                steps=steps,
                target=None if np.isnan(target[i]) else float(target[i]),
            )
            for i in range(own.size)
        ]
    bounds = _bounds(drawn[0].solution.statement, block)
    suffix = " (estimate)" if block.kind == "unknown" else ""
    return _separated(block.name + suffix, entry_names((block,)), curves, bounds, units.get(block.name, ""))


def _bounds(statement: Statement | None, block: Block) -> Array:
    """Lower and upper bounds of a state or a control, (2, size); infinite where there are none."""
    if statement is None or block.kind not in ("state", "control"):
        return np.tile([[-np.inf], [np.inf]], (1, block.size))
    bounds = statement.state_bounds if block.kind == "state" else statement.control_bounds
    return np.array([bound[block.span] for bound in bounds])


def _separated(name: str, entries: tuple[str, ...], curves: list[Curve], bounds: Array, unit: str) -> list[Panel]:
    """A panel an entry, or one for many of them (then without bands)."""
    unit = f" [{unit}]" if unit else ""
    if len(entries) > SEPARATE_ENTRIES:
        plain = tuple(replace(curve, deviation=None) for curve in curves)
        return [Panel(label=name + unit, entries=entries, curves=plain)]
    suffix = name.removeprefix(name.split(" ")[0])
    return [
        Panel(
            label=entry + suffix + unit,
            entries=(entry,),
            curves=tuple(replace(curve, entry=0) for curve in curves if curve.entry == i),
            bounds=tuple(float(b) for b in bounds[:, i] if np.isfinite(b)),
        )
        for i, entry in enumerate(entries)
    ]


def _matrix(drawn: list[Drawn], block: Block, units: Mapping[str, str]) -> list[Panel]:
    """Entries of a matrix, of a large one its diagonal, grouped by the symbols of its rows."""
    chosen = [d for d in drawn if block.name in d.names]
    histories = [(d.order, d.t, d.sample[block.name]) for d in chosen]
    panels = []
    for pairs in _pairs(block):
        names = tuple(f"{block.name}[{block.labels[i]}, {block.labels[j]}]" for i, j in pairs)
        if len(pairs) > 1:
            names = tuple(block.labels[i] for i, _ in pairs)
        elif block.size == 1:
            names = (block.name,)
        curves = [
            Curve(t=t, y=values[:, i, j], order=order, entry=k)
            for order, t, values in histories
            for k, (i, j) in enumerate(pairs)
        ]
        owners = [block.labels[i].split("[")[0] for i in pairs[0]]
        group = f" of {owners[0]}" if block.estimation else ""
        label = names[0] if len(pairs) == 1 else f"{block.name}, diagonal{group}"
        own = f" [{units[block.name]}]" if units.get(block.name) else ""
        unit = _product(owners, units) if block.estimation else own
        panels.append(Panel(label=label + unit, entries=tuple(names), curves=tuple(curves)))
    return panels


def _pairs(block: Block) -> list[list[tuple[int, int]]]:
    """Entries of a matrix, those that share a panel together."""
    if block.size <= WHOLE_MATRIX:
        return [[(int(min(pair)), int(max(pair)))] for pair in zip(*half_indices(block.size), strict=True)]
    groups: dict[str, list[tuple[int, int]]] = {}
    for i, label in enumerate(block.labels):
        groups.setdefault(label.split("[")[0] if block.estimation else "", []).append((i, i))
    return [
        part
        for group in groups.values()
        for part in ([group] if len(group) > SEPARATE_ENTRIES else [[pair] for pair in group])
    ]


def _pair(drawn: list[Drawn], key: tuple[str, str], units: Mapping[str, str]) -> list[Panel]:
    """A block of the estimation covariance, at the nodes."""
    curves: list[Curve] = []
    names: tuple[str, ...] = ()
    for d in drawn:
        values = d.solution.covariance(*key)
        names = tuple(f"{i}, {j}" for i in range(values.shape[1]) for j in range(values.shape[2]))
        flat = values.reshape(values.shape[0], -1)
        curves += [Curve(t=d.solution.t, y=flat[:, k], order=d.order, entry=k) for k in range(flat.shape[1])]
    matrix = next(b.name for b in drawn[0].solution.blocks if b.estimation)
    label = f"{matrix}[{key[0]}, {key[1]}]" + _product(list(key), units)
    return [Panel(label=label, entries=names, curves=tuple(curves))]


def _product(owners: list[str], units: Mapping[str, str]) -> str:
    """Unit of a covariance between two symbols."""
    words = [units.get(owner, "") for owner in owners]
    if not all(words):
        return ""
    words = [word if word.isalnum() else f"({word})" for word in words]
    return f" [{words[0]}²]" if words[0] == words[-1] else f" [{words[0]} {words[1]}]"


def _costates(drawn: list[Drawn], block: Block) -> list[Panel]:
    """Costates of a state or a matrix, at the nodes."""
    chosen = [d for d in drawn if block.name in d.names]
    name = f"costate of {block.name}"
    if block.kind == "state":
        curves = [
            Curve(t=d.solution.t, y=values, order=d.order, entry=i)
            for d in chosen
            for i, values in enumerate(d.solution.costate(block.name).reshape(d.solution.t.size, -1).T)
        ]
        if block.size > SEPARATE_ENTRIES:
            return [Panel(label=name, entries=entry_names((block,)), curves=tuple(curves))]
        return [
            Panel(
                label=f"costate of {entry}",
                entries=(entry,),
                curves=tuple(replace(curve, entry=0) for curve in curves if curve.entry == i),
            )
            for i, entry in enumerate(entry_names((block,)))
        ]
    pairs = [pair for group in _pairs(block) for pair in group]
    entries = tuple(f"{block.labels[i]}, {block.labels[j]}" for i, j in pairs)
    curves = [
        Curve(t=d.solution.t, y=d.solution.costate(block.name)[:, i, j], order=d.order, entry=k)
        for d in chosen
        for k, (i, j) in enumerate(pairs)
    ]
    return [Panel(label=name, entries=entries, curves=tuple(curves))]
