"""The mesh of a transcription: nodes, controls, substeps, shooting segments, and where the covariances are."""

from __future__ import annotations

from dataclasses import field, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np

from covocp.base.arguments import MOST, is_number
from covocp.base.checks import as_number, is_whole
from covocp.base.dataclass import dataclass
from covocp.base.errors import ProblemError, spelling
from covocp.base.expressions import Given
from covocp.base.linear_solve import LINEAR_SOLVER
from covocp.base.matrices import Array
from covocp.base.short_repr import short_repr
from covocp.base.threads import cached
from covocp.statement.statement import Statement
from covocp.transcription.covariance_steps import StepKind

# Control intervals where none are asked for.
INTERVALS = 100
# And as many as can be: with a covariance of 12 rows 100 000 of them take 8 GB.
MOST_INTERVALS = 100_000
# Explicit steps an interval, at most.
LARGEST_SUBSTEPS = 64
# h times the spectral radius above which classical Runge-Kutta gets more substeps; its stability limit is 2.78.
STIFFNESS_PER_STEP = 1.0
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


def step_unit(statement: Statement, mesh: Mesh) -> int:
    """Of which the substeps of a mesh are a multiple: limits inside, and pairs for Simpson's rule."""
    return mesh.points * (2 if statement.running_uses_matrices else 1)


def with_substeps(options: Options, mesh: Mesh, substeps: int) -> Options:
    """Options of a mesh with other integration steps of its kind, and limits imposed where they are."""
    step: Any = "rodas" if mesh.step == "rodas" else "rk4"
    return replace(options, substeps=substeps, points=mesh.points, step=step)


def explicit_substeps(stiffness: float) -> int:
    """Steps of classical Runge-Kutta that an interval of this stiffness takes."""
    return int(np.clip(np.ceil(stiffness / STIFFNESS_PER_STEP), 1, LARGEST_SUBSTEPS))


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
