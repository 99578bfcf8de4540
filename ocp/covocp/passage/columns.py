"""Functions of CasADi's scalars on many columns in compiled code, as nodes of expressions."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Protocol
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from covocp.base.expressions import Given, sequence_of
from covocp.base.matrices import Array
from covocp.base.nodes import Buffers, Node
from covocp.base.threads import cached
from covocp.passage.library import functions, needed
from covocp.passage.operations import OF_TWO, Program, program

# Columns from which on it pays: to read an operation takes 2 us, which a thousand columns save; a solve asks for some
# twenty runs.
FEWEST = 32
# Operations of a derivative for each of the function, at most.
MOST_TIMES = 12


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


def derivative_in_columns(owner: Owner, function: ca.Function, *kinds: str) -> OnColumns | None:
    """A derivative of a function along one direction, for numbers, as nodes of `in_columns` have it.

    Args:
        owner: as of `in_columns`.
        function: of dense arguments, one column each.
        kinds: "forward" or "reverse", and of what comes of that again.

    Returns:
        The derivative, with the arguments and results that CasADi gives it; None where compiled code cannot take it, or
        where something is sparse.
    """
    told = _KEPT.setdefault(owner, _Kept()).told(function)
    moving = [function.is_diff_in(i) for i in range(function.n_in())]
    for kind in kinds:
        if told is None:
            return None
        ends = told.outputs if kind == "reverse" else told.inputs
        moved = [*moving, *([True] * (len(told.outputs) + len(ends)))]
        told, moving = told.derived(kind, tuple(moving)), moved
    return told if told is not None and told.whole else None


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
            self._told[function] = None if listed is None else OnColumns.of(function, listed)
        return self._told[function]

    def columns(self, function: ca.Function, count: int, name: str = "", options: Given = None) -> ca.Function:
        """A node where it pays, else CasADi's map."""
        told = self.told(function) if count >= FEWEST else None
        if told is None:
            return function.map(count)
        return _Columns(self, _Source.of(function), (count, 1), told, name, options)

    def sequences(self, function: ca.Function, steps: int, sequences: int) -> ca.Function:
        """A node of sequences where these can be had, else CasADi's."""
        told = self.told(function)
        if told is None or not told.plain:
            return _of_casadi(function, steps, sequences)
        return _Columns(self, _Source.of(function), (sequences, steps), told)


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

    def __init__(self, inputs: list[ca.Sparsity], outputs: list[ca.Sparsity], listed: Program, registers: int) -> None:
        """Keep what the library points to."""
        self._run = needed()["columns"]
        self.inputs, self.outputs, self._registers = inputs, outputs, max(registers, 1)
        self._listed, heights = listed, [shape.nnz() for shape in (*self.inputs, *self.outputs)]
        self._heights = np.array(heights, np.intc)
        self._derived: dict[tuple[str, tuple[bool, ...]], OnColumns | None] = {}
        rows, constants = listed
        self._operations = len(rows), rows.ctypes.data, constants.ctypes.data, self._registers
        self._told = *self._operations, len(self.inputs), self._heights.ctypes.data
        self._places = ctypes.c_void_p * len(heights)

    @classmethod
    def of(cls, function: ca.Function, listed: Program) -> OnColumns:
        """Of a function of CasADi's and its operations."""
        inputs = [function.sparsity_in(i) for i in range(function.n_in())]
        outputs = [function.sparsity_out(i) for i in range(function.n_out())]
        return cls(inputs, outputs, listed, function.sz_w())

    def derived(self, kind: str, moving: tuple[bool, ...]) -> OnColumns | None:
        """Its derivative along one direction, with the arguments and results that CasADi gives it; remembered.

        Args:
            kind: "forward" or "reverse".
            moving: of each argument, whether it is differentiated by it.

        Returns:
            None where that takes more operations than is thought of, or arguments are sparse.
        """
        key = kind, moving
        if key not in self._derived:
            self._derived[key] = self._derivative(kind == "reverse", moving) if self.whole else None
        return self._derived[key]

    def _derivative(self, reverse: bool, moving: tuple[bool, ...]) -> OnColumns | None:
        ends = (self.outputs, self.inputs) if reverse else (self.inputs, self.outputs)
        most = MOST_TIMES * len(self._listed[0]) + 2 * int(self._heights.sum()) + MOST_TIMES
        rows, constants = np.empty((most, 4), np.intc), np.empty(most)
        wanted, there, registers = np.array(moving, np.intc), np.empty(len(ends[1]), np.intc), np.zeros(1, np.intc)
        count = needed()["derived_program"](
            *(reverse, *self._operations, len(self.inputs), len(self.outputs), self._heights.ctypes.data),
            *(wanted.ctypes.data, OF_TWO.ctypes.data, most, rows.ctypes.data, constants.ctypes.data),
            *(there.ctypes.data, registers.ctypes.data),
        )
        if count < 0:
            return None
        found = [shape if own else ca.Sparsity(*shape.shape) for shape, own in zip(ends[1], there, strict=True)]
        given = [*self.inputs, *(ca.Sparsity(*shape.shape) for shape in self.outputs), *ends[0]]
        return OnColumns(given, found, (rows[:count].copy(), constants[:count].copy()), int(registers[0]))

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


class Prepared:
    """A function on columns of numbers that change where they lie, evaluated again and again.

    Attributes:
        found: columns of each result; empty where a result is nothing.
    """

    def __init__(self, told: OnColumns, given: Sequence[Array | None], count: int) -> None:
        """Make room for the results.

        Args:
            told: the function.
            given: of each argument its columns (rows, count), dense and in Fortran's order, kept here; None: zeros.
            count: columns.
        """
        shapes = [(shape.shape[0] if shape.nnz() else 0, shape.shape[1] * count) for shape in told.outputs]
        self.found = [np.zeros(shape, order="F") for shape in shapes]
        self._told, self._given, self._count = told, given, count
        self._places = [None if array is None else array.ctypes.data for array in (*given, *self.found)]

    def run(self) -> None:
        """Evaluate it.

        Raises:
            MemoryError: there was none.
        """
        if self._told.run(self._places, self._count):
            raise MemoryError


class _Source:
    """A function of CasADi's that is made when it is asked for: derivatives that the library makes have none before."""

    def __init__(self, name: str, moving: list[bool] | None, make: Callable[[], ca.Function]) -> None:
        """Take its name, by which arguments it may be differentiated (None: CasADi says so), and what makes it."""
        self.name, self.moving, self._make = name, moving, make

    @classmethod
    def of(cls, function: ca.Function) -> _Source:
        """Of a function that is there."""
        moving = [function.is_diff_in(i) for i in range(function.n_in())]
        return cls(function.name(), moving, lambda: function)

    @cached
    def function(self) -> ca.Function:
        """The function."""
        return self._make()


class _Columns(Node):
    """A function of scalars on columns, or on sequences of them."""

    def __init__(
        self,
        kept: _Kept,
        source: _Source,
        size: tuple[int, int],
        told: OnColumns,
        name: str = "",
        options: Given = None,
    ) -> None:
        """Keep what the library is told; size: sequences, and steps of each."""
        self._kept = kept
        self._source, self._told = source, told
        self._count, self._steps = size
        self._derived: dict[tuple[str, int], ca.Function] = {}
        widths = [self._count, *[self._count * self._steps] * (len(told.inputs) - 1 + len(told.outputs))]
        shapes = [beside(own, width) for own, width in zip((*told.inputs, *told.outputs), widths, strict=True)]
        inputs, outputs = shapes[: len(told.inputs)], shapes[len(told.inputs) :]
        own = {} if source.moving is None else {"is_diff_in": source.moving}
        kind = "columns" if self._steps == 1 else "sequences"
        super().__init__(name or f"{kind}_{source.name}", inputs, outputs, own | dict(options or {}))

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        return self._told.run(needed()["addresses"]((*arguments, *results)), self._count, self._steps)

    def has_jac_sparsity(self, oind: int, iind: int) -> bool:
        """Of CasADi."""
        return True

    def get_jac_sparsity(self, oind: int, iind: int, symmetric: bool) -> ca.Sparsity:
        """Of CasADi: columns have nothing to do with one another, and sequences are CasADi's own."""
        if self._steps > 1:
            return _of_casadi(self._source.function, self._steps, self._count).jac_sparsity(oind, iind)
        return ca.diagcat(*[self._source.function.jac_sparsity(oind, iind)] * self._count)

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
            made = getattr(_of_casadi(self._source.function, self._steps, self._count), kind)(directions)
        elif directions > 1:
            made = getattr(self._source.function.map(self._count), kind)(directions)
        else:
            made = self._along_one(kind, name, options)
        return self._derived.setdefault((kind, directions), made)

    def _along_one(self, kind: str, name: str, options: Given) -> ca.Function:
        """The derivative along one direction by the library's own rules, where that can be, else by CasADi's."""
        told = self._told.derived(kind, tuple(self.is_diff_in(i) for i in range(self.n_in())))
        if told is None:
            return self._kept.columns(getattr(self._source.function, kind)(1), self._count, name, options)
        source = _Source(f"{kind}_{self._source.name}", None, lambda: getattr(self._source.function, kind)(1))
        return _Columns(self._kept, source, (self._count, 1), told, name, options)
