"""Meshes with nodes where something happens: where a measurement is taken there are two, before and after it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from covocp.base.matrices import Array
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Graded, Options

# Share of the terminal time within which a node is the instant itself.
SAME = 1e-9


def with_instants(statement: Statement, options: Options) -> Options:
    """The options with a grid that has the instants of a statement as nodes.

    A uniform mesh becomes uniform between them; to a grid that is given they are added.

    Args:
        statement: the problem.
        options: a grid that is complete stays as it is.
    """
    instants = np.array(statement.instants)
    if not instants.size or isinstance(options.grid, Graded):
        return options
    nodes = np.unique(options.nodes())
    if options.grid is None:
        nodes = _spread(instants, options.intervals)
    asked = options.intervals if options.grid is None else nodes.size - 1
    return replace(options, grid=Graded(nodes=completed(statement, nodes), asked=asked))


def completed(statement: Statement, nodes: Array) -> Array:
    """Some nodes with the instants among them; twice where a measurement is taken."""
    instants = np.array(statement.instants)
    if not instants.size:
        return nodes
    others = np.unique(nodes)
    k = np.clip(np.searchsorted(instants, others), 1, instants.size) - 1
    near = np.minimum(np.abs(others - instants[k]), np.abs(others - instants[np.minimum(k + 1, instants.size - 1)]))
    kept = others[(near > SAME) | (others == 0.0) | (others == 1.0)]
    twice = () if statement.samples is None else statement.samples.instants
    return np.sort(np.concatenate([np.union1d(kept, instants), twice]))


def _spread(instants: Array, intervals: int) -> Array:
    """Nodes evenly spread between the instants, about as many intervals as asked for."""
    ends = np.union1d(instants, [0.0, 1.0])
    parts = [
        begin + (end - begin) * np.arange(count) / count
        for begin, end in pairwise(ends)
        for count in [max(1, round(intervals * (end - begin)))]
    ]
    return np.append(np.concatenate(parts), 1.0)
