"""Which rows of a simulation belong to which symbol: of states and unknowns those of their errors."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from covocp.base.expressions import Given
from covocp.statement.augmented import augmented_blocks, check_no_quaternion_entry, without_rows
from covocp.statement.names import name_of, sizes_of, split_entry
from covocp.statement.statement import Block

if TYPE_CHECKING:
    from covocp.simulation.monte_carlo import MonteCarlo

# Where a symbol lies among the rows (2n + m) of deviation, estimate and deviation of the control, and its block.
Place = tuple[slice, Block]


def places(sample: MonteCarlo, *, controls: bool = True) -> dict[str, Place]:
    """Where the states and unknowns, and the controls that are fed back, lie among the rows (2n + m), by name."""
    found = {b.name: (slice(b.offset, b.offset + b.size), b) for b in augmented_blocks(sample.blocks, sample.augmented)}
    for block in sample.blocks:
        if controls and block.kind == "control" and block.offset < sample.nominal_control.shape[1]:
            start = 2 * sample.size + block.offset
            found[block.name] = (slice(start, start + block.size), block)
    return found


def place_of(sample: MonteCarlo, key: Given, *, controls: bool = True) -> Place:
    """Where a symbol, or an entry of one, lies; an entry of an attitude, by name, is one of its error.

    Raises:
        ProblemError: it has no rows.
    """
    found = places(sample, controls=controls)
    _check_rows(sample, key, found)
    # The entries of an attitude's symbol are those of its quaternion.
    sizes = {name: b.size for name, (_, b) in found.items() if isinstance(key, str) or not b.tangent}
    name = name_of(key, sample.symbols, tuple(found), sizes=sizes)
    entry = split_entry(name)
    if name in found or entry is None:
        return found[name]
    rows, owner = found[entry[0]]
    first = rows.start + entry[1]
    return slice(first, first + 1), replace(owner, name=name, size=1, offset=owner.offset + entry[1], tangent=0)


def _check_rows(sample: MonteCarlo, key: Given, found: dict[str, Place]) -> None:
    """What is meant has rows, if it is anything at all.

    Raises:
        ProblemError: it is a symbol of the problem that has none.
    """
    check_no_quaternion_entry(key, sample.symbols, sample.blocks, found)
    every = {block.name: block for block in sample.blocks if block.kind in ("state", "unknown", "control")}
    name = name_of(key, sample.symbols, tuple(every), missing_ok=True, sizes=sizes_of(every.values()))
    entry = split_entry(name)
    owner = every.get(name if name in every or entry is None else entry[0])
    if owner is None:
        return
    if owner.name not in found:
        raise without_rows(name, found, *_kind(owner, sample))


def _kind(block: Block, sample: MonteCarlo) -> tuple[str, str]:
    """What a symbol without rows is, and why it has none."""
    if block.role == "decision":
        return "a decision", "it is the same number in all runs, that of the solution"
    if block.role == "integral":
        return "an integral", "its value is that along the nominal, and violations tell what runs do"
    if block.offset < sample.nominal_control.shape[1]:
        return "a control", "this is known of states and unknowns"
    return "a control that is not fed back", "it is the same in all runs, that of the solution"
