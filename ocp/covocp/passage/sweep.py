"""The compiled passage as a node of CasADi expressions: values and exact slopes by symplectic duality."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.base.matrices import half_length
from covocp.passage.library import functions

# Bytes of passages that are kept for the next call beside the last one.
KEPT_BYTES = 50_000_000

Pattern = tuple[tuple[int, ...], tuple[int, ...]]
Buffers = tuple[memoryview | None, ...]
Given = Mapping[str, Any]


def passed_by(first: Expr, points: Sequence[Expr], size: int, kicks: Expr = None) -> Any:
    """Half-vectors of a covariance after each Gauss step.

    Args:
        first: half-vector at the start.
        points: h H of all steps side by side, at the first and at the second Gauss point, of one sparsity each step.
        size: of the covariance.
        kicks: added to the half-vectors as they pass, a column for each step; None: nothing.

    Returns:
        A column for each step. It can be differentiated twice (reverse sweeps, tangents, tangents of reverse sweeps),
        but its sparsity is not seen: no Jacobians of it.
    """
    rows, columns = _pattern(points, size)
    count = points[0].shape[1] // (2 * size)
    shape = ca.Sparsity.dense(len(rows), count)
    wide = ca.repmat(ca.Sparsity.triplet(2 * size, 2 * size, rows, columns), 1, count)
    entries = [ca.sparsity_cast(ca.project(point, wide), shape) for point in points]
    sweep = _sweep(size, (tuple(rows), tuple(columns)), count, kicks is not None)
    return sweep(first, *entries, *([] if kicks is None else [kicks]))


def depends(first: Expr, points: Sequence[Expr], size: int, kicks: Expr = None) -> Any:
    """Something that depends on what `passed_by` depends on, by operations whose sparsity CasADi sees."""
    count = points[0].shape[1] // (2 * size)
    each: Any = sum(ca.sum1(ca.reshape(ca.sum1(point), 2 * size, count)) for point in points)
    if kicks is not None:
        each = each + ca.sum1(kicks)
    return ca.repmat(ca.sum1(first) + ca.cumsum(each, 1), half_length(size), 1)


def _pattern(points: Sequence[Expr], size: int) -> tuple[list[int], list[int]]:
    """Rows and columns, column by column, of what may be nonzero in some step."""
    united = ca.Sparsity(2 * size, 2 * size)
    for point in points:
        for part in ca.horzsplit(point.sparsity(), 2 * size):
            if part != united:
                united = united + part
    return united.get_triplet()


class _Workspaces:
    """Memory of passages: taken for a call, given back after it; what was used last is kept."""

    def __init__(self) -> None:
        self._kept: list[tuple[_Sweep, int]] = []
        self._lock = threading.Lock()

    def take(self, sweep: _Sweep) -> int:
        """The last memory of a sweep, or new memory."""
        with self._lock:
            for place in range(len(self._kept) - 1, -1, -1):
                if self._kept[place][0] is sweep:
                    return self._kept.pop(place)[1]
        return sweep.new_memory()

    def give(self, sweep: _Sweep, memory: int) -> None:
        """Keep memory for the next call, and free the oldest where it has become too much."""
        with self._lock:
            self._kept.append((sweep, memory))
            while len(self._kept) > 1 and sum(owner.bytes for owner, _ in self._kept) > KEPT_BYTES:
                _library()["passage_free"](self._kept.pop(0)[1])


_WORKSPACES = _Workspaces()


def _library() -> dict[str, Callable[..., Any]]:
    """The library, which is there where a sweep is."""
    there = functions()
    assert there is not None
    return there


@cache
def _sweep(size: int, pattern: Pattern, count: int, kicked: bool) -> _Sweep:
    """A sweep; CasADi's expressions do not keep what Python makes, so all of them stay. They are small."""
    return _Sweep(size, pattern, count, kicked)


class _Sweep(ca.Callback):
    """(half-vector at the start, entries of h H at both points[, kicks]) -> half-vectors after the steps."""

    def __init__(self, size: int, pattern: Pattern, count: int, kicked: bool) -> None:
        ca.Callback.__init__(self)
        self.half, self.entries, self.count, self.kicked = half_length(size), len(pattern[0]), count, kicked
        self._size = size
        self._rows, self._columns = (np.array(part, dtype=np.intc) for part in pattern)
        steps = count * (10 * size * size + 2 * self.entries + 2 * self.half)
        self.bytes = 8 * (steps + 17 * size * size)
        self._reverse: dict[int, _Slopes] = {}
        self._forward: dict[int, _Tangents] = {}
        self.construct("passage", {})

    def new_memory(self) -> int:
        """Memory of the library for one call at a time."""
        rows, columns = self._rows.ctypes.data, self._columns.ctypes.data
        memory = _library()["passage_new"](self._size, self.entries, rows, columns, self.count)
        if not memory:
            raise MemoryError(f"no memory for the covariances of {self.count} steps")
        return int(memory)

    @property
    def shapes(self) -> list[ca.Sparsity]:
        """Of the arguments."""
        return [self.get_sparsity_in(i) for i in range(self.get_n_in())]

    def padded(self, addresses: list[int | None]) -> list[int | None]:
        """With a place for the kicks, which the library has always."""
        return addresses if self.kicked else [*addresses, None]

    def direction(self, addresses: list[int | None], k: int) -> list[int | None]:
        """Where the part of direction k begins, of all arguments."""
        lengths = (8 * shape.nnz() for shape in self.shapes)
        return [None if at is None else at + k * length for at, length in zip(addresses, lengths, strict=True)]

    def seed(self, address: int | None, k: int) -> int | None:
        """The same of results."""
        return None if address is None else address + 8 * k * self.half * self.count

    def tangent(
        self,
        given: list[int | None],
        seed: int | None,
        moved: list[int | None],
        moved_seed: int | None,
        after: int | None,
        slopes: list[int | None],
    ) -> None:
        """One direction: tangents of the arguments -> of the result, of its slopes, where there is a place for them."""
        zero = np.zeros(max(self.half, self.entries * self.count))  # what CasADi leaves out is zero
        moved = [zero.ctypes.data if at is None and i < 3 else at for i, at in enumerate(moved)]
        memory = _WORKSPACES.take(self)
        failed = _library()["passage_tangent"](memory, *given, seed, *self.padded(moved), moved_seed, after, *slopes)
        _WORKSPACES.give(self, memory)
        if failed:
            raise MemoryError(f"no memory for the tangents of {self.count} steps")

    def get_n_in(self) -> int:
        """Of CasADi."""
        return 4 if self.kicked else 3

    def get_n_out(self) -> int:
        """Of CasADi."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Of CasADi."""
        shapes = ((self.half, 1), (self.entries, self.count), (self.entries, self.count), (self.half, self.count))
        return ca.Sparsity.dense(*shapes[i])

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Of CasADi."""
        return ca.Sparsity.dense(self.half, self.count)

    def has_eval_buffer(self) -> bool:
        """Of CasADi."""
        return True

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        given = self.padded([_address(argument) for argument in arguments])
        memory = _WORKSPACES.take(self)
        _library()["passage_forward"](memory, *given, _address(results[0]))
        _WORKSPACES.give(self, memory)
        return 0

    def has_reverse(self, nadj: int) -> bool:
        """Of CasADi."""
        return True

    def get_reverse(
        self, nadj: int, name: str, inames: Sequence[str], onames: Sequence[str], opts: Given
    ) -> ca.Function:
        """Of CasADi."""
        if nadj not in self._reverse:
            self._reverse[nadj] = _Slopes(self, nadj, name, opts)
        return self._reverse[nadj]

    def has_forward(self, nfwd: int) -> bool:
        """Of CasADi."""
        return True

    def get_forward(
        self, nfwd: int, name: str, inames: Sequence[str], onames: Sequence[str], opts: Given
    ) -> ca.Function:
        """Of CasADi."""
        if nfwd not in self._forward:
            self._forward[nfwd] = _Tangents(self, nfwd, name, opts)
        return self._forward[nfwd]


class _Derived(ca.Callback):
    """What the derivatives of a sweep have in common: sparsities that are given, evaluation through buffers."""

    def __init__(self, inputs: list[ca.Sparsity], outputs: list[ca.Sparsity], name: str, options: Given) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs = inputs, outputs
        self.construct(name, dict(options))

    def get_n_in(self) -> int:
        """Of CasADi."""
        return len(self._inputs)

    def get_n_out(self) -> int:
        """Of CasADi."""
        return len(self._outputs)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Of CasADi."""
        return self._inputs[i]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Of CasADi."""
        return self._outputs[i]

    def has_eval_buffer(self) -> bool:
        """Of CasADi."""
        return True


class _Slopes(_Derived):
    """(arguments of a sweep, its result, seeds) -> slopes by the arguments, for some directions side by side."""

    def __init__(self, sweep: _Sweep, directions: int, name: str, options: Given) -> None:
        self._sweep, self._directions = sweep, directions
        self._forward: dict[int, _MovedSlopes] = {}
        result = sweep.get_sparsity_out(0)
        inputs = [*sweep.shapes, result, ca.repmat(result, 1, directions)]
        super().__init__(inputs, [ca.repmat(shape, 1, directions) for shape in sweep.shapes], name, options)

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        sweep, count = self._sweep, self._sweep.get_n_in()
        given = sweep.padded([_address(argument) for argument in arguments[:count]])
        seeds, slopes = _address(arguments[count + 1]), [_address(result) for result in results]
        memory = _WORKSPACES.take(sweep)
        for k in range(self._directions):
            own = sweep.padded(sweep.direction(slopes, k))
            _library()["passage_reverse"](memory, *given, sweep.seed(seeds, k), *own)
        _WORKSPACES.give(sweep, memory)
        return 0

    def has_forward(self, nfwd: int) -> bool:
        """Of CasADi."""
        return True

    def get_forward(
        self, nfwd: int, name: str, inames: Sequence[str], onames: Sequence[str], opts: Given
    ) -> ca.Function:
        """Of CasADi."""
        if nfwd not in self._forward:
            self._forward[nfwd] = _MovedSlopes(self._sweep, self._directions, nfwd, name, opts)
        return self._forward[nfwd]


class _Tangents(_Derived):
    """(arguments of a sweep, its result, tangents of the arguments) -> tangents of the result, side by side."""

    def __init__(self, sweep: _Sweep, tangents: int, name: str, options: Given) -> None:
        self._sweep, self._tangents = sweep, tangents
        result = sweep.get_sparsity_out(0)
        inputs = [*sweep.shapes, result, *(ca.repmat(shape, 1, tangents) for shape in sweep.shapes)]
        super().__init__(inputs, [ca.repmat(result, 1, tangents)], name, options)

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        sweep, count = self._sweep, self._sweep.get_n_in()
        given = sweep.padded([_address(argument) for argument in arguments[:count]])
        moved = [_address(argument) for argument in arguments[count + 1 :]]
        for k in range(self._tangents):
            after = sweep.seed(_address(results[0]), k)
            sweep.tangent(given, None, sweep.direction(moved, k), None, after, [None] * 4)
        return 0


class _MovedSlopes(_Derived):
    """Tangents of `_Slopes`: (its arguments, its results, tangents of its arguments) -> tangents of its results."""

    def __init__(self, sweep: _Sweep, directions: int, tangents: int, name: str, options: Given) -> None:
        self._sweep, self._directions, self._tangents = sweep, directions, tangents
        result = sweep.get_sparsity_out(0)
        of = [*sweep.shapes, result, ca.repmat(result, 1, directions)]
        slopes = [ca.repmat(shape, 1, directions) for shape in sweep.shapes]
        moved = [[ca.repmat(shape, 1, tangents) for shape in shapes] for shapes in (of, slopes)]
        super().__init__([*of, *slopes, *moved[0]], moved[1], name, options)

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        sweep, count = self._sweep, self._sweep.get_n_in()
        given = sweep.padded([_address(argument) for argument in arguments[:count]])
        seeds = _address(arguments[count + 1])
        moved = [_address(argument) for argument in arguments[2 * count + 2 : 3 * count + 2]]
        moved_seeds, slopes = _address(arguments[-1]), [_address(result) for result in results]
        for t in range(self._tangents):
            along = sweep.direction(moved, t)
            for k in range(self._directions):
                place = t * self._directions + k
                own = sweep.padded(sweep.direction(slopes, place))
                sweep.tangent(given, sweep.seed(seeds, k), along, sweep.seed(moved_seeds, place), None, own)
        return 0


def _address(view: memoryview | None) -> int | None:
    """Where the numbers of CasADi's buffer lie; None: no numbers are given or wanted."""
    return None if view is None else int(np.frombuffer(view).ctypes.data)
