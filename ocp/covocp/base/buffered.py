"""A CasADi function called through its buffers: no CasADi object is made in a call."""

from __future__ import annotations

import weakref
from typing import Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array
from covocp.base.threads import briefly

# Numbers that a function works in above which they are there for one function at a time: that which was called last.
MOST_KEPT = 1_000_000


class Buffered:
    """A function of dense arguments, with memory of its own; not for two threads at a time.

    Attributes:
        large: whether it has memory only as long as no other large one is called.
    """

    def __init__(self, function: ca.Function) -> None:
        """Make the memory.

        Args:
            function: whose inputs are dense; of sparse outputs the nonzero entries are returned.
        """
        self._function = function
        self._arguments = [np.zeros(function.nnz_in(i)) for i in range(function.n_in())]
        self._results = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        self.large = function.sz_w() > MOST_KEPT
        self._kept = None if self.large else self._memory()

    def _memory(self) -> tuple[Any, Any]:
        """What CasADi works in, and the call."""
        buffer: Any
        buffer, run = self._function.buffer()
        for i, array in enumerate(self._arguments):
            buffer.set_arg(i, memoryview(array))  # type: ignore[arg-type]
        for i, array in enumerate(self._results):
            buffer.set_res(i, memoryview(array))  # type: ignore[arg-type]
        return buffer, run

    def __call__(self, *arguments: Array) -> tuple[Array, ...] | None:
        """The nonzero entries of the outputs, copied; None where the function fails."""
        for memory, argument in zip(self._arguments, arguments, strict=True):
            memory[:] = argument
        if self._kept is None:
            release_large()
            self._kept = self._memory()
            _LARGE.append(weakref.ref(self))
        buffer, run = self._kept
        try:
            run()
        except RuntimeError:
            return None
        if buffer.ret():
            return None
        return tuple(result.copy() for result in self._results)


# The one of those which are large that has memory.
_LARGE: list[weakref.ref[Buffered]] = []


def release_large() -> None:
    """Give back what the large function that was called last works in, before another one does or after many calls."""
    while _LARGE:
        last = _LARGE.pop()()
        if last is not None:
            last._kept = None


class Matrices(Buffered):
    """The same of matrices, to dense ones: as a function of CasADi, in a fraction of its time. Threads take turns."""

    def __init__(self, function: ca.Function) -> None:
        """Make the memory.

        Args:
            function: whose inputs are dense.
        """
        if not all(function.sparsity_out(i).is_dense() for i in range(function.n_out())):
            inputs = function.mx_in()
            function = ca.Function(function.name(), inputs, [ca.densify(v) for v in function.call(inputs)])
        self._shapes = [function.size_out(i) for i in range(function.n_out())]
        super().__init__(function)

    @briefly
    def evaluated(self, *arguments: Array | float) -> list[Array]:
        """The outputs.

        Raises:
            RuntimeError: the function fails.
        """
        outputs = self(*(np.asarray(argument).ravel(order="F") for argument in arguments))
        if self.large:  # as a rule it is asked once
            release_large()
        if outputs is None:
            raise RuntimeError(f"{self._function.name()} failed")
        return [values.reshape(shape, order="F") for values, shape in zip(outputs, self._shapes, strict=True)]


def swept(function: ca.Function, start: Array, *columns: Any) -> tuple[Array, ...]:
    """A function of a value and a column of each of the others, from one column to the next.

    Args:
        function: (value, *others) -> value after it, and more; all dense.
        start: the first value.
        columns: of each of the others, those of all calls side by side (numbers).

    Returns:
        The entries of each output, a row for each call.

    Raises:
        RuntimeError: a call failed.
    """
    single = [function.size_in(i) for i in range(1, function.n_in())]
    wide = [c if isinstance(c, np.ndarray) and c.ndim == 2 else np.asarray(ca.DM(c).full()) for c in columns]
    count = next(array.shape[1] // shape[1] for array, shape in zip(wide, single, strict=True) if shape[1])
    rows = [array.T.reshape(count, -1) for array in wide]
    call, value = Buffered(function), start
    outputs = []
    for k in range(count):
        results = call(value, *(row[k] for row in rows))
        if results is None:
            raise RuntimeError(f"{function.name()} failed at column {k}")
        outputs.append(results)
        value = results[0]
    return tuple(np.array(each) for each in zip(*outputs, strict=True))
