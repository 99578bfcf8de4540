"""The passage as exported code has it: expressions of which one form is evaluated, the other written out as C.

Both forms have the same arguments. The first calls the library, in which the same C code is compiled; the second is a
function of CasADi's without a body, which `bodies` gives.
"""

from __future__ import annotations

import zlib
from functools import cache
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.matrices import half_length
from covocp.base.nodes import Buffers, Node
from covocp.base.short_repr import short_repr
from covocp.passage.library import needed
from covocp.passage.shape import Pattern, shape
from covocp.passage.sweep import Entries, Told

# What the bodies call, in the order in which C must see it.
SOURCES = ("memory.h", "rows.h", "sparse.h", "forward.h", "few.h", "back.h", "places.h", "written.h")
WHAT = ("forward", "slopes")
WIDTH = 24  # numbers of a line
Form = Literal["evaluated", "written"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Call:
    """One passage of a tape.

    Attributes:
        arguments: half-vector at the start, entries of h H at both points; expressions.
        after: the half-vectors after each step, a symbol.
        forward: of the arguments -> a column: the half-vectors, then what slopes need.
        slopes: of the arguments but the first, of what `forward` returns and of slopes by the half-vectors -> a column:
            slopes by the arguments one below the other, then what is of no use.
    """

    arguments: list[Any]
    after: Any
    forward: ca.Function
    slopes: ca.Function

    __repr__ = short_repr

    def split(self, column: Expr) -> list[Any]:
        """Slopes by each of the arguments."""
        ends = np.cumsum([0, *(argument.numel() for argument in self.arguments)]).tolist()
        parts = ca.vertsplit(column, [*ends, column.shape[0]])[:-1]
        return [ca.reshape(part, *given.shape) for part, given in zip(parts, self.arguments, strict=True)]


@dataclass(frozen=True, kw_only=True)
class Written:
    """C code of passages: what stands before all functions, and the bodies of some of them by name."""

    introduction: str
    bodies: dict[str, str]

    __repr__ = short_repr


class Tape:
    """Passages one after the other, each of what those before have given.

    Args:
        form: of their functions.

    Attributes:
        calls: the passages so far.
    """

    def __init__(self, form: Form) -> None:
        """Begin without any."""
        self.calls: list[Call] = []
        self._form = form
        self._unwritten: dict[str, tuple[Any, ...]] = {}

    def passed_by(
        self,
        first: Expr,
        entries: Entries,
        kicks: Expr = None,
        told: Told | None = None,
        *,
        every: int = 1,
    ) -> Any:
        """What `covocp.passage.sweep.passed_by` returns, of a symbol."""
        assert kicks is None  # nothing that is exported has them, nor readings
        assert told is None
        size, pattern, given = entries.size, entries.pattern, [entries.first, entries.second]
        count = given[0].shape[1]
        if self._form == "evaluated":
            forward, slopes = _evaluated(size, pattern, count)
        else:
            own = shape(size, pattern, count, (), 0)
            known, forward, slopes = self._unwritten.setdefault(_named(own), (own, *_unwritten(own)))
            assert np.array_equal(known, own)  # the names of different shapes differ
        after = ca.MX.sym(f"after_{len(self.calls)}", half_length(size), count)
        self.calls.append(Call(arguments=[first, *given], after=after, forward=forward, slopes=slopes))
        return after[:, every - 1 :: every] if every > 1 else after

    def beside(self) -> Tape:
        """Another one, whose C code is told with that of this one."""
        other = Tape(self._form)
        other._unwritten = self._unwritten
        return other

    def written(self) -> Written:
        """The C code of all of them, in the form that is written."""
        from importlib.resources import files

        folder = files("covocp.passage")
        parts = [folder.joinpath(name).read_text(encoding="utf-8") for name in SOURCES if self._unwritten]
        bodies: dict[str, str] = {}
        for name, (own, *_) in self._unwritten.items():
            lines = [", ".join(map(str, own[i : i + WIDTH])) for i in range(0, own.size, WIDTH)]
            parts.append(f"static const int {name}[{own.size}] = {{\n    " + ",\n    ".join(lines) + "\n};\n")
            bodies |= {f"{name}_{what}": _body(name, what, own) for what in WHAT}
        return Written(introduction="\n".join(parts), bodies=bodies)


def _named(own: NDArray[np.intc]) -> str:
    """A name for what has this shape."""
    return f"passage_{zlib.crc32(own.tobytes()):08x}"


@cache
def _evaluated(size: int, pattern: Pattern, count: int) -> list[ca.Function]:
    """Forward and slopes; CasADi's expressions do not keep what Python makes, so all of them stay. They are small."""
    own = shape(size, pattern, count, (), 0)
    return [_Evaluated(what, own, *_form(own, what)) for what in WHAT]


def _unwritten(own: NDArray[np.intc]) -> list[ca.Function]:
    """The same without bodies."""
    made = []
    for what in WHAT:
        inputs, length = _form(own, what)
        symbols = [ca.MX.sym(f"given_{i}", each) for i, each in enumerate(inputs)]
        made.append(ca.Function(f"{_named(own)}_{what}", symbols, [ca.DM.zeros(length)], {"never_inline": True}))
    return made


def _form(own: NDArray[np.intc], what: str) -> tuple[list[ca.Sparsity], int]:
    """Sparsities of the arguments of a function, length of its result."""
    size, nonzeros, count = own[:3].tolist()
    half, point = half_length(size), (nonzeros, count)
    lengths = [int(needed()["exported_length"](own.ctypes.data, of)) for of in range(len(WHAT))]
    shapes = [(half, 1), point, point] if what == WHAT[0] else [point, point, (lengths[0], 1), (half, count)]
    return [ca.Sparsity.dense(*each) for each in shapes], lengths[WHAT.index(what)]


class _Evaluated(Node):
    """A function of the library that works in what it returns."""

    def __init__(self, what: str, own: NDArray[np.intc], inputs: list[ca.Sparsity], length: int) -> None:
        self._run, self._shape = needed()[f"exported_{what}"], own
        super().__init__(f"passage_{what}", inputs, [ca.Sparsity.dense(length, 1)])

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Of CasADi."""
        if results[0] is None:
            return 0
        chosen = np.empty(2 * int(self._shape[0]) + 1, dtype=np.intc)
        places = needed()["addresses"]((*self.filled(arguments), *results))
        self._run(self._shape.ctypes.data, chosen.ctypes.data, *places)
        return 0


def _body(name: str, what: str, own: NDArray[np.intc]) -> str:
    """A call of written.h."""
    given = ", ".join(f"arg[{i}]" for i in range(3 if what == WHAT[0] else 4))
    call = f"written_{what}({name}, chosen, {given}, res[0]);"
    return f"  int chosen[{2 * own[0] + 1}];\n  if (res[0]) {call}\n  return 0;\n"
