"""Cost, rows and their slopes at a point, had together and kept: what solvers ask for one after the other."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from covocp.base.buffered import Buffered, release_large
from covocp.base.matrices import Array
from covocp.base.nodes import Buffers, Node
from covocp.passage.sweep import make_room
from covocp.transcription.program import Program

Outputs = tuple[Array, ...]

# Points that are kept: where a run starts, where its scale is probed, the last one.
KEPT = 3


class Weighed:
    """The slope of the sum of rows with some weights, from the entries of their Jacobian."""

    def __init__(self, pattern: ca.Sparsity) -> None:
        """Take the sparsity of the Jacobian."""
        self._rows, self._columns = np.array(pattern.row(), np.intp), np.array(pattern.get_col(), np.intp)
        self._width = pattern.shape[1]

    def __call__(self, entries: Array, weights: Array) -> Array:
        """The slope."""
        return np.asarray(np.bincount(self._columns, entries * weights[self._rows], self._width), dtype=float)


class AtPoint:
    """The functions of a program with slopes of first order; the last points are kept, in any unit of the cost."""

    def __init__(self, program: Program) -> None:
        """Make the functions, called through buffers.

        Args:
            program: of one statement whose matrices are no variables.
        """
        w, p = program.w, program.p
        cost, gradient = program.gradient or (program.f, ca.gradient(program.f, w))
        rows = ca.jacobian(program.g, w) if program.jacobian is None else program.jacobian
        self.pattern = rows.sparsity()
        self.weighed = Weighed(self.pattern)
        outputs = [ca.densify(program.g), ca.densify(gradient), rows]
        self._full = Buffered(ca.Function("full", [w, p], [cost, *outputs]))
        self._value = Buffered(ca.Function("value", [w, p], [program.f, *outputs[:1]]))
        self._points: dict[bytes, Outputs | None] = {}
        self.rest()
        self._trial: tuple[bytes, Outputs | None] = b"", None

    def rest(self) -> None:
        """Before and after many calls: where they take much memory, nothing is kept beside it."""
        if self._full.large:
            release_large()
            make_room()

    def full(self, w: Array, p: Array) -> Outputs | None:
        """Cost, rows, slope of the cost, entries of the Jacobian of the rows; None where the model fails."""
        key = self._key(w, p)
        if key not in self._points:
            while len(self._points) >= KEPT:
                del self._points[next(iter(self._points))]
            self._points[key] = _kept(self._full(w, np.append(p[:-1], 1.0)))
        return _scaled(self._points[key], p)

    def value(self, w: Array, p: Array) -> Outputs | None:
        """Cost and rows; None where the model fails."""
        key = self._key(w, p)
        if key in self._points:
            outputs = self._points[key]
            return _scaled(outputs if outputs is None else outputs[:2], p)
        if self._trial[0] != key:
            self._trial = key, _kept(self._value(w, np.append(p[:-1], 1.0)))
        return _scaled(self._trial[1], p)

    @staticmethod
    def _key(w: Array, p: Array) -> bytes:
        return np.concatenate([w, p[:-1]]).tobytes()


def _kept(outputs: Outputs | None) -> Outputs | None:
    """What several are given, read-only."""
    for values in outputs or ():
        values.flags.writeable = False
    return outputs


def _scaled(outputs: Outputs | None, p: Array) -> Outputs | None:
    """In units of the scale of the cost, the last of the parameters of a program."""
    if outputs is None:
        return None
    return tuple(values / p[-1] if i in (0, 2) else values for i, values in enumerate(outputs))


class Nodes:
    """The functions of a program as CasADi's NLP solvers take them; a point that is new is had with all slopes.

    The first values after slopes are those of a whole step, at which slopes are asked for next as a rule; further ones
    before that are trials of a search.
    """

    def __init__(self, program: Program) -> None:
        """Make them; they have to be kept as long as a solver uses them."""
        self.of = AtPoint(program)
        self._whole = True
        shapes = {
            "f": ca.Sparsity.scalar(),
            "g": ca.Sparsity.dense(program.g.shape[0], 1),
            "grad_f": ca.Sparsity.dense(program.w.shape[0], 1),
            "jac_g": self.of.pattern,
        }
        inputs = [ca.Sparsity.dense(symbol.shape[0], 1) for symbol in (program.w, program.p)]
        self._nodes = {
            name: _Asked(name, self._asked, inputs, [shapes[k] for k in names], names)
            for name, names in (("values", ("f", "g")), ("grad_f", ("f", "grad_f")), ("jac_g", ("g", "jac_g")))
        }
        cost, rows = self._nodes["values"](program.w, program.p)
        self.problem = {"x": program.w, "p": program.p, "f": cost, "g": rows}
        self.slopes = {name: self._nodes[name] for name in ("grad_f", "jac_g")}

    def _asked(self, w: Array, p: Array, names: tuple[str, ...]) -> list[Array] | None:
        """Some of what is had at a point."""
        slopes = names != ("f", "g")
        outputs = self.of.full(w, p) if slopes or self._whole else self.of.value(w, p)
        self._whole = slopes
        places = {"f": 0, "g": 1, "grad_f": 2, "jac_g": 3}
        return None if outputs is None else [outputs[places[name]] for name in names]


class _Asked(Node):
    """(w, p) -> some of what is had at a point."""

    def __init__(
        self, name: str, asked: Any, inputs: list[ca.Sparsity], outputs: list[ca.Sparsity], names: tuple[str, ...]
    ) -> None:
        self._asked, self._names = asked, names
        super().__init__(f"nlp_{name}", inputs, outputs)

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        w, p = (
            np.zeros(shape.nnz()) if given is None else np.frombuffer(given)
            for given, shape in zip(arguments, self._inputs, strict=True)
        )
        found = self._asked(w, p, self._names)
        if found is None:
            return 1
        for result, values in zip(results, found, strict=True):
            if result is not None and values.size:
                np.frombuffer(result)[:] = values
        return 0
