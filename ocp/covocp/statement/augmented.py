"""The augmented state, of states and unknowns: which of its rows belong to which symbol."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import accumulate
from typing import Any

from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.statement.entries import error_names, error_size
from covocp.statement.names import name_of, sizes_of, split_entry
from covocp.statement.statement import Block


def augmented_blocks(blocks: Iterable[Block], augmented: tuple[str, ...]) -> tuple[Block, ...]:
    """The states and unknowns that have rows in the augmented state, their sizes and offsets in it.

    Of an attitude these are the three of its error. Decisions and integrals are states without rows.

    Args:
        blocks: of a problem.
        augmented: names of the rows.
    """
    every = tuple(blocks)
    both = [block for kind in ("state", "unknown") for block in every if block.kind == kind]
    own = [block for block in both if error_names((block,))[0] in augmented]
    offsets = accumulate((error_size(block) for block in own), initial=0)
    return tuple(replace(b, size=error_size(b), offset=offset) for b, offset in zip(own, offsets, strict=False))


def check_no_quaternion_entry(
    key: Given, symbols: Mapping[str, Any], blocks: Iterable[Block], rows: Iterable[str]
) -> None:
    """An entry of an attitude's symbol is one of its quaternion, which has no row; by name it is one of its error.

    Args:
        key: what is asked for.
        symbols: by name.
        blocks: of the problem.
        rows: names of what has rows, for the error.

    Raises:
        ProblemError: it is such an entry.
    """
    if isinstance(key, str):
        return
    every = {block.name: block for block in blocks if block.kind != "matrix"}
    name = name_of(key, symbols, tuple(every), missing_ok=True, sizes=sizes_of(every.values()))
    entry = split_entry(name)
    if name not in every and entry is not None and every[entry[0]].tangent:
        raise without_rows(name, rows, f"an entry of the quaternion of '{entry[0]}'", "rows are those of its error")


def without_rows(name: str, rows: Iterable[str], what: str, why: str) -> ProblemError:
    """The error for a symbol that has no deviations."""
    return ProblemError(
        f"There are no deviations of '{name}' here: {why}.",
        expected="a symbol or name of " + ", ".join(rows),
        received=f"'{name}', {what}",
        remedy="ask for one of these",
    )
