"""What a controller is made from: the linear model, the gains and the limits along the nominal of a closed loop."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ExportError
from covocp.base.expressions import Expr, Given
from covocp.base.matrices import Array, unpack, unpack_symbolic
from covocp.base.short_repr import short_repr
from covocp.solution.origin import Origin
from covocp.solution.solution import Solution
from covocp.statement.names import control_limits
from covocp.statement.statement import Block, Statement


class DesignAt(NamedTuple):
    """F (n, n), G (n, m), h (r,), M (r, n), slope of h by the control (r, m), noise density U (r, r)."""

    F: Any
    G: Any
    h: Any
    M: Any
    H: Any
    U: Any


@dataclass(frozen=True, kw_only=True, eq=False)
class Design:
    """A closed loop along its nominal; n: rows of the estimate, m: controls fed back, r: measured values.

    Measured values are those that are always there, then those that are read at instants.

    Attributes:
        statement: of the problem.
        duration: T [s].
        parameters: of the statement.
        linear: (state, control, time) -> F (n, n), G (n, m), h (r,), M (r, n), slope of h by the control (r, m),
            noise density U (r, r), of what is read at instants its variance.
        noise: (state, control, time) -> Q (n, n).
        gain: (state, control, half-vectors, time) -> C (m, n), E (n, n).
        error: half-vectors -> E (n, n).
        weights: (state, control, time) -> A (n, n), N (n, m), B (m, m): second derivatives of the expected running
            cost by deviations of state and control.
        final_weight: S(T) (n, n).
        prior: E(0) (n, n), before what is read at time zero.
        best_gain: whether C is the best gain, not one that was constrained.
        limits: lower and upper limits of the control, (m,) each.
        units: largest standard deviation of each row of the estimate on the way, (n,); 1 where it is zero.
        labels: names of the rows of the estimate.
        sizes: n, m, r.
        measured: the measurements, in the order of the values.
        instants: times at which each value is read [s], (r,) of them; None of those that are always there.
    """

    statement: Statement
    duration: float
    parameters: Array
    linear: ca.Function
    noise: ca.Function
    gain: ca.Function
    error: ca.Function
    weights: ca.Function
    final_weight: Array
    prior: Array
    best_gain: bool
    limits: tuple[Array, Array]
    units: Array
    labels: tuple[str, ...]
    sizes: tuple[int, int, int]
    measured: tuple[Block, ...]
    instants: tuple[Array | None, ...]

    @property
    def always(self) -> int:
        """Number of values that are always there, the first ones."""
        return sum(times is None for times in self.instants)

    @property
    def reads(self) -> bool:
        """Whether something is read at instants."""
        return self.always < self.sizes[2]

    @property
    def reads_first(self) -> bool:
        """Whether something is read at time zero, where the covariance of the error jumps from the prior."""
        return any(times is not None and times[0] == 0.0 for times in self.instants)

    def due(self, time: Expr, margin: float) -> Any:
        """Which values are there at a time, 1 or 0, (r,); an MX expression."""
        rows = [
            ca.MX(1) if times is None else ca.mmin(ca.fabs(time - ca.DM(times))) <= margin for times in self.instants
        ]
        return ca.vertcat(ca.MX(0, 1), *rows)

    __repr__ = short_repr

    def model(self, x: Expr, u: Expr, t: Expr) -> DesignAt:
        """What `linear` gives at one point, or at a column of each for several, by name."""
        columns = x.shape[1] if len(x.shape) > 1 else 1
        return DesignAt(*(self.linear if columns == 1 else self.linear.map(columns))(x, u, t))

    @property
    def symbolic(self) -> Any:
        """SX, or MX where the model has no SX form."""
        return self.statement.symbolic


def design_of(solution: Solution, limits: Given) -> Design:
    """The closed loop of a solution.

    Args:
        solution: with a loop and its problem.
        limits: of the control that is given out: None, "bounds" (those of the problem), or a dict of control to
            (lower, upper).

    Raises:
        ExportError: no problem, limits that mean nothing.
    """
    statement = solution.statement
    if statement is None or statement.loop is None:
        raise ExportError(
            "The controller of this solution cannot be exported: it knows no problem.",
            expected="a solution with its problem",
            received=f"'{solution.name}', read from a file",
            remedy="load(path, problem=...) with the problem that was solved",
        )
    n, m = int(statement.loop.gain.size2_out(0)), int(statement.loop.gain.size1_out(0))
    symbolic: Any = statement.symbolic
    sizes = (statement.nx, statement.nu, statement.ne, 1)
    x, u, e, t = (symbolic.sym(k, size) for k, size in zip("xuet", sizes, strict=True))
    rest = (t, solution.duration, ca.DM(solution.parameters))
    F, G, A, B, N, Q = statement.loop.slopes(x, u, *rest)
    h, M, U = _measured(statement, n, x, u, *rest)
    slope = ca.jacobian(h, u)[:, :m]
    block = statement.estimation
    C, E = statement.loop.gain(x, u, e, *rest), unpack_symbolic(e[block.span], n)
    return Design(
        statement=statement,
        duration=solution.duration,
        parameters=solution.parameters,
        linear=ca.Function("linear", [x, u, t], [ca.densify(v) for v in (F, G, h, M, slope, U)]),
        noise=ca.Function("noise", [x, u, t], [ca.densify(Q)]),
        gain=ca.Function("gain", [x, u, e, t], [ca.densify(C), ca.densify(E)]),
        error=ca.Function("error", [e], [ca.densify(E)]),
        weights=ca.Function("weights", [x, u, t], [ca.densify(v) for v in (A, N, B)]),
        final_weight=np.asarray(statement.loop.terminal(solution.trajectory.x[-1], *rest[1:])[1].full()),
        prior=unpack(solution.trajectory.e[0, block.span], n),
        best_gain=statement.loop.by_parts is not None,
        limits=control_limits(statement, m, limits),
        units=_units(solution, block),
        labels=statement.augmented,
        sizes=(n, m, int(h.shape[0])),
        measured=measured_blocks(statement),
        instants=_instants(statement, solution.duration),
    )


def check_designed(solution: Solution) -> None:
    """Refuse a solution that was evaluated under another truth: the laws are those of its design, and see no truth.

    Raises:
        ExportError: names it.
    """
    if solution.origin is Origin.OTHER_TRUTH:
        raise ExportError(
            "This solution was evaluated under other statistics, of which a controller knows nothing.",
            expected="the solution of the design",
            received=f"'{solution.name}', {solution.message}",
            remedy="export the design, whose filter and feedback these are; feedback=False exports the histories alone",
        )


def check_measured(names: list[str], designs: list[Design]) -> None:
    """Refuse what never measures anything: the estimate stays zero, so there is nothing to feed back.

    One phase that measures is enough: the estimate goes on from it, and before it the feedback waits.

    Args:
        names: of the phases, or of the solution.
        designs: of each of them.

    Raises:
        ExportError: names them.
    """
    if not any(design.sizes[2] for design in designs):
        several = len(designs) > 1
        raise ExportError(
            f"There is no controller: {'no phase measures anything' if several else 'the problem measures nothing'}, "
            "so the feedback never acts.",
            expected="measurement() in one of the phases at least" if several else "a problem with measurement()",
            received=f"{', '.join(map(repr, names))} without one",
            remedy="add what is measured, or export the histories by feedback=False",
        )


def measured_blocks(statement: Statement) -> tuple[Block, ...]:
    """The measurements that are always there, then those at instants."""
    return (*statement.measurements, *(() if statement.samples is None else statement.samples.blocks))


def _measured(statement: Statement, n: int, *point: Any) -> tuple[Any, Any, Any]:
    """Values, slopes and noise of everything that is measured."""
    symbolic: Any = statement.symbolic
    parts: list[tuple[Any, ...]] = [(symbolic.zeros(0), symbolic.zeros(0, n), symbolic.zeros(0, 0))]
    if statement.measurement is not None:
        parts.append(tuple(statement.measurement(*point)))
    if statement.samples is not None:
        parts.append(tuple(statement.samples.measurement(*point)))
    h, M, U = zip(*parts, strict=True)
    return ca.vertcat(*h), ca.vertcat(*M), ca.diagcat(*U)


def _instants(statement: Statement, duration: float) -> tuple[Array | None, ...]:
    """When each measured value is there."""
    always: list[Array | None] = [None for block in statement.measurements for _ in range(block.size)]
    if statement.samples is None:
        return tuple(always)
    pairs = zip(statement.samples.blocks, statement.samples.places, strict=True)
    return (*always, *(duration * np.array(places) for block, places in pairs for _ in range(block.size)))


def _units(solution: Solution, block: Block) -> Array:
    """Largest standard deviation of the deviation from the nominal at any node, 1 where it is zero."""
    matrices = [unpack(solution.trajectory.e[:, block.span], block.size)]
    matrices += [solution.loop.X] if solution.loop is not None else []
    variances = np.max([np.diagonal(matrix, axis1=1, axis2=2).max(axis=0) for matrix in matrices], axis=0)
    units = np.sqrt(np.maximum(variances, 0.0))
    return np.where(np.isfinite(units) & (units > 0.0), units, 1.0)
