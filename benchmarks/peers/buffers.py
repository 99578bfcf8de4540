"""Functions of CasADi called through their buffers: no object is made in a call."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np


def bound(function: ca.Function, inputs: Sequence[np.ndarray], output: np.ndarray) -> Callable[[], None]:
    """What evaluates a function of one output from some arrays into another; it keeps all of them alive."""
    buffer, evaluate = function.buffer()
    for i, array in enumerate(inputs):
        buffer.set_arg(i, memoryview(array))
    buffer.set_res(0, memoryview(output))

    def call(_keep: object = (buffer, function, inputs, output)) -> None:
        evaluate()

    return call
