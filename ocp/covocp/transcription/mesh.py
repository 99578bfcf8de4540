"""The mesh of a transcription: nodes, controls, substeps, shooting segments, and where the covariances are."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np

from covocp.base.arguments import MOST, is_number
from covocp.base.checks import as_number, is_whole
from covocp.base.errors import ProblemError, spelling
from covocp.base.expressions import Given
from covocp.base.linear_solve import LINEAR_SOLVER
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.base.threads import cached
from covocp.statement.statement import Statement
from covocp.transcription.before_reading import waits
from covocp.transcription.covariance_steps import StepKind

# Control intervals where none are asked for.
INTERVALS = 100
# And as many as can be: with a covariance of 12 rows 100 000 of them take 8 GB.
MOST_INTERVALS = 100_000
# Shooting segments where matrices are eliminated; where there are many states as few as these, about so many states at
# the starts of all: an iteration of Ipopt takes as long as an evaluation there (chain of masses of 28 and 58 states).
ELIMINATED_SEGMENTS, FEWEST_SEGMENTS, SEGMENT_STATES = 10, 5, 120
# Logarithm of what a change may grow to within one of them. With e^17 a regulator of an unstable plant ended away from
# its optimum: by any control the end of a segment moves further than a cost can tell.
GROWTH = 5.0
LARGEST_SUBSTEPS = 64
# Entries of E and S up to which their step is written out in scalars where they are variables.
SCALAR_ENTRIES = 12
# Entries of covariances up to which a constraint on them along the path makes them variables. Chain of masses with a
# bound on the variance of the stiffness, 50 intervals, seconds of the first solve as variables and eliminated:
# 10 entries 0.42 and 0.71, 21 entries 0.92 and 1.26, 36 entries 5.4 and 1.5, 55 entries 9.7 and 2.3.
PATH_ENTRIES = 21
# h times the spectral radius above which classical Runge-Kutta gets more substeps; its stability limit is 2.78.
STIFFNESS_PER_STEP = 1.0
# h times the largest rate of a decaying nominal from which on classical Runge-Kutta diverges.
STABILITY_LIMIT = 2.78
# Steps an interval that a nominal may need by classical Runge-Kutta before it is stepped implicitly.
EXPLICIT_SUBSTEPS = 8
# Implicit steps an interval, at most: what happens faster than these has died out. DC motor with a time constant of
# 1/20 of an interval, error of the cost with 1, 2, 3, 4, 8 steps: 6e-3, 5e-4, 1e-4, 1e-4, 2e-5.
IMPLICIT_SUBSTEPS = 4

# Gauss steps an interval, at least, where a gain is a control and the estimate learns all the time: by two of them a
# large gain while little is estimated costs nothing where the rule of the running cost does not look.
FED_SUBSTEPS = 4

# Share of the terminal time by which a time may miss an instant and mean it.
SAME_TIME = 1e-9
# The same of a node: what dividing and multiplying by the terminal time leave.
SAME_NODE = 4 * float(np.finfo(float).eps)


@dataclass(frozen=True, kw_only=True, eq=False)
class Graded:
    """The nodes of a default mesh that was graded at its ends, in place of a grid that is given (`grading`).

    nodes: of t/T, twice where a measurement is taken; asked: intervals that the user asked for; added: nodes added at
        the start and at the end; stiffness: largest h times rate of the filter on its intervals, None where it was not
        looked at; nominal: that of the nominal along a solution, None where only its start is known; layered: whether
        nodes were added for what the nominal does at its ends within a small part of an interval.
    """

    nodes: Array
    asked: int
    added: tuple[int, int] = (0, 0)
    stiffness: float | None = None
    nominal: Stiffness | None = None
    layered: bool = False

    __repr__ = short_repr


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of every shooting method, as the user gives them (`solve`); checked on construction."""

    intervals: int = INTERVALS
    control: Literal["linear", "constant"] = "linear"
    substeps: int | Literal["auto"] = "auto"
    grid: Any = None
    segments: int | Literal["auto"] = "auto"
    covariances: Literal["auto", "eliminated", "states"] = "auto"
    covariance_step: Literal["auto", "gauss", "strang", "rk4"] = "auto"
    step: Literal["auto", "rk4", "rodas"] = "auto"
    points: int | Literal["auto"] = "auto"
    refine: float | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Refuse options that mean nothing."""
        _whole("intervals", self.intervals, most=MOST_INTERVALS)
        _choice("control", self.control, ("linear", "constant"))
        _choice("covariances", self.covariances, ("auto", "eliminated", "states"))
        _choice("covariance_step", self.covariance_step, ("auto", "gauss", "strang", "rk4"))
        _choice("step", self.step, ("auto", "rk4", "rodas"))
        for name, value in (("substeps", self.substeps), ("segments", self.segments), ("points", self.points)):
            if not (isinstance(value, str) and value == "auto"):
                _whole(name, value, "'auto' or 1, 2, 3, ...")
        if self.refine is not None and not (is_number(self.refine) and 0 < float(self.refine) < 1):
            raise ProblemError(
                "The option 'refine' must be a relative error of the cost.",
                expected="None, or a number between 0 and 1, such as 1e-6",
                received=repr(self.refine),
                remedy="correct refine=",
            )

    def nodes(self) -> Array:
        """Nodes of the normalised time, from 0 to 1.

        Raises:
            ProblemError: where the given grid does not rise from 0 to 1.
        """
        if self.grid is None:
            return np.linspace(0.0, 1.0, self.intervals + 1)
        if isinstance(self.grid, Graded):
            return self.grid.nodes
        nodes = as_number("grid", "option", self.grid).ravel()
        if nodes.size < 2 or nodes[0] != 0 or nodes[-1] != 1 or not (np.diff(nodes) > 0).all():
            raise ProblemError(
                "The grid does not rise from 0 to 1.",
                expected="increasing nodes of t/T, the first 0, the last 1",
                received=np.array2string(nodes, threshold=8),
                remedy="divide the times by the duration",
            )
        return nodes

    @property
    def grading(self) -> dict[str, Any]:
        """What is said of the mesh in the statistics of a solution: how its ends were graded, where they were."""
        if not isinstance(self.grid, Graded) or self.grid.asked == self.grid.nodes.size - 1:
            return {}
        return {"intervals_asked": self.grid.asked, "nodes_added": self.grid.added}


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """A resolved mesh.

    Args:
        nodes: normalised time, shape (N + 1,), from 0 to 1.
        control: piecewise linear or piecewise constant.
        substeps: integration steps an interval.
        segments: lengths of the shooting segments, in intervals; they add up to N.
        eliminated: whether the matrices are propagated along the nominal instead of being variables.
        step: covariance step; "rodas": implicit steps of the nominal, gauss steps of the covariances.
        linear_solver: CasADi's linear solver of the covariance steps.
        readings: what each interval takes of each measurement at instants, (measurements, N): its node is there twice,
            and the interval between has no length; nothing where only a condition holds there.
        points: equally spread points of an interval, its start among them, where path inequalities and bounds of
            states are imposed, equations at the nodes alone; they are ends of substeps. 1: at the nodes only.
    """

    nodes: Array
    control: str
    substeps: int
    segments: tuple[int, ...]
    eliminated: bool
    step: StepKind
    linear_solver: str = LINEAR_SOLVER
    points: int = 1
    readings: Annotated[Array, "any intervals or none"] = field(default_factory=lambda: np.zeros((0, 0)))

    __repr__ = short_repr

    @property
    def intervals(self) -> int:
        """Number of control intervals N."""
        return self.nodes.size - 1

    @property
    def control_nodes(self) -> int:
        """Number of control values: N + 1 (linear) or N (constant)."""
        return self.intervals + (self.control == "linear")

    def divided(self, parts: int) -> Mesh:
        """The mesh with each interval in equal parts, whose steps are those of the interval."""
        c = np.arange(parts) / parts
        inside = self.nodes[:-1, None] + c * np.diff(self.nodes)[:, None]
        segments = tuple(parts * length for length in self.segments)
        nodes, readings = np.append(inside.ravel(), self.nodes[-1]), np.repeat(self.readings / parts, parts, axis=1)
        return replace(self, nodes=nodes, segments=segments, points=1, readings=readings)

    @cached
    def instants(self) -> list[int]:
        """Intervals of no length, at which measurements are taken or conditions hold."""
        return [int(k) for k in np.flatnonzero(np.diff(self.nodes) == 0.0)]

    def placed(self, s: Array) -> Array:
        """Normalised times within [0, 1]; what rounding parts from a node is the node, more so from an instant."""
        s = np.clip(s, 0.0, 1.0)
        for places, same in ((self.nodes, SAME_NODE), (self.nodes[self.instants], SAME_TIME)):
            if places.size:
                k = np.clip(np.searchsorted(places, s), 1, places.size) - 1
                for near in (places[k], places[np.minimum(k + 1, places.size - 1)]):
                    s = np.where(np.abs(s - near) <= same, near, s)
        return s

    @cached
    def stand_ins(self) -> list[int]:
        """For each control value the one that acts in its place: another where it would act for no time."""
        own = list(range(self.control_nodes))
        last = self.intervals
        if self.control == "constant":
            for k in self.instants:
                own[k] = own[k - 1] if k else next(j for j in own if j not in self.instants)
        elif self.instants:
            if self.nodes[1] == 0.0:
                begin = int(np.flatnonzero(self.nodes == 0.0)[-1])
                own[:begin] = [begin] * begin
            if self.nodes[last - 1] == self.nodes[last]:
                end = int(np.flatnonzero(self.nodes == self.nodes[last])[0])
                own[end:] = [end] * (last + 1 - end)
        still = set(self.instants)
        for k in reversed(self.instants):
            if k - 1 in still and not self.readings[:, k].any():  # for a condition on what goes on
                own[k] = own[k + 1]
        return own

    @cached
    def idle(self) -> list[int]:
        """Control values in whose place others act."""
        return [k for k, j in enumerate(self.stand_ins) if j != k]

    def acting(self, u: Any) -> Any:
        """Controls, a column each, with those that act in the place of others."""
        return u[:, self.stand_ins] if self.idle else u

    def gathered(self, slopes: Array) -> Array:
        """Slopes by the controls, a row each, where some act in the place of others."""
        if not self.idle:
            return slopes
        result = np.zeros_like(slopes)
        np.add.at(result, self.stand_ins, slopes)
        return result

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """Node at which each segment starts, and the last node."""
        return tuple(np.cumsum([0, *self.segments]).tolist())


def readings_at(statement: Statement, nodes: Array) -> Array:
    """What each interval of some nodes takes of each measurement at instants, (measurements, N).

    Raises:
        ValueError: an instant is not there twice.
    """
    taken = np.zeros((statement.readings, nodes.size - 1))
    if statement.samples is not None:
        empty = np.flatnonzero(np.diff(nodes) == 0.0)
        for j, places in enumerate(statement.samples.places):
            at = np.searchsorted(nodes[empty], places)
            if at.size and (at.max() >= empty.size or not np.array_equal(nodes[empty[at]], places)):
                raise ValueError("the nodes of the mesh are not those of the measurements")
            taken[j, empty[at]] = 1.0
    return taken


def control_places(nodes: Array, control: str) -> Array:
    """Normalised times of the control values: the nodes, or the middles of the intervals."""
    return nodes if control == "linear" else 0.5 * (nodes[1:] + nodes[:-1])


@dataclass(frozen=True, kw_only=True)
class Stiffness:
    """Largest h times rate of change for one step an interval.

    Args:
        nominal: of the nominal, the spectral radius of f_x.
        oscillating: of what does not die out faster than it moves (real part above -1/2 of the modulus): implicit
            steps must resolve it too, they would damp it.
        decaying: of what does not grow: explicit steps that are too long for it end in nonsense.
        matrices: of the covariances, where they are stepped by Runge-Kutta.
        growing: the largest real part, where it is positive.
    """

    nominal: float
    oscillating: float
    decaying: float
    matrices: float = 0.0
    growing: float = 0.0


def choose_mesh(statement: Statement, options: Options, step: StepKind, stiffness: Stiffness) -> Mesh:
    """Resolve every "auto".

    Args:
        statement: the problem.
        options: what the user asked for.
        step: as chosen by `choose_step`.
        stiffness: of the problem on this mesh (`guess.stiffness`).

    Raises:
        ProblemError: options that contradict the problem.
    """
    nodes = options.nodes()
    intervals = nodes.size - 1
    eliminated = _choose_eliminated(statement, options)
    if options.segments == "auto":
        count = intervals
        if eliminated and statement.matrices:
            grown = float(np.nan_to_num(intervals * stiffness.growing / GROWTH, posinf=intervals))
            usual = int(np.clip(SEGMENT_STATES // max(statement.nx, 1), FEWEST_SEGMENTS, ELIMINATED_SEGMENTS))
            count = min(max(usual, int(np.ceil(grown))), intervals)
    else:
        count = min(options.segments, intervals)
    if options.substeps == "auto":
        if step == "rodas":
            implicit = int(np.clip(np.ceil(np.sqrt(stiffness.nominal)), 1, IMPLICIT_SUBSTEPS))
            substeps = max(implicit, explicit_substeps(stiffness.oscillating))
        else:
            substeps = explicit_substeps(max(stiffness.nominal, stiffness.matrices if step == "rk4" else 0.0))
    else:
        substeps = options.substeps
    if step != "rodas" and stiffness.decaying > STABILITY_LIMIT * substeps:
        raise _too_few_substeps(substeps, stiffness.decaying)
    paired = statement.running_uses_matrices and (step != "rk4" or bool(statement.behind))
    if paired and statement.fed and options.substeps == "auto":
        substeps = max(substeps, FED_SUBSTEPS)
    if paired and substeps % 2:
        substeps += 1  # Simpson's rule for the running cost takes them in pairs
    substeps, points = _choose_points(statement, options, substeps, 2 if paired else 1)
    return Mesh(
        nodes=nodes,
        control=options.control,
        substeps=substeps,
        segments=segment_lengths(intervals, count),
        eliminated=eliminated,
        step=step,
        points=points,
        readings=readings_at(statement, nodes),
    )


def segment_lengths(intervals: int, count: int) -> tuple[int, ...]:
    """So many segments of as many intervals as possible, the longer ones first."""
    short, longer = divmod(intervals, count)
    return (short + 1,) * longer + (short,) * (count - longer)


def step_unit(statement: Statement, mesh: Mesh) -> int:
    """Of which the substeps of a mesh are a multiple: limits inside, and pairs for Simpson's rule."""
    return mesh.points * (2 if statement.running_uses_matrices else 1)


def with_substeps(options: Options, mesh: Mesh, substeps: int) -> Options:
    """Options of a mesh with other integration steps of its kind, and limits imposed where they are."""
    step: Any = "rodas" if mesh.step == "rodas" else "rk4"
    return replace(options, substeps=substeps, points=mesh.points, step=step)


def _choose_points(statement: Statement, options: Options, substeps: int, group: int) -> tuple[int, int]:
    """Substeps, and points of an interval where limits are imposed: ends of groups of so many substeps.

    An interval that needs substeps holds changes that its ends do not show, which the optimiser would use.

    Raises:
        ProblemError: given substeps that do not end at the given points.
    """
    if statement.loop is not None and statement.loop.shared and options.substeps == "auto":
        substeps = max(substeps, 2 * group)  # as below, also where the limits are those of another phase
    if not (statement.path.size or statement.bounded_states):
        return substeps, 1
    if options.points == "auto":
        if statement.path.realised is not None and options.substeps == "auto":
            substeps = max(substeps, 2 * group)  # the spread of the controls is free where it begins, at t = 0
        return substeps, max(1, substeps // group)
    least = options.points * group if options.points > 1 else 1
    if options.substeps != "auto" and substeps % least:
        raise ProblemError(
            f"The points at which limits are imposed are no ends of {'pairs of ' * (group > 1)}integration steps.",
            expected=f"substeps={least}, {2 * least}, ... for points={options.points}",
            received=f"substeps={options.substeps}",
            remedy="leave substeps='auto', or take a divisor of them as points",
        )
    return -(-substeps // least) * least, options.points


def _too_few_substeps(substeps: int, rate: float) -> ProblemError:
    """Explicit steps that diverge."""
    needed = int(np.ceil(rate / STIFFNESS_PER_STEP))
    return ProblemError(
        "The integration steps of the nominal are too long: classical Runge-Kutta diverges.",
        expected=f"about {needed} steps an interval: the fastest rate of the system, at its start, times the "
        f"longest interval is {rate:.3g}",
        received=f"{substeps} steps an interval",
        remedy=f"leave step= and substeps= 'auto' (implicit steps where they apply), or give substeps={needed} or "
        "more intervals",
    )


def explicit_substeps(stiffness: float) -> int:
    """Steps of classical Runge-Kutta that an interval of this stiffness takes."""
    return int(np.clip(np.ceil(stiffness / STIFFNESS_PER_STEP), 1, LARGEST_SUBSTEPS))


def choose_step(statement: Statement, options: Options, stiffness: Stiffness) -> StepKind:
    """The step of nominal and covariances.

    Args:
        statement: the problem.
        options: what the user asked for.
        stiffness: of the problem on this mesh.

    Returns:
        "rodas" where the nominal is too stiff for explicit steps, or asked for; else the covariance step.

    Raises:
        ProblemError: a step that does not apply.
    """
    covariance = _choose_covariance_step(statement, options, stiffness)
    riccati = statement.riccati_forms
    possible = riccati and not statement.fed and options.covariance_step in ("auto", "gauss")
    if options.step == "rodas" and not possible:
        raise ProblemError(
            "step='rodas' does not apply: it goes with gauss steps of the covariances.",
            expected="matrices of Riccati or Lyapunov form, stepped by gauss, that the nominal does not depend on",
            received="a gain that is a control, and an estimate that learns all the time"
            if statement.fed
            else f"covariance_step='{options.covariance_step}'"
            if riccati
            else "a matrix of another form: " + ", ".join(block.name for block in statement.matrices),
            remedy="leave step='auto', with more substeps= where the system is stiff",
        )
    needed = explicit_substeps(stiffness.nominal)
    too_few = options.substeps == "auto" or options.substeps < needed
    dies_out = explicit_substeps(stiffness.oscillating) <= EXPLICIT_SUBSTEPS
    stiff = options.step == "auto" and needed > EXPLICIT_SUBSTEPS and too_few and dies_out
    return "rodas" if possible and (options.step == "rodas" or stiff) else covariance


def _choose_covariance_step(statement: Statement, options: Options, stiffness: Stiffness) -> StepKind:
    """The covariance step: gauss where every rate has the Riccati form, else rk4.

    Where E and S of a closed loop are variables and small, rk4: written out in scalars, its exact derivatives cost a
    third of those of gauss's linear systems (lag of section 6.12, 6 entries). For large ones these are cheaper (Mars
    entry, 30 entries: 1.6 and 0.2 s for Hessian and Jacobian, with rk4 1.8 and 0.7 s and twice the memory).

    Where a gain is a control and all is measured all the time, few steps of rk4 are cheaper than those that keep Xhat
    semidefinite, and do: a wall of a double integrator takes a third of the time. Readings make it as narrow as can be.
    So many steps as a stiff nominal needs are too many to be written out.
    """
    riccati = statement.riccati_forms
    if options.covariance_step == "auto":
        small = statement.ne <= SCALAR_ENTRIES
        stated = bool(statement.behind) and small and not _choose_eliminated(statement, options)
        if statement.fed:
            many = explicit_substeps(stiffness.matrices) > EXPLICIT_SUBSTEPS
            stiff = explicit_substeps(stiffness.nominal) > EXPLICIT_SUBSTEPS
            stated = stiff or (statement.samples is None and not many)
        return "gauss" if riccati and not stated else "rk4"
    if options.covariance_step != "rk4" and not riccati:
        pairs = zip(statement.matrices, statement.riccati, strict=True)
        names = [block.name for block, form in pairs if form is None and block.role == "moving"]
        reason = "feeds back into the nominal" if statement.coupled else "is not of the form F E + E F' + Q - E W E"
        raise ProblemError(
            f"covariance_step='{options.covariance_step}' does not apply: the rate of "
            f"{', '.join(names) or 'a matrix'} {reason}.",
            expected="rates of Riccati or Lyapunov form that depend on the nominal only",
            received=", ".join(names) or "a coupled problem",
            remedy="use covariance_step='rk4' (or leave it 'auto')",
        )
    if options.covariance_step == "strang" and statement.fed:
        raise ProblemError(
            "covariance_step='strang' does not apply: the covariance of the estimate gains what its error loses, all "
            "the time.",
            expected="'gauss' or 'rk4' where a gain is a control",
            received="covariance_step='strang'",
            remedy="leave covariance_step='auto'",
        )
    return options.covariance_step


def _choose_eliminated(statement: Statement, options: Options) -> bool:
    """Whether the matrices are eliminated: where they can be, are no integrals, and no path constraint needs a few.

    Eliminated is faster for every covariance of benchmarks/measurements/formulations.py, down to a single variance.
    Integrals along the nominal have second derivatives that cost nothing as variables, and their sum over the whole
    path is ill-conditioned without them: an information matrix of 21 entries takes 45 iterations and 1.5 s, eliminated
    900 and 10 s (`models.designed_excitation`). A gain that acts only along what was read has curvature of very
    different size in its directions: an ellipse at the end takes 7 iterations with exact second derivatives, with an
    approximate Hessian 655.
    """
    if not statement.matrices:
        return True
    tied = () if statement.tied is None else statement.tied.matrices
    own = sorted(set(statement.entries(statement.ahead)) - set(tied))
    initial = statement.boundary_values(statement.values)[2][own]
    obstacle = None
    if statement.coupled:
        obstacle = "the rate of a state depends on a matrix"
    elif np.isnan(initial).any():
        obstacle = "an initial value of a matrix is free"
    elif statement.fed:
        obstacle = "a gain is a control"
    elif bounded := _bounded_matrices(statement):
        obstacle = f"the diagonal of {', '.join(bounded)} has a lower bound that its rate does not ensure"
    if options.covariances == "eliminated" and obstacle:
        raise ProblemError(
            "The matrices cannot be eliminated.",
            expected="matrices that follow from the nominal",
            received=obstacle,
            remedy="use covariances='states' (or leave it 'auto')",
        )
    if options.covariances != "auto":
        return options.covariances == "eliminated"
    if statement.integrals or waits(statement) or statement.fed:
        return False
    few = statement.loop is not None or statement.ne <= PATH_ENTRIES
    return obstacle is None and not (statement.path.uses_matrices and few)


def _bounded_matrices(statement: Statement) -> list[str]:
    """Matrices with lower bounds on the diagonal that only a variable can keep.

    An estimation covariance stays positive semidefinite by itself, and so does a state of Riccati or Lyapunov form
    that is only asked not to be negative.
    """
    names = []
    for block, form in zip(statement.matrices, statement.riccati, strict=True):
        lower = statement.matrix_lower[block.span]
        lower = lower[np.isfinite(lower)]
        if lower.size and not block.estimation and (form is None or lower.max() > 0):
            names.append(block.name)
    return names


def _whole(name: str, value: Given, expected: str = "1, 2, 3, ...", most: int = MOST) -> None:
    if not is_whole(value, 1, most):
        raise ProblemError(
            f"The option '{name}' must be a positive whole number.",
            expected=f"{expected}, at most {most:.3g}",
            received=repr(value),
            remedy=f"correct {name}=",
        )


def _choice(name: str, value: Given, choices: tuple[str, ...]) -> None:
    if not isinstance(value, str) or value not in choices:
        raise ProblemError(
            f"The option '{name}' has an unknown value.",
            expected="one of " + ", ".join(repr(choice) for choice in choices),
            received=repr(value),
            remedy=spelling(value, choices, f"correct {name}="),
        )
