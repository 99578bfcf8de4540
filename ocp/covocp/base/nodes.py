"""Functions of Python or of a C library as nodes of CasADi expressions, evaluated through buffers."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from covocp.base.expressions import Given

# Of the arguments or results of a call, None where no numbers are given or wanted.
Buffers = tuple[memoryview | None, ...]


class Node(ca.Callback):
    """A node of given sparsities; `eval_buffer` is what it does. CasADi's expressions do not keep it."""

    def __init__(
        self, name: str, inputs: Sequence[ca.Sparsity], outputs: Sequence[ca.Sparsity], options: Given = None
    ) -> None:
        """Construct it: what `has_reverse` and the like go by must be set before."""
        ca.Callback.__init__(self)
        self._inputs, self._outputs = list(inputs), list(outputs)
        self.construct(name, dict(options or {}))

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

    def filled(self, arguments: Buffers) -> list[memoryview]:
        """The arguments of a call, with zeros for what CasADi leaves out."""
        pairs = zip(arguments, self._inputs, strict=True)
        return [np.zeros(shape.nnz()).data if own is None else own for own, shape in pairs]

    def has_eval_buffer(self) -> bool:
        """Of CasADi."""
        return True
