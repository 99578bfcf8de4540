"""A CasADi function called through its buffers: no CasADi object is made in a call."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.matrices import Array


class Buffered:
    """A function of dense arguments, with memory of its own; not for two threads at a time."""

    def __init__(self, function: ca.Function) -> None:
        """Make the memory.

        Args:
            function: whose inputs are dense; of sparse outputs the nonzero entries are returned.
        """
        self._function = function
        self._arguments = [np.zeros(function.nnz_in(i)) for i in range(function.n_in())]
        self._results = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        buffer: Any
        buffer, self._run = function.buffer()
        for i, array in enumerate(self._arguments):
            buffer.set_arg(i, memoryview(array))  # type: ignore[arg-type]
        for i, array in enumerate(self._results):
            buffer.set_res(i, memoryview(array))  # type: ignore[arg-type]
        self._buffer = buffer

    def __call__(self, *arguments: Array) -> tuple[Array, ...] | None:
        """The nonzero entries of the outputs, copied; None where the function fails."""
        for memory, argument in zip(self._arguments, arguments, strict=True):
            memory[:] = argument
        try:
            self._run()
        except RuntimeError:
            return None
        if self._buffer.ret():
            return None
        return tuple(result.copy() for result in self._results)
