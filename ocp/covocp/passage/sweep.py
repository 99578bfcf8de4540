"""The compiled passage as a node of CasADi expressions: values and exact slopes by symplectic duality."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import Array, half_length
from covocp.base.nodes import Buffers, Node
from covocp.base.short_repr import short_repr
from covocp.passage.library import functions, needed
from covocp.passage.shape import Pattern, shape

# Bytes of passages that are kept for the next call beside the last one.
KEPT_BYTES = 12_000_000

# Numbers in the factors of all X above which a passage keeps nothing but the half-vectors that are wanted.
MOST_FACTORS = 1_000_000

Given = Mapping[str, Any]
# Where numbers lie, None where there are none.
Addresses = tuple[int | None, ...]


@dataclass(frozen=True, kw_only=True)
class Told:
    """What steps of a passage read that have no length.

    steps: their places among all steps, rising. rows: of each, r. columns: the rows of M (r, n), then the half-vector
    of the variance R, a column for each reading; rows of zeros, of variance 1, read nothing.
    """

    steps: tuple[int, ...]
    rows: int
    columns: Any


@dataclass(frozen=True, kw_only=True, eq=False)
class Entries:
    """h H of Gauss steps by what may be nonzero in it.

    size: n of the covariance. pattern: rows and columns of the entries in H, (2n, 2n). first, second: the entries at
    both Gauss points, (entries, steps).
    """

    size: int
    pattern: Pattern
    first: Any
    second: Any

    __repr__ = short_repr


def passed_by(
    first: Expr,
    entries: Entries,
    kicks: Expr = None,
    told: Told | None = None,
    *,
    every: int = 1,
    lean: bool = False,
) -> Any:
    """Half-vectors of a covariance after steps: Gauss steps, and readings between them.

    Args:
        first: half-vector at the start.
        entries: of h H of all Gauss steps.
        kicks: added to the half-vectors as they pass, a column for each of those that are returned; None: nothing.
        told: what is read; None: nothing.
        every: after how many steps, each time, a half-vector is wanted; a share of their number.
        lean: for values alone, of which no steps are kept; so it is where numbers are given.

    Returns:
        A column for each of them. It can be differentiated twice (reverse sweeps, tangents, tangents of reverse sweeps;
        not where it is lean), but its sparsity is not seen: no Jacobians of it.
    """
    steps, height = ((), 0) if told is None else (told.steps, told.rows)
    given = (first, entries.first, entries.second)
    lean = lean or all(isinstance(one, ca.DM) for one in given)
    count = entries.first.shape[1] + len(steps)
    sweep = _sweep(entries.size, entries.pattern, count, kicks is not None, steps, height, lean, every)
    others = [*([] if told is None else [told.columns]), *([] if kicks is None else [kicks])]
    return sweep(*given, *others)


values_by = partial(passed_by, lean=True)


def from_many(firsts: Array, points: Sequence[Array], size: int, pattern: Pattern, count: int) -> Array:
    """Half-vectors of a covariance after each of some Gauss steps, the same number of them from each of many starts.

    Args:
        firsts: half-vectors at the starts, (starts, half).
        points: entries of h H at the first and at the second point, of one step after the other, those of the first
            start first.
        size: of the covariance.
        pattern: rows and columns of the entries.
        count: steps from each start.

    Returns:
        (starts, count, half).
    """
    starts = firsts.shape[0]
    sweep = _sweep(size, pattern, count, False, (), 0, True, 1)
    result = np.empty((starts, count, sweep.half))
    given = [np.ascontiguousarray(array, dtype=float) for array in (firsts, *points)]
    lengths = [array.nbytes // starts for array in (*given, result)]
    places = [array.ctypes.data for array in (*given, result)]
    memory, forward = _WORKSPACES.take(sweep), needed()["passage_forward"]
    for k in range(starts):
        first, one, two, after = (place + k * length for place, length in zip(places, lengths, strict=True))
        forward(memory, first, one, two, None, None, after)
    _WORKSPACES.give(sweep, memory)
    return result


def from_one(first: Array, points: Sequence[Array], size: int, pattern: Pattern, every: int) -> Array:
    """Half-vectors of a covariance from one start, as `passed_by` gives them of numbers, without a node.

    Args:
        first: half-vector at the start.
        points: entries of h H of all steps at the first and at the second point, a column for each.
        size: of the covariance.
        pattern: rows and columns of the entries.
        every: after how many steps, each time, one is wanted.

    Returns:
        A column for each of them.
    """
    count = points[0].shape[1]
    sweep = _sweep(size, pattern, count, False, (), 0, True, every)
    given = [np.asfortranarray(array, dtype=float) for array in (first, *points)]
    result = np.empty((sweep.half, sweep.ends), order="F")
    memory = _WORKSPACES.take(sweep)
    places = [array.ctypes.data for array in given]
    needed()["passage_forward"](memory, *places, None, None, result.ctypes.data)
    _WORKSPACES.give(sweep, memory)
    return result


class Course:
    """A passage of numbers from one start whose slopes are wanted, without a node; not for two threads at a time."""

    def __init__(self, first: Array, points: Sequence[Array], size: int, pattern: Pattern, every: int) -> None:
        """As of `from_one`."""
        self._sweep = _sweep(size, pattern, points[0].shape[1], False, (), 0, False, every)
        self._given = [np.asfortranarray(array, dtype=float) for array in (first, *points)]
        self._places = (*(array.ctypes.data for array in self._given), None, None)
        self._still = np.zeros(self._sweep.half)

    def slopes(self, seeds: Array) -> tuple[Array, list[Array], Array]:
        """Slopes of what weighs the half-vectors.

        Args:
            seeds: weights, a column for each half-vector that is wanted.

        Returns:
            Slopes by the half-vector at the start; by the entries at the first and the second point, a column for each
            step; by what is added to the half-vectors as they pass, a column for each that is wanted.

        Raises:
            MemoryError: there was none.
        """
        sweep, seeds = self._sweep, np.asfortranarray(seeds, dtype=float)
        start, kicks = np.empty(sweep.half), np.empty((sweep.half, sweep.ends), order="F")
        points = [np.empty((sweep.entries, sweep.moves), order="F") for _ in range(2)]
        found = (array.ctypes.data for array in (start, *points))
        memory = _WORKSPACES.take(sweep)
        failed = needed()["passage_reverse"](memory, *self._places, seeds.ctypes.data, *found, None, kicks.ctypes.data)
        _WORKSPACES.give(sweep, memory)
        if failed:
            raise MemoryError(f"no memory for the slopes of {sweep.count} steps")
        return start, points, kicks

    def tangents(self, seeds: Array, moved: Sequence[Array], slopes: Sequence[Array]) -> None:
        """Tangents of the slopes by the entries at both points, where the entries move, and the start does not.

        Args:
            seeds: as of `slopes`, in Fortran's order.
            moved: tangents of the entries at both points, in Fortran's order.
            slopes: where tangents of the slopes are written, likewise.

        Raises:
            MemoryError: there was none.
        """
        along = (self._still.ctypes.data, *(array.ctypes.data for array in moved))
        places = (None, *(array.ctypes.data for array in slopes), None, None)
        self._sweep.tangent(self._places, seeds.ctypes.data, along, None, None, places)


def entries_of(points: Sequence[Expr], size: int) -> Entries:
    """Entries of h H of steps, from the matrices (2n, 2n) of all steps side by side, at the first and second point."""
    rows, columns = _pattern(points, size)
    moves = points[0].shape[1] // (2 * size)
    dense = ca.Sparsity.dense(len(rows), moves)
    wide = ca.repmat(ca.Sparsity.triplet(2 * size, 2 * size, rows, columns), 1, moves)
    first, second = (ca.sparsity_cast(ca.project(point, wide), dense) for point in points)
    return Entries(size=size, pattern=(tuple(rows), tuple(columns)), first=first, second=second)


def depends(first: Expr, entries: Entries, kicks: Expr = None, told: Told | None = None, *, every: int = 1) -> Any:
    """Something that depends on what `passed_by` depends on, by operations whose sparsity CasADi sees."""
    each: Any = ca.sum1(entries.first) + ca.sum1(entries.second)
    if told is not None:
        both = ca.horzcat(each, ca.sum1(told.columns))
        order = np.argsort([*(k for k in range(both.shape[1]) if k not in set(told.steps)), *told.steps])
        each = both[:, order.tolist()]
    if every > 1:
        each = ca.sum1(ca.reshape(each, every, each.shape[1] // every))
    if kicks is not None:
        each = each + ca.sum1(kicks)
    # without `densify` CasADi's sums along a row end where its first entry is structurally zero
    return ca.repmat(ca.sum1(first) + ca.cumsum(ca.densify(each), 1), half_length(entries.size), 1)


def _pattern(points: Sequence[Expr], size: int) -> tuple[list[int], list[int]]:
    """Rows and columns, column by column, of what may be nonzero in some step."""
    united = ca.Sparsity(2 * size, 2 * size)
    for point in points if points[0].shape[1] else ():
        whole, first = point.sparsity(), point[:, : 2 * size].sparsity()
        same = whole == ca.repmat(first, 1, whole.shape[1] // (2 * size))
        for part in (first,) if same else ca.horzsplit(whole, 2 * size):
            if part != united:
                united = united + part
    return united.get_triplet()


class _Workspaces:
    """Memory of passages: taken for a call, given back after it; what was used last is kept."""

    def __init__(self) -> None:
        self._kept: list[tuple[_Sweep, int, int]] = []  # and the bytes that each memory has
        self._held = 0  # by all of them
        self._lock = threading.Lock()

    def take(self, sweep: _Sweep) -> int:
        """The last memory of a sweep, or new memory, for which the oldest is freed where all would be too much."""
        with self._lock:
            for place in range(len(self._kept) - 1, -1, -1):
                if self._kept[place][0] is sweep:
                    return self._taken(place)
            self._free(sweep.bytes, 0)
        return sweep.new_memory()

    def give(self, sweep: _Sweep, memory: int) -> None:
        """Keep memory for the next call, and free the oldest where it has become too much."""
        with self._lock:
            held = int(needed()["passage_held"](memory))
            self._kept.append((sweep, memory, held))
            self._held += held
            self._free(0, 1)

    def empty(self) -> None:
        """Free all that is kept."""
        with self._lock:
            self._free(KEPT_BYTES, 0)

    def _taken(self, place: int) -> int:
        """The memory at a place, which is no longer kept."""
        _, memory, held = self._kept.pop(place)
        self._held -= held
        return memory

    def _free(self, more: int, least: int) -> None:
        """Free the oldest, down to so many, until there is room for more bytes."""
        while len(self._kept) > least and more + self._held > KEPT_BYTES:
            needed()["passage_free"](self._taken(0))


_WORKSPACES = _Workspaces()


def make_room() -> None:
    """Give back to the system what passages keep and what the process has freed, before or after much is taken."""
    if functions() is not None:
        _WORKSPACES.empty()
        needed()["passage_trim"]()


@cache
def _sweep(
    size: int, pattern: Pattern, count: int, kicked: bool, reads: tuple[int, ...], height: int, lean: bool, every: int
) -> _Sweep:
    """A sweep; CasADi's expressions do not keep what Python makes, so all of them stay. They are small."""
    return _Sweep(size, pattern, count, kicked, reads, height, lean, every)


class _Sweep(Node):
    """(half-vector at the start, entries of h H at both points[, what is read][, kicks]) -> half-vectors."""

    def __init__(
        self,
        size: int,
        pattern: Pattern,
        count: int,
        kicked: bool,
        reads: tuple[int, ...],
        height: int,
        lean: bool,
        every: int,
    ) -> None:
        """Keep what the library is told; `lean`: for values alone, of which no steps are kept."""
        self._lean = lean
        self.half, self.entries, self.count, self.kicked = half_length(size), len(pattern[0]), count, kicked
        self.ends = count // every
        self.moves, self.reads, self.telling = count - len(reads), len(reads), height * size + half_length(height)
        self._shape = shape(size, pattern, count, reads, height, every)
        self.bytes = int(needed()["passage_bytes"](self._shape.ctypes.data, int(lean), MOST_FACTORS))
        self._reverse: dict[int, _Slopes] = {}
        self._forward: dict[int, _Tangents] = {}
        sizes = [(self.half, 1), (self.entries, self.moves), (self.entries, self.moves)]
        sizes += [(self.telling, self.reads)] if self.reads else []
        sizes += [(self.half, self.ends)] if kicked else []
        self.shapes = [ca.Sparsity.dense(*size) for size in sizes]
        self._lengths = [8 * shape.nnz() for shape in self.shapes]
        super().__init__("passage", self.shapes, [ca.Sparsity.dense(self.half, self.ends)])

    def new_memory(self) -> int:
        """Memory of the library for one call at a time."""
        memory = needed()["passage_new"](self._shape.ctypes.data, self._shape.size, int(self._lean), MOST_FACTORS)
        if not memory:
            raise MemoryError(f"no memory for the covariances of {self.count} steps")
        return int(memory)

    def padded(self, addresses: Addresses) -> Addresses:
        """With places for what is read and for the kicks, which the library has always."""
        known = addresses if self.reads else (*addresses[:3], None, *addresses[3:])
        return known if self.kicked else (*known, None)

    def direction(self, addresses: Addresses, k: int) -> Addresses:
        """Where the part of direction k begins, of all arguments."""
        if not k:
            return addresses
        return tuple(
            None if at is None else at + k * length for at, length in zip(addresses, self._lengths, strict=True)
        )

    def seed(self, address: int | None, k: int) -> int | None:
        """The same of results."""
        return None if address is None else address + 8 * k * self.half * self.ends

    def tangent(
        self,
        given: Addresses,
        seed: int | None,
        moved: Addresses,
        moved_seed: int | None,
        after: int | None,
        slopes: Addresses,
    ) -> None:
        """One direction: tangents of the arguments -> of the result, of its slopes, where there is a place for them."""
        longest = max(self.half, self.entries * self.moves, self.telling * self.reads)
        zero = np.zeros(longest)  # what CasADi leaves out is zero
        whole = [zero.ctypes.data if at is None and i < 4 else at for i, at in enumerate(self.padded(moved))]
        memory = _WORKSPACES.take(self)
        failed = needed()["passage_tangent"](memory, *given, seed, *whole, moved_seed, after, *slopes)
        _WORKSPACES.give(self, memory)
        if failed:
            raise MemoryError(f"no memory for the tangents of {self.count} steps")

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        library = needed()
        whole = tuple(self.filled(arguments))  # which live as long as the call
        given = self.padded(library["addresses"](whole))
        memory = _WORKSPACES.take(self)
        library["passage_forward"](memory, *given, *library["addresses"](results))
        _WORKSPACES.give(self, memory)
        return 0

    def has_reverse(self, nadj: int) -> bool:
        """Of CasADi."""
        return not self._lean

    def get_reverse(
        self, nadj: int, name: str, inames: Sequence[str], onames: Sequence[str], opts: Given
    ) -> ca.Function:
        """Of CasADi."""
        if nadj not in self._reverse:
            self._reverse[nadj] = _Slopes(self, nadj, name, opts)
        return self._reverse[nadj]

    def has_forward(self, nfwd: int) -> bool:
        """Of CasADi."""
        return not self._lean

    def get_forward(
        self, nfwd: int, name: str, inames: Sequence[str], onames: Sequence[str], opts: Given
    ) -> ca.Function:
        """Of CasADi."""
        if nfwd not in self._forward:
            self._forward[nfwd] = _Tangents(self, nfwd, name, opts)
        return self._forward[nfwd]


class _Slopes(Node):
    """(arguments of a sweep, its result, seeds) -> slopes by the arguments, for some directions side by side."""

    def __init__(self, sweep: _Sweep, directions: int, name: str, options: Given) -> None:
        self._sweep, self._directions = sweep, directions
        self._forward: dict[int, _MovedSlopes] = {}
        result = sweep.get_sparsity_out(0)
        inputs = [*sweep.shapes, result, ca.repmat(result, 1, directions)]
        super().__init__(name, inputs, [ca.repmat(shape, 1, directions) for shape in sweep.shapes], options)

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        sweep, count, library = self._sweep, self._sweep.get_n_in(), needed()
        whole = tuple(self.filled(arguments))  # which live as long as the call
        places, slopes = library["addresses"](whole), library["addresses"](results)
        given, seeds = sweep.padded(places[:count]), places[count + 1]
        memory, failed = _WORKSPACES.take(sweep), 0
        for k in range(self._directions):
            own = sweep.padded(sweep.direction(slopes, k))
            failed += library["passage_reverse"](memory, *given, sweep.seed(seeds, k), *own)
        _WORKSPACES.give(sweep, memory)
        if failed:
            raise MemoryError(f"no memory for the slopes of {sweep.count} steps")
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


class _Tangents(Node):
    """(arguments of a sweep, its result, tangents of the arguments) -> tangents of the result, side by side."""

    def __init__(self, sweep: _Sweep, tangents: int, name: str, options: Given) -> None:
        self._sweep, self._tangents = sweep, tangents
        result = sweep.get_sparsity_out(0)
        inputs = [*sweep.shapes, result, *(ca.repmat(shape, 1, tangents) for shape in sweep.shapes)]
        super().__init__(name, inputs, [ca.repmat(result, 1, tangents)], options)

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        sweep, count, library = self._sweep, self._sweep.get_n_in(), needed()
        places, (result,) = library["addresses"](arguments), library["addresses"](results)
        given, moved = sweep.padded(places[:count]), places[count + 1 :]
        for k in range(self._tangents):
            sweep.tangent(given, None, sweep.direction(moved, k), None, sweep.seed(result, k), (None,) * 5)
        return 0


class _MovedSlopes(Node):
    """Tangents of `_Slopes`: (its arguments, its results, tangents of its arguments) -> tangents of its results."""

    def __init__(self, sweep: _Sweep, directions: int, tangents: int, name: str, options: Given) -> None:
        self._sweep, self._directions, self._tangents = sweep, directions, tangents
        result = sweep.get_sparsity_out(0)
        of = [*sweep.shapes, result, ca.repmat(result, 1, directions)]
        slopes = [ca.repmat(shape, 1, directions) for shape in sweep.shapes]
        moved = [[ca.repmat(shape, 1, tangents) for shape in shapes] for shapes in (of, slopes)]
        super().__init__(name, [*of, *slopes, *moved[0]], moved[1], options)

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        sweep, count, library = self._sweep, self._sweep.get_n_in(), needed()
        places, slopes = library["addresses"](arguments), library["addresses"](results)
        given, seeds = sweep.padded(places[:count]), places[count + 1]
        moved, moved_seeds = places[2 * count + 2 : 3 * count + 2], places[-1]
        for t in range(self._tangents):
            along = sweep.direction(moved, t)
            for k in range(self._directions):
                place = t * self._directions + k
                own = sweep.padded(sweep.direction(slopes, place))
                sweep.tangent(given, sweep.seed(seeds, k), along, sweep.seed(moved_seeds, place), None, own)
        return 0
