"""The frozen result of building a problem: CasADi functions with named inputs, dimensions and bounds.

This is what solvers read. The *nominal* (state x, control u) and the *matrices* (all symmetric matrix states, stacked
half-vectors e) are kept apart: the nominal drives the matrices, and only where `coupled` is true do the matrices drive
the nominal. Every function takes its arguments in the order

    (state, control, matrices, time, duration, parameters)

and leaves out those that it cannot depend on. `parameters` stacks the known parameters and the means of the unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.expressions import Expr
from covocp.base.matrices import Array, half_indices, half_length
from covocp.base.short_repr import short_repr
from covocp.base.threads import cached

Kind = Literal["state", "control", "matrix", "unknown", "parameter", "measurement"]

INPUTS = ("state", "control", "matrices", "time", "duration", "parameters")


@dataclass(frozen=True, kw_only=True)
class Block:
    """Where one of the user's symbols lies in its stacked vector."""

    name: str
    kind: Kind
    size: int
    offset: int
    labels: tuple[str, ...] = ()
    covariance: bool = False
    estimation: bool = False
    backward: bool = False
    unit: str = ""

    @property
    def length(self) -> int:
        """Entries in the stacked vector (of a matrix: of its half-vector)."""
        return half_length(self.size) if self.kind == "matrix" else self.size

    @property
    def span(self) -> slice:
        """The entries in the stacked vector."""
        return slice(self.offset, self.offset + self.length)


class Boundary(NamedTuple):
    """Initial and final state, initial and final half-vectors; NaN: free."""

    initial: Array
    final: Array
    initial_matrices: Array
    final_matrices: Array


class Columns(NamedTuple):
    """States, controls, half-vectors and times of several points, a column each."""

    x: Expr
    u: Expr
    matrices: Expr
    time: Expr


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Inequalities lower <= value(...) <= upper of one kind: along the path, at the start or at the end.

    `function` takes (state, control, matrices, time, duration, parameters); `names` has one entry for each row.
    `realised` is the same of one run, whose spread is none: the covariance X of the closed loop is zero in it; None
    where no row contains X.
    """

    function: ca.Function
    names: tuple[str, ...]
    lower: Array
    upper: Array
    uses_matrices: bool
    realised: ca.Function | None = None

    __repr__ = short_repr

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.names)

    def columns(self, at: Columns, duration: Expr, parameters: Expr) -> Any:
        """The values for columns of points; matrices that no row reads are no part of the expression.

        Else every slope of these values would carry the propagation of the covariances along.
        """
        count = at.x.shape[1]
        seen = at.matrices if self.uses_matrices else ca.DM(*at.matrices.shape)
        rest = (ca.repmat(duration, 1, count), ca.repmat(parameters, 1, count))
        return self.function.map(count)(at.x, at.u, seen, at.time, *rest)


class LoopSlopes(NamedTuple):
    """F (n, n), G (n, m), A (n, n), B (m, m), N (n, m), Q (n, n), see `Loop.expansion`."""

    F: Expr
    G: Expr
    A: Expr
    B: Expr
    N: Expr
    Q: Expr


@dataclass(frozen=True, kw_only=True)
class Loop:
    """What the feedback of an expected cost sees of the actual system along the nominal [Schmidt 6.2, 6.3].

    n: rows of the augmented state (states, then unknowns), m: those of the control that is fed back.

    expansion: (state, control, time, duration, parameters) -> F (n, n), G (n, m), A (n, n), B (m, m), N (n, m),
        Q (n, n): slopes of the rates, second derivatives of the running cost with the weights, process noise.
    gain: (all six) -> C (m, n) of du = -C dx'.
    running: (state, control, time, duration, parameters) -> L of the actual system.
    terminal: (state, duration, parameters) -> k of the actual system, S(T) (n, n).
    extra_control: (state, control, time, duration, parameters) -> B - L_uu (m, m): what the weights add to L.
    by_parts: (all six) -> L + tr(S Q + C'B C E)/2, tr(S E)/2: over any time the running cost is the integral of the
        first less the growth of the second [Schmidt E-20]; None where the gain is not the best one.
    spread: (state, control, time, duration, parameters, half-vector of the covariance of augmented state and controls)
        -> what terms that are not linear in that covariance add to the running cost; None without them.
    spread_end: (state, duration, parameters, that half-vector) -> the same of the terminal cost.
    """

    expansion: ca.Function
    gain: ca.Function
    running: ca.Function
    terminal: ca.Function
    extra_control: ca.Function
    by_parts: ca.Function | None
    spread: ca.Function | None = None
    spread_end: ca.Function | None = None

    __repr__ = short_repr

    def slopes(self, *point: Expr) -> LoopSlopes:
        """What `expansion` gives at (state, control, time, duration, parameters), by name."""
        return LoopSlopes(*self.expansion(*point))


@dataclass(frozen=True, kw_only=True)
class Duration:
    """The terminal time: its guess and bounds [s]; fixed where the bounds are equal."""

    guess: float
    lower: float
    upper: float

    @property
    def free(self) -> bool:
        """Whether the solver chooses it."""
        return self.lower < self.upper


@dataclass(frozen=True, kw_only=True, eq=False)
class Statement:
    """A vector-matrix optimal control problem, ready for any method.

    Functions (arguments in the order of `INPUTS`):
        nominal: (state, control, time, duration, parameters) -> rate, running cost. Only where not `coupled`; the
            running cost is zero here where it depends on the matrices.
        rates: (all six) -> rate of the state, rate of the stacked half-vectors, running cost.
        terminal: (state, matrices, duration, parameters) -> terminal cost.
        boundary: (parameters) -> initial state, final state, initial matrices, final matrices (NaN: free).
        matrix_end: (state, duration, parameters) -> half-vectors at T of the matrices that run backward, stacked; None
            where there are none. They have no initial value, and their rates do not depend on the other matrices.
        riccati: for each matrix, (state, control, time, duration, parameters) -> F, Q, W with
            V = F E + E F' + Q - E W E, or None where the rate has not this form.
        measurement: (state, control, time, duration, parameters) -> measured values, H = their Jacobian by the
            augmented state, noise density; None without measurements.
        measurements: where each of them lies among the measured values.
        information: (state, control, time, duration, parameters) -> the inverse densities that were stated as
            information, which may be zero but not negative; None where none was.
        expression: a user's expression -> function of the six inputs.
    """

    name: str
    blocks: tuple[Block, ...]
    duration: Duration
    values: Array
    nominal: ca.Function | None
    rates: ca.Function
    terminal: ca.Function
    boundary: ca.Function
    matrix_end: ca.Function | None
    loop: Loop | None
    riccati: tuple[ca.Function | None, ...]
    measurement: ca.Function | None
    measurements: tuple[Block, ...]
    information: ca.Function | None
    path: Conditions
    start: Conditions
    end: Conditions
    state_bounds: tuple[Array, Array]
    control_bounds: tuple[Array, Array]
    matrix_lower: Array
    guesses: Mapping[str, Any]
    scales: Mapping[str, Array]
    augmented: tuple[str, ...]
    coupled: bool
    symbolic: type
    autonomous: bool
    noise_varies: bool
    running_uses_matrices: bool
    symbols: Mapping[str, Any] = field(repr=False)
    expression: Callable[[Any], ca.Function] = field(repr=False)

    __repr__ = short_repr

    @property
    def measurement_names(self) -> tuple[str, ...]:
        """The user's names of the measurements."""
        return tuple(block.name for block in self.measurements)

    def of_kind(self, kind: Kind) -> tuple[Block, ...]:
        """The blocks of one kind, in the order of their declaration."""
        return tuple(block for block in self.blocks if block.kind == kind)

    @cached
    def states(self) -> tuple[Block, ...]:
        """Blocks of the nominal state."""
        return self.of_kind("state")

    @cached
    def controls(self) -> tuple[Block, ...]:
        """Blocks of the control."""
        return self.of_kind("control")

    @cached
    def matrices(self) -> tuple[Block, ...]:
        """Blocks of the matrix states."""
        return self.of_kind("matrix")

    @cached
    def nx(self) -> int:
        """Entries of the nominal state."""
        return sum(block.length for block in self.states)

    @cached
    def nu(self) -> int:
        """Entries of the control."""
        return sum(block.length for block in self.controls)

    @cached
    def ne(self) -> int:
        """Entries of all half-vectors together."""
        return sum(block.length for block in self.matrices)

    @cached
    def ahead(self) -> tuple[int, ...]:
        """Positions among `matrices` of those that run forward in time."""
        return tuple(i for i, block in enumerate(self.matrices) if not block.backward)

    @cached
    def behind(self) -> tuple[int, ...]:
        """Positions among `matrices` of those that run backward in time."""
        return tuple(i for i, block in enumerate(self.matrices) if block.backward)

    @cached
    def estimated(self) -> bool:
        """Whether the covariance of the estimation error is among the matrices."""
        return any(block.estimation for block in self.matrices)

    @cached
    def estimation(self) -> Block:
        """Block of the covariance of the estimation error, where there is one."""
        return next(block for block in self.matrices if block.estimation)

    @cached
    def integrals(self) -> bool:
        """Whether the matrices are integrals along the nominal: their rates depend on none of them."""
        if self.estimated or self.behind or not self.matrices:
            return False
        return bool(self.rates.jac_sparsity(1, INPUTS.index("matrices")).nnz() == 0)

    def entries(self, positions: tuple[int, ...]) -> list[int]:
        """Entries of the stacked half-vectors that belong to some of the matrices."""
        return [k for i in positions for k in range(self.matrices[i].span.start, self.matrices[i].span.stop)]

    @cached
    def bounded_states(self) -> list[int]:
        """Entries of the state with a bound."""
        lower, upper = self.state_bounds
        return [int(i) for i in np.flatnonzero(np.isfinite(lower) | np.isfinite(upper))]

    @property
    def np(self) -> int:
        """Entries of the parameters (known, then means of the unknowns)."""
        return int(self.values.size)

    def boundary_values(self, parameters: Array) -> Boundary:
        """Initial state, final state, initial matrices, final matrices for these parameters (NaN: free)."""
        values = self.boundary(parameters)
        return Boundary(*(np.asarray(value.full()).ravel() for value in values))

    @cached
    def matrix_names(self) -> tuple[str, ...]:
        """Names of the entries of the stacked half-vectors, such as 'E[x, b]'."""
        return tuple(name for block in self.matrices for name in half_names(block.name, block.labels))

    @cached
    def state_names(self) -> tuple[str, ...]:
        """Names of the entries of the state, such as 'y' or 'y[2]'."""
        return entry_names(self.states)

    @cached
    def control_names(self) -> tuple[str, ...]:
        """Names of the entries of the control."""
        return entry_names(self.controls)


def entry_names(blocks: Iterable[Any]) -> tuple[str, ...]:
    """Names of the entries of some stacked vectors."""
    return tuple(block.name if block.size == 1 else f"{block.name}[{i}]" for block in blocks for i in range(block.size))


def half_names(name: str, labels: tuple[str, ...]) -> list[str]:
    """Names of the entries of the half-vector of a matrix, such as 'E[x, b]'."""
    return [f"{name}[{labels[i]}, {labels[j]}]" for i, j in zip(*half_indices(len(labels)), strict=True)]
