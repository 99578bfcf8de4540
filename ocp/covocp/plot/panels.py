"""What a figure of solutions shows: panels of curves as plain numbers, before anything is drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.matrices import Array, half_indices
from covocp.base.short_repr import short_repr
from covocp.plot.attitude_panels import attitude_panels
from covocp.plot.chance_panels import CHANCE, chance_names, chance_panels
from covocp.plot.curves import GAIN, SEPARATE_ENTRIES, Bound, Curve, Drawn, Panel, product_unit, shortened, unit_of
from covocp.plot.loop_panels import COVARIANCES, FILTER, RMS, WORDS, gain, knows, rms
from covocp.plot.paths import over_panels
from covocp.solution.solution import Solution
from covocp.statement.entries import entry_names
from covocp.statement.names import block_of, chosen_entry, name_of, sizes_of, split_entry
from covocp.statement.statement import Block
from covocp.statement.time_data import in_words

# Matrices up to this size are shown whole, larger ones by their diagonal.
WHOLE_MATRIX = 2
# Entries of a covariance that share a panel, at most: there are so many colours, and dashes, for solutions compared.
COLOURED, DASHED = 7, 5


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """What a panel shows that is no symbol: a word of `loop_panels`, and of which symbol or expression."""

    word: str
    of: Any = None

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Together:
    """Keys that share a panel."""

    keys: tuple[Any, ...]

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Labelled:
    """A key with a label of its own."""

    label: str
    key: Any

    __repr__ = short_repr


def choose_panels(
    solutions: list[Solution],
    names: tuple[Any, ...],
    *,
    costates: bool,
    gains: bool = False,
    over: Given = None,
    units: Mapping[str, str],
    phases: bool = False,
) -> list[Panel]:
    """The panels of a figure; see `covocp.plot.figure.plot_solutions`.

    `phases`: whether the solutions follow each other, instead of being compared.

    Raises:
        ProblemError: a name is in none of the solutions.
    """
    drawn = [Drawn(solution, i, phase=phases) for i, solution in enumerate(solutions)]
    blocks: dict[str, Block] = {}
    for solution in solutions:
        for block in solution.blocks:
            blocks[block.name] = _together(blocks.get(block.name, block), block)
    keys = [key for name in names for key in _keys(solutions, name)]
    keys = keys or [*_usual(drawn, blocks), *(Quantity(word=CHANCE, of=name) for name in chance_names(solutions))]
    if gains:
        keys += [Quantity(word=w) for w in (GAIN, FILTER) if any(knows(solution, w) for solution in solutions)]
    panels: list[Panel] = []
    for key in keys:
        panels += _of_key(drawn, key, blocks, units)
    for key in keys if costates else ():
        if isinstance(key, str) and (block := _block(key, blocks)).kind in ("state", "matrix"):
            panels += _costates(drawn, block)
    panels = _explained_once(panels)
    return panels if over is None else over_panels(drawn, panels, _resolved(solutions, over), units)


def _together(one: Block, other: Block) -> Block:
    """A covariance of the estimation error with the rows of two solutions; of everything else the first counts."""
    if not (one.estimation and other.estimation) or one.labels == other.labels:
        return one
    labels = tuple(dict.fromkeys((*one.labels, *other.labels)))
    return replace(one, labels=labels, size=len(labels))


def _in_order(values: Array, own: tuple[str, ...], labels: tuple[str, ...]) -> Array:
    """Values of a matrix (K, n, n) in another order of its rows; NaN for those that it has not."""
    if own == labels:
        return values
    places = [own.index(label) if label in own else -1 for label in labels]
    missing = np.array([place < 0 for place in places])
    result = values[:, places][:, :, places].copy()
    result[:, missing] = np.nan
    result[:, :, missing] = np.nan
    return result


def _explained_once(panels: list[Panel]) -> list[Panel]:
    """Where several panels have the same entries the first one explains them."""
    return [replace(p, legend=all(p.entries != other.entries for other in panels[:i])) for i, p in enumerate(panels)]


def _usual(drawn: list[Drawn], blocks: Mapping[str, Block]) -> list[Any]:
    """What is drawn where nothing is asked for.

    Of closed loops root mean squares stand in place of the covariances that they come from; decisions and integrals are
    numbers, which print shows.
    """
    kinds = ("state", "control", "unknown", "matrix")
    ordered = [b for kind in kinds for b in blocks.values() if b.kind == kind and b.role == "moving"]
    if all(d.solution.loop is None for d in drawn):
        return [b.name for b in ordered]
    plain = [b for b in ordered if b.name not in (GAIN, *COVARIANCES) and not (b.estimation or b.backward)]
    uncertain = [b.name for b in plain if b.kind == "state" and any(_varies(d, b) for d in drawn)]
    return [*(b.name for b in plain), *(Quantity(word=RMS, of=name) for name in uncertain)]


def _varies(drawn: Drawn, block: Block) -> bool:
    """Whether a state is uncertain."""
    deviation = drawn.deviation(block) if drawn.knows(block.name) else None
    return deviation is not None and bool(np.any(deviation))


def _keys(solutions: list[Solution], name: Given) -> list[Any]:
    """What a name given by the user stands for; a dict gives its entries labels.

    Raises:
        ProblemError: no solution knows it.
    """
    if isinstance(name, Mapping):
        return [Labelled(label=str(label), key=_resolved(solutions, key)) for label, key in name.items()]
    return [_resolved(solutions, name)]


def _of_key(drawn: list[Drawn], key: Given, blocks: Mapping[str, Block], units: Mapping[str, str]) -> list[Panel]:
    """Panels of one quantity."""
    if isinstance(key, Labelled):
        panels = _of_key(drawn, key.key, blocks, units)
        if len(panels) == 1:
            return [replace(panels[0], label=key.label)]
        return [replace(panel, label=f"{key.label}: {panel.label}") for panel in panels]
    if isinstance(key, Together):
        return [_shared([panel for part in key.keys for panel in _of_key(drawn, part, blocks, units)])]
    if isinstance(key, Quantity) and key.word == CHANCE:
        return chance_panels(drawn, key.of)
    if isinstance(key, Quantity):
        return _quantity([d for d in drawn if knows(d.solution, key.word)], key, blocks, units)
    if isinstance(key, tuple):
        return _pair(drawn, key, units)
    if not isinstance(key, str):
        return _expression(drawn, key)
    block = _block(key, blocks)
    if block.kind == "matrix":
        known = [(d, d.solution.block(key).labels) for d in drawn if d.knows(key)]
        return _matrix([(d, d.t, _in_order(d.sample[key], own, block.labels)) for d, own in known], block, units)
    return _vector(drawn, block, units)


def _shared(panels: list[Panel]) -> Panel:
    """Several panels as one whose entries they are; the unit stands on the axis where it is the same.

    Raises:
        ProblemError: there are none.
    """
    if not panels:
        raise ProblemError(
            "A panel has nothing to show.",
            expected="a list of names or symbols that share it",
            received="an empty list",
            remedy="name what is to be drawn, or leave the list out",
        )
    entries: list[str] = []
    curves: list[Curve] = []
    parts = [panel.label.rpartition(" [") if panel.label.endswith("]") else ("", "", panel.label) for panel in panels]
    plain = [name or whole for name, _, whole in parts]
    units = {unit if name else "" for name, _, unit in parts}
    for panel, name in zip(panels, plain, strict=True):
        curves += [replace(curve, entry=curve.entry + len(entries)) for curve in panel.curves]
        own = name if len(units) == 1 else panel.label
        entries += [own] if len(panel.entries) == 1 else list(panel.entries)
    unit = units.pop() if len(units) == 1 else ""
    label = shortened(", ".join(plain)) + (f" [{unit}" if unit else "")
    bounds = tuple(dict.fromkeys(bound for panel in panels for bound in panel.bounds))
    return Panel(label=label, entries=tuple(entries), curves=tuple(curves), bounds=bounds)


def _block(name: str, blocks: Mapping[str, Block]) -> Block:
    """Where a name that was found, or an entry of it, lies."""
    found = block_of(name, blocks.values())
    assert found is not None
    return found


def _quantity(drawn: list[Drawn], key: Quantity, blocks: Mapping[str, Block], units: Mapping[str, str]) -> list[Panel]:
    """Root mean squares, gains or covariances, of the solutions that have them."""
    if isinstance(key.of, str):
        drawn = [d for d in drawn if d.knows(key.of)]
    if key.word in (GAIN, FILTER):
        return gain(drawn, key.word, key.of, units)
    if key.word == RMS:
        every = [b.name for b in blocks.values() if b.kind in ("state", "unknown") and drawn[0].rows(b.name)]
        chosen = every if key.of is None else [key.of]
        return [panel for of in chosen for panel in rms(drawn, of, blocks, units)]
    labels = drawn[0].solution.augmented
    block = Block(name=key.word, kind="matrix", size=len(labels), offset=0, labels=labels, estimation=True)
    return _matrix([(d, d.t, getattr(d.covariances, key.word)) for d in drawn], block, units)


def _resolved(solutions: list[Solution], key: Given) -> Any:
    """A name, a pair of names, a quantity, or the expression itself.

    Raises:
        ProblemError: no solution knows it.
    """
    if isinstance(key, tuple):
        word = key[0] if len(key) == 2 and isinstance(key[0], str) and key[0] in (RMS, GAIN, FILTER) else ""
        if word and any(knows(solution, word) for solution in solutions) and not _declared(solutions, word):
            return Quantity(word=word, of=_uncertain(solutions, word, key[1]))
        return tuple(_resolved(solutions, part) for part in key)
    if isinstance(key, list):
        return Together(keys=tuple(_resolved(solutions, part) for part in key))
    error: ProblemError | None = None
    if isinstance(key, str) and (course := _course(solutions, key)) is not None:
        return course
    if isinstance(key, str) and key in chance_names(solutions) and not _declared(solutions, key):
        return Quantity(word=CHANCE, of=key)
    if isinstance(key, str) and key in WORDS and not _declared(solutions, key):
        if any(knows(solution, key) for solution in solutions):
            return Quantity(word=key)
        raise _unknown_word(key)
    for solution in solutions:
        try:
            names = tuple(b.name for b in solution.blocks)
            return name_of(key, solution.symbols, names, sizes=sizes_of(solution.blocks))
        except ProblemError as unknown:
            error = unknown
    if error is None or isinstance(key, ca.MX):
        return key
    raise error


def _course(solutions: list[Solution], name: str) -> Any:
    """The expression of data over time, or of an entry of them, by name; None where it is no such name."""
    vector, k = split_entry(name) or (name, -1)
    for entry in (entry for solution in solutions if solution.statement for entry in solution.statement.data):
        if entry.name == name:
            return entry.expression
        if entry.name == vector and k < entry.values.shape[1]:
            return entry.expression[k]
    return None


def _uncertain(solutions: list[Solution], word: str, key: Given) -> Any:
    """What a root mean square or a gain may be of.

    Raises:
        ProblemError: it is something else.
    """
    of = _resolved(solutions, key)
    if word == RMS and isinstance(of, ca.MX):
        return of
    names = {label.split("[")[0] for solution in solutions for label in solution.augmented}
    if word == RMS:
        loops = [solution for solution in solutions if solution.loop is not None]
        names |= {b.name for solution in loops for b in solution.blocks if b.kind == "control" and b.name != GAIN}
    if not isinstance(of, str) or not names & {of, of.split("[")[0]}:
        raise ProblemError(
            f"There is no ('{word}', {shortened(key)}).",
            expected="a state or an unknown with a covariance: " + ", ".join(sorted(names)),
            received=shortened(key),
            remedy="choose one of them" + (", or an expression of them" if word == RMS else ""),
        )
    return of


def _declared(solutions: list[Solution], word: str) -> bool:
    """Whether a word is a name of the user's; the gain of a constrained feedback is drawn as a gain."""
    names = [(b.name, solution) for solution in solutions for b in solution.blocks]
    return any(name == word and not (word == GAIN and solution.loop) for name, solution in names)


def _unknown_word(word: str) -> ProblemError:
    needed = {FILTER: "a measurement and an estimation covariance", RMS: "an estimation covariance"}
    return ProblemError(
        f"'{word}' is not in this solution.",
        expected=f"a problem with {needed.get(word, 'minimize_expected()')}",
        received=f"'{word}' of a problem without",
        remedy="draw something else",
    )


def abscissa_label(solutions: list[Solution], over: Given, units: Mapping[str, str]) -> str:
    """Label of an abscissa that is not time."""
    key = _resolved(solutions, over)
    return key + unit_of(key, units) if isinstance(key, str) else shortened(key)


def _expression(drawn: list[Drawn], key: Given) -> list[Panel]:
    """An expression of the symbols with its band."""
    curves: list[Curve] = []
    for d in drawn:
        t, values, spread = d.expression(key)
        curves += [
            Curve(
                t=t,
                y=values[:, i],
                deviation=spread[:, i] if np.any(spread[:, i]) else None,
                order=d.order,
                entry=i,
            )
            for i in range(values.shape[1])
        ]
    count = key.shape[0] * key.shape[1]
    return [Panel(label=_written(drawn, key), entries=tuple(str(i) for i in range(count)), curves=tuple(curves))]


def _written(drawn: list[Drawn], key: Any) -> str:
    """An expression with the names of data over time in it; one of the data with its unit."""
    data = {entry.name: entry for d in drawn for entry in d.solution.extremal.statement.data}
    (named,), symbols = in_words(data.values(), [key])
    unit = next((e.unit for e, s in zip(data.values(), symbols, strict=True) if _part_of(named, s)), "")
    return shortened(named) + (f" [{unit}]" if unit else "")


def _part_of(expression: Any, symbol: Any) -> bool:
    """Whether an expression is a symbol or an entry of it."""
    return bool(ca.is_equal(expression, symbol)) or chosen_entry(expression, symbol) >= 0


def _vector(drawn: list[Drawn], block: Block, units: Mapping[str, str]) -> list[Panel]:
    """A state with its band and target, a control, an unknown or a parameter with its band."""
    if block.tangent:
        return attitude_panels(drawn, block)
    curves = []
    for d in drawn:
        if not d.knows(block.name):
            continue
        own = d.solution.block(block.name)
        t, values = d.t, d.sample[block.name]
        steps = own.kind == "control" and d.solution.mesh.control == "constant"
        if steps:
            t, values = d.solution.t, d.solution[block.name]
        values = values.reshape(t.size, -1)
        deviation = d.deviation(own) if own.kind in ("state", "unknown", "control") else None
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
    bounds = [_bounds(d, block) for d in drawn if d.knows(block.name)]
    suffix = " (estimate)" if block.kind == "unknown" else ""
    return _separated(block, suffix + unit_of(block.name, units), curves, bounds)


def _bounds(drawn: Drawn, block: Block) -> list[list[Bound]]:
    """Bounds of the entries of a state or a control that a solution has; of others none."""
    statement, own = drawn.solution.statement, drawn.solution.block(block.name)
    if statement is None or own.kind not in ("state", "control"):
        return [[] for _ in range(own.size)]
    bounds = statement.state_bounds if own.kind == "state" else statement.control_bounds
    lower, upper = (bound[own.span] for bound in bounds)
    return [drawn.bounds(pair) for pair in zip(lower, upper, strict=True)]


def _separated(block: Block, suffix: str, curves: list[Curve], bounds: Sequence[list[list[Bound]]] = ()) -> list[Panel]:
    """A panel an entry, with the bounds of each solution, or one for many of them (then without both and bands)."""
    entries = entry_names((block,))
    if len(entries) > SEPARATE_ENTRIES:
        plain = tuple(replace(curve, deviation=None) for curve in curves)
        return [Panel(label=block.name + suffix, entries=entries, curves=plain)]
    return [
        Panel(
            label=entry + suffix,
            entries=(entry,),
            key=entry,
            curves=tuple(replace(curve, entry=0) for curve in curves if curve.entry == i),
            bounds=tuple(dict.fromkeys(bound for own in bounds for bound in own[i])),
        )
        for i, entry in enumerate(entries)
    ]


def _matrix(histories: list[tuple[Drawn, Array, Array]], block: Block, units: Mapping[str, str]) -> list[Panel]:
    """Entries of a matrix, of a large one its diagonal, grouped by the symbols of its rows."""
    panels = []
    for pairs in _pairs(block):
        names = tuple(f"{block.name}[{block.labels[i]}, {block.labels[j]}]" for i, j in pairs)
        if len(pairs) > 1:
            names = tuple(block.labels[i] for i, _ in pairs)
        elif block.size == 1:
            names = (block.name,)
        curves = [
            Curve(t=t, y=values[:, i, j], order=d.order, entry=k)
            for d, t, values in histories
            for k, (i, j) in enumerate(pairs)
        ]
        owners = [block.labels[i].split("[")[0] for i in pairs[0]]
        group = f" of {owners[0]}" if block.estimation else ""
        label = names[0] if len(pairs) == 1 else f"{block.name}, diagonal{group}"
        unit = product_unit(owners, units) if block.estimation else unit_of(block.name, units)
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
    """A block of the covariance of the actual deviations, between the nodes as the whole matrix has it.

    Of a symbol with itself each entry once. Where these would not be told apart each row has a panel.
    """
    chosen = [d for d in drawn if all(not isinstance(part, str) or d.knows(part) for part in key)] or drawn
    blocks = [(d, d.block(*key)) for d in chosen]
    count, width = (max(values.shape[axis] for _, values in blocks) for axis in (1, 2))
    rows = [[(i, j) for j in range(i if key[0] == key[1] else 0, width)] for i in range(count)]
    every = [pair for row in rows for pair in row]
    closed = any(d.solution.loop is not None for d in drawn)
    matrix = COVARIANCES[0] if closed else next(b.name for b in drawn[0].solution.blocks if b.estimation)
    unit = product_unit(list(key), units)
    panels = []
    most = DASHED if len(drawn) > 1 and not drawn[0].phase else COLOURED
    for group in [every] if len(every) <= most else rows:
        curves = [
            Curve(t=d.t, y=values[:, i, j], order=d.order, entry=k)
            for d, values in blocks
            for k, (i, j) in enumerate(group)
            if i < values.shape[1] and j < values.shape[2]
        ]
        row = key[0] if len(group) == len(every) else f"{key[0]}[{group[0][0]}]"
        names = tuple(f"{i}, {j}" for i, j in group)
        panels.append(Panel(label=f"{matrix}[{row}, {key[1]}]{unit}", entries=names, curves=tuple(curves)))
    return panels


def _costates(drawn: list[Drawn], block: Block) -> list[Panel]:
    """Costates of a state or a matrix, at the nodes."""
    chosen = [d for d in drawn if d.knows(block.name)]
    if block.kind == "state":
        curves = [
            Curve(t=d.solution.t, y=values, order=d.order, entry=i)
            for d in chosen
            for i, values in enumerate(d.solution.costate(block.name).reshape(d.solution.t.size, -1).T)
        ]
        panels = _separated(block, "", curves)
        return [replace(panel, label=f"costate of {panel.label}", key="") for panel in panels]
    pairs = [pair for group in _pairs(block) for pair in group]
    entries = tuple(f"{block.labels[i]}, {block.labels[j]}" for i, j in pairs)
    curves = [
        Curve(t=d.solution.t, y=costates[:, i, j], order=d.order, entry=k)
        for d in chosen
        for costates in [_in_order(d.solution.costate(block.name), d.solution.block(block.name).labels, block.labels)]
        for k, (i, j) in enumerate(pairs)
    ]
    return [Panel(label=f"costate of {block.name}", entries=entries, curves=tuple(curves))]
