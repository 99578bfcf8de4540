"""Meshes with nodes where something happens: at an instant there are two, before and after it.

At an instant a measurement is taken, or a condition holds: a covariance or a costate jumps there. Where a condition is
about what comes after a measurement, or about the control that goes on, there is a third node for it between them.

Data over time have kinks, and models jump where they compare the time (`if_else(time < t_k, ...)`): integration steps
over them lose their order, or do not see what lies between two of them. Those of each of the data, and of each
comparison, are nodes too, of every mesh that was asked to have at least as many intervals; to a coarser one they are
noise, and what they cost is in the error of the mesh.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from covocp.base.matrices import SAME, Array, distinct, near
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Graded, Options


def with_instants(statement: Statement, options: Options, parameters: Array) -> Options:
    """The options with a grid that has the instants of a statement as nodes.

    A uniform mesh becomes uniform between them; to a grid that is given they are added.

    Args:
        statement: the problem.
        options: a grid that has them stays as it is.
        parameters: of the statement.
    """
    if isinstance(options.grid, Graded):
        return _completed_grid(statement, options, options.grid, parameters)
    nodes = distinct(options.nodes())
    asked = nodes.size - 1
    needed = _needed(statement, asked, parameters)
    if not needed.size:
        return options
    if options.grid is None:
        nodes = _spread(needed, options.intervals)
    return replace(options, grid=Graded(nodes=completed(statement, nodes, parameters, asked), asked=asked))


def completed(statement: Statement, nodes: Array, parameters: Array, asked: int | None = None) -> Array:
    """Some nodes with the instants among them, before and after what happens there.

    Args:
        statement: the problem.
        nodes: rising.
        parameters: of the statement.
        asked: number of intervals that the mesh was asked to have; None: those between the nodes.
    """
    needed = _needed(statement, distinct(nodes).size - 1 if asked is None else asked, parameters)
    if not needed.size:
        return nodes
    others = distinct(nodes)
    kept = others[~near(others, needed) | (others == 0.0) | (others == 1.0)]
    return np.sort(np.concatenate([distinct(kept, needed), statement.instants, statement.inside.thrice]))


def _completed_grid(statement: Statement, options: Options, grid: Graded, parameters: Array) -> Options:
    """The options with the instants in a grid that was graded, perhaps for another problem."""
    twice, thrice = np.array(statement.instants), np.array(statement.inside.thrice)
    there = all((np.sum(grid.nodes == place) >= 2 + (place in thrice)) for place in twice)
    if there:
        return options
    return replace(options, grid=replace(grid, nodes=completed(statement, grid.nodes, parameters, grid.asked)))


def _needed(statement: Statement, asked: int, parameters: Array) -> Array:
    """Nodes that a mesh of so many intervals must have."""
    instants = np.array(statement.instants)
    kinks = distinct([place for own in statement.kinks(parameters) if len(own) <= asked for place in own])
    if not kinks.size:
        return instants
    fixed = distinct(instants, [0.0, 1.0])
    kinks = kinks[~near(kinks, fixed)]
    return distinct(instants, kinks[np.diff(kinks, prepend=-1.0) > SAME])


def _spread(instants: Array, intervals: int) -> Array:
    """Nodes evenly spread between the instants, about as many intervals as asked for."""
    ends = distinct(instants, [0.0, 1.0])
    parts = [
        begin + (end - begin) * np.arange(count) / count
        for begin, end in pairwise(ends)
        for count in [max(1, round(intervals * (end - begin)))]
    ]
    return np.append(np.concatenate(parts), 1.0)
