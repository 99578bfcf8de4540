"""The shape of a passage as the C code reads it: sizes, steps, nonzeros of H, an order of elimination."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from covocp.passage.ordering import Ordering, ordering

Pattern = tuple[tuple[int, ...], tuple[int, ...]]


@cache
def shape(
    size: int, pattern: Pattern, count: int, reads: tuple[int, ...], height: int, every: int = 1
) -> NDArray[np.intc]:
    """The array that memory.h describes.

    Args:
        size: n of the covariance.
        pattern: rows and columns of the nonzeros of h H, column by column.
        count: steps, with those that read.
        reads: which of them read.
        height: rows that are read at once.
        every: steps after which something is wanted or given.
    """
    rows, columns = (np.array(part, dtype=np.intc) for part in pattern)
    place = np.empty(count, dtype=np.intc)
    reading = np.isin(np.arange(count), reads)
    place[reading] = -1 - np.arange(len(reads))
    place[~reading] = np.arange(count - len(reads))
    by_rows = np.lexsort((columns, rows))
    begin = np.searchsorted(rows[by_rows], np.arange(2 * size + 1))
    own = ordering(size, *(list(part) for part in pattern))
    head = (size, rows.size, count, height, int(own is not None), every)
    parts = [head, place, rows, columns, begin, columns[by_rows], by_rows, *([] if own is None else _factors(own))]
    return np.concatenate([np.asarray(part, dtype=np.intc) for part in parts])


def _factors(own: Ordering) -> list[NDArray[Any]]:
    """Order, its inverse, and the pattern of the factors before and behind the diagonal of each row."""
    height = own.order.size
    rank = np.argsort(own.order)
    of_row = np.repeat(np.arange(height), np.diff(own.begins))
    facing = np.argsort(own.columns, kind="stable")  # by the row that has the entry before its diagonal
    left = np.searchsorted(own.columns[facing], np.arange(height + 1))
    return [own.order, rank, left, own.begins, own.order[of_row[facing]], facing, own.order[own.columns]]
