"""A candidate solution as plain data: the trajectory at the nodes and the multipliers of what binds it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, NamedTuple, Protocol

import casadi as ca
import numpy as np

from covocp.base.dataclass import dataclass
from covocp.base.errors import CovocpError
from covocp.base.expressions import Expr
from covocp.base.matrices import Array
from covocp.base.progress import Progress
from covocp.base.short_repr import short_repr
from covocp.statement.conditions import Inside
from covocp.statement.interval import Interval, repeated
from covocp.statement.statement import Conditions, Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.nlp import Scales
from covocp.transcription.shooting import control_ends, interval_columns
from covocp.transcription.trajectory import Multipliers, Trajectory, at_nodes

# How a method says, among its counts, that it lost its way: it was stopped, or ended by itself.
STOPPED, ENDED = "stopped", "ended"


@dataclass(frozen=True, kw_only=True, eq=False)
class Extremal:
    """Trajectory, multipliers, and what is needed to evaluate anything along them.

    stated: the problem; None where it was read from a file without its problem.
    """

    mesh: Mesh
    trajectory: Trajectory
    parameters: Annotated[Array, "p"]
    multipliers: Multipliers
    stated: Statement | None = None

    __repr__ = short_repr

    @property
    def statement(self) -> Statement:
        """The problem.

        Raises:
            CovocpError: it is not known.
        """
        if self.stated is None:
            raise CovocpError(
                "This solution was read from a file and knows no problem: use load(path, problem=...) for this."
            )
        return self.stated

    @property
    def time(self) -> Array:
        """Times of the nodes [s]."""
        return np.asarray(self.mesh.nodes * self.trajectory.duration)

    @property
    def controls(self) -> Array:
        """Controls at all N + 1 nodes; a constant control holds its last value at the last node."""
        return at_nodes(self.trajectory.u, self.mesh.nodes.size)

    def control(self, k: Expr, c: Array) -> Array:
        """Controls at shares c of the intervals k, (K, nu)."""
        u = self.controls
        return np.asarray(u[k] if self.mesh.control == "constant" else u[k] + c[:, None] * (u[k + 1] - u[k]))

    def controls_at(self, s: Array, *, before: bool = False) -> Array:
        """Controls at some normalised times, (K, nu); where they jump those after it, or before it."""
        nodes = self.mesh.nodes
        k = np.clip(np.searchsorted(nodes, s, side="left" if before else "right") - 1, 0, nodes.size - 2)
        h = nodes[k + 1] - nodes[k]
        return self.control(k, np.where(h > 0, (s - nodes[k]) / np.where(h > 0, h, 1.0), float(not before)))

    def columns(self) -> tuple[Array | float, ...]:
        """Arguments (x, u, e, t, T, p) at the nodes, a column each, for a mapped function of the statement."""
        return (
            self.trajectory.x.T,
            self.controls.T,
            self.trajectory.e.T,
            self.time[None, :],
            *repeated(self.trajectory.duration, self.parameters, self.mesh.nodes.size),
        )

    def inequalities(self) -> Iterator[tuple[Conditions | Inside, str, Array]]:
        """Those of the statement that are there, their place, and their values at the nodes of it, (nodes, rows)."""
        st, columns = self.statement, [np.asarray(column) for column in self.columns()]
        for place, nodes in (("path", slice(None)), ("start", slice(1)), ("end", slice(-1, None))):
            conditions: Conditions = getattr(st, place)
            if conditions.size:
                chosen = [column[:, nodes] for column in columns]
                yield conditions, place, np.asarray(conditions.function.map(chosen[0].shape[1])(*chosen).full()).T
        if st.inside.size:
            values = [
                np.asarray(part.conditions.function(*(column[:, k] for column in columns)).full()).ravel()
                for part, k in zip(st.inside.parts, st.inside.nodes_among(self.mesh.nodes), strict=True)
            ]
            yield st.inside, "instants", np.concatenate(values)[None, :]

    @property
    def intervals(self) -> Interval:
        """Its control intervals, a column for each."""
        t = self.trajectory
        return interval_columns(self.mesh, ca.DM(t.u.T), t.duration, ca.DM(self.parameters))

    @property
    def interval_arrays(self) -> Interval:
        """The same as arrays, which cost less to take apart."""
        mesh, n = self.mesh, self.mesh.intervals
        start, end = control_ends(mesh, self.trajectory.u.T)
        reading = mesh.readings if mesh.readings.size else np.zeros((0, n))
        known = repeated(self.trajectory.duration, self.parameters, n)
        return Interval(start, end, mesh.nodes[None, :-1], np.diff(mesh.nodes)[None, :], *known, reading)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a method returns: an extremal, its cost by term, and how the run ended.

    Args:
        extremal: the last iterate.
        cost_terms: terminal and running cost.
        converged: whether the method's own test was met.
        message: how it ended, a sentence.
        violations: largest violation of each violated constraint by its name.
        stats: iterations, times, what the method counts; `wandered` where it lost its way (STOPPED or ENDED).
    """

    extremal: Extremal
    cost_terms: Mapping[str, float]
    converged: bool
    message: str
    violations: Mapping[str, float]
    stats: Mapping[str, Any]

    __repr__ = short_repr


class Merit(NamedTuple):
    """What a trajectory costs, its largest violation in units of the rows; NaN where they are no numbers.

    mark: a number of the same method that mirror images share, and starts that only cost the same do not.
    """

    cost: float
    violation: float
    mark: float


class Prepared(Protocol):
    """What `prepare` of a method's module returns: the problem made ready, solved as often as wanted."""

    @property
    def mesh(self) -> Mesh:
        """The resolved mesh."""

    def solve(self, parameters: Array, guess: Guess, progress: Progress) -> Outcome:
        """Solve for these parameters from this guess."""

    def merit(self, parameters: Array, trajectory: Trajectory) -> Merit:
        """What the controls of a trajectory cost, and how they meet the conditions."""


@dataclass(frozen=True, kw_only=True)
class Guess:
    """Where to start, and how sure that is.

    Args:
        trajectory: nominal and matrices at the nodes of the mesh.
        multipliers: of a related solution on the same mesh, or None.
        costates: p and the costates of the half-vectors at the nodes that belong to them, or None.
        warm: whether it comes from a solution.
        tentative: whether there are others: a method that loses its way should stop.
        scales: units of a program that is made for it; None: chosen by the trajectory.
        held: whether a feedback holds an unstable nominal along it, which need not be the way.
        rival: whether it is one of several ways round what may not be entered, or of several sides on which something
            is learnt: the cheapest that comes of them counts.
        about: what a rival is thought to cost, NaN where nothing tells.
        alike: whether a rival has the magnitudes of the problem's own start, whose program serves it.
        sides: the start as it is to be compared with those that are bent to other sides, and these; none: one side.
    """

    trajectory: Trajectory
    multipliers: Multipliers | None = None
    costates: tuple[Array, Array] | None = None
    warm: bool = False
    tentative: bool = False
    scales: Scales | None = None
    held: bool = False
    rival: bool = False
    about: float = np.nan
    alike: bool = False
    sides: tuple[Trajectory, ...] = ()

    __repr__ = short_repr
