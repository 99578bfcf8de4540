"""Functions of CasADi's scalars on many columns in compiled code, as nodes of expressions."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Protocol
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from covocp.base.expressions import Given
from covocp.base.nodes import Buffers, Node
from covocp.passage.library import functions, needed
from covocp.passage.operations import Program, program

# Columns from which on it pays: to read an operation takes 2 us, which a thousand columns save; a solve asks for some
# twenty runs.
FEWEST = 32


class Owner(Protocol):
    """What nodes live as long as: CasADi's expressions do not keep what Python makes."""

    def __hash__(self) -> int:
        """By identity."""


_KEPT: WeakKeyDictionary[Owner, _Kept] = WeakKeyDictionary()


def in_columns(owner: Owner, function: ca.Function, count: int) -> ca.Function:
    """A function mapped over columns, in compiled code where it pays.

    Args:
        owner: what the node shall live as long as: the statement of the problem.
        function: with the derivatives that CasADi gives it.
        count: columns.

    Returns:
        What `function.map(count)` is, by the same operations. It can be differentiated like that.
    """
    kept = _KEPT.setdefault(owner, _Kept())
    found = kept.nodes.get((function, count))
    if found is not None:
        return found
    # two threads may make it at once: one of both stays, and is what both are given
    return kept.nodes.setdefault((function, count), kept.columns(function, count))


class _Kept:
    """What is kept of one owner: nodes, and operations of functions."""

    def __init__(self) -> None:
        self.nodes: dict[tuple[ca.Function, int], ca.Function] = {}
        self._programs: dict[ca.Function, Program | None] = {}

    def columns(self, function: ca.Function, count: int, name: str = "", options: Given = None) -> ca.Function:
        """A node where it pays, else CasADi's map."""
        if count < FEWEST or functions() is None:
            return function.map(count)
        if function not in self._programs:
            self._programs[function] = program(function)
        listed = self._programs[function]
        return function.map(count) if listed is None else _Columns(self, function, count, listed, name, options)


def beside(shape: ca.Sparsity, count: int) -> ca.Sparsity:
    """A sparsity so many times side by side."""
    rows, columns = shape.shape
    if shape.is_dense():
        return ca.Sparsity.dense(rows, columns * count)
    return ca.repmat(shape, 1, count) if shape.nnz() else ca.Sparsity(rows, columns * count)


class OnColumns:
    """A function of scalars as the library is told of it, on numbers that lie column after column."""

    def __init__(self, function: ca.Function, listed: Program) -> None:
        """Keep what the library points to."""
        self._run = needed()["columns"]
        shapes = [function.sparsity_in(i) for i in range(function.n_in())]
        results = [function.sparsity_out(i) for i in range(function.n_out())]
        self._listed, self._heights = listed, np.array([shape.nnz() for shape in (*shapes, *results)], np.intc)
        rows, constants = listed
        self._told = (
            *(len(rows), rows.ctypes.data, constants.ctypes.data, max(function.sz_w(), 1)),
            *(len(shapes), self._heights.ctypes.data),
        )
        self._places = ctypes.c_void_p * len(self._heights)

    def run(self, addresses: Sequence[int | None], count: int) -> int:
        """Evaluate it on so many columns.

        Args:
            addresses: where the nonzeros of each argument, then of each result lie; None: zeros, or not wanted.
            count: columns.

        Returns:
            0; else there was no memory.
        """
        return int(self._run(*self._told, self._places(*addresses), count))


class _Columns(Node):
    """A function of scalars on columns."""

    def __init__(
        self, kept: _Kept, function: ca.Function, count: int, listed: Program, name: str, options: Given
    ) -> None:
        """Keep what the library is told."""
        self._kept = kept
        self._function, self._count, self._told = function, count, OnColumns(function, listed)
        self._derived: dict[tuple[str, int], ca.Function] = {}
        shapes = [function.sparsity_in(i) for i in range(function.n_in())]
        results = [function.sparsity_out(i) for i in range(function.n_out())]
        inputs, outputs = ([beside(shape, count) for shape in each] for each in (shapes, results))
        own = {"is_diff_in": [function.is_diff_in(i) for i in range(len(shapes))], **(options or {})}
        super().__init__(name or f"columns_{function.name()}", inputs, outputs, own)

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        return self._told.run(needed()["addresses"]((*arguments, *results)), self._count)

    def has_jac_sparsity(self, oind: int, iind: int) -> bool:
        """Of CasADi."""
        return True

    def get_jac_sparsity(self, oind: int, iind: int, symmetric: bool) -> ca.Sparsity:
        """Of CasADi: columns have nothing to do with one another."""
        return ca.diagcat(*[self._function.jac_sparsity(oind, iind)] * self._count)

    def has_reverse(self, nadj: int) -> bool:
        """Of CasADi."""
        return True

    def get_reverse(
        self, nadj: int, name: str, inames: Sequence[str], onames: Sequence[str], opts: Given
    ) -> ca.Function:
        """Of CasADi."""
        return self._derivative("reverse", nadj, name, opts)

    def has_forward(self, nfwd: int) -> bool:
        """Of CasADi."""
        return True

    def get_forward(
        self, nfwd: int, name: str, inames: Sequence[str], onames: Sequence[str], opts: Given
    ) -> ca.Function:
        """Of CasADi."""
        return self._derivative("forward", nfwd, name, opts)

    def _derivative(self, kind: str, directions: int, name: str, options: Given) -> ca.Function:
        """Of one direction the same of columns, of several what CasADi's map gives."""
        found = self._derived.get((kind, directions))
        if found is not None:
            return found
        if directions > 1:
            made = getattr(self._function.map(self._count), kind)(directions)
        else:
            made = self._kept.columns(getattr(self._function, kind)(1), self._count, name, options)
        return self._derived.setdefault((kind, directions), made)
