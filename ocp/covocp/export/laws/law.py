"""What is exported: laws, each one CasADi function of flat columns, with the names and units of what goes in and out.

Python and C call the same function, so they compute the same. Its inputs and outputs are dense columns; a matrix is
flat *row by row*, as C has it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Given
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.passage.written import Written

Kind = Literal["function", "sample", "controller", "solver"]
Points = Callable[[np.random.Generator, int], Array]

# What the C functions return, in the order of their numbers.
STATUSES = {
    "OK": "as asked for",
    "MEASUREMENT_MISSING": "a row of the measurement was not finite (or beyond 1e30) and was left out",
    "TIME_BEFORE": "the time is before the start: values of the start",
    "TIME_AFTER": "the time is after the end: values of the end; of a controller the nominal control of the end "
    "without feedback: the caller must stop",
    "TIME_BACKWARDS": "the time is before that of the last step: nominal control, the estimate stays",
    "TIME_NOT_FINITE": "the time is NaN, infinite or beyond 1e30: values of the last valid time",
    "ESTIMATE_LOST": "the new estimate or its control was not finite: nominal control, the estimate stays as before, "
    "or as at the last node that was reached",
    "ARGUMENT_NOT_FINITE": "an argument is NaN or infinite: the plan made at the export is returned",
    "NOT_CONVERGED": "the iterations ended before the first-order conditions of a minimum held: the last iterate is "
    "returned",
    "RESULT_NOT_FINITE": "a result would be NaN or infinite: the results were not written",
    "FAILED": "the evaluation failed: nothing was written, or (solver) the plan made at the export is returned",
    "COARSE": "the conditions hold, but the mesh of the export is too coarse for what was given (a faster plant, a "
    "longer time) or too coarse for so much uncertainty at the start: halves of its steps would move a state by more "
    "than 0.4 % of its range, its cost or what limits a covariance is off by more than about 1 %, or a limit is passed "
    "by that between the nodes; export the solver for such values, or with more substeps or intervals",
    "SAMPLES_SKIPPED": "samples before this one were left out: they are predicted over, but the measurement is weighed "
    "by the gain of one period; the estimate is less certain than the design says until steps are of one period again",
    "READING_IGNORED": "another call at the sample of the last one: its reading is not used",
}
CODES = {name: number for number, name in enumerate(STATUSES)}
# Beyond this a number of a measurement, a time or an estimate counts as infinite, as the texts above and those of the
# controllers say; it is finite in single precision.
LARGEST = 1e30
# What the four numbers of an attitude are.
QUATERNION = "a unit quaternion, scalar first"
# An output of a controller that a step hands to its caller and does not keep.
RETURNED = "returned"


@dataclass(frozen=True, kw_only=True)
class Port:
    """One value that goes into or comes out of a law.

    Attributes:
        name: identifier in C.
        rows: of the matrix; 1 by 1 is a number, one column a vector.
        columns: of the matrix.
        unit: in words, for the comments.
        about: what it is, a line.
        entries: names of the rows of a vector.
        whole: whether a number is an int in a struct.
        least: where it is compared, what is smaller counts as of this size.
    """

    name: str
    rows: int = 1
    columns: int = 1
    unit: str = ""
    about: str = ""
    entries: tuple[str, ...] = ()
    whole: bool = False
    least: float = 0.0

    @property
    def size(self) -> int:
        """Number of entries."""
        return self.rows * self.columns

    @property
    def scalar(self) -> bool:
        """Whether it is one number."""
        return self.rows == self.columns == 1

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array that Python sees."""
        return () if self.scalar else (self.rows,) if self.columns == 1 else (self.rows, self.columns)


@dataclass(frozen=True, kw_only=True, eq=False)
class Law:
    """A law that becomes a C function.

    Attributes:
        name: the C function is <package>_<name>.
        kind: "function": arguments in, results out; "sample": a time in, a struct out; "controller": a struct that is
            kept from step to step; "solver": with a workspace that the caller provides.
        about: what it computes, paragraphs.
        core: flat columns of the inputs -> flat columns of the outputs; the last output of a law that has statuses is
            the status, a number.
        inputs: ports of the core.
        outputs: ports of the core; of a controller the fields of its struct, the control among them.
        statuses: names of what it may return.
        held: of a controller: input -> field of the struct where it is kept.
        returned: of a controller: the output that a step hands to its caller; a field unless it is `RETURNED`.
        start: of a controller: first values of the fields, stacked.
        safe: of a solver: outputs where it fails, stacked.
        defaults: of a solver: inputs of the export, stacked.
        instead: of a solver: parameters of the problem that are no arguments -> the arguments in their place.
        points: (random numbers, count) -> inputs at which C is compared with Python, a row for each.
        constants: numbers for the header, by name and unit: "DURATION [s]".
        notes: what the package says of the law where it is printed.
        most: largest number of points.
        tolerance: largest deviation of C from Python, relative.
        code: of the core, where another form of it is written out; passages: C code that this form calls; plain: makes
            a core that other processes can have; all of them None where the core itself will do.
    """

    name: str
    kind: Kind
    about: tuple[str, ...]
    core: ca.Function
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    points: Points = field(repr=False)
    statuses: tuple[str, ...] = ("OK", "RESULT_NOT_FINITE", "FAILED")
    held: Mapping[str, str] = field(default_factory=dict)
    returned: str = "control"
    start: Array = field(default_factory=lambda: np.zeros(0))
    safe: Array = field(default_factory=lambda: np.zeros(0))
    defaults: Array = field(default_factory=lambda: np.zeros(0))
    instead: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    most: int = 100_000
    tolerance: float = 1e-12
    code: ca.Function | None = field(default=None, repr=False)
    passages: Written | None = None
    plain: Callable[[], ca.Function] | None = field(default=None, repr=False)

    __repr__ = short_repr

    @property
    def written(self) -> ca.Function:
        """What is written out."""
        return self.core if self.code is None else self.code

    def sent(self, *, evaluated: bool) -> Law:
        """What another process needs of it, with a core where that is evaluated there."""
        core = self.core
        if self.plain is not None:
            core = self.plain() if evaluated else ca.Function("none", [], [])
        return replace(self, core=core, points=_no_points, code=None, passages=None, plain=None)

    @property
    def arguments(self) -> tuple[Port, ...]:
        """Inputs that the caller gives."""
        return tuple(port for port in self.inputs if port.name not in self.held)

    @property
    def results(self) -> tuple[Port, ...]:
        """Outputs without the status."""
        return self.outputs if self.kind == "function" else self.outputs[:-1]

    @property
    def fields(self) -> tuple[Port, ...]:
        """Outputs that a struct keeps."""
        return tuple(port for port in self.outputs if port.name != RETURNED)

    def values(self, rows: Array) -> Array:
        """Outputs of the core, a row for each row of inputs; steps that ask to be continued are continued."""
        result = self._once(rows)
        while self.kind == "controller":
            again = np.flatnonzero(result[:, -1] < 0)
            if not again.size:
                break
            following = rows[again].copy()
            for name, kept in self.held.items():
                following[:, span(self.inputs, name)] = result[again][:, span(self.outputs, kept)]
            rows = rows.copy()
            rows[again] = following
            result[again] = self._once(following)
        return result

    def _once(self, rows: Array) -> Array:
        """Outputs of one call of the core."""
        if self.kind == "solver":
            return np.array([self._solved(row) for row in rows])
        columns: Any = self.core.map(rows.shape[0]).call(split_columns(rows, self.inputs))  # a list, without inputs too
        return np.vstack([np.asarray(column.full()) for column in columns]).T

    def _solved(self, row: Array) -> Array:
        """Outputs of a solver; those of the export where it has none."""
        reason = "ARGUMENT_NOT_FINITE"
        if np.isfinite(row).all():
            reason = "FAILED"
            try:
                columns = self.core(*(column[:, 0] for column in split_columns(row[None, :], self.inputs)))
                values = np.concatenate([np.asarray(column.full()).ravel() for column in columns])
            except RuntimeError:
                values = np.full(stacked_size(self.outputs), np.nan)
            if np.isfinite(values).all():
                return values
        return np.append(self.safe[:-1], float(CODES[reason]))


def _no_points(random: np.random.Generator, count: int) -> Array:
    """Stands for the points of a law in another process, where nothing is compared."""
    raise NotImplementedError


def span(ports: tuple[Port, ...], name: str) -> slice:
    """Where a port lies in the stacked ports."""
    offset = 0
    for port in ports:
        if port.name == name:
            return slice(offset, offset + port.size)
        offset += port.size
    raise KeyError(name)


def split_columns(rows: Array, ports: tuple[Port, ...]) -> list[Array]:
    """Rows of stacked values as one array for each port, a column for each row."""
    return [np.ascontiguousarray(rows[:, span(ports, port.name)].T) for port in ports]


def stacked_size(ports: tuple[Port, ...]) -> int:
    """Number of entries of all ports."""
    return sum(port.size for port in ports)


def flat(value: Given) -> Any:
    """A matrix as a dense column, row by row."""
    dense = ca.densify(value)
    return dense if dense.shape[1] == 1 else ca.vec(dense.T)


def shaped(column: Given, rows: int, columns: int) -> Any:
    """The matrix of a flat column."""
    return column if columns == 1 else ca.reshape(column, columns, rows).T


def status_of(conditions: list[tuple[Any, str]]) -> Any:
    """The code of the first condition that holds, as an expression."""
    code: Any = CODES["OK"]
    for condition, name in reversed(conditions):
        code = ca.if_else(condition, CODES[name], code)
    return code
