"""Panels of a closed loop: root mean squares of the deviations, gains, covariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from covocp.base.expressions import Given
from covocp.plot.curves import GAIN, SEPARATE_ENTRIES, Curve, Drawn, Panel, filter_unit, ratio_unit, shortened, unit_of
from covocp.solution.solution import Solution
from covocp.statement.entries import entry_names, error_names
from covocp.statement.names import block_of
from covocp.statement.statement import Block

# What may be drawn beside the symbols of the problem: root mean squares, gains of feedback and filter, covariances.
RMS, FILTER = "rms", "K"
COVARIANCES = ("X", "Xhat", "Z")
WORDS = (RMS, GAIN, FILTER, *COVARIANCES)
# What the actual system does, what of it the filter does not know, what it knows and has not yet corrected.
PARTS = ("deviation", "error of the estimate", "estimate")


def knows(solution: Solution, word: str) -> bool:
    """Whether a solution has what a word stands for."""
    if word == FILTER:
        return solution.filter_gain is not None and solution.filter_gain.size > 0
    if word == RMS:
        return any(b.estimation and b.covariance for b in solution.blocks)
    return solution.loop is not None


def rms(drawn: Sequence[Drawn], key: Given, blocks: Mapping[str, Block], units: Mapping[str, str]) -> list[Panel]:
    """Root mean squares of the deviations of a symbol or an expression.

    Of one closed loop, also of several phases, with their parts, of several that are compared with the error of the
    estimate. Of unknown constants, whose actual deviations nothing changes, the error of the estimate alone.
    """
    name = key if isinstance(key, str) else shortened(key)
    block = block_of(key, blocks.values()) if isinstance(key, str) else None
    kind = block.kind if block is not None else "state"
    if block is not None and block.size == 1:  # also an entry of the error of an attitude
        block = replace(block, tangent=0)
    entries = error_names((_as_block(name, key) if block is None else block,))
    closed = any(d.solution.loop is not None for d in drawn)
    shown: tuple[int, ...] = (0,)
    if closed and kind == "unknown":
        shown = (1,)
    elif closed and kind == "state" and len(entries) <= SEPARATE_ENTRIES:
        compared = len(drawn) > 1 and not drawn[0].phase
        shown = (0, 1) if compared else (0, 1, 2)  # the third would follow from the others
    curves: list[list[Curve]] = [[] for _ in entries]
    for d in drawn:
        parts = d.spread(key)
        for k in shown if d.solution.loop is not None else shown[:1]:
            for i, values in enumerate(parts[k].T):
                entry = i if len(entries) > SEPARATE_ENTRIES else shown.index(k)
                curves[i].append(Curve(t=d.t, y=values, order=d.order, entry=entry))
    label = "rms error of " if shown == (1,) else "rms of "
    unit = unit_of(name, units)
    if len(entries) > SEPARATE_ENTRIES:
        together = tuple(curve for own in curves for curve in own)
        return [Panel(label=label + name + unit, entries=entries, curves=together)]
    return [
        Panel(label=label + entry + unit, entries=tuple(PARTS[k] for k in shown), curves=tuple(own))
        for entry, own in zip(entries, curves, strict=True)
    ]


def _as_block(name: str, expression: Given) -> Block:
    return Block(name=name, kind="state", size=expression.shape[0] * expression.shape[1], offset=0)


def gain(drawn: Sequence[Drawn], word: str, of: str | None, units: Mapping[str, str]) -> list[Panel]:
    """Entries of the gain of the feedback, by the deviation fed back, or of the filter, by the state corrected.

    Args:
        drawn: solutions that have it.
        word: which gain.
        of: the state or unknown; None: all whose gain is not zero.
        units: by name; where they differ within a panel they stand with its entries.
    """
    fed = word == GAIN
    histories = [d.between(d.solution.gains[word].transpose(0, 2, 1) if fed else d.solution.gains[word]) for d in drawn]
    labels = drawn[0].solution.augmented
    others = _controls(drawn[0].solution) if fed else _measured(drawn[0].solution)
    owners = [name.split("[")[0] for name in (others if fed else _measured(drawn[0].solution, alone=True))]
    panels = []
    some = any(np.any(history) for history in histories)
    for owner in dict.fromkeys(label.split("[")[0] for label in labels) if of is None else (of,):
        rows = [i for i, label in enumerate(labels) if owner in (label, label.split("[")[0])]
        if of is None and some and not any(np.any(history[:, rows]) for history in histories):
            continue
        for group in [rows] if len(rows) > SEPARATE_ENTRIES else [[i] for i in rows]:
            entries = [(i, j) for i in group for j in range(len(others))]
            names = [_entry(labels[i], others[j], fed) for i, j in entries] if len(group) > 1 else list(others)
            pairs = [(owners[j], owner) if fed else (owner, owners[j]) for _, j in entries]
            words = [(ratio_unit if fed else filter_unit)(above, below, units) for above, below in pairs]
            alike = len(set(words)) == 1
            names = names if alike else [name + unit for name, unit in zip(names, words, strict=True)]
            whole = _entry(labels[group[0]] if len(group) == 1 else owner, others[0] if len(others) == 1 else "", fed)
            curves = [
                Curve(t=d.t, y=history[:, i, j], order=d.order, entry=k)
                for d, history in zip(drawn, histories, strict=True)
                for k, (i, j) in enumerate(entries)
            ]
            label = f"{word}[{whole}]" + (words[0] if alike else "")
            panels.append(Panel(label=label, entries=tuple(names), curves=tuple(curves)))
    return panels


def _entry(row: str, other: str, fed: bool) -> str:
    """What an entry of a gain joins: of the feedback control and deviation, of the filter state and measurement."""
    return ", ".join(word for word in ((other, row) if fed else (row, other)) if word)


def _controls(solution: Solution) -> list[str]:
    """Names of the controls that the feedback moves."""
    return list(entry_names(tuple(b for b in solution.blocks if b.kind == "control" and b.name != GAIN)))


def _measured(solution: Solution, *, alone: bool = False) -> list[str]:
    """Names of the measured values, those of a file without its problem with numbers; `alone`: also of a single one."""
    assert solution.filter_gain is not None
    count = solution.filter_gain.shape[2]
    known = solution.statement.measurement_names if solution.statement is not None else ()
    if count == 1 and not alone:
        return [""]
    name = known[0] if len(known) == 1 else "m"
    return list(known) if len(known) == count else [f"{name}[{i}]" for i in range(count)]
