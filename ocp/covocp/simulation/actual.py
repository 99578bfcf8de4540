"""The systems of a simulation: the one that filter and feedback were designed for, and the one that really flies.

Both are the same unless a truth is given. The augmented state is that of the estimation covariance: the states, then
the unknown constants, which are the last entries of the parameters. One run of the actual system is had by putting its
own unknowns there.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError
from covocp.base.expressions import Given
from covocp.base.geometry import Geometry
from covocp.base.matrices import Array, unpack
from covocp.base.short_repr import short_repr
from covocp.problem.builder import Problem
from covocp.problem.declarations import Declarations
from covocp.problem.estimation_covariance import with_estimation
from covocp.problem.expected_cost import statement_of
from covocp.solution.solution import Solution
from covocp.statement.names import name_of, stacked_parameters
from covocp.statement.statement import Block, Statement

ARGUMENTS = ["state", "control", "time", "duration", "parameters"]


class Linearised(NamedTuple):
    """Rate of the augmented state, F, G, Q; measured values h, M, their slope Hu by the control, U."""

    rate: Given
    F: Given
    G: Given
    Q: Given
    h: Given
    M: Given
    Hu: Given
    U: Given


class Read(NamedTuple):
    """What is read at instants: values h, H, their slope Hu by the control, variance R."""

    h: Given
    H: Given
    Hu: Given
    R: Given


@dataclass(frozen=True, kw_only=True, eq=False)
class System:
    """A system with its statistics. n: errors of the augmented state, of which `states` move; m: controls fed back.

    start: mean of the augmented state at time zero; (n,) where all of it are vectors.
    variance: covariance of its deviation there, (n, n).
    linear: (state, control, time, duration, parameters) -> velocity of the augmented state (n,), F (n, n), G (n, m),
        process noise Q (n, n), measured values h (r,), M (r, n), their slope by the control (r, m), noise U (r, r).
    readings: the same arguments -> all values that can be read at instants (s,), H (s, n), their slope by the control
        (s, m), variance R (s, s).
    constants: what stands behind the states in x(0): decisions as they were chosen, integrals.
    """

    statement: Statement
    parameters: Array
    start: Array
    variance: Array
    states: int
    fed_back: int
    linear: ca.Function
    readings: ca.Function
    constants: Array

    __repr__ = short_repr

    def model(self, *point: Given) -> Linearised:
        """What `linear` gives at (state, control, time, duration, parameters), by name."""
        return Linearised(*self.linear(*point))

    def read(self, *point: Given) -> Read:
        """What `readings` gives at (state, control, time, duration, parameters), by name."""
        return Read(*self.readings(*point))

    @property
    def sampled(self) -> int:
        """Number of values that can be read at instants."""
        return int(self.readings.size1_out(0))

    @property
    def size(self) -> int:
        """Rows of the augmented state."""
        return int(self.variance.shape[0])

    @property
    def entries(self) -> int:
        """Entries of the part of the augmented state that moves; `states` where all of it are vectors."""
        return self.start.size - self.unknowns

    @property
    def geometry(self) -> Geometry:
        """How the augmented state moves by its error."""
        return self.statement.augmented_geometry

    @property
    def motion(self) -> Geometry:
        """The same of the part that moves."""
        return self.geometry.first(self.entries)

    def error(self, start: Array) -> Array:
        """By how much an augmented state differs from the mean at time zero, (n,)."""
        return np.asarray(self.geometry.differences(start[None], self.start[None])[0])

    @property
    def measured(self) -> int:
        """Number of measured values."""
        return int(self.linear.size1_out(4))

    @property
    def unknowns(self) -> int:
        """Number of unknown constants."""
        return self.size - self.states

    @property
    def covariance(self) -> slice:
        """Where the estimation covariance lies among the half-vectors of the statement."""
        return next(b.span for b in self.statement.matrices if b.estimation)


def design_system(solution: Solution) -> System:
    """The system that a solution's filter and feedback assume.

    Raises:
        ProblemError: read from a file without its problem, no estimation covariance, or dynamics that depend on a
            matrix.
    """
    statement = solution.statement
    if statement is None:
        raise ProblemError(
            "This solution knows no problem, so there is nothing to simulate.",
            expected="a solution with its problem",
            received=f"'{solution.name}', read from a file",
            remedy="load(path, problem=...) with the problem that was solved",
        )
    block = _estimation(statement)
    if block is None:
        raise ProblemError(
            "The covariance of the estimate is no part of this problem, so there is no filter to simulate.",
            expected="a problem with minimize_expected() or estimation_covariance()",
            received=f"'{statement.name}' without either",
            remedy="say what is uncertain (variance=, noise=) and call estimation_covariance() after the last state() "
            "and unknown(): where no cost or condition contains it, the solution stays as it is",
        )
    start = np.concatenate([solution.trajectory.x[0], solution.parameters])
    return _system(
        statement,
        solution.parameters,
        start=_augmented(statement, start[: statement.nx], solution.parameters),
        variance=unpack(solution.trajectory.e[0, block.span], block.size),
        fed_back=feedback_rows(statement),
        constants=solution.trajectory.x[0, len(statement.moving) :],
    )


def actual_system(design: System, truth: Given) -> System:
    """The system that is simulated.

    Args:
        design: of the solution.
        truth: None: the same; a dict of parameter or unknown to the value that it really has in every run; or a problem
            with the same states, unknowns, controls and measurements and any dynamics, noises and variances.

    Raises:
        ProblemError: where it is none of these, or names or sizes differ.
    """
    if truth is None:
        return design
    if isinstance(truth, Mapping):
        return _with_values(design, truth)
    if not isinstance(truth, Problem):
        raise ProblemError(
            "The truth is of an unknown kind.",
            expected="a Problem with the same states, unknowns, controls and measurements, or a dict of name to value",
            received=repr(truth)[:100],
            remedy="correct truth=",
        )
    return stated_system(design, truth.declarations, statement_of(plain_truth(truth.declarations)))


def stated_system(design: System, truth: Declarations, statement: Statement) -> System:
    """The system of a truth, from its declarations and the statement of `plain_truth` of them.

    Raises:
        ProblemError: names, sizes or instants differ from those of the design.
    """
    _check_measured(design, truth)
    _check_symbols(design, statement)
    return _from_statement(design, statement, statement.values)


def feedback_rows(statement: Statement) -> int:
    """Number of controls that are fed back: the first ones; none without an expected cost."""
    return 0 if statement.loop is None else int(statement.loop.gain.size1_out(0))


def _estimation(statement: Statement) -> Block | None:
    return next((b for b in statement.matrices if b.estimation), None)


def _augmented(statement: Statement, state: Array, parameters: Array) -> Array:
    """Augmented state from the whole state and the parameters."""
    entries = statement.augmented_geometry.size - statement.unknowns
    return np.concatenate([state[:entries], parameters[parameters.size - statement.unknowns :]])


def _system(
    statement: Statement, parameters: Array, *, start: Array, variance: Array, fed_back: int, constants: Array
) -> System:
    return System(
        statement=statement,
        parameters=parameters,
        start=start,
        variance=variance,
        states=len(statement.augmented) - statement.unknowns,
        fed_back=fed_back,
        linear=_linear(statement, fed_back),
        readings=_readings(statement, fed_back),
        constants=constants,
    )


def _linear(statement: Statement, fed_back: int) -> ca.Function:
    """Rates and measurements with their slopes and noise densities, see `System.linear`."""
    position = next(i for i, b in enumerate(statement.matrices) if b.estimation)
    form = statement.riccati[position]
    if statement.nominal is None or form is None:
        raise ProblemError(
            "The dynamics depend on a matrix, which the actual system does not have.",
            expected="rates of the states that depend on states, controls, time and parameters",
            received=f"'{statement.name}', a rate of which contains a matrix",
            remedy="simulate a problem whose states move without the matrices",
        )
    symbolic: Any = statement.symbolic
    a, n = _arguments(statement), len(statement.augmented)
    geometry = statement.augmented_geometry
    entries = geometry.size - statement.unknowns
    state, moved = (ca.vertsplit(v, [0, entries, statement.nx])[0] for v in (a[0], statement.nominal(*a)[0]))
    still = symbolic.zeros(statement.unknowns)
    rate = geometry.velocity(ca.vertcat(state, still), ca.vertcat(moved, still))
    F, Q, _ = form(*a)
    measured: tuple[Any, ...] = (symbolic.zeros(0), symbolic.zeros(0, n), symbolic.zeros(0, 0))
    if statement.measurement is not None:
        measured = statement.measurement(*a)
    h, M, U = measured
    slopes = [ca.jacobian(value, a[1])[:, :fed_back] for value in (rate, h)]
    outputs = [rate, F, slopes[0], Q, h, M, slopes[1], U]
    names = ["rate", "F", "G", "Q", "h", "M", "Hu", "U"]
    return ca.Function("linear", a, outputs, ARGUMENTS, names)


def _arguments(statement: Statement) -> list[Any]:
    """Symbols of (state, control, time, duration, parameters)."""
    symbolic: Any = statement.symbolic
    sizes = (statement.nx, statement.nu, 1, 1, statement.np)
    return [symbolic.sym(name, k) for name, k in zip(("x", "u", "t", "T", "p"), sizes, strict=True)]


def _readings(statement: Statement, fed_back: int) -> ca.Function:
    """What can be read at instants, see `System.readings`."""
    symbolic: Any = statement.symbolic
    a, n = _arguments(statement), len(statement.augmented)
    read: tuple[Any, ...] = (symbolic.zeros(0), symbolic.zeros(0, n), symbolic.zeros(0, 0))
    if statement.samples is not None:
        read = statement.samples.measurement(*a)
    h, H, R = read
    outputs = [h, H, ca.jacobian(h, a[1])[:, :fed_back], R]
    return ca.Function("readings", a, outputs, ARGUMENTS, ["h", "H", "Hu", "R"])


def _with_values(design: System, truth: Mapping[Any, Any]) -> System:
    """The design with other values of parameters; an unknown that is given has this value in every run."""
    statement = design.statement
    names = tuple(b.name for b in statement.blocks if b.kind in ("parameter", "unknown"))
    given = {name_of(key, statement.symbols, names, missing_ok=True) or str(key): v for key, v in truth.items()}
    values = stacked_parameters(statement, given, design.parameters)
    system = _from_statement(design, statement, values)
    variance, rows = system.variance.copy(), unknown_rows(design, given)
    variance[rows, :] = 0.0
    variance[:, rows] = 0.0
    return replace(system, variance=variance)


def unknown_rows(system: System, names: Container[str]) -> list[int]:
    """Rows of the augmented state with the unknowns of some names."""
    first = system.statement.np - system.size
    blocks = [block for block in system.statement.of_kind("unknown") if block.name in names]
    return [k - first for block in blocks for k in range(block.span.start, block.span.stop)]


def _from_statement(design: System, statement: Statement, values: Array) -> System:
    """Start and covariance as a statement has them for these values; free ones as the design has them."""
    state, _, matrices, _ = statement.boundary_values(values)
    moving = len(statement.moving)
    known = np.concatenate([design.start[:moving], design.constants])[: statement.nx]
    state, matrices = statement.started(np.where(np.isnan(state), known, state), values, matrices)
    block = _estimation(statement)
    assert block is not None
    half = matrices[block.span]
    return _system(
        statement,
        values,
        start=_augmented(statement, state, values),
        variance=design.variance if np.isnan(half).any() else unpack(half, block.size),
        fed_back=design.fed_back,
        constants=design.constants,
    )


def plain_truth(truth: Declarations) -> Declarations:
    """The truth with an estimation covariance and no other matrix; its cost and its constraints do not matter."""
    moving = {state.name for state in truth.states}
    plain = replace(
        truth,
        matrices=tuple(matrix for matrix in truth.matrices if matrix.estimation),
        rates={name: entry for name, entry in truth.rates.items() if name in moving},
        constraints=(),
        chances=(),
        expected=None,
        cost=(ca.MX(0), ca.sumsqr(ca.vertcat(*(state.symbol for state in truth.states)))),
    )
    return plain if plain.matrices else with_estimation(plain)


def _check_symbols(design: System, truth: Statement) -> None:
    """Filter and feedback of the design must fit the truth."""
    # Gains that were optimised are states or controls of the design, after those of the actual system.
    rows = {"state": design.entries, "control": design.fed_back or design.statement.nu}
    for kind, what in (("state", "states"), ("unknown", "unknowns"), ("control", "controls")):
        blocks = [b for b in design.statement.blocks if b.kind == kind and b.role == "moving"]
        own = [(b.name, b.size) for b in blocks if b.offset < rows.get(kind, b.offset + 1)]
        other = [(b.name, b.size) for b in truth.blocks if b.kind == kind and b.role == "moving"]
        if own != other:
            raise ProblemError(
                f"The truth has other {what} than the design.",
                expected=_listed(own),
                received=_listed(other),
                remedy=f"declare the same {what} in the same order and size; dynamics, noises and variances may differ",
            )
    chosen, own = (
        [(b.name, b.size) for b in statement.states if b.role != "moving"] for statement in (design.statement, truth)
    )
    if own != chosen[: len(own)]:
        raise ProblemError(
            "The truth has other decisions or integrals than the design, and no value of them is known.",
            expected=f"numbers, or {_listed(chosen)} in this order: the truth has the chosen values",
            received=_listed(own),
            remedy="declare the same decisions and integrals, or none and numbers in place of decisions",
        )


def _check_measured(design: System, truth: Declarations) -> None:
    """The filter of the design must be fed with what it expects, when it expects it."""
    own, read = design.statement, design.statement.samples
    expected: list[Any] = [(b.name, b.size, ()) for b in own.measurements]
    if read is not None:
        expected += [(b.name, b.size, at) for b, at in zip(read.blocks, read.places, strict=True)]
    given = [(m.name, m.expression.shape[0], m.instants) for m in (*truth.continuous, *truth.sampled)]
    if given != expected:
        same = [entry[:2] for entry in given] == [entry[:2] for entry in expected]
        raise ProblemError(
            "The truth has measurements at other instants than the design."
            if same
            else "The truth has other measurements than the design.",
            expected=_with_instants(expected),
            received=_with_instants(given),
            remedy="declare the same measurements in the same order, size and instants; expressions and noises may "
            "differ",
        )


def _with_instants(entries: list[Any]) -> str:
    """Measurements with their sizes, and at how many instants they are taken."""
    return (
        ", ".join(
            f"{name}: {size} value{'s' * (size > 1)}" + (f" at {len(at)} instants" if at else "")
            for name, size, at in entries
        )
        or "none"
    )


def _listed(entries: list[tuple[str, int]]) -> str:
    return ", ".join(f"{name} ({size})" if size > 1 else name for name, size in entries) or "none"
