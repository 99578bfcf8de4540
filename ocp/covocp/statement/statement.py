"""The frozen result of building a problem: CasADi functions with named inputs, dimensions and bounds.

This is what solvers read. The *nominal* (state x, control u) and the *matrices* (all symmetric matrix states, stacked
half-vectors e) are kept apart: the nominal drives the matrices, and only where `coupled` is true do the matrices drive
the nominal. Every function takes its arguments in the order

    (state, control, matrices, time, duration, parameters)

and leaves out those that it cannot depend on. `parameters` stacks the known parameters and the means of the unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.expressions import Expr
from covocp.base.geometry import Geometry
from covocp.base.matrices import Array, half_length
from covocp.base.pickling import not_pickled
from covocp.base.short_repr import short_repr
from covocp.base.threads import cached
from covocp.statement.chances import ChanceLimits
from covocp.statement.conditions import Columns as Columns
from covocp.statement.conditions import Conditions as Conditions
from covocp.statement.conditions import Inside
from covocp.statement.entries import entries_of, entry_names
from covocp.statement.switches import switch_times
from covocp.statement.time_data import TimeData, kinks

Kind = Literal["state", "control", "matrix", "unknown", "parameter", "measurement"]

# What a state or a matrix stands for: something that moves, a constant that is chosen, an integral over the whole time.
Role = Literal["moving", "decision", "integral"]
ROLES: tuple[Role, ...] = ("moving", "decision", "integral")

INPUTS = ("state", "control", "matrices", "time", "duration", "parameters")
# Jumps of what runs backward that are looked at one by one.
FEW = 4


@dataclass(frozen=True, kw_only=True)
class Block:
    """Where one of the user's symbols lies in its stacked vector.

    tangent: entries of its error where it is no vector (of an attitude: 3), else 0.
    """

    name: str
    kind: Kind
    size: int
    offset: int
    labels: tuple[str, ...] = ()
    covariance: bool = False
    estimation: bool = False
    backward: bool = False
    unit: str = ""
    tangent: int = 0
    role: Role = "moving"

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Tied:
    """Initial values that decisions give.

    states, matrices: entries of x(0) and of the half-vectors at the start.
    function: (state, parameters) -> their values, x(0)[states] and e(0)[matrices].
    slopes: (state, parameters) -> slopes of both, one below the other, by the state.
    """

    states: tuple[int, ...]
    matrices: tuple[int, ...]
    function: ca.Function
    slopes: ca.Function

    __repr__ = short_repr


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
    weighed: the same -> what terms of the loop's covariance add to A (n, n) and N (n, m); None without them.
    by_parts: (all six) -> L + tr(S Q + C'B C E)/2, tr(S E)/2: over any time the running cost is the integral of the
        first less the growth of the second [Schmidt E-20]; None where the gain is not the best one.
    spread: (state, control, time, duration, parameters, half-vector of the covariance of augmented state and controls)
        -> what terms that are not linear in that covariance add to the running cost; None without them.
    spread_end: (state, duration, parameters, that half-vector) -> the same of the terminal cost.
    shared: whether the gain is optimised because of what some phase of several asks for.
    """

    expansion: ca.Function
    gain: ca.Function
    running: ca.Function
    terminal: ca.Function
    extra_control: ca.Function
    by_parts: ca.Function | None
    weighed: ca.Function | None = None
    spread: ca.Function | None = None
    spread_end: ca.Function | None = None
    shared: bool = False

    __repr__ = short_repr

    def slopes(self, *point: Expr) -> LoopSlopes:
        """What `expansion` gives at (state, control, time, duration, parameters), by name."""
        return LoopSlopes(*self.expansion(*point))


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Measurements that are taken at instants, where the covariance of the estimation error falls at once.

    Such an instant is an interval of no length in the meshes, with a node before and one after it. What an interval
    takes of each measurement is its *reading*: 0 or 1, or a part of it, 1/k of the information in each of k parts.

    blocks: where each measurement lies among the values.
    places: the instants of each, rising fractions of the terminal time.
    measurement: (state, control, time, duration, parameters) -> values (m), H = their Jacobian by the augmented state
        (m, n), variance R of the noise (m, m).
    groups: rows that are read together, the others one after the other: their noises are correlated.
    update: (all six, reading) -> half-vectors after it [E+ = (I - K H) E (I - K H)' + K R K'], what it adds to the
        running cost: tr S (E - E+)/2 in a closed loop with the best gain, else nothing.
    """

    blocks: tuple[Block, ...]
    places: tuple[tuple[float, ...], ...]
    measurement: ca.Function
    groups: tuple[tuple[int, ...], ...]
    update: ca.Function

    __repr__ = short_repr

    @cached
    def instants(self) -> tuple[float, ...]:
        """All instants, rising."""
        return tuple(sorted({place for own in self.places for place in own}))


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


@not_pickled
@dataclass(frozen=True, kw_only=True, eq=False)
class Statement:
    """A vector-matrix optimal control problem, ready for any method.

    Functions (arguments in the order of `INPUTS`):
        nominal: (state, control, time, duration, parameters) -> rate, running cost. Only where not `coupled`; the
            running cost is zero here where it depends on the matrices.
        rates: (all six) -> rate of the state, rate of the stacked half-vectors, running cost.
        terminal: (state, matrices, duration, parameters) -> terminal cost.
        boundary: (parameters) -> initial state, final state, initial matrices, final matrices (NaN: free, or given by
            decisions).
        tied: initial values that decisions give, or None; those of states are also the last of the `start` conditions.
        matrix_end: (state, duration, parameters) -> half-vectors at T of the matrices that run backward, stacked; None
            where there are none. They have no initial value, and their rates do not depend on the other matrices.
        riccati: for each matrix, (state, control, time, duration, parameters) -> F, Q, W with
            V = F E + E F' + Q - E W E, or None where the rate has not this form.
        sources: for each matrix, the position of the covariance E of which it gains, beside its form, E W E with the W
            of that: what the estimate of a closed loop learns. None: of none.
        measurement: (state, control, time, duration, parameters) -> measured values, H = their Jacobian by the
            augmented state, noise density; None without measurements.
        measurements: where each of them lies among the measured values.
        information: (state, control, time, duration, parameters) -> the inverse densities that were stated as
            information, which may be zero but not negative; None where none was.
        inside: conditions at instants of the horizon, of which every mesh has the nodes.
        chances: conditions on probabilities, which are among those of `path`, `start` and `end`.
        samples: measurements that are taken at instants; None where there are none.
        data: values over time that are in some of these functions.
        tables: what is looked up in tables along the path, with their outermost knots as limits; None without tables.
        geometry: how the state moves where some of it is no vector.
        expression: a user's expression -> function of the six inputs; with scattered=True also of the half-vector of
            the covariance X of the closed loop, where conditions or the cost contain it.
    """

    name: str
    blocks: tuple[Block, ...]
    duration: Duration
    values: Array
    nominal: ca.Function | None
    rates: ca.Function
    terminal: ca.Function
    boundary: ca.Function
    tied: Tied | None
    matrix_end: ca.Function | None
    loop: Loop | None
    riccati: tuple[ca.Function | None, ...]
    sources: tuple[int | None, ...]
    measurement: ca.Function | None
    measurements: tuple[Block, ...]
    information: ca.Function | None
    samples: Samples | None
    data: tuple[TimeData, ...]
    tables: Conditions | None
    path: Conditions
    start: Conditions
    end: Conditions
    inside: Inside
    chances: tuple[ChanceLimits, ...]
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
    geometry: Geometry
    symbols: Mapping[str, Any] = field(repr=False)
    expression: Callable[..., ca.Function] = field(repr=False)
    matrix_parameters: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    __repr__ = short_repr

    @cached
    def readings(self) -> int:
        """Number of measurements that are taken at instants."""
        return 0 if self.samples is None else len(self.samples.blocks)

    @cached
    def instants(self) -> tuple[float, ...]:
        """Fractions of the terminal time at which every mesh has a node before and one after what happens there."""
        sampled = () if self.samples is None else self.samples.instants
        return tuple(sorted({*sampled, *self.inside.places}))

    @cached
    def conditions(self) -> tuple[Conditions, ...]:
        """All inequalities: along the path, at the start, at the end, at each of the instants."""
        return (self.path, self.start, self.end, *(part.conditions for part in self.inside.parts))

    def kinks(self, parameters: Array) -> tuple[tuple[float, ...], ...]:
        """Fractions of a fixed terminal time at which data have kinks, or rates jump or bend by comparing it; of each.

        They are nodes where these are few. The times that are compared may depend on the parameters.
        """
        if self.duration.free:
            return ()
        duration = self.duration.guess
        of_data = tuple(kinks(entry, duration) for entry in self.data)
        if self.autonomous:
            return of_data
        parts = [self.nominal, *self.riccati]  # of fewer operations than what they make together
        functions = [part for part in parts if part is not None]
        if len(functions) < len(parts) or self.running_uses_matrices:
            functions = [self.rates]
        return of_data + tuple(own for f in functions for own in switch_times(f, duration, parameters))

    @cached
    def falls(self) -> tuple[float, ...]:
        """Fractions of a fixed terminal time before which what runs backward is steep since its rate jumps; a few."""
        if self.duration.free or self.autonomous:
            return ()
        functions = [function for i in self.behind if (function := self.riccati[i]) is not None]
        jumps = [own for f in functions for own in switch_times(f, self.duration.guess, self.values)]
        places = sorted({place for own in jumps for place in own})
        return tuple(places) if len(places) <= FEW else ()

    def varies(self, position: int) -> bool:
        """Whether the rate of a matrix depends on the state or the control."""
        function = self.riccati[position]
        return function is None or any(function.jac_sparsity(k, i).nnz() for k in range(3) for i in range(2))

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
        """Positions among `matrices` of those that run forward in time, integrals of the others left out."""
        return tuple(i for i, block in enumerate(self.matrices) if not block.backward and block.role == "moving")

    @cached
    def behind(self) -> tuple[int, ...]:
        """Positions among `matrices` of those that run backward in time."""
        return tuple(i for i, block in enumerate(self.matrices) if block.backward)

    @cached
    def summed(self) -> tuple[int, ...]:
        """Positions among `matrices` of the integrals of what depends on the others; nothing depends on them."""
        return tuple(i for i, block in enumerate(self.matrices) if block.role == "integral")

    @cached
    def fed(self) -> bool:
        """Whether a matrix gains what another one loses by what is measured all the time."""
        return any(source is not None for source in self.sources)

    @cached
    def riccati_forms(self) -> bool:
        """Whether every matrix follows from the nominal and has a rate of Riccati form; integrals follow from them."""
        moving = (i for i in range(len(self.matrices)) if i not in self.summed)
        return not self.coupled and all(self.riccati[i] is not None for i in moving)

    @cached
    def decisions(self) -> list[int]:
        """Entries of the state that are constants to be chosen."""
        return [k for b in self.states if b.role == "decision" for k in range(b.span.start, b.span.stop)]

    @cached
    def moving(self) -> list[int]:
        """Entries of the state that are neither constants to be chosen nor integrals."""
        return [k for b in self.states if b.role == "moving" for k in range(b.span.start, b.span.stop)]

    @cached
    def estimated(self) -> bool:
        """Whether the covariance of the estimation error is among the matrices."""
        return any(block.estimation for block in self.matrices)

    @cached
    def estimation(self) -> Block:
        """Block of the covariance of the estimation error, where there is one."""
        return next(block for block in self.matrices if block.estimation)

    @cached
    def unknowns(self) -> int:
        """Entries of the unknowns, the last rows of the augmented state and the last parameters."""
        return sum(block.length for block in self.of_kind("unknown"))

    @cached
    def augmented_geometry(self) -> Geometry:
        """Of the augmented state: the states that are estimated, which are the first ones, then the unknowns."""
        rows = len(self.augmented) - self.unknowns
        estimated = self.geometry.first(
            max((part.rows.stop for part in self.geometry.parts if part.tangent.stop <= rows), default=0)
        )
        return Geometry.stacked(estimated, self.unknowns)

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
        """Entries of the state with a bound along the path; a constant keeps its own from the start."""
        lower, upper = self.state_bounds
        bounded = np.flatnonzero(np.isfinite(lower) | np.isfinite(upper))
        return [int(i) for i in bounded if i not in self.decisions]

    def slope(self, expression: Expr, name: str) -> Any:
        """Jacobian of an expression of the user's symbols by one of them, by the tangent of what is no vector."""
        charts = {block.name: part.chart for block, part in zip(self.states, self.geometry.parts, strict=True)}
        chart, symbol = charts.get(name), self.symbols[name]
        by_symbol = ca.jacobian(expression, symbol)
        return by_symbol if chart is None else by_symbol @ chart.basis(symbol)

    @property
    def np(self) -> int:
        """Entries of the parameters (known, then means of the unknowns)."""
        return int(self.values.size)

    def boundary_values(self, parameters: Array) -> Boundary:
        """Initial state, final state, initial matrices, final matrices for these parameters (NaN: free)."""
        return Boundary(*(values.copy() for values in _boundary_values(self, tuple(parameters.tolist()))))

    def started(self, x0: Expr, parameters: Expr, e0: Expr = None) -> tuple[Any, Any]:
        """Initial state and half-vectors with what decisions give of them; numbers or symbols.

        Args:
            x0: initial state, of which the decisions are read.
            parameters: of the statement.
            e0: half-vectors at the start; None: those of `boundary`.
        """
        e0 = self.boundary(parameters)[2] if e0 is None else e0
        if self.tied is None:
            return x0, e0
        x, e = self.tied.function(x0, parameters)
        return _replaced(x0, self.tied.states, x), _replaced(e0, self.tied.matrices, e)

    @cached
    def matrix_names(self) -> tuple[str, ...]:
        """Names of the entries of the stacked half-vectors, such as 'E[x, b]'."""
        return tuple(name for block in self.matrices for name in entries_of(block))

    @cached
    def state_names(self) -> tuple[str, ...]:
        """Names of the entries of the state, such as 'y' or 'y[2]'."""
        return entry_names(self.states)

    @cached
    def control_names(self) -> tuple[str, ...]:
        """Names of the entries of the control."""
        return entry_names(self.controls)


def _replaced(column: Expr, entries: tuple[int, ...], values: Expr) -> Any:
    """A column with other values in some entries; of numbers as an array where it was one."""
    if not entries:
        return column
    if isinstance(column, np.ndarray):
        result = column.copy()
        result[list(entries)] = np.asarray(values.full()).ravel()
        return result
    rows = ca.vertsplit(column)
    for k, value in zip(entries, ca.vertsplit(values), strict=True):
        rows[k] = value
    return ca.vertcat(*rows)


@lru_cache(maxsize=16)
def _boundary_values(statement: Statement, parameters: tuple[float, ...]) -> Boundary:
    """See `Statement.boundary_values`, which is asked several times in every solve."""
    return Boundary(*(np.asarray(value.full()).ravel() for value in statement.boundary(np.array(parameters))))
