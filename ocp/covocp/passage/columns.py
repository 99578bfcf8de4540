"""Functions of CasADi's scalars on many columns in compiled code, as nodes of expressions."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Protocol
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from covocp.base.expressions import Given, sequence_of
from covocp.base.matrices import Array
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


def in_turn(owner: Owner, function: ca.Function, steps: int, sequences: int) -> ca.Function:
    """A function of a value and others in sequences from several first values, in compiled code.

    Args:
        owner: as of `in_columns`.
        function: (value, *others) -> value after it, and more; all dense.
        steps: in each sequence.
        sequences: from a first value each.

    Returns:
        (first values, columns of the others, sequence after sequence) -> columns of what the function gives, as
        `sequence_of` mapped over the sequences.
    """
    kept = _KEPT.setdefault(owner, _Kept())
    key = (function, steps * sequences, steps)
    found = kept.nodes.get(key)
    return kept.nodes.setdefault(key, kept.sequences(function, steps, sequences)) if found is None else found


def numbers_in_turn(
    owner: Owner, function: ca.Function, first: Array, columns: Sequence[Array], steps: int
) -> list[Array] | None:
    """What `in_turn` gives of numbers, without a node.

    Args:
        owner: as of `in_columns`.
        function: as of `in_turn`.
        first: first values, a column for each sequence.
        columns: of the others, sequence after sequence.
        steps: in each sequence.

    Returns:
        Columns of what the function gives; None where compiled code cannot take it.

    Raises:
        MemoryError: there was none.
    """
    told = _KEPT.setdefault(owner, _Kept()).told(function)
    if told is None or not told.plain or not told.whole:
        return None
    return told.of_numbers((first, *columns), first.shape[1], steps)


def numbers_in_columns(owner: Owner, function: ca.Function, columns: Sequence[Array]) -> list[Array] | None:
    """What `in_columns` gives of numbers, without a node.

    Args:
        owner: as of `in_columns`.
        function: of dense arguments, one column each.
        columns: of all of them.

    Returns:
        Columns of what the function gives; None where compiled code cannot take it or does not pay, or where something
        is sparse.

    Raises:
        MemoryError: there was none.
    """
    kept = _KEPT.setdefault(owner, _Kept())
    told = kept.told(function) if columns[0].shape[1] >= FEWEST or kept.knows(function) else None
    if told is None or not told.whole:
        return None
    return told.of_numbers(columns, columns[0].shape[1])


class _Kept:
    """What is kept of one owner: nodes, and functions as the library is told of them."""

    def __init__(self) -> None:
        self.nodes: dict[tuple[ca.Function, int] | tuple[ca.Function, int, int], ca.Function] = {}
        self._told: dict[ca.Function, OnColumns | None] = {}

    def knows(self, function: ca.Function) -> bool:
        """Whether its operations were read."""
        return function in self._told

    def told(self, function: ca.Function) -> OnColumns | None:
        """A function as the library is told of it; None without the library, or where operations are not known."""
        if functions() is None:
            return None
        if function not in self._told:
            listed = program(function)
            self._told[function] = None if listed is None else OnColumns(function, listed)
        return self._told[function]

    def columns(self, function: ca.Function, count: int, name: str = "", options: Given = None) -> ca.Function:
        """A node where it pays, else CasADi's map."""
        told = self.told(function) if count >= FEWEST else None
        return function.map(count) if told is None else _Columns(self, function, (count, 1), told, name, options)

    def sequences(self, function: ca.Function, steps: int, sequences: int) -> ca.Function:
        """A node of sequences where these can be had, else CasADi's."""
        told = self.told(function)
        if told is None or not told.plain:
            return _of_casadi(function, steps, sequences)
        return _Columns(self, function, (sequences, steps), told)


def _of_casadi(function: ca.Function, steps: int, sequences: int) -> ca.Function:
    """Sequences of a function, or columns of it where each has one step, by CasADi's own."""
    run = sequence_of(function, steps)
    return run.map(sequences) if sequences > 1 else run


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
        self.inputs = [function.sparsity_in(i) for i in range(function.n_in())]
        self.outputs = [function.sparsity_out(i) for i in range(function.n_out())]
        self._listed, heights = listed, [shape.nnz() for shape in (*self.inputs, *self.outputs)]
        self._heights = np.array(heights, np.intc)
        rows, constants = listed
        self._told = (
            *(len(rows), rows.ctypes.data, constants.ctypes.data, max(function.sz_w(), 1)),
            *(len(self.inputs), self._heights.ctypes.data),
        )
        self._places = ctypes.c_void_p * len(heights)

    @property
    def plain(self) -> bool:
        """Whether arguments and the first result are dense, and the first ones alike: what sequences are made of."""
        shapes = (*self.inputs, self.outputs[0])
        return all(shape.is_dense() for shape in shapes) and self.inputs[0].shape == self.outputs[0].shape

    @property
    def whole(self) -> bool:
        """Whether what is given and found is dense, or nothing at all."""
        return all(shape.is_dense() or not shape.nnz() for shape in (*self.inputs, *self.outputs))

    def of_numbers(self, columns: Sequence[Array], count: int, steps: int = 1) -> list[Array]:
        """What `run` makes of dense arguments, as new matrices of dense results.

        Raises:
            MemoryError: there was none.
        """
        given = [np.asfortranarray(values, dtype=float) for values in columns]
        width = count * steps
        found = [np.zeros((shape.shape[0], shape.shape[1] * width), order="F") for shape in self.outputs]
        if self.run([array.ctypes.data for array in (*given, *found)], count, steps):
            raise MemoryError
        return found

    def run(self, addresses: Sequence[int | None], count: int, steps: int = 1) -> int:
        """Evaluate it on so many columns, or sequences of them.

        Args:
            addresses: where the nonzeros of each argument, then of each result lie; None: zeros, or not wanted.
            count: columns, or sequences.
            steps: of each sequence.

        Returns:
            0; else there was no memory.
        """
        return int(self._run(*self._told, self._places(*addresses), steps, count))


class _Columns(Node):
    """A function of scalars on columns, or on sequences of them."""

    def __init__(
        self,
        kept: _Kept,
        function: ca.Function,
        size: tuple[int, int],
        told: OnColumns,
        name: str = "",
        options: Given = None,
    ) -> None:
        """Keep what the library is told; size: sequences, and steps of each."""
        self._kept = kept
        self._function, self._told = function, told
        self._count, self._steps = size
        self._derived: dict[tuple[str, int], ca.Function] = {}
        widths = [self._count, *[self._count * self._steps] * (len(told.inputs) - 1 + len(told.outputs))]
        shapes = [beside(own, width) for own, width in zip((*told.inputs, *told.outputs), widths, strict=True)]
        inputs, outputs = shapes[: len(told.inputs)], shapes[len(told.inputs) :]
        own = {"is_diff_in": [function.is_diff_in(i) for i in range(len(inputs))], **(options or {})}
        kind = "columns" if self._steps == 1 else "sequences"
        super().__init__(name or f"{kind}_{function.name()}", inputs, outputs, own)

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        return self._told.run(needed()["addresses"]((*arguments, *results)), self._count, self._steps)

    def has_jac_sparsity(self, oind: int, iind: int) -> bool:
        """Of CasADi."""
        return True

    def get_jac_sparsity(self, oind: int, iind: int, symmetric: bool) -> ca.Sparsity:
        """Of CasADi: columns have nothing to do with one another, and sequences are CasADi's own."""
        if self._steps > 1:
            return _of_casadi(self._function, self._steps, self._count).jac_sparsity(oind, iind)
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
        """Of one direction the same of columns; of several, and of sequences, what CasADi's own gives."""
        found = self._derived.get((kind, directions))
        if found is not None:
            return found
        if self._steps > 1:
            made = getattr(_of_casadi(self._function, self._steps, self._count), kind)(directions)
        elif directions > 1:
            made = getattr(self._function.map(self._count), kind)(directions)
        else:
            made = self._kept.columns(getattr(self._function, kind)(1), self._count, name, options)
        return self._derived.setdefault((kind, directions), made)
