"""What is declared, name by name: the records that `Problem` collects and `freeze` turns into a statement."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from covocp.base.arguments import check_argument, checked_class, truth
from covocp.base.checks import check_positive, check_times, one_number
from covocp.base.dataclass import dataclass
from covocp.base.geometry import Chart
from covocp.base.matrices import Array
from covocp.base.pickling import not_pickled
from covocp.base.short_repr import short_repr
from covocp.problem.matrices import Matrix, Spread
from covocp.statement.statement import ROLES, Role
from covocp.statement.time_data import TimeData

Guess = float | Array | Callable[[Array], Any] | None
Place = Literal["path", "initial", "final"]
Where = Literal[Place, "inside"]


@checked_class
@dataclass(frozen=True, kw_only=True)
class Free:
    """A terminal time that the solver chooses.

    Args:
        guess: where to start [s].
        lower: smallest terminal time allowed [s], positive; a thousandth of the guess where it is not given.
        upper: largest terminal time allowed [s].

    Raises:
        ProblemError: where 0 < lower <= guess <= upper does not hold.
    """

    guess: float
    lower: float
    upper: float

    def __init__(self, guess: float, lower: float | None = None, upper: float = np.inf) -> None:
        """Check and keep the three numbers."""
        start = check_positive("duration", guess, unit="s")
        object.__setattr__(self, "guess", start)
        object.__setattr__(self, "lower", 1e-3 * start if lower is None else one_number("Free", "lower bound", lower))
        object.__setattr__(self, "upper", one_number("Free", "upper bound", upper))
        check_times(self.guess, self.lower, self.upper)


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """A vector state of the nominal; data are columns of numbers or of expressions in the parameters.

    role: constants that are chosen (decisions) and integrals are no part of the augmented state, and come last.
    chart: how it moves where it is no vector; its variance and its noise are those of its tangent, and what it has to
        reach is its target, which a constraint poses, not its final value.
    """

    name: str
    symbol: ca.MX
    size: int
    where: str
    unit: str
    initial: ca.MX
    final: ca.MX
    lower: Array
    upper: Array
    guess: Guess
    scale: Array | None
    variance: ca.MX
    role: Role = "moving"
    chart: Chart | None = None
    target: ca.MX | None = None

    __repr__ = short_repr

    @property
    def tangent(self) -> int:
        """Entries of its tangent where it is no vector, else 0."""
        return 0 if self.chart is None else self.chart.tangent

    @property
    def estimated(self) -> bool:
        """Whether it is part of the augmented state."""
        return self.role == "moving"


@dataclass(frozen=True, kw_only=True, eq=False)
class Unknown:
    """A constant unknown parameter of the actual system."""

    name: str
    symbol: ca.MX
    size: int
    where: str
    unit: str
    mean: Array
    variance: ca.MX

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Parameter:
    """A known number, vector, or matrix, whose columns are stacked.

    columns: of a matrix; of others 1.
    """

    name: str
    symbol: ca.MX
    size: int
    where: str
    unit: str
    value: Array
    columns: int = 1

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Control:
    """A control vector."""

    name: str
    symbol: ca.MX
    size: int
    where: str
    unit: str
    lower: Array
    upper: Array
    guess: Guess
    scale: Array | None

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Dynamics:
    """Rate of a state or of the half-vector of a matrix; `noise` is a square density matrix, None without noise.

    `one_density`: whether the noise was given as one number for all rows.
    """

    rate: ca.MX
    noise: ca.MX | None
    where: str
    one_density: bool = False

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurement:
    """A measurement and the density matrix of its noise, or, where it is taken at instants, its variance.

    instants: when it is taken, as rising fractions of the terminal time; none: always.
    information: the inverse density where it was stated in place of the density (a diagonal matrix that may be zero),
        else None. `noise` is then what stands for the density where a filter or a simulation needs one.
    """

    name: str
    expression: ca.MX
    noise: ca.MX
    unit: str
    where: str
    information: ca.MX | None = None
    instants: tuple[float, ...] = ()

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Chance:
    """lower <= expression <= upper of the actual system with a probability.

    probability: of each row, or of all rows together where they are joint; smallest: to which its standard deviations
    are rounded. slopes: by the augmented state and by the controls that scatter, and spread: the name of the matrix
    that is their covariance (None: X of the closed loop), once they are known.
    """

    name: str
    expression: ca.MX
    lower: Array
    upper: Array
    probability: float
    joint: bool
    smallest: float
    at: Place
    where: str
    slopes: tuple[ca.MX, ca.MX] | None = None
    spread: str | None = None

    __repr__ = short_repr

    @property
    def each(self) -> float:
        """Probability of each row: where they are joint each takes an equal share of the risk, by Boole's bound."""
        return 1.0 - (1.0 - self.probability) / self.lower.size if self.joint else self.probability


@dataclass(frozen=True, kw_only=True, eq=False)
class Data:
    """Data over time, and the table of them as a function of the time."""

    course: TimeData
    function: ca.Function
    where: str

    __repr__ = short_repr

    @property
    def name(self) -> str:
        """The user's name."""
        return self.course.name

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(self.course.values.shape[1])

    @property
    def unit(self) -> str:
        """Of each entry."""
        return self.course.unit


@dataclass(frozen=True, kw_only=True, eq=False)
class Constraint:
    """lower <= expression <= upper along the path, at the start, at the end or at an instant of the horizon.

    between: not at the nodes alone. instant: share of T of one that holds inside; late: after what happens then;
    relative: whether it was stated as a share.
    chance: the condition on probabilities that it stands for, with this name; else None.
    """

    name: str
    expression: ca.MX
    lower: Array
    upper: Array
    at: Where
    where: str
    between: bool = False
    instant: float | None = None
    late: bool = True
    relative: bool = False
    chance: Chance | None = None

    __repr__ = short_repr


@checked_class
@dataclass(frozen=True, kw_only=True)
class Gain:
    """A feedback gain with constraints, optimised instead of the unconstrained optimal one.

    Args:
        structure: which entries may differ from zero, shape (controls, augmented states), truth values; None: all.
        constant: whether each entry is one number for the whole time.
        lower: lower bounds of the entries, a number or an array of that shape.
        upper: upper bounds.
        guess: where the entries start; None: zero.
    """

    structure: Any = None
    constant: bool = False
    lower: Any = -np.inf
    upper: Any = np.inf
    guess: Any = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Refuse what is no truth value; the arrays are checked with the problem that they belong to."""
        check_argument("Gain()", "constant", truth, self.constant)


@dataclass(frozen=True, kw_only=True, eq=False)
class Expected:
    """An expected cost: L and k of the actual system, and the weights of what their second derivatives leave out.

    terminal_weight: added to k_xx, matrix over the augmented state or None; control_weight: B where it is given, a
    matrix over the controls, None where L_uu is taken.
    """

    running: ca.MX
    terminal: ca.MX
    terminal_weight: Any
    control_weight: Any
    gain: Gain | None
    where: str

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True, eq=False)
class Expansion:
    """What the feedback sees of the actual system along the nominal; expressions of the user's symbols.

    F, G: slopes of the rates by the augmented state and by the control; A, B, N: second derivatives of the running
    cost with the weights; Q: process noise; end: S(T); running, terminal: L and k; gain: the feedback gain C.
    spread: what nonlinear terms of the covariance X of the closed loop add to the running and to the terminal cost.
    weighed: what the linear ones of the running cost add to A and N; None without them.
    shared: whether the gain is optimised because of what some phase of several asks for.
    """

    F: ca.MX
    G: ca.MX
    A: ca.MX
    B: ca.MX
    N: ca.MX
    Q: ca.MX
    end: ca.MX
    running: ca.MX
    terminal: ca.MX
    gain: ca.MX
    alternative: ca.MX | None = None
    product: ca.MX | None = None
    spread: tuple[ca.MX, ca.MX] | None = None
    weighed: tuple[ca.MX, ca.MX] | None = None
    shared: bool = False

    __repr__ = short_repr


@not_pickled
@dataclass(frozen=True, kw_only=True, eq=False)
class Declarations:
    """All that is declared of a problem; another problem is made by replacing some of it.

    time, duration: symbols of the running and of the terminal time; the duration is a number where it is fixed.
    rates: by the name of the state or the matrix. expansion: of an expected cost that was derived. spread: the symbol
    of the covariance of the closed loop. chances: that are not yet constraints, because the cost is not known.
    """

    name: str
    duration: Any
    free_duration: Free | None = None
    time: ca.MX = field(default_factory=lambda: ca.MX.sym("time"))
    states: tuple[State, ...] = ()
    unknowns: tuple[Unknown, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    controls: tuple[Control, ...] = ()
    data: tuple[Data, ...] = ()
    matrices: tuple[Matrix, ...] = ()
    rates: Mapping[str, Dynamics] = field(default_factory=dict)
    measurements: tuple[Measurement, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    chances: tuple[Chance, ...] = ()
    cost: tuple[ca.MX, ca.MX] | None = None
    expected: Expected | None = None
    expansion: Expansion | None = None
    spread: Spread | None = None

    __repr__ = short_repr

    @property
    def named(self) -> tuple[Any, ...]:
        """All declarations that have a name."""
        symbols = (*self.states, *self.unknowns, *self.parameters, *self.controls, *self.matrices)
        return (*symbols, *self.data, *self.measurements, *self.constraints, *self.chances)

    @property
    def taken(self) -> tuple[Any, ...]:
        """All declarations whose names are taken."""
        return (*self.named, *(() if self.spread is None else (self.spread,)))

    @property
    def continuous(self) -> tuple[Measurement, ...]:
        """Measurements that are always there."""
        return tuple(entry for entry in self.measurements if not entry.instants)

    @property
    def sampled(self) -> tuple[Measurement, ...]:
        """Measurements that are taken at instants."""
        return tuple(entry for entry in self.measurements if entry.instants)

    @property
    def augmented(self) -> list[State | Unknown]:
        """What is estimated: states, then unknowns; constants that are chosen are not."""
        return [*(state for state in self.states if state.estimated), *self.unknowns]

    def adding(self, **more: Any) -> Declarations:
        """These and one more each in some groups, by the names of the groups; rates by name.

        Among states and matrices those that play another role than a state stay last.
        """
        rates = {**self.rates, **more.pop("rates", {})}
        grown: dict[str, Any] = {group: (*getattr(self, group), entry) for group, entry in more.items()}
        for group in grown.keys() & {"states", "matrices"}:
            grown[group] = tuple(sorted(grown[group], key=lambda entry: ROLES.index(entry.role)))
        return replace(self, rates=rates, **grown)
